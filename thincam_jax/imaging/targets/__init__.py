"""Things to image: resolution charts, test patterns and photographs, as NumPy arrays in [0, 1].

All are drawn eagerly, with the centre of the picture at the centre of the array, +x right and
+y down. A scene turns them into a plane at a distance with a size in mm.
"""

from thincam_jax.imaging.targets.images import load_image as load_image
from thincam_jax.imaging.targets.images import middle_square as middle_square
from thincam_jax.imaging.targets.images import resize as resize
from thincam_jax.imaging.targets.images import sample_image as sample_image
from thincam_jax.imaging.targets.images import sample_images as sample_images
from thincam_jax.imaging.targets.patterns import point_grid as point_grid
from thincam_jax.imaging.targets.patterns import siemens_star as siemens_star
from thincam_jax.imaging.targets.patterns import slanted_edge as slanted_edge
from thincam_jax.imaging.targets.usaf import line_pair as line_pair
from thincam_jax.imaging.targets.usaf import usaf1951 as usaf1951
from thincam_jax.imaging.targets.usaf import usaf1951_elements as usaf1951_elements
