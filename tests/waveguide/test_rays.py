"""Rays against the errata's exact values, a 3-D tracer of surfaces, and finite differences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import camera, hologram

from helpers import finite_difference, value_and_slope
from thincam_jax import waveguide as wg
from thincam_jax.imaging.refractive_index import CauchyIndex, bk7
from thincam_jax.units import nm
from thincam_jax.waveguide.rays import RayStatus, pixel_centres

# Of ERRATA: pixel (y, x), wavelength in nm, Θ′ in degrees, P_0, P_1, P_3 (x, y) in mm, to a digit.
EXACT = [
    ((0, 0), 532, 61.2, (0, 9.095), (0, 27.285), (0, 63.665)),
    ((1.0536, 0), 564.729, 54.579, (0, -92.467), (0, -78.406), (0, -50.285)),
    (
        (-1.0536, -1.0536),
        *(489.342, 67.918),
        *((100.998, 111.719), (104.020, 136.182), (110.065, 185.109)),
    ),
]
PLACES = 0.5e-3  # of the digits printed


@pytest.mark.parametrize(("pixel", "wavelength", "angle", *"ABC"), EXACT)
def test_exact_values(pixel, wavelength, angle, A, B, C):
    rays = wg.trace(camera(), jnp.asarray(pixel, float), object_distance=550.0)
    assert rays.wavelength / nm == pytest.approx(wavelength, abs=PLACES)
    inside = np.degrees(np.arcsin(np.linalg.norm(rays.guided) / 1.5))
    assert inside == pytest.approx(angle, abs=PLACES)
    expected = np.array([A, B, C])
    np.testing.assert_allclose(rays.points[np.array([0, 1, 3]), :2], expected, atol=PLACES)
    np.testing.assert_allclose(rays.points[:, 2], 6 + 10 + 5 + 550, rtol=1e-15)
    assert not rays.status.any()


def unit(vector):
    return vector / np.linalg.norm(vector)


def snell(direction, before, after):
    """Refraction at a plane z = const, with vectors."""
    across = direction[:2] * before / after
    return np.array([*across, np.sign(direction[2]) * np.sqrt(1 - across @ across)])


def to_plane(point, direction, z):
    return point + direction * (z - point[2]) / direction[2]


TILT = (0.03, -0.05)  # rad, of the plate about x and y


def turned(tilt):
    """Rotations about x, then y; columns are the plate's axes."""
    (cx, cy), (sx, sy) = np.cos(tilt), np.sin(tilt)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ about_x


def traced(pixel, order, distance, tilt=(0.0, 0.0), lens=(0.0, 0.0), focus=None):
    """Surface by surface: lens, glass, hologram, 2i total reflections, hologram, glass, object.

    Within a tilted plate in its own axes, from where the camera's axis meets its rear surface.
    """
    index, width = 1.5, 5.0
    k_recorded = 2 * np.pi * index / 532e-6
    angle = np.radians(61.2)
    fringes = k_recorded * np.array([0, -np.sin(angle), 1 + np.cos(angle)])
    rear, front = 0.0, width
    axes, corner = turned(tilt), np.array([0, 0, 16.0])
    y, x = pixel
    start, sharp = np.array([*lens[::-1], 6.0]), np.array([-x, -y, 6.0]) * (focus or 1e9) / 6.0
    ray = axes.T @ unit(sharp - [*lens[::-1], 0.0])
    point = to_plane(axes.T @ (start - corner), ray, rear)
    ray = snell(ray, 1.0, index)
    point = to_plane(point, ray, front)
    # The wavelength at which |k s − K| = k: the diffracted wave has the film's wavenumber.
    k = (fringes @ fringes) / (2 * ray @ fringes)
    ray = (k * ray - fringes) / k
    for bounce in range(2 * order + 1):
        point = to_plane(point, ray, front if bounce % 2 else rear)
        ray = ray * [1, 1, -1] if bounce < 2 * order else ray
    ray = (k * ray + fringes) / k
    point = to_plane(point, ray, front)
    ray = snell(ray, index, 1.0)
    ended = to_plane(corner + axes @ point, axes @ ray, 16.0 + width + distance)
    return ended, 2 * np.pi * index / k


@pytest.mark.parametrize(
    ("tilt", "lens", "focus"),
    [((0.0, 0.0), (0.0, 0.0), None), (TILT, (0.0, 0.0), 300.0), (TILT, (0.7, -1.2), 300.0)],
)
def test_a_tracer_of_surfaces(tilt, lens, focus):
    random = np.random.default_rng(5)
    pixels = random.uniform(-1.2, 1.2, (40, 2))
    places = {"tilt": np.array(tilt), "focus_distance": focus, "lens_point": np.array(lens)}
    sts = dataclasses.replace(camera(), **places)
    rays = wg.trace(sts, jnp.asarray(pixels), object_distance=550.0)
    assert not rays.status.any()
    for order in range(4):
        expected = [traced(pixel, order, 550.0, tilt, lens, focus) for pixel in pixels]
        points, wavelengths = zip(*expected, strict=True)
        np.testing.assert_allclose(rays.points[order], points, rtol=0, atol=1e-10)
        np.testing.assert_allclose(rays.wavelength, wavelengths, rtol=1e-13)


@pytest.mark.thorough
def test_single_precision_over_the_crop():
    sts = camera()
    pixels = pixel_centres(sts)[np.linspace(0, 439, 23).astype(int), ::73]
    single, plane = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (sts, pixels))
    points = wg.trace(single, plane, object_distance=jnp.float32(550.0)).points
    assert points.dtype == jnp.float32
    np.testing.assert_allclose(
        points, wg.trace(sts, pixels, object_distance=550.0).points, rtol=0, atol=1e-4
    )


def test_colours_of_the_crop():
    """489 to 565 nm; the image stands on its head on the sensor, so red is at its lower rows."""
    sts = camera()
    pixels = pixel_centres(sts)[np.linspace(0, 439, 12).astype(int)][:, [0, 219, 439]]
    nanometres = np.asarray(wg.trace(sts, pixels, object_distance=550.0).wavelength / nm)
    assert (np.round(nanometres.min()), np.round(nanometres.max())) == (489, 565)
    rows = nanometres.mean(axis=1)
    assert (np.diff(rows) > 0).all()


def test_guided_range():
    """Along x₀ = 0 from −29.87° to 46.27° in air: critical angle and grazing (Eq 5.5)."""
    angles = np.radians(np.array([-29.88, -29.86, 46.26, 46.28]))
    pixels = jnp.stack([-6.0 * np.tan(angles), jnp.zeros(4)], axis=-1)
    status = np.asarray(wg.trace(camera(), pixels, object_distance=550.0, orders=1).status[0])
    assert set(status[[1, 2]]) == {RayStatus.OK}
    assert RayStatus.OK not in status[[0, 3]]
    assert RayStatus.NOT_GUIDED in status


def numbers(sts, pixel, distance):
    rays = wg.trace(sts, pixel, object_distance=distance, orders=3)
    return jnp.sum(rays.points) + 1e5 * jnp.sum(rays.wavelength) + 1e5 * jnp.sum(rays.weight)


@pytest.mark.parametrize(
    "pixel", [(0.0, 0.0), pytest.param((-0.9, 0.6), marks=pytest.mark.thorough)]
)
@pytest.mark.parametrize("film", [1.5, pytest.param(bk7(), marks=pytest.mark.thorough)])
def test_gradients(pixel, film):
    """In every number of the camera, in the pixel (on the axis too) and in the distance."""
    sts = camera(hologram(film), film)
    at = (*eqx.partition(sts, eqx.is_inexact_array), jnp.asarray(pixel), jnp.asarray(550.0))

    def of_arrays(arrays, pixel, distance):
        return numbers(eqx.combine(arrays, at[1]), pixel, distance)

    value, slopes_of = value_and_slope(of_arrays, (0, 1, 2))
    point = (at[0], *at[2:])
    slopes = slopes_of(*point)
    leaves, structure = jax.tree.flatten(point)
    for number, (leaf, slope) in enumerate(zip(leaves, jax.tree.leaves(slopes), strict=True)):
        directions = [jnp.zeros_like(a) for a in leaves]
        directions[number] = jnp.asarray(np.random.default_rng(number).uniform(0.5, 1, leaf.shape))
        directions[number] = directions[number] * jnp.where(leaf == 0, 1.0, abs(leaf))
        direction = jax.tree.unflatten(structure, directions)
        expected = finite_difference(lambda p: value(*p), point, direction, 1e-6)
        found = np.vdot(slope, directions[number])
        np.testing.assert_allclose(found, expected, rtol=2e-6, atol=1e-5)


def test_every_fault_has_a_status():
    """And finite points: the angle of recording takes guided light past both ends."""
    steep = wg.VolumeHologram.record(
        532 * nm, 0.0, np.radians(40.0), index=1.5, thickness=0.016, index_modulation=0.02
    )
    low = camera(steep, 1.5)
    rays = wg.trace(low, jnp.zeros(2), object_distance=550.0)
    assert (rays.status == RayStatus.NOT_GUIDED).all()
    thin_glass = camera(hologram(), 1.2)
    rays = wg.trace(thin_glass, jnp.zeros(2), object_distance=550.0)
    assert (rays.status == RayStatus.EVANESCENT).all()
    short = camera(bottom=wg.Rectangle((20.0, 0.0), (30.0, 10.0)))
    rays = wg.trace(short, jnp.zeros(2), object_distance=550.0)
    # Contacts at 9.1, 27.3, 45.5 and 63.7 mm; the hologram ends at 35.
    off = RayStatus.OFF_HOLOGRAM
    np.testing.assert_array_equal(rays.status, [0, 0, off, off])
    assert not rays.weight[2:].any()
    aside = wg.trace(
        camera(),
        jnp.zeros(2),
        object_distance=550.0,
        orders=2,
        extent=wg.Rectangle((9.0, 0.0), (5.0, 5.0)),
    )
    np.testing.assert_array_equal(aside.status, [0, RayStatus.MISSED])
    narrow = camera(hologram(CauchyIndex(1.49, 4e-9, (540e-6, 600e-6))), 1.5)
    none = wg.trace(narrow, jnp.zeros(2), object_distance=550.0)
    assert (none.status == RayStatus.NO_BRAGG_MATCH).all()
    for found in (rays, aside, none):
        assert np.isfinite(found.points).all()
        assert np.isfinite(found.weight).all()


def test_an_earlier_contact_beside_the_hologram_takes_no_light():
    """A hologram that begins after the first contact: the second is then the first ghost."""
    whole = wg.trace(camera(), jnp.zeros(2), object_distance=550.0)
    late = wg.trace(
        camera(bottom=wg.Rectangle((60.0, 0.0), (80.0, 10.0))), jnp.zeros(2), object_distance=550.0
    )
    assert late.status[0] == RayStatus.OFF_HOLOGRAM
    np.testing.assert_allclose(late.weight[1:], whole.weight[:-1], rtol=1e-14)
