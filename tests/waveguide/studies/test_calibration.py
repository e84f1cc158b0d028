"""Screens calibrated with Hadamard patterns: their matrix, the fit, other distances."""

import dataclasses

import pytest
from waveguide.studies import tiny_screen

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import nm
from thincam_jax.waveguide.studies.calibration import calibrate
from thincam_jax.waveguide.studies.screen import ScreenModel

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def study():
    return tiny_screen.study()


@pytest.fixture(scope="module")
def calibrated(study):
    return calibrate(study, tiny_screen.CALIBRATION)


def test_a_calibration_is_as_good_as_its_noise(study, calibrated):
    """The matrix has the noise of its frames, and takes the place of the exact rays."""
    scores = calibrated.scores
    assert scores.frames == 2 * 8 * 16
    spread = (2 * (1 + 1 / 12) / 128) ** 0.5
    assert scores.expected_noise_counts == pytest.approx(spread, abs=1e-5)
    assert scores.noise_counts == pytest.approx(spread, rel=0.1)
    exact = study.run().models["right"].methods
    for name, measured in calibrated.methods.items():
        expected = exact[name].scores.mean_psnr_db
        assert measured.scores.mean_psnr_db == pytest.approx(expected, abs=1)


def test_another_distance_follows_from_the_fit(calibrated):
    glass = calibrated.scores.fit.values["glass_thickness"]
    assert glass.true == 5 and glass.unit == "mm"
    assert glass.found == pytest.approx(5, abs=0.05)  # from 5.3 mm
    means = {n: way.mean_psnr_db for n, way in calibrated.scores.distances["450 mm"].items()}
    assert abs(means["from the fit"] - means["measured there"]) < 1
    assert means["from the fit"] > means["as assumed"] + 1


@pytest.fixture(scope="module")
def colours():
    """Of three gratings and a sensor whose channels overlap."""
    return tiny_screen.study(
        *(tiny_screen.camera(w * nm) for w in (633, 532, 473)),
        responses=tuple(wg.ColourBand(c * nm, 80 * nm) for c in (610, 535, 465)),
        targets={"face": resize(sample_image("astronaut", linear=True), tiny_screen.CELLS)},
        solvers={"CGM": tc.Ridge(0.1)},
        models=(ScreenModel("right"), ScreenModel("separated", "no_crosstalk")),
    )


def test_colours_are_calibrated_with_their_cross_talk(colours):
    """Patterns of each primary: as good as the exact model, better than separated colours."""
    calibration = dataclasses.replace(tiny_screen.CALIBRATION, distances=())
    found = calibrate(colours, calibration)
    assert found.scores.frames == 3 * 2 * 8 * 16
    spread = found.scores.expected_noise_counts
    assert found.scores.noise_counts == pytest.approx(spread, rel=0.15)
    models = {name: model.methods["CGM"] for name, model in colours.run().models.items()}
    means = {name: method.scores.mean_psnr_db for name, method in models.items()}
    measured = found.methods["CGM"]
    assert measured.images.shape == (1, 8, 16, 3)
    assert measured.scores.mean_psnr_db == pytest.approx(means["right"], abs=2)
    assert means["right"] > means["separated"] + 10
