"""Designs from file to folder: the simulation, what is written, and going on after Ctrl-C."""

import inspect
import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import skimage.io
from commands.design import tiny

from thincam_jax.commands.design import problem as problem_of_search
from thincam_jax.commands.design import run as running
from thincam_jax.commands.design.compare import compare
from thincam_jax.commands.design.figures import as_png, draw_landscape, draw_mtf, draw_responses
from thincam_jax.commands.design.landscape import Landscape
from thincam_jax.commands.design.page import findings
from thincam_jax.commands.design.pareto import Front, Fronts, Point
from thincam_jax.commands.design.problem import Goal
from thincam_jax.commands.design.ranking import Candidate, Result
from thincam_jax.commands.design.run import DesignFolder, run_design, steps
from thincam_jax.commands.design.sensitivity import FreeValue
from thincam_jax.commands.design.simulated import build_study, check_design
from thincam_jax.commands.design.transfer import Transfer as ContrastTransfer
from thincam_jax.commands.design.words import cells, free_number, in_words, told_of
from thincam_jax.commands.study import build
from thincam_jax.commands.study.config import (
    ConfigError,
    MethodConfig,
    StudyConfig,
    TargetConfig,
    load_config,
)
from thincam_jax.commands.study.target import examine_target
from thincam_jax.design import find_designs, landscape
from thincam_jax.design.search import Found, Search
from thincam_jax.design.space import active_limits
from thincam_jax.imaging.sensor import electrons_per_unit

RINGS = np.ones(64)


def by_grid(goal, space, data, **options):
    """In place of the search, which takes long to compile: the best points of the landscape."""
    inspect.signature(find_designs).bind(goal, space, data, **options)
    points, values = landscape(goal, space, data, 5)
    found = tuple(
        Found(
            *(space.design(points[n]), space.values(points[n]), float(values[n]), "converged"),
            *(active_limits(space, points[n]), points[n]),
        )
        for n in np.argsort(values)[:6]
    )
    return Search(found, len(points), 0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One uninterrupted run: configuration, folder, what was found, the texts of its progress."""
    home = tmp_path_factory.mktemp("design")
    config, texts = tiny.design(home), []
    folder = DesignFolder(home / "out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problem_of_search, "find_designs", by_grid)
        return config, folder.path, run_design(config, folder, texts.append), texts


@pytest.mark.thorough
def test_searched_design_is_no_worse_than_the_grid(whole, tmp_path):
    config = tiny.design(tmp_path, "search.samples=32", "search.steps=20")
    design = run_design(config, DesignFolder(tmp_path / "out"), tiny.ignore)
    assert design["search"]["evaluations"] > 32
    assert design["found"][0]["objective_exact"] <= whole[2]["found"][0]["objective_exact"]
    assert json.loads((tmp_path / "out" / "design.json").read_text("utf-8")) == design


def test_what_is_written(whole):
    config, path, design, texts = whole
    assert json.loads((path / "design.json").read_text("utf-8")) == design
    assert len(texts) == steps(config) == 6
    assert {p.name for p in path.iterdir()} == {
        *("config.yaml", "found.yaml", "design.json", "environment.json", "report.html"),
        *("landscape.png", "responses.png", "mtf.png", "targets"),
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
    study = load_config(path / "found.yaml")
    names = [method.name for method in study.methods]
    assert names == ["pairs", *(one["name"] for one in design["found"][: len(names) - 1])]
    evaluations = examine_target(study, 1, study.targets[1], {}, tiny.ignore).evaluations
    for name in names:
        trials = design["validation"]["methods"][name]["picture"]["psnr_db"]["values"]
        assert len(trials) == 2
        assert trials[0] == evaluations[name].metrics["psnr_db"]
        assert trials[0] != trials[1]  # other noise


def test_report_stands_alone(whole):
    config, path, design, _ = whole
    page = (path / "report.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == 3
    assert "A tiny design" in page
    psnr = design["validation"]["methods"]["pairs"]["picture"]["psnr_db"]
    assert f"{psnr['mean']:.2f} ± {psnr['deviation']:.2f}" in page
    gain = design["validation"]["methods"]["found 1"]["picture"]["gain_db"]
    assert f"{gain['mean']:+.2f} ± {gain['deviation']:.2f}" in page
    assert f"{design['found'][0]['predicted_gain']:+.3f}" in page
    assert "kind: design" in page


def shots_of(method):
    return tuple(tiny.shot(s.beta, s.distance) for s in method.shots)


@pytest.fixture
def again(whole, monkeypatch):
    """The same design in another folder without the search; `found` may be changed."""
    config, path, design, _ = whole
    methods = load_config(path / "found.yaml").methods[1:]
    found = tuple(
        Candidate(
            one["name"], tuple(tiny.shot(s.beta, s.distance) for s in m.shots), 0.1, 0.09, RINGS
        )
        for one, m in zip(design["found"][:2], methods, strict=True)
    )
    again = SimpleNamespace(config=config, folder=DesignFolder(path.parent / "again"), found=found)

    def result(*_):
        reference = again.found[0]._replace(name="pairs")
        return Result(Goal("bayes_error"), reference, again.found, 1, 0, 2.5, 9.0, None)

    monkeypatch.setattr(running, "find", result)
    return again


def test_interrupted_design_goes_on(whole, again, monkeypatch):
    """The finished target is not simulated again, and the figures are those of a whole run."""
    simulate, simulated = running.simulate, []

    def one_only(study, index, target, seeds):
        if simulated:
            raise KeyboardInterrupt
        simulated.append(target.name)
        return simulate(study, index, target, seeds)

    def interrupted():
        with pytest.raises(KeyboardInterrupt):
            run_design(again.config, again.folder, tiny.ignore)
        assert not (again.folder.path / "design.json").exists()

    monkeypatch.setattr(running, "simulate", one_only)
    interrupted()
    assert simulated == ["chart"]
    # Other designs are not taken for those that were simulated.
    same, again.found = (
        again.found,
        tuple(one._replace(shots=(one.shots[0], tiny.shot(15.5, 3.0))) for one in again.found),
    )
    interrupted()
    again.found = same
    simulated.clear()
    design = run_design(again.config, again.folder, tiny.ignore)
    assert simulated == ["picture"]
    assert design["validation"] == whole[2]["validation"]
    # A complete design is done anew.
    interrupted()
    with pytest.raises(ConfigError, match="holds a design of another configuration"):
        again.folder.claim(again.config.model_copy(update={"seed": 4}))


def test_fronts_are_written_and_reported(whole, again, monkeypatch, tmp_path):
    """They come after the targets, and count as progress."""
    bounds, told = "{bounds: [12 rad/mm^2, 30 rad/mm^2], variable: beta}", []
    config = tiny.design(
        tmp_path,
        f"search.free=[{bounds}, {{variable: distance, bounds: [2 mm, 3 mm]}}]",
        "pareto.thickness={bounds: [2 mm, 3 mm], points: 2}",
    )
    points = tuple(
        Point(cost, (tiny.shot(20.0, cost),) * 2, 4 * cost, "", 0.1) for cost in (2.0, 3.0)
    )

    def found(_, progress):
        for point in (*points, *points[:1], *points[1:]):  # back, and there again
            progress(f"thickness {point.cost}")
        return Fronts(Front(points, points[1]), None, None, 18.75, None)

    monkeypatch.setattr(running, "find_fronts", found)
    again.folder = DesignFolder(tmp_path / "fronts")
    design = run_design(config, again.folder, told.append)
    assert len(told) + 3 == steps(config)  # `find` is replaced
    assert told[-3:] == ["thickness 2.0", "thickness 3.0", "report"]
    path = again.folder.path
    assert json.loads((path / "design.json").read_text("utf-8")) == design
    assert [p["thickness_mm"] for p in design["pareto"]["thickness"]["points"]] == [2.0, 3.0]
    assert (path / "pareto.png").exists()
    page = (path / "report.html").read_text("utf-8")
    assert "Thickness against resolution" in page
    assert "0.120" in page  # 12 cycles/rad at 100 mm, line pairs/mm
    assert "pareto" not in whole[2]


def metrics(psnr, step, pixel=0.1):
    resolved = None
    if step is not None:
        resolved = {"group": step // 6, "element": step % 6, "object_mm": 2.0 ** -(step / 6)}
    return {"psnr_db": psnr, "ssim": 0.5, "object_pixel_mm": pixel, "resolved": resolved}


def test_gains_are_taken_seed_by_seed():
    study = StudyConfig.model_construct(
        methods=tuple(MethodConfig.model_construct(name=n) for n in ("old", "new")),
        targets=(TargetConfig.model_construct(name="a"),),
    )
    trials = {
        "a": {
            "old": [metrics(20.0, 7), metrics(22.0, 8)],
            "new": [metrics(20.5, 9), metrics(22.9, 8)],
        }
    }
    compared = compare(study, trials)
    assert "gain_db" not in compared["old"]["a"]
    gain = compared["new"]["a"]["gain_db"]
    assert gain["values"] == [0.5, 0.9]
    assert gain["mean"] == 0.7
    assert gain["deviation"] == pytest.approx(np.std([0.5, 0.9], ddof=1), abs=1e-4)
    assert compared["new"]["a"]["gain_elements"]["values"] == [2, 0]
    # Not resolved, or exact: no number is made up.
    trials["a"]["old"][0] = metrics(None, None)
    compared = compare(study, trials)
    assert compared["new"]["a"]["gain_db"] is None
    assert compared["new"]["a"]["gain_elements"] is None
    assert compared["old"]["a"]["resolved_object_mm"][0] is None


def test_shots_that_coincide_are_two_exposures(tmp_path):
    config = tiny.design(tmp_path)
    same = SimpleNamespace(name="found 1", shots=(tiny.shot(20.0, 3.0),) * 2)
    method = build_study(config, [same]).methods[1]
    assert len(build.settings(build_study(config, [same]), method)) == 4
    assert len({shot.beta for shot in method.shots}) == 2
    assert [shot.beta for shot in method.shots] == pytest.approx([20.0, 20.0], rel=1e-8)
    config = tiny.design(tmp_path, "noise={read_noise: 0, electrons: 2e5}")
    longer = SimpleNamespace(
        name="found 1", shots=tuple(tiny.shot(20.0, 3.0, exposure=e) for e in (0.7, 1.3))
    )
    method = build_study(config, [longer]).methods[1]
    assert [(s.beta, s.exposure) for s in method.shots] == [(20.0, 0.7), (20.0, 1.3)]


def test_only_the_simulation_has_the_pixels_of_a_display(tmp_path):
    settings = ("model=separable", "mask.pixel_pitch=50 um", "mask.fill_factor=0.9")
    config = tiny.design(tmp_path, *settings)
    study = build_study(config)
    camera = build.build_camera(study, build.all_settings(study)[0])
    assert (camera.mask.pixels, float(camera.mask.fill_factor)) == (40, pytest.approx(0.9))
    assert config.reference_design().cameras(camera.sensor)[0].mask.pixels is None
    check_design(config)
    with pytest.raises(ConfigError, match="mask"):
        check_design(tiny.design(tmp_path, "mask.pixel_pitch=70 um"))


def test_electrons_are_those_of_the_file(tmp_path):
    config = tiny.design(tmp_path, "noise={read_noise: 0, electrons: 2e5}")
    study = build_study(config)
    setting = build.all_settings(study)[0]
    plane = build.build_plane(study, study.targets[0])
    camera = build.build_camera(study, setting)
    clean = build.imaging(study, camera, setting, plane)
    noise = build.build_noise(study)
    counted = electrons_per_unit(camera.sensor, clean)
    assert float(counted[0, 0, 0]) == pytest.approx(2e5, rel=1e-4)
    assert float(noise.variance(clean, counted)[0]) == pytest.approx(
        float(clean.mean()) / 2e5, rel=1e-4
    )
    assert float(build_noise_of(config, tiny.shot(20.0, 3.0, exposure=0.5))) == pytest.approx(
        2 * float(clean.mean()) / 2e5, rel=0.05
    )


def build_noise_of(config, shot):
    """Variance of the first capture of a found design, mm⁴."""
    study = build_study(config, [SimpleNamespace(name="found 1", shots=(shot,) * 2)])
    setting = build.settings(study, study.methods[1])[0]
    plane = build.build_plane(study, study.targets[0])
    return build.take(study, setting, plane, jax.random.key(0)).variance[0]


def test_found_numbers_reach_the_simulation(tmp_path):
    """Width (in whole pixels of a display), wavelength and exposure; what all share is left out."""
    config = tiny.design(
        tmp_path, "noise={read_noise: 0, electrons: 2e5}", "mask.pixel_pitch=50 um"
    )
    found = tiny.shot(20.0, 2.5, width=1.49, wavelength=6e-4, exposure=0.7)
    study = build_study(config, [SimpleNamespace(name="found 1", shots=(found,))])
    (shot,) = study.methods[1].shots
    setting = build.settings(study, study.methods[1])[0]
    assert shot.width == pytest.approx(1.45)
    assert setting[:1] + setting[2:] == pytest.approx((20.0, 2.5, 6e-4, 1.45, 0.7))
    camera = build.build_camera(study, setting)
    assert (camera.mask.pixels, float(camera.mask.width)) == (29, pytest.approx(1.45))
    assert float(camera.sensor.electrons) == pytest.approx(0.7 * 2e5)
    assert study.methods[0].shots[0].model_dump(exclude_defaults=True).keys() == {
        "beta",
        "distance",
    }


class TestPictures:
    def result(self, reference=(25.0, 21.0), goal="bayes_error", axes=2):
        found = Candidate(
            "found 1",
            (tiny.shot(20.0, 3.0), tiny.shot(17.0, 3.0)),
            0.1,
            0.09,
            np.ones(64),
            (FreeValue("beta", (1,), 20.0, 0.1), FreeValue("beta", (2,), 17.0, None)),
        )
        old = found._replace(name="pairs", shots=tuple(tiny.shot(b, 3.0) for b in reference))
        axis = np.linspace(12, 30, 7)
        named = tuple(("beta", (n,)) for n in range(1, axes + 1))
        level = np.linspace(0.09, 0.4, 7**axes).reshape((7,) * axes)
        around = Landscape(named, (axis,) * axes, level)
        return Result(Goal(goal), old, (found,), 1, 0, 2.5, 18.75, around)

    def test_map_reaches_to_a_reference_beyond_it(self):
        for reference, right in (((25.0, 21.0), 31.5), ((40.0, 21.0), 40.0)):
            figure = draw_landscape(self.result(reference), 1)
            ax = figure.axes[0]
            assert ax.get_xlim()[1] >= right
            places = [tuple(float(c[0]) for c in line.get_data()) for line in ax.lines]
            assert places == [reference, (20.0, 17.0)]
            assert ax.get_xlabel() == "β of shot 1, rad/mm²"
            assert figure.axes[1].get_ylabel() == Goal("bayes_error").label
            assert as_png(figure).startswith(b"\x89PNG")

    @pytest.mark.parametrize("goal", ["limit", "worst_ratio", "unevenness"])
    def test_other_goals_and_one_variable(self, goal):
        for axes in (1, 2):
            assert as_png(draw_landscape(self.result(goal=goal, axes=axes), 1))

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
        transfer = ContrastTransfer(np.stack([levels, levels / 2]), levels * 50, sums)
        result = self.result()._replace(transfers=(transfer, transfer))
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
        assert free_number("distance", (1, 2)) == "distance of shots 1, 2, mm"
        assert free_number("width", ()) == "mask width, mm"
        assert free_number("exposure", (2,)) == "exposure of shot 2"

    def test_axes_have_the_units_of_their_labels(self):
        """Wavelengths are in nm, and all shots have the width of the first."""
        result, axis = self.result(), np.linspace(4e-4, 6e-4, 7)
        named = (("width", ()), ("wavelength", (2,)))
        level = np.linspace(0.09, 0.4, 49).reshape(7, 7)
        ax = draw_landscape(
            result._replace(landscape=Landscape(named, (np.linspace(1, 3, 7), axis), level)), 1
        ).axes[0]
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("mask width, mm", "wavelength of shot 2, nm")
        assert ax.lines[0].get_xydata()[0] == pytest.approx([2.0, 500.0])
        assert ax.get_ylim() == pytest.approx((400 - 100 / 6, 600 + 100 / 6))


def test_what_differs_is_told():
    """β and distances always; the width and the wavelength where they are not all the same."""

    def design(*shots):
        keys = ("beta_rad_per_mm2", "distance_mm", "wavelength_nm", "width_mm", "exposure")
        return {"shots": [dict(zip(keys, shot, strict=True)) for shot in shots]}

    one = design((20.0, 3.0, 500.0, 2.0, 1.0), (20.0, 2.5, 500.0, 2.0, 1.0))
    other = design((25.0, 3.0, 620.0, 1.5, 1.0), (21.0, 3.0, 500.0, 1.5, 1.0))
    assert told_of([one]) == ("beta", "distance")
    names = told_of([one, other])
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
    design["validation"]["one_object_grid"] = False
    design["reference"]["broken_limits"] = ["β of shot 1 is too much"]
    design["found"][0]["active_limits"] = ["beta ≤ 9"]
    told = " ".join(findings(design))
    for part in ("not on one grid", "The reference breaks a limit: β of", "against a limit: beta"):
        assert part in told
