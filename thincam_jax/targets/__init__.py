"""Things to image: resolution charts, test patterns and photographs, as NumPy arrays in [0, 1].

All are drawn eagerly, with the centre of the picture at the centre of the array, +x right and
+y down. A scene turns them into a plane at a distance with a size in mm.
"""

from .images import load_image as load_image
from .images import resize as resize
from .images import sample_image as sample_image
from .images import sample_images as sample_images
from .patterns import point_grid as point_grid
from .patterns import siemens_star as siemens_star
from .patterns import slanted_edge as slanted_edge
from .usaf1951 import UsafElement as UsafElement
from .usaf1951 import line_pair as line_pair
from .usaf1951 import usaf1951 as usaf1951
from .usaf1951 import usaf1951_elements as usaf1951_elements
