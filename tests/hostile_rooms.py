"""Calls of designs, studies, networks, rigs and calibrations, for `hostile_calls.py` to spoil."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from hostile_table import IMAGE, MASKS, RANDOM, SENSOR, TWO, WAVE, ZONES, call, camera

import thincam_jax as tc
from thincam_jax import design, hardware, learn, measured, studies
from thincam_jax.design.design import Design
from thincam_jax.design.fronts import non_dominated
from thincam_jax.design.match import (
    MatchSettings,
    ResponseModel,
    match_response,
    response_misfit,
    ring_levels,
)
from thincam_jax.design.objectives import (
    Tolerances,
    bayes_error,
    channels,
    limit,
    mismatch_error,
    robust_error,
    unevenness,
    worst_ratio_db,
)
from thincam_jax.design.phase_mask import MaskSetting, mask_of_phase, one_turn
from thincam_jax.design.phase_retrieval import contour_target
from thincam_jax.design.ranking import score_design
from thincam_jax.design.setup import Polar, fit_power_law
from thincam_jax.design.space import Limits
from thincam_jax.hardware import plans
from thincam_jax.hardware.acquisition.plan import AcquisitionPlan, AcquisitionStep
from thincam_jax.hardware.acquisition.taker import find_exposure
from thincam_jax.hardware.base import Region
from thincam_jax.hardware.registry import driver
from thincam_jax.hardware.stages.grbl import GrblStage
from thincam_jax.hardware.stages.zaber import ZaberStage
from thincam_jax.imaging.operators import Separable
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.lensless.masks import MaskBlank
from thincam_jax.measured import calibration
from thincam_jax.measured.bayer import demosaic, demosaic_mask
from thincam_jax.measured.calibration import calibrate_separable
from thincam_jax.measured.calibration.hadamard import hadamard_pattern, walsh_hadamard
from thincam_jax.measured.calibration.start import PsfSearch
from thincam_jax.measured.read import list_captures
from thincam_jax.measured.write import log_text
from thincam_jax.waveguide.design.plate import Plate, Viewing, judge_plate


def space(base: Any, variable: Any, limits: Any) -> design.DesignSpace:
    return design.DesignSpace(base, (variable,), limits)


def at_once(function: Callable[..., Any], *names: str, **fixed: Any) -> Callable[..., Any]:
    """A function or class that takes some of its arguments as a tuple of one."""

    def inner(**given: Any) -> Any:
        return function(**{n: (v,) if n in names else v for n, v in given.items()}, **fixed)

    inner.__qualname__ = function.__qualname__
    return inner


def denoised(network: Any, image: Any, sigma: Any) -> Any:
    return learn.Denoiser.load(network)(image, sigma)


EXPOSURES = call(tc.Exposures, beta=[25.0, 13.0], distance=6.5, wavelength=WAVE, width=5.0)
DESIGN = call(Design, exposures=EXPOSURES)
SETUP = call(
    design.Setup,
    pitch=0.02,
    sensor_width=5.0,
    object_distance=250.0,
    object_width=180.0,
    contrast=0.5,
    noise=call(design.PhotonNoise, electrons=2000.0, read_noise=8.0),
    prior=call(design.PowerLaw, exponent=2.0, corner=3.0),
)
SPACE = call(
    space,
    base=DESIGN,
    variable=call(design.Variable, name="beta", lower=10.0, upper=25.0, captures=(0,)),
    limits=call(Limits, mask_pixel=0.01, thickness=8.0, captures=4, exposure=2.0),
)
RINGS = call(Polar, highest=80.0, count=64, directions=2)
SEEN = {"setup": SETUP, "synthesis": np.eye(2), "frequencies": RINGS}
KNOWN = call(channels, design=DESIGN, **SEEN)
TOLERANCES = call(Tolerances, beta=0.01, distance=0.01, wavelength=1e-5, tilt=0.01)
PROBLEM = call(
    design.design_problem,
    objective=call(design.BayesError),
    space=SPACE,
    setup=SETUP,
    synthesis=np.eye(2),
    counts=call(design.FrequencyCounts, radii=64, directions=1, exact=64),
)
KEY = jax.random.key(3)
RELIEF = call(MaskBlank, shape=(8, 10), pitch=0.05, material=1.5)
DESIGNS = (
    SPACE,
    call(
        design.shots, beta=[25.0, 13.0], distance=6.5, phases=[0.0, 1.0], wavelength=WAVE, width=5
    ),
    call(bayes_error, known=KNOWN),
    call(mismatch_error, known=KNOWN, actual=KNOWN),
    call(limit, known=KNOWN, frequencies=RINGS, ratio=1.0, rings=16),
    *(
        call(f, known=KNOWN, frequencies=RINGS, band=(0.05, 0.5), rings=16)
        for f in (unevenness, worst_ratio_db)
    ),
    call(ring_levels, known=KNOWN, frequencies=RINGS, rings=16),
    call(response_misfit, known=KNOWN, frequencies=RINGS, target=np.ones(8)),
    call(robust_error, design=DESIGN, tolerances=TOLERANCES, how="mean", **SEEN),
    call(score_design, problem=PROBLEM, design=DESIGN, name="a"),
    call(
        design.find_designs,
        problem=PROBLEM,
        settings=call(design.SearchSettings, starts=1, samples=4, steps=2, tolerance=1e-3),
        key=KEY,
    ),
    call(design.landscape_around, problem=PROBLEM, design=DESIGN, count=3, at_a_time=2),
    call(
        match_response,
        model=call(ResponseModel, space=SPACE, **SEEN, rings=8),
        target=np.ones(8),
        settings=call(MatchSettings, starts=1, samples=4, steps=2, tolerance=1e-3),
        key=KEY,
    ),
    call(at_once(fit_power_law, "images"), images=RANDOM.random((32, 40))),
    call(non_dominated, points=RANDOM.random((4, 2)), larger=(True, False)),
    call(MaskSetting, camera=camera(MASKS[-1]), wavelengths=WAVE, field_shape=(5, 6)),
    call(
        mask_of_phase,
        phase=RANDOM.random((8, 10)).astype("f4"),
        blank=RELIEF,
        wavelength=WAVE,
        limits=call(one_turn, blank=RELIEF, wavelength=WAVE, levels=4),
    ),
    call(
        contour_target,
        key=KEY,
        grid=call(tc.Grid, shape=(8, 10), pitch=0.05),
        feature=0.2,
        line_width=0.1,
    ),
    call(
        judge_plate,
        plate=call(Plate, glass_thickness=5.0, film_thickness=0.016, lens_distance=10.0),
        viewing=call(
            Viewing, sensor=SENSOR, object_distance=550.0, object_width=150.0, snr_db=30.0
        ),
    ),
)
METHOD = call(
    studies.Method,
    name="one",
    exposures=call(tc.Exposures, beta=25.0, distance=6.5, wavelength=WAVE, width=1.2),
    solver=call(tc.Wiener),
    synthesis="separate",
    phases=1,
)
TARGET = call(
    studies.Target.of_image, name="a", image=IMAGE, distance=250.0, width=40.0, kind="file"
)
STUDIES = (
    call(
        at_once(studies.superresolution, "targets"),
        betas=(25.0, 21.0),
        distances=(5.0, 6.5),
        sensor=SENSOR,
        targets=TARGET,
        noise=30.0,
        seed=0,
    ),
    call(
        studies.evaluate_target,
        study=call(
            at_once(studies.Study, "methods", "targets"),
            mask=ZONES,
            sensor=SENSOR,
            methods=METHOD,
            targets=TARGET,
            object_distance=250.0,
            noise=call(tc.GaussianNoise, snr_db=30.0),
            model="separable",
            field_tolerance=1.0,
            seed=0,
        ),
        target=TARGET,
    ),
)
LEARNED = (
    call(TrainingOptions, steps=5, rate=1e-3, warm_up=2, averaging=0.9, seed=0, falling=0.5),
    call(denoised, network="shipped", image=IMAGE, sigma=0.1),
    call(tc.PlugAndPlay, denoiser="shipped", strength=1.0, iterations=2, tolerance=1e-3),
)
SETTINGS = call(
    hardware.CameraSettings,
    exposure=0.01,
    region=call(Region, top=0, left=0, height=10, width=12),
    pixel_format="Mono12",
    gain=0.0,
)
PLATE = call(plans.zone_plate, beta=25.0, width=5.0, phase=0.0, profile="cosine")
SERIES = call(calibration.HadamardSeries, object_shape=(2, 4), order="natural", dark_frames=2)
RIGS = (
    call(plans.fringe_scan, mask=PLATE, settings=SETTINGS, dark_frames=2),
    call(
        plans.method_a,
        mask=PLATE,
        distances=[5.0, 6.5],
        settings=SETTINGS,
        stage_zero=1.0,
        dark_frames=1,
    ),
    call(plans.method_b, mask=PLATE, betas=[25.0, 13.0], settings=SETTINGS),
    call(plans.psf_stack, mask=PLATE, depths=[5.0, 6.5], settings=SETTINGS, stage_zero=1.0),
    call(plans.hadamard, series=SERIES, settings=SETTINGS),
    call(
        at_once(AcquisitionPlan, "patterns", "settings", "steps"),
        name="a",
        patterns=PLATE,
        settings=SETTINGS,
        steps=call(AcquisitionStep, pattern=0, position=1.0, settings=0, dark=False),
        facts={"a": 1.0},
    ),
    call(find_exposure, level_at=lambda exposure: 50 * exposure, start=0.01, camera="a"),
    call(driver, kind="cameras", name="pylon"),
    call(GrblStage.Options, port="a", axis="X", speed=1.0, answer_time=1.0),
    call(ZaberStage.Options, port="a", device=1, axis=1, microstep=1e-4, answer_time=1.0),
)
LARGE = RANDOM.random((32, 34))
CALIBRATIONS = (
    call(
        tc.fit_psf,
        psf_image=LARGE,
        camera=call(
            tc.LenslessCamera,
            mask=call(tc.FresnelZoneAperture, beta=25.0, width=1.2),
            sensor=call(tc.Sensor, shape=(32, 34), pitch=0.03),
            distance=6.5,
        ),
        weights=None,
        object_distance=250.0,
        wavelength=WAVE,
        search=call(
            PsfSearch,
            parameters=("beta", "phase"),
            relative=0.1,
            centre=0.05,
            pixel_integration=False,
            max_steps=2,
        ),
    ),
    call(
        calibration.estimate_registration,
        capture=LARGE,
        reference=LARGE,
        scale=1.0,
        search=0.1,
        smoothing=1.0,
        max_steps=2,
    ),
    call(calibrate_separable, rows=TWO, columns=TWO, shown="stripes"),
    call(
        tc.measured.calibration.fit_separable,
        images=RANDOM.random((4, 9, 12)),
        captures=RANDOM.random((4, 12, 15)),
        start=call(Separable, left=RANDOM.random((12, 9)), right=RANDOM.random((15, 12))),
        iterations=2,
        tolerance=1e-3,
    ),
    SERIES,
    call(hadamard_pattern, index=1, object_shape=(2, 4), order="natural"),
    call(walsh_hadamard, values=RANDOM.random((4, 3))),
    call(demosaic, mosaic=RANDOM.random((6, 8)), pattern="RGGB", method="bilinear"),
    call(demosaic_mask, mask=np.ones((6, 8), bool), pattern="RGGB", method="superpixel"),
    call(
        measured.to_display, image=TWO[:1], white_balance="grey_world", gamma=2.2, percentile=99.0
    ),
    call(measured.read_image, path="nothing", bits=12),
    call(list_captures, folder="nothing", bits=12),
    call(log_text, log={"a": 1.0}),
    call(tc.load_image, path="nothing"),
)

ROOMS = (*DESIGNS, *STUDIES, *LEARNED, *RIGS, *CALIBRATIONS)
