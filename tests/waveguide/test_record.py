"""Recordings behind a screen, by the three lines of other cameras."""

import math

import numpy as np
import pytest
import skimage.data
from waveguide.studies import tiny_screen

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax import waveguide as wg
from thincam_jax._core.grids import Grid
from thincam_jax.imaging.targets import resize
from thincam_jax.units import nm
from thincam_jax.waveguide.camera import seen_size

PICTURE = skimage.data.camera()[::16, ::16] / 255.0


@pytest.mark.parametrize("deep", quick([False, True], 0))
def test_behind_a_screen(deep):
    """The scene's middle is where the middle pixel looks, and light adds up over planes."""
    camera = tiny_screen.camera()
    plane = tc.ImagePlane(PICTURE, 550.0, 120.0)
    recording = tc.record(camera, tc.Scene(plane, 550 * nm), noise=45.0)
    (capture,), (operator,) = recording.captures, recording.imaging_model.operators
    middle = wg.trace(camera, np.zeros((1, 2)), object_distance=550.0, orders=1).points[0, 0]
    size = float(seen_size(camera, wg.ObjectPlane((1, 1), 550.0, 120.0, (0.0, 0.0))))
    rows, columns = (math.ceil(float(side) / size) for side in (plane.height, plane.width))
    cells = wg.ObjectPlane((rows, columns), 550.0, 120.0, middle[1::-1])
    image = plane.sample(Grid(cells.shape, cells.pitch), magnification=1.0)
    expected = wg.system_operator(camera, cells)(image)
    assert relative_l2(capture, expected) < 0.01
    assert operator.in_shape == cells.shape
    image = tc.reconstruct(recording, tc.AdmmTV(0.5, iterations=30)).image
    truth = resize(PICTURE, cells.shape)
    assert np.corrcoef(np.ravel(image), np.ravel(truth))[0, 1] > 0.9
    both = tc.Scene([plane, tc.ImagePlane(PICTURE[:24], 300.0, 65.0)], 550 * nm)
    if deep:
        two = tc.record(camera, both).imaging_model.operators[0]
        assert two.in_shape == (2, *cells.shape)
    with pytest.raises(TypeError, match="is of a mask's PSF; leave it out here"):
        tc.record(camera, both, model="geometric")
    with pytest.raises(TypeError, match=r"give a LenslessCamera, several, a Mosaic, or a waveg"):
        tc.record(camera.sensor, both)
