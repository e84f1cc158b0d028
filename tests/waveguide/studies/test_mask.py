"""A mask in place of a screen's lens: its matrix against rays through every part of the mask."""

import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.studies import tiny_screen
from waveguide.test_screen_to_sensor import OBJECT, ORDERS, behind, blobs, mask, traced

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax import waveguide as wg
from thincam_jax._core.quantity import FieldError
from thincam_jax.waveguide.screen_to_sensor import ghost_images
from thincam_jax.waveguide.studies.calibration import CalibrationRun
from thincam_jax.waveguide.studies.mask import ScreenMask, first_image
from thincam_jax.waveguide.studies.screen import ScreenModel

PLANE = wg.ObjectPlane((18, 24), OBJECT, 150.0, (12.0, 6.0))


def test_cells_are_carried_to_their_first_image():
    """Off the axis and of a non-square plane: each sample reads its traced point's cell."""
    camera = behind()
    matrix, field = first_image(camera, PLANE)
    rows, columns = np.mgrid[: PLANE.shape[0], : PLANE.shape[1]]
    y, x = ((n - (c - 1) / 2) * float(PLANE.pitch) for n, c in ((rows, 18), (columns, 24)))
    ends = [(n - 1) / 2 * float(camera.sensor.pitch) for n in field]
    v, u = np.meshgrid(*(np.linspace(-e, e, n) for e, n in zip(ends, field, strict=True)))
    pixels = jnp.asarray(np.stack([v, u], axis=-1).transpose(1, 0, 2))
    seen = np.asarray(wg.trace(camera, pixels, object_distance=OBJECT, orders=1).points)[
        0, ..., 1::-1
    ]
    inside = np.abs(seen - np.asarray(PLANE.centre)) < np.array([43.0, 62.0])
    for axis, place in enumerate((y, x)):
        found = (matrix @ place.ravel()).reshape(field) + float(PLANE.centre[axis])
        assert np.abs(found - seen[..., axis])[inside.all(axis=-1)].max() < 0.1 * float(PLANE.pitch)
    assert float(matrix.sum(axis=0).min()) > 0.3 * float(matrix.sum(axis=0).max())


@pytest.mark.thorough
def test_matrix_against_rays_through_every_part_of_the_mask():
    camera, plane = behind(), wg.ObjectPlane((54, 72), OBJECT, 150.0, (12.0, 6.0))
    middle, sides = np.asarray(plane.centre), np.array(plane.shape)
    y, x = (float(plane.pitch) * (np.arange(n) - (n - 1) / 2) for n in sides)
    image = blobs(np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1) + middle)

    def scene(points):
        half = sides * float(plane.pitch) / 2
        return np.where((np.abs(points - middle) < half).all(axis=-1), blobs(points), 0)

    system = ScreenMask(mask(), "geometric", points=5, tolerance=2e-3).system(camera, plane, ORDERS)
    level = float(ghost_images(camera, jnp.zeros((1, 2)), OBJECT, ORDERS).weight.sum())
    # 1.6 %, nearly all of it the mean over samples that are as wide as the spots' deviation.
    assert relative_l2(level * system(jnp.asarray(image)), traced(camera, scene)) < 0.02
    alone = ScreenMask(mask(), "geometric", points=5).system(camera, plane, ORDERS, "no_ghosts")
    assert relative_l2(alone(jnp.asarray(image)), system(jnp.asarray(image))) > 0.04


def test_a_study_with_a_mask_refuses_the_mistakes_of_a_lens():
    given = {"mask": ScreenMask(tc.Pinhole(0.2)), "band_samples": None}
    with pytest.raises(FieldError, match="'no_smear' is of a camera with a lens; choose none or"):
        tiny_screen.study(models=(ScreenModel("sharp", "no_smear"),), **given)
    with pytest.raises(FieldError, match="the smear of the band is left out behind a mask"):
        tiny_screen.study(mask=given["mask"])
    masked = tiny_screen.study(models=(ScreenModel("right"),), **given)
    with pytest.raises(ValueError, match="a calibration fits a camera with a lens"):
        CalibrationRun(masked, tiny_screen.CALIBRATION)
    with pytest.raises(FieldError, match="a mask takes a hologram of one colour"):
        tiny_screen.study(tiny_screen.camera(), tiny_screen.camera(), **given)
