"""What was seen: captures with all that is known of how they were taken."""

import dataclasses
import functools
import math
import operator
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import same_parity
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.module import Module
from thincam_jax.imaging.operators import (
    AbstractOperator,
    CropConvolution,
    Masked,
    Scaled,
    Stacked,
    kernel_shape,
    window_shape,
)
from thincam_jax.imaging.operators.base import is_shape, shapes_of
from thincam_jax.imaging.operators.crop_convolution import cut
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.drive import Outcome
from thincam_jax.reconstruction.noise import estimate_variance, given_variances
from thincam_jax.reconstruction.problem import InverseProblem
from thincam_jax.reconstruction.registration import distance_ratios, register
from thincam_jax.reconstruction.regularisers import AbstractRegulariser
from thincam_jax.reconstruction.seen_by import Cameras, Psfs
from thincam_jax.reconstruction.solver import Reconstruction
from thincam_jax.reconstruction.synthesis import check_synthesis, separate


class Recording(Module):
    """What was seen: captures, how they came about, their noise, and the pixels to trust.

    **Arguments**

    - `captures`: (capture, *batch, y, x), or a list of (*batch, y, x), one for each of `seen_by`.
      The last batch axis is the colour channel. With operators (*batch, …) of each, with the axes
      that the operator's captures have.
    - `seen_by`: `Cameras`, whose PSFs are computed; `Psfs`, which were measured; or an operator of
      `thincam_jax.imaging.operators`, or a list of them, which all see one image.
    - `noise_variance`: one number, or one for each capture, in the captures' units squared;
      estimated where it is not given (see `estimate_variance`), which takes captures that are
      images.
    - `valid`: mask of the pixels to trust, that broadcasts to the captures.

    **Errors**: ValueError, one line, for captures that do not fit what has seen them.
    """

    captures: tuple[Float[Array, "..."], ...]
    seen_by: Cameras | Psfs | Stacked
    noise_variance: Any
    valid: tuple[Array, ...] | None

    def __init__(
        self, captures: Any, seen_by: Any, *, noise_variance: Any = None, valid: Any = None
    ):
        if isinstance(seen_by, Sequence) and seen_by and isinstance(seen_by[0], LenslessCamera):
            raise TypeError(
                "a list of cameras does not say in which light; give tc.Cameras(cameras, "
                "wavelength=…, object_distance=…)"
            )
        if isinstance(seen_by, AbstractOperator):
            if is_shape(seen_by.out_shape):
                captures, valid = [captures], None if valid is None else [valid]
            seen_by = [seen_by]
        if isinstance(seen_by, Sequence):
            if not all(isinstance(one, AbstractOperator) for one in seen_by):
                raise TypeError("seen_by holds something else than operators; give operators only")
            seen_by = Stacked([part for one in seen_by for part in _apart(one)])
            captures, valid = (_flat(parts) for parts in (captures, valid))
        if not isinstance(seen_by, Cameras | Psfs | Stacked):
            raise TypeError(
                f"the captures were seen by a {type(seen_by).__name__}; give tc.Cameras(…), "
                "tc.Psfs(…), or operators"
            )
        self.seen_by = seen_by
        self.captures = tuple(_floating(c) for c in captures)
        self._check_captures(getattr(captures, "shape", [c.shape for c in self.captures]))
        self.noise_variance = noise_variance
        self.valid = None if valid is None else self._masks(valid)
        if self.valid and not any(checks.is_traced(m) or np.asarray(m).any() for m in self.valid):
            raise ValueError("valid is False everywhere; give a mask with pixels to trust")
        if not isinstance(seen_by, Stacked):  # operators may have masks of their own
            self._require_finite()

    def problem(
        self,
        *,
        tau: Any = 2.0,
        regulariser: AbstractRegulariser | None = None,
        nonnegative: bool = True,
        synthesis: Any = None,
    ) -> InverseProblem:
        """What an iterative method is to minimise; see `InverseProblem` for the arguments.

        - `synthesis`: real matrix (channel × capture) of sums of captures that are reconstructed in
          place of the captures; default: the captures. Sums in which the bright background cancels
          converge much faster.
        """
        captures, valid = self._trusted()
        settings = {"tau": tau, "regulariser": regulariser, "nonnegative": nonnegative}
        if isinstance(self.seen_by, Stacked):
            _no_synthesis(synthesis, "operators")
            variances = self._variances(np.eye(len(captures)), captures, valid)
            shapes = shapes_of(self.seen_by.out_shape)
            lengths = [len(s) - _channels(o) for s, o in self._detectors(shapes)]
            captures = [_with_channel(c, n) for c, n in zip(captures, lengths, strict=True)]
            weights = [
                1 / v if m is None else _with_channel(m.astype(c.dtype), n) / v
                for m, v, c, n in zip(valid, variances, captures, lengths, strict=True)
            ]
            return InverseProblem(self.seen_by.operators, captures, weights=weights, **settings)
        matrix, sums = self._sums(synthesis, captures, valid)
        variances = [
            variance * s.ratio**2
            for variance, s in zip(self._variances(matrix, captures, valid), sums, strict=True)
        ]
        pitch = self._pitch(captures[0].dtype)
        return _convolutions(sums, variances, pitch, self._field(), settings)

    def reconstruction(
        self, problem: InverseProblem, outcome: Outcome, method: str, tau: float | None = None
    ) -> Reconstruction:
        """The image of an outcome with the axes of the captures, upright, and how it came about."""
        image, pitch = outcome.image, None
        if isinstance(self.seen_by, Cameras):
            pitch = self.seen_by.pitch
        elif isinstance(self.seen_by, Psfs) and self.seen_by.field_shape is None:
            image = middle(image, self.captures[0].shape[-2:])  # the part in front of the sensor
        planes = image.shape[-3]
        batch = image.shape[:-3] if self._has_channel() else image.shape[:-4]
        image = image.reshape(*batch, *((planes,) if planes > 1 else ()), *image.shape[-2:])
        return Reconstruction(
            self.oriented(image),
            pitch,
            method,
            ending=outcome.status,
            history=outcome.history,
            iterations=outcome.iterations,
            seconds=outcome.seconds,
            tau=tau,
        )

    def oriented(self, image: Float[Array, "..."]):
        """An image as the scene is: cameras turn it over; the other way it is the same."""
        if not isinstance(self.seen_by, Cameras):
            return image
        return jnp.asarray(image)[..., ::-1, ::-1]

    def with_noise(self, variance: Numbers) -> "Recording":
        """The same recording with another noise variance."""
        none = {"is_leaf": lambda leaf: leaf is None}
        return eqx.tree_at(lambda recording: recording.noise_variance, self, variance, **none)

    def focused(self, object_distance: Numbers | Sequence[Number]) -> "Recording":
        """The same recording with its `Cameras` focused on another distance, mm."""
        if not isinstance(self.seen_by, Cameras):
            raise ValueError("a distance is that of computed PSFs; this recording has no Cameras")
        focused = dataclasses.replace(self.seen_by, object_distance=object_distance)
        return dataclasses.replace(self, seen_by=focused)

    def _check_captures(self, given) -> None:
        """As many as were seen; what cameras and PSFs see are images of one shape."""
        seen_by, shapes = self.seen_by, [c.shape for c in self.captures]
        count = len(seen_by.operators) if isinstance(seen_by, Stacked) else seen_by.count
        unlike = len(set(shapes)) > 1 or any(len(shape) < 2 for shape in shapes)
        if len(shapes) != count or (unlike and not isinstance(seen_by, Stacked)):
            raise ValueError(
                f"captures have shape {given} for {count} cameras, PSFs or operators; give "
                f"({count}, …, y, x)"
            )
        if not isinstance(seen_by, Stacked):
            checks.channels_first("a capture", shapes[0])
        if isinstance(seen_by, Cameras):
            sensor, pixels = seen_by.cameras[0].sensor.shape, shapes[0][-2:]
            if pixels != sensor:
                raise ValueError(f"captures have {pixels} pixels, the cameras' sensor {sensor}")

    def _require_finite(self) -> None:
        """Trusted pixels are numbers."""
        for number, (capture, valid) in enumerate(zip(*self._trusted(), strict=True)):
            known = not checks.is_traced(capture) and not checks.is_traced(valid)
            if known and not bool(jnp.isfinite(capture).all()):
                raise ValueError(
                    f"captures[{number}] holds NaN or infinity; mend it, or leave such pixels out "
                    "with valid=numpy.isfinite(captures)"
                )

    def _detectors(self, shapes):
        return zip(shapes, self.seen_by.operators, strict=True)  # type: ignore[union-attr]

    def _has_channel(self) -> bool:
        """Whether the captures have an axis before those of the detector."""
        if isinstance(self.seen_by, Stacked):
            shape = shapes_of(self.seen_by.out_shape)[0]
            return self.captures[0].ndim > len(shape) - _channels(self.seen_by.operators[0])
        return self.captures[0].ndim > 2

    def _masks(self, valid: Any) -> tuple[Array, ...]:
        """A mask for each capture."""
        shapes = [c.shape for c in self.captures]
        if not isinstance(valid, tuple | list):
            valid = jnp.asarray(valid)
            valid = list(valid) if valid.ndim > len(shapes[0]) else [valid]
        if len(valid) == 1:
            valid = [*valid] * len(shapes)
        try:
            pairs = zip(valid, shapes, strict=True)
            return tuple(jnp.broadcast_to(jnp.asarray(m, bool), s) for m, s in pairs)
        except ValueError:
            given = [jnp.shape(m) for m in valid]
            raise ValueError(
                f"valid has shapes {given}; give a mask for each capture, of shapes {shapes}"
            ) from None

    def _trusted(self) -> tuple[list[Array], list[Array | None]]:
        """Captures and masks; what is neither valid nor finite becomes 0."""
        if self.valid is None:
            return list(self.captures), [None] * len(self.captures)
        pairs = list(zip(self.captures, self.valid, strict=True))
        return [jnp.where(m | jnp.isfinite(c), c, 0) for c, m in pairs], [m for _, m in pairs]

    def _variances(self, matrix: np.ndarray, captures, valid) -> list[Float[Array, ""]]:
        """Variances of sums of captures: as given, or estimated where that is nothing or zero."""
        squares = [jnp.asarray(row**2, captures[0].dtype) for row in matrix]
        if self.noise_variance is None:
            each = self._estimated(captures, valid)
            return [jnp.sum(square * each) for square in squares]
        with jax.ensure_compile_time_eval():  # a variance that is known stays so under jit
            given = given_variances(self.noise_variance, captures)
            totals = [jnp.sum(jnp.asarray(row**2, given.dtype) * given) for row in matrix]
        if all(not checks.is_traced(total) and float(total) > 0 for total in totals):
            return totals
        each = self._estimated(captures, valid)
        pairs = zip(totals, squares, strict=True)
        return [jnp.where(t > 0, t, jnp.sum(s * each)) for t, s in pairs]

    def _estimated(self, captures, valid) -> Float[Array, " capture"]:
        seen_by = self.seen_by
        if isinstance(seen_by, Stacked) and any(len(s) < 2 for s in shapes_of(seen_by.out_shape)):
            raise ValueError("give noise_variance: captures that are no images do not show it")
        return estimate_variance(captures, None if valid[0] is None else valid)

    def _pitch(self, dtype) -> Float[Array, ""]:
        if isinstance(self.seen_by, Cameras):
            return self.seen_by.cameras[0].sensor.pitch
        return jnp.ones((), dtype)

    def _field(self) -> tuple[int, int]:
        seen_by, sensor = self.seen_by, self.captures[0].shape[-2:]
        if isinstance(seen_by, Cameras):
            grid = seen_by.cameras[0].sensor.grid
            return same_parity(seen_by.field_shape or grid.shape, grid.shape)
        kernel = seen_by.psfs.shape[-2:]  # type: ignore[union-attr]
        whole = tuple(s + k - 1 for s, k in zip(sensor, kernel, strict=True))
        return _fitting_field(seen_by.field_shape or whole, sensor, kernel)  # type: ignore

    def _sums(self, synthesis, captures, valid) -> tuple[np.ndarray, list["_Sum"]]:
        """The rows of a synthesis with their kernels and captures."""
        seen_by = self.seen_by
        count = len(captures)
        matrix = separate(count) if synthesis is None else np.asarray(synthesis, dtype=float)
        if isinstance(seen_by, Cameras):
            ratios = distance_ratios(seen_by.cameras)
            check_synthesis(matrix, seen_by.cameras, ratios)
            kernels = seen_by.kernels(self._field(), ratios)
        else:
            _no_synthesis(synthesis, "measured PSFs")
            ratios = [1.0] * count
            kernels = list(seen_by.psfs.astype(captures[0].dtype))  # type: ignore[union-attr]
        return matrix, [_Sum(row, kernels, captures, valid, ratios) for row in matrix]


class _Sum:
    """One row of a synthesis: its kernel, its capture, and where this is to be trusted."""

    def __init__(self, row: np.ndarray, kernels, captures, valid, ratios):
        used = [(float(w), k) for k, w in enumerate(row) if w]
        self.ratio = ratios[used[0][1]]
        self.kernel = functools.reduce(operator.add, [w * kernels[k] for w, k in used])
        whole = functools.reduce(operator.add, [w * captures[k] for w, k in used])
        self.capture = _with_channel(register(whole, self.ratio), 2)
        self.valid = None
        if valid[0] is not None or self.ratio > 1:
            both = jnp.ones(captures[0].shape, bool)
            if valid[0] is not None:
                both = jnp.all(jnp.stack([valid[k] for _, k in used]), axis=0)
            # A pixel that an invalid one, or the dark beyond the sensor, has been interpolated into
            # is not trusted either; the interpolation overshoots, too.
            seen = register(both.astype(captures[0].dtype), self.ratio)
            self.valid = _with_channel(jnp.abs(seen - 1) < 0.01, 2)


def _convolutions(sums, variances, pitch, field_shape, settings) -> InverseProblem:
    """Operators on one window, and their weights."""
    dtype = sums[0].capture.dtype
    windows = [
        window_shape(s.capture.shape[-2:], field_shape, _reach(s.kernel, s.capture, field_shape))
        for s in sums
    ]
    window = (max(w[0] for w in windows), max(w[1] for w in windows))
    # Captures, kernels and a field, each with its transform, at the least.
    refuse_if_too_large(
        f"a reconstruction on a field of {field_shape[0]}×{field_shape[1]} pixels",
        dtype.itemsize * math.prod(window) * (2 * len(sums) + 3),
        "give a smaller field_shape, fewer pixels or fewer captures",
    )
    operators = [
        CropConvolution(
            s.kernel.astype(dtype),
            pitch.astype(dtype),
            s.capture.shape[-2:],
            field_shape,
            summed=1,
            window=window,
        )
        for s in sums
    ]
    weights = [
        (1.0 if s.valid is None else s.valid.astype(dtype)) / v
        for s, v in zip(sums, variances, strict=True)
    ]
    return InverseProblem(operators, [s.capture for s in sums], weights=weights, **settings)


def middle(image: Float[Array, "*batch y x"], shape: Sequence[int]) -> Float[Array, "*batch v u"]:
    """The middle of an image."""
    corner = [(n - s) // 2 for n, s in zip(image.shape[-2:], shape, strict=True)]
    return cut(image, corner, shape)


def _floating(capture) -> Array:
    """Raw counts are taken as they are, but as real numbers."""
    capture = jnp.asarray(capture)
    if jnp.issubdtype(capture.dtype, jnp.complexfloating):
        raise TypeError(f"a capture is {capture.dtype}; give real numbers")
    return capture if jnp.issubdtype(capture.dtype, jnp.floating) else capture.astype(float)


def _apart(operator: AbstractOperator) -> list[AbstractOperator]:
    """Operators of one capture each in place of one of several, with its masks and gains."""
    if isinstance(operator, Stacked):
        return [part for one in operator.operators for part in _apart(one)]
    if is_shape(operator.out_shape) or not isinstance(operator, Masked | Scaled):
        return [operator]
    given = operator.valid if isinstance(operator, Masked) else operator.gain
    inside = _apart(operator.operator)
    values = jax.tree.leaves(given) if isinstance(given, tuple) else [given] * len(inside)
    return [type(operator)(one, value) for one, value in zip(inside, values, strict=True)]


def _flat(parts: Any) -> Any:
    """The arrays of a nested tuple; one array of several captures, or None, as it is."""
    return jax.tree.leaves(parts) if isinstance(parts, tuple | list) else parts


def _channels(operator: AbstractOperator) -> int:
    """1 if the operator's own axes begin with the colour channel."""
    return int(len(operator.in_shape) == 4)


def _with_channel(capture: Array, axes: int) -> Array:
    """A capture with an axis for the colour before its own axes."""
    return capture[None] if capture.ndim == axes else capture


def _no_synthesis(synthesis, what: str) -> None:
    if synthesis is not None:
        raise ValueError(f"a synthesis adds captures of known cameras; leave it out with {what}")


def _reach(kernel, capture, field_shape) -> tuple[int, int]:
    """What of a kernel can send light from the field to the sensor."""
    most = kernel_shape(capture.shape[-2:], field_shape)
    rows, columns = (min(k, m) for k, m in zip(kernel.shape[-2:], most, strict=True))
    return rows, columns


def _fitting_field(field_shape, sensor, kernel) -> tuple[int, int]:
    """A field whose centre fits the sensor's and the PSF's samples: smaller by one if need be."""
    shape = checks.shape2d("field_shape", field_shape)
    sizes = zip(shape, sensor, kernel, strict=True)
    rows, columns = (max(f - (s + f - 1 - k) % 2, 1) for f, s, k in sizes)
    return rows, columns
