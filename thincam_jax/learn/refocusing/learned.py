"""A trained network as a solver: `tc.reconstruct(recording, tc.Learned(network))`."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.table import Table
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.learn.refocusing.network import RefocusNetwork, explain, flattened
from thincam_jax.learn.refocusing.scenes import Batch
from thincam_jax.learn.refocusing.store import SHIPPED, described, same_camera
from thincam_jax.learn.training import Trained
from thincam_jax.reconstruction.depth.refocus import RefocusSweep, refocus_distances
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.noise import estimate_variance, given_variances
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.solver import AbstractSolver

# Residual over noise from which an image is doubted.
_DOUBTED = 1.5
# Confidence below which commands and reports mark a pixel.
SURE = 0.5


class Reading(Module):
    """All that a network reads from captures; see `RefocusNetwork`.

    All but `images` is from the explanation that is focused on the first distance.
    """

    images: Float[Array, "*batch distance y x"]
    all_in_focus: Float[Array, "*batch y x"]
    distance: Float[Array, "*batch y x"]
    confidence: Float[Array, "*batch y x"]
    consistency: Float[Array, "*batch"]


def read(
    network: RefocusNetwork,
    captures: Numbers,
    distances: Numbers | Sequence[Number],
    noise_std: Numbers,
) -> Reading:
    """Images focused on each of `distances`, mm, and everything else, for captures (*batch, y, x).

    `distances`: (distance,), or (*batch, distance) with their own for each capture.
    """
    captures, noise_std, batch = flattened(network, captures, noise_std)
    each = network.camera.within(distances)
    count = each.shape[-1]
    each = jnp.broadcast_to(each, (*batch, count))
    found = _read(network, captures, noise_std, each.reshape(-1, count))
    return jax.tree.map(lambda a: a.reshape(*batch, *a.shape[1:]), found)


@eqx.filter_jit
def _read(network: RefocusNetwork, captures, deviations, distances) -> Reading:
    return jax.vmap(lambda *one: _read_one(network, *one))(captures, deviations, distances)


def _read_one(network: RefocusNetwork, capture, noise_std, distances) -> Reading:
    explained = jax.vmap(lambda t: explain(network, capture, noise_std, t))(distances)
    first = jax.tree.map(lambda leaf: leaf[0], explained)
    seen = first.distance
    return Reading(
        first.mean * explained.cleaned.image,
        first.all_in_focus,
        seen.distance,
        seen.confidence,
        first.consistency,
    )


class Learned(AbstractSolver):
    """A refocusing network as a solver, for captures (*batch, y, x) of its camera.

    Focused on the recording's object distances; several are planes of the result. What it gives
    may be made up where the capture does not tell: see `Reconstruction.consistency` and
    `Reconstruction.confidence`.

    - `network`: trained, see `RefocusNetwork.load`; default the one that comes with the package,
      for its camera.
    - `output`: "focus", or "all_in_focus", which needs no distance.

    **Errors**: ValueError, one line, for another camera, a distance outside of what the network
    was trained for, pixels that are not to be trusted, and a field of another size.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    from thincam_jax import learn

    mask = tc.FresnelZoneAperture(beta=13.0, width=5.6)
    thin = tc.LenslessCamera(mask, tc.Sensor((256, 256), 44 * um), distance=7.5)
    network = learn.RefocusNetwork.load("shipped", thin)
    solver = tc.Learned(network, output="focus")
    ```

    **See also**: `reconstruct`.
    """

    name: ClassVar[str] = "learned"
    network: RefocusNetwork | None = None
    output: Literal["focus", "all_in_focus"] = eqx.field(static=True, default="focus")

    def __check_init__(self):
        checks.choice("output", self.output, ("focus", "all_in_focus"))

    def solve(self, recording: Recording) -> Reconstruction:
        began, model = time.perf_counter(), recording.imaging_model
        if not isinstance(model, Cameras):
            raise ValueError("a network belongs to a camera; give a recording by tc.Cameras")
        network = RefocusNetwork.load(SHIPPED, model) if self.network is None else self.network
        camera = network.camera
        same_camera("the network", described(camera), model)
        if model.pixels not in (None, camera.field_shape):
            raise ValueError(
                f"field_shape is {model.pixels} and the network's {camera.field_shape}; "
                "leave it out"
            )
        if recording.valid is not None and not all(np.asarray(m).all() for m in recording.valid):
            raise ValueError("the network takes every pixel of a capture; mend those not valid")
        (capture,) = recording.captures
        variance = recording.noise_variance
        known = None if variance is None else given_variances(variance, recording.captures)
        variance = estimate_variance(recording.captures) if known is None else known
        is_focused, distance = self.output == "focus", camera.far
        if is_focused:
            model.require("object_distance")
            distance = model.object_distance
        distances = jnp.atleast_1d(jnp.asarray(distance))
        found = read(network, capture, distances, jnp.sqrt(variance[0]))
        image, pitch = found.all_in_focus, None
        if is_focused:
            planes = np.ndim(distance) == 1
            image, pitch = found.images if planes else found.images[..., 0, :, :], model.pitch
        image, confidence = (
            jax.block_until_ready(a)[..., ::-1, ::-1] for a in (image, found.confidence)
        )
        return Reconstruction(
            image,
            pitch,
            self.name,
            reason=doubt(float(jnp.max(found.consistency))),
            seconds=time.perf_counter() - began,
            consistency=found.consistency,
            confidence=confidence,
        )


def doubt(consistency: float) -> str:
    """Warning in words where an image does not explain its capture; else empty."""
    if consistency < _DOUBTED:
        return ""
    return (
        f"what the network explains misses the capture by {consistency:.1f} times the noise: it "
        "may be of another camera, of distances outside of the range, or not be true"
    )


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
