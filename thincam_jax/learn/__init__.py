"""Learned parts: a denoiser, unrolled solvers, reconstructions for one camera.

The names stand in `__init__.pyi`; each is imported at its first use.
"""

from thincam_jax._core.names import lazy_face

__getattr__, __dir__ = lazy_face(__name__)
