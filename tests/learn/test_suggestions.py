"""Suggested designs: near to the target where a design gives it, honest where none does."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design.setting import setup, thesis_design, two_betas

from helpers import finite_difference
from thincam_jax.design import DesignSpace, Polar, PowerLaw, ResponseModel, Variable
from thincam_jax.learn import Suggester, suggest
from thincam_jax.learn.suggester_training import SuggesterTraining, _levels, train_suggester
from thincam_jax.learn.suggestions import propose
from thincam_jax.reconstruction import phase_pairs

RINGS = 16
SPACE = two_betas()
DATA = (setup(prior=PowerLaw(2.8)), jnp.asarray(phase_pairs(2)), Polar(96.0, 128, 2))
MODEL = ResponseModel(SPACE, *DATA, RINGS)
SMALL = {"samples": 256, "guesses": 3, "width": 48, "depth": 2, "batch": 32}
WARM_UP, STEPS = 400, 40
HELD_OUT = 40


@pytest.fixture(scope="module")
def trained():
    settings = SuggesterTraining(**SMALL, warm_up=WARM_UP, steps=STEPS)
    return train_suggester(MODEL, settings, key=jax.random.key(3))


@pytest.fixture(scope="module")
def suggester(trained):
    return trained.suggester


@pytest.fixture(scope="module")
def targets(suggester):
    """Responses of designs that no example was: (their levels, those of random other designs)."""
    # As many at a time as in the training: the program is compiled already.
    points = jax.random.uniform(jax.random.key(77), (SMALL["samples"], SPACE.size))
    levels = _levels(suggester.model, points)
    return levels[:HELD_OUT], levels[HELD_OUT : 2 * HELD_OUT]


@pytest.fixture(scope="module")
def proposals(suggester, targets):
    """One after the other: together they would be another program."""
    each = [propose(suggester, target) for target in targets[0]]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


@pytest.mark.thorough
def test_training_learns(trained):
    """Both parts gain, and nothing was skipped; the guesses are not all one."""
    warm_up, history = np.asarray(trained.warm_up), np.asarray(trained.history)
    assert trained.skipped == 0
    assert warm_up.shape == (WARM_UP,) and history.shape == (STEPS,)
    assert np.mean(warm_up[-50:]) < 0.4 * np.mean(warm_up[:20])
    assert np.mean(history[-20:]) < np.mean(history[:5])
    guesses = trained.suggester(trained.suggester.mean)
    assert guesses.shape == (3, 2)
    assert float(jnp.max(jnp.ptp(guesses, axis=0))) > 0.05


@pytest.mark.thorough
def test_nearer_than_random_designs(targets, proposals):
    """Medians over held-out designs: a random design, the network alone, two steps more."""
    random = np.median(np.sqrt(np.mean((targets[1] - targets[0]) ** 2, axis=-1)))
    network, refined = (np.median(m) for m in (proposals.first_misfit_db, proposals.misfit_db))
    assert network < 0.5 * random
    assert refined < 0.5 * network


@pytest.mark.thorough
def test_newton_steps_never_make_worse(suggester, targets, proposals):
    """And what is told is the misfit of the design that is given."""
    assert np.all(proposals.misfit_db <= proposals.first_misfit_db)
    levels = jax.jit(lambda point: suggester.model.levels(point))
    for k in (0, 31):
        told = proposals.levels[k] - targets[0][k]
        np.testing.assert_allclose(np.sqrt(np.mean(told**2)), proposals.misfit_db[k], rtol=1e-9)
        np.testing.assert_allclose(levels(proposals.point[k]), proposals.levels[k], atol=1e-9)


@pytest.mark.thorough
def test_suggestion(suggester, targets, proposals):
    """As `propose` over all targets says, and not compiled again for another."""
    suggest(suggester, targets[0][0])
    before = propose._cache_size()
    for k in (1, 2):
        found = suggest(suggester, np.asarray(targets[0][k]))
        np.testing.assert_allclose(found.point, proposals.point[k], atol=1e-9)
        np.testing.assert_allclose(found.design.beta, np.repeat(found.values, 2))
        assert found.status == ("matched" if found.misfit_db <= 1.0 else "not_attained")
        assert found.misfit_db <= found.network_misfit_db
    assert propose._cache_size() == before


@pytest.mark.thorough
def test_many_at_a_time_and_slopes(suggester, targets, proposals):
    """Under vmap as one by one; the misfit's slope in the target levels by differences."""
    together = jax.jit(jax.vmap(propose, in_axes=(None, 0)))(suggester, targets[0])
    same = partial(np.testing.assert_allclose, atol=1e-6)
    jax.tree.map(same, together, proposals)
    target, direction = targets[0][0] + 1.0, jnp.ones(RINGS)
    told = jax.jit(lambda w: propose(suggester, w).first_misfit_db)
    expected = finite_difference(told, target, direction, 1e-6)
    np.testing.assert_allclose(jax.grad(told)(target) @ direction, expected, rtol=1e-4)


@pytest.mark.thorough
def test_unattainable_targets_are_told(suggester, targets):
    """30 dB everywhere, a response turned round, and 8 dB more than there is."""
    response = targets[0][0]
    for target in (jnp.full(RINGS, 30.0), response[::-1], response + 8.0):
        found = suggest(suggester, target)
        assert found.status == "not_attained"
        assert found.misfit_db > 2.0
        assert suggest(suggester, target, tolerance_db=60.0).status == "matched"
    # Against the faces: the limits are told.
    assert any(suggest(suggester, jnp.full(RINGS, level)).active for level in (0.0, 30.0, 60.0))


@pytest.mark.thorough
def test_no_number_is_told(suggester):
    broken = jax.tree.map(lambda leaf: leaf * jnp.nan, suggester)
    assert suggest(broken, np.full(RINGS, 3.0)).status == "non_finite"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("target", "message"),
    [
        (np.zeros(RINGS + 1), r"target has shape \(17,\); give \(16,\), a level in dB"),
        (np.full(RINGS, np.nan), "ring 1 is nan, no finite number; give levels"),
        (np.linspace(1.0, -1.0, RINGS), "ring 9 is -0.0666667, below 0 dB"),
    ],
)
def test_errors(suggester, target, message):
    with pytest.raises(ValueError, match=message) as told:
        suggest(suggester, target)
    assert "\n" not in str(told.value)


def test_training_errors():
    with pytest.raises(ValueError, match="batch = 0: give a whole number of at least 1"):
        SuggesterTraining(batch=0)
    with pytest.raises(ValueError, match="guesses = 0: give a whole number of at least 1"):
        SuggesterTraining(guesses=0)


@pytest.mark.thorough
def test_saved_and_loaded_answers_are_the_same(suggester, targets, tmp_path):
    path = suggester.save(tmp_path / "two_betas.suggester")
    loaded = Suggester.load(path, MODEL)
    target = targets[0][0]
    expected = propose(suggester, target)
    before = propose._cache_size()
    jax.tree.map(np.testing.assert_array_equal, propose(loaded, target), expected)
    assert propose._cache_size() == before


@pytest.mark.thorough
def test_files_of_something_else(suggester, tmp_path):
    path = suggester.save(tmp_path / "two_betas.suggester")
    one = DesignSpace(thesis_design(), (Variable("beta", 8.0, 36.0, (0, 1, 2, 3)),))
    dim = setup(prior=PowerLaw(2.0))
    whole = path.read_bytes()
    (tmp_path / "cut").write_bytes(whole[:-200])
    (tmp_path / "text").write_text("β = 25\n", encoding="utf-8")
    cases = (
        (path, one, DATA, "was trained for other variables: "),
        (path, two_betas(9.0), DATA, "was trained for other variables: "),
        (path, SPACE, (*DATA[:2], Polar(96.0, 64, 2)), "frequencies.* and the model here has"),
        (path, SPACE, (dim, *DATA[1:]), "setup.prior.exponent was 2.8 and is 2; train"),
        (tmp_path / "cut", SPACE, DATA, "cut: is damaged or cut off"),
        (tmp_path / "text", SPACE, DATA, "text: is no file of a network; give one"),
    )
    for file, space, data, message in cases:
        with pytest.raises(ValueError, match=message) as told:
            Suggester.load(file, ResponseModel(space, *data, RINGS))
        assert "\n" not in str(told.value)
