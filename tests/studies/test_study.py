"""Studies in memory: their scores are those of a file's run; what a study refuses."""

import dataclasses
import json
from dataclasses import asdict

import jax.numpy as jnp
import numpy as np
import pytest
from commands.study import tiny as file
from matplotlib import pyplot
from studies import tiny

import thincam_jax as tc
from helpers import ROOT, relative_l2
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.run import run_study
from thincam_jax.lensless.field import fall_of_light
from thincam_jax.reconstruction import TotalVariation
from thincam_jax.studies import Method
from thincam_jax.studies.evaluate import (
    coupled,
    expose,
    field_shape,
    noise_free,
    reconstructor,
    stacked,
)
from thincam_jax.units import um


@pytest.fixture(scope="module")
def result():
    return tiny.study().run()


@pytest.mark.thorough
def test_scores_are_those_of_the_file(result, tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_study(file.built(tmp_path), folder, file.ignore)
    assert json.loads((folder.path / "metrics.json").read_text("utf-8")) == asdict(result.scores)


def test_figures_are_those_of_pyplot(result):
    pyplot.close("all")
    try:
        figures = result.plot(), result.plot("picture")
        assert len(pyplot.get_fignums()) == 2
        titles = [ax.get_title().splitlines()[0] for ax in figures[1].axes[:3]]
        assert titles == ["scene", "conventional", "pairs"]
        with pytest.raises(ValueError, match="'no' is no target of this result; choose one of"):
            result.plot("no")
    finally:
        pyplot.close("all")


def test_the_study_of_the_thesis_is_that_of_its_file():
    """Cameras, sums, solvers and noise; the scores follow from them."""
    built = tc.studies.superresolution()
    config = load_experiment(ROOT / "configs" / "fza_superresolution.yaml")
    read = build_study(config)
    assert built.exposures == read.exposures and len(built.exposures) == 8 + 2
    for one, other in zip(built.methods, read.methods, strict=True):
        assert (one.name, one.published, one.synthesis) == (
            other.name,
            other.published,
            other.synthesis,
        )
        assert tuple(one.exposures) == tuple(other.exposures)
        assert str(one.solver) == str(other.solver)
    for one, other in zip(built.targets, read.targets, strict=True):
        assert (one.number, one.name, one.distance) == (other.number, other.name, other.distance)
        np.testing.assert_array_equal(one.plane.image, other.plane.image)
    for name in ("sensor", "noise", "model", "pixel_integration", "seed", "name"):
        assert str(getattr(built, name)) == str(getattr(read, name))
    assert str(built.camera(built.exposures[0])) == str(read.camera(read.exposures[0]))


def test_without_noise_a_filter_estimates_it(result):
    """As other solvers do; the image is better than that of noisy captures."""
    study = tiny.study(methods=tiny.methods()[1:], noise=None)
    every = study.run(study.targets[1:]), result
    clean, noisy = (one.evaluations["picture"]["pairs"].scores.psnr_db or 0.0 for one in every)
    assert clean > noisy + 0.1 > 10


def test_total_variation_is_coupled_as_suits_the_colours():
    solver = tc.AdmmTV(variation=TotalVariation(coupling="opponent", chroma_weight=2.0))
    found = [coupled(solver, channels).variation for channels in (1, 2, 3)]  # pyright: ignore
    assert [one.coupling for one in found] == ["none", "joint", "opponent"]
    assert jnp.all(jnp.stack([one.chroma_weight for one in found]) == 2.0)
    assert coupled(tc.Wiener(), 3) == tc.Wiener()


def test_refused_in_one_line():
    exposures = tc.Exposures(25.0, [3.0, 4.0], **tiny.LIGHT)
    for given, message in (
        ((exposures, tc.Wiener(), "fringe_scanning"), "takes 4 at each shot: give a multiple"),
        ((exposures, tc.Wiener(synthesis=np.eye(2))), "has a synthesis of its own; give its name"),
        ((exposures, tc.PoissonTV(), "contrasts"), "PoissonTV of method 'one' takes no sums"),
    ):
        with pytest.raises(ValueError, match=message):
            Method("one", *given)
    with pytest.raises(ValueError, match="two of the methods .* have one name"):
        tiny.study(methods=tiny.methods() * 2)


SETTINGS = {"wavelength": 500e-6, "width": 2.0}


@pytest.mark.parametrize(
    ("exposures", "synthesis", "more", "field", "message"),
    [
        (([25.0, 25.0], 3.0, [1, 1]), "separate", {}, "shots", "shots hold an entry twice"),
        (([25.0, 21.0], [3.0, 4.0], None), "contrasts", {}, None, "needs shots at one distance"),
        ((25.0, 3.0, None), "contrasts", {}, None, "give two phases or shots"),
        ((25.0, 3.0, None), "separate", {"harmonics": (1,)}, "harmonics", "separate has none"),
    ],
)
def test_methods_whose_captures_do_not_suit(exposures, synthesis, more, field, message):
    beta, distance, take = exposures
    settings = tc.Exposures(beta, distance, take=take, **SETTINGS)
    with pytest.raises(ValueError, match=message) as caught:
        Method("one", settings, tc.Wiener(), synthesis, **more)
    assert getattr(caught.value, "field", None) == field


def test_a_fault_between_methods_sensor_and_noise_has_its_place():
    study = tiny.study()
    with pytest.raises(ValueError, match="read_noise counts electrons; give sensor.exp") as caught:
        dataclasses.replace(study, noise=tc.PoissonGaussianNoise(2.0))
    assert caught.value.place == ("noise", "read_noise")
    longer = tc.Exposures([25.0, 21.0], 3.0, relative_time=[1.0, 2.0], **SETTINGS)
    method = Method("one", longer, tc.Wiener())
    with pytest.raises(ValueError, match="relative to the sensor's") as caught:
        dataclasses.replace(study, methods=(method,))
    assert caught.value.place == ("methods", 0, "shots", 1, "exposure")


def test_images_of_captures_over_the_field_are_divided_by_the_fall_of_light():
    """Shadows have the PSF of the axis everywhere, so that the light alone differs."""

    def taken(tolerance):
        study = tiny.study(noise=None, field_tolerance=tolerance)
        target, method = study.targets[1], study.methods[0]
        shape, exposures = field_shape(study, method, target), tuple(method.exposures)
        clean = [noise_free(study, exposure, target.plane) for exposure in exposures]
        seen = stacked([expose(study, *one, 1) for one in zip(exposures, clean, strict=True)])
        return seen[0], reconstructor(study, method, shape, 100.0)(*seen).image

    (axis, image), (field, even) = taken(None), taken(1e-3)
    assert relative_l2(np.asarray(field), np.asarray(axis)) > 0.1
    # What is left: a convolution of weighted images is no weighted convolution.
    assert relative_l2(np.asarray(even), np.asarray(image)) < 0.05
    rows, columns = ((np.arange(n) - (n - 1) / 2) * 40 * um / 3.0 for n in (46, 60))
    fall = fall_of_light(rows, columns)
    assert relative_l2(fall * np.asarray(even), np.asarray(image)) > 0.1


def test_says_what_the_psf_of_the_axis_leaves_out():
    """At the corner of 80 × 60 mm at 50 mm, where tan θ = 1; not at 100 mm."""
    far = tiny.study().targets[1]
    near = dataclasses.replace(far, distance=50.0)
    (told,) = tiny.study(targets=(near,)).warnings
    # π λ d ν² (√8 − 1) of 8.0 cycles/mm is 0.55 rad, of which 0.22 is the error.
    assert told.startswith("at 45°, the corner of the field, the PSF is some 12 % off")
    assert tiny.study(targets=(near,), field_tolerance=1e-2).warnings == []
    assert tiny.study(targets=(far,)).warnings == []


@pytest.mark.thorough
def test_two_distances_gain_decibels_in_the_quick_study():
    """Method A over the better conventional camera; both methods halve what is resolved."""
    result = build_study(load_experiment(ROOT / "configs" / "quick.yaml")).run()
    psnr, resolved = {}, {}
    for name, method in result.scores.methods.items():
        psnr[name] = method.targets["astronaut"].psnr_db
        resolved[name] = method.targets["USAF-1951"].resolved.object_mm
    usual = [name for name in psnr if name.startswith("conventional")]
    assert psnr["method A"] - max(psnr[name] for name in usual) > 2
    for name in ("method A", "method B"):
        assert resolved[name] <= min(resolved[one] for one in usual) / 2 + 1e-3


def test_table_has_a_row_for_each_method(result):
    table = result.table()
    (name, psnr, published, resolved, *_), _ = table.rows
    assert (name, published, resolved) == ("conventional", 20.3, 5.0)
    lines = str(table).splitlines()
    assert len(lines) == 4 and len({len(line) for line in lines}) == 1
    assert lines[2].startswith(f"| conventional | {psnr:7.1f} |") and "–" in lines[3]
