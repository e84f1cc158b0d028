"""Calls of the optics and of reconstructions, for `hostile_calls.py` to spoil."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax import waveguide as wg
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.imaging.refractive_index import bk7
from thincam_jax.lensless.masks import MaskBlank, UniformlyRedundantArray, random_cells
from thincam_jax.lensless.masks.phase import diffuser
from thincam_jax.lensless.phase_shift import fringe_scanned_otf, phase_pair_otf
from thincam_jax.plot.explorer import Explorer
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.hologram import refracted
from thincam_jax.waveguide.screen_to_sensor import ghost_images


@dataclass(frozen=True)
class Call:
    """A function and its arguments, which may be calls."""

    function: Callable[..., Any]
    arguments: Mapping[str, Any]

    def paths(self) -> Iterator[tuple[str, ...]]:
        """The places of all arguments, those of inner calls too."""
        for name, value in self.arguments.items():
            yield (name,)
            if isinstance(value, Call):
                yield from ((name, *rest) for rest in value.paths())

    def replaced(self, path: tuple[str, ...], value: Any) -> "Call":
        name, *rest = path
        inner = self.arguments[name]
        if rest and not isinstance(inner, Call):
            return self  # what held it was replaced before
        new = inner.replaced(tuple(rest), value) if rest else value
        return Call(self.function, {**self.arguments, name: new})

    def __call__(self) -> Any:
        return self.function(
            **{n: v() if isinstance(v, Call) else v for n, v in self.arguments.items()}
        )

    def __repr__(self) -> str:
        given = ", ".join(f"{name}={_short(value)}" for name, value in self.arguments.items())
        return f"{self.function.__qualname__}({given})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray | jax.Array) and value.size > 3:
        kind = "NaN" if not np.isfinite(value).all() else f"to {np.max(np.abs(value)):g}"
        return f"<{value.dtype} {value.shape} {kind}>"
    return repr(value)


def call(function: Callable[..., Any], **arguments: Any) -> Call:
    return Call(function, arguments)


RANDOM = np.random.default_rng(5)
IMAGE = RANDOM.random((9, 12))
PSF = RANDOM.random((7, 5))
WAVE = 500 * nm
SENSOR = call(tc.Sensor, shape=(12, 15), pitch=20 * um)
ZONES = call(tc.FresnelZoneAperture, beta=25.0, phase=0.3, width=1.2, profile="cosine")
MASKS = (
    ZONES,
    call(tc.FresnelZoneAperture, beta=25.0, width=1.2, profile="binary", pixel_pitch=0.04),
    call(tc.Pinhole, width=0.1),
    call(tc.RadialMask, rings=np.array([1.0, 0.0, 1.0]), ring=0.1),
    call(tc.ModifiedUniformlyRedundantArray, order=5, cell=0.1),
    call(UniformlyRedundantArray, orders=(5, 3), cell=0.1),
    call(tc.LensletArray, focal_length=5.0, pitch=0.4, shape=(2, 3)),
    call(tc.SampledMask, amplitude=RANDOM.random((6, 8)).round(), pitch=0.1),
    call(tc.SeparableMask, rows=np.array([1.0, 0, 1]), columns=np.array([0, 1.0, 1, 0]), cell=0.1),
    call(random_cells, key=3, width=0.8, cell=0.1, open_fraction=0.4),
    call(
        diffuser,
        key=3,
        blank=call(MaskBlank, shape=(8, 10), pitch=0.05, material=call(bk7)),
        correlation_length=0.2,
        rms_slope=0.05,
    ),
)


def camera(mask: Call = ZONES) -> Call:
    return call(tc.LenslessCamera, mask=mask, sensor=SENSOR, distance=6.5)


def seen(**arguments: Any) -> Call:
    return call(
        tc.Recording,
        captures=IMAGE[None],
        imaging_model=call(tc.Psfs, psfs=PSF[None], field_shape=(9, 12)),
        **arguments,
    )


SCENE = call(
    tc.Scene,
    planes=call(tc.ImagePlane, image=IMAGE, distance=250.0, width=40.0),
    spectrum=call(tc.Spectrum, wavelengths=np.array([450.0, 550.0]) * nm, weights=[0.4, 0.6]),
)
PLANE = call(tc.ImagePlane, image=IMAGE, distance=250.0, width=40.0)
CAMERAS = call(
    lambda first, second, **more: tc.Cameras([first, second], **more),
    first=camera(),
    second=camera(call(tc.FresnelZoneAperture, beta=13.0, width=1.2)),
    wavelength=WAVE,
    object_distance=250.0,
    field_shape=(12, 15),
)
TWO = np.stack([RANDOM.random((12, 15)), RANDOM.random((12, 15))])
HOLOGRAM = call(
    wg.VolumeHologram.record,
    wavelength=532 * nm,
    object_angle=0.0,
    reference_angle=61.2 * deg,
    index=1.5,
    thickness=16 * um,
    index_modulation=0.02,
)
THROUGH = call(
    wg.SeeThroughCamera,
    screen=call(wg.Screen, hologram=HOLOGRAM, glass_thickness=5.0, glass_index=1.5),
    sensor=call(tc.Sensor, shape=(4, 6), pitch=50 * um),
    focal_distance=6.0,
    lens_distance=10.0,
)
BEHIND = call(wg.ObjectPlane, shape=(5, 4), distance=550.0, width=20.0, centre=(15.0, 0.0))
RAW = call(measured.Raw, pixels=(4000 * RANDOM.random((12, 16))).astype(np.uint16), bits=12)


def _blurred(image: Any, sigma: Any) -> Any:
    del sigma
    return (image + image[..., ::-1]) / 2


SOLVERS = (
    call(tc.AdmmTV, tau=1e-3, iterations=4, tolerance=1e-4),
    call(tc.Fista, tau=1e-3, iterations=4),
    call(tc.PoissonTV, tau=1e-3, iterations=4, background=0.1),
    call(tc.Ridge, ridge=1e-2),
    call(tc.PlugAndPlay, denoiser=_blurred, strength=1.0, iterations=2),
    call(tc.Wiener, prior="inverse_square"),
    None,
)
MODELS = ("geometric", "paraxial", "closed_form", "separable", "angular_spectrum")

OPTICS = (
    *(
        call(tc.psf, camera=camera(), wavelength=WAVE, object_distance=t, at=at, model=model)
        for t, at, model in ((250.0, (5.0, 7.0), "separable"), (1e6, (0.0, 9e4), "geometric"))
    ),
    call(
        tc.field_operator,
        camera=camera(),
        light=WAVE,
        object_distance=250.0,
        field_shape=(5, 6),
        tolerance=1.0,
        model="separable",
    ),
    call(Explorer, camera=camera(), scene=IMAGE, wavelength=WAVE, object_distance=250.0),
    *MASKS,
    *(call(tc.psf, camera=camera(m), wavelength=WAVE, object_distance=250.0) for m in MASKS),
    *(
        call(f, camera=camera(), wavelength=WAVE, object_distance=250.0, model=model)
        for f in (tc.psf, tc.otf)
        for model in MODELS
    ),
    call(
        tc.psf,
        camera=camera(),
        wavelength=WAVE,
        model=call(tc.PsfMethod, model="separable", precision="float32", pixel_integration=True),
    ),
    *(
        call(f, camera=camera(), wavelength=WAVE, object_distance=250.0)
        for f in (fringe_scanned_otf, phase_pair_otf)
    ),
    *(
        call(
            tc.choose_model, camera=camera(m), wavelength=WAVE, object_distance=250.0, tolerance=0.1
        )
        for m in MASKS[:5]
    ),
    call(tc.predict_error, camera=camera(), wavelength=WAVE, model="closed_form"),
    call(tc.plan_capture, camera=camera(), scene=SCENE, tolerance=0.1),
    *(
        call(tc.capture, camera=camera(), scene=scene, key=3, noise=noise)
        for scene in (SCENE, PLANE)
        for noise in (
            None,
            call(tc.GaussianNoise, snr_db=30.0),
            call(tc.PoissonGaussianNoise, read_noise=3.0),
        )
    ),
    *(call(tc.reconstruct, recording=seen(), solver=solver, start=None) for solver in SOLVERS),
    *(
        call(
            tc.reconstruct,
            recording=call(tc.Recording, captures=TWO, imaging_model=CAMERAS),
            solver=solver,
        )
        for solver in (*SOLVERS, call(tc.FringeScanning))
    ),
    call(
        tc.reconstruct,
        recording=seen(noise_variance=0.01, valid=np.ones((9, 12), bool)),
        solver=call(tc.Ridge, ridge="noise", correlation=2.0),
    ),
    call(tc.choose_solver, recording=seen()),
    call(tc.check_psf, recording=seen(), search=0.06, tau=2.0),
    call(tc.refine, recording=seen(), parameters=["turn"], search=0.06, tau=0.5),
    call(tc.separable_operator, camera=camera(MASKS[4]), scene=PLANE, tolerance=0.01),
    call(
        measured.prepare,
        psf=call(measured.Raw, pixels=(4000 * PSF.round()).astype(np.uint16), bits=12),
        capture=RAW,
        background=3.0,
        options=call(measured.Preparation, psf_scale=1.0, capture_scale="maximum"),
    ),
    call(
        tc.Exposures,
        beta=[25.0, 13.0],
        distance=6.5,
        phase=[0.0, 1.0],
        wavelength=WAVE,
        width=[5.0, 4.0],
        relative_time=[0.4, 0.6],
    ),
    call(psnr, image=IMAGE, reference=IMAGE[::-1]),
    call(ssim, image=IMAGE, reference=IMAGE[::-1]),
    HOLOGRAM,
    call(
        wg.trace,
        camera=THROUGH,
        pixels=np.array([[0.0, 0.1], [0.3, -0.2]]),
        object_distance=550.0,
        orders=3,
    ),
    call(wg.system_operator, camera=THROUGH, plane=BEHIND, orders=2),
    call(
        ghost_images,
        camera=THROUGH,
        field=np.array([[0.0, 0.1], [0.05, 0.0]]),
        object_distance=550.0,
        orders=3,
    ),
    call(
        wg.distance_from_ghosts,
        camera=call(
            wg.SeeThroughCamera,
            screen=call(wg.Screen, hologram=HOLOGRAM, glass_thickness=5.0, glass_index=1.5),
            sensor=call(tc.Sensor, shape=(20, 22), pitch=100 * um),
            focal_distance=6.0,
            lens_distance=10.0,
        ),
        capture=1 + np.sin(np.indices((20, 22))).sum(axis=0) / 4,
        nearest=200.0,
        farthest=600.0,
        orders=2,
    ),
    call(refracted, angle=0.3, before=1.0, after=1.5),
)
