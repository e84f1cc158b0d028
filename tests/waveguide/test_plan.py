"""Plans: predicted errors against true ones over random cameras, and what a plan says."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import hologram

import thincam_jax as tc
from helpers import AS_IN_USE, in_full, relative_l2
from thincam_jax import waveguide as wg
from thincam_jax.imaging.operators import Separable, Sparse
from thincam_jax.imaging.refractive_index import CauchyIndex
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide import planning, probe
from thincam_jax.waveguide.camera import seen_size
from thincam_jax.waveguide.rays import RayStatus, pixel_centres
from thincam_jax.waveguide.system import LitPlane, smeared_rays, system_matrix

SHAPE, CELLS = (32, 12), (24, 28)


# All orders of each camera are much work for a few programs: a sixth of the time.
OPTIMISED = eqx.filter_jit(smeared_rays, compiler_options=AS_IN_USE)


def all_optimised(camera, pixels, plane, orders, samples):
    compiled = OPTIMISED if orders >= 32 else smeared_rays
    return compiled(camera, pixels, plane, orders, samples)


@pytest.fixture(autouse=True)
def long_programs_optimised(monkeypatch):
    for module in (planning, probe):
        monkeypatch.setattr(module, "smeared_rays", all_optimised)


def reference(plan, plane):
    """The capture with all orders, 64 parts of each band and dispersion, in double precision."""
    pixels = pixel_centres(plan.camera)
    orders = 32 if plan.all_orders <= 32 else 48
    rays = all_optimised(plan.camera, pixels, plane, orders, 64)
    return system_matrix(rays, plane, float(seen_size(plan.camera, plane)), plan.level)


def errors(plan, *lit):
    """Predicted and true."""
    system = plan.system()
    images = np.array([one.image for one in lit]).reshape(system.in_shape)
    found = np.asarray(system(jnp.asarray(images, jnp.dtype(plan.precision))), float)
    true = sum(reference(plan, one.plane) @ np.asarray(one.image).ravel() for one in lit)
    return plan.predicted_error, relative_l2(found.ravel(), true)


@functools.cache
def pictures():
    """Photographs, a page of text, noise, and a few bright cells, in (24, 28) cells."""
    random = np.random.default_rng(8)
    photographs = [resize(sample_image(name, linear=True), CELLS) for name in ("camera", "page")]
    sparse = np.zeros(CELLS)
    sparse[random.integers(0, 24, 12), random.integers(0, 28, 12)] = 1
    blocks = np.kron(random.uniform(size=(6, 7)), np.ones((4, 4)))
    return [np.clip(p, 0, 1) for p in photographs] + [random.uniform(size=CELLS), blocks, sparse]


def random_case(random):
    """A camera whose middle sees guided light, an object about where it looks, and a tolerance."""
    while True:
        index = random.uniform(1.48, 1.6)
        if random.uniform() < 0.5:
            index = CauchyIndex(index, random.uniform(2e-9, 8e-9))
        film = wg.VolumeHologram.record(
            random.uniform(500, 600) * nm,
            random.uniform(-5, 5) * deg,
            random.uniform(50, 74) * deg,
            index=index,
            thickness=random.uniform(8, 40) * um,
            index_modulation=random.uniform(0.008, 0.04),
        ).processed(shrinkage=random.uniform(-0.01, 0.03))
        focal, field = random.uniform(4, 10), random.uniform(0.08, 0.22)
        sensor = tc.Sensor(SHAPE, 2 * focal * field / SHAPE[0])
        width = np.exp(random.uniform(np.log(3), np.log(12)))
        screen = wg.Screen(film, width, film.index)
        sts = wg.SeeThroughCamera(screen, sensor, focal, random.uniform(2, 20))
        distance = np.exp(random.uniform(np.log(100), np.log(2000)))
        middle = wg.trace(sts, jnp.zeros(2), object_distance=distance, orders=1)
        if int(middle.status[0]) != RayStatus.OK:
            continue
        # The bottom hologram: of any length, or of all that matters.
        first = float(middle.points[0, 1])
        height = random.uniform(1, 6) * first + 80 * field if random.uniform() < 0.5 else 1e4
        bottom = wg.Rectangle((first, 0.0), (height, 200.0))
        sts = eqx.tree_at(lambda c: c.screen.bottom, sts, bottom, is_leaf=lambda n: n is None)
        seen = 2 * field * distance
        offset = random.uniform(-0.2, 0.2, 2) * seen
        centre = np.asarray(middle.points[0, 1::-1]) + offset[::-1]
        plane = wg.ObjectPlane(CELLS, distance, random.uniform(0.3, 1.3) * seen, centre)
        image = pictures()[random.integers(5)]
        return sts, LitPlane(plane, image), 10 ** random.uniform(-3.5, -0.5)


@pytest.mark.parametrize(("count", "seed"), in_full((50, 34), (200, 34)))
def test_predictions_hold_over_random_cameras(capsys, count, seed):
    """True ≤ predicted in 99 % of cameras, predicted ≤ 10·true in 80 %."""
    random, pairs, met, kinds = np.random.default_rng(seed), [], [], []
    for _ in range(count):
        sts, scene, tolerance = random_case(random)
        plan = wg.plan_screen(sts, scene, tolerance=tolerance)
        pairs.append(errors(plan, scene))
        met.append((plan.meets_tolerance, pairs[-1][1] <= tolerance))
        way = (not plan.field_dependent, plan.dispersion, plan.samples is not None)
        kinds.append((*way, plan.precision == "float32"))
    predicted, true = np.array(pairs).T
    covered, close = np.mean(true <= predicted), np.mean(predicted <= 10 * true)
    claimed, held = np.array(met).T
    with capsys.disabled():
        quantiles = np.quantile(predicted / true, [0, 0.01, 0.05, 0.5, 0.95, 0.99, 1])
        print(
            f"\n{count} cameras: true ≤ predicted {covered:.1%}, predicted ≤ 10·true {close:.1%}; "
            "predicted/true at 0, 1, 5, 50, 95, 99, 100 %: "
            + ", ".join(f"{q:.3g}" for q in quantiles)
            + f"; true from {true.min():.1e} to {true.max():.1e}; tolerance claimed "
            f"{claimed.mean():.1%}, held {held.mean():.1%}; rows and columns apart, dispersion, "
            "smear, float32: " + ", ".join(f"{share:.0%}" for share in np.mean(kinds, axis=0))
        )
    assert covered >= 0.99
    assert close >= 0.80
    assert np.mean(held[claimed]) >= 0.99


def lit(shape):
    return LitPlane(wg.ObjectPlane(shape, 550.0, 150.0, (27.0, 0.0)), np.ones(shape))


@pytest.fixture(scope="module")
def scene():
    return LitPlane(lit(CELLS).plane, pictures()[0])


def thin(glass, modulation=0.02):
    """A plate of that thickness before the test's sensor."""
    screen = wg.Screen(hologram(index_modulation=modulation), glass, 1.5)
    return wg.SeeThroughCamera(screen, tc.Sensor(SHAPE, 66 * um), 6.0, 10.0)


@pytest.mark.thorough
def test_what_a_scene_requires(scene):
    """A loose tolerance takes rows and columns apart, a strict one the whole band of all ghosts."""
    loose, strict = (wg.plan_screen(thin(5.0), scene, tolerance=t) for t in (0.2, 1e-3))
    assert loose.meets_tolerance and strict.meets_tolerance
    assert isinstance(loose.system(), Separable) and isinstance(strict.system(), Sparse)
    assert loose.orders < strict.orders
    assert loose.samples is None and strict.samples is not None
    assert strict.simpler["shift-invariant"] > 0.2  # a convolution is far off in 5 mm of glass
    for words in (
        "tolerance   1.0e-03, predicted",
        f"ghosts      {strict.orders} of",
        "every pixel",
    ):
        assert words in str(strict)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"scene": [lit((3, 4)), lit((4, 3))]}, ValueError, "planes have .* cells; give at least"),
        ({"scene": []}, ValueError, "planes have .* cells; give at least one"),
        pytest.param(
            *({"camera": thin(5.0, 0.0)}, ValueError, "no light reaches the sensor.*check_screen"),
            marks=pytest.mark.thorough,
        ),
    ],
)
def test_errors(scene, change, error, message):
    given = {"camera": thin(5.0), "scene": scene, "tolerance": 0.1} | change
    with pytest.raises(error, match=message):
        wg.plan_screen(given["camera"], given["scene"], tolerance=given["tolerance"])
