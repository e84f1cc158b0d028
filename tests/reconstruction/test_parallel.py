"""Parallel parts: each as it would be alone, and together as the whole would be."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import scenes

from helpers import quick, relative_l2
from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.parallel import (
    ParallelMethod,
    _in_threads,
    independent_parts,
    parallel_pays,
)
from thincam_jax.reconstruction.problem import objective
from thincam_jax.reconstruction.splittings import admm_method
from thincam_jax.reconstruction.total_variation import TotalVariation


def admm(problem):
    return admm_method(problem, relaxation=1.7)


def solve(method, problem, **settings):
    image = jnp.zeros(problem.image_shape, problem.tau.dtype)
    settings = {"iterations": 3000, "tolerance": 1e-6, "adapt_until": 1500} | settings
    return iterate(method, image, Schedule(**settings))


def masked(problem, seed=0):
    """The problem with pixels of its own weights, some of them zero, in each image and colour."""
    rng = np.random.default_rng(seed)
    weights = [rng.uniform(0.5, 2, c.shape) * (rng.uniform(size=c.shape) > 0.1)
               for c in problem.captures]  # fmt: skip
    return scenes.inverse(
        problem.operators,
        problem.captures,
        tau=problem.absolute_tau,
        weights=weights,
        regulariser=problem.regulariser,
        nonnegative=problem.nonnegative,
    )


@pytest.mark.parametrize(("coupling", "count"), quick([("none", 6), ("joint", 3)], 1))
def test_the_objective_of_the_parts_is_that_of_the_whole(coupling, count):
    """Whatever the axes along which the parts lie, with weights of every kind."""
    problem, _ = scenes.problem(
        batch=(3,), channels=2, planes=2, regulariser=TotalVariation(coupling=coupling)
    )
    image = jnp.asarray(np.random.default_rng(5).normal(size=problem.image_shape))
    for whole in (problem, masked(problem)):
        assert len(independent_parts(whole)) == count
        parallel = ParallelMethod(whole, admm)
        np.testing.assert_allclose(parallel.objective(image), objective(whole, image), rtol=1e-12)
        back = parallel.image(parallel.start(jnp.abs(image)))
        np.testing.assert_allclose(back, jnp.abs(image), atol=1e-12)


@pytest.mark.thorough
def test_the_minimum_is_that_of_the_whole_and_of_each_part_alone():
    problem, _ = scenes.problem(batch=(2,), channels=2, kernel=scenes.spots, tau=3e-3)
    problem = masked(problem)
    together = solve(ParallelMethod(problem, admm), problem)
    whole = solve(admm(problem), problem)
    assert together.status == whole.status == "converged"
    assert relative_l2(together.image, whole.image) < 1e-5
    images = whole.image.reshape(4, -1)
    for index, part in list(enumerate(independent_parts(problem)))[::3]:
        assert relative_l2(solve(admm(part), part).image.ravel(), images[index]) < 1e-5


def test_the_worst_part_counts():
    """A part with little light is done when it is, not when the bright one is."""
    problem, _ = scenes.problem(batch=(2,), captures=1)
    dim = jnp.asarray([1.0, 1e-6])[:, None, None, None]
    problem = scenes.inverse(
        problem.operators, [c * dim for c in problem.captures], tau=problem.absolute_tau * 1e-3
    )
    parallel = ParallelMethod(problem, admm)
    found = parallel.residuals(parallel.advance(parallel.start(jnp.zeros(problem.image_shape)), 6))
    assert found.primal == max(r.primal for r in found.elements)
    assert found.dual == max(r.dual for r in found.elements)
    assert len({r.primal for r in found.elements}) == 2


def test_only_independent_parts_run_in_parallel():
    coupled = TotalVariation(coupling="joint")
    assert parallel_pays(scenes.problem(batch=(2,))[0])
    assert parallel_pays(scenes.problem(channels=2)[0])
    assert not parallel_pays(scenes.problem()[0])
    assert not parallel_pays(scenes.problem(channels=2, regulariser=coupled)[0])


def test_precision_of_the_calling_thread():
    """It is a setting of the thread; in others it would fall back to that of the process."""
    with jax.enable_x64(False):
        found = _in_threads(lambda x: (jnp.asarray(x).dtype, threading.get_ident()), [1.5] * 4)
    assert {dtype for dtype, _ in found} == {np.dtype("float32")}
    assert threading.get_ident() not in {thread for _, thread in found}


def test_operators_are_not_copied():
    """Every part refers to the same spectrum, however many images there are."""
    problem, _ = scenes.problem(batch=(5,))
    parallel = ParallelMethod(problem, admm)
    for n in range(2):
        spectra = [m.arguments.operators[n].spectrum for m in parallel.methods]
        assert {s.unsafe_buffer_pointer() for s in spectra} == {
            problem.operators[n].spectrum.unsafe_buffer_pointer()
        }
