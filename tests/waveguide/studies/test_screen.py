"""Screen studies: the right model is the best, and the mistakes are those of the thesis."""

import dataclasses

import numpy as np
import pytest
from matplotlib import pyplot
from waveguide.studies import tiny_screen

import thincam_jax as tc
from thincam_jax.studies.pictures import PublishedImage
from thincam_jax.units import nm
from thincam_jax.waveguide.studies.mask import ScreenMask
from thincam_jax.waveguide.studies.screen import ScreenModel, mistaken_rays

SINGLE = (ScreenModel("right"), ScreenModel("single", "no_ghosts"))


@pytest.fixture(scope="module")
def study():
    return tiny_screen.study()


@pytest.fixture(scope="module")
def result(study):
    return study.run()


@pytest.mark.thorough
def test_forgotten_ghosts_cost_an_image():
    study = tiny_screen.study(models=SINGLE, solvers={"CGM": tc.Ridge(1.0)})
    texts = []
    result = study.run(lambda text, count: texts.append((text, count)))
    assert texts == [("rays and captures", 3), ("right: CGM", 3), ("single: CGM", 3)]
    right, single = (result.models[name].methods["CGM"] for name in ("right", "single"))
    assert right.images.shape == (2, 8, 16)
    assert right.scores.mean_psnr_db > 25
    assert right.scores.mean_psnr_db > single.scores.mean_psnr_db + 1.5
    first, second = result.errors_table().rows
    loss = right.scores.mean_psnr_db - single.scores.mean_psnr_db
    assert first[0] == "right" and first[-2] == 0 and second[-2] == pytest.approx(loss)
    published = {list(study.targets)[0]: {"CGM": PublishedImage(16.8)}}
    rows = result.published_table(published).rows
    assert rows[0][-2:] == (16.8, None) and rows[1][-2:] == (None, None)
    try:
        assert [ax.get_title() for ax in result.plot().axes[:3]] == [
            "target",
            "capture, turned",
            "CGM",
        ]
    finally:
        pyplot.close("all")
    of_targets = [score.psnr_db for score in right.scores.targets.values()]
    assert right.scores.mean_psnr_db == pytest.approx(np.mean(of_targets), abs=1e-3)


@pytest.mark.parametrize(
    ("mistake", "places", "lost"),
    [
        pytest.param(
            *("no_defocus", {"aperture": 6.0, "focus_distance": 150.0}, 0.5),
            marks=pytest.mark.thorough,
        ),
        ("no_direct", {"direct_band": 20 * nm}, 3.0),
    ],
)
def test_forgotten_light_costs_an_image(mistake, places, lost):
    """That which crosses a lens beside its middle, or comes straight through the plate."""
    seen = dataclasses.replace(tiny_screen.camera(), **places)
    models = ScreenModel("right"), ScreenModel("wrong", mistake)
    study = tiny_screen.study(seen, models=models, solvers={"CGM": tc.Ridge(1.0)}, band_samples=1)
    right, wrong = (one.methods["CGM"].scores for one in study.run().models.values())
    assert right.mean_psnr_db > wrong.mean_psnr_db + lost
    mask = ScreenMask(tc.FresnelZoneAperture(beta=25.0, width=1.0))
    with pytest.raises(ValueError, match=f"{next(iter(places))} is of a camera with a lens; give"):
        tiny_screen.study(seen, band_samples=None, models=models[:1], mask=mask)


@pytest.fixture(scope="module")
def right(study):
    return mistaken_rays(study, study.camera, "none")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("mistake", "on_axis"),
    [
        ("none", 0.0),
        ("shift_invariant", 0.0),
        ("grating", 0.0),
        ("ghost_index", -18.19),
        ("no_smear", 0.0),
    ],
)
def test_mistakes_are_those_of_the_thesis(study, right, mistake, on_axis):
    """All but the ghost index agree on the axis, and none elsewhere."""
    wrong = mistaken_rays(study, study.camera, mistake)
    moved = np.mean(wrong.points - right.points, axis=-2)[..., 0]
    rows, columns = study.camera.sensor.shape
    middle = moved[:, rows // 2 - 1 : rows // 2 + 1, columns // 2 - 1 : columns // 2 + 1].mean(
        (1, 2)
    )
    np.testing.assert_allclose(middle, on_axis, atol=0.05)
    assert (np.ptp(moved[0]) > 1) == (mistake not in ("none", "no_smear"))


@pytest.mark.thorough
def test_the_printed_grating_needs_the_recording(study):
    unknown = tiny_screen.study(recording_angles=None)
    with pytest.raises(ValueError, match="give the study recording_angles"):
        mistaken_rays(unknown, unknown.camera, "grating")
