"""Calls of depth, operators, targets, metrics, figures and files, for `hostile_calls.py`."""

from collections.abc import Callable
from typing import Any

import numpy as np
from hostile_table import (
    BEHIND,
    IMAGE,
    PSF,
    RANDOM,
    SENSOR,
    THROUGH,
    TWO,
    WAVE,
    ZONES,
    Call,
    call,
    camera,
    seen,
)
from matplotlib import pyplot

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax.imaging import metrics, operators, targets
from thincam_jax.imaging.metrics.mtf import (
    cut_off,
    first_common_zero,
    low_frequency_value,
    zero_crossings,
)
from thincam_jax.imaging.metrics.usaf import resolved_element, usaf_contrast
from thincam_jax.imaging.operators.low_rank import low_rank_psf
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.imaging.targets.patterns import point_grid, slanted_edge
from thincam_jax.imaging.targets.usaf import line_pair, usaf1951_elements
from thincam_jax.lensless.masks import MaskBlank, maximum_length_sequence
from thincam_jax.lensless.masks.phase import voronoi_fresnel
from thincam_jax.lensless.phase_shift import harmonic_otf
from thincam_jax.measured import calibration
from thincam_jax.measured.exposures import ExposedFrames, merge_exposures
from thincam_jax.reconstruction import depth
from thincam_jax.reconstruction.depth.find import depth_of_colours, focus_measure, object_regions
from thincam_jax.reconstruction.depth.refocus import RefocusSweep
from thincam_jax.waveguide.measured.screen_fit import GhostPositions


def drawn(function: Callable[..., Any], **given: Any) -> Call:
    """The call of a figure, which is closed again."""

    def inner(**given: Any) -> None:
        try:
            function(**given)
        finally:
            pyplot.close("all")

    inner.__qualname__ = f"plot.{function.__name__}"
    return call(inner, **given)


def compared(image: Any, truth: Any) -> Any:
    return tc.plot.compare({"image": image, "scene": IMAGE}, truth=truth)


def streamed(captures: Any) -> Any:
    return tc.Stream(seen()(), tc.AdmmTV(0.5, iterations=4)).next(captures)[1]


THREE = np.array([100.0, 200.0, 300.0])
SWEEP = RefocusSweep(RANDOM.random((3, 9, 12)), THREE, np.float64(0.01))
DEPTHS = (
    call(depth.refocus_distances, nearest=100.0, farthest=300.0, count=3),
    call(depth.axial_resolution, camera=camera(), object_distance=250.0),
    call(
        depth.refocus_sweep,
        recording=call(
            tc.Recording,
            captures=IMAGE[None],
            imaging_model=call(tc.Psfs, psfs=RANDOM.random((1, 1, 3, 7, 5))),
            noise_variance=0.01,
        ),
        distances=THREE,
        solver=call(tc.Ridge, ridge=1e-2),
    ),
    call(
        focus_measure,
        image=IMAGE,
        measure="gradient_energy",
        smoothing=1.0,
        window=None,
        region=np.ones((9, 12), bool),
    ),
    call(
        depth.find_distances,
        sweep=SWEEP,
        measure="laplacian_variance",
        smoothing=1.0,
        regions=np.ones((9, 12), int),
        prominence=0.1,
    ),
    call(object_regions, sweep=SWEEP, threshold=0.25, smoothing=1.0, least=2),
    call(
        depth.all_in_focus,
        sweep=SWEEP,
        depth=call(depth.depth_map, sweep=SWEEP, smoothing=1.0, window=2.0),
        smoothing=2.0,
    ),
    call(depth_of_colours, images=RANDOM.random((3, 2, 9, 12)), distances=[100.0, 200, 300]),
)
CHART, ELEMENTS = targets.usaf1951((64, 80), layers=1), usaf1951_elements(layers=1)
CURVE = {"frequency": np.linspace(0, 5, 60), "response": np.cos(np.linspace(0, 5, 60))}
PICTURES = (
    call(point_grid, shape=(9, 12), count=(2, 3)),
    call(targets.siemens_star, shape=(9, 12), spokes=8),
    call(slanted_edge, shape=(9, 12), angle=0.1, low=0.1, high=0.9),
    call(
        targets.usaf1951, shape=(9, 12), layers=2, polarity="bright_on_dark", pixels_per_chart=9.0
    ),
    call(usaf1951_elements, layers=2, first_group=-2),
    call(line_pair, element=ELEMENTS[0], width=64.0),
    call(targets.resize, image=IMAGE, shape=(5, 6)),
    call(targets.sample_image, name="camera"),
    call(metrics.align, image=IMAGE, reference=IMAGE[::-1]),
    call(
        resolved_element,
        records=call(
            usaf_contrast,
            image=CHART,
            elements=ELEMENTS,
            pixels_per_chart=64.0,
            polarity="bright_on_dark",
        ),
        threshold=0.1,
    ),
    call(low_frequency_value, **CURVE),
    call(cut_off, **CURVE, part=0.05),
    call(zero_crossings, **CURVE),
    call(first_common_zero, frequency=CURVE["frequency"], responses=[CURVE["response"]]),
)
PARTS = (
    call(
        operators.CropConvolution,
        kernel=PSF,
        pitch=0.1,
        sensor_shape=(9, 12),
        field_shape=(9, 12),
        summed=0,
        window=(16, 20),
    ),
    call(
        low_rank_psf,
        psfs=RANDOM.random((2, 3, 7, 5)),
        pitch=0.1,
        sensor_shape=(9, 12),
        field_shape=(9, 12),
        tolerance=0.1,
        positions=None,
    ),
    call(operators.Separable, left=RANDOM.random((12, 9)), right=RANDOM.random((15, 12))),
    call(operators.Matrix, matrix=RANDOM.random((6, 12)), in_shape=(3, 4), out_shape=(2, 3)),
)
OPERATORS = (
    *PARTS,
    call(operators.Masked, operator=PARTS[2], valid=np.ones((12, 15), bool)),
    call(Scaled, operator=PARTS[2], gain=2.0),
    call(lambda first, second: operators.Stacked([first, second]), first=PARTS[2], second=PARTS[2]),
)
FIGURES = (
    drawn(tc.plot.psf, camera=camera(), wavelength=WAVE, object_distance=250.0),
    drawn(tc.plot.otf, camera=camera(), wavelength=WAVE, object_distance=250.0),
    drawn(tc.plot.mask, mask=ZONES, wavelength=WAVE, samples=64),
    drawn(tc.plot.capture, image=IMAGE, sensor=SENSOR),
    drawn(compared, image=IMAGE, truth="scene"),
    drawn(
        tc.plot.history,
        result=call(tc.reconstruct, recording=seen(), solver=call(tc.AdmmTV, iterations=4)),
    ),
    drawn(
        tc.plot.landscape,
        values=RANDOM.random((3, 4)),
        across=np.arange(4.0),
        down=np.arange(3.0),
        labels=("a", "b", "c"),
    ),
)
BLANK = call(MaskBlank, shape=(24, 32), pitch=0.01, material=1.5)
FRAMES = RANDOM.integers(0, 4000, (3, 9, 12))
FURTHER = (
    call(tc.Stream, recording=seen(), solver=call(tc.AdmmTV, tau=0.5, iterations=4), steps=2),
    call(streamed, captures=IMAGE[None]),
    call(
        tc.PhaseMask,
        height=np.tile([0.0, 5e-4], (6, 4)),
        pitch=0.01,
        material=1.5,
        amplitude=np.ones((6, 8)),
        centre=(0.1, 0.2),
        fill_factor=0.9,
        interpolation="cells",
    ),
    call(
        voronoi_fresnel,
        key=0,
        blank=BLANK,
        sites=3,
        focal_length=6.0,
        wavelength=WAVE,
        relaxations=2,
    ),
    call(maximum_length_sequence, length=7),
    call(tc.read_mask, path="nothing", cell=0.03),
    call(harmonic_otf, camera=camera(), harmonic=2, wavelength=WAVE, object_distance=250.0),
    call(
        merge_exposures, exposures=[ExposedFrames(0.1, FRAMES, FRAMES // 100)] * 2, full_scale=4095
    ),
    call(
        lambda one, full_scale: merge_exposures([one], full_scale),
        one=call(ExposedFrames, exposure=0.1, frames=FRAMES, dark=FRAMES // 100),
        full_scale=4095,
    ),
    call(
        calibration.fit_screen,
        measured=call(
            GhostPositions,
            pixels=RANDOM.random((4, 2)),
            points=RANDOM.random((4, 2)),
            orders=[0, 1, 2, 1],
            deviation=0.1,
        ),
        camera=THROUGH,
        plane=BEHIND,
        parameters=("lens_distance",),
        orders=3,
        samples=2,
    ),
    call(calibration.recover_matrix, captures=TWO),
    call(measured.write_image, path="nothing/a.png", image=TWO[:1], log={"a": 1.0}, gamma=2.2),
)

IMAGES = (*DEPTHS, *PICTURES, *OPERATORS, *FIGURES, *FURTHER)
