"""What `thincam run` makes of a store of captures: an image or a system matrix, and a report."""

import math
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core.grids import Grid
from thincam_jax.commands.capture import figures, report
from thincam_jax.commands.capture.build import build_study, field_shape, screen_system
from thincam_jax.commands.capture.config import CaptureConfig
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.screen.figures import draw_columns
from thincam_jax.commands.study.figures import save_figure
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import ReducedMatrix
from thincam_jax.measured import calibration
from thincam_jax.reconstruction import Reconstruction
from thincam_jax.reconstruction.noise import estimate_noise
from thincam_jax.studies.evaluate import Reconstructor, reconstructor, rounded, sample
from thincam_jax.studies.screen_calibration import diagonal_cells
from thincam_jax.studies.simulate import noise_free
from thincam_jax.studies.study import Study


@dataclass(frozen=True)
class Simulated:
    """What a virtual rig's camera does with light, to hold its frames against direct simulation.

    - `counts`: of a unit of the noise-free image; `electron`: counts of an electron.
    - `read_noise`: in electrons; `offset`: counts that were not subtracted.
    """

    counts: float
    electron: float
    read_noise: float
    offset: float

    def variance(self, counts: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Of a frame whose noise-free counts, without the offset, are given."""
        return self.electron * counts + (self.electron * self.read_noise) ** 2 + 1 / 12


@dataclass(frozen=True)
class Taken:
    """What was captured.

    - `frames`: (capture, y, x) counts without the mean dark frame; of a Hadamard plan some only.
    - `labels`: what was shown for each. `seconds`: of the steps of the acquisition, by name.
    - `simulated`: of a virtual rig. `dark_frames`: whose mean was subtracted.
    - `pixels`: the part of the sensor that was read, rows and columns.
    """

    frames: np.ndarray
    labels: list[str]
    shown: list[np.ndarray]
    pixels: tuple[slice, slice]
    seconds: Mapping[str, float] = field(default_factory=dict)
    simulated: Simulated | None = None
    dark_frames: int = 0
    hadamard: calibration.HadamardCaptures | None = None


def run_captures(
    config: CaptureConfig, taken: Taken, folder: RunFolder, progress: Progress
) -> dict[str, Any]:
    """Reconstruct, compare with direct simulation where the rig was virtual, and report.

    Returns (and writes) the metrics.
    """
    return _CaptureRun(config, taken, folder).carry_out(progress)


class _CaptureRun(Run):
    """Captures on their way to an image or a matrix; `metrics` grows with the steps."""

    def __init__(self, config: CaptureConfig, taken: Taken, folder: RunFolder):
        super().__init__(config, folder)
        self.taken = taken
        self._reconstructor: Reconstructor | None = None
        self.metrics |= {
            "study": config.name,
            "kind": config.kind,
            "rig": config.rig,
            "plan": config.plan.kind,
            "seconds": {name: round(s, 4) for name, s in taken.seconds.items()},
        }
        self.add("captures", self.show)
        if config.plan.kind == "hadamard":
            self.add("system matrix", self.recover)
        elif config.plan.kind != "psf_stack":
            self.add("image", self.reconstruct)
        self.add("report", self.report)

    def report(self) -> None:
        self.complete(report.page(self.config, self.metrics))

    def show(self) -> None:
        figures.save_frames(self.folder, self.config, self.taken.frames, self.taken.labels)
        figures.save_shown(self.folder, self.config, self.taken.shown, self.taken.labels)
        if self.taken.seconds:
            figures.save_seconds(self.folder, self.taken.seconds)

    def reconstruct(self) -> None:
        frames = self.taken.frames
        study = build_study(self.config, (frames.shape[1], frames.shape[2]))
        captured = self._image(study, frames)
        images = {"captured": captured}
        if self.taken.simulated is not None:
            images = self._compare(study, captured)
        figures.save_images(self.folder, images, self.metrics.get("psnr_db", {}))
        self.metrics["status"] = captured.status
        self.metrics["object_pixel_mm"] = float(np.asarray(captured.pitch))

    def _image(self, study: Study, frames: np.ndarray) -> Reconstruction:
        if self._reconstructor is None:
            method, seen = study.methods[0], study.object_distance
            shape = field_shape(self.config, method)
            self._reconstructor = reconstructor(study, method, shape, seen)
        captures = jnp.asarray(frames[:, None], jnp.float32)
        return self._reconstructor(captures, estimate_noise(captures) ** 2)

    def _compare(self, study: Study, captured: Reconstruction) -> dict[str, Reconstruction]:
        """Frames and image against direct simulation, by another model than the virtual rig's."""
        camera, virtual, target = self.taken.simulated, self.config.virtual, study.targets[0]
        assert camera is not None and virtual is not None
        whole, part = build_study(self.config, virtual.sensor), self.taken.pixels
        clean = camera.counts * np.stack(
            [
                np.asarray(noise_free(whole, exposure, target.plane))[part]
                for exposure in whole.methods[0].exposures
            ]
        )
        variance, dark = camera.variance(clean), np.zeros(clean.shape[1:])
        if self.taken.dark_frames:
            dark = camera.variance(dark) / self.taken.dark_frames
        residual = (self.taken.frames - clean - camera.offset) / np.sqrt(variance + dark)
        of_each = residual[:, figures.without_fiducial(self.config, dark.shape)]
        random = np.random.default_rng(self.config.seed + 1)

        def simulated(noise: float) -> Reconstruction:
            frames = np.sqrt(variance) * random.standard_normal(clean.shape)
            frames += np.sqrt(dark) * random.standard_normal(dark.shape)  # the same in all
            frames = noise * frames + clean + camera.offset
            return self._image(study, frames.astype(np.float32))

        images = {"captured": captured}
        images |= {"simulated": simulated(1.0), "without noise": simulated(0.0)}
        pixels = {name: np.squeeze(np.asarray(one.image, float)) for name, one in images.items()}
        grid = Grid(pixels["captured"].shape, jnp.asarray(captured.pitch))
        truth = np.asarray(sample(target.plane, grid), float)
        scores = {name: psnr(image, truth) for name, image in pixels.items()}
        self.metrics["psnr_db"] = {name: rounded(score) for name, score in scores.items()}
        noise = [np.std(pixels[n] - pixels["without noise"]) for n in ("captured", "simulated")]
        self.metrics["agreement"] = {
            "frame_residual_over_noise": [round(float(np.std(z)), 4) for z in of_each],
            "frame_bias_over_noise": [round(float(np.mean(z)), 4) for z in of_each],
            "image_noise_over_simulated": round(float(noise[0] / noise[1]), 4),
        }
        return images

    def recover(self) -> None:
        """The matrix into a store, block by block, and what it is reduced to beside it.

        Of a virtual rig: compared with the exact one.
        """
        captures = self.taken.hadamard
        assert captures is not None
        path = self.folder.path / "matrix.zarr"
        shutil.rmtree(path, ignore_errors=True)  # of an interrupted run
        began = time.perf_counter()
        calibration.write_matrix(captures, path)
        matrix = calibration.open_matrix(path)
        reduced = ReducedMatrix.of(matrix, captures.series.object_shape)
        reduced.save(self.folder.path / "reduced.npz", matrix)
        cells = diagonal_cells(captures.series.object_shape)
        numbers = [row * captures.series.object_shape[1] + column for row, column in cells]
        columns = np.empty((len(cells), math.prod(captures.sensor_shape)), np.float32)
        exact = self._exact() if self.taken.simulated is not None else None
        total, count = 0.0, 0
        for pixels, block in calibration.stored_blocks(path):
            columns[:, pixels] = block[:, numbers].T
            if exact is not None:
                matrix, deviation = exact
                left = (block - matrix[pixels].toarray()) / deviation[pixels, None]
                # The first column takes the offset and the white frame: it is told by the others.
                total += float(np.sum(left[:, 1:] ** 2, dtype=np.float64))
                count += left[:, 1:].size
        images = {"measured": columns}
        if exact is not None:
            images["exact"] = np.asarray(exact[0][:, numbers].toarray(), np.float32).T
            self.metrics["agreement"] = {
                "matrix_residual_over_noise": round(math.sqrt(total / count), 4),
                "largest_counts": round(float(abs(exact[0]).max()), 3),
                "noise_counts": round(float(np.sqrt(np.mean(exact[1] ** 2))), 4),
            }
        shape = (len(cells), *captures.sensor_shape)
        stacks = {name: image.reshape(shape) for name, image in images.items()}
        save_figure(self.folder, "columns", draw_columns(self.config.camera.pitch, cells, stacks))
        self.metrics |= {
            "frames": captures.series.frame_count,
            "matrix": [math.prod(captures.sensor_shape), captures.series.cell_count],
            "matrix_seconds": round(time.perf_counter() - began, 2),
        }

    def _exact(self) -> tuple[Any, np.ndarray]:
        """The matrix of direct simulation in counts, and the noise of each pixel's entries."""
        camera, captures = self.taken.simulated, self.taken.hadamard
        assert camera is not None and captures is not None
        system = screen_system(self.config)
        numbers = np.arange(math.prod(system.out_shape)).reshape(system.out_shape)
        matrix = camera.counts * system.by_rows()[numbers[self.taken.pixels].ravel()]
        mean = np.asarray(matrix.sum(axis=1), float).ravel() / 2  # half of the cells are lit
        of_an_entry = 2 if captures.series.display == "complementary" else 4
        variance = of_an_entry * camera.variance(mean) / captures.series.cell_count
        return matrix, np.sqrt(variance)
