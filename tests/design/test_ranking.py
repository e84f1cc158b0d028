"""Ranking of designs: by the exact objective, each order of shots once."""

import jax
import numpy as np
import pytest
from design import small
from design.test_sensitivity import Bowl, found_at

from thincam_jax.design.objectives import bayes_error, ring_means
from thincam_jax.design.ranking import distinct_designs, rank_designs, score_design
from thincam_jax.design.search import NonFiniteObjectiveError


def test_ranked_by_the_exact_value_and_orders_of_shots_are_one():
    problem = small.problem(Bowl())
    betas = [(20.0, 15.0), (15.1, 19.9), (18.0, 15.0), (24.0, 15.0)]
    ranked = rank_designs(problem, tuple(found_at(problem, *b) for b in betas))
    # Exactly: 4 + 4.8, 8 + 1.2, 20 + 19.2; 15.1, 19.9 is the first with its shots exchanged.
    assert [[s.beta for s in one.shots] for one in ranked] == [
        *(pytest.approx(b) for b in ((20, 15), (18, 15), (24, 15)))
    ]
    assert [one.exact for one in ranked] == pytest.approx([8.8, 9.2, 39.2])
    assert [one.searched for one in ranked] == pytest.approx([4, 8, 20])
    assert [one.name for one in ranked] == ["found 1", "found 2", "found 3"]
    assert ranked[0].active == ("a",)
    np.testing.assert_allclose(ranked[0].design.beta, [20, 20, 15, 15])
    assert ranked[0].values[1].tolerance == pytest.approx(np.sqrt(0.044))
    given = found_at(problem, 18.0, 15.0), found_at(problem, 20.0, 15.0)
    assert rank_designs(problem, given)[0].shots[0].beta == pytest.approx(20)


@jax.jit
def compiled_channels(data):
    return data.channels(small.pairs())


@pytest.mark.thorough
def test_score_of_a_design():
    problem = small.problem()
    scored = score_design(problem, problem.space.base, "pairs")
    assert scored.name == "pairs" and scored.level.shape == (64,)
    known, other = map(compiled_channels, (problem.exact, problem.data))
    np.testing.assert_allclose(scored.level, ring_means(known, problem.exact.frequencies, 64))
    assert scored.exact == pytest.approx(float(bayes_error(known)))
    assert scored.searched == pytest.approx(float(bayes_error(other)))


def test_nothing_found_is_refused():
    with pytest.raises(NonFiniteObjectiveError, match="NaN at any start; give bounds nearer"):
        distinct_designs(small.problem().space, ())
