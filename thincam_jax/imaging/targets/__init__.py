"""Things to image: resolution charts, test patterns and photographs, as NumPy arrays in [0, 1].

All are drawn eagerly, with the centre of the picture at the centre of the array, +x right and
+y down. A scene turns them into a plane at a distance with a size in mm.
"""

from thincam_jax._core.names import modules_of
from thincam_jax.imaging.targets.images import middle_square as middle_square
from thincam_jax.imaging.targets.images import resize as resize
from thincam_jax.imaging.targets.images import sample_image as sample_image
from thincam_jax.imaging.targets.patterns import siemens_star as siemens_star
from thincam_jax.imaging.targets.usaf import usaf1951 as usaf1951

__getattr__ = modules_of(__name__)
