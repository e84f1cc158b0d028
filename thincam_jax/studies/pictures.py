"""Pictures on the cells of a monitor: reconstructed from captures by a matrix, and scored."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.quantity import check_fields, quantity
from thincam_jax._core.table import Table
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.imaging.operators import AbstractOperator
from thincam_jax.reconstruction import AbstractSolver
from thincam_jax.reconstruction.methods import reconstruct
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies.evaluate import rounded

PUBLISHED = (
    "Ours are simulated, the published ones measured: the differences are those of the two, not of "
    "the methods. Times are with compilation, all images together."
)


_SHOWN = 3  # cells whose columns of the matrix are compared with the exact ones


class ScreenCaptures(eqx.Module):
    """Captures (target, *channel, y, x), or reduced ones, and the variance of their noise."""

    images: Array
    variance: Array


def diagonal_cells(shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Cells (row, column) spread along a diagonal of the object."""
    rows, columns = ((2 * np.arange(_SHOWN) + 1) * n // (2 * _SHOWN) for n in shape)
    return [(int(row), int(column)) for row, column in zip(rows, columns, strict=True)]


def reconstruct_targets(
    system: AbstractOperator, solver: AbstractSolver, captures: ScreenCaptures
) -> Reconstruction:
    """All targets at once, (target, *channel, y, x); what a study leaves in them stays light."""
    given = {"noise_variance": captures.variance[None], "background": 0.0}
    return reconstruct(Recording(captures.images[None], [system], **given), solver)


@dataclass(frozen=True)
class TargetScores:
    """Agreement of a reconstruction with its target; the PSNR of an exact one is None."""

    psnr_db: float | None
    ssim: float


@dataclass(frozen=True)
class SolverScores:
    """Figures of merit of a solver with a model; `targets` by name. The time has compilation."""

    mean_psnr_db: float | None
    seconds_per_image: float
    status: str
    iterations: int
    targets: dict[str, TargetScores]


@dataclass(frozen=True, eq=False)
class Reconstructed:
    """The targets as a solver reconstructs them with a model, and their scores."""

    images: Float[np.ndarray, "target y x *channel"]
    scores: SolverScores


def reconstructed(
    targets: Mapping[str, np.ndarray | None],
    solver: AbstractSolver,
    system: AbstractOperator,
    captures: ScreenCaptures,
) -> Reconstructed:
    """Reconstruct targets from captures by a matrix, and score those that are known."""
    began = time.perf_counter()
    found = reconstruct_targets(system, solver, captures)
    images = np.asarray(found.image, float)
    images = images.reshape(len(targets), -1, *images.shape[-2:])
    images = images[:, 0] if images.shape[1] == 1 else np.moveaxis(images, 1, -1)
    seconds = time.perf_counter() - began
    pairs = [
        (name, image, truth)
        for (name, truth), image in zip(targets.items(), images, strict=True)
        if truth is not None
    ]
    scores = [psnr(image, truth) for _, image, truth in pairs]
    of_targets = {
        name: TargetScores(rounded(score), round(ssim(image, truth), 4))
        for score, (name, image, truth) in zip(scores, pairs, strict=True)
    }
    mean = rounded(float(np.mean(scores))) if scores else None
    means = mean, round(seconds / len(images), 3)
    return Reconstructed(images, SolverScores(*means, found.status, found.iterations, of_targets))


def finding(methods: Mapping[str, Reconstructed]) -> str:
    """Sentence on how well the last method does."""
    name, one = list(methods.items())[-1]
    mean, count = one.scores.mean_psnr_db, len(one.scores.targets)
    near = "exactly" if mean is None else f"at {mean:.1f} dB on average"
    return f"{name} reconstructs {count} picture{'s' * (count > 1)} {near}."


@dataclass(frozen=True)
class PublishedImage:
    """Figures that a publication gives for a target and a solver; None where it gives none."""

    psnr_db: Annotated[float | None, quantity("dB", check=checks.decibels, optional=True)] = None
    seconds: Annotated[float | None, quantity("seconds", positive=True, optional=True)] = None

    def __post_init__(self):
        check_fields(self)


def beside(
    found: Mapping[str, Reconstructed], published: Mapping[str, Mapping[str, PublishedImage]]
) -> Table:
    """Scores of every target, beside what was published of it.

    - `found`: by solver. `published`: by target and solver; either may be missing.
    """
    methods = {name: one.scores for name, one in found.items()}
    others, rows = (list(methods) if any(published.values()) else []), []
    for target in next(iter(methods.values())).targets:
        own = [scores.targets[target] for scores in methods.values()]
        stated = [published.get(target, {}).get(name, PublishedImage()) for name in others]
        theirs = (number for one in stated for number in (one.psnr_db, one.seconds))
        rows.append((target, *(n for one in own for n in (one.psnr_db, one.ssim)), *theirs))
    seconds = (t for s in methods.values() for t in (f"{s.seconds_per_image:.2f}", ""))
    rows.append(("time for an image, s", *seconds, *[""] * (2 * len(others))))
    ours = (heading for name in methods for heading in (f"{name}\nPSNR dB", "SSIM"))
    theirs = (h for name in others for h in (f"published\n{name}, dB", "published\ns"))
    count, more = 2 * len(methods), 2 * len(others)
    digits = (*(1, 3) * len(methods), *(1,) * more)
    columns = range(count + 1, count + more + 1)
    return Table(("target", *ours, *theirs), rows, digits, published=columns)
