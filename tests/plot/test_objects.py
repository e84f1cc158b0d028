"""Pictures of objects in notebooks: what they hold, their axes and units."""

import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.operators import Separable
from thincam_jax.plot.objects import draw_camera, draw_recording, draw_scene
from thincam_jax.units import nm, um

RNG = np.random.default_rng(0)
CAMERA = tc.LenslessCamera(
    tc.FresnelZoneAperture(12.0, width=1.6), tc.Sensor((24, 32), 100 * um), distance=4.0
)


def titles(figure):
    return [axes.get_title() for axes in figure.axes]


def test_a_scene_shows_its_planes_in_millimetres():
    near, far = (tc.ImagePlane(RNG.random((3, 8, 12)), d, 0.3 * d) for d in (100.0, 300.0))
    figure = draw_scene(tc.Scene([near, far], 550 * nm))
    assert titles(figure) == ["at 100 mm", "at 300 mm"]
    assert figure.axes[1].get_xlim() == (-45, 45) and figure.axes[1].get_ylim() == (30, -30)
    assert figure.axes[0].get_xlabel() == "x (mm)"


def test_a_camera_shows_its_mask_and_itself_from_the_side():
    mask, side = draw_camera(CAMERA).axes
    np.testing.assert_allclose(mask.get_xlim(), (-0.8, 0.8))
    lines = {one.get_label(): np.array(one.get_data()) for one in side.get_lines()}
    np.testing.assert_allclose(lines["mask"], [[0, 0], [-0.8, 0.8]])
    np.testing.assert_allclose(lines["sensor"], [[4, 4], [-1.6, 1.6]])
    assert "24×32 pixels of 100 µm" in titles(side.figure)


def test_a_recording_shows_captures_and_the_psf():
    scene = tc.Scene(tc.ImagePlane(RNG.random((8, 12)), 250.0, 60.0), 550 * nm)
    assert titles(draw_recording(tc.record(CAMERA, scene))) == ["capture", "PSF"]
    operator = Separable(RNG.random((24, 9)), RNG.random((32, 12)))
    others = (
        tc.Recording(RNG.random((5, 24, 32)), tc.Psfs(RNG.random((5, 9, 9)))),
        tc.Recording([RNG.random((3, 24, 32))], operator),
        tc.Recording([RNG.random((24, 32))], tc.Cameras([CAMERA])),  # for fringe scanning
    )
    shown = [titles(draw_recording(one)) for one in others]
    assert shown == [[*(f"capture {n} of 5" for n in (1, 2, 3)), "PSF"], ["capture"], ["capture"]]


def test_the_psf_shown_is_that_of_the_first_camera():
    """Alone computed, from the nearest distance."""
    scene = tc.Scene(tc.ImagePlane(RNG.random((8, 12)), 250.0, 60.0), 550 * nm)
    recording = tc.record([CAMERA, CAMERA.replace(distance=6.0)], scene)
    shown = np.asarray(draw_recording(recording).axes[-1].images[0].get_array())
    optics = tc.Cameras([CAMERA], wavelength=550 * nm, object_distance=250.0)
    kernel = np.asarray(optics.kernels((24, 32), [1.0])[0][0, 0])
    assert shown.shape == kernel.shape
    assert np.corrcoef(shown.ravel(), kernel.ravel())[0, 1] > 0.9


def test_all_of_them_show_themselves():
    scene = tc.Scene(tc.ImagePlane(RNG.random((8, 12)), 250.0, 60.0), 550 * nm)
    for one in (scene, CAMERA, tc.record(CAMERA, scene)):
        assert one._repr_png_()[:4] == b"\x89PNG"
