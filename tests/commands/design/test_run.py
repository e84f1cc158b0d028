"""Designs from file to folder: the search, what is written, and going on after Ctrl-C."""

import json
from dataclasses import astuple, replace

import numpy as np
import pytest
from commands.design import tiny
from commands.study.tiny import Told
from commands.test_cli import called

from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design import run as running
from thincam_jax.commands.design.build import as_study_config
from thincam_jax.commands.design.run import DesignFolder, run_design
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.run_folder import as_record
from thincam_jax.commands.study.build import build_study
from thincam_jax.design.search import Search
from thincam_jax.studies import design as designs
from thincam_jax.studies.design_scores import DesignScores
from thincam_jax.studies.evaluate import evaluate_method, take
from thincam_jax.studies.trials import Spread

QUICK = ("search.starts=2", "search.samples=8", "search.steps=3")


def stored(path):
    """The record that a folder holds."""
    return as_record(DesignScores, json.loads((path / "design.json").read_text("utf-8")))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One uninterrupted run of the command: its folder, its record, and what it printed."""
    home = tmp_path_factory.mktemp("design")
    settings = [word for setting in QUICK for word in ("--set", setting)]
    result = called("design", tiny.write(home), "--out", home / "out", *settings)
    return home / "out", stored(home / "out"), result.stdout


def test_found_designs_are_better_and_within_bounds(whole):
    design = whole[1]
    reference, found = design.reference, design.found
    exact = [one.objective_exact for one in found]
    assert exact == sorted(exact)
    assert exact[0] < reference.objective_exact
    for one in found:
        gain = 10 * np.log10(reference.objective_exact / one.objective_exact)
        assert one.predicted_gain == pytest.approx(gain, rel=1e-4, abs=1e-6)
        assert all(12 <= shot.beta_rad_per_mm2 <= 30 for shot in one.shots)
        assert all(shot.distance_mm == 3 for shot in one.shots)


def test_found_study_gives_the_first_seed(whole):
    """`thincam run found.yaml` simulates the same captures."""
    path, design, _ = whole
    study = build_study(load_experiment(path / "found.yaml"))
    names = [method.name for method in study.methods]
    assert names == ["pairs", *(one.name for one in design.found[: len(names) - 1])]
    picture = study.targets[1]
    captures = {exposure: take(study, exposure, picture) for exposure in study.exposures}
    for name, method in zip(names, study.methods, strict=True):
        trials = design.validation.methods[name]["picture"].psnr_db.values
        assert len(trials) == 2
        found = evaluate_method(study, method, picture, captures)
        assert trials[0] == found.scores.psnr_db
        assert trials[0] != trials[1]  # other noise


@pytest.mark.thorough
def test_interrupted_design_goes_on(whole, tmp_path, monkeypatch):
    """The finished target is not simulated again, and the figures are those of a whole run."""
    study, design = tiny.built(tmp_path, *QUICK), whole[1]
    folder = DesignFolder(tmp_path / "again")
    simulate, simulated = running.simulate_trials, []

    def one_only(study, target, *more):
        if simulated:
            raise KeyboardInterrupt
        simulated.append(target.name)
        return simulate(study, target, *more)

    def interrupted():
        simulated.clear()
        with pytest.raises(KeyboardInterrupt):
            run_design(study, folder, tiny.ignore)
        assert not (folder.path / "design.json").exists()
        return list(simulated)

    monkeypatch.setattr(running, "simulate_trials", one_only)
    assert interrupted() == ["chart"]
    # Other designs are not taken for those that were simulated.
    path = folder.path / "targets" / "chart.json"
    held = json.loads(path.read_text("utf-8"))
    held["designs"][1][0][0] += 1.0
    path.write_text(json.dumps(held), encoding="utf-8")
    assert interrupted() == ["chart"]
    simulated.clear()
    again = run_design(study, folder, tiny.ignore)
    assert simulated == ["picture"]
    assert again.validation == design.validation
    # A complete design is done anew.
    assert interrupted() == ["chart"]
    with pytest.raises(ConfigError, match="holds a design of another configuration"):
        folder.claim(study.study.config.model_copy(update={"seed": 4}))


@pytest.mark.thorough
def test_fronts_are_written_and_reported(whole, tmp_path):
    """They come after the targets, and count as progress; captures are simulated in full."""
    bounds, told = "{bounds: [12 rad/mm^2, 30 rad/mm^2], variable: beta}", Told()
    study = tiny.built(
        tmp_path,
        *QUICK,
        f"search.free=[{bounds}, {{variable: distance, bounds: [2 mm, 3 mm], shared: true}}]",
        "noise={read_noise: 4, electrons: 900}",
        *("pareto.samples=8", "pareto.starts=1", "pareto.steps=3", "pareto.captures.shots=[1, 2]"),
        "pareto.thickness={bounds: [2 mm, 3 mm], points: 2}",
    )
    folder = DesignFolder(tmp_path / "fronts")
    design = run_design(study, folder, told)
    costs = ["thickness 2 mm", "thickness 3 mm", "thickness 2 mm", "thickness 3 mm"]
    captures = ["2 captures", "4 captures"]
    simulated = [f"{text}, simulated" for text in captures]
    assert list(told)[7:] == [*costs, *captures, *simulated, "report"]
    path = folder.path
    assert stored(path) == design
    thin, thick = design.pareto.thickness.points
    assert (thin.cost, thick.cost) == (2.0, 3.0)
    assert thin.resolution_cycles_per_rad <= thick.resolution_cycles_per_rad
    few, many = design.pareto.captures.points
    assert (few.cost, many.cost) == (2, 4)
    # Half the captures have twice the electrons each.
    assert (few.shots[0].exposure, many.shots[0].exposure) == (2.0, 1.0)
    assert 5 < few.simulated_psnr_db["picture"] < 60
    assert (path / "pareto.png").exists()
    page = (path / "report.html").read_text("utf-8")
    assert "Thickness against resolution" in page
    assert f"{thick.resolution_line_pairs_per_mm:.3f}" in page
    assert whole[1].pareto is None
    assert design.limits_db.keys() == {"shadow", "amplitude"}
    assert all(design.found[0].reported > least for least in design.limits_db.values())
    assert "above the limit that no masks that cast shadows pass (pairs" in page


def test_an_objective_that_is_nan_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(designs, "find_designs", lambda *_, **__: Search((), 3, 3))
    with pytest.raises(ConfigError, match="^search: the objective is NaN at any start; give"):
        run_design(tiny.built(tmp_path), DesignFolder(tmp_path / "out"), tiny.ignore)


def read_again(config, study, folder):
    """As `thincam run` reads found.yaml."""
    path = folder / "found.yaml"
    path.write_text(dump_config(as_study_config(config, study.methods)), encoding="utf-8")
    return build_study(load_experiment(path))


def taken(study):
    """What the methods are, but for their solvers."""
    return [(m.name, m.solver.name, m.synthesis, tuple(m.exposures)) for m in study.methods]


def test_shots_that_coincide_are_two_exposures(tmp_path):
    """In the simulation, and in the file of what was found."""
    same = {"found 1": tiny.found([20.0, 17.0, 20.0])}
    design = tiny.built(tmp_path)
    study = design.with_designs(same)
    method = study.methods[1]
    assert len(set(method.exposures)) == 6
    assert [(shot.beta, shot.take) for shot in method.shots] == [(20, 1), (17, 1), (20, 2)]
    assert taken(read_again(design.study.config, study, tmp_path)) == taken(study)
    electrons = "noise={read_noise: 0, electrons: 2e5}"
    longer = {"found 1": tiny.found([20.0, 20.0], relative_time=[0.7, 1.3])}
    method = tiny.built(tmp_path, electrons).with_designs(longer).methods[1]
    assert [(s.beta, s.relative_time, s.take) for s in method.shots] == [(20, 0.7, 1), (20, 1.3, 1)]


def test_only_the_simulation_has_the_pixels_of_a_display(tmp_path):
    settings = ("model=separable", "mask.pixel_pitch=50 um", "mask.fill_factor=0.9")
    design = tiny.built(tmp_path, *settings)
    study = design.study
    camera = study.camera(study.exposures[0])
    assert (camera.mask.pixels, float(camera.mask.fill_factor)) == ((40, 40), pytest.approx(0.9))
    reference = design.problem.space.base
    assert reference.cameras(camera.sensor)[0].mask.pixels is None
    with pytest.raises(ConfigError, match="mask"):
        tiny.built(tmp_path, "mask.pixel_pitch=70 um")


def test_found_numbers_reach_the_simulation(tmp_path):
    """Width (in whole pixels of a display), wavelength and exposure; what all share is left out."""
    given = ("noise={read_noise: 0, electrons: 2e5}", "mask.pixel_pitch=50 um")
    found = tiny.found([20.0], 2.5, width=1.49, wavelength=6e-4, relative_time=0.7)
    design = tiny.built(tmp_path, *given)
    study = design.with_designs({"found 1": found})
    exposure = study.methods[1].exposures[0]
    assert astuple(exposure)[:7] == pytest.approx((20.0, 0.0, 2.5, 6e-4, 1.45, 0.7, 1))
    assert exposure.profile is None
    camera = study.camera(exposure)
    assert (camera.mask.pixels, float(camera.mask.width)) == ((29, 29), pytest.approx(1.45))
    assert float(camera.sensor.electrons) == pytest.approx(0.7 * 2e5)
    assert taken(read_again(design.study.config, study, tmp_path)) == taken(study)
    shot = as_study_config(design.study.config, study.methods).methods[0].shots[0]
    assert shot.model_dump(exclude_defaults=True).keys() == {"beta", "distance"}


def test_sentences_of_the_report(whole):
    design = whole[1]
    told = " ".join(design.findings())
    assert "Simulated, found 1 gains" in told
    assert "not on one grid" not in told
    assert f"The best of {design.random_designs} random designs, which cost as much as" in told
    gain = design.held_out.gains["found 1"]
    assert f"On 3 further photographs found 1 gains {gain}, the random one " in told
    small = replace(gain, mean=0.04, low=0.03)
    gains = design.held_out.gains | {"found 1": small}
    alike = replace(design, held_out=replace(design.held_out, gains=gains))
    verdict = "within the tolerance of pairs: no new mask is worth making"
    assert verdict in " ".join(alike.findings())
    gains = gains | {"found 1": replace(gain, mean=0.5, low=0.1)}
    better = replace(design, held_out=replace(design.held_out, gains=gains))
    assert verdict not in " ".join(better.findings())
    methods = dict(design.validation.methods)
    gains = {"gain_elements": Spread(0.0, None, []), "gain_db": Spread(-1.06, None, [])}
    methods["found 1"] = {"chart": replace(methods["found 1"]["chart"], **gains)}
    changed = replace(
        design,
        validation=replace(design.validation, one_object_grid=False, methods=methods),
        search=replace(design.search, broken_limits=("β of shot 1 is too much",)),
        found=(replace(design.found[0], active_limits=("beta ≤ 9",)),),
        limits_db={"shadow": design.found[0].reported - 2.0, "amplitude": -90.0},
    )
    assert design.limits_db == {}  # noise at an SNR
    told = " ".join(changed.findings())
    for part in (
        "found 1 is 2.0 dB above the limit that no masks that cast shadows pass (pairs ",
        "at -1.06 dB (28 % more squared error)",
        *("not on one grid", "The reference breaks a limit: β of", "against a limit: beta"),
    ):
        assert part in told
