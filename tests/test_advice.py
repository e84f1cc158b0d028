"""What a message advises works: the wrong call ends in the advice, and the call that follows it in
what was wanted."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax.imaging.operators import Separable
from thincam_jax.lensless import AccuracyWarning
from thincam_jax.reconstruction import solve_fixed_point
from thincam_jax.units import mm, nm, um

RANDOM = np.random.default_rng(0)
CAPTURE = RANDOM.random((24, 32)).astype(np.float32)
PSF = RANDOM.random((9, 11)).astype(np.float32) ** 4
LIGHT: dict[str, Any] = {"wavelength": 532 * nm, "object_distance": 250 * mm}
ZONES = tc.FresnelZoneAperture(25.0, width=1.2 * mm)
SENSOR = tc.Sensor((24, 32), 40 * um)
CAMERA = tc.LenslessCamera(ZONES, SENSOR, 3 * mm)
SCENE = tc.Scene(tc.ImagePlane([[0.0, 1.0, 0.4]], distance=250 * mm, width=60 * mm), 532 * nm)
PSFS = tc.Recording(CAPTURE[None], tc.Psfs(PSF[None]))
CAMERAS = tc.Recording(CAPTURE[None], tc.Cameras([CAMERA], **LIGHT))
FEW = tc.AdmmTV(iterations=3)
FLATCAM = Separable(
    RANDOM.random((2, 24, 10)).astype(np.float32), RANDOM.random((2, 32, 12)).astype(np.float32)
)


@dataclass(frozen=True)
class Case:
    """A call that is refused or warned of, words of its advice, and the call that follows them."""

    advice: str
    wrong: Callable[[], Any]
    followed: Callable[[], Any]


def solved(capture: Any) -> Any:
    """The objective's minimiser under jit."""
    problem = tc.Recording(capture[None], tc.Psfs(PSF[None])).problem()
    start = jnp.zeros((1, 1, *problem.operators[0].in_shape[-2:]), capture.dtype)
    return solve_fixed_point(problem, start, iterations=3).image


def fine_zones() -> tc.LenslessCamera:
    mask = tc.FresnelZoneAperture(1000.0, width=100 * mm)
    return tc.LenslessCamera(mask, tc.Sensor((48, 80), 1 * mm), 0.65 * mm)


def bright(camera: tc.LenslessCamera) -> tc.LenslessCamera:
    return replace(camera, sensor=tc.Sensor((24, 32), 40 * um, angular_response=2.0))


CASES = {
    "a seed of noise": Case(
        "pass key=seed, such as key=0",
        lambda: tc.capture(CAMERA, SCENE, noise=tc.GaussianNoise(snr_db=30.0)),
        lambda: tc.capture(CAMERA, SCENE, noise=tc.GaussianNoise(snr_db=30.0), key=0),
    ),
    "the light of cameras": Case(
        "give tc.Cameras(cameras, wavelength=…, object_distance=…)",
        lambda: tc.Recording(CAPTURE[None], [CAMERA]),
        lambda: tc.Recording(CAPTURE[None], tc.Cameras([CAMERA], **LIGHT)),
    ),
    "a PSF as the imaging model": Case(
        "give tc.Cameras(…), tc.Psfs(…), or operators",
        lambda: tc.Recording(CAPTURE[None], PSF[None]),
        lambda: tc.Recording(CAPTURE[None], tc.Psfs(PSF[None])),
    ),
    "focusing measured PSFs": Case(
        "give a recording with tc.Cameras(…)",
        lambda: PSFS.focused(200.0),
        lambda: CAMERAS.focused(200.0),
    ),
    "reconstruction inside jit": Case(
        "use tc.reconstruction.solve_fixed_point there",
        lambda: jax.jit(lambda g: tc.reconstruct(replace(PSFS, captures=(g[None],)), FEW).image)(
            jnp.asarray(CAPTURE)
        ),
        lambda: jax.jit(solved)(jnp.asarray(CAPTURE)),
    ),
    "a filter of measured PSFs": Case(
        "with measured PSFs or operators use AdmmTV, Fista, Ridge or PoissonTV",
        lambda: tc.reconstruct(PSFS, tc.Wiener()),
        lambda: [
            tc.reconstruct(PSFS, solver)
            for solver in (FEW, tc.Fista(iterations=3), tc.Ridge(), tc.PoissonTV(iterations=3))
        ],
    ),
    "a check of cameras": Case(
        "give a recording with tc.Psfs",
        lambda: tc.check_psf(CAMERAS),
        lambda: tc.check_psf(
            tc.Recording(RANDOM.random((1, 32, 40)), tc.Psfs(PSF[None])), search=0.02
        ),
    ),
    "a refinement of operators": Case(
        "give a recording with tc.Psfs",
        lambda: tc.refine(tc.Recording(CAPTURE, FLATCAM)),
        lambda: tc.refine(
            tc.Recording(RANDOM.random((1, 32, 40)), tc.Psfs(PSF[None])), parameters=["turn"]
        ),
    ),
    "a response that the axis leaves out": Case(
        "give model=PsfMethod(field_tolerance=1.0)",
        lambda: tc.capture(bright(CAMERA), SCENE),
        lambda: tc.capture(bright(CAMERA), SCENE, model=tc.PsfMethod(field_tolerance=1.0)),
    ),
    "channels of a measured PSF": Case(
        "average the PSF's with `psf_channels='mean'`",
        lambda: prepared(),
        lambda: prepared(psf_channels="mean"),
    ),
    "the history of a closed form": Case(
        "give the result of an iterative solver, such as tc.AdmmTV()",
        lambda: tc.plot.history(tc.reconstruct(CAMERAS, tc.Wiener())),
        lambda: tc.plot.history(tc.reconstruct(PSFS, FEW)),
    ),
    "a denoiser": Case(
        "give 'shipped'",
        lambda: tc.PlugAndPlay(denoiser="drunet"),
        lambda: tc.PlugAndPlay(denoiser="shipped"),
    ),
    "several lengths of correlation": Case(
        'ridge="sure" or "gcv", which choose among them',
        lambda: tc.Ridge(0.1, correlation=(1.0, 2.0)),
        lambda: tc.Ridge("gcv", correlation=(1.0, 2.0)),
    ),
    "a ridge to choose for several terms": Case(
        "give a number, or one term (truncated(terms=1).operator)",
        lambda: tc.reconstruct(tc.Recording(CAPTURE, FLATCAM), tc.Ridge("gcv")),
        lambda: tc.reconstruct(
            tc.Recording(CAPTURE, FLATCAM.truncated(terms=1).operator), tc.Ridge("gcv")
        ),
    ),
    "modes of several terms": Case(
        "give those of one, truncated(terms=1).operator",
        lambda: FLATCAM.with_modes().modes.seen(jnp.asarray(CAPTURE)),
        lambda: FLATCAM.truncated(terms=1).operator.with_modes().modes.seen(jnp.asarray(CAPTURE)),
    ),
    "zones whose phase single precision does not hold": Case(
        "give PsfMethod('separable', precision='float64')",
        lambda: tc.psf(
            fine_zones(),
            **LIGHT,
            model=tc.PsfMethod("separable", "float32"),
            pixel_integration=False,
        ),
        lambda: tc.psf(
            fine_zones(),
            **LIGHT,
            model=tc.PsfMethod("separable", precision="float64"),
            pixel_integration=False,
        ),
    ),
}


def prepared(**options: Any) -> Any:
    psf = measured.Raw(np.repeat(CAPTURE[..., None], 3, axis=-1), name="psf.tif")
    return measured.prepare(
        psf,
        measured.Raw(CAPTURE[..., None], name="raw.tif"),
        background=0.0,
        options=measured.Preparation(**options),
    )


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_advice_can_be_followed(case):
    with pytest.raises(Exception, match=".") as caught, warnings.catch_warnings():
        warnings.simplefilter("error")
        case.wrong()
    assert case.advice in " ".join(str(caught.value).split())
    with warnings.catch_warnings():
        warnings.simplefilter("error", AccuracyWarning)
        case.followed()
