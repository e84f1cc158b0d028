"""Do masks pass the limit? 10,000 drawn ones, 100 descents over all cells, and all of 4 × 4 cells.

`nice -n 5 python -m pytest benchmarks/test_limit.py -s`, some minutes. On the camera of
docs/measured/limit.md with pixels of 44 µm.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.ndimage
from shadow_masks import ShadowJudge, drawn_mask

from thincam_jax.design import (
    BayesError,
    DesignSpace,
    PhotonNoise,
    PowerLaw,
    Setup,
    Variable,
    design_problem,
    shots,
)
from thincam_jax.design.least_error import limit
from thincam_jax.design.objectives import ObjectiveData
from thincam_jax.design.setup import Quadrant

LIGHTS = {"little": PhotonNoise(4e3, 64.0), "plenty": PhotonNoise(204_800.0, 64.0)}
LIGHTS["plenty, no read noise"] = PhotonNoise(204_800.0, 0.0)


def problem(noise, width=5.632, count=80):
    base = shots([25.0], 6.5, [0.0], wavelength=500e-6, width=width)
    setup = Setup(0.044, 5.632, 250.0, 179.0, noise=noise, prior=PowerLaw(2.8), crop=False)
    space = DesignSpace(base, (Variable("beta", 5.0, 30.0, (0,)),))
    searched = design_problem(BayesError(), space, setup, np.eye(1))
    frequencies = Quadrant(searched.best_data.frequencies.highest, count)
    return replace(searched, exact=ObjectiveData(setup, searched.data.synthesis, frequencies))


def report(light, found, above, masks):
    print(
        f"\n{light}: {found.decibels:.2f} dB, gap {found.gap:.0e}, light {found.transmission:.3f}; "
        f"{len(above)} {masks}: {min(above):.2f} dB above at least, median {np.median(above):.2f}"
    )
    assert min(above) > 0
    assert 0 <= found.gap < 0.05


def test_no_drawn_mask_passes_the_limit():
    problems, rng = (
        {light: problem(noise) for light, noise in LIGHTS.items()},
        np.random.default_rng(0),
    )
    above = {light: [] for light in LIGHTS}
    found = {light: limit(searched) for light, searched in problems.items()}
    for cells in (16, 32, 64, 128):
        judges = {light: ShadowJudge(searched, cells) for light, searched in problems.items()}
        for _ in range(2500):
            mask = drawn_mask(rng, cells)[None]
            power = judges["little"].power(mask)
            for light, judge in judges.items():
                above[light].append(found[light].above(judge.error(mask, power=power)))
    for light in LIGHTS:
        report(light, found[light], above[light], "drawn masks")


def test_no_optimised_mask_passes_the_limit():
    """Descents over all of 64 × 64 cells, from drawn masks and from grey noise."""
    rng = np.random.default_rng(1)
    for light, number in zip(LIGHTS, (34, 33, 33), strict=True):
        searched, above = problem(LIGHTS[light]), []
        judge, found = ShadowJudge(searched, 64), limit(searched)
        for n in range(number):
            start = np.exp(rng.uniform(-3, 0)) * rng.random((64, 64))
            start = start if n % 2 else np.clip(drawn_mask(rng, 64) + 0.1 * start, 0, 1)
            above.append(found.above(judge.error(judge.descended(start, 120)[None])))
        report(light, found, above, "descents")


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("width", [0.2, 0.5, 1.0])
def test_best_of_all_masks_of_sixteen_cells(light, width):
    """65,535 masks of 4 × 4 cells; 40 samples resolve their fringes."""
    searched = problem(LIGHTS[light], width, count=40)
    judge, bits = ShadowJudge(searched, 4), itertools.product((0.0, 1.0), repeat=16)
    next(bits)
    best = min(
        np.min(judge.error(np.asarray(some).reshape(-1, 1, 4, 4)))
        for some in np.array_split(np.asarray([*bits]), 32)
    )
    above = limit(searched).above(best)
    print(f"\n{light}, {width} mm: {10 * np.log10(best):.2f} dB, {above:.2f} above the limit")
    assert above > 0


@pytest.mark.parametrize("light", ["little", "plenty"])
def test_diffraction_of_cells_as_wide_as_pixels(light):
    """By Fresnel's transfer function, 8 samples a cell: errors, and how bright pixels are."""
    searched, rng = problem(LIGHTS[light], count=128), np.random.default_rng(2)
    judge, found = ShadowJudge(searched, 128), limit(searched)
    opening, dots = np.zeros((128, 128)), rng.random((64, 64)) < 0.3
    opening[63:66, 63:66] = 1.0
    masks = {"opening": opening, "random cells": np.kron(dots, np.ones((2, 2)))}
    masks["by gradient"] = (judge.descended(0.3 * rng.random((128, 128)), 120) > 0.5) * 1.0
    magnification, step = 1 + 6.5 / 250, 5.632 / 1024
    places = (np.arange(2048) - 1023.5) * step * magnification
    u = np.asarray(searched.best_data.frequencies.axis) / 6.5
    waves = np.exp(-2j * np.pi * u[:, None] * places) * np.sinc(0.044 * u)[:, None]
    chirp = np.exp(-1j * np.pi * 5e-4 * 6.5 / magnification * np.fft.fftfreq(2048, step) ** 2)
    for name, mask in masks.items():
        field = np.pad(np.kron(mask, np.ones((8, 8))), 512)
        spectrum = np.fft.fft2(field) * chirp[:, None] * chirp
        psf = np.abs(np.fft.ifft2(spectrum)) ** 2
        across = psf @ waves.T * (step * magnification) ** 2
        power = [np.abs(rows @ across)[None] ** 2 for rows in (waves, waves.conj())]
        shadow, wave = judge.error(mask[None]), judge.error(mask[None], power=power)
        brightest = scipy.ndimage.uniform_filter(psf, 8).max()
        above = f"{found.above(shadow):.2f}, diffracted {found.above(wave):.2f} dB above"
        print(f"\n{light}, {name}: {above}, brightest pixel {brightest:.2f}")
        assert wave > found.error
