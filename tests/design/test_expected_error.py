"""Expected error of PSFs: written out in NumPy, beside the closed form, and its slope."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss

import thincam_jax as tc
from thincam_jax.design import PhotonNoise, PowerLaw, Setup, SignalNoise
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.design.objectives import bayes_error, channels
from thincam_jax.design.setup import Quadrant

PITCH, WIDTH, FAR, ACROSS = 0.04, 1.92, 100.0, 60.0


def setup(noise=None, **changed):
    given = {"noise": noise or PhotonNoise(1e5, 20.0), "prior": PowerLaw(2.5)} | changed
    return Setup(PITCH, WIDTH, FAR, ACROSS, **given)


def written_out(psfs, grids, distances, light, read, nodes=2):
    """The error from its definition: sums over pixels for each frequency and point of the field."""
    field, farthest = ACROSS / FAR, max(distances)
    highest = farthest / (4 * PITCH)
    nu = np.arange(-int(highest * 4), int(highest * 4) + 1) / 4.0  # finer than any fringe
    nu = nu[abs(nu) <= highest]
    prior = (1 + (nu[:, None] ** 2 + nu**2) * field**2) ** -1.25
    density = 0.25 * prior / np.sum(prior * 0.25**2)
    places, weights = leggauss(nodes)
    total, lights, powers = 0.0, np.zeros(len(psfs)), {}
    for i in range(nodes):
        for j in range(nodes):
            for k, (psf, (y, x), d) in enumerate(zip(psfs, grids, distances, strict=True)):
                seen = [
                    np.clip((WIDTH / 2 - abs(a + places[n] * field * d / 2)) / PITCH + 0.5, 0, 1)
                    for n, a in ((i, y), (j, x))
                ]
                part = psf * seen[0][:, None] * seen[1] * PITCH**2
                lights[k] += weights[i] * weights[j] / 4 * part.sum() * (field * d / WIDTH) ** 2
                down, across = (np.exp(-2j * np.pi * np.outer(nu / d, a)) for a in (y, x))
                powers[i, j, k] = abs(down @ part @ across.T) ** 2
    exposure = 1 / len(psfs)
    noise = lights / (light * exposure) + (read / (light * exposure)) ** 2
    for i in range(nodes):
        for j in range(nodes):
            known = sum(
                powers[i, j, k] * d**2 / (noise[k] * PITCH**2) for k, d in enumerate(distances)
            )
            left = np.sum(density / (1 + density * known)) / np.sum(density)
            total += weights[i] * weights[j] / 4 * left
    return total


def test_is_what_its_definition_says():
    """Captures at two distances, on grids that are not square; frequencies half as far apart."""
    rng, distances = np.random.default_rng(0), (3.0, 4.0)
    grids = [tc.Grid((40, 34), PITCH), tc.Grid((50, 60), PITCH)]
    psfs = [rng.random(grid.shape) ** 8 for grid in grids]
    error = ExpectedError(setup(), grids, distances, nodes=2)
    axes = [(np.asarray(grid.y), np.asarray(grid.x)) for grid in grids]
    wanted = written_out(psfs, axes, distances, 1e5, 20.0)
    assert 0.02 < wanted < 0.9
    assert error([jnp.asarray(h) for h in psfs]) == pytest.approx(wanted, rel=0.05)


def test_an_image_made_for_other_psfs():
    """Against a sum over frequencies of filters written out; PSFs of each point of the field."""
    rng, grid = np.random.default_rng(2), tc.Grid((40, 34), PITCH)
    h, other, field = rng.random(grid.shape) ** 8, rng.random(grid.shape) ** 8, ACROSS / FAR
    other = 0.7 * h + 0.3 * other
    error = ExpectedError(setup(), [grid], [3.0], nodes=2, padding=8.0)
    frequency = np.arange(-300, 301) / 300.5 * 3.0 / (4 * PITCH)
    prior = (1 + (frequency[:, None] ** 2 + frequency**2) * field**2) ** -1.25
    density = 0.25 * prior / np.sum(prior * (frequency[1] - frequency[0]) ** 2)
    y, x, places = np.asarray(grid.y), np.asarray(grid.x), leggauss(2)[0] * field * 3.0 / 2

    def seen(psf, i, j):
        inside = [
            np.clip((WIDTH / 2 - abs(a + places[n])) / PITCH + 0.5, 0, 1)
            for n, a in ((i, y), (j, x))
        ]
        return psf * inside[0][:, None] * inside[1] * PITCH**2

    def noise(psfs):
        parts = [seen(h, i, j).sum() for (i, j), h in psfs.items()]
        light = np.mean(parts) * (field * 3.0 / WIDTH) ** 2
        return (light / 1e5 + (20.0 / 1e5) ** 2) * PITCH**2 / 3.0**2

    def spectrum(psf, i, j):
        down, across = (np.exp(-2j * np.pi * np.outer(frequency / 3.0, a)) for a in (y, x))
        return down @ seen(psf, i, j) @ across.T

    def wanted(psfs):
        total, own, assumed = 0.0, noise(psfs), noise(dict.fromkeys(psfs, other))
        for (i, j), psf in psfs.items():
            thought = spectrum(other, i, j)
            filters = thought.conj() / assumed / (1 / density + abs(thought) ** 2 / assumed)
            left = density * abs(1 - filters * spectrum(psf, i, j)) ** 2 + abs(filters) ** 2 * own
            total += np.sum(left) / np.sum(density) / 4
        return total

    points = [(i, j) for i in range(2) for j in range(2)]
    found = error([jnp.asarray(h)], assumed=[jnp.asarray(other)])
    assert found == pytest.approx(wanted(dict.fromkeys(points, h)), rel=0.05)
    assert found > 1.2 * error([jnp.asarray(h)])
    every = rng.random((2, 2, 1, 1)) * h
    found = error([jnp.asarray(every)], assumed=[jnp.asarray(other)])
    assert found == pytest.approx(wanted({p: every[p] for p in points}), rel=0.05)


def test_an_image_made_for_its_own_psfs():
    rng, grids = np.random.default_rng(3), [tc.Grid((40, 34), PITCH), tc.Grid((50, 60), PITCH)]
    psfs = [jnp.asarray(rng.random(grid.shape) ** 8) for grid in grids]
    error = ExpectedError(setup(), grids, [3.0, 4.0])
    assert error(psfs, assumed=psfs) == pytest.approx(float(error(psfs)), rel=1e-9)
    alike = [jnp.broadcast_to(h, (3, 3, *h.shape)) for h in psfs]
    assert error(alike) == pytest.approx(float(error(psfs)), rel=1e-12)


@pytest.mark.parametrize("noise", [PhotonNoise(1e5, 2e3), SignalNoise(25.0)])
def test_without_an_edge_it_is_that_of_the_closed_form(noise):
    # Of read noise, for the closed form takes the light of a plate from its mean alone.
    base = tc.design.shots([18.0, 12.0], 3.0, [0.5], wavelength=5e-4, width=1.6)
    uncut = setup(noise, crop=False)
    known = channels(base, uncut, jnp.eye(2), Quadrant(3.0 / (4 * PITCH), 256))
    sensor = tc.Sensor((512, 512), PITCH)
    cameras = base.cameras(sensor)
    psfs = [tc.psf(camera, wavelength=5e-4, object_distance=FAR) for camera in cameras]
    found = ExpectedError(uncut, [sensor.grid] * 2, [3.0] * 2)(psfs, exposures=[1.0, 1.0])
    assert 10 * np.log10(found / bayes_error(known)) == pytest.approx(0.0, abs=0.1)


def test_slope_batches_and_new_values():
    sensor, traces = tc.Sensor((48, 48), PITCH), []
    errors = [ExpectedError(setup(PhotonNoise(n)), [sensor.grid], [3.0]) for n in (1e4, 1e5)]
    rng = np.random.default_rng(1)
    psf, way = (jnp.asarray(rng.random((48, 48))) for _ in range(2))

    @jax.jit
    def cost(h, error):
        traces.append(1)
        return error([h])

    assert cost(psf, errors[1]) < cost(psf, errors[0])
    assert len(traces) == 1
    slope = jnp.sum(jax.grad(cost)(psf, errors[0]) * way)
    ends = (cost(psf + s * way, errors[0]) for s in (1e-4, -1e-4))
    assert float(slope) == pytest.approx(float(next(ends) - next(ends)) / 2e-4, rel=1e-6)
    both = jax.vmap(lambda h: errors[0]([h]))(jnp.stack([psf, way]))
    assert both[1] == pytest.approx(float(errors[0]([way])), rel=1e-12)


def test_what_it_refuses():
    grid = tc.Grid((8, 8), 3 * PITCH)
    with pytest.raises(ValueError, match=r"at most two pixels, 0\.08 mm"):
        ExpectedError(setup(), [grid], [3.0])
    with pytest.raises(ValueError, match="1 grids and 2 distances"):
        ExpectedError(setup(), [grid], [3.0, 4.0])
