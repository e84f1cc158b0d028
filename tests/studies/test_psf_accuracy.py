"""Errors and times of PSF models, against an independent recomputation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import tiny

import thincam_jax as tc
from thincam_jax._core.steps import carry_out
from thincam_jax.lensless.method import MODELS
from thincam_jax.studies.psf_accuracy import PsfErrors, binned, pareto_front

SIZE = 32  # of the sensor's 64


@pytest.fixture(scope="module")
def rows():
    study = tiny.study()
    errors = PsfErrors(study, study.exposures[0], SIZE)
    carry_out(errors.work)
    return errors.rows


def own_psf(size, model, precision, **how):
    """The PSF of the binned camera, without the package's benchmark."""
    ratio = 64 / size
    pitch = float(np.float32(0.04 * ratio))
    shape = (round(48 / ratio), round(64 / ratio))
    mask = tc.FresnelZoneAperture(jnp.float32(25.0), jnp.float32(0.0), width=jnp.float32(2.0))
    mask = jax.tree.map(lambda x: x.astype(precision), mask)
    camera = tc.LenslessCamera(
        mask, tc.Sensor(shape, jnp.asarray(pitch, precision)), jnp.asarray(3.0, precision)
    )
    return np.asarray(
        tc.psf(
            camera,
            wavelength=jnp.asarray(float(np.float32(500e-6)), precision),
            object_distance=jnp.asarray(100.0, precision),
            model=tc.PsfMethod(model, **how),
        ),
        float,
    )


@pytest.mark.thorough
def test_errors_agree_with_a_recomputation(rows):
    exact = own_psf(SIZE, "separable", "float64")
    run = [row for row in rows if row.status == "run"]
    assert {row.model for row in run} == set(MODELS) - {"radial"}
    for row in run:
        if row.oversampling == 3 and row.precision == "float64":
            continue  # for the time it takes
        how = {"oversampling": row.oversampling} if row.oversampling else {}
        h = own_psf(SIZE, row.model, row.precision, **how)
        error = np.linalg.norm(h - exact) / np.linalg.norm(exact)
        if row.true_error == 0:
            assert (row.model, row.precision, error < 1e-13) == ("separable", "float64", True)
        else:
            assert row.true_error == pytest.approx(error, rel=0.2 if error < 1e-5 else 1e-3)


@pytest.mark.thorough
def test_every_candidate_has_its_row(rows):
    ways = {(row.model, row.precision, row.oversampling, max(row.shape)) for row in rows}
    assert len(ways) == len(rows) == 2 * (4 + 2 + 2)
    for row in rows:
        assert row.flops > 0 and row.bytes > 0
        ran = row.status == "run"
        assert ran == (row.reason is None) == (row.calls > 0)
        if ran:
            assert row.seconds > 0 and row.compile_seconds > 0
            assert row.predicted_error >= 0.5 * row.true_error


@pytest.mark.parametrize("size", [7, 16, 33, 64])
def test_binning_keeps_the_area(size):
    study = tiny.study()
    sensor = binned(study, size).sensor
    pitch = float(sensor.pitch)
    assert max(sensor.shape) == size
    assert sensor.shape[1] * pitch == pytest.approx(64 * 0.04, rel=1e-12)
    assert sensor.shape[0] * pitch == pytest.approx(48 * 0.04, abs=pitch / 2 + 1e-12)


def worth_choosing(errors, seconds):
    return pareto_front(list(zip(seconds, errors, strict=True)))


def test_made_up_table():
    # name: error, seconds
    table = {
        "fast and rough": (1.0, 0.1, True),
        "slower and rougher": (2.0, 0.2, False),
        "in between": (0.1, 0.3, True),
        "as accurate, slower": (0.1, 0.4, False),
        "no gain worth it": (0.096, 0.5, False),
        "exact": (0.0, 1.0, True),
        "exact, slower": (0.0, 2.0, False),
    }
    errors, seconds, expected = map(list, zip(*table.values(), strict=True))
    assert worth_choosing(errors, seconds) == expected
    assert worth_choosing(errors[::-1], seconds[::-1]) == expected[::-1]


def test_equal_times():
    assert worth_choosing([0.5, 0.1], [1.0, 1.0]) == [False, True]
    assert worth_choosing([0.1, 0.1], [1.0, 1.0]) == [True, False]


def test_nothing_and_one():
    assert worth_choosing([], []) == []
    assert worth_choosing([3.0], [1.0]) == [True]
