"""The names of `thincam_jax.learn`; `__init__.py` reads them from here."""

from .denoiser.network import Denoiser as Denoiser
from .unrolled import UnrolledAdmm as UnrolledAdmm
