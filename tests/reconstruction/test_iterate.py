"""How a run ends, what it keeps and what it reports: with a method made for the purpose."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from thincam_jax.reconstruction.iterate import (
    AbstractMethod,
    Progress,
    Residuals,
    Schedule,
    iterate,
)
from thincam_jax.reconstruction.result import Reconstruction


class Walk(AbstractMethod[Float[Array, ""]]):
    """A method whose image after n iterations is `path[n]`, and whose objective is the image.

    Its state is n; `residual(n)` = 10⁻ⁿ.
    """

    path: Float[Array, " n"]
    adapted: int = 0

    def start(self, image):
        return jnp.asarray(0.0)

    def advance(self, state, count):
        return state + count

    def image(self, state):
        return self.path[int(state)].reshape(1, 1, 1, 1)

    def objective(self, image):
        return image[..., 0, 0, 0, 0]

    def residuals(self, state):
        return Residuals(10.0 ** -float(state), 10.0 ** (1 - float(state)))

    def adapt(self, state, residuals):
        assert residuals.primal == pytest.approx(10.0 ** -float(state))
        return Walk(self.path, self.adapted + 1), state


def run(path, *, iterations, tolerance=0.0, check_every=3, adapt_until=0, callback=None):
    first = jnp.full((1, 1, 1, 1), 100.0)
    return iterate(
        Walk(jnp.asarray(path, dtype=float)),
        first,
        Schedule(iterations, tolerance, check_every, adapt_until),
        callback=callback,
    )


def test_it_runs_to_the_last_iteration_and_keeps_the_best():
    """Looks at 3, 6, 9 and at the last one; the lowest is at 6, the lower one at 7 goes unseen."""
    path = [0, 9, 9, 50, 9, 9, 20, 1, 9, 40, 30]
    seen = []
    outcome = run(path, iterations=10, callback=seen.append)
    assert outcome.status == "iterations_exhausted" and outcome.iterations == 10
    assert [p.iteration for p in outcome.history] == [0, 3, 6, 9, 10]
    assert [p.objective for p in outcome.history] == [100, 50, 20, 40, 30]
    assert float(outcome.image.squeeze()) == 20 and outcome.seconds > 0
    assert seen == list(outcome.history[1:]) and isinstance(seen[0], Progress)
    first = outcome.history[0]
    assert math.isnan(first.primal) and math.isnan(first.dual)
    third = outcome.history[2]
    assert (third.primal, third.dual) == pytest.approx((1e-6, 1e-5))


def test_it_counts_on_from_a_run_before():
    """Of nine iterations four are done already."""
    outcome = iterate(
        Walk(jnp.arange(30.0)),
        jnp.full((1, 1, 1, 1), 100.0),
        Schedule(9, 0.0, check_every=3, done=4),
    )
    assert [p.iteration for p in outcome.history] == [4, 7, 9]
    assert [p.objective for p in outcome.history] == [100, 3, 5] and outcome.iterations == 9


@pytest.mark.parametrize("iterations", [1, 2, 3, 11, 25])
def test_the_count_is_exact(iterations):
    """Whatever it is divided into."""
    for every in (1, 4, 10, 13):
        outcome = run(np.arange(30.0), iterations=iterations, check_every=every)
        assert outcome.history[-1].iteration == outcome.iterations == iterations
        assert outcome.history[-1].objective == iterations


def test_it_stops_when_both_residuals_are_small():
    """The dual one, 10⁻⁵ at iteration 6, is the larger."""
    for tolerance, expected in ((1.01e-5, 6), (0.99e-5, 9)):
        outcome = run(np.zeros(20), iterations=15, tolerance=tolerance)
        assert (outcome.status, outcome.iterations) == ("converged", expected)


def test_an_interruption_keeps_the_best_image():
    """Ctrl-C in a callback, and in the midst of iterations."""

    def at_nine(progress):
        if progress.iteration == 9:
            raise KeyboardInterrupt

    path = [0, 9, 9, 30, 9, 9, 10, 9, 9, 60, 5, 5, 5]
    outcome = run(path, iterations=12, callback=at_nine)
    assert outcome.status == "interrupted" and float(outcome.image.squeeze()) == 10
    assert [p.iteration for p in outcome.history] == [0, 3, 6, 9]

    class Interrupted(Walk):
        def advance(self, state, count):
            if float(state) >= 6:
                raise KeyboardInterrupt
            return state + count

    method = Interrupted(jnp.asarray(path, dtype=float))
    first = jnp.full((1, 1, 1, 1), 100.0)
    outcome = iterate(method, first, Schedule(12, 0.0, check_every=3))
    assert (outcome.status, outcome.iterations) == ("interrupted", 6)
    assert float(outcome.image.squeeze()) == 10


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_a_number_ends_it(value):
    """The image is the last one that was."""
    path = [0, 9, 9, 30, 9, 9, value, 9, 9, 9]
    outcome = run(path, iterations=9)
    assert (outcome.status, outcome.iterations) == ("non_finite", 6)
    assert float(outcome.image.squeeze()) == 30
    assert all(math.isfinite(p.objective) for p in outcome.history)


def test_it_adapts_until_it_is_told_not_to():
    """At 3, 6 and 9, not at 12: the method that goes on is the one that was adapted."""

    class Counted(Walk):
        def adapt(self, state, residuals):
            adapted.append(int(state))
            return Counted(self.path - 1, self.adapted + 1), state

    adapted = []
    method = Counted(jnp.full(20, 50.0))
    first = jnp.full((1, 1, 1, 1), 100.0)
    outcome = iterate(method, first, Schedule(15, 0.0, check_every=3, adapt_until=9))
    assert adapted == [3, 6, 9]
    assert [p.objective for p in outcome.history] == [100, 50, 49, 48, 47, 47]


def test_it_does_not_adapt_where_the_objective_has_risen():
    class Counted(Walk):
        def adapt(self, state, residuals):
            adapted.append(int(state))
            return self, state

    adapted = []
    path = jnp.asarray([0.0, 50, 60, 40, 45, 30, 30])
    first = jnp.full((1, 1, 1, 1), 100.0)
    iterate(Counted(path), first, Schedule(6, 0.0, check_every=1, adapt_until=6))
    assert adapted == [1, 3, 5, 6]


@pytest.mark.parametrize(
    ("path", "iterations"),
    [([0, 150, 105, 95, 90], 4), ([0, 150, 130, 120], 2), ([0, 90, 99, 80], 2)],
)
def test_it_ends_where_the_objective_stays_above(path, iterations):
    """From 100: one that falls by more than it is above goes on, one that has risen does not."""
    method, first = Walk(jnp.asarray(path, dtype=float)), jnp.full((1, 1, 1, 1), 100.0)
    schedule = Schedule(len(path) - 1, 0.0, check_every=1, rising=0.01)
    outcome = iterate(method, first, schedule)
    assert outcome.iterations == iterations and outcome.status == "iterations_exhausted"


def test_an_image_that_is_still_has_converged_though_its_objective_rose():
    method, first = Walk(jnp.asarray([0.0, 90, 90.2, 80])), jnp.full((1, 1, 1, 1), 100.0)
    schedule = Schedule(3, 0.0, check_every=1, rising=0.001, still=0.01)
    outcome = iterate(method, first, schedule)
    assert outcome.iterations == 2 and outcome.status == "converged"


def test_a_batch_is_judged_by_its_sum():
    class Batch(Walk):
        def image(self, state):
            return jnp.stack([self.path[int(state)], 2 * self.path[int(state)]]).reshape(
                2, 1, 1, 1, 1
            )

    method = Batch(jnp.asarray([0.0, 4.0, 3.0, 5.0]))
    outcome = iterate(method, jnp.full((2, 1, 1, 1, 1), 9.0), Schedule(3, 0.0, check_every=1))
    assert [p.objective for p in outcome.history] == [18, 12, 9, 15]
    np.testing.assert_array_equal(outcome.image.ravel(), [3, 6])


def test_iterations_exhausted_read_as_what_is_left_to_gain():
    steps = tuple(Progress(n, v, math.nan, math.nan) for n, v in ((0, 9.0), (10, 5.0), (20, 4.9)))
    known = {"ended": "iterations_exhausted", "iterations": 20}
    image = jnp.ones((3, 4))
    seen = Reconstruction(image, None, history=steps, **known)
    told = "stopped after 20 iterations; the objective still fell by 0.2 % an iteration"
    assert (seen.status, seen.ending) == ("iterations_exhausted", told)
    assert Reconstruction(image, None, **known).ending == "stopped after 20 iterations"
    assert Reconstruction(image, None).ending == "ok"
    assert Reconstruction(jnp.nan * image, None, **known).ending == "non finite after 20 iterations"
