"""A screen calibrated with Hadamard patterns: its matrix, the rays behind it, other distances."""

import math
import shutil
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax import waveguide as wg
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.screen import figures
from thincam_jax.commands.screen.build import (
    Captured,
    Setup,
    build_cameras,
    build_model,
    capture,
    rounded,
    undo,
)
from thincam_jax.commands.screen.config import CalibrationConfig
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import Matrix, ReducedMatrix, Scaled, Sparse
from thincam_jax.measured.calibration import (
    HadamardSeries,
    ScreenFit,
    create_captures,
    fit_screen,
    recover_matrix,
    simulate_captures,
)
from thincam_jax.measured.calibration.screen_fit import PARAMETERS

_SHOWN = 3  # cells whose columns are drawn, and say how large the noise is


class Known(eqx.Module):
    """A matrix, measured or modelled, and what reconstructions need of it.

    - `matrix`: a `Matrix` or `Sparse`. `counts`: its unit, where a model has 1.
    """

    matrix: Any
    reduced: ReducedMatrix
    counts: float

    @classmethod
    def of(cls, matrix: Matrix | Sparse, counts: float = 1.0) -> "Known":
        return cls(matrix, ReducedMatrix.of(matrix), counts)

    def seen(self, captured: Captured) -> Captured:
        """Captures in the matrix' unit, as `ReducedMatrix` takes them."""
        variance = captured.variance.reshape(*captured.variance.shape[:1], -1).mean(axis=1)
        images = self.reduced.project(self.matrix, self.counts * captured.images)
        return Captured(images, self.counts**2 * variance)


def measure(setup: Setup, system: Sparse, folder: RunFolder) -> Known:
    """The matrix of a camera from its captures of Hadamard patterns, stored in the run's folder."""
    options = _options(setup)
    plane, sensor = setup.plane, setup.camera.sensor
    brightest = float(jnp.max(system(jnp.ones(plane.shape, system.values.dtype))))
    counts = options.exposure * (2**options.bits - 1 - options.offset) / brightest
    path = folder.path / f"captures-{float(plane.distance):g}mm.zarr"
    shutil.rmtree(path, ignore_errors=True)  # of an interrupted run
    key = jax.random.fold_in(jax.random.key(setup.config.seed), int(1000 * plane.distance))
    with create_captures(path, _series(setup), sensor.shape, bits=options.bits) as writer:
        captures = simulate_captures(
            writer, Scaled(system, counts), key, deviation=options.noise, offset=options.offset
        )
    matrix = recover_matrix(captures)
    if not options.keep_captures:
        shutil.rmtree(path)
    return Known.of(matrix, counts)


def _options(setup: Setup) -> CalibrationConfig:
    options = setup.config.calibration
    assert options is not None  # this file is for runs that have one
    return options


def _series(setup: Setup) -> HadamardSeries:
    options = _options(setup)
    return HadamardSeries(setup.plane.shape, options.order, options.display, options.dark_frames)


@dataclass(frozen=True, eq=False)
class Columns:
    """What the sensor sees of some cells alone, in counts, measured and exact.

    - `cells`: (row, column) of each.
    """

    cells: list[tuple[int, int]]
    measured: Float[np.ndarray, "cell y x"]
    exact: Float[np.ndarray, "cell y x"]


class Calibration:
    """The calibration of a run, step by step; `metrics` grows with them."""

    def __init__(self, setup: Setup, system: Sparse, folder: RunFolder):
        self.setup, self.folder, self.options = setup, folder, _options(setup)
        began = time.perf_counter()
        self.measured = measure(setup, system, folder)
        seconds = time.perf_counter() - began
        self.columns = _columns(self.measured, system, setup.plane.shape)
        noise = self.columns.measured - self.columns.exact
        rounding = 1 / 12  # variance of whole numbers, in counts
        of_a_cell = 2 if self.options.display == "complementary" else 4
        spread = of_a_cell * (self.options.noise**2 + rounding) / math.prod(setup.plane.shape)
        self.metrics: dict[str, Any] = {
            "frames": _series(setup).frame_count,
            "seconds": round(seconds, 2),
            "largest_counts": round(float(self.columns.exact.max()), 3),
            "noise_counts": round(float(noise.std()), 5),
            "expected_noise_counts": round(math.sqrt(spread), 5),
            "distances": {},
        }
        self.fitted: ScreenFit | None = None
        self.images: dict[str, dict[str, np.ndarray]] = {}  # by distance and matrix

    def fit_screen(self) -> None:
        """The screen from the matrix, which is let go of: another of its size may be measured."""
        setup = self.setup
        began = time.perf_counter()
        fit = fit_screen(
            self.measured.matrix,
            self._assumed(),
            setup.plane,
            self.options.fitted,
            orders=setup.config.orders,
            samples=setup.config.band_samples,
        )
        self.fitted, true = fit, _true_values(setup)
        self.metrics["fit"] = {
            "status": fit.status,
            "reasons": list(fit.reasons),
            "explained": round(float(fit.explained), 4),
            "seconds": round(time.perf_counter() - began, 2),
            "values": {
                name: {
                    "found": float(value),
                    "standard_error": float(fit.standard_errors[name]),
                    "true": true.get(name),
                    "unit": PARAMETERS[name][0],
                }
                for name, value in fit.values.items()
                if name != "gain"
            },
        }
        del self.measured

    def _assumed(self) -> wg.SeeThroughCamera:
        """What the camera is taken for before the fit: straight where its tilt is to be found."""
        (camera,) = build_cameras(self.setup.config, self.options.glass_thickness)
        known = [name not in self.options.fitted for name in ("plate_x", "plate_y")]
        return eqx.tree_at(lambda c: c.tilt, camera, jnp.where(jnp.asarray(known), camera.tilt, 0))

    def look_from(self, distance: float) -> None:
        """Targets at another distance, by the last method: from the fit, and measured there."""
        assert self.fitted is not None  # an earlier step
        config = self.setup.config
        plane = wg.ObjectPlane(
            self.setup.plane.shape, distance, self.setup.plane.width, self.setup.plane.centre
        )
        there = replace(self.setup, plane=plane)
        true = build_model(there, config.models[0])
        captured, samples = capture(there, true), config.band_samples
        fitted = self.fitted.system(plane)
        assumed = wg.system_operator(self._assumed(), plane, config.orders, samples)
        assert isinstance(fitted.operator, Sparse)
        # All reduced, so that one compiled program serves them.
        ways = {
            "exact model": partial(Known.of, true),
            "measured there": partial(measure, there, true, self.folder),
            "from the fit": partial(Known.of, fitted.operator),
            "as assumed": partial(Known.of, assumed),
        }
        scores, self.images[f"{distance:g} mm"] = {}, {}
        for name, made in ways.items():  # one after another, for the memory
            known = made()
            result = undo(known.reduced, config.methods[-1], known.seen(captured))
            images = np.asarray(result.image, float).reshape(-1, *plane.shape)
            self.images[f"{distance:g} mm"][name] = images
            found = [psnr(i, t.image) for i, t in zip(images, there.targets, strict=True)]
            scores[name] = {
                "mean_psnr_db": rounded(float(np.mean(found))),
                "targets": {
                    t.config.name: rounded(score)
                    for t, score in zip(there.targets, found, strict=True)
                },
            }
        self.metrics["distances"][f"{distance:g} mm"] = scores

    def save_figures(self) -> None:
        """Columns of the matrix, and the targets at other distances."""
        images = {"measured": self.columns.measured, "exact": self.columns.exact}
        pitch = float(self.setup.camera.sensor.pitch)
        figures.save_columns(self.folder, pitch, self.columns.cells, images)
        if self.images:
            figures.save_distances(self.folder, self.setup, self.images, self.metrics["distances"])


def _columns(measured: Known, system: Sparse, shape: tuple[int, int]) -> Columns:
    """Of cells spread along a diagonal of the object."""
    rows, columns = ((2 * np.arange(_SHOWN) + 1) * n // (2 * _SHOWN) for n in shape)
    cells = rows * shape[1] + columns
    lit = np.zeros((_SHOWN, math.prod(shape)))
    lit[np.arange(_SHOWN), cells] = measured.counts
    exact: Array = system(jnp.asarray(lit.reshape(-1, *shape), system.values.dtype))
    found = np.asarray(measured.matrix.matrix[:, cells], float).T
    places = [(int(row), int(column)) for row, column in zip(rows, columns, strict=True)]
    return Columns(places, found.reshape(exact.shape), np.asarray(exact, float))


def _true_values(setup: Setup) -> dict[str, float]:
    """Of the simulated screen, what `fit_screen` can find."""
    camera, plane = setup.camera, setup.plane
    hologram = camera.screen.hologram
    x, y, z = (float(number) for number in hologram.grating)
    return {
        "glass_thickness": float(camera.screen.glass_thickness),
        "lens_distance": float(camera.lens_distance),
        "focal_distance": float(camera.focal_distance),
        "slant": math.atan2(math.hypot(x, y), z),
        "tilt": math.atan2(x, -y),
        "film_thickness": float(hologram.thickness),
        "index_modulation": float(hologram.index_modulation),
        "plate_x": float(camera.tilt[0]),
        "plate_y": float(camera.tilt[1]),
        "object_distance": float(plane.distance),
        "object_x": float(plane.centre[0]),
        "object_y": float(plane.centre[1]),
    }
