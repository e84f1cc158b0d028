"""Designs from file to folder: the search, what is written, and going on after Ctrl-C."""

import json
from dataclasses import astuple, replace

import numpy as np
import pytest
import skimage.io
from commands.design import tiny
from commands.study.tiny import Told

from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design import run as running
from thincam_jax.commands.design import simulation
from thincam_jax.commands.design.figures import as_png, draw_landscape, draw_mtf, draw_responses
from thincam_jax.commands.design.record import FoundDesigns
from thincam_jax.commands.design.report import cells, findings, in_words, reported_names
from thincam_jax.commands.design.run import DesignFolder, Finder, run_design
from thincam_jax.commands.design.simulation import as_study_config, compare, with_designs
from thincam_jax.commands.run_folder import carry_out
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.config import load_config
from thincam_jax.design import BayesError, FreeValue, Landscape, ModulationTransfer, RankedDesign
from thincam_jax.design.search import Search
from thincam_jax.design.space import REPORTED
from thincam_jax.imaging.sensor import electrons_per_unit
from thincam_jax.studies import evaluate_method, noise_free, take

QUICK = ("search.starts=2", "search.samples=8", "search.steps=3")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One uninterrupted run: the study, folder, what was found, the texts of its progress."""
    home = tmp_path_factory.mktemp("design")
    study, texts = tiny.built(home, *QUICK), Told()
    folder = DesignFolder(home / "out")
    return study, folder.path, run_design(study, folder, texts), texts


@pytest.mark.thorough
def test_a_longer_search_finds_no_worse(whole, tmp_path):
    study = tiny.built(tmp_path, "search.samples=32", "search.steps=20")
    design = run_design(study, DesignFolder(tmp_path / "out"), tiny.ignore)
    assert design["search"]["evaluations"] > 32
    quick = whole[2]["found"][0]["objective_exact"]
    assert design["found"][0]["objective_exact"] <= quick * (1 + 1e-3)
    assert json.loads((tmp_path / "out" / "design.json").read_text("utf-8")) == design


def test_what_is_written(whole):
    _, path, design, texts = whole
    assert json.loads((path / "design.json").read_text("utf-8")) == design
    assert len(texts) == texts.total == 6
    assert {p.name for p in path.iterdir()} == {
        *("config.yaml", "found.yaml", "design.json", "environment.json", "report.html"),
        *("landscape.png", "responses.png", "mtf.png", "masks.png", "targets"),
        *("reconstructions-chart.png", "reconstructions-picture.png"),
    }
    assert skimage.io.imread(path / "landscape.png").shape[:2] == (660, 836)
    assert design["seed"] == 3
    assert design["objective"]["better"] == "lower"
    assert design["objective"]["prior_exponent"] == 2.5


def test_found_designs_are_better_and_within_bounds(whole):
    design = whole[2]
    reference, found = design["reference"], design["found"]
    exact = [one["objective_exact"] for one in found]
    assert exact == sorted(exact)
    assert exact[0] < reference["objective_exact"]
    for one in found:
        gain = 10 * np.log10(reference["objective_exact"] / one["objective_exact"])
        assert one["predicted_gain"] == pytest.approx(gain, rel=1e-4, abs=1e-6)
        assert all(12 <= shot["beta_rad_per_mm2"] <= 30 for shot in one["shots"])
        assert all(shot["distance_mm"] == 3 for shot in one["shots"])


def test_found_study_gives_the_first_seed(whole):
    """`thincam run found.yaml` simulates the same captures."""
    _, path, design, _ = whole
    study = build_study(load_config(path / "found.yaml"))
    names = [method.name for method in study.methods]
    assert names == ["pairs", *(one["name"] for one in design["found"][: len(names) - 1])]
    picture = study.targets[1]
    captures = {exposure: take(study, exposure, picture) for exposure in study.exposures}
    for name, method in zip(names, study.methods, strict=True):
        trials = design["validation"]["methods"][name]["picture"]["psnr_db"]["values"]
        assert len(trials) == 2
        found = evaluate_method(study, method, picture, captures)
        assert trials[0] == found.scores.psnr_db
        assert trials[0] != trials[1]  # other noise


def test_report_stands_alone(whole):
    config, path, design, _ = whole
    page = (path / "report.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == 6
    assert "A tiny design" in page
    psnr = design["validation"]["methods"]["pairs"]["picture"]["psnr_db"]
    assert f"{psnr['mean']:.2f} ± {psnr['deviation']:.2f}" in page
    gain = design["validation"]["methods"]["found 1"]["picture"]["gain_db"]
    assert f"{gain['mean']:+.2f} ± {gain['deviation']:.2f}" in page
    assert f"{design['found'][0]['predicted_gain']:+.3f}" in page
    assert "kind: design" in page


@pytest.mark.thorough
def test_interrupted_design_goes_on(whole, tmp_path, monkeypatch):
    """The finished target is not simulated again, and the figures are those of a whole run."""
    study, _, design, _ = whole
    folder = DesignFolder(tmp_path / "again")
    simulate, simulated = simulation.simulate, []

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

    monkeypatch.setattr(simulation, "simulate", one_only)
    assert interrupted() == ["chart"]
    # Other designs are not taken for those that were simulated.
    path = folder.path / "targets" / "chart.json"
    stored = json.loads(path.read_text("utf-8"))
    stored["designs"][1][0][0] += 1.0
    path.write_text(json.dumps(stored), encoding="utf-8")
    assert interrupted() == ["chart"]
    simulated.clear()
    again = run_design(study, folder, tiny.ignore)
    assert simulated == ["picture"]
    assert again["validation"] == design["validation"]
    # A complete design is done anew.
    assert interrupted() == ["chart"]
    with pytest.raises(ConfigError, match="holds a design of another configuration"):
        folder.claim(study.config.model_copy(update={"seed": 4}))


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
    assert list(told)[5:] == [*costs, *captures, *simulated, "report"]
    path = folder.path
    assert json.loads((path / "design.json").read_text("utf-8")) == design
    thin, thick = design["pareto"]["thickness"]["points"]
    assert (thin["thickness_mm"], thick["thickness_mm"]) == (2.0, 3.0)
    assert thin["resolution_cycles_per_rad"] <= thick["resolution_cycles_per_rad"]
    few, many = design["pareto"]["captures"]["points"]
    assert (few["captures"], many["captures"]) == (2, 4)
    # Half the captures have twice the electrons each.
    assert (few["shots"][0]["exposure"], many["shots"][0]["exposure"]) == (2.0, 1.0)
    assert 5 < few["simulated_psnr_db"]["picture"] < 60
    assert (path / "pareto.png").exists()
    page = (path / "report.html").read_text("utf-8")
    assert "Thickness against resolution" in page
    assert f"{thick['resolution_line_pairs_per_mm']:.3f}" in page
    assert "pareto" not in whole[2]


def test_an_objective_that_is_nan_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "find_designs", lambda *_, **__: Search((), 3, 3))
    with pytest.raises(ConfigError, match="^search: the objective is NaN at any start; give"):
        carry_out(Finder(tiny.built(tmp_path)).work, tiny.ignore)


def metrics(psnr, step, pixel=0.1):
    resolved = None
    if step is not None:
        resolved = {"group": step // 6, "element": step % 6, "object_mm": 2.0 ** -(step / 6)}
    return {"psnr_db": psnr, "ssim": 0.5, "object_pixel_mm": pixel, "resolved": resolved}


def test_gains_are_taken_seed_by_seed():
    trials = {
        "a": {
            "old": [metrics(20.0, 7), metrics(22.0, 8)],
            "new": [metrics(20.5, 9), metrics(22.9, 8)],
        }
    }
    compared = compare(trials)
    assert "gain_db" not in compared["old"]["a"]
    gain = compared["new"]["a"]["gain_db"]
    assert gain["values"] == [0.5, 0.9]
    assert gain["mean"] == 0.7
    assert gain["deviation"] == pytest.approx(np.std([0.5, 0.9], ddof=1), abs=1e-4)
    assert compared["new"]["a"]["gain_elements"]["values"] == [2, 0]
    # Not resolved, or exact: no number is made up.
    trials["a"]["old"][0] = metrics(None, None)
    compared = compare(trials)
    assert compared["new"]["a"]["gain_db"] is None
    assert compared["new"]["a"]["gain_elements"] is None
    assert compared["old"]["a"]["resolved_object_mm"][0] is None


def read_again(study, folder):
    """As `thincam run` reads found.yaml."""
    path = folder / "found.yaml"
    path.write_text(dump_config(as_study_config(study)), encoding="utf-8")
    return build_study(load_config(path))


def taken(study):
    """What the methods are, but for their solvers."""
    return [(m.name, m.solver.name, m.synthesis, tuple(m.exposures)) for m in study.methods]


def test_shots_that_coincide_are_two_exposures(tmp_path):
    """In the simulation, and in the file of what was found."""
    same = {"found 1": tiny.found([20.0, 17.0, 20.0])}
    study = with_designs(tiny.built(tmp_path), same)
    method = study.methods[1]
    assert len(set(method.exposures)) == 6
    assert [(shot.beta, shot.take) for shot in method.shots] == [(20, 1), (17, 1), (20, 2)]
    assert taken(read_again(study, tmp_path)) == taken(study)
    electrons = "noise={read_noise: 0, electrons: 2e5}"
    longer = {"found 1": tiny.found([20.0, 20.0], exposure=[0.7, 1.3])}
    method = with_designs(tiny.built(tmp_path, electrons), longer).methods[1]
    assert [(s.beta, s.relative_time, s.take) for s in method.shots] == [(20, 0.7, 1), (20, 1.3, 1)]


def test_only_the_simulation_has_the_pixels_of_a_display(tmp_path):
    settings = ("model=separable", "mask.pixel_pitch=50 um", "mask.fill_factor=0.9")
    study = tiny.built(tmp_path, *settings)
    camera = study.camera(study.exposures[0])
    assert (camera.mask.pixels, float(camera.mask.fill_factor)) == ((40, 40), pytest.approx(0.9))
    reference = study.config.design(study.config.reference)
    assert reference.cameras(camera.sensor)[0].mask.pixels is None
    with pytest.raises(ConfigError, match="mask"):
        tiny.built(tmp_path, "mask.pixel_pitch=70 um")


def test_electrons_are_those_of_the_file(tmp_path):
    study = tiny.built(tmp_path, "noise={read_noise: 0, electrons: 2e5}")
    exposure, plane = study.exposures[0], study.targets[0].plane
    clean = noise_free(study, exposure, plane)
    counted = electrons_per_unit(study.camera(exposure).sensor, clean)
    assert float(counted[0, 0, 0]) == pytest.approx(2e5, rel=1e-4)
    assert float(study.noise.variance(clean, counted)[0]) == pytest.approx(
        float(clean.mean()) / 2e5, rel=1e-4
    )
    found = {"found 1": tiny.found([20.0, 17.0], exposure=0.5)}
    found = with_designs(study, found)
    variance = take(found, found.methods[1].exposures[0], found.targets[0]).variance[0]
    assert float(variance) == pytest.approx(2 * float(clean.mean()) / 2e5, rel=0.05)


def test_found_numbers_reach_the_simulation(tmp_path):
    """Width (in whole pixels of a display), wavelength and exposure; what all share is left out."""
    given = ("noise={read_noise: 0, electrons: 2e5}", "mask.pixel_pitch=50 um")
    found = tiny.found([20.0], 2.5, width=1.49, wavelength=6e-4, exposure=0.7)
    study = with_designs(tiny.built(tmp_path, *given), {"found 1": found})
    exposure = study.methods[1].exposures[0]
    assert astuple(exposure)[:7] == pytest.approx((20.0, 0.0, 2.5, 6e-4, 1.45, 0.7, 1))
    assert exposure.profile is None
    camera = study.camera(exposure)
    assert (camera.mask.pixels, float(camera.mask.width)) == ((29, 29), pytest.approx(1.45))
    assert float(camera.sensor.electrons) == pytest.approx(0.7 * 2e5)
    assert taken(read_again(study, tmp_path)) == taken(study)
    shot = as_study_config(study).methods[0].shots[0]
    assert shot.model_dump(exclude_defaults=True).keys() == {"beta", "distance"}


class TestPictures:
    def result(self, **changed):
        found = RankedDesign(
            "found 1",
            tiny.found([20.0, 17.0]),
            0.1,
            0.09,
            np.ones(64),
            (FreeValue("beta", (1,), 20.0, 0.1), FreeValue("beta", (2,), 17.0, None)),
        )
        old = replace(found, name="pairs", design=tiny.found((25.0, 21.0)))
        axis = np.linspace(12, 30, 7)
        costs = np.linspace(0.09, 0.4, 49).reshape(7, 7)
        named = (("beta", (1,)), ("beta", (2,)))
        around = Landscape(named, (axis, axis), costs, BayesError())
        result = FoundDesigns(BayesError(), old, (found,), 1, 0, 2.5, 18.75, around)
        return replace(result, **changed)

    def test_landscape_with_the_designs(self):
        figure = draw_landscape(self.result(), 1)
        assert as_png(figure).startswith(b"\x89PNG")
        labels = [line.get_label() for line in figure.axes[0].lines]
        assert labels == ["pairs (-10.46 dB)", "found 1 (-10.46 dB)"]
        assert draw_landscape(self.result(landscape=None), 1) is None

    def test_frequencies_on_the_sensor(self):
        figure = draw_responses(self.result(), 1, 0.04)
        ax = figure.axes[0]
        top = ax.child_axes[0]
        figure.draw_without_rendering()
        assert ax.get_xlim()[1] == 18.75
        assert top.get_xlim()[1] == pytest.approx(6.25)
        assert "12.5" in top.get_xlabel()
        assert ax.lines[0].get_xdata()[0] == pytest.approx(18.75 / 128)

    def test_contrast_side_by_side(self):
        """Common axes; a curve for the chain, and one for each sum of captures."""
        levels = np.linspace(1e-2, 1e-4, 64)
        sums = (((1,), (2,)), ((3,), (4,)))
        transfer = ModulationTransfer(np.stack([levels, levels / 2]), levels * 50, sums)
        result = self.result(transfers=(transfer, transfer))
        figure = draw_mtf(result, 100.0)
        assert [ax.get_title() for ax in figure.axes] == ["pairs", "found 1"]
        left, right = figure.axes
        assert left.get_ylim() == right.get_ylim()
        assert [line.get_label() for line in right.lines] == [
            "camera and reconstruction",
            "captures 1 − 2: β 20 rad/mm² at 3 mm",
            "captures 3 − 4: β 17 rad/mm² at 3 mm",
        ]
        assert len({line.get_linestyle() + line.get_marker() for line in right.lines}) == 3
        figure.draw_without_rendering()
        assert left.child_axes[0].get_xlim()[1] == pytest.approx(0.1875)
        assert draw_mtf(self.result(), 100.0) is None

    def test_labels(self):
        assert REPORTED["distance"].of_shots((1, 2)) == "distance of shots 1, 2, mm"
        assert REPORTED["width"].label == "mask width, mm"
        assert REPORTED["exposure"].of_shots((2,)) == "exposure of shot 2"


def test_what_differs_is_told():
    """β and distances always; the width and the wavelength where they are not all the same."""

    def design(*shots):
        keys = ("beta_rad_per_mm2", "distance_mm", "wavelength_nm", "width_mm", "exposure")
        return {"shots": [dict(zip(keys, shot, strict=True)) for shot in shots]}

    one = design((20.0, 3.0, 500.0, 2.0, 1.0), (20.0, 2.5, 500.0, 2.0, 1.0))
    other = design((25.0, 3.0, 620.0, 1.5, 1.0), (21.0, 3.0, 500.0, 1.5, 1.0))
    assert reported_names([one]) == ("beta", "distance")
    names = reported_names([one, other])
    assert names == ("beta", "distance", "wavelength", "width")
    assert cells(one, names) == ["20.00, 20.00", "3.00, 2.50", "500", "2.00"]
    assert cells(other, names) == ["25.00, 21.00", "3.00", "620, 500", "1.50"]
    assert in_words(other, names) == [
        "β 25.00 at 3.00 mm, wavelength 620 nm, mask width 1.50 mm",
        "β 21.00 at 3.00 mm, wavelength 500 nm, mask width 1.50 mm",
    ]


def test_sentences_of_the_report(whole):
    design = json.loads(json.dumps(whole[2]))
    told = " ".join(findings(design))
    assert "Simulated, found 1 gains" in told
    assert "not on one grid" not in told
    chart = design["validation"]["methods"]["found 1"]["chart"]
    chart |= {"gain_elements": {"mean": 0, "deviation": None}}
    chart |= {"gain_db": {"mean": -1.06, "deviation": None}}
    assert "at -1.06 dB (28 % more squared error)" in " ".join(findings(design))
    design["validation"]["one_object_grid"] = False
    design["reference"]["broken_limits"] = ["β of shot 1 is too much"]
    design["found"][0]["active_limits"] = ["beta ≤ 9"]
    told = " ".join(findings(design))
    for part in ("not on one grid", "The reference breaks a limit: β of", "against a limit: beta"):
        assert part in told
