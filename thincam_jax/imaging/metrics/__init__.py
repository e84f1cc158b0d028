"""Image quality: agreement with a reference, and resolution read off a chart.

These are eager NumPy functions for judging results. They are not differentiable and do not belong
inside a jitted function; losses for optimisation live with the solvers.
"""

from thincam_jax.imaging.metrics.image import align as align
from thincam_jax.imaging.metrics.image import psnr as psnr
from thincam_jax.imaging.metrics.image import ssim as ssim
from thincam_jax.imaging.metrics.mtf import cut_off as cut_off
from thincam_jax.imaging.metrics.mtf import first_common_zero as first_common_zero
from thincam_jax.imaging.metrics.mtf import low_frequency_value as low_frequency_value
from thincam_jax.imaging.metrics.usaf import resolved_element as resolved_element
from thincam_jax.imaging.metrics.usaf import usaf_contrast as usaf_contrast
