"""A PSF of a wrong scale, turned or mirrored, is told from a capture alone; a right one is not."""

from dataclasses import dataclass, replace

import jax
import numpy as np
import pytest
import scipy

import thincam_jax as tc
from helpers import in_full
from thincam_jax._core.grids import block_sum
from thincam_jax.reconstruction.psf_check import ORIENTATIONS, blocks_blur

SHAPE = (96, 128)
SMALL = (48, 64)


@dataclass(frozen=True)
class Camera:
    """A capture with the noise of electrons and counts, and its PSF at any scale."""

    capture: np.ndarray
    pattern: object  # irradiance at (y, x), pixels
    electrons: float
    is_symmetric: bool = False
    seed: int = 0

    def psf(self, scale=1.0, undone_by=0):
        """As measured: 12 bits, four times the light of the capture.

        On a sensor that is turned or mirrored so that that number of `ORIENTATIONS` undoes it.
        """
        generator = np.random.default_rng(self.seed)
        shape = self.capture.shape
        y, x = coordinates((max(shape),) * 2)
        clean = np.rot90(self.pattern(y / scale, x / scale), -(undone_by % 4))
        clean = clean[:, ::-1] if undone_by >= 4 else clean
        top, left = ((max(shape) - n) // 2 for n in shape)
        clean = clean[top : top + shape[0], left : left + shape[1]]
        light = 4 * self.electrons
        psf = generator.poisson(0.9 * light * clean / clean.max()) / light
        psf = np.round(4095 * psf)
        return psf / psf.sum()

    def check(self, psf, **settings):
        return tc.check_psf(tc.Recording(self.capture[None], tc.Psfs(psf[None])), **settings)


def camera(seed, pattern, shape, *, bits=10, electrons=10_000.0, **known):
    """One that sees random ellipses and boxes, partly beyond the field in front of the sensor."""
    generator = np.random.default_rng(seed)
    field = tuple(2 * n - 1 for n in shape)
    image = scene(generator, field, shape)
    psf = pattern(*coordinates(tuple(2 * n for n in shape)))
    whole = scipy.signal.fftconvolve(image, psf / psf.sum())
    first = [(k + f - s - 1) // 2 for k, f, s in zip(psf.shape, field, shape, strict=True)]
    seen = whole[first[0] : first[0] + shape[0], first[1] : first[1] + shape[1]]
    seen = 0.9 * np.maximum(seen, 0) / seen.max()
    read = 5 * generator.normal(size=shape)
    noisy = (generator.poisson(seen * electrons) + read) / electrons
    full = 2**bits - 1
    capture = np.clip(np.round(full * noisy), 0, full) / full
    return Camera(capture, pattern, electrons, seed=seed, **known)


def scene(generator, field, shape):
    y, x = coordinates(field)
    image = np.zeros(field)
    count, reach = ((6, 0.45), (40, 0.45), (30, 0.7))[generator.integers(3)]
    for _ in range(count):
        centre = generator.uniform(-reach, reach, 2) * shape
        radius = generator.uniform(0.02, 0.15) * min(shape)
        turn, flat = generator.uniform(0, np.pi), generator.uniform(0.2, 1)
        u = (y - centre[0]) * np.cos(turn) + (x - centre[1]) * np.sin(turn)
        v = ((x - centre[1]) * np.cos(turn) - (y - centre[0]) * np.sin(turn)) / flat
        inside = np.hypot(u, v) if generator.random() < 0.5 else np.maximum(abs(u), abs(v))
        image[inside < radius] = generator.uniform(0.1, 1)
    return scipy.ndimage.gaussian_filter(image, 0.5)


def coordinates(shape):
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    return y[:, None], x[None, :]


def spots(generator, shape, widths=(1, 2), count=150):
    """A diffuser of Gaussian spots."""
    width = generator.uniform(*widths)
    centres = generator.uniform(-0.44, 0.44, (count, 2)) * shape
    powers = generator.exponential(1, count)

    def pattern(y, x):
        rows, columns = (
            np.exp(-((a.ravel()[:, None] - c) ** 2) / (2 * width**2))
            for a, c in zip((y, x), centres.T, strict=True)
        )
        return (rows * powers) @ columns.T

    return pattern


def caustics(generator, shape):
    """A diffuser's bright lines, vignetted towards the edge."""
    fine = 3
    size = [int(1.5 * n * fine) for n in shape]
    surface = scipy.ndimage.gaussian_filter(
        generator.normal(size=size), generator.uniform(1.5, 3) * fine
    )
    lines = np.exp(-generator.uniform(2, 4) * np.abs(surface) / surface.std())
    lines = scipy.ndimage.gaussian_filter(lines, 0.7 * fine)

    def pattern(y, x):
        rows, columns = np.broadcast_arrays(y, x)
        place = [fine * r + (n - 1) / 2 for r, n in zip((rows, columns), size, strict=True)]
        light = scipy.ndimage.map_coordinates(lines, place, mode="nearest")
        return np.maximum(light, 0) * np.exp(-((np.hypot(y / shape[0], x / shape[1]) / 0.4) ** 4))

    return pattern


def zones(generator, shape):
    """A zone aperture's shadow on the sensor; it has no orientation."""
    edge = 0.47 * min(shape)
    beta = np.pi / (generator.uniform(4, 8) * edge)
    phase = generator.uniform(0, 2 * np.pi)

    def pattern(y, x):
        radius = np.hypot(y, x)
        return (1 + 0.9 * np.cos(beta * radius**2 + phase)) / (1 + np.exp((radius - edge) / 0.7))

    return pattern


@pytest.fixture(scope="module")
def diffuser():
    return camera(1, spots(np.random.default_rng(1), SMALL), SMALL)


@pytest.mark.thorough
def test_right_psf_is_not_doubted(diffuser):
    seen = []
    found = diffuser.check(diffuser.psf(), callback=lambda done, of: seen.append((done, of)))
    assert found.fits and found.orientation == "as given"
    assert abs(found.scale - 1) < 0.004
    assert seen[-1][0] == seen[-1][1] == len(seen)
    assert min(found.objectives) == 1 and list(found.scales) == sorted(found.scales)


def test_wrong_scale_and_orientation_are_named(diffuser):
    found = diffuser.check(diffuser.psf(scale=1.03, undone_by=6))
    assert found.orientation == ORIENTATIONS[6]
    assert abs(found.scale - 1 / 1.03) < 0.005
    assert len(found.reasons) == 2 and "times its size" in found.reasons[1]


@pytest.mark.thorough
@pytest.mark.parametrize("number", range(1, 8))
def test_every_orientation_is_named(diffuser, number):
    """Where it is a quarter turn, a part of the PSF was beside the sensor as it was measured."""
    found = diffuser.check(diffuser.psf(undone_by=number), search=0.01)
    assert found.orientation == ORIENTATIONS[number]
    assert found.reasons == (f"it fits better {found.orientation}",)


@pytest.mark.thorough
def test_scale_beyond_the_search_is_said(diffuser):
    found = diffuser.check(diffuser.psf(scale=1.1), search=0.04)
    assert "or beyond: search farther" in " ".join(found.reasons)


@pytest.mark.thorough
def test_zones_have_no_orientation():
    rig = camera(2, zones(np.random.default_rng(2), SMALL), SMALL)
    assert rig.check(rig.psf(undone_by=2)).orientation == "as given"


def test_what_cannot_be_checked_is_said(diffuser):
    psf = diffuser.psf()
    with pytest.raises(ValueError, match="measured PSFs of one plane"):
        tc.check_psf(
            tc.Recording(diffuser.capture[None], tc.Psfs(np.stack([psf, psf])[None, None]))
        )
    with pytest.raises(ValueError, match="at least 32 a side"):
        tc.check_psf(tc.Recording(diffuser.capture[None, :20], tc.Psfs(psf[None])))
    with pytest.raises(ValueError, match="search = 0.7 is too wide"):
        diffuser.check(psf, search=0.7)
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda g: tc.check_psf(tc.Recording(g, tc.Psfs(psf[None]))))(diffuser.capture[None])


@pytest.mark.parametrize("count", in_full(20, 60))
def test_rates_over_random_cameras(optimised, count):
    """Wrong scales from 1 % on, turns and mirror images: 95 % named; 2 % false alarms at most."""
    wrong, missed, right, alarms = rates(count)
    assert len(missed) <= 0.05 * wrong, missed
    assert len(alarms) <= 0.02 * right, alarms


def rates(count):
    """Faults, those missed, what is right, and false alarms, over random cameras."""
    wrong, missed, right, alarms = 0, [], 0, []
    for seed in range(count):
        generator = np.random.default_rng(seed)
        kind = (spots, caustics, zones)[seed % 3]
        rig = camera(
            seed,
            kind(generator, SHAPE),
            SHAPE,
            bits=int(generator.choice([8, 10, 12])),
            electrons=float(generator.choice([3e3, 1e4, 3e4])),
            is_symmetric=kind is zones,
        )
        scale = float(generator.choice([1, 1, 0.97, 0.99, 1.01, 1.03]))
        number = int(generator.choice([0] * 5 + list(range(1, 8))))
        found = rig.check(rig.psf(scale, undone_by=number))
        turned = ORIENTATIONS[0 if rig.is_symmetric else number]
        scaled = any("times its size" in reason for reason in found.reasons)
        cases = [(turned != "as given", found.orientation == turned)]
        if number % 2 == 0 or rig.is_symmetric:  # else a part of the PSF is missing
            cases.append((scale != 1, scaled and abs(found.scale * scale - 1) < 0.01))
        for is_wrong, is_named in cases:
            wrong += is_wrong
            right += not is_wrong
            if is_wrong and not is_named:
                missed.append((seed, scale, turned, found))
        if (scale == 1 and scaled) or (turned == "as given" != found.orientation):
            alarms.append((seed, scale, turned, found))
    return wrong, missed, right, alarms


def faulty(seed):
    """A capture with what no PSF explains: glare, 8 bit, and pixels coarser than the detail."""
    kind = (spots, caustics, zones)[seed % 3]
    rig = camera(seed, kind(np.random.default_rng(seed), SHAPE), SHAPE, bits=12)
    veil = scipy.ndimage.gaussian_filter(rig.capture, 15, mode="nearest")
    y, x = coordinates(SHAPE)
    lamp = np.exp(-((y / 96 - 0.3) ** 2 + (x / 128 + 0.4) ** 2) / 0.05)
    light = 0.75 * rig.capture + 0.1 * veil / veil.max() + 0.05 * lamp
    return replace(rig, capture=np.round(255 * block_sum(light, 2) / 4) / 255)


@pytest.mark.thorough
def test_errors_hold_where_the_model_does_not():
    """Of scales from PSFs 3 % too small, right and 3 % too large: in the interval, and agreeing."""
    outside, total = [], 0
    for seed in range(4):
        rig, found = faulty(seed), []
        fine = replace(rig, capture=np.zeros(SHAPE))
        for start in (0.97, 1.0, 1.03):
            one = rig.check(block_sum(fine.psf(start), 2))
            found.append([start * scale for scale in one.interval])
            outside += [(seed, start, one)] if not found[-1][0] < 1 < found[-1][1] else []
            total += 1
        assert max(low for low, _ in found) < min(high for _, high in found), found
    assert len(outside) <= 0.1 * total, outside


def test_blocks_that_keep_a_psf_are_enough():
    smooth = scipy.ndimage.gaussian_filter(np.random.default_rng(0).random((1, 90, 70)), (0, 4, 4))
    assert not blocks_blur(smooth, 1)
    assert blocks_blur(smooth, 8)
