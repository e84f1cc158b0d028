"""What wrong PSFs cost captures and reconstructions, against an independent recomputation."""

import dataclasses

import numpy as np
import pytest
from studies import tiny

import thincam_jax as tc
from thincam_jax._core.steps import carry_out
from thincam_jax.studies.psf_error_cost import CaptureErrors, ReconstructionErrors, make_case


@pytest.fixture(scope="module")
def case():
    return make_case(tiny.study(), 48)


@pytest.fixture(scope="module")
def costs(case):
    errors = ReconstructionErrors(case)
    carry_out(errors.work)
    return errors.costs


@pytest.mark.thorough
def test_captures_agree_with_a_recomputation(case):
    errors = CaptureErrors(case)
    carry_out(errors.work)
    rows = {row.model: row for row in errors.rows}
    exposure, target = case.method.exposures[0], case.study.targets[1]
    camera = case.study.camera(exposure)
    scene = tc.Scene(target.plane, exposure.wavelength)
    exact, shadow = (
        np.asarray(tc.capture(camera, scene, model=m, pixel_integration=False), float)
        for m in ("separable", "geometric")
    )
    error = np.linalg.norm(shadow - exact) / np.linalg.norm(exact)
    assert rows["geometric"].error == pytest.approx(error, rel=1e-3)
    exact, shadow = (i - i.mean(axis=(-2, -1), keepdims=True) for i in (exact, shadow))
    error = np.linalg.norm(shadow - exact) / np.linalg.norm(exact)
    assert rows["geometric"].contrast_error == pytest.approx(error, rel=1e-3)
    assert rows["separable"].contrast_error < 1e-4


@pytest.mark.thorough
def test_losses_count_from_the_exact_model(costs):
    assert (costs.method, costs.skipped) == ("pairs", None)
    rows = {row.model: row for row in costs.models}
    for row in rows.values():
        if row.status == "run":
            assert row.psnr_lost_db == pytest.approx(costs.exact_psnr_db - row.psnr_db, abs=1e-9)
    assert abs(rows["separable"].psnr_lost_db) < 1e-3


@pytest.mark.thorough
@pytest.mark.parametrize("wrong", ["beta", "distance"])
def test_controlled_errors(costs, wrong):
    """Each hits its level; the larger the error of β the more PSNR is lost.

    A wrong d also changes how strong the fringes are taken to be, and can gain by it.
    """
    rows = [row for row in costs.controlled if row.wrong == wrong]
    assert [row.level for row in rows] == [0.003, 0.01, 0.03, 0.1]
    for row in rows:
        assert row.psf_error == pytest.approx(row.level, rel=0.05)
    lost = [row.psnr_lost_db for row in rows]
    if wrong == "beta":
        assert lost == sorted(lost) and lost[-1] > 0
    assert rows[0].capture_contrast_error < rows[-1].capture_contrast_error


def test_without_wiener():
    """Fringe scanning assumes no PSF: reported, not run."""
    study = tiny.study()
    case = make_case(dataclasses.replace(study, methods=study.methods[:1]), 32)
    assert case.skipped == "conventional: fringe scanning assumes no PSF"
    assert ReconstructionErrors(case).work == []
