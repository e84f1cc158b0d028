"""The screen-to-sensor camera: images by order, its ghosts' transfer, and a ray trace by itself."""

import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import hologram

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax import waveguide as wg
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.operators.low_rank import low_rank_psf
from thincam_jax.units import um
from thincam_jax.waveguide.efficiency import ghost_weights
from thincam_jax.waveguide.screen_to_sensor import ghost_images, ghost_psfs

ORDERS, OBJECT = 3, 550.0


def behind(shape=(28, 32), pitch=110 * um):
    """A mask 6.5 mm before a bare sensor, 0.5 mm behind the plate of ERRATA's defaults."""
    sensor = tc.Sensor(shape, pitch)
    return wg.SeeThroughCamera(wg.Screen(hologram(), 5.0, 1.5), sensor, 6.5, 0.5)


class TestGhostImages:
    def images(self):
        field = jnp.array([[0.0, 0.0], [0.9, 0.6], [-0.4, -1.05]])
        return ghost_images(behind(), field, OBJECT, ORDERS)

    @pytest.mark.thorough
    def test_all_orders_see_the_same_point(self):
        found = self.images()
        rays = wg.trace(behind(), found.places, object_distance=OBJECT, orders=ORDERS)
        points = np.asarray(rays.points)
        for order in range(ORDERS):
            np.testing.assert_allclose(points[order, order], points[0, 0], atol=1e-9)
            own = np.asarray(rays.wavelength)[order]
            np.testing.assert_allclose(found.wavelength[order], own, rtol=1e-12)

    def test_on_the_axis(self):
        """30.4 mrad from image to first ghost: 35.9 pixels of 5.5 µm at d = 6.5 mm.

        One pixel sees points 18.19 mm apart, 32 mrad at the first image's 567 mm. But the ghost of
        one point is farther away: d1 + d2 + 2w/n + 3w/(n cos²Θ') = 600 mm along the screen.
        """
        y = np.asarray(self.images().places)[:, 0, 0]
        apart = np.asarray(
            wg.trace(behind(), jnp.zeros((1, 2)), object_distance=OBJECT, orders=2).points
        )[:, 0, 1]
        assert apart[1] - apart[0] == pytest.approx(2 * 5 * np.tan(np.deg2rad(61.2)), rel=1e-6)
        assert (apart[1] - apart[0]) / 567 * 1e3 == pytest.approx(32.1, abs=0.1)
        assert (y[1] - y[0]) / 6.5 * 1e3 == pytest.approx(30.38, abs=0.01)
        assert (y[1] - y[0]) / 5.5e-3 == pytest.approx(35.9, abs=0.05)
        # d(tan Θ')/dt = 1/(n cos²Θ'); Θ' of the ghost is 1.2° less than that of the axis.
        along = 550.5 + 10 / 1.5 + 15 / (1.5 * np.cos(np.deg2rad(61.2)) ** 2)
        assert along == pytest.approx((apart[1] - apart[0]) / (y[1] - y[0]) * 6.5, rel=3e-3)

    def test_sources_seem_farther_with_each_order(self):
        """T = d1 + d2 + 2w/n + (2i+1) w/(n cos Θ') across and /cos²Θ' along, in the mean."""
        cosine = np.cos(np.deg2rad(61.2))
        mean = (1 / cosine + 1 / cosine**2) / 2 / 1.5
        found = self.images().distance
        assert float(found[0, 0]) == pytest.approx(550.5 + 10 / 1.5 + 5 * mean, rel=1e-3)
        assert (np.diff(found, axis=0) > 10).all()


class TestGhostsAlone:
    """Σ W_i e^{ijφ}: the transfer of ghosts an equal step apart."""

    def test_those_of_the_film(self):
        """W_i falls with i as 0 < 1 − η < 1, and |ΣW_i e^{ijφ}| ≥ ∫η²/(2 − η)dλ, its value at π.

        Σ(1 − η)^i z^i = 1/(1 − (1 − η)z), whose real part on |z| = 1 is least at z = −1.
        """
        weights = np.asarray(ghost_weights(hologram(), jnp.zeros((1, 2)), 24))[:, 0]
        assert (np.diff(weights) < 0).all() and (weights > 0).all()
        phase = np.linspace(0, 2 * np.pi, 721)
        transfer = np.abs(np.exp(1j * np.outer(phase, np.arange(24))) @ weights)
        # The orders beyond the 24th add at most w_24/2.
        assert np.argmin(transfer) in (360 + np.arange(-15, 16))
        assert transfer.min() / weights.sum() == pytest.approx(0.64, abs=0.02)
        few = np.abs(np.exp(1j * np.outer(phase, np.arange(4))) @ weights[:4])
        assert few.min() / weights[:4].sum() > 0.69


def mask():
    return tc.FresnelZoneAperture(6.0, 0.4, width=1.375)


def traced(camera, scene):
    """The capture by rays through every part of the mask: no images, no PSF, no linear Δ.

    g(x) = Σ_m |t(m)|² Σ_i W_i(x − m) f(m + Δ_i(x − m)), with x, m and so x − m on one lattice.
    """
    fine, across = 2, 25
    pitch = float(camera.sensor.pitch) / fine
    opened = np.asarray(mask().sample(tc.Grid((across, across), pitch))) ** 2
    rows, columns = camera.sensor.shape
    lattice = tc.Grid((fine * (rows - 1) + across, fine * (columns - 1) + across), pitch)
    y, x = np.meshgrid(lattice.y, lattice.x, indexing="ij")
    rays = wg.trace(
        camera, jnp.asarray(np.stack([y, x], axis=-1)), object_distance=OBJECT, orders=ORDERS
    )
    points, weights = np.asarray(rays.points)[..., 1::-1], np.asarray(rays.weight)
    places = (np.arange(across) - (across - 1) / 2) * pitch
    total = np.zeros((rows, columns))
    for row, column in np.argwhere(opened > 0):
        # The mask's first part leaves the lattice's last differences.
        down, right = across - 1 - row, across - 1 - column
        part = np.s_[:, down : down + fine * rows : fine, right : right + fine * columns : fine]
        seen = scene(points[part] + places[[row, column]])
        total += opened[row, column] * np.sum(weights[part] * seen, axis=0)
    return total * pitch**2


def blobs(points):
    """Three spots on the object, mm."""
    total = np.full(points.shape[:-1], 0.0)
    for x, y, size in ((-30, 10, 9), (25, -20, 12), (10, 45, 8)):
        total += np.exp(-np.sum((points - [y, x]) ** 2, axis=-1) / (2 * size**2))
    return total


def field_of(camera, shape, count):
    """The first images of `count` points of a field, from its first to its last sample."""
    half = [(n - 1) / 2 * float(camera.sensor.pitch) for n in shape]
    y, x = (np.linspace(-h, h, n) for h, n in zip(half, count, strict=True))
    return jnp.asarray(np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1))


@pytest.mark.thorough
def test_operator_against_rays_through_every_part_of_the_mask():
    camera, shape = behind(), (24, 20)
    grid = kernel_grid(camera.sensor.grid, shape)

    def shadow(wavelength, distance, place):
        moved = tc.FresnelZoneAperture(
            6.0, 0.4, width=1.375, centre=place / (1 + camera.focal_distance / distance)
        )
        lensless = tc.LenslessCamera(moved, camera.sensor, camera.focal_distance)
        return tc.psf(
            lensless.on_grid(grid),
            wavelength=wavelength,
            object_distance=distance,
            model="geometric",
            pixel_integration=True,
        )

    images = ghost_images(camera, field_of(camera, shape, (5, 5)), OBJECT, ORDERS)
    psfs = ghost_psfs(images, shadow)
    fit = low_rank_psf(psfs, camera.sensor.pitch, camera.sensor.shape, shape, tolerance=2e-3)
    points = wg.trace(
        camera, field_of(camera, shape, shape), object_distance=OBJECT, orders=1
    ).points[0, ..., 1::-1]
    scene = jnp.asarray(blobs(np.asarray(points)))
    expected = traced(camera, blobs)
    assert relative_l2(fit.operator(scene), expected) < 0.01
    middle = psfs[2, 2]
    fixed = CropConvolution(middle, camera.sensor.pitch, camera.sensor.shape, shape)
    assert relative_l2(fixed(scene), expected) > 3 * relative_l2(fit.operator(scene), expected)
