"""A sensor's calibration: against simulated sensors whose numbers are known."""

import runpy
from dataclasses import replace

import numpy as np
import pytest

from helpers import ROOT
from thincam_jax.measured import MeasurementError, Preparation, Raw, measure_sensor, prepare
from thincam_jax.measured.exposures import ExposedFrames
from thincam_jax.measured.sensor import SensorCalibration
from thincam_jax.studies.prepared import pixel_noise

BENCHMARK = str(ROOT / "benchmarks/photon_transfer.py")
SHAPE, FULL = (61, 90), 4095
GAIN, READ = 0.35, 6.0  # counts per electron, electrons
TIMES = (0.005, 0.02, 0.05, 0.1, 0.2)  # s
LIGHT = 34_000.0  # electrons/s
HOT, DEAD, DIM, NOISY = (4, 7), (30, 41), (50, 3), (17, 80)
ODD = HOT, DEAD, DIM, NOISY


class Sensor:
    """Poisson electrons of light and dark current, read noise, an offset that differs."""

    def __init__(self, seed=1):
        self.random = random = np.random.default_rng(seed)
        self.offset = 60 + 2 * random.standard_normal(SHAPE)  # counts
        self.current = np.full(SHAPE, 150.0)  # electrons/s
        self.read = np.full(SHAPE, READ)
        self.response = 1 + 0.02 * random.standard_normal(SHAPE)
        self.response *= 1 + 0.2 * np.cos(np.arange(SHAPE[1]) / 30)  # a lens's or lamp's shading
        self.offset[HOT] += 700
        self.response[DEAD], self.response[DIM] = 0.0, 0.5 * self.response[DIM]
        self.read[NOISY] = 10 * READ
        self.good = np.ones(SHAPE, bool)
        self.good[tuple(np.transpose(ODD))] = False
        self.response /= self.response[self.good].mean()

    def expose(self, exposure, light, count, flicker=0.0):
        lamp = 1 + flicker * self.random.standard_normal((count, 1, 1))
        rate = light * self.response * lamp + self.current
        electrons = self.random.poisson(rate * exposure, (count, *SHAPE))
        noise = self.read * self.random.standard_normal((count, *SHAPE))
        counts = np.rint(self.offset + GAIN * (electrons + noise))
        return np.clip(counts, 0, FULL).astype(np.uint16)

    def taken(self, exposure, frames=6, darks=9, light=LIGHT, flicker=0.0):
        lit = self.expose(exposure, light, frames, flicker)
        return ExposedFrames(exposure, lit, self.expose(exposure, 0.0, darks))

    def raw(self, exposure, light=LIGHT):
        return Raw(self.expose(exposure, light, 1)[0], bits=12)

    def level(self, exposure):
        return self.offset + GAIN * self.current * exposure


@pytest.fixture(scope="module")
def sensor():
    return Sensor()


@pytest.fixture(scope="module")
def found(sensor):
    return measure_sensor([sensor.taken(one) for one in TIMES], full_scale=FULL)


def test_numbers_have_no_bias_and_honest_errors(sensor):
    """Of many measurements of one sensor, with new noise each."""
    every = [
        measure_sensor([sensor.taken(t, 4, 4) for t in (0.02, 0.1, 0.2)], full_scale=FULL)
        for _ in range(30)
    ]
    for name, truth in (("conversion_gain", GAIN), ("read_noise", READ)):
        errors = np.array([getattr(one, f"{name}_error") for one in every])
        z = (np.array([getattr(one, name) for one in every]) - truth) / errors
        assert abs(z.mean()) < 3 / 30**0.5 and 0.7 < z.std() < 1.35, name
        assert errors.mean() < 0.02 * truth


def test_maps_have_no_bias_and_honest_errors(sensor, found):
    good = sensor.good & ~found.defective
    assert good.sum() >= sensor.good.sum() - 2
    for name, truth in (
        ("dark_level", sensor.level(found.exposure)),
        ("dark_rate", GAIN * sensor.current),
        ("response", sensor.response),
    ):
        z = (getattr(found, name) - truth)[good] / getattr(found, f"{name}_error")[good]
        assert abs(z.mean()) < 0.05, name  # 0.014 by chance
        assert abs(np.mean(z**2) - 1) < 0.08, name  # 0.02 by chance


def test_defective_pixels_are_found(found):
    assert all(found.defective[one] for one in ODD)


def test_line_of_photon_transfer_is_that_of_numpy(sensor):
    """The pair of two frames of EMVA 1288 in place of sums of squares, and a fit by NumPy."""
    series = [sensor.taken(one, 2, 2) for one in TIMES]
    found = measure_sensor(series, full_scale=FULL)
    good, points = ~found.defective, []
    for one in series:
        lit, dark = one.frames[:, good].astype(float), one.dark[:, good].astype(float)
        pair = [np.var(both[0] - both[1]) / 2 for both in (lit, dark)]
        points.append((lit.mean() - dark.mean(), pair[0] - pair[1]))
    means, excess = np.transpose(points)
    np.testing.assert_allclose(found.photon_transfer[:, 0], means, rtol=1e-9)
    np.testing.assert_allclose(found.photon_transfer[:, 1], excess, rtol=2e-3)
    weights = 1 / found.photon_transfer[:, 2]
    slope = np.linalg.lstsq((weights * means)[:, None], weights * excess, rcond=None)[0][0]
    assert found.conversion_gain == pytest.approx(slope, abs=0.2 * found.conversion_gain_error)


@pytest.fixture(scope="module")
def simulated():
    return {one.name: one for one in runpy.run_path(BENCHMARK)["SENSORS"]}


def z(found, name, truth):
    return abs(getattr(found, name) - truth) / getattr(found, f"{name}_error")


@pytest.mark.parametrize(
    "name", ["read noise 0.25 counts", "read noise 0.1 counts", "row noise", "row and column noise"]
)
def test_rounding_and_lines_are_no_read_noise(simulated, name):
    """They were 0.02 to 1 of it, over ten standard errors, without a word."""
    truth = simulated[name]
    found = truth.measured(3)
    assert z(found, "read_noise", truth.read) < 4 and z(found, "conversion_gain", truth.gain) < 4
    assert found.read_noise_error < 0.03 * truth.read and not found.findings
    assert found.defective.sum() <= 2
    lines = np.hypot(truth.rows, truth.columns)
    assert found.line_noise == pytest.approx(lines, rel=0.15)


@pytest.mark.parametrize("name", ["2 % non-linear", "0.5 % non-linear"])
def test_a_response_that_is_not_linear_is_found(simulated, name):
    truth = simulated[name]
    found = truth.measured(3)
    assert z(found, "conversion_gain", truth.gain) < 4 and found.bend < 0
    assert "not linear" in found.findings[0] and "expose less" in found.findings[0]


def test_findings_say_what_the_frames_cannot_show(simulated):
    """Each goes when its advice is followed."""
    one = simulated["one exposure"].measured(3)
    assert "take dark frames of a second exposure" in one.findings[0]
    assert "1 usable exposures" in one.findings[1] and "take three or more" in one.findings[1]
    assert not simulated["typical"].measured(3).findings
    alike = simulated["and one dark level"]
    (hidden,) = alike.measured(3).findings
    assert "up to 9.99 electrons" in hidden and "raise the analogue gain" in hidden
    assert not replace(alike, gain=0.4).measured(3).findings
    bent = simulated["2 % non-linear"]
    assert bent.measured(3).findings and not replace(bent, brightest=0.02).measured(3).findings


@pytest.mark.thorough
def test_two_sigma_cover_or_the_findings_say_why(simulated):
    for truth in simulated.values():
        every = [truth.measured(seed) for seed in range(100)]
        silent = [one for one in every if not one.findings]
        for name, value in (("conversion_gain", truth.gain), ("read_noise", truth.read)):
            off = [z(one, name, value) > 2 for one in silent]
            assert sum(off) <= 12, (truth.name, name)  # 5 of 100 by chance


def test_exposures_that_are_too_bright_are_left_out(sensor):
    series = [sensor.taken(one) for one in (*TIMES, 0.26, 0.5)]  # 0.9 of full scale, saturated
    found = measure_sensor(series, full_scale=FULL)
    assert len(found.photon_transfer) == len(TIMES)
    assert abs(found.conversion_gain - GAIN) < 4 * found.conversion_gain_error
    with pytest.raises(MeasurementError, match="over 0.8 of full scale; give a shorter"):
        measure_sensor(series[-1:], full_scale=FULL)


def test_corrected_frames_are_even_and_have_the_variance_that_they_say(sensor, found):
    exposure = 0.08
    truth = GAIN * LIGHT * exposure
    light, variance = found.at(exposure).correct(sensor.raw(exposure))
    good = ~found.defective
    z = (light[good] - truth) / np.sqrt(variance[good])
    assert abs(z.mean()) < 0.1 and abs(np.mean(z**2) - 1) < 0.1
    assert not light[~good].any() and not variance[~good].any()
    dark, variance = found.at(0.4).correct(sensor.raw(0.4, 0.0))
    assert abs(np.mean(dark[good] / np.sqrt(variance[good]))) < 0.1


def test_a_mosaic_has_the_mean_response_1_at_each_place(sensor):
    colours = np.where(np.add.outer(*map(np.arange, SHAPE)) % 2, 1.0, 0.4)
    coloured = Sensor()
    coloured.response = coloured.response * colours
    series = [coloured.taken(one) for one in TIMES]
    found = measure_sensor(series, full_scale=FULL, mosaic=True)
    for i in (0, 1):
        for j in (0, 1):
            good = ~found.defective[i::2, j::2]
            assert found.response[i::2, j::2][good].mean() == pytest.approx(1, abs=1e-5)
    assert (~found.defective).sum() >= sensor.good.sum() - 2


def test_a_file_keeps_it(found, tmp_path):
    again = SensorCalibration.load(found.save(tmp_path / "sensor.npz"))
    for name, value in vars(found).items():
        assert np.array_equal(getattr(again, name), value), name
        assert type(getattr(again, name)) is type(value), name


def test_damaged_files_are_refused_in_a_line(found, tmp_path):
    path = found.save(tmp_path / "sensor.npz")
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:400] + b"\xff" * 9 + whole[409:], b"text"):
        path.write_bytes(damaged)
        with pytest.raises(MeasurementError, match="is no calibration of a sensor") as refused:
            SensorCalibration.load(path)
        assert "\n" not in str(refused.value)
    for changed in (
        {"response": found.response[:-1]},
        {"dark_level": np.full(SHAPE, np.nan)},
        {"conversion_gain": -1.0},
        {"conversion_gain": np.ones(2)},
        {"unknown": 1.0},
    ):
        np.savez(path, **{**vars(found), **changed})
        with pytest.raises(MeasurementError, match="is no calibration of a sensor") as refused:
            SensorCalibration.load(path)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: [], "one exposure or more"),
        (lambda one: [one, replace(one, frames=one.frames[:, 1:], dark=one.dark[:, 1:])], "same"),
        (lambda one: [replace(one, dark=one.dark * 0)], "raise the camera's black level"),
        (lambda one: [replace(one, frames=one.dark)], "give more light|does not grow"),
        (lambda one: [replace(one, frames=one.dark[:6] + np.uint16(200))], "does not grow"),
    ],
)
def test_what_cannot_be_measured_is_refused(sensor, change, message):
    with pytest.raises(MeasurementError, match=message):
        measure_sensor(change(sensor.taken(0.1)), full_scale=FULL)


def prepared(sensor, found, options, seen=None, **given):
    """Even light at 80 ms, prepared with the calibration."""
    capture = sensor.raw(0.08) if seen is None else seen
    return prepare(capture, capture, background=found.at(0.08), options=options, **given)


@pytest.mark.parametrize(
    "options",
    [
        Preparation(capture_scale="none"),
        Preparation(downsample=3, corner=(2, 8)),
        Preparation(bayer="GRBG", corner=(2, 8)),
        Preparation(downsample=2, corner=(2, 8), crop=((2, 50), (5, 81))),
    ],
)
def test_a_preparation_is_even_and_has_the_variance_that_it_says(sensor, found, options):
    ready = prepared(sensor, found, options)
    assert ready.noise_variance is not None and ready.noise_variance.shape == ready.capture.shape
    z = ready.capture - GAIN * LIGHT * 0.08 / FULL / ready.log.capture_divisor
    z = z[ready.valid] / np.sqrt(ready.noise_variance[ready.valid])
    assert abs(z.mean()) < 0.12 and abs(np.mean(z**2) - 1) < 0.12
    assert np.array_equal(np.isfinite(ready.noise_variance), ready.valid)
    raw = np.sqrt(GAIN**2 * READ**2 + GAIN**2 * (LIGHT + 150) * 0.08)
    assert ready.log.capture.noise == pytest.approx(raw, rel=0.05)  # of an uneven response
    noise = pixel_noise(ready)
    assert "sensor's calibration" in noise.found
    assert noise.counts == pytest.approx(ready.log.capture.noise)


def test_superpixels_have_the_variance_of_their_samples(sensor, found):
    even = {
        n: m[:60] if np.ndim(m) == 2 and m.shape == SHAPE else m for n, m in vars(found).items()
    }
    options = Preparation(bayer="RGGB", demosaicing="superpixel", corner=(2, 8))
    seen = Raw(sensor.raw(0.08).pixels[:60], bits=12)
    ready = prepared(sensor, SensorCalibration(**even), options, seen)
    z = ready.capture - GAIN * LIGHT * 0.08 / FULL / ready.log.capture_divisor
    for channel in range(3):
        here = ready.valid[channel]
        squares = z[channel][here] ** 2 / ready.noise_variance[channel][here]
        assert abs(np.mean(squares) - 1) < 0.15
    mean = [np.mean(one[np.isfinite(one)]) for one in ready.noise_variance]
    assert mean[1] == pytest.approx(mean[0] / 2, rel=0.1)


def test_defective_pixels_are_not_valid_in_a_preparation(sensor, found):
    dead = np.zeros(SHAPE, bool)
    dead[9, 9] = True
    ready = prepared(sensor, found, Preparation(capture_scale="none"), dead=dead)
    assert np.array_equal(ready.valid[0], ~(found.defective | dead))
    assert ready.log.capture.dead == np.count_nonzero(found.defective) + 1
    assert "sensor's calibration at 0.08 s" in ready.log.capture.background


@pytest.mark.parametrize("pixels", [np.ones((5, 6), np.uint16), np.ones((*SHAPE, 3), np.uint16)])
def test_a_preparation_of_other_pixels_is_refused(found, pixels):
    raw = Raw(pixels, bits=12)
    with pytest.raises(MeasurementError, match="same region, binning and pixel format"):
        prepare(raw, raw, background=found, options=Preparation(corner=(1, 4)))


def test_one_exposure_says_nothing_of_another(sensor):
    one = measure_sensor([sensor.taken(0.1)], full_scale=FULL)
    assert not one.dark_rate.any() and not one.dark_rate_error.any()
    assert np.array_equal(one.at(0.1).dark_level, one.dark_level)
    assert abs(one.conversion_gain - GAIN) < 4 * one.conversion_gain_error
    with pytest.raises(MeasurementError, match="all dark frames have 0.1 s .* a second exposure"):
        one.at(0.2)
