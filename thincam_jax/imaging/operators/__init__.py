"""Linear operators of a camera, with their adjoints: one file a structure."""

from thincam_jax._core.names import modules_of
from thincam_jax.imaging.operators.base import AbstractOperator as AbstractOperator
from thincam_jax.imaging.operators.crop_convolution import CropConvolution as CropConvolution
from thincam_jax.imaging.operators.masked import Masked as Masked
from thincam_jax.imaging.operators.masked import Stacked as Stacked
from thincam_jax.imaging.operators.matrix import Matrix as Matrix
from thincam_jax.imaging.operators.matrix import Sparse as Sparse
from thincam_jax.imaging.operators.reduced import ReducedMatrix as ReducedMatrix
from thincam_jax.imaging.operators.separable import Separable as Separable

__getattr__ = modules_of(__name__)
