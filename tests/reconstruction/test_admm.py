"""ADMM against a primal-dual solver on dense matrices, and how its method gets to the minimum."""

import itertools
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import dense, scenes

from helpers import count_traces, quick, relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape, window_shape
from thincam_jax.reconstruction.admm import AdmmMethod, Penalties, admm_map, consensus
from thincam_jax.reconstruction.problem import InverseProblem, objective
from thincam_jax.reconstruction.splittings import admm_method, splitting_of
from thincam_jax.reconstruction.total_variation import TotalVariation

FIELD = (6, 11)
SENSORS = ((7, 9), (10, 6))


class Case(NamedTuple):
    """A problem twice: for the package, and as matrices."""

    problem: InverseProblem
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
            CropConvolution(jax.device_put(kernels), 0.7, sensor, FIELD, summed=1, window=window)
        )
        matrices = np.stack(
            [np.hstack([dense.matrix(k, sensor, FIELD, 0.7) for k in row]) for row in kernels]
        )
        clean = np.einsum("cps,cs->cp", matrices, truth)
        capture = clean + 0.05 * clean.max() * rng.normal(size=clean.shape)
        weight = rng.uniform(0.5, 3.0, size=clean.shape)
        dead = rng.uniform(size=clean.shape) < 0.1
        weight[dead], capture[dead] = 0.0, 1e3
        captures.append(capture.reshape(channels, *sensor))
        weights.append(weight.reshape(channels, *sensor))
        parts.append((matrices, capture, weight))
    variation = TotalVariation(
        setting.kind, "joint" if setting.joint else "none", depth_weight=setting.depth_weight
    )
    problem = scenes.inverse(
        operators,
        captures,
        tau=setting.tau,
        weights=weights,
        regulariser=variation,
        nonnegative=setting.nonnegative,
    )
    psi = dense.slopes((planes, *FIELD), setting.depth_weight)
    return Case(problem, parts, setting.tau, psi, setting.kind, setting.joint)


def relaxed(splitting, relaxation, state):
    """One iteration: q + α (T(q) − q)."""
    mapped = admm_map(state, splitting)
    return jax.tree.map(lambda q, t: q + relaxation * (t - q), state, mapped)


@jax.jit
def stepped(splitting, relaxation, image, count):
    """The image after so many iterations from another."""
    start = splitting.start(image)
    state = jax.lax.fori_loop(0, count, lambda _, s: relaxed(splitting, relaxation, s), start)
    return splitting.image(state)


def weighed(problem, factors):
    """The splitting of a problem with its penalties multiplied."""
    splitting = splitting_of(problem)
    wanted = Penalties(*(jnp.asarray(f, problem.tau.dtype) for f in factors))
    return splitting.with_penalties(jax.tree.map(jnp.multiply, splitting.penalties, wanted))


def solved(problem, *, relaxation=1.8, factors=(0.1, 0.1, 0.1), iterations=1500, image=None):
    splitting = weighed(problem, factors)
    image = jnp.zeros(problem.image_shape, problem.tau.dtype) if image is None else image
    relaxation = jnp.asarray(relaxation, problem.tau.dtype)
    return stepped(splitting, relaxation, image, iterations)


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


@pytest.mark.parametrize("name", quick(CASES, list(CASES).index("planes_anisotropic")))
def test_the_minimiser_is_that_of_another_method(name):
    """Crop, dead pixels (of value 1000), weights, sensors of two shapes, planes, colours."""
    given = case(name)
    # A tenth of the penalties for one plane, whatever they are for several.
    factors = (1.0, 10.0, 10.0) if given.problem.image_shape[-3] > 1 else (0.1, 0.1, 0.1)
    value, expected = solved(given.problem, factors=factors), reference(given)
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


@pytest.mark.parametrize(
    ("relaxation", "factors"),
    quick(itertools.product([0.7, 1.0, 1.8], [(0.1, 0.1, 0.1), (0.3, 0.2, 0.05)]), 5),
)
def test_relaxation_and_penalties_do_not_move_the_minimiser(relaxation, factors):
    given = case("two")
    expected = solved(given.problem)
    begin = jnp.full(given.problem.image_shape, 0.8)
    value = solved(
        given.problem, relaxation=relaxation, factors=factors, iterations=4000, image=begin
    )
    assert relative_l2(value, expected) < 1e-6


def test_a_batch_is_its_elements_and_new_values_compile_once():
    """The same by a leading axis and by vmap over the captures."""
    problem, _ = scenes.problem(batch=(2,), channels=1)
    together = solved(problem, iterations=30)

    def alone(captures):
        return solved(eqx.tree_at(lambda p: p.captures, problem, captures), iterations=30)

    # The unit of the captures is that of the batch: a state is the same in another unit.
    mapped = jax.vmap(alone)(problem.captures)
    np.testing.assert_allclose(mapped, together, rtol=1e-9, atol=1e-11)

    counted = count_traces(relaxed)
    compiled = jax.jit(counted)
    for tau, relaxation in ((1e-3, 1.0), (2e-3, 1.6)):
        other = scenes.absolute(scenes.rescaled(problem, 1 + tau), tau)
        splitting = splitting_of(other)
        begin = splitting.start(jnp.zeros(other.image_shape))
        compiled(splitting, jnp.asarray(relaxation), begin)
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
    free, flat = (solved(scenes.absolute(problem, tau), iterations=200) for tau in (0.0, 1e6))
    assert bool(jnp.isfinite(free).all()) and 0 < float(jnp.ptp(flat)) < 0.2 * float(jnp.ptp(free))


def test_residuals_are_what_their_names_say():
    """Primal: Kf − z against the larger of the two; dual: how far z moved, against the forces."""
    problem, _ = scenes.problem()
    method = admm_method(problem, relaxation=1.3)
    splitting = method.arguments
    state = method.advance(method.start(jnp.full(problem.image_shape, 0.3)), 7)
    before = jax.tree.map(np.array, state.value)
    state = method.advance(state, 1)
    after, found = jax.device_get(state.value), method.residuals(state)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-13),
        after,
        jax.jit(relaxed)(splitting, 1.3, before),
    )
    settled = jax.jit(consensus)
    old, new = (jax.device_get(settled(splitting, s)) for s in (before, after))
    image = jax.tree.map(lambda z, a, b: z + (a - b) / 1.3, old, after, before)

    def size(tree):
        """Lengths in the metric of the penalties."""
        total = 0.0
        for name, leaf in (("data", "data"), ("slopes", "variation"), ("image", "image")):
            weight = float(getattr(splitting.penalties, leaf))
            for part in jax.tree.leaves(getattr(tree, name)):
                total += weight * float((np.asarray(part) ** 2).sum())
        return total**0.5

    gap = jax.tree.map(np.subtract, image, old)
    forces = jax.tree.map(np.subtract, after, new)
    assert found.dual == pytest.approx(
        size(jax.tree.map(np.subtract, new, old)) / size(forces), rel=1e-10
    )
    # each split takes the larger of Kf and z
    assert found.primal <= size(gap) / max(size(image), size(old)) * (1 + 1e-10)
    assert found.primal >= size(gap) / (size(image) ** 2 + size(old) ** 2) ** 0.5
    assert len(found.parts) == 3 and all(p > 0 and d > 0 for p, d in found.parts)
    # what ends a fixed point: the move of the plain map, relative to the state
    assert float(state.inside.change) == pytest.approx(size(gap) / size(before), rel=1e-10)


def test_balanced_penalties_keep_the_image():
    problem, _ = scenes.problem()
    method = admm_method(problem)
    state = method.advance(method.start(jnp.full(problem.image_shape, 0.3)), 1)
    residuals = method.residuals(state)
    uneven = replace(residuals, parts=((4.0, 1.0), (1.0, 100.0), (1.0, 1.0)))
    before = method.image(state)
    other, changed = method.adapt(state, uneven)
    assert isinstance(other, AdmmMethod)
    np.testing.assert_allclose(other.image(changed), before, atol=1e-12)
    expected = Penalties(*(jnp.asarray(f) for f in (2.0, 1 / 3, 1.0)))
    for old, new, factor in zip(
        *(
            jax.tree.leaves(p)
            for p in (method.arguments.penalties, other.arguments.penalties, expected)
        ),
        strict=True,
    ):
        assert float(new / old) == pytest.approx(float(factor), rel=1e-12)
    # nothing is rebuilt for a balance that is good enough
    even = replace(residuals, parts=((1.1, 1.0), (1.0, 1.1), (0.0, 1.0)))
    assert method.adapt(state, even)[0] is method
