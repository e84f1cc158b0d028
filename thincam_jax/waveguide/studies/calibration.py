"""A see-through screen calibrated with Hadamard patterns: its matrix, a fit, other distances.

The matrix that patterns on a monitor measure holds for the distance at which it was measured
(thesis section 5.3). The rays that are fitted to it hold for all.
"""

import contextlib
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from thincam_jax import waveguide as wg
from thincam_jax._core.quantity import FieldError, check_fields, choice, quantity, whole
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax._core.table import Table
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import AbstractOperator, Matrix, ReducedMatrix, Sparse
from thincam_jax.imaging.operators.base import dtype_of
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.measured import calibration as measuring
from thincam_jax.measured.calibration.hadamard import DARK_FRAMES, Display, Order
from thincam_jax.studies.evaluate import rounded
from thincam_jax.studies.pictures import (
    Reconstructed,
    ScreenCaptures,
    diagonal_cells,
    reconstruct_targets,
    reconstructed,
)
from thincam_jax.waveguide.measured.screen_fit import ScreenFit
from thincam_jax.waveguide.measured.screen_state import (
    DEFAULT,
    PARAMETERS,
    QUANTITIES,
    screen_values,
)
from thincam_jax.waveguide.studies.screen import GLASS, ScreenStudy, with_glass

MEASURED = "measured matrix"


@dataclass(frozen=True)
class Calibration:
    """Measurement of a matrix, and the rays that are fitted to it.

    - `order`, `display`, `dark_frames`: see `HadamardSeries`. `bits`: bits of the camera.
    - `exposure`: part of the camera's range that a white monitor fills; `offset`: its dark level
      and `noise_std`: standard deviation of its white noise, in counts.
    - `keep_captures`: leave the stores of captures in the folder that is given.
    - `glass_thickness`: assumed before the fit, mm; None for the true one.
    - `fitted`: the parameters that are found, keys of `waveguide.measured.screen_state.PARAMETERS`.
      A plate whose tilt is fitted is taken for straight before.
    - `distances`: distances of the object, mm, at which the matrix follows from the fit and is
      measured anew.
    """

    order: Annotated[Order, choice(get_args(Order))] = "sequency"
    display: Annotated[Display, choice(get_args(Display))] = "complementary"
    dark_frames: Annotated[int, DARK_FRAMES] = 0
    bits: Annotated[int, whole(4, 16)] = 12
    exposure: Annotated[float, quantity(positive=True, most=1.0)] = 0.9
    offset: Annotated[float, quantity("counts", non_negative=True)] = 0.0
    noise_std: Annotated[float, quantity("counts", non_negative=True)] = 0.0
    keep_captures: bool = False
    glass_thickness: Annotated[float | None, GLASS] = None
    fitted: Annotated[tuple[str, ...], choice(PARAMETERS, many=True)] = DEFAULT
    distances: Annotated[tuple[float, ...], quantity("mm", positive=True, many=True)] = ()

    def __post_init__(self):
        check_fields(self)
        if not self.fitted or len(set(self.fitted)) < len(self.fitted):
            raise FieldError("names one number twice, or none; give each once", "fitted")
        if self.offset >= 2**self.bits / 2:
            message = f"{self.offset:g} fills half of the {self.bits} bits; give less, or more bits"
            raise FieldError(message, "offset")
        if self.display == "binary" and self.offset and not self.dark_frames:
            message = "a binary display with an offset needs dark frames; give 8, or offset: 0"
            raise FieldError(message, "display")

    def series(self, shape: tuple[int, int]) -> measuring.HadamardSeries:
        """The patterns for so many cells."""
        return measuring.HadamardSeries(shape, self.order, self.display, self.dark_frames)


class SystemMatrix(eqx.Module):
    """A measured or modelled matrix, reduced so that one compiled program serves all.

    - `counts`: counts of the camera in the unit of the matrix, where a model has 1.
    """

    matrix: Matrix | Sparse
    reduced: ReducedMatrix
    counts: float

    @classmethod
    def of(cls, matrix: Matrix | Sparse, counts: float = 1.0) -> "SystemMatrix":
        """A matrix and its reduction."""
        return cls(matrix, ReducedMatrix.of(matrix), counts)

    def reduce(self, captures: ScreenCaptures) -> ScreenCaptures:
        """Captures in the unit of the matrix, as its reduction takes them."""
        variance = captures.variance.reshape(*captures.variance.shape[:1], -1).mean(axis=1)
        images = captures.images.reshape(len(captures.images), -1)
        images = self.reduced.project(self.matrix, self.counts * images)
        return ScreenCaptures(images, self.counts**2 * variance)


def measure_matrix(
    study: ScreenStudy,
    calibration: Calibration,
    system: AbstractOperator,
    folder: Path | None = None,
) -> SystemMatrix:
    """The matrix of a camera from simulated captures of Hadamard patterns.

    - `system`: the camera's own matrix.
    - `folder`: folder of the store of captures; default a temporary one.
    """
    plane, full = study.plane, math.prod(system.out_shape)
    brightest = float(jnp.max(system(jnp.ones(system.in_shape, dtype_of(system)))))
    counts = calibration.exposure * (2**calibration.bits - 1 - calibration.offset) / brightest
    key = jax.random.fold_in(jax.random.key(study.seed), int(1000 * plane.distance))
    series, cells = calibration.series(plane.shape), math.prod(plane.shape)
    assert isinstance(system, Sparse)  # of a camera with a lens
    lit = [np.asarray(part) for part in (system.values, system.rows, system.columns)]
    frame = full // system.out_shape[-1], system.out_shape[-1]  # channels one below the other
    measured = []
    for number in range(math.prod(system.in_shape) // cells):  # patterns of each primary
        bits, kept = calibration.bits, (lit[2] // cells == number) & (lit[1] < full)
        values, rows, columns = (part[kept] for part in lit)
        table = scipy.sparse.csr_array((values, (rows, columns % cells)), (full, cells))
        name = f"captures-{float(plane.distance):g}mm{f'-{number}' if number else ''}.zarr"
        with _store(folder, name, calibration) as path:
            with measuring.HadamardCaptures.create(path, series, frame, bits=bits) as writer:
                captures = measuring.simulate_captures(
                    writer,
                    Scaled(Sparse(table, plane.shape, frame), counts),
                    jax.random.fold_in(key, number) if number else key,
                    noise_std=calibration.noise_std,
                    offset=calibration.offset,
                )
            measured.append(measuring.recover_matrix(captures))
    if len(measured) == 1:
        return SystemMatrix.of(measured[0], counts)
    matrix = jnp.concatenate([one.matrix for one in measured], axis=1)
    matrix = Matrix(matrix, (len(measured), *plane.shape), system.out_shape)  # colours as planes
    return SystemMatrix.of(matrix, counts)


@contextlib.contextmanager
def _store(folder: Path | None, name: str, calibration: Calibration) -> Iterator[Path]:
    """The path of a store of captures, which is removed at the end unless it is kept."""
    if folder is None:
        with tempfile.TemporaryDirectory() as temporary:
            yield Path(temporary) / name
        return
    path = folder / name
    shutil.rmtree(path, ignore_errors=True)  # of an interrupted run
    yield path
    if not calibration.keep_captures:
        shutil.rmtree(path)


@dataclass(frozen=True)
class FittedValue:
    """A parameter of the screen; `true` is None for those that a screen does not have."""

    found: float
    standard_error: float
    true: float | None
    unit: str


@dataclass(frozen=True)
class FitScores:
    """Status of the fit of the screen, and its parameters by name; see `ScreenFit`."""

    status: str
    reasons: tuple[str, ...]
    explained: float
    seconds: float
    values: dict[str, FittedValue]

    def table(self) -> Table:
        """Every parameter beside its true value."""
        rows = [
            (
                name.replace("_", " "),
                f"{value.found:.5g} {value.unit}",
                f"{value.standard_error:.2g}",
                None if value.true is None else f"{value.true:.5g}",
            )
            for name, value in self.values.items()
        ]
        return Table(("number", "found", "standard error", "true"), rows)


@dataclass(frozen=True)
class DistanceScores:
    """PSNR of the targets, dB, by name; None where exact."""

    mean_psnr_db: float | None
    targets: dict[str, float | None]


@dataclass(frozen=True)
class CalibrationScores:
    """Figures of merit of a calibration.

    - `frames`, `seconds`: frames and duration (s) of the measurement.
    - `largest_counts`, `noise_counts`: largest and noise of the matrix' entries, counts;
      `expected_noise_counts`: their noise by that of the frames.
    - `distances`: by distance and by how the matrix was found.
    """

    frames: int
    seconds: float
    largest_counts: float
    noise_counts: float
    expected_noise_counts: float
    distances: dict[str, dict[str, DistanceScores]]
    fit: FitScores

    def table(self) -> Table:
        """Mean PSNR at every distance, by how the matrix was found; no rows without distances."""
        ways = next(iter(self.distances.values()), {})
        rows = [
            (distance, *(way.mean_psnr_db for way in each.values()))
            for distance, each in self.distances.items()
        ]
        headings = ("object at", *(f"{name}, mean dB" for name in ways))
        return Table(headings, rows, (1,) * len(ways))


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibrated screen.

    - `methods`: reconstructions by the measured matrix, by name of the solver.
    - `columns`: captures of the `cells` (row, column) alone, in counts, as "measured" and "exact".
    - `images`: images of the targets, by distance and by how the matrix was found.
    """

    study: ScreenStudy
    scores: CalibrationScores
    methods: dict[str, Reconstructed]
    cells: list[tuple[int, int]]
    columns: dict[str, Float[np.ndarray, "cell y x"]]
    images: dict[str, dict[str, Float[np.ndarray, "target row column"]]]


def calibrate(
    study: ScreenStudy,
    calibration: Calibration,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Measure the matrix of a study's camera, reconstruct with it, and fit the screen to it.

    - `folder`: folder of the stores of captures; default a temporary one.

    Of several colours each primary has its patterns, and every channel of a frame is read; neither
    a fit nor other distances follow.
    """
    run = CalibrationRun(study, calibration, folder)
    carry_out(run.work, progress)
    return run.result


class CalibrationRun:
    """A calibration step by step: `work` fills what `result` holds."""

    measured: SystemMatrix
    fit: ScreenFit

    def __init__(self, study: ScreenStudy, calibration: Calibration, folder: Path | None = None):
        colours = len(study.cameras) > 1
        if colours and calibration.distances:
            raise ValueError("distances need a fit, and that one colour; drop distances")
        if study.mask is not None:
            raise ValueError("a calibration fits a camera with a lens; give a study without a mask")
        self.study, self.calibration, self.folder = study, calibration, folder
        self.methods: dict[str, Reconstructed] = {}
        self.distances: dict[str, dict[str, DistanceScores]] = {}
        self.images: dict[str, dict[str, np.ndarray]] = {}
        self.work = [Step("captures of Hadamard patterns", self._measure)]
        for name in study.solvers:
            step = partial(self._reconstruct, name)
            self.work.append(Step(f"{MEASURED}: {name}", step))
        self._fit_scores = FitScores("of one colour alone", (), 0.0, 0.0, {})
        if not colours:
            self.work.append(Step("fit of the screen", self._fit))
        for distance in calibration.distances:
            step = partial(self._look_from, distance)
            self.work.append(Step(f"object at {distance:g} mm", step))

    @property
    def result(self) -> CalibrationResult:
        """All of it, at the end."""
        options = self.calibration
        noise = self.columns["measured"] - self.columns["exact"]
        rounding = 1 / 12  # variance of whole numbers, in counts
        of_a_cell = 2 if options.display == "complementary" else 4
        spread = of_a_cell * (options.noise_std**2 + rounding) / math.prod(self.study.plane.shape)
        scores = CalibrationScores(
            options.series(self.study.plane.shape).frame_count * len(self.study.cameras),
            round(self._seconds, 2),
            round(float(self.columns["exact"].max()), 3),
            round(float(noise.std()), 5),
            round(math.sqrt(spread), 5),
            self.distances,
            self._fit_scores,
        )
        return CalibrationResult(
            self.study, scores, self.methods, self.cells, self.columns, self.images
        )

    def _measure(self) -> None:
        study = self.study
        began = time.perf_counter()
        self.measured = measure_matrix(study, self.calibration, study.systems[0], self.folder)
        self._seconds = time.perf_counter() - began
        self.cells = diagonal_cells(study.plane.shape)
        self.columns = _columns(self.measured, study, self.cells)

    def _reconstruct(self, name: str) -> None:
        study, known = self.study, self.measured
        captures, solver = known.reduce(study.captures), study.solvers[name]
        self.methods[name] = reconstructed(study.targets, solver, known.reduced, captures)

    def _fit(self) -> None:
        """The screen from the matrix, which is let go of: another of its size may be measured."""
        study, true = self.study, screen_values(self.study.camera, self.study.plane)
        began = time.perf_counter()
        self.fit = measuring.fit_screen(
            self.measured.matrix,  # pyright: ignore[reportArgumentType]
            self._assumed(),
            study.plane,
            parameters=self.calibration.fitted,
            orders=study.orders,
            samples=study.band_samples,
        )
        errors = self.fit.standard_errors
        values = {
            name: FittedValue(
                float(value), float(errors[name]), true.get(name), QUANTITIES[name].unit
            )
            for name, value in self.fit.values.items()
            if name != "gain"
        }
        self._fit_scores = FitScores(
            self.fit.status,
            tuple(self.fit.reasons),
            round(float(self.fit.explained), 4),
            round(time.perf_counter() - began, 2),
            values,
        )
        del self.measured

    def _assumed(self) -> wg.SeeThroughCamera:
        """The camera as assumed before the fit: straight where its tilt is to be found."""
        camera, thickness = self.study.camera, self.calibration.glass_thickness
        if thickness is not None:
            camera = with_glass(camera, thickness)
        known = [name not in self.calibration.fitted for name in ("plate_x", "plate_y")]
        return eqx.tree_at(lambda c: c.tilt, camera, jnp.where(jnp.asarray(known), camera.tilt, 0))

    def _look_from(self, distance: float) -> None:
        """Targets at another distance, by the last solver: from the fit, and measured there."""
        study, where = self.study, f"{distance:g} mm"
        plane = wg.ObjectPlane(study.plane.shape, distance, study.plane.width, study.plane.centre)
        there = replace(study, plane=plane)
        true = there.system(study.models[0])
        captures, solver = there.captured_through(true), list(study.solvers.values())[-1]
        fitted = self.fit.system(plane)
        assumed = wg.system_operator(
            self._assumed(), plane, orders=study.orders, samples=study.band_samples
        )
        assert isinstance(fitted.operator, Sparse)
        ways: dict[str, Callable[[], SystemMatrix]] = {
            "exact model": partial(SystemMatrix.of, true),
            "measured there": partial(measure_matrix, there, self.calibration, true, self.folder),
            "from the fit": partial(SystemMatrix.of, fitted.operator),
            "as assumed": partial(SystemMatrix.of, assumed),
        }
        self.distances[where], self.images[where] = {}, {}
        for name, find in ways.items():  # one after another, for the memory
            known = find()
            found = reconstruct_targets(known.reduced, solver, known.reduce(captures))
            images = np.asarray(found.image, float).reshape(-1, *plane.shape)
            pairs = zip(images, study.targets.values(), strict=True)
            scores = [psnr(image, truth) for image, truth in pairs]
            self.images[where][name] = images
            self.distances[where][name] = DistanceScores(
                rounded(float(np.mean(scores))),
                dict(zip(study.targets, map(rounded, scores), strict=True)),
            )


def _columns(
    measured: SystemMatrix, study: ScreenStudy, cells: list[tuple[int, int]]
) -> dict[str, Float[np.ndarray, "cell y x"]]:
    """Captures of some cells alone, in counts."""
    system, shape = study.systems[0], study.plane.shape
    middle = len(study.cameras) // 2  # colour
    numbers = np.ravel_multi_index(tuple(np.transpose(cells)), shape) + middle * math.prod(shape)
    lit = np.zeros((len(cells), math.prod(system.in_shape)))
    lit[np.arange(len(cells)), numbers] = measured.counts
    exact: Array = system(jnp.asarray(lit.reshape(-1, *system.in_shape), dtype_of(system)))
    assert isinstance(measured.matrix, Matrix)
    found = {"measured": measured.matrix.matrix[:, numbers].T, "exact": exact}
    frame = len(cells), -1, *study.camera.sensor.shape
    return {n: np.asarray(each, float).reshape(frame)[:, middle] for n, each in found.items()}
