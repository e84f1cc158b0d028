"""Full-colour screens against a direct sum over wavelengths, and against coupled waves."""

import functools
from contextlib import nullcontext

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax import waveguide as wg
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.lensless import AccuracyWarning
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.colours import colour_system
from thincam_jax.waveguide.efficiency import diffraction_efficiency
from thincam_jax.waveguide.rays import pixel_centres
from thincam_jax.waveguide.system import LitPlane

# Of strong films the formula is tested, not what it is an approximation of.
pytestmark = pytest.mark.filterwarnings("ignore:η by Kogelnik:UserWarning")
RECORDED = ((633 * nm, 60 * deg), (532 * nm, 61.2 * deg), (473 * nm, 62 * deg))
INDEX, THICKNESS, GLASS, PINHOLE, GAP, DISTANCE = 1.5, 16 * um, 5.0, 6.0, 10.0, 550.0


def gratings(recorded=RECORDED, modulation=0.012):
    made = {"index": INDEX, "thickness": THICKNESS, "index_modulation": modulation}
    return [wg.VolumeHologram.record(c, 0.0, a, **made) for c, a in recorded]


def bands(width=70 * nm):
    return [wg.ColourBand(c * nm, width) for c in (610, 535, 465)]


def camera(films=None, sensor=None, responses=None, bottom=None, **others):
    sensor = sensor or tc.Sensor((4, 3), 500 * um)
    screens = [wg.Screen(film, GLASS, INDEX, bottom=bottom) for film in films or gratings()]
    cameras = [wg.SeeThroughCamera(screen, sensor, PINHOLE, GAP) for screen in screens]
    return wg.ColourCamera(cameras, responses or bands(), **others)


def plane(shape=(12, 16)):
    return wg.ObjectPlane(shape, DISTANCE, 160.0, (27.0, 0.0))


def coupled_waves(first, second, wavelength, modulation):
    """η of two gratings of one film for light along its normal, TE, by 14 coupled waves.

    Waves R_m = k + m(K₁ − K₂) and S_m = R_m − K₁, with c A′ + jϑA = −jκ Σ of the neighbours A; the
    first grating joins R_m and S_m, the second R_m and S_{m+1}. (Kogelnik's c and ϑ of each.)
    """
    wave, steps = 2 * np.pi * INDEX / wavelength, np.arange(-3, 4)[:, None]
    forward = np.array([0, 0, wave]) + steps * (first - second)
    vectors = np.concatenate([forward, forward - first])
    along = vectors[:, 2] / wave
    matrix = np.diag((wave**2 - np.sum(vectors**2, axis=1)) / (2 * wave)).astype(complex)
    kappa = np.pi * modulation / wavelength
    for n in range(7):
        for other in (n + 7, n + 8)[: 14 - 7 - n]:
            matrix[n, other] = matrix[other, n] = kappa
    through = scipy.linalg.expm(-1j * matrix / along[:, None] * THICKNESS)
    ahead, back = np.flatnonzero(along > 0), np.flatnonzero(along <= 0)
    sent = np.eye(14)[3][ahead]
    found = np.zeros(14, complex)
    found[back] = -np.linalg.solve(through[np.ix_(back, back)], through[np.ix_(back, ahead)] @ sent)
    return np.abs(along[[10, 11]]) * np.abs(found[[10, 11]]) ** 2


@eqx.filter_jit
def coupled_films(films, guided, waves):
    return films.coupled(guided, waves)


@pytest.mark.parametrize(
    ("second", "modulation", "most", "alone"),
    [
        (473, 0.012, 0.002, 0.002),
        (473, 0.02, 0.004, 0.007),
        (518, 0.012, 0.01, 0.01),
        (520, 0.012, 0.025, 0.05),
        (526, 0.012, 0.14, 0.35),
    ],
)
def test_two_gratings_of_one_film_are_coupled_waves(second, modulation, most, alone):
    """∫η² dλ of both: of two lasers to 0.4 %, worse where bands overlap, as gratings alone are."""
    films = gratings([(c * nm, 61.2 * deg) for c in (532, second)], modulation)
    waves = np.linspace(second - 20, 552, 300) * nm
    vectors = [np.asarray(film.grating) for film in films]
    exact = np.stack([coupled_waves(*vectors, wave, modulation) for wave in waves], axis=1)
    near = f"two gratings {532 - second} nm apart, .* 8.* nm, count .*; record them 14 nm apart"
    with pytest.warns(AccuracyWarning, match=near) if second > 518 else nullcontext():
        both, own = camera(films), jnp.zeros((len(waves), 2))
    for number, vector in enumerate(vectors):
        guided = -waves[:, None] / (2 * np.pi) * vector[:2]
        found = coupled_films(both, jnp.asarray(guided), jnp.asarray(waves))[0][number][0]
        whole = np.sum(exact[number] ** 2)
        assert np.sum(np.asarray(found) ** 2) == pytest.approx(whole, rel=most)
        by_itself = diffraction_efficiency(films[number], own, jnp.asarray(waves))
        assert np.sum(np.asarray(by_itself) ** 2) > whole * (1 + alone)


def kogelnik(K, t, wavelength, modulation=0.012):
    """η for TE and TM, in plain NumPy; t (…, 2), direction cosines in air."""
    wave = 2 * np.pi * INDEX / wavelength
    up = np.sqrt(np.maximum(1 - np.sum(t**2, -1) / INDEX**2, 1e-3))
    s = np.concatenate([t / INDEX, up[:, None]], axis=-1)
    back = K[2] / wave - up
    mismatch = s @ K - K @ K / (2 * wave)
    found = []
    for overlap in (1.0, np.abs(1 - 2 * (s @ K) ** 2 / (K @ K))):
        safe = np.where(back > 1e-9, back, 1)
        nu = np.pi * modulation * THICKNESS / wavelength / np.sqrt(up * safe) * overlap
        xi = mismatch * THICKNESS / (2 * safe)
        root = np.sqrt((nu**2 - xi**2).astype(complex))
        coupled = np.abs(nu * np.sinh(root) / root) ** 2
        found.append(np.where(back > 1e-9, coupled / (1 + coupled), 0))
    return np.stack(found)


def coupled(g, there, own):
    """η of the grating g beside the others, the mean of all orders in which light may meet them."""
    lost = [1 - (1 - eta) * (1 - guided) for eta, guided in zip(there, own, strict=True)]
    others = lost[:g] + lost[g + 1 :]
    steps = (np.arange(50) + 0.5) / 50
    return own[g] * np.mean([np.prod([1 - u * o for o in others], axis=0) for u in steps], axis=0)


def summed(camera, films, pixel, picture, orders, crossed=True):
    """Light of each channel of a pixel, a sum over wavelengths, gratings and orders.

    `picture`: for each primary rows and columns of cells, whose product is its radiance.
    """
    wave = np.arange(400, 720, 0.02) * nm
    slope = -np.asarray(pixel)[::-1] / PINHOLE
    t = slope / np.sqrt(1 + slope @ slope)
    K = [np.asarray(film.grating) for film in films]
    numbers = range(len(K))
    colour = [np.asarray(band(jnp.asarray(wave))) for band in camera.responses]
    size = float(camera.cameras[0].sensor.pitch) * (GAP + DISTANCE) / PINHOLE
    total = np.zeros((2, len(colour)))

    def length(p):
        return p / np.sqrt(np.maximum(INDEX**2 - np.sum(p**2, -1, keepdims=True), 1e-3))

    for out in numbers:
        p = t - wave[:, None] / (2 * np.pi) * K[out][:2]
        guided = (np.sum(p**2, -1) > 1) & (np.sum(p**2, -1) < INDEX**2)
        outside = [p + wave[:, None] / (2 * np.pi) * k[:2] for k in K]
        own = [kogelnik(k, o, wave) for k, o in zip(K, outside, strict=True)]

        ways = [coupled(g, [kogelnik(k, outside[g], wave) for k in K], own) for g in numbers]
        kept = np.prod([1 - eta for eta in own], axis=0)
        for into in numbers if crossed else [out]:
            e = outside[into]
            air = np.sum(e**2, -1)
            sound = guided & (air < 1)
            e = np.where(sound[:, None], e, 0)
            far = DISTANCE * e / np.sqrt(1 - np.sum(e**2, -1, keepdims=True))
            for i in range(orders):
                at = GAP * slope + GLASS * (length(t) + (2 * i + 1) * length(p) + length(e)) + far
                light = np.mean(ways[into] * ways[out] * kept**i, axis=0) * sound
                for c, response in enumerate(colour):
                    weight = light * response * 0.02 * nm
                    total[1, c] += sum(np.sum(weight * primary) for primary in colour)
                    for (rows, columns), primary in zip(picture, colour, strict=True):
                        seen = weight * primary
                        for axis, cells in ((0, columns), (1, rows)):
                            edge = np.arange(len(cells) + 1) - len(cells) / 2
                            added = np.concatenate([[0], np.cumsum(cells)])
                            place = (at[:, axis] - (0.0, 27.0)[axis]) / 10.0
                            ends = [np.interp(place + h * size / 20, edge, added) for h in (1, -1)]
                            seen = seen * (ends[0] - ends[1]) / (size / 10)
                        total[0, c] += seen.sum()
    return total


@pytest.mark.thorough
@pytest.mark.parametrize("crosstalk", ["all", "bands"])
def test_captures_are_sums_over_wavelengths(crosstalk):
    """Of 12 pixels and 3 colours, of 2 orders and 9 ways through the gratings."""
    random, films = np.random.default_rng(4), gratings()
    picture = [(random.uniform(size=12), random.uniform(size=16)) for _ in range(3)]
    both = camera(films)
    operator = colour_system(both, plane(), 2, 32, crosstalk)
    found = operator(jnp.stack([jnp.outer(*p)[None] for p in picture]))
    pixels = np.asarray(pixel_centres(both.cameras[0])).reshape(-1, 2)
    way = functools.partial(summed, both, films, crossed=crosstalk == "all")
    light, level = np.moveaxis([way(pixel, picture, 2) for pixel in pixels], 1, 0)
    expected = (light / level.mean(axis=0)).T.reshape(found.shape)
    assert relative_l2(found, expected) < 3e-3
    assert adjoint_error(operator, jax.random.key(1)) < 1e-13
    own = colour_system(both, plane(), 2, 32, "none")
    assert relative_l2(own(jnp.stack([jnp.outer(*p)[None] for p in picture])), found) > 0.05


@pytest.mark.thorough
def test_a_plan_says_whether_cross_talk_matters():
    """True errors at most the predicted ones; sharper responses need no cross-talk."""
    sensor, picture = tc.Sensor((16, 12), 130 * um), sample_image("astronaut", linear=True)
    picture = np.moveaxis(resize(picture, (12, 16)), -1, 0)
    lit = LitPlane(plane(), picture)
    edge = wg.Rectangle((20.0, 0.0), (40.0, 400.0))
    for width, tolerance, crosstalk in ((70 * nm, 3e-3, "all"), (30 * nm, 0.3, "none")):
        both = camera(sensor=sensor, responses=bands(width), bottom=edge)
        plan = wg.plan_screen(both, lit, tolerance=tolerance)
        counts = 4, 32, "all", plan.level  # the bottom hologram ends after three
        exact = colour_system(both, plan.plane, *counts)(jnp.asarray(picture)[:, None])
        found = plan.system()(jnp.asarray(picture, plan.precision)[:, None])
        true = relative_l2(np.asarray(found, float), exact)
        assert true <= plan.predicted_error <= max(8 * true, 1e-4)
        assert plan.meets_tolerance and plan.crosstalk == crosstalk
        assert f"cross-talk  {crosstalk}: " in str(plan)
    with pytest.raises(ValueError, match=r"images are .*12, 16.*; give \(3, 'y', 'x'\), of one"):
        wg.plan_screen(both, LitPlane(plane(), picture[0]), tolerance=0.1)
