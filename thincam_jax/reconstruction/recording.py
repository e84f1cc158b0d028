"""Recordings: captures with their imaging model and noise."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import same_parity
from thincam_jax._core.module import Module
from thincam_jax.imaging.operators import AbstractOperator, Masked, Stacked
from thincam_jax.imaging.operators.base import is_shape, shapes_of
from thincam_jax.imaging.operators.crop_convolution import centred_crop
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.assembly import convolution_problem, fitting_field
from thincam_jax.reconstruction.backgrounds import shows_brightness
from thincam_jax.reconstruction.imaging_model import Cameras, Psfs, distance_ratios
from thincam_jax.reconstruction.iterate import Outcome
from thincam_jax.reconstruction.noise import (
    BY_NOISE,
    estimate_variance,
    given_variances,
    square_below_black,
    valid_pixels,
    without_unknown,
)
from thincam_jax.reconstruction.problem import Background, InverseProblem, as_real, detector_shape
from thincam_jax.reconstruction.regularisers import AbstractRegulariser
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.synthesis import (
    SynthesisRow,
    channel_capture,
    separate,
    synthesis_matrix,
    with_channel,
)
from thincam_jax.reconstruction.unseen import unseen_variance


class Recording(Module):
    """Captures with their imaging model, their noise and the mask of valid pixels.

    **Arguments**

    - `captures`: (capture, *batch, y, x), or a list of (*batch, y, x), one for each camera, PSF or
      operator of `imaging_model`. The last batch axis is the colour channel. With operators
      (*batch, …), with the axes that the operator's captures have.
    - `imaging_model`: `Cameras`, whose PSFs are computed; `Psfs`, which were measured; or an
      operator of `thincam_jax.imaging.operators`, or a list of operators of one image.
    - `noise_variance`: one number, or one for each capture, in the captures' units squared. By
      default it is estimated by `estimate_variance`, which needs captures that are images.
    - `valid`: mask of the valid pixels, that broadcasts to the captures. Those that are masked
      (`numpy.ma`) or NaN are not valid either. By default neither are hot and dead pixels, nor
      those of a plateau at the largest value, which are saturated. A warning says how many.
    - `background`: known light that is not the scene's, such as a black level or a dark frame: one
      for all captures, or one for each, that broadcasts to them. By default it is unknown: a
      uniform background of each capture and colour is found with the image (but by `Wiener`,
      `FringeScanning` and `PoissonTV`). It is negative only in captures that are partly darker than
      black by more than noise. Give 0 where there is none to `Ridge` of a dark room, which is
      otherwise some 0.6 dB worse. With operators it is 0 where a uniform image casts a uniform
      capture, which leaves the brightness open, or captures are no images.

    **Errors**: ValueError, one line, for captures that do not fit the imaging model.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, tc.AdmmTV(iterations=10))
    ```

    **See also**: `Cameras`, `Psfs`, `reconstruct`.
    """

    captures: tuple[Float[Array, "..."], ...]
    imaging_model: Cameras | Psfs | Stacked
    noise_variance: Any
    valid: tuple[Array, ...] | None
    background: Any

    def __init__(
        self,
        captures: Any,
        imaging_model: Any,
        *,
        noise_variance: Any = None,
        valid: Any = None,
        background: Any = None,
    ):
        if isinstance(imaging_model, AbstractOperator):
            if is_shape(imaging_model.out_shape):
                captures, valid = [captures], None if valid is None else [valid]
            imaging_model = [imaging_model]
        if isinstance(imaging_model, Sequence):
            if any(isinstance(one, LenslessCamera) for one in imaging_model):
                raise TypeError(
                    "a list of cameras does not say in which light; give tc.Cameras(cameras, "
                    "wavelength=…, object_distance=…)"
                )
            if not all(isinstance(one, AbstractOperator) for one in imaging_model):
                raise TypeError(
                    "imaging_model holds objects that are no operators; give operators only"
                )
            imaging_model = Stacked(
                [part for one in imaging_model for part in _single_captures(one)]
            )
            captures, valid = (_flat(parts) for parts in (captures, valid))
        if not isinstance(imaging_model, Cameras | Psfs | Stacked):
            raise TypeError(
                f"imaging_model is a {type(imaging_model).__name__}; give tc.Cameras(…), "
                "tc.Psfs(…), or operators"
            )
        self.imaging_model = imaging_model
        if not isinstance(captures, list | tuple) and np.ndim(captures) == 0:
            raise TypeError(f"captures is {checks.shown(captures)}; give an array for each camera")
        pairs = [without_unknown(one) for one in checks.staying_known(list, captures)]
        self.captures, known = tuple(as_real(c) for c, _ in pairs), [one for _, one in pairs]
        self._check_captures(getattr(captures, "shape", [c.shape for c in self.captures]))
        self.noise_variance = noise_variance
        self.background = None if background is None else self._backgrounds(background)
        if noise_variance is not None:
            given_variances(noise_variance, self.captures)  # refuses others
        self.valid = None if valid is None else self._masks(valid)
        examined = None
        if valid is None and self._axes() == 2:
            examined = getattr(imaging_model, "operators", [None] * len(self.captures))
        self.valid = valid_pixels(self.captures, known, self.valid, examined)
        if self.valid and not any(checks.is_traced(m) or np.asarray(m).any() for m in self.valid):
            raise ValueError("valid is False everywhere; give a mask with pixels to trust")
        if not isinstance(imaging_model, Stacked):  # operators may have masks of their own
            self.require_finite()

    def problem(
        self,
        *,
        tau: Any = 2.0,
        regulariser: AbstractRegulariser | None = None,
        nonnegative: bool = True,
        synthesis: Any = None,
    ) -> InverseProblem:
        """The problem that an iterative method minimises; see `InverseProblem` for the arguments.

        - `synthesis`: real matrix (channel × capture) of sums of captures that are reconstructed in
          place of the captures; default: the captures. Sums in which the bright background cancels
          converge much faster.
        """
        captures, valid = self._masked_captures()
        estimated = functools.cache(functools.partial(self._estimated, captures, valid))
        noise = self._variances(captures, estimated)
        below = functools.partial(self._is_below_black, captures, noise, estimated)
        settings = {
            "tau": tau,
            "regulariser": regulariser,
            "nonnegative": nonnegative,
            "background": self._kind_of_background(synthesis, nonnegative, below),
        }
        operators = self._operators()
        if operators:
            _no_synthesis(synthesis, "operators")
            variances = _sums(np.eye(len(captures), dtype=noise.dtype), noise)
            lengths = [len(detector_shape(o)) for o in operators]
            captures = [with_channel(c, n) for c, n in zip(captures, lengths, strict=True)]
            weights = [
                1 / v if m is None else with_channel(m.astype(c.dtype), n) / v
                for m, v, c, n in zip(valid, variances, captures, lengths, strict=True)
            ]
            return InverseProblem(operators, captures, weights=weights, **settings)
        matrix, channels = self._channels(synthesis, captures, valid)
        summed = _sums(np.asarray(matrix**2, noise.dtype), noise)
        variances = [v * c.ratio**2 for v, c in zip(summed, channels, strict=True)]
        pitch = self._pitch(captures[0].dtype)
        return convolution_problem(channels, variances, pitch, self._field(), settings)

    def _repr_png_(self) -> bytes:
        """Picture for notebooks: captures and PSF."""
        from thincam_jax.plot.frame import as_png
        from thincam_jax.plot.objects import draw_recording

        return as_png(draw_recording(self))

    def pixel_pitch_and_psf(self) -> tuple[float | None, Any]:
        """Pitch of the captures' pixels, mm, and the first one's PSF; None where not known."""
        model = self.imaging_model
        if isinstance(model, Psfs):
            return None, np.asarray(model.psfs)[0].reshape(-1, *model.psfs.shape[-2:])[0]
        if not isinstance(model, Cameras):
            return None, None
        sensor, distance = model.cameras[0].sensor, model.object_distance
        # Without light and distance, which fringe scanning does not need, there is none.
        if model.over_field or model.wavelength is None or distance is None:
            return float(sensor.pitch), None
        nearest = np.atleast_1d(np.asarray(distance, dtype=object))[0]
        return float(sensor.pitch), model.own_psf(0, sensor.shape, nearest)

    def reconstruction(
        self, outcome: Outcome, method: str, tau: float | None = None
    ) -> Reconstruction:
        """The image of an outcome, upright and with the axes of the captures, with its history."""
        model = self.imaging_model
        return Reconstruction(
            self.shaped(outcome.image),
            model.pitch if isinstance(model, Cameras) else None,
            method,
            ended=outcome.status,
            history=outcome.history,
            iterations=outcome.iterations,
            seconds=outcome.seconds,
            tau=tau,
        )

    def shaped(self, image: Float[Array, "*batch channel plane y x"]) -> Float[Array, "..."]:
        """The image of a problem, upright and with the axes of the captures."""
        if isinstance(self.imaging_model, Psfs) and self.imaging_model.field_shape is None:
            # The part in front of the sensor.
            image = centred_crop(image, self.captures[0].shape[-2:])
        planes = image.shape[-3]
        batch = image.shape[:-3] if self._has_channel() else image.shape[:-4]
        image = image.reshape(*batch, *((planes,) if planes > 1 else ()), *image.shape[-2:])
        return self.oriented(image)

    def oriented(self, image: Float[Array, "..."]):
        """The upright image of the scene: cameras turn it by 180°. It is its own inverse."""
        if not isinstance(self.imaging_model, Cameras):
            return image
        return jnp.asarray(image)[..., ::-1, ::-1]

    def channel_captures(
        self, rows: Sequence[Sequence[float]], ratios: Sequence[float]
    ) -> tuple[Array, ...]:
        """The captures that a problem of PSFs takes, by `synthesis_rows`."""
        captures, _ = self._masked_captures()
        return tuple(channel_capture(row, captures, ratios) for row in rows)

    def with_noise(self, noise_variance: Numbers) -> "Recording":
        """This recording with another noise variance."""
        none = {"is_leaf": lambda leaf: leaf is None}
        return eqx.tree_at(lambda recording: recording.noise_variance, self, noise_variance, **none)

    def with_background(self, background: Any) -> "Recording":
        """This recording with a known background; its captures are not examined again."""
        known, none = self._backgrounds(background), {"is_leaf": lambda x: x is None}
        return eqx.tree_at(lambda recording: recording.background, self, known, **none)

    def focused(self, object_distance: Numbers | Sequence[Number]) -> "Recording":
        """This recording with its `Cameras` focused on another distance, mm."""
        if not isinstance(self.imaging_model, Cameras):
            raise ValueError("only Cameras can be focused; give a recording with tc.Cameras(…)")
        focused = dataclasses.replace(self.imaging_model, object_distance=object_distance)
        return dataclasses.replace(self, imaging_model=focused)

    def _check_captures(self, given) -> None:
        """Require one capture for each model; those of cameras and PSFs are images of one shape."""
        model, shapes = self.imaging_model, [c.shape for c in self.captures]
        count = len(model.operators) if isinstance(model, Stacked) else model.count
        unlike = len(set(shapes)) > 1 or any(len(shape) < 2 or 0 in shape for shape in shapes)
        if len(shapes) != count or (unlike and not isinstance(model, Stacked)):
            raise ValueError(
                f"captures have shape {given} for {count} cameras, PSFs or operators; give "
                f"({count}, …, y, x)"
            )
        if not isinstance(model, Stacked):
            checks.channels_first("a capture", shapes[0])
        if isinstance(model, Psfs):
            given, channels = (1, *shapes[0])[-3], model.psfs.shape[1]
            if channels not in (1, given):
                raise ValueError(
                    f"a capture has {given} channels and its PSF {channels}; give a PSF of 1 "
                    "channel or of as many"
                )
        if isinstance(model, Cameras):
            sensor, pixels = model.cameras[0].sensor.shape, shapes[0][-2:]
            if pixels != sensor:
                raise ValueError(f"captures have {pixels} pixels, the cameras' sensor {sensor}")

    def require_finite(self) -> None:
        """Require finite values in valid pixels."""
        for number, (capture, valid) in enumerate(zip(*self._masked_captures(), strict=True)):
            if checks.is_traced(capture) or checks.is_traced(valid):
                continue
            largest = float(np.max(np.abs(capture)))  # NaN, where one is
            if not math.isfinite(largest):
                raise ValueError(
                    f"captures[{number}] holds NaN or infinity; repair it, or exclude such pixels "
                    "with valid=numpy.isfinite(captures)"
                )
            checks.scaled(f"captures[{number}]", largest)

    def _has_channel(self) -> bool:
        """Whether the captures have an axis before those of the detector."""
        return self.captures[0].ndim > self._axes()

    def _axes(self) -> int:
        """Axes of the detector."""
        model = self.imaging_model
        return len(detector_shape(model.operators[0])) if isinstance(model, Stacked) else 2

    def _operators(self) -> tuple[AbstractOperator, ...]:
        """Operators of a model that is no PSF for the whole field."""
        model = self.imaging_model
        if isinstance(model, Cameras):
            return model.field_operators(self._field()) if model.over_field else ()
        return model.operators if isinstance(model, Stacked) else ()

    def _backgrounds(self, background: Any) -> tuple[Array, ...]:
        """A known background for each capture."""
        several = isinstance(background, tuple | list) or np.ndim(background) > len(
            self.captures[0].shape
        )
        each = [checks.array("background", b) for b in (background if several else [background])]
        each = each * len(self.captures) if len(each) == 1 else each
        shapes = [c.shape for c in self.captures]
        if len(each) != len(shapes) or any(
            n not in (1, m)
            for b, s in zip(each, shapes, strict=True)
            for n, m in zip(b.shape[::-1], (*s[::-1], *(0,) * b.ndim), strict=False)
        ):
            raise ValueError(
                f"background has shapes {[b.shape for b in each]}; give a number or a frame, for "
                f"all captures or one for each, of shapes {shapes}"
            )
        return tuple(each)

    def _kind_of_background(
        self, synthesis: Any, nonnegative: bool, is_below_black: Callable[[], bool]
    ) -> Background:
        """Not negative but in differences of captures, and if something was subtracted before."""
        if self.background is not None or not self.shows_brightness:
            return "known"
        if not nonnegative or (synthesis is not None and bool(np.any(np.asarray(synthesis) < 0))):
            return "unknown"
        return "unknown" if is_below_black() else "nonnegative"

    def _is_below_black(self, captures, noise, estimated: Callable[[], Array]) -> bool:
        """Whether captures that are known are negative.

        By more than noise where they leave the brightness open: a negative background is far worse
        than none there. The noise is the lower of that given and that estimated.
        """
        if checks.holds_traced(captures):
            return False
        squares = np.array([square_below_black(capture) for capture in captures])
        model = self.imaging_model
        is_open = not isinstance(model, Cameras) and getattr(model, "field_shape", None) is None
        if not is_open or not squares.any():
            return bool(squares.any())

        def exceed(variance) -> bool:
            return bool(np.any(squares > BY_NOISE**2 * np.asarray(variance)))

        return (not checks.is_traced(noise) and exceed(noise)) or exceed(estimated())

    @property
    def shows_brightness(self) -> bool:
        """Whether captures tell uniform light of the scene from a background.

        With operators that are traced, or whose captures are no images, nobody asks.
        """
        operators = getattr(self.imaging_model, "operators", None)
        if operators is None:
            return True
        if self._axes() != 2 or checks.holds_traced(operators):
            return False
        with jax.ensure_compile_time_eval():  # operators that are known stay so under jit
            uniform = jnp.ones((1,) * 4, self.captures[0].dtype)
            return bool(np.all(jax.device_get(shows_brightness(operators, uniform))))

    @property
    def light(self) -> tuple[Float[Array, "..."], ...]:
        """The captures less their background, where it is known."""
        if self.background is None:
            return self.captures
        pairs = zip(self.captures, self.background, strict=True)
        return tuple(c - b.astype(c.dtype) for c, b in pairs)

    def _masks(self, valid: Any) -> tuple[Array, ...]:
        """A mask for each capture."""
        shapes = [c.shape for c in self.captures]
        if not isinstance(valid, tuple | list):
            valid = valid if checks.is_traced(valid) else np.asarray(valid)
            valid = list(valid) if valid.ndim > len(shapes[0]) else [valid]
        if len(valid) == 1:
            valid = [*valid] * len(shapes)
        try:
            pairs = zip(valid, shapes, strict=True)
            return tuple(_mask(m, s) for m, s in pairs)
        except ValueError:
            given = [jnp.shape(m) for m in valid]
            raise ValueError(
                f"valid has shapes {given}; give a mask for each capture, of shapes {shapes}"
            ) from None

    def _masked_captures(self) -> tuple[list[Array], list[Array | None]]:
        """Captures and masks; pixels that are neither valid nor finite become 0."""
        if self.valid is None:
            return list(self.light), [None] * len(self.captures)
        pairs = list(zip(self.light, self.valid, strict=True))
        light = [checks.staying_known(_without_invalid, *pair) for pair in pairs]
        return light, [m for _, m in pairs]

    def _variances(self, captures, estimated: Callable[[], Array]) -> Float[Array, " capture"]:
        """Variance of each capture: as given, or estimated where none or zero is given."""
        if self.noise_variance is None:
            return estimated()
        with jax.ensure_compile_time_eval():  # a variance that is known stays so under jit
            given = given_variances(self.noise_variance, captures)
        if not checks.is_traced(given) and np.all(np.asarray(given) > 0):
            return given
        return jnp.where(given > 0, given, estimated())

    def _estimated(self, captures, valid) -> Float[Array, " capture"]:
        given = getattr(self.imaging_model, "operators", ())
        if any(len(s) < 2 for one in given for s in shapes_of(one.out_shape)):
            raise ValueError("give noise_variance: it is estimated from captures that are images")
        with jax.ensure_compile_time_eval():  # captures that are known stay so under jit
            found = estimate_variance(captures, None if valid[0] is None else valid)
            return unseen_variance(given, captures, valid, found)

    def _pitch(self, dtype) -> Float[Array, ""]:
        if isinstance(self.imaging_model, Cameras):
            return self.imaging_model.cameras[0].sensor.pitch
        return jnp.ones((), dtype)

    def _field(self) -> tuple[int, int]:
        model, sensor = self.imaging_model, self.captures[0].shape[-2:]
        if isinstance(model, Cameras):
            grid = model.cameras[0].sensor.grid
            return same_parity(model.pixels or grid.shape, grid.shape)
        kernel = model.psfs.shape[-2:]  # type: ignore[union-attr]
        whole = tuple(s + k - 1 for s, k in zip(sensor, kernel, strict=True))
        return fitting_field(model.field_shape or whole, sensor, kernel)  # type: ignore

    def _channels(self, synthesis, captures, valid) -> tuple[np.ndarray, list[SynthesisRow]]:
        """The channels of a synthesis."""
        model, (matrix, ratios) = self.imaging_model, self.synthesis_rows(synthesis)
        if isinstance(model, Cameras):
            kernels = model.kernels(self._field(), ratios)
        else:
            kernels = list(model.psfs.astype(captures[0].dtype))  # type: ignore[union-attr]
        return matrix, [SynthesisRow(row, kernels, captures, valid, ratios) for row in matrix]

    def synthesis_rows(self, synthesis: Any) -> tuple[np.ndarray, list[float]]:
        """The matrix (channel × capture) of a synthesis, and the enlargement of each capture."""
        model = self.imaging_model
        if isinstance(model, Cameras):
            ratios = distance_ratios(model.cameras)
            return synthesis_matrix(synthesis, model.cameras, ratios), ratios
        _no_synthesis(synthesis, "measured PSFs")
        return separate(len(self.captures)), [1.0] * len(self.captures)


def _mask(valid: Any, shape: tuple[int, ...]) -> Bool[Array, "..."]:
    if checks.is_traced(valid):
        return jnp.broadcast_to(valid.astype(bool), shape)
    return checks.as_array(np.broadcast_to(np.asarray(valid, bool), shape))


@jax.jit
def _without_invalid(capture, valid):
    return jnp.where(valid | jnp.isfinite(capture), capture, 0)


@jax.jit
def _sums(weights: Float[Array, "sum part"], parts: Float[Array, " part"]):
    return list(jnp.sum(weights * parts, axis=1))


def _single_captures(operator: AbstractOperator) -> list[AbstractOperator]:
    """An operator of several captures as operators of one each, with their masks and gains."""
    if isinstance(operator, Stacked):
        return [part for one in operator.operators for part in _single_captures(one)]
    if is_shape(operator.out_shape) or not isinstance(operator, Masked | Scaled):
        return [operator]
    given = operator.valid if isinstance(operator, Masked) else operator.gain
    inside = _single_captures(operator.operator)
    values = jax.tree.leaves(given) if isinstance(given, tuple) else [given] * len(inside)
    return [type(operator)(one, value) for one, value in zip(inside, values, strict=True)]


def _flat(parts: Any) -> Any:
    """The arrays of a nested tuple; an array of several captures, or None, unchanged."""
    return jax.tree.leaves(parts) if isinstance(parts, tuple | list) else parts


def _no_synthesis(synthesis, what: str) -> None:
    if synthesis is not None:
        raise ValueError(f"a synthesis needs Cameras; leave it out with {what}")
