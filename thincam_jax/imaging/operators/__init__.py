"""Linear operators of a camera, with their adjoints: one file a structure."""

from thincam_jax.imaging.operators.base import AbstractOperator as AbstractOperator
from thincam_jax.imaging.operators.base import adjoint_error as adjoint_error
from thincam_jax.imaging.operators.crop_convolution import CropConvolution as CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid as kernel_grid
from thincam_jax.imaging.operators.low_rank import LowRank as LowRank
from thincam_jax.imaging.operators.low_rank import low_rank_psf as low_rank_psf
from thincam_jax.imaging.operators.masked import Masked as Masked
from thincam_jax.imaging.operators.masked import Scaled as Scaled
from thincam_jax.imaging.operators.matrix import Matrix as Matrix
from thincam_jax.imaging.operators.reduced import ReducedMatrix as ReducedMatrix
from thincam_jax.imaging.operators.separable import Separable as Separable
from thincam_jax.imaging.operators.separable import centred as centred
from thincam_jax.imaging.operators.sparse import Sparse as Sparse
from thincam_jax.imaging.operators.stacked import Stacked as Stacked
