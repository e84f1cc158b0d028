"""Result of a training: a refocusing network beside its linear start, on scenes held out."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.table import Table
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.learn.refocusing.network import RefocusNetwork
from thincam_jax.learn.refocusing.scenes import Batch
from thincam_jax.learn.refocusing.use import Reading, read
from thincam_jax.learn.training import Trained
from thincam_jax.reconstruction.depth.refocus import RefocusSweep, refocus_distances

_SWEPT = 15  # distances of a sweep


@dataclass(frozen=True)
class NetworkScores:
    """Means over scenes: PSNR (dB) and SSIM of images, and residual over noise.

    None where a mean is not finite. Images are those focused on the commanded distance, and those
    sharp everywhere.
    """

    focus_psnr_db: float | None
    focus_ssim: float | None
    all_in_focus_psnr_db: float | None
    all_in_focus_ssim: float | None
    consistency: float | None


@dataclass(frozen=True, eq=False)
class RefocusTraining:
    """A trained network, its scores beside those of the linear start, and a batch to look at.

    - `reading`: reading of the captures of `batch` by the network.
    """

    trained: Trained
    linear: NetworkScores
    scores: NetworkScores
    batch: Batch
    reading: Reading

    @property
    def network(self) -> RefocusNetwork:
        """The trained network."""
        return self.trained.model

    def table(self) -> Table:
        """Scores of both networks."""
        compared = {"linear start, untrained": self.linear, "trained": self.scores}
        rows = [(name, *asdict(one).values()) for name, one in compared.items()]
        names = ("focused", "all in focus")
        both = (f"{name}\n{score}" for name in names for score in ("PSNR dB", "SSIM"))
        return Table(("network", *both, "residual\nover noise"), rows, (2, 3, 2, 3, 2))

    def finding(self) -> str:
        """Gain by the training, in words."""
        after, before = self.scores.focus_psnr_db, self.linear.focus_psnr_db
        return f"focused images have {after:.2f} dB, the linear start {before:.2f} dB"

    def sweep(self) -> RefocusSweep:
        """The batch's first capture, focused on distances even in 1/t, upright."""
        network, batch = self.network, self.batch
        camera, size = network.camera, len(batch.capture)
        distances = refocus_distances(float(camera.near), float(camera.far), _SWEPT)
        first = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], leaf.shape), batch)
        # As many at a time as the batch has, which is compiled for.
        rounds = np.resize(np.asarray(distances), (-(-_SWEPT // size), size))
        images = [read_batch(network, replace(first, commanded=jnp.asarray(t))) for t in rounds]
        images = jnp.concatenate([found.images[:, 0] for found in images])[:_SWEPT, ::-1, ::-1]
        slope = camera.camera.sensor.pitch / camera.camera.distance
        return RefocusSweep(images, jnp.asarray(distances, images.dtype), slope, "learned")


def judge_training(
    trained: Trained, untrained: RefocusNetwork, batches: Sequence[Batch]
) -> RefocusTraining:
    """Score a trained network and its linear start on scenes, as those of `Lessons.validation`."""
    linear, readings = ([read_batch(n, b) for b in batches] for n in (untrained, trained.model))
    scores = score(linear, batches), score(readings, batches)
    return RefocusTraining(trained, *scores, batches[0], readings[0])


def read_batch(network: RefocusNetwork, batch: Batch) -> Reading:
    """Each capture of a batch, focused on the distance that is commanded for it."""
    return read(network, batch.capture, batch.commanded[:, None], batch.deviation)


def score(readings: Sequence[Reading], batches: Sequence[Batch]) -> NetworkScores:
    """Mean PSNR and SSIM of focused images and of those sharp everywhere, and the consistency."""
    found: dict[str, list[float]] = {}
    for reading, batch in zip(readings, batches, strict=True):
        pairs = {
            "focus": (reading.images[:, 0], batch.image),
            "all_in_focus": (reading.all_in_focus, batch.all_in_focus),
        }
        for name, (images, truths) in pairs.items():
            for image, truth in zip(np.asarray(images), np.asarray(truths), strict=True):
                arrays = image.astype(float), truth.astype(float)
                found.setdefault(f"{name}_psnr_db", []).append(float(psnr(*arrays)))
                found.setdefault(f"{name}_ssim", []).append(float(ssim(*arrays)))
        found.setdefault("consistency", []).extend(np.asarray(reading.consistency).tolist())
    return NetworkScores(**{name: finite(np.mean(values)) for name, values in found.items()})


def finite(value: Any) -> float | None:
    """Number to four decimals; None where it is not finite, which JSON has no number for."""
    return round(float(value), 4) if np.isfinite(value) else None
