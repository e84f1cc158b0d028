"""Image quality: agreement with a reference, and resolution read off a chart.

These are eager NumPy functions for judging results. They are not differentiable and do not belong
inside a jitted function; losses for optimisation live with the solvers.
"""

from thincam_jax._core.names import modules_of
from thincam_jax.imaging.metrics.image import align as align
from thincam_jax.imaging.metrics.image import psnr as psnr
from thincam_jax.imaging.metrics.image import ssim as ssim

__getattr__ = modules_of(__name__)
