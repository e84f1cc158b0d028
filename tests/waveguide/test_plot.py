"""Colours of a screen's captures."""

import numpy as np

from thincam_jax.units import nm
from thincam_jax.waveguide.plot import srgb


def test_colours_of_wavelengths():
    red, green, blue = srgb(np.array([630.0, 530.0, 455.0]) * nm)
    assert red.argmax() == 0 and green.argmax() == 1 and blue.argmax() == 2
    assert red.max() == green.max() == blue.max() == 1
