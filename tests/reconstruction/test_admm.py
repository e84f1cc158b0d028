"""ADMM against a primal-dual solver on dense matrices; what its penalties must not change."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import dense, scenes

from helpers import count_traces, relative_l2
from thincam_jax.imaging.operators import CropConvolution, kernel_shape, window_shape
from thincam_jax.reconstruction.admm import (
    Penalties,
    Splitting,
    default_penalties,
    image_of,
    reflected,
    rescale,
    start,
    step,
)
from thincam_jax.reconstruction.problem import Deconvolution, objective
from thincam_jax.reconstruction.total_variation import TotalVariation

FIELD = (6, 11)
SENSORS = ((7, 9), (10, 6))


class Case(NamedTuple):
    """A problem twice: for the package, and as matrices."""

    problem: Deconvolution
    parts: list
    tau: float
    psi: np.ndarray
    kind: str
    joint: bool


class Setting(NamedTuple):
    """What a case is made of."""

    captures: int = 1
    planes: int = 1
    channels: int = 1
    kind: str = "isotropic"
    joint: bool = False
    depth_weight: float = 0.0
    nonnegative: bool = True
    tau: float = 0.5


CASES = {
    "one": Setting(),
    "two": Setting(captures=2, kind="anisotropic"),
    "colour": Setting(captures=2, channels=2, joint=True),
    "colour_anisotropic": Setting(channels=2, joint=True, kind="anisotropic"),
    "planes": Setting(captures=2, planes=2, depth_weight=0.5),
    "planes_anisotropic": Setting(planes=2, depth_weight=0.8, kind="anisotropic", tau=0.8),
    "signed": Setting(nonnegative=False),
}


def case(name: str) -> Case:
    """Random kernels, two sensors, weights that differ from pixel to pixel, dead pixels."""
    setting = CASES[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    planes, channels = setting.planes, setting.channels
    sensors = SENSORS[: setting.captures]
    windows = [window_shape(s, FIELD, kernel_shape(s, FIELD)) for s in sensors]
    window = tuple(max(sizes) for sizes in zip(*windows, strict=True))
    truth = np.maximum(rng.normal(size=(channels, planes, 2, 3)), 0)
    truth = np.repeat(np.repeat(truth, 3, axis=-2), 4, axis=-1)[..., :11].reshape(channels, -1)
    if not setting.nonnegative:
        truth = truth - 0.5
    operators, captures, weights, parts = [], [], [], []
    for sensor in sensors:
        kernels = rng.uniform(size=(channels, planes, *kernel_shape(sensor, FIELD))) ** 6
        operators.append(
            CropConvolution(jnp.asarray(kernels), 0.7, sensor, FIELD, summed=1, window=window)
        )
        matrices = np.stack(
            [np.hstack([dense.matrix(k, sensor, FIELD, 0.7) for k in row]) for row in kernels]
        )
        clean = np.einsum("cps,cs->cp", matrices, truth)
        capture = clean + 0.05 * clean.max() * rng.normal(size=clean.shape)
        weight = rng.uniform(0.5, 3.0, size=clean.shape)
        dead = rng.uniform(size=clean.shape) < 0.1
        weight[dead], capture[dead] = 0.0, 1e3
        captures.append(jnp.asarray(capture.reshape(channels, *sensor)))
        weights.append(jnp.asarray(weight.reshape(channels, *sensor)))
        parts.append((matrices, capture, weight))
    variation = TotalVariation(
        setting.kind,
        "joint" if setting.joint else "none",
        depth_weight=setting.depth_weight,
    )
    problem = Deconvolution(
        operators,
        captures,
        tau=setting.tau,
        weights=weights,
        variation=variation,
        nonnegative=setting.nonnegative,
    )
    psi = dense.slopes((planes, *FIELD), setting.depth_weight)
    return Case(problem, parts, setting.tau, psi, setting.kind, setting.joint)


@jax.jit
def _iterate(splitting, penalties, relaxation, state, count):
    return jax.lax.fori_loop(
        0, count, lambda _, s: step(splitting, penalties, relaxation, s), state
    )


def solved(problem, *, relaxation=1.8, factors=(0.1, 0.1, 0.1), iterations=1500, image=None):
    splitting = Splitting(problem)
    penalties = default_penalties(splitting)
    wanted = Penalties(*(jnp.asarray(f, problem.tau.dtype) for f in factors))
    penalties = jax.tree.map(jnp.multiply, penalties, wanted)
    image = jnp.zeros(problem.image_shape, problem.tau.dtype) if image is None else image
    begin = start(splitting, image)
    relaxation = jnp.asarray(relaxation, problem.tau.dtype)
    return image_of(splitting, _iterate(splitting, penalties, relaxation, begin, iterations))


def reference(given: Case) -> np.ndarray:
    """The primal-dual minimiser (channel, sample)."""
    return dense.primal_dual(
        given.parts,
        given.tau,
        given.psi,
        given.kind,
        given.joint,
        nonnegative=given.problem.nonnegative,
    )


def energy(given: Case, image) -> float:
    flat = np.asarray(image).reshape(given.parts[0][0].shape[0], -1)
    return dense.objective(flat, given.parts, given.tau, given.psi, given.kind, given.joint)


@pytest.mark.parametrize("name", CASES)
def test_the_minimiser_is_that_of_another_method(name):
    """Crop, dead pixels (of value 1000), weights, sensors of two shapes, planes, colours."""
    given = case(name)
    value, expected = solved(given.problem), reference(given)
    assert relative_l2(np.asarray(value).reshape(expected.shape), expected) < 1e-6
    lowest = energy(given, expected)
    assert energy(given, value) == pytest.approx(lowest, rel=1e-9)
    assert float(objective(given.problem, value)) == pytest.approx(lowest, rel=1e-9)
    # The case is one: the variation and the sign matter, and no image nearby is better.
    assert bool((expected < -0.01).any()) != given.problem.nonnegative
    without = eqx.tree_at(lambda p: p.tau, given.problem, given.problem.tau / 10)
    assert energy(given, solved(without)) > 1.001 * lowest
    rng = np.random.default_rng(0)
    for size in (1e-1, 1e-2, 1e-3) * 10:
        other = expected + size * rng.normal(size=expected.shape)
        other = np.maximum(other, 0) if given.problem.nonnegative else other
        assert energy(given, other) > lowest


@pytest.mark.parametrize("relaxation", [0.7, 1.0, 1.8])
@pytest.mark.parametrize("factors", [(0.1, 0.1, 0.1), (0.3, 0.2, 0.05)])
def test_relaxation_and_penalties_do_not_move_the_minimiser(relaxation, factors):
    given = case("two")
    expected = solved(given.problem)
    begin = jnp.full(given.problem.image_shape, 0.8)
    value = solved(
        given.problem, relaxation=relaxation, factors=factors, iterations=4000, image=begin
    )
    assert relative_l2(value, expected) < 1e-6


def test_a_state_stands_for_its_image():
    """`start` and back; negative parts are cut only if that is asked."""
    for nonnegative in (True, False):
        problem, _ = scenes.problem(planes=2, channels=2, nonnegative=nonnegative)
        splitting = Splitting(problem)
        image = jnp.asarray(np.random.default_rng(1).normal(size=problem.image_shape))
        back = image_of(splitting, start(splitting, image))
        expected = jnp.maximum(image, 0) if nonnegative else image
        np.testing.assert_allclose(back, expected, atol=1e-13)


def test_the_minimiser_is_a_fixed_point():
    """At the end q stays, and z = Kf in all splits: no gap is left."""
    given = case("two")
    splitting = Splitting(given.problem)
    penalties = jax.tree.map(lambda p: 0.1 * p, default_penalties(splitting))
    begin = start(splitting, jnp.zeros(given.problem.image_shape))
    state = _iterate(splitting, penalties, jnp.asarray(1.8), begin, 2000)
    after = step(splitting, penalties, jnp.asarray(1.0), state)
    for before, now in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        np.testing.assert_allclose(now, before, atol=1e-10)


def consensus(splitting, penalties, state):
    back = reflected(splitting, penalties, state)
    return jax.tree.map(lambda q, r: 0.5 * (q + r), state, back)


def test_other_penalties_keep_image_and_forces():
    """`rescale`: z as before, μ(q − z), which are the forces, as before; the same fixed point."""
    given = case("colour")
    splitting = Splitting(given.problem)
    penalties = default_penalties(splitting)
    state = start(splitting, jnp.full(given.problem.image_shape, 0.4))
    state = _iterate(splitting, penalties, jnp.asarray(1.5), state, 20)
    factors = Penalties(*(jnp.asarray(f) for f in (0.3, 2.5, 1.7)))
    others, scaled = rescale(splitting, state, penalties, factors)
    for name in ("data", "variation", "image"):
        ratio = float(getattr(others, name) / getattr(penalties, name))
        assert ratio == pytest.approx(float(getattr(factors, name)), rel=1e-12)
    z, still = consensus(splitting, penalties, state), consensus(splitting, others, scaled)
    force = 0.0
    for part, name in (("data", "data"), ("slopes", "variation"), ("image", "image")):
        old, new = getattr(penalties, name), getattr(others, name)
        sides = (getattr(s, part) for s in (state, z, scaled, still))
        for q, a, r, b in zip(*(jax.tree.leaves(s) for s in sides), strict=True):
            np.testing.assert_allclose(b, a, atol=1e-12)
            np.testing.assert_allclose(new * (r - b), old * (q - a), atol=1e-12)
            force = max(force, float(jnp.abs(q - a).max()))
    assert force > 0.1
    np.testing.assert_allclose(image_of(splitting, scaled), image_of(splitting, state), atol=1e-12)


def test_the_reflection_minimises_each_part():
    """z of the data: (w g + μ q)/(w + μ) on the sensor, q beside it; of the image: its field."""
    given = case("one")
    splitting = Splitting(given.problem)
    penalties = Penalties(*(jnp.asarray(p) for p in (0.7, 2.0, 3.0)))
    rng = np.random.default_rng(4)
    state = start(splitting, jnp.zeros(given.problem.image_shape))
    state = jax.tree.map(lambda q: jnp.asarray(rng.normal(size=q.shape)), state)
    z = consensus(splitting, penalties, state)
    operator = splitting.operators[0]
    (top, left), (rows, columns) = operator.sensor_corner, operator.sensor_shape
    inside = np.zeros(operator.window, bool)
    inside[top : top + rows, left : left + columns] = True
    q = np.asarray(state.data[0])[0]
    w, g = np.asarray(splitting.weights[0])[0], np.asarray(splitting.captures[0])[0]
    expected = q.copy()
    expected[inside] = ((w * g + 0.7 * q[inside].reshape(g.shape)) / (w + 0.7)).ravel()
    np.testing.assert_allclose(z.data[0][0], expected, rtol=1e-12, atol=1e-12)
    field = np.zeros(operator.window, bool)
    (top, left), (rows, columns) = operator.field_corner, operator.field_shape
    field[top : top + rows, left : left + columns] = True
    q = np.asarray(state.image)[0, 0]
    np.testing.assert_allclose(z.image[0, 0], np.where(field, np.maximum(q, 0), 0), atol=1e-15)
    # the last row's difference downwards leaves the field, and costs nothing
    row = top + rows - 1
    np.testing.assert_array_equal(z.slopes[0][0, 0, row], state.slopes[0][0, 0, row])
    assert jnp.abs(z.slopes[0][0, 0, row - 1] - state.slopes[0][0, 0, row - 1]).max() > 1e-3


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_units_do_not_matter(factor):
    """Captures and τ times a number, in single precision: the image times that number."""
    problem, _ = scenes.problem()
    expected = solved(scenes.single(problem), iterations=50)
    value = solved(scenes.single(scenes.rescaled(problem, factor)), iterations=50)
    assert value.dtype == jnp.float32
    assert relative_l2(value, factor * expected) < 1e-4


def test_single_precision_agrees_with_double():
    problem, truth = scenes.problem(planes=2)
    expected = solved(problem, iterations=100)
    value = solved(scenes.single(problem), iterations=100)
    assert relative_l2(value, expected) < 1e-4 and relative_l2(expected, truth) < 0.9


def test_a_batch_is_its_members_and_new_values_compile_once():
    """The same by a leading axis and by vmap over the captures."""
    problem, _ = scenes.problem(batch=(2,), channels=1)
    together = solved(problem, iterations=30)

    def alone(captures):
        return solved(eqx.tree_at(lambda p: p.captures, problem, captures), iterations=30)

    # The unit of the captures is that of the batch: a state is the same in another unit.
    mapped = jax.vmap(alone)(problem.captures)
    np.testing.assert_allclose(mapped, together, rtol=1e-9, atol=1e-11)

    counted = count_traces(step)
    compiled = jax.jit(counted)
    for tau, relaxation in ((1e-3, 1.0), (2e-3, 1.6)):
        other = scenes.rescaled(problem, 1 + tau)
        other = eqx.tree_at(lambda p: p.tau, other, jnp.asarray(tau))
        splitting = Splitting(other)
        begin = start(splitting, jnp.zeros(other.image_shape))
        compiled(splitting, default_penalties(splitting), jnp.asarray(relaxation), begin)
    assert counted.traces == 1


def test_extremes_are_finite():
    """No light, no trusted pixel, no operator, no variation: a finite image, zero if it must be."""
    problem, _ = scenes.problem()
    zero = [jnp.zeros_like(c) for c in problem.captures]
    none = [jnp.zeros_like(w) for w in problem.weights]
    dark = eqx.tree_at(lambda p: p.captures, problem, tuple(zero))
    blind = eqx.tree_at(lambda p: p.weights, problem, tuple(none))
    closed = eqx.tree_at(
        lambda p: [o.spectrum for o in p.operators],
        problem,
        [jnp.zeros_like(o.spectrum) for o in problem.operators],
    )
    for given in (dark, blind, closed):
        np.testing.assert_array_equal(solved(given, iterations=20), 0)
    free, flat = (
        solved(eqx.tree_at(lambda p: p.tau, problem, jnp.asarray(tau)), iterations=200)
        for tau in (0.0, 1e6)
    )
    assert bool(jnp.isfinite(free).all()) and 0 < float(jnp.ptp(flat)) < 0.2 * float(jnp.ptp(free))
