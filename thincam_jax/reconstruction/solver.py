"""Solvers as objects: their base classes and the checks of their settings."""

import abc
import functools
import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax.imaging.operators.crop_convolution import place
from thincam_jax.reconstruction.iterate import Callback
from thincam_jax.reconstruction.problem import InverseProblem, compiled_level
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import AbstractRegulariser, Image
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.total_variation import TotalVariation

# A real matrix (channel × capture): sums of captures, reconstructed in place of the captures.
Synthesis = Numbers | Sequence[Sequence[float]]

TauRule = Literal["discrepancy", "sure"]

DEFAULT_TAU = 2.0


class AbstractSolver(Module):
    """A reconstruction method; its fields are all of its settings."""

    name: ClassVar[str]

    @abc.abstractmethod
    def solve(self, recording: Recording) -> Reconstruction:
        """Reconstruct the image of a recording."""


class AbstractIterativeSolver(AbstractSolver):
    """A solver that iterates: it accepts a start image and reports its progress."""

    @abc.abstractmethod
    def solve(
        self,
        recording: Recording,
        *,
        start: Float[Array, "..."] | None = None,
        callback: Callback | None = None,
    ) -> Reconstruction:
        """Reconstruct the image of a recording; see `reconstruct` for the arguments."""


def as_tolerance(tolerance: float) -> float:
    """Check a tolerance of residuals."""
    checks.non_negative("tolerance", tolerance, "a ratio")
    return tolerance


def as_synthesis(synthesis: Synthesis | None) -> np.ndarray | None:
    """The matrix of a synthesis, (channel, capture)."""
    return None if synthesis is None else np.asarray(synthesis, dtype=float)


def as_tau(name: str, tau: Any) -> Any:
    """Check τ ≥ 0, or the name of a rule that chooses it."""
    if isinstance(tau, str):
        return checks.choice(name, tau, get_args(TauRule))
    return checks.non_negative(name, tau, "a ratio")


def of_kind(name: str, value: Any, kind: type):
    """Check the type of a value; by default an instance of that type with its defaults."""
    if value is None:
        return kind()
    if not isinstance(value, kind):
        wanted = kind.__name__.removeprefix("Abstract")
        raise ValueError(f"{name} is a {type(value).__name__}; give a {wanted}")
    return value


as_variation = functools.partial(of_kind, "variation", kind=TotalVariation)


def as_regulariser(value: Any) -> AbstractRegulariser:
    """The regulariser given; total variation by default."""
    return TotalVariation() if value is None else of_kind("regulariser", value, AbstractRegulariser)


def first_image(
    problem: InverseProblem, start: Float[Array, "..."] | None, *, uniform: bool
) -> Image:
    """The start image, padded with zeros to the field; by default uniform, or zero."""
    shape, dtype = problem.image_shape, problem.captures[0].dtype
    if start is None:
        level = compiled_level(problem)[..., None, None, None] if uniform else np.zeros((), dtype)
        return jnp.asarray(np.broadcast_to(np.asarray(level), shape))
    start = checks.array("start", start).astype(dtype)
    if not checks.is_traced(start) and not bool(jnp.isfinite(start).all()):
        raise ValueError("start holds NaN or infinity; give a finite image")
    if start.ndim < 2 or start.size != math.prod((*shape[:-2], *start.shape[-2:])):
        raise ValueError(
            f"start has shape {start.shape}; give an image of the result's batch and planes, "
            f"{shape[:-2]}, and its rows and columns"
        )
    rows, columns = start.shape[-2:]
    start = start.reshape(*shape[:-2], rows, columns)
    if (rows, columns) == problem.field_shape:
        return start
    corner = [(f - n) // 2 for f, n in zip(problem.field_shape, (rows, columns), strict=True)]
    if min(corner) < 0:
        raise ValueError(
            f"start has {rows}×{columns} pixels, more than the field's {problem.field_shape}"
        )
    return place(start, corner, problem.field_shape)
