"""The cells of experiments/full_size_design.py, judged again with NumPy and SciPy alone."""

import numpy as np
import pytest
import scipy.fft
import skimage.io

from helpers import ROOT

CELLS, CELL, WIDTH, PITCH = 512, 0.011, 5.632, 0.0055
DISTANCE, AWAY, ACROSS, WAVELENGTH = 6.5, 250.0, 179.0, 500e-6
ELECTRONS, READ = 2e5, 8.0
FIELD, SAMPLES, SPAN = ACROSS / AWAY, 6, 640  # samples a cell, cells of the window
MAGNIFICATION = 1 + DISTANCE / AWAY


def irradiance(amplitude):
    """Fresnel diffraction, averaged over half cells on the sensor."""
    count, margin = SPAN * SAMPLES, (SPAN * SAMPLES - amplitude.shape[0]) // 2
    f = scipy.fft.fftfreq(count, CELL / SAMPLES)
    chirp = np.exp(-1j * np.pi * WAVELENGTH * DISTANCE / MAGNIFICATION * f**2)
    wave = scipy.fft.fft2(np.pad(amplitude, margin).astype(np.complex64))
    wave = scipy.fft.ifft2(wave * chirp[:, None].astype(np.complex64) * chirp)
    half = SAMPLES // 2
    return (np.abs(wave) ** 2).reshape(2 * SPAN, half, 2 * SPAN, half).mean((1, 3))


def expected(amplitudes):
    """Error in dB of captures that share the light, at 5 × 5 points of the field."""
    psfs = [irradiance(amplitude) for amplitude in amplitudes]
    step, size, electrons = CELL * MAGNIFICATION / 2, 2048, ELECTRONS / len(amplitudes)
    x = (np.arange(2 * SPAN) - SPAN + 0.5) * step
    v, u = scipy.fft.fftfreq(size, step) * DISTANCE, scipy.fft.rfftfreq(size, step) * DISTANCE
    rows, columns = (abs(f) <= DISTANCE / (4 * PITCH) for f in (v, u))
    v, u = v[rows], u[columns]
    prior = (1 + (v[:, None] ** 2 + u**2) * FIELD**2) ** -1.4
    weight = np.where(u == 0, 1.0, 2.0) * (DISTANCE / (size * step)) ** 2
    density = 0.25 * prior / np.sum(prior * weight)
    average = [np.sinc(PITCH * f / DISTANCE) / np.sinc(step * f / DISTANCE) for f in (v, u)]
    area = average[0][:, None] * average[1] * step**2
    places, weights = np.polynomial.legendre.leggauss(5)
    seen = np.clip((WIDTH / 2 - abs(x + places[:, None] * FIELD * DISTANCE / 2)) / step + 0.5, 0, 1)
    over = np.outer(weights, weights) / 4
    lights = [
        np.sum(over * (seen @ h @ seen.T)) * step**2 * (FIELD * DISTANCE / WIDTH) ** 2 for h in psfs
    ]
    noise = [(light / electrons + (READ / electrons) ** 2) * PITCH**2 for light in lights]
    error = 0.0
    for (i, j), share in np.ndenumerate(over):
        known = 0.0
        for h, variance in zip(psfs, noise, strict=True):
            part = scipy.fft.rfft2(h * seen[i][:, None] * seen[j], (size, size))
            known = known + np.abs(part[rows][:, columns] * area) ** 2 * DISTANCE**2 / variance
        left = density * weight / (1 + density * known)
        error += share * np.sum(left) / np.sum(density * weight)
    return 10 * np.log10(error)


def zone_plate(beta, phase):
    x = (np.arange(CELLS * SAMPLES) - (CELLS * SAMPLES - 1) / 2) * CELL / SAMPLES
    return 0.5 + 0.5 * np.cos(beta * (x[:, None] ** 2 + x**2) + phase)


def opening(cells):
    mask = np.zeros((CELLS, CELLS))
    before = (CELLS - cells) // 2
    mask[before : before + cells, before : before + cells] = 1
    return np.kron(mask, np.ones((SAMPLES, SAMPLES)))


@pytest.mark.thorough
def test_cells_beat_method_b_and_the_best_opening():
    shown = skimage.io.imread(ROOT / "docs/images/full-size-cells.png")
    assert shown.shape == (CELLS, CELLS)
    cells = expected([np.kron((shown > 0) * 1.0, np.ones((SAMPLES, SAMPLES)))])
    openings = [expected([opening(n)]) for n in (6, 8, 10)]
    phases = (0.0, 1.5 * np.pi)
    method_b = expected([zone_plate(beta, p) for beta in (25.0, 21.0) for p in phases])
    assert cells < min(openings) - 4
    assert cells < method_b - 5
