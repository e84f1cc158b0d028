"""How good an image is: agreement with a reference, and resolution read off a chart.

These are eager NumPy functions for judging results. They are not differentiable and do not belong
inside a jitted function; losses for optimisation live with the solvers.
"""

from .image import align as align
from .image import psnr as psnr
from .image import ssim as ssim
from .mtf import cut_off as cut_off
from .mtf import first_common_zero as first_common_zero
from .mtf import low_frequency_value as low_frequency_value
from .mtf import zero_crossings as zero_crossings
from .usaf import UsafContrast as UsafContrast
from .usaf import resolved_element as resolved_element
from .usaf import usaf_contrast as usaf_contrast
