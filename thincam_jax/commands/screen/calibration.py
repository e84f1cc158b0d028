"""A screen calibrated with Hadamard patterns: its matrix, the rays behind it, other distances."""

import math
import shutil
import time
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax import waveguide as wg
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.screen import build, figures
from thincam_jax.commands.screen.config import CalibrationConfig
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import Matrix, ReducedMatrix, Scaled, Sparse
from thincam_jax.measured import calibration as measuring
from thincam_jax.measured.calibration.screen_fit import PARAMETERS
from thincam_jax.studies.evaluate import rounded

_SHOWN = 3  # cells whose columns are drawn, and say how large the noise is


def diagonal(shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Cells (row, column) spread along a diagonal of the object."""
    rows, columns = ((2 * np.arange(_SHOWN) + 1) * n // (2 * _SHOWN) for n in shape)
    return [(int(row), int(column)) for row, column in zip(rows, columns, strict=True)]


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

    def seen(self, captured: build.Captured) -> build.Captured:
        """Captures in the matrix' unit, as `ReducedMatrix` takes them."""
        variance = captured.variance.reshape(*captured.variance.shape[:1], -1).mean(axis=1)
        images = self.reduced.project(self.matrix, self.counts * captured.images)
        return build.Captured(images, self.counts**2 * variance)


def measure(setup: build.Setup, system: Sparse, folder: RunFolder) -> Known:
    """The matrix of a camera from its captures of Hadamard patterns, stored in the run's folder."""
    options = _options(setup)
    plane, sensor = setup.plane, setup.camera.sensor
    brightest = float(jnp.max(system(jnp.ones(plane.shape, system.values.dtype))))
    counts = options.exposure * (2**options.bits - 1 - options.offset) / brightest
    path = folder.path / f"captures-{float(plane.distance):g}mm.zarr"
    shutil.rmtree(path, ignore_errors=True)  # of an interrupted run
    key = jax.random.fold_in(jax.random.key(setup.config.seed), int(1000 * plane.distance))
    with measuring.create_captures(path, _series(setup), sensor.shape, bits=options.bits) as writer:
        captures = measuring.simulate_captures(
            writer, Scaled(system, counts), key, deviation=options.noise, offset=options.offset
        )
    matrix = measuring.recover_matrix(captures)
    if not options.keep_captures:
        shutil.rmtree(path)
    return Known.of(matrix, counts)


def _options(setup: build.Setup) -> CalibrationConfig:
    options = setup.config.calibration
    assert options is not None  # this file is for runs that have one
    return options


def _series(setup: build.Setup) -> measuring.HadamardSeries:
    options = _options(setup)
    return measuring.HadamardSeries(
        setup.plane.shape, options.order, options.display, options.dark_frames
    )


class Calibration:
    """The calibration of a run, step by step; `metrics` grows with them."""

    fitted: measuring.ScreenFit

    def __init__(self, setup: build.Setup, system: Sparse, folder: RunFolder):
        self.setup, self.folder, self.options = setup, folder, _options(setup)
        began = time.perf_counter()
        self.measured = measure(setup, system, folder)
        seconds = time.perf_counter() - began
        self.cells = diagonal(setup.plane.shape)
        self.columns = _columns(self.measured, system, setup.plane.shape, self.cells)
        exact = self.columns["exact"]
        noise = self.columns["measured"] - exact
        rounding = 1 / 12  # variance of whole numbers, in counts
        of_a_cell = 2 if self.options.display == "complementary" else 4
        spread = of_a_cell * (self.options.noise**2 + rounding) / math.prod(setup.plane.shape)
        self.metrics: dict[str, Any] = {
            "frames": _series(setup).frame_count,
            "seconds": round(seconds, 2),
            "largest_counts": round(float(exact.max()), 3),
            "noise_counts": round(float(noise.std()), 5),
            "expected_noise_counts": round(math.sqrt(spread), 5),
            "distances": {},
        }
        self.images: dict[str, dict[str, np.ndarray]] = {}  # by distance and matrix

    def fit_screen(self) -> None:
        """The screen from the matrix, which is let go of: another of its size may be measured."""
        setup = self.setup
        began = time.perf_counter()
        fit = measuring.fit_screen(
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
        (camera,) = build.build_cameras(self.setup.config, self.options.glass_thickness)
        known = [name not in self.options.fitted for name in ("plate_x", "plate_y")]
        return eqx.tree_at(lambda c: c.tilt, camera, jnp.where(jnp.asarray(known), camera.tilt, 0))

    def look_from(self, distance: float) -> None:
        """Targets at another distance, by the last method: from the fit, and measured there."""
        config = self.setup.config
        plane = wg.ObjectPlane(
            self.setup.plane.shape, distance, self.setup.plane.width, self.setup.plane.centre
        )
        there = replace(self.setup, plane=plane)
        true = build.build_model(there, config.models[0])
        captured, samples = build.capture(there, true), config.band_samples
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
            result = build.undo(known.reduced, config.methods[-1], known.seen(captured))
            images = np.asarray(result.image, float).reshape(-1, *plane.shape)
            self.images[f"{distance:g} mm"][name] = images
            pairs = zip(images, there.targets.values(), strict=True)
            found = [psnr(image, truth) for image, truth in pairs]
            scores[name] = {
                "mean_psnr_db": rounded(float(np.mean(found))),
                "targets": dict(zip(there.targets, map(rounded, found), strict=True)),
            }
        self.metrics["distances"][f"{distance:g} mm"] = scores

    def save_figures(self) -> None:
        """Columns of the matrix, and the targets at other distances."""
        pitch = float(self.setup.camera.sensor.pitch)
        figures.save_columns(self.folder, pitch, self.cells, self.columns)
        if self.images:
            figures.save_distances(self.folder, self.setup, self.images, self.metrics["distances"])


def _columns(
    measured: Known, system: Sparse, shape: tuple[int, int], cells: list[tuple[int, int]]
) -> dict[str, Float[np.ndarray, "cell y x"]]:
    """What the sensor sees of some cells alone, in counts."""
    numbers = np.ravel_multi_index(tuple(np.transpose(cells)), shape)
    lit = np.zeros((len(cells), math.prod(shape)))
    lit[np.arange(len(cells)), numbers] = measured.counts
    exact: Array = system(jnp.asarray(lit.reshape(-1, *shape), system.values.dtype))
    found = np.asarray(measured.matrix.matrix[:, numbers], float).T
    return {"measured": found.reshape(exact.shape), "exact": np.asarray(exact, float)}


def _true_values(setup: build.Setup) -> dict[str, float]:
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
