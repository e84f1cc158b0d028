"""Masks of square cells that cast shadows: drawn, optimised, and their expected error by NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize


class ShadowJudge:
    """Expected error of captures through masks of cells, on the frequencies of a problem.

    Written out from the definition: the best linear image of Σ_k |H_k|²/η_k, H the Fourier
    integral of the cells' shadows. A mask has two quadrants of frequencies that differ.
    """

    def __init__(self, problem, cells):
        data = problem.best_data
        setup, axis = data.setup, np.asarray(data.frequencies.axis, float)
        distance, width = float(problem.space.base.distance[0]), float(problem.space.base.width)
        side = width * (1 + distance / float(setup.object_distance))
        self.cell = side / cells
        places = (np.arange(cells) - (cells - 1) / 2) * self.cell
        u = axis / distance
        waves = np.exp(-2j * np.pi * u[:, None] * places) * self.cell
        average = np.sinc(float(setup.pitch) * u) if setup.pixel_integration else np.ones_like(u)
        self.waves = waves * (np.sinc(self.cell * u) * average)[:, None]
        field = float(setup.object_width) / float(setup.object_distance)
        self.seen = min(1.0, field * distance / side) ** 2
        noise = setup.noise
        self.counted, self.read = float(noise.electrons), float(noise.read_noise)
        self.per_noise = distance**2 / float(setup.pitch) ** 2
        prior = (1 + (axis[:, None] ** 2 + axis**2) * field**2) ** -(
            float(setup.prior.exponent) / 2
        )
        weight = np.asarray(data.frequencies.weight, float)
        self.weight = weight * prior / np.sum(weight * prior)
        self.spectrum = float(setup.contrast) ** 2 * prior / np.sum(weight * prior)

    def variance(self, masks, exposures):
        """Of a pixel, mm⁴."""
        light = self.seen * self.cell**2 * masks.sum((-2, -1))
        counted = self.counted * exposures
        return light / counted + (self.read / counted) ** 2

    def power(self, masks):
        """|H|² of both quadrants, pixel averages included."""
        across = np.asarray(masks, float) @ self.waves.T
        return [np.abs(rows @ across) ** 2 for rows in (self.waves, self.waves.conj())]

    def error(self, masks, exposures=1.0, power=None):
        """Of masks (..., capture, y, x) of transmittances 0 to 1, whose power may be known."""
        known = self.per_noise / self.variance(np.asarray(masks, float), exposures)
        left = 0.0
        for one in self.power(masks) if power is None else power:
            ratio = self.spectrum * np.sum(known[..., None, None] * one, axis=-3)
            left = left + np.sum(self.weight / (1 + ratio), axis=(-2, -1)) / 2
        return left

    @functools.cached_property
    def _slope(self):
        """Logarithm of the error of one mask and its derivative with respect to the cells."""
        parts = jnp.asarray(np.stack([self.waves.real, self.waves.imag]))
        known = self.per_noise * self.spectrum

        @jax.jit
        @jax.value_and_grad
        def error(mask):
            (rr, ri), (ir, ii) = jnp.einsum("avy,yx,bux->abvu", parts, mask, parts)
            one, other = (rr - ii) ** 2 + (ri + ir) ** 2, (rr + ii) ** 2 + (ri - ir) ** 2
            light = self.seen * self.cell**2 * jnp.sum(mask)
            ratio = known / (light / self.counted + (self.read / self.counted) ** 2)
            left = self.weight / (1 + ratio * one) + self.weight / (1 + ratio * other)
            return jnp.log(jnp.sum(left) / 2)

        return error

    def descended(self, start, steps):
        """The mask where a descent over all cells ends, within 0 to 1."""

        def cost(cells):
            value, slope = self._slope(cells.reshape(start.shape))
            return float(value), np.asarray(slope, float).ravel()

        given = {"jac": True, "bounds": [(0.0, 1.0)] * start.size, "options": {"maxiter": steps}}
        return scipy.optimize.minimize(cost, start.ravel(), **given).x.reshape(start.shape)


def drawn_mask(rng, cells):
    """A mask of a random kind, of random sizes, not empty."""
    kinds = (_random_cells, _zones, _smooth, _redundant, _contours, _opening, _pinholes)
    mask = kinds[rng.integers(len(kinds))](rng, cells)
    if rng.random() < 0.2:
        other = kinds[rng.integers(len(kinds))](rng, cells)
        mask = mask * other if rng.random() < 0.5 else np.maximum(mask, other)
    mask = np.clip(mask, 0, 1)
    return mask if mask.any() else _opening(rng, cells)


def _within(pattern, cells, rng):
    """Patterns larger than the mask are cropped, smaller ones put at a random place."""
    pattern = pattern[:cells, :cells]
    top, left = (rng.integers(cells - n + 1) for n in pattern.shape)
    mask = np.zeros((cells, cells))
    mask[top : top + pattern.shape[0], left : left + pattern.shape[1]] = pattern
    return mask


def _random_cells(rng, cells):
    side = int(rng.integers(1, 1 + max(1, cells // 4)))
    across = int(rng.integers(1, 1 + max(1, cells // side)))
    opened = rng.random((across, across)) < np.exp(rng.uniform(np.log(0.01), 0))
    return _within(np.kron(opened, np.ones((side, side))), cells, rng)


def _radius_squared(cells, rng):
    axis = np.linspace(-1, 1, cells)
    y, x = rng.normal(size=2) * 0.2
    return (axis[:, None] - y) ** 2 + (axis - x) ** 2


def _zones(rng, cells):
    phase = np.exp(rng.uniform(0, np.log(2 * cells))) * _radius_squared(cells, rng)
    wave = np.cos(phase + rng.uniform(0, 2 * np.pi))
    return (
        np.asarray([(wave > rng.uniform(-0.9, 0.9)), ((1 + wave) / 2) ** 2])[rng.integers(2)] * 1.0
    )


def _noise(rng, cells):
    f = np.fft.fftfreq(cells)
    fineness = np.exp(rng.uniform(np.log(1 / cells), np.log(0.5)))
    envelope = np.exp(-(f[:, None] ** 2 + f**2) / (2 * fineness**2))
    noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=(cells, cells))) * envelope).real
    return (noise - noise.mean()) / noise.std()


def _smooth(rng, cells):
    return np.clip(0.5 + rng.normal() * 0.5 + rng.uniform(0.1, 1) * _noise(rng, cells), 0, 1)


def _contours(rng, cells):
    noise = _noise(rng, cells)
    return (np.abs(noise - rng.normal()) < np.exp(rng.uniform(-3, 0))) * 1.0


def _redundant(rng, cells):
    """A MURA: open where the Legendre symbols of row and column are equal."""
    primes = [p for p in (3, 5, 7, 11, 13, 17, 23, 31, 43, 61, 101) if p <= cells]
    p = int(rng.choice(primes))
    symbol = np.full(p, -1)
    symbol[(np.arange(p) ** 2) % p] = 1
    pattern = np.equal.outer(symbol, symbol) * 1.0
    pattern[0], pattern[:, 0] = 0, 1
    pattern[0] = 0
    times, side = int(rng.integers(1, 3)), int(rng.integers(1, 1 + cells // p))
    return _within(np.kron(np.tile(pattern, (times, times)), np.ones((side, side))), cells, rng)


def _opening(rng, cells):
    high, wide = (int(np.exp(rng.uniform(0, np.log(cells + 1)))) for _ in range(2))
    return _within(np.ones((high, wide if rng.random() < 0.5 else high)), cells, rng)


def _pinholes(rng, cells):
    mask = np.zeros((cells, cells))
    side = int(rng.integers(1, 5))
    for _ in range(int(np.exp(rng.uniform(0, np.log(cells))))):
        mask = np.maximum(mask, _within(np.ones((side, side)), cells, rng))
    return mask
