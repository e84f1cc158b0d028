"""The names of `thincam_jax.learn`; `__init__.py` reads them from here."""

from .denoiser.network import Denoiser as Denoiser
from .trained import TrainedReconstruction as TrainedReconstruction
from .unrolled import UnrolledAdmm as UnrolledAdmm
