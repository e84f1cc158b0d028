"""PSFs that are upside down are found from the captures, and the advice mends the image."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
import scipy.signal

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction import InverseProblem
from thincam_jax.reconstruction.orientation import _mirrored

RNG = np.random.default_rng(5)
SHAPE = (52, 61)
SCENE = np.zeros(SHAPE)
SCENE[16:30, 20:33], SCENE[26:38, 30:44] = 0.6, 1.0
PSF = np.kron(RNG.random((7, 9)) < 0.3, np.ones((3, 3)))
PSF /= PSF.sum()
CLEAN = scipy.signal.fftconvolve(SCENE, PSF, "same")
CAPTURE = CLEAN + 0.004 * CLEAN.max() * RNG.standard_normal(SHAPE)
SOLVER = tc.AdmmTV(iterations=120)
TURNS = {
    "upside down": np.s_[::-1],
    "mirrored left to right": np.s_[:, ::-1],
    "turned by 180°": np.s_[::-1, ::-1],
}


@pytest.mark.parametrize("axes", [(-2,), (-1,), (-2, -1)])
def test_spectra_are_those_of_mirrored_kernels(axes):
    """Exactly so where sensor and field agree in parity, else half a pixel away."""
    kernel, image = RNG.random((1, 1, 5, 7)), jnp.asarray(RNG.random((1, 1, 8, 13)))

    def problem(kernel):
        operator = CropConvolution(jnp.asarray(kernel), 1.0, (12, 17), (8, 13), summed=1)
        return InverseProblem([operator], [jnp.zeros((1, 12, 17))], weights=[1.0])

    mirrored = _mirrored(problem(kernel), axes).operators[0](image)
    expected = problem(np.flip(kernel, axes)).operators[0](image)
    assert relative_l2(mirrored, expected) < 1e-12


@pytest.mark.parametrize("turn", TURNS)
def test_what_is_said_mends_the_image(turn):
    wrong = tc.reconstruct(tc.Recording([CAPTURE], tc.Psfs(PSF[TURNS[turn]][None])), SOLVER)
    assert f"fit far better a PSF that is {turn}; turn the PSF" in wrong.reason
    right = tc.reconstruct(tc.Recording([CAPTURE], tc.Psfs(PSF[None])), SOLVER)
    assert right.reason == ""
    errors = [relative_l2(np.asarray(found.image), SCENE) for found in (right, wrong)]
    assert errors[0] < 0.5 * errors[1]


def test_symmetric_and_otherwise_wrong_psfs_are_not_turned():
    other = scipy.ndimage.gaussian_filter(PSF, 1.2)
    for psf in (other, (other + np.flip(other)) / 2, other + other[::-1]):
        found = tc.reconstruct(tc.Recording([CAPTURE], tc.Psfs(psf[None])), SOLVER)
        assert "turn the PSF" not in found.reason
