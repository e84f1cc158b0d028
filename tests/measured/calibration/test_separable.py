"""FlatCam from stripes, Hadamard stripes and known images: noise, scale, sign, second terms."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from helpers import quick, relative_l2
from thincam_jax.imaging.operators import Separable
from thincam_jax.imaging.operators.separable import centred
from thincam_jax.measured.calibration.hadamard import hadamard_pattern
from thincam_jax.measured.calibration.separable import calibrate_separable, fit_separable

SENSOR, FIELD = (22, 27), (8, 16)


@functools.cache
def camera(terms=1, overfills=True):
    """Of binary codes: with two terms the mask (1 + c dᵀ)/2, which may end on the sensor."""
    rng = np.random.default_rng(4)

    def shadows(size, scene):
        places = np.arange(size)[:, None] - np.arange(scene) + scene
        codes = [2.0 * rng.integers(0, 2, size + scene + 1) - 1]
        uniform = np.ones(size + scene + 1)
        if not overfills:
            uniform[[*range(scene + 4), *range(size - 3, size + scene + 1)]] = 0
        return np.stack([code[places] for code in [*codes, uniform][:terms]]) / size**0.5

    return Separable(shadows(SENSOR[0], FIELD[0]), shadows(SENSOR[1], FIELD[1]))


def stripes(operator, signs=lambda n: np.eye(n)):
    """Captures of each row and of each column, or of patterns of them."""
    m, n = FIELD
    return [
        np.asarray(operator(jnp.asarray(images)))
        for images in (
            np.repeat(signs(m)[:, :, None], n, axis=2),
            np.repeat(signs(n)[:, None, :], m, axis=1),
        )
    ]


def hadamard(n):
    return np.stack([hadamard_pattern(k, (n, 1))[:, 0] for k in range(n)]).astype(float)


def difference(found, truth):
    """Of the products, since P and Q have a common scale."""
    pairs = [np.einsum("kym,kxn->ymxn", o.left, o.right) for o in (found, truth)]
    return relative_l2(*pairs)


@pytest.mark.parametrize("shown", ["stripes", "hadamard"])
def test_stripes_give_the_camera(shown):
    """Exactly without noise, sign and scale included; in whole counts and float32 too."""
    captures = stripes(camera(), hadamard if shown == "hadamard" else np.eye)
    found = calibrate_separable(*captures, shown=shown)
    assert difference(found.operator, camera()) < 1e-12
    assert found.residual < 1e-7 and found.status == "ok" and not found.reason
    single = calibrate_separable(*(c.astype(np.float32) for c in captures), shown=shown)
    assert single.operator.left.dtype == jnp.float32
    assert difference(single.operator, camera()) < 1e-5


def test_the_shared_factor_holds_where_single_stripes_drown():
    """And Hadamard stripes less than single ones, by about 2/√n for ±1 from two frames."""
    rng = np.random.default_rng(1)
    noise = 3 * np.std(stripes(camera())[0])

    def noisy(signs):
        return [c + noise * rng.normal(size=c.shape) for c in stripes(camera(), signs)]

    single, several = noisy(np.eye), noisy(hadamard)
    together = calibrate_separable(*single)
    assert not together.reason
    alone = []
    for stack in (single[0], np.swapaxes(single[1], 1, 2)):
        parts = [np.linalg.svd(c, full_matrices=False) for c in stack]
        signs = [np.sign(v[0] @ parts[0][2][0]) for _, _, v in parts]
        alone.append(
            np.stack(
                [k * u[:, 0] * s[0] for k, (u, s, _) in zip(signs, parts, strict=True)], axis=1
            )
        )
    clean = [np.asarray(part[0]) for part in (camera().left, camera().right)]
    ours = [np.asarray(part[0]) for part in (together.operator.left, together.operator.right)]
    for mine, theirs, truth in zip(ours, alone, clean, strict=True):
        assert off(mine, truth) < 0.9 * off(theirs, truth)
    found = calibrate_separable(*several, shown="hadamard").operator
    assert difference(found, camera()) < 0.6 * difference(together.operator, camera())


def off(found, truth):
    """Relative difference at the best scale."""
    scale = np.sum(found * truth) / np.sum(found**2)
    return np.linalg.norm(scale * found - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize("overfills", [True, False])
def test_centring_is_right_only_if_the_shadow_overfills_the_sensor(overfills):
    """Else a term is left and reported, and a fit of two terms has it."""
    truth = camera(2, overfills)
    plain = calibrate_separable(*stripes(truth))
    assert "centre the captures" in plain.reason
    rows, columns = (np.asarray(centred(jnp.asarray(c))) for c in stripes(truth))
    found = calibrate_separable(rows, columns)
    assert (not found.reason) == overfills
    assert (difference(found.operator, truth.centred()) < 1e-10) == overfills


def test_known_images_give_all_terms():
    """From a camera that is a little off."""
    truth, rng = camera(2, False), np.random.default_rng(2)
    images = jnp.asarray(rng.uniform(size=(6, *FIELD)))
    captures = truth(images)
    near = [part * (1 + 0.1 * rng.normal(size=part.shape)) for part in (truth.left, truth.right)]
    start = Separable(*near)
    found = fit_separable(images, captures, start, tolerance=1e-9)
    assert found.residual < 1e-4
    assert difference(found.operator, truth) < 1e-2 * difference(start, truth)
    few = fit_separable(images, captures, start, iterations=1)
    assert few.status == "iterations_exhausted" and few.residual > found.residual


def test_bad_input():

    images = jnp.ones((2, *FIELD))
    with pytest.raises(ValueError, match="2 images do not tell one camera"):
        fit_separable(images, camera()(images), camera())


def blind(scale, offset, blur, shading):
    """Shadows of one code, `scale` pixels apart: Toeplitz for a scale of 1 without shading."""
    parts = []
    for number, (size, scene) in enumerate(zip(SENSOR, FIELD, strict=True)):
        code = np.repeat(np.random.default_rng(number).choice([-1.0, 1.0], 60), 4)
        code = scipy.ndimage.gaussian_filter1d(code, blur)
        y, m = ((np.arange(n) - (n - 1) / 2)[:, None] for n in (size, scene))
        places = 2 * (scale * (y + m.T) + offset) + 120
        shadow = scipy.ndimage.map_coordinates(code, [places], order=1)
        shadow *= 1 - shading * ((2 * y / size) ** 2 + (2 * m.T / scene) ** 2) / 2
        parts.append(shadow[None] / size**0.5)
    return Separable(*parts)


def scenes(kind, count, seed=1):
    images = np.random.default_rng(seed).uniform(size=(count, *FIELD))
    if kind == "smooth":  # hardly any fine detail, as in photographs
        images = scipy.ndimage.gaussian_filter(images, (0, 1.5, 1.5))
        images = (images - images.min()) / np.ptp(images)
    return images


def correlation_of_a_scene(operator, truth, glare):
    """Of a scene that no fit has seen, reconstructed by the best of some ridges."""
    image = scenes("smooth", 1, seed=8)[0]
    seen = lit(truth, image[None], glare, 50.0, seed=9)[0].ravel()
    left, right = (np.asarray(part[0]) for part in (operator.left, operator.right))
    matrix = np.kron(left, right)
    gram, size = matrix.T @ matrix, np.trace(matrix.T @ matrix) / image.size
    found = [
        np.linalg.solve(gram + ridge * size * np.eye(len(gram)), matrix.T @ seen)
        for ridge in 10.0 ** -np.arange(6)
    ]
    return max(np.corrcoef(f, image.ravel())[0, 1] for f in found)


def lit(truth, images, glare, snr_db, seed=3):
    """Captures with glare, which no P and Q make, and noise."""
    seen = np.asarray(truth(jnp.asarray(images)))
    seen = seen + glare * scipy.ndimage.gaussian_filter(np.abs(seen), (0, 4, 4))
    noise = np.std(seen) * 10 ** (-snr_db / 20)
    return seen + noise * np.random.default_rng(seed).normal(size=seen.shape)


FAR, NEAR = (1.0, 0.0, 1.0, 0.0), (1.009, 0.3, 2.8, 0.25)


@pytest.mark.parametrize(
    ("kind", "count", "start", "glare", "gain"),
    quick(
        [
            ("random", 8, FAR, 0.0, 0.1),
            ("smooth", 8, FAR, 0.0, 0.0),
            ("random", 8, NEAR, 0.2, -1e-3),
            ("smooth", 8, NEAR, 0.2, -1e-3),
        ],
        *(0, 3),
    ),
)
def test_a_fit_is_never_worse_than_its_start(kind, count, start, glare, gain):
    """The correlation of another scene grows from a bad start; glare does not spoil a good one."""
    truth, start = blind(1.01, 0.4, 3.0, 0.3), blind(*start)
    images = scenes(kind, count)
    captures = lit(truth, images, glare, 40.0)
    found = fit_separable(jnp.asarray(images), jnp.asarray(captures), start, iterations=50)
    before, after = (correlation_of_a_scene(o, truth, glare) for o in (start, found.operator))
    assert after >= before + gain


@pytest.mark.thorough
def test_single_precision_ends_in_numbers():
    """Nearly uniform images make the equations singular in float32, not in double."""
    rng = np.random.default_rng(5)
    truth = Separable(*(rng.uniform(size=(1, n, 256)) for n in (20, 24)))
    images = 1 + 1e-4 * rng.uniform(size=(4, 256, 256))
    captures = np.asarray(truth(jnp.asarray(images)))
    images, captures = (jnp.asarray(a, jnp.float32) for a in (images, captures))
    found = fit_separable(images, captures, truth, iterations=5)
    assert found.operator.left.dtype == jnp.float32
    assert bool(jnp.isfinite(found.operator.left).all() & jnp.isfinite(found.operator.right).all())
