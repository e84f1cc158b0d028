"""Captures of a rig: their image or system matrix, beside those of a direct simulation.

A virtual rig renders its frames by another model than these simulations: where frames and images
agree within the noise, the rig's geometry, electronics and bookkeeping are right.
"""

import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from thincam_jax._core.grids import Grid, same_parity
from thincam_jax.hardware.studies.images import FrameSolver, mosaic_of, square_field
from thincam_jax.imaging.encoding import as_picture
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import CropConvolution, ReducedMatrix, Sparse
from thincam_jax.imaging.operators.low_rank import LowRank
from thincam_jax.imaging.scene import Scene
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.forward import imaging_operator
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.measured import calibration
from thincam_jax.measured.bayer import Pattern, mosaic
from thincam_jax.measured.calibration.alignment import (
    Alignment,
    MapKind,
    fit_alignment,
    locate_mark,
)
from thincam_jax.measured.calibration.captures import HadamardCaptures
from thincam_jax.measured.calibration.system_matrix import open_matrix, stored_blocks, write_matrix
from thincam_jax.reconstruction import AbstractSolver
from thincam_jax.reconstruction.noise import estimate_noise
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies.evaluate import noise_free, rounded, sample
from thincam_jax.studies.pictures import (
    Reconstructed,
    ScreenCaptures,
    diagonal_cells,
    reconstructed,
)
from thincam_jax.studies.study import Study

Pixels = tuple[slice, slice]
COLOURS = "red", "green", "blue"


@dataclass(frozen=True)
class CountingCamera:
    """Response of a camera to light, for the noise of its frames.

    - `counts`: counts of a unit of the noise-free image; `electron`: counts of an electron.
    - `read_noise`: in electrons; `offset`: counts that were not subtracted.
    - `light`: light whose mean was subtracted, (y, x), in the unit of the noise-free image.
    """

    counts: float
    electron: float
    read_noise: float
    offset: float = 0.0
    light: Any = 0.0

    def variance(self, counts: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Noise variance of a frame, counts², from its noise-free counts without the offset."""
        return self.electron * counts + (self.electron * self.read_noise) ** 2 + 1 / 12


@dataclass(frozen=True, eq=False)
class RigFrames:
    """Frames of a rig, and the camera that took them, where it is known.

    - `frames`: counts without the mean of so many `dark_frames`.
    - `pixels`: part of the sensor that was read, rows and columns.
    - `lit`: pixels of that part that see light.
    - `variance`: variance of frames that are means of several; infinite for unknown pixels.
    - `bayer`: pattern of the frames; None of grey ones.
    - `positions`: the stage's, mm, for each frame; empty without a stage.
    """

    frames: Float[np.ndarray, "capture y x"]
    camera: CountingCamera | None
    pixels: Pixels
    lit: Bool[np.ndarray, "y x"]
    dark_frames: int = 0
    variance: Float[np.ndarray, "y x"] | None = None
    bayer: Pattern | None = None
    positions: tuple[float, ...] = ()


@dataclass(frozen=True)
class FrameAgreement:
    """Differences between a rig and a direct simulation, over the noise: 1 is agreement.

    Of each frame the standard deviation and the mean; of the image, its noise over that of a
    simulated one.
    """

    frame_residual_over_noise: list[float]
    frame_bias_over_noise: list[float]
    image_noise_over_simulated: float

    def __str__(self) -> str:
        worst, image = max(self.frame_residual_over_noise), self.image_noise_over_simulated
        frames = f"Beside a direct simulation frames differ by {worst:.2f} times their noise"
        return f"{frames}; the image has {image:.2f} times the noise of a simulated one."


@dataclass(frozen=True, eq=False)
class FrameComparison:
    """Images "scene", "captured", "simulated" and "without noise", PSNR, dB, and the agreement.

    Images in colour are (y, x, 3), and each colour of the captured one has a PSNR, too.
    """

    images: dict[str, Float[np.ndarray, "y x *colour"]]
    psnr_db: dict[str, float | None]
    agreement: FrameAgreement


def compare_frames(
    study: Study, rig: RigFrames, solve: FrameSolver, captured: Reconstruction, seed: int = 0
) -> FrameComparison:
    """Compare frames and their image with a direct simulation of the same exposures.

    - `study`: study of the whole sensor, whose first target the rig looked at.
    - `solve`: see `frame_solver`; `captured`: image that it makes of the rig's frames.
    """
    camera, target = rig.camera, study.targets[0]
    assert camera is not None
    light = [
        np.stack([noise_free(study, exposure, *scene.planes) for exposure in method.exposures])
        for method, scene in zip(study.methods, scenes_of(study), strict=True)
    ]
    side_by_side, lit = mosaic_of(study), rig.lit
    if side_by_side is not None:
        parts = [np.ones(side_by_side.part_shape)] * len(light[0])
        lit = lit & (np.asarray(side_by_side.join(parts)) > 0)
        light = [np.asarray(side_by_side.join([*one]))[None] for one in light]
    part = np.stack(light, axis=1)[..., *rig.pixels]  # capture, colour, y, x
    clean = camera.counts * (part[:, 0] if rig.bayer is None else mosaic(part, rig.bayer))
    variance, dark = camera.variance(clean), np.zeros(clean.shape[1:])
    if rig.variance is not None:
        known = np.isfinite(rig.variance)
        variance = np.where(known, rig.variance, np.median(rig.variance))[None]
        lit = lit & known
    elif rig.dark_frames:
        dark = camera.variance(dark) / rig.dark_frames
    residual = (rig.frames - clean - camera.offset) / np.sqrt(variance + dark)
    of_each = residual[:, lit]
    random = np.random.default_rng(seed + 1)

    def simulated(noise: float) -> Reconstruction:
        frames = np.sqrt(variance) * random.standard_normal(clean.shape)
        frames += np.sqrt(dark) * random.standard_normal(dark.shape)  # the same in all
        frames = noise * frames + clean + camera.offset
        return solve(frames.astype(np.float32))

    images = {"captured": captured, "simulated": simulated(1.0), "without noise": simulated(0.0)}
    pixels = {name: as_picture(np.asarray(one.image, float)) for name, one in images.items()}
    grid = Grid(pixels["captured"].shape[:2], jnp.asarray(captured.pitch))
    truth = as_picture(np.asarray(sample(target.plane, grid), float))
    scores = {name: rounded(psnr(image, truth)) for name, image in pixels.items()}
    for number, colour in enumerate(COLOURS if rig.bayer else ()):
        found = pixels["captured"][..., number]
        scores[f"captured {colour}"] = rounded(psnr(found, truth[..., number]))
    pixels = {"scene": truth} | pixels
    noise = [np.std(pixels[n] - pixels["without noise"]) for n in ("captured", "simulated")]
    agreement = FrameAgreement(
        [round(float(np.std(z)), 4) for z in of_each],
        [round(float(np.mean(z)), 4) for z in of_each],
        round(float(noise[0] / noise[1]), 4),
    )
    return FrameComparison(pixels, scores, agreement)


def scenes_of(study: Study) -> list[Scene]:
    """The first target in the light of each method: a channel of its image for each."""
    plane = study.targets[0].plane
    return [
        Scene(replace(plane, image=image), method.exposures[0].wavelength)
        for image, method in zip(plane.image, study.methods, strict=True)
    ]


@dataclass(frozen=True)
class MatrixAgreement:
    """A measured matrix beside the exact one: residual over noise (1 is agreement), and counts."""

    matrix_residual_over_noise: float
    largest_counts: float
    noise_counts: float

    def __str__(self) -> str:
        found = self.matrix_residual_over_noise
        return f"The matrix differs from the exact one by {found:.2f} times its noise."


@dataclass(frozen=True, eq=False)
class MeasuredMatrix:
    """The system matrix of Hadamard captures.

    - `shape`: pixels and cells. `seconds`: to recover, reduce and compare it.
    - `columns`: frames of the `cells` (row, column) alone, in counts, as "measured" and "exact".
    """

    shape: tuple[int, int]
    cells: list[tuple[int, int]]
    columns: dict[str, Float[np.ndarray, "cell y x"]]
    agreement: MatrixAgreement | None
    seconds: float


def recover_to(
    folder: Path,
    captures: HadamardCaptures,
    exact: tuple[Sparse, CountingCamera, Pixels] | None = None,
) -> MeasuredMatrix:
    """Recover the matrix of captures into a folder, block by block: matrix.zarr, reduced.npz.

    - `exact`: truth of a virtual rig: its system (see `waveguide.system.monitor_system`), its
      camera, and the part of the sensor that was read; the matrix is compared with it.
    """
    path, shape = folder / "matrix.zarr", captures.series.object_shape
    shutil.rmtree(path, ignore_errors=True)  # of an interrupted run
    began = time.perf_counter()
    write_matrix(captures, path)
    matrix = open_matrix(path)
    ReducedMatrix.of(matrix, shape).save(folder / "reduced.npz", matrix)
    cells, pixel_count = diagonal_cells(shape), math.prod(captures.sensor_shape)
    numbers = [row * shape[1] + column for row, column in cells]
    columns = np.empty((len(cells), pixel_count), np.float32)
    known = None if exact is None else _exact_matrix(captures, *exact)
    total, count = 0.0, 0
    for pixels, block in stored_blocks(path):
        columns[:, pixels] = block[:, numbers].T
        if known is not None:
            matrix, deviation = known
            left = (block - matrix[pixels].toarray()) / deviation[pixels, None]
            # The offset of the frames goes into the first column, which is therefore left out.
            total += float(np.sum(left[:, 1:] ** 2, dtype=np.float64))
            count += left[:, 1:].size
    images, agreement = {"measured": columns}, None
    if known is not None:
        matrix, deviation = known
        images["exact"] = np.asarray(matrix[:, numbers].toarray(), np.float32).T
        agreement = MatrixAgreement(
            round(math.sqrt(total / count), 4),
            round(float(abs(matrix).max()), 3),
            round(float(np.sqrt(np.mean(deviation**2))), 4),
        )
    stacks = {
        name: image.reshape(len(cells), *captures.sensor_shape) for name, image in images.items()
    }
    seconds = round(time.perf_counter() - began, 2)
    whole = pixel_count, captures.series.cell_count
    return MeasuredMatrix(whole, cells, stacks, agreement, seconds)


def calibrated(path: Path, folder: Path) -> tuple[Any, ReducedMatrix]:
    """The matrix of a calibration, unread, and its reduction.

    - `path`: matrix.zarr beside its reduced.npz, as `recover_to` writes them; or the store of its
      Hadamard captures, whose matrix goes into the folder.

    **Errors**: CaptureStoreError, ValueError or OSError, one line, for what is neither.
    """
    if not path.with_name("reduced.npz").is_file():
        recover_to(folder, calibration.HadamardCaptures.load(path))
        path = folder / "matrix.zarr"
    matrix = open_matrix(path)
    return matrix, ReducedMatrix.load(path.with_name("reduced.npz"), matrix)


@dataclass(frozen=True, eq=False)
class ShownPictures:
    """Pictures, by name, and what was captured and reconstructed of them; None: not known.

    - `captures`: mean frames without the dark one, counts. `methods`: by solver.
    """

    targets: dict[str, Float[np.ndarray, "row column"] | None]
    captures: Float[np.ndarray, "picture y x"]
    methods: dict[str, Reconstructed]


def reconstruct_pictures(
    targets: Mapping[str, Float[np.ndarray, "row column"] | None],
    frames: Float[np.ndarray, "frame y x"],
    known: tuple[Any, ReducedMatrix],
    solvers: Mapping[str, AbstractSolver],
    variance: Float[np.ndarray, "y x"] | None = None,
) -> ShownPictures:
    """Pictures from frames, equally many of each in the order of `targets`, by a calibration.

    - `known`: see `calibrated`.
    - `variance`: variance of each pixel, infinite where it is not known: its mean counts, and
      without such pixels the matrix is reduced anew. Else the noise is estimated from the frames.

    **Errors**: ValueError where the matrix is of other cells or pixels than the frames.
    """
    matrix, reduced = known
    shape = reduced.in_shape
    for one in targets.values():
        if one is not None and one.shape != shape:
            raise ValueError(f"the matrix is of {shape} cells; the pictures have {one.shape}")
    captures = frames.reshape(len(targets), -1, *frames.shape[1:]).mean(axis=1)
    if variance is None:
        noise = estimate_noise(jnp.asarray(captures[:, None], jnp.float32))[:, 0] ** 2
    else:
        lit = np.isfinite(variance)
        noise = jnp.full(len(captures), variance[lit].mean(), jnp.float32)
        if not lit.all() and lit.size == matrix.shape[0]:  # others are refused below
            matrix, captures = _KnownRows(matrix, lit.ravel()), np.where(lit, captures, 0)
            reduced = ReducedMatrix.of(matrix, shape)
    seen = ScreenCaptures(reduced.project(matrix, captures), noise)
    found = {n: reconstructed(targets, solver, reduced, seen) for n, solver in solvers.items()}
    return ShownPictures(dict(targets), captures, found)


def lensless_system(study: Study, width: float) -> CropConvolution | LowRank:
    """Operator from a monitor `width` mm wide to the sensor, by a study's first camera."""
    shape = same_parity(square_field(study, width), study.sensor.shape)
    exposure = study.methods[0].exposures[0]
    light, method = exposure.wavelength, PsfMethod(study.model, pixel_integration=True)
    camera, distance = study.camera(exposure), study.object_distance
    return imaging_operator(camera, light, distance, field_shape=shape, model=method)


def align_display(
    study: Study,
    frames: Float[np.ndarray, "frame y x"],
    shown: Sequence[np.ndarray],
    pitch: float,
    kind: MapKind,
) -> Alignment:
    """Find a display before a study's first camera, by frames of a mark each.

    - `study`: its `config` has the object's width, within which marks are looked for.
    - `shown`: levels of the display for each frame. `pitch`: pitch of its pixels, mm.

    **Errors**: MeasurementError where too few marks agree; see `fit_alignment`.
    """
    exposure = study.methods[0].exposures[0]
    field = same_parity(square_field(study, study.config.object.width), (0, 0))
    wide = Sensor(tuple(np.add(study.sensor.shape, field).tolist()), study.pitch)
    psf = np.asarray(replace(study, sensor=wide).psf(exposure), float)
    pixel = -study.pitch * study.object_distance / exposure.distance  # turned by 180°
    middle = (np.array(shown[0].shape) - 1) / 2
    places = [np.argwhere(levels).mean(axis=0) for levels in shown]
    marks, number = np.unique(places, axis=0, return_inverse=True)
    radius = pitch * math.sqrt(np.count_nonzero(shown[0]) / math.pi) / abs(pixel)
    seen = []
    for mark in range(len(marks)):
        mean = frames[number == mark].mean(axis=0, dtype=float)
        found = locate_mark(mean, psf, radius)
        seen.append(found and (pixel * found[0], pixel**2 * found[1]))
    on_display = pitch * (marks - middle)[:, ::-1]
    display = (shown[0].shape[0], shown[0].shape[1]), pitch
    return fit_alignment(display, on_display, seen, kind, abs(pixel))


class _KnownRows:
    """A matrix, unread, whose rows of pixels that are not known are 0 as they are read."""

    def __init__(self, rows: Any, known: Bool[np.ndarray, " pixel"]):
        self.rows, self.known, self.shape = rows, known, rows.shape
        self.chunks = getattr(rows, "chunks", None)

    def __getitem__(self, part: slice) -> np.ndarray:
        return np.where(self.known[part, None], self.rows[part], 0)


def _exact_matrix(
    captures: HadamardCaptures, system: Sparse, camera: CountingCamera, pixels: Pixels
):
    """The matrix of direct simulation in counts, and the noise of each pixel's entries."""
    numbers = np.arange(math.prod(system.out_shape)).reshape(system.out_shape)
    matrix = camera.counts * system.by_rows()[numbers[pixels].ravel()]
    mean = np.asarray(matrix.sum(axis=1), float).ravel() / 2  # half of the cells are lit
    of_an_entry = 2 if captures.series.display == "complementary" else 4
    light = np.broadcast_to(camera.counts * camera.light, system.out_shape)[pixels].ravel()
    variance = of_an_entry * camera.variance(mean + light) / captures.series.cell_count
    return matrix, np.sqrt(variance)
