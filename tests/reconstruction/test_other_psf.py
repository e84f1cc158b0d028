"""PSFs upside down or too large are found from the captures; the advice mends the image."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
import scipy.signal

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.reconstruction.other_psf import _FIT, NEGATIVE, RESIZE, TURN, _mirror, without_size

RNG = np.random.default_rng(5)
SHAPE = (52, 61)
SCENE = np.zeros(SHAPE)
SCENE[16:30, 20:33], SCENE[26:38, 30:44] = 0.6, 1.0
PSF = np.kron(RNG.random((7, 9)) < 0.3, np.ones((3, 3)))
PSF /= PSF.sum()
CLEAN = scipy.signal.fftconvolve(SCENE, PSF, "same")
CAPTURE = CLEAN + 0.004 * CLEAN.max() * RNG.standard_normal(SHAPE)
SOLVER = tc.AdmmTV(iterations=60)
TURNS = {
    "upside down": np.s_[::-1],
    "mirrored left to right": np.s_[:, ::-1],
    "turned by 180°": np.s_[::-1, ::-1],
}


@pytest.mark.parametrize("axes", [(-2,), (-1,), (-2, -1)])
def test_spectra_are_those_of_mirrored_kernels(axes):
    """Exactly so where sensor and field agree in parity, else half a pixel away."""
    kernel, image = RNG.random((1, 1, 5, 7)), jnp.asarray(RNG.random((1, 1, 8, 13)))

    def operator(kernel):
        return CropConvolution(jnp.asarray(kernel), 1.0, (12, 17), (8, 13), summed=1)

    given = operator(kernel)
    spectrum = jnp.asarray(_mirror(axes)(np.asarray(given.spectrum), given.window))
    mirrored = eqx.tree_at(lambda o: o.spectrum, given, spectrum)(image)
    assert relative_l2(mirrored, operator(np.flip(kernel, axes))(image)) < 1e-12


@functools.cache
def as_given():
    return tc.reconstruct(tc.Recording([CAPTURE], tc.Psfs(PSF[None])), SOLVER)


@pytest.mark.parametrize("turn", quick(TURNS, 2))
def test_what_is_said_mends_the_image(turn):
    wrong = tc.reconstruct(tc.Recording([CAPTURE], tc.Psfs(PSF[TURNS[turn]][None])), SOLVER)
    assert f"fit far better a PSF that is {turn}; turn the PSF" in wrong.reason
    assert as_given().reason == ""
    errors = [relative_l2(np.asarray(found.image), SCENE) for found in (as_given(), wrong)]
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize(
    ("noise", "background"), quick([(0.006, None), (0.002, 0.0), (0.006, 0.0), (0.002, None)], 0, 1)
)
def test_inverted_captures_are_named_and_the_advice_mends_the_image(noise, background):
    normal = np.random.default_rng(6).standard_normal(SHAPE)
    capture = CLEAN + noise * CLEAN.max() * normal
    known = {} if background is None else {"background": background}
    full = 1.2 * CLEAN.max()
    wrong = tc.Recording([full - capture], tc.Psfs(PSF[None]), **known)
    negative = tc.reconstruct(wrong, SOLVER)
    assert negative.reason == NEGATIVE and "give full scale minus captures" in NEGATIVE
    found = tc.reconstruct(tc.Recording([full - wrong.captures[0]], tc.Psfs(PSF[None])), SOLVER)
    right = tc.reconstruct(tc.Recording([capture], tc.Psfs(PSF[None])), SOLVER)
    assert found.reason == right.reason == ""
    errors = [relative_l2(one.image, SCENE) for one in (right, found, negative)]
    assert errors[1] < 1.2 * errors[0] < 0.5 * errors[2]


def test_a_psf_of_another_size_is_found():
    larger = np.asarray(scipy.ndimage.zoom(PSF, 1.06, order=1), float)
    recording = tc.Recording([CAPTURE], tc.Psfs(larger[None]))
    found = tc.reconstruct(recording, tc.AdmmTV(iterations=120))
    assert "has 0.94 times the size; refine it" in found.reason


def test_symmetric_and_otherwise_wrong_psfs_are_not_turned():
    other = scipy.ndimage.gaussian_filter(PSF, 1.2)
    for psf in (other, (other + np.flip(other)) / 2, other + other[::-1]):
        found = tc.reconstruct(tc.Recording([CAPTURE], tc.Psfs(psf[None])), SOLVER)
        assert "fit far better" not in found.reason


def test_light_from_outside_takes_the_place_of_another_size_alone():
    """How τ was found stays, and so does a PSF that is turned."""
    rule = "tau = 3.2 by the discrepancy principle"
    larger, turned = f"{_FIT} has 0.94 times the size; {RESIZE}", f"{_FIT} is upside down; {TURN}"
    assert without_size(f"{rule}; {larger}") == rule and without_size(larger) == ""
    assert without_size(f"{rule}; {turned}") == f"{rule}; {turned}"


def test_captures_that_are_no_images_are_not_inverted():
    """Those of a reduced matrix are numbers of either sign, in one row."""
    matrix = Matrix(RNG.standard_normal((40, 64)), (8, 8), (1, 40))
    capture = matrix(jnp.asarray(RNG.random((8, 8)))) + RNG.standard_normal((1, 40))
    recording = tc.Recording([capture], [matrix], noise_variance=1e-4)
    assert NEGATIVE not in tc.reconstruct(recording, tc.Ridge()).reason


@pytest.mark.parametrize("colours", quick([1, 3], 1))
def test_inverted_captures_behind_operators_are_named(colours):
    """By each solver; upright ones, also of a point, are not."""
    random = np.random.default_rng(7)
    sides = [(random.random((n, m)) < 0.5).astype(float) for n, m in ((24, 12), (28, 14))]
    camera, point = Separable(*sides), np.zeros((12, 14))
    point[2, 11] = 1.0
    for image in (resize(sample_image("camera", linear=True), (12, 14)), point):
        light = np.asarray(camera(jnp.asarray(image))) * np.ones((colours, 1, 1))
        light += 0.01 * light.max() * random.standard_normal(light.shape)
        for solver in (tc.Ridge(), tc.Fista(iterations=10)):
            upright = tc.reconstruct(tc.Recording([light], camera), solver)
            assert NEGATIVE not in upright.reason
            if image is not point:
                inverted = tc.reconstruct(tc.Recording([255 - light], camera), solver)
                assert NEGATIVE in inverted.reason
