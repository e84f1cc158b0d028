"""The system's matrix against a sum over rays, and images that come back from its captures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import hologram

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import adjoint_error
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import um

SENSOR = tc.Sensor((22, 30), 70.4 * um)


def small(**places):
    return wg.SeeThroughCamera(wg.Screen(hologram(), 5.0, 1.5, **places), SENSOR, 6.0, 10.0)


def plane(shape=(12, 16)):
    return wg.ObjectPlane(shape, 550.0, 120.0, (0.0, 27.0))


@pytest.mark.parametrize("shape", [(12, 16), (40, 37)])
def test_every_pixel_is_the_sum_of_its_ghosts(shape):
    """Cells larger and smaller than what a pixel sees: sampled finely in place of overlaps."""
    sts, seen = small(bottom=wg.Rectangle((0.0, 20.0), (60.0, 40.0))), plane(shape)
    image = np.random.default_rng(1).uniform(size=shape)
    found = np.asarray(wg.system_operator(sts, seen, 3)(jnp.asarray(image)))
    rays = wg.trace(sts, wg.pixel_centres(sts), 550.0, 3)
    weight = np.asarray(rays.weight)
    size = 70.4e-3 * 560 / 6
    pitch = 120.0 / shape[1]
    offsets = (np.arange(400) + 0.5) / 400 * size - size / 2
    expected = np.zeros((22, 30))
    for order, row, column in np.ndindex(weight.shape):
        x, y = np.asarray(rays.points[order, row, column, :2])
        columns = np.floor((x + offsets) / pitch + shape[1] / 2).astype(int)
        rows = np.floor((y - 27.0 + offsets) / pitch + shape[0] / 2).astype(int)
        columns, rows = (i[(i >= 0) & (i < n)] for i, n in ((columns, shape[1]), (rows, shape[0])))
        seen_here = image[np.ix_(rows, columns)].sum() / 400**2
        expected[row, column] += weight[order, row, column] * seen_here
    expected /= weight.sum(axis=0).mean()
    np.testing.assert_allclose(found, expected, atol=6e-3)


def test_adjoint_and_level():
    """A uniform object that fills the field gives captures about its radiance."""
    wide = wg.ObjectPlane((9, 11), 550.0, 800.0, (0.0, 27.0))
    operator = wg.system_operator(small(), wide)
    assert adjoint_error(operator, jax.random.key(1)) < 1e-14
    assert float(jnp.mean(operator(jnp.ones((9, 11))))) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(("name", "least"), [("camera", 34.0), ("page", 33.0)])
def test_images_come_back(name, least):
    """At 30 dB, with the solver of every camera; more than 34 and 33 dB at 64² on a 110² sensor."""
    sensor = tc.Sensor((110, 110), 19.2 * um)
    sts = wg.SeeThroughCamera(wg.Screen(hologram(), 5.0, 1.5), sensor, 6.0, 10.0)
    sts, seen = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32),
        (sts, wg.ObjectPlane((64, 64), 550.0, 150.0, (0.0, 27.0))),
    )
    operator = wg.system_operator(sts, seen)
    whole = sample_image(name)
    image = resize(whole if name == "camera" else whole[:180, :180], (64, 64))
    clean = operator(jnp.asarray(image, jnp.float32))
    deviation = float(jnp.sqrt(jnp.mean(clean**2))) * 10**-1.5
    noise = deviation * jax.random.normal(jax.random.key(0), clean.shape, jnp.float32)
    recording = tc.Recording((clean + noise)[None, None], [operator], noise_variance=deviation**2)
    found = tc.reconstruct(recording, tc.AdmmTV(0.5, iterations=100))
    assert psnr(np.squeeze(np.asarray(found.image)), image) > least


def test_cells_that_are_too_small_are_refused():
    fine = wg.ObjectPlane((500, 500), 550.0, 20.0, (0.0, 27.0))
    with pytest.raises(ValueError, match="a pixel sees 164.* cells.*give cells of at least"):
        wg.system_operator(small(), fine)
