r"""The relief of a phase mask by gradient: its limits, its objective, and the descent.

A phase retrieved for one wavelength, rounded to the levels that can be made, is no longer the best
one. Here the heights themselves are changed, with the limits inside: each is

.. math:: h = q\big(h_{max} \sin^2 u\big)

of a free number u, q the nearest level. Its derivative is taken as 1 (the straight-through
estimator; Bengio, Léonard & Courville 2013), so that the optics see what will be made, and the
descent what it would be between the levels. Heights are drawn to the levels in stages, from not at
all to wholly: else few levels hold a descent where it begins.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import Grid
from thincam_jax._core.module import Module
from thincam_jax._core.precision import as_complex
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.end_to_end import restore_by
from thincam_jax.design.objectives import Channels, bayes_error
from thincam_jax.design.phase_retrieval import contour_target, match_error, retrieve_phase
from thincam_jax.design.setup import Setup
from thincam_jax.design.stochastic import adam
from thincam_jax.design.training import CaptureSum, relative_error
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import LenslessCamera, LightPath
from thincam_jax.lensless.masks.phase import HIGHEST, MaskBlank, PhaseMask
from thincam_jax.lensless.method import PsfMethod, psf_method
from thincam_jax.lensless.propagation.angular_spectrum import angular_spectrum
from thincam_jax.lensless.resolve import require_phase_sampling

# Of the angle u, whose range from the lowest to the highest relief is π/2.
_RATE = 0.05
# Window over mask and sensor: nothing wraps round. The steep waves that it cuts are up to 3 % of
# a small PSF, and twice as much takes four times as long.
_PADDING = 1.0
# How far from the ends of the range a descent begins, as a part of it: there sin² is flat.
_INNER = 0.02
# How far heights are drawn to their levels, stage by stage.
_STAGES = (0.0, 0.4, 0.7, 0.9, 1.0)

# Of a field, whose full matrices take their square: 2048 are 16 MB and some seconds a step.
_MOST_SAMPLES = 2048

# (mask, data, key) → cost.
MaskObjective = Callable[[PhaseMask, Any, PRNGKeyArray], Float[Array, ""]]


@checked
@dataclass(frozen=True)
class HeightLimits:
    """Heights that can be made. The smallest feature is a cell of the mask.

    - `highest`: mm. `levels`: how many heights, evenly from 0 to the highest; None is any.
    """

    highest: float
    levels: int | None = None

    def checked(self) -> "HeightLimits":
        """These limits where they are possible; else a ValueError of one line."""
        if not 0 < self.highest <= HIGHEST:
            raise ValueError(f"highest = {self.highest:g} mm; give more than 0, up to {HIGHEST:g}")
        if self.levels is not None and self.levels < 2:
            raise ValueError(f"levels = {self.levels}; give at least 2, or None for any height")
        return self

    def nearest(
        self, height: Float[Array, "y x"], drawn: float | Float[Array, ""] = 1.0
    ) -> Float[Array, "y x"]:
        """The heights that can be made; derivatives pass as if any could.

        `drawn`: which part of the way to them, from 0 to 1.
        """
        inside = jnp.clip(height, 0.0, self.highest)
        if self.levels is None:
            return inside
        step = self.highest / (self.levels - 1)
        return inside + drawn * jax.lax.stop_gradient(jnp.round(inside / step) * step - inside)


@checked
def one_turn(blank: MaskBlank, wavelength: Number, levels: int | None = None) -> HeightLimits:
    """Limits that hold every phase of one wavelength: λ/(n − 1), less the last of even levels."""
    limits = HeightLimits(float(blank.wrap_height(wavelength)), levels).checked()
    return limits if levels is None else replace(limits, highest=limits.highest * (1 - 1 / levels))


@checked
def mask_of_phase(
    phase: Float[Array, "y x"], blank: MaskBlank, wavelength: Number, limits: HeightLimits
) -> PhaseMask:
    """The mask that comes nearest to a phase (rad) at a wavelength, within the limits.

    Phases are taken up to whole turns; what is higher than the limits becomes the highest or the
    lowest height, whichever phase is nearer.
    """
    limits = limits.checked()
    turn = blank.wrap_height(wavelength).astype(phase.dtype)
    height = (phase / (2 * math.pi) - jnp.floor(phase / (2 * math.pi))) * turn
    over = height - limits.highest
    return blank.mask(limits.nearest(jnp.where(turn - height < over, 0.0, height)))


@checked
def contour_mask(
    key: Key, blank: MaskBlank, path: LightPath, *, feature: Number, line_width: Number
) -> PhaseMask:
    """The mask whose PSF at a path's wavelength and distances is nearest to a `contour_target`.

    - `key`: key of `jax.random`, or a seed. `path`: path of the light; see `retrieve_phase`.
    - `feature`, `line_width`: size of the noise's features and width of the lines, mm; see
      `contour_target`.

    ```python
    import thincam_jax as tc
    from thincam_jax.design.phase_mask import contour_mask
    from thincam_jax.lensless.camera import LightPath

    blank = tc.lensless.masks.MaskBlank((64, 64), 0.01, 1.52)
    mask = contour_mask(0, blank, LightPath(5e-4, 5.0), feature=0.08, line_width=0.02)
    ```
    """
    key = random_key(key)
    lines = contour_target(key, blank.grid, feature=feature, line_width=line_width)
    found = retrieve_phase(lines, blank.grid, path, shape=blank.shape, key=key)
    return mask_of_phase(found.phase, blank, path.wavelength, one_turn(blank, path.wavelength))


@checked
class MaskSetting(eqx.Module):
    """Setting of a mask's design: its sensor, and the light that it meets.

    - `sensor`, `distance`: mask to sensor, mm. `wavelengths`, `object_distances`: mm.
    - `together`: the sensor sees all wavelengths as one grey image; else each has its own.
    - `field_shape`: rows and columns of the scene on the sensor's pitch, at most 2048 samples: what
      falls beside the sensor is lost. None takes the sensor's rims to meet.
    """

    sensor: Sensor
    distance: Float[Array, ""]
    wavelengths: Float[Array, " colour"]
    object_distances: Float[Array, " depth"]
    together: bool = eqx.field(static=True)
    field_shape: tuple[int, int] | None = eqx.field(static=True)
    method: PsfMethod = eqx.field(static=True)

    def __init__(
        self,
        camera: LenslessCamera,
        *,
        wavelengths: Numbers | Sequence[float],
        object_distances: Numbers | Sequence[float] = (math.inf,),
        together: bool = False,
        field_shape: tuple[int, int] | None = None,
    ):
        self.sensor, self.distance, self.together = camera.sensor, camera.distance, together
        self.field_shape = None if field_shape is None else checks.shape2d("field", field_shape)
        if self.field_shape and math.prod(self.field_shape) > _MOST_SAMPLES:
            raise ValueError(
                f"field_shape = {self.field_shape} has {math.prod(self.field_shape)} samples, each "
                f"a row of a full matrix; give at most {_MOST_SAMPLES}, or larger pixels"
            )
        dtype = self.distance.dtype
        given = jnp.atleast_1d(jnp.asarray(wavelengths, dtype))
        self.wavelengths = checks.wavelengths("wavelengths", given)
        self.object_distances = jnp.atleast_1d(jnp.asarray(object_distances, dtype))
        flat = eqx.tree_at(lambda mask: mask.height, camera.mask, replace_fn=jnp.zeros_like)
        self.method = psf_method(flat, self.grid, "angular_spectrum", pixel_integration=True)
        for light in self.wavelengths:
            for away in self.object_distances:
                path = LightPath(light, self.distance, away)
                require_phase_sampling(flat, self.grid, path, self.method)

    @property
    def grid(self) -> Grid:
        """Grid of the PSFs: the sensor's, or with a field the extent that its points cast."""
        if self.field_shape is None:
            return self.sensor.grid
        return kernel_grid(self.sensor.grid, self.field_shape)

    def psfs(self, mask: PhaseMask) -> Float[Array, "depth colour y x"]:
        """Averaged over the pixels; of all wavelengths together, the mean as one colour.

        By `angular_spectrum` without its waves of the window's rim: `psf` judges to the last digit.
        """

        def one(light):
            return angular_spectrum(
                mask,
                self.grid,
                LightPath(light[0], self.distance, light[1]),
                self.method,
                padding=_PADDING,
            )

        depths, colours = len(self.object_distances), len(self.wavelengths)
        away, light = jnp.meshgrid(self.object_distances, self.wavelengths, indexing="ij")
        found = jax.lax.map(one, jnp.stack([light.ravel(), away.ravel()], axis=-1))
        found = found.reshape(depths, colours, *self.grid.shape)
        return jnp.mean(found, axis=1, keepdims=True) if self.together else found


def linear_error(
    psfs: Float[Array, "*case y x"], setup: Setup, distance: Float[Array, ""]
) -> Float[Array, "*case"]:
    r"""Expected error of the best linear image of each PSF, as a part of the scene's variance.

    `bayes_error` at the frequencies of the PSF's DFT: a sensor whose rims meet, so that nothing is
    cut off. `setup`: noise and prior; its pitch is that of the PSFs. `distance`: mask to sensor.
    """
    shape = psfs.shape[-2:]
    dtype = psfs.dtype
    v, u = (jnp.asarray(np.fft.fftfreq(n), dtype) / setup.pitch * distance for n in shape)
    weight = (distance / setup.pitch) ** 2 / (shape[0] * shape[1])
    prior = setup.prior(v[:, None] ** 2 + u**2, setup.field)
    density = prior * (setup.contrast**2 / (jnp.sum(prior) * weight))

    def one(h):
        response = jnp.abs(jnp.fft.fft2(h)) * setup.pitch**2
        signal = jnp.sum(response**2 * density) * weight
        noise = setup.noise.variance(response[0, 0], signal, 1.0) * setup.pitch**2
        # Per area of the sensor the scene's density grows with the distance squared.
        known = Channels(
            (response * distance)[None],
            jnp.full((1, *shape), noise),
            density,
            jnp.full(shape, weight),
        )
        return bayes_error(known)

    flat = jax.vmap(one)(psfs.reshape(-1, *shape))
    return flat.reshape(psfs.shape[:-2])


def cropped_error(
    psfs: Float[Array, "*case y x"],
    setup: Setup,
    distance: Float[Array, ""],
    field_shape: tuple[int, int],
) -> Float[Array, "*case"]:
    r"""`linear_error` of a sensor that ends: of a field's samples, by full matrices.

    .. math:: \operatorname{tr} S (1 + S A^T A S / \sigma^2)^{-1} S \,/ \operatorname{tr} S^2

    A the convolution cropped to the sensor, S² the prior's covariance, periodic in the field.
    `psfs`: on `kernel_grid` of sensor and field.
    """
    rows, columns = field_shape
    count, dtype = rows * columns, psfs.dtype
    seen = tuple(k - n + 1 for k, n in zip(psfs.shape[-2:], field_shape, strict=True))
    v, u = (jnp.asarray(np.fft.fftfreq(n), dtype) / setup.pitch * distance for n in field_shape)
    prior = setup.prior(v[:, None] ** 2 + u**2, setup.field)
    root = as_complex(setup.contrast * jnp.sqrt(prior / jnp.mean(prior)))

    def shaped(parts):
        """S of each column."""
        spectra = jnp.fft.fft2(parts.reshape(rows, columns, -1), axes=(0, 1))
        return jnp.fft.ifft2(spectra * root[..., None], axes=(0, 1)).real.reshape(count, -1)

    prior_root = shaped(jnp.eye(count, dtype=dtype))
    corners = jnp.meshgrid(rows - 1 - jnp.arange(rows), columns - 1 - jnp.arange(columns))
    y, x = (corner.T.ravel() for corner in corners)

    def one(h):
        cast = jax.vmap(lambda i, j: jax.lax.dynamic_slice(h, (i, j), seen))(y, x)
        cast = cast.reshape(count, -1) * setup.pitch**2  # Aᵀ
        across = shaped(cast)
        light, signal = jnp.mean(jnp.sum(cast, axis=0)), jnp.mean(jnp.sum(across**2, axis=0))
        deviation = jnp.sqrt(setup.noise.variance(light, signal, 1.0))
        # Its triangle's square is 1 + S AᵀA S/σ², whose digits float32 could not hold.
        stacked = jnp.concatenate([jnp.eye(count, dtype=dtype), across.T / deviation])
        triangle = jnp.linalg.qr(stacked, mode="r")
        left = solve_triangular(triangle.T, prior_root, lower=True)
        return jnp.sum(left**2) / (count * setup.contrast**2)

    return jax.lax.map(one, psfs.reshape(-1, *psfs.shape[-2:])).reshape(psfs.shape[:-2])


def match_objective(mask: PhaseMask, data: Any, key: PRNGKeyArray) -> Float[Array, ""]:
    """Mean `match_error` over wavelengths and depths. `data`: (MaskSetting, target)."""
    setting, target = data
    psfs = setting.psfs(mask).reshape(-1, *setting.grid.shape)
    return jnp.mean(jax.vmap(match_error, (0, None))(psfs, target))


def linear_objective(mask: PhaseMask, data: Any, key: PRNGKeyArray) -> Float[Array, ""]:
    """Mean expected error over wavelengths and depths. `data`: (MaskSetting, Setup).

    `linear_error`, or `cropped_error` where the setting has a field.
    """
    setting, setup = data
    given = setting.psfs(mask), setup, setting.distance
    if setting.field_shape is None:
        return jnp.mean(linear_error(*given))
    return jnp.mean(cropped_error(*given, setting.field_shape))


def restored_objective(mask: PhaseMask, data: Any, key: PRNGKeyArray) -> Float[Array, ""]:
    """Mean error of restored training images over wavelengths and depths, end to end.

    The best linear estimate by conjugate gradients, crop and noise included
    (`thincam_jax.design.end_to_end`), with other noise at every key. `data`: (MaskSetting,
    Training) of one capture; the setting has the training's sensor and `field_shape`.
    """
    setting, training = data
    noise = jax.random.normal(key, training.noise.shape, training.noise.dtype)
    training = eqx.tree_at(lambda t: t.noise, training, noise)
    share = jnp.ones((), noise.dtype)

    def one(kernel):
        camera = CaptureSum(kernel[None], (1.0,), (share,), setting.distance, training)
        return relative_error(restore_by((camera,), training), training)

    psfs = setting.psfs(mask).reshape(-1, *setting.grid.shape)
    return jnp.mean(jnp.stack([one(h) for h in psfs]))


class Refined(Module):
    """Result of `refine_mask`.

    - `mask`: after the last step, or the one given where that is better. `history`: the objective
      at every step, before it.
    - `skipped`: steps whose objective or gradient was not finite; they changed nothing.
    """

    mask: PhaseMask
    history: Float[Array, " step"]
    skipped: int


@checked
def refine_mask(
    objective: MaskObjective,
    mask: PhaseMask,
    limits: HeightLimits,
    data: Any,
    *,
    key: Key,
    steps: int = 100,
) -> Refined:
    """A mask's heights, changed by Adam so that an objective falls; the limits are kept throughout.

    - `objective`: (mask, data, key) → a number, at module level, such as `match_objective`,
      `linear_objective` and `restored_objective`.
    - `mask`: to begin with, such as `mask_of_phase` makes.

    **Validity.** It finds a local minimum.

    **Errors**: ValueError for limits and numbers of steps that are out of range.
    """
    key = random_key(key)
    limits = limits.checked()
    stages = (1.0,) if limits.levels is None else _STAGES
    each = steps // len(stages)
    if each < 2:
        raise ValueError(f"steps = {steps}; give at least {2 * len(stages)}")
    part = jnp.clip(mask.height / limits.highest, _INNER, 1 - _INNER)
    u, histories, skipped = jnp.arcsin(jnp.sqrt(part)), [], 0
    for drawn, stage_key in zip(stages, jax.random.split(key, len(stages)), strict=True):
        start = u, jnp.asarray(drawn, u.dtype), stage_key
        u, history, failed = _descend(objective, mask, limits, data, start, each)
        histories.append(history)
        skipped += int(failed)
    better = _better(objective, mask, limits, data, (u, key))
    return Refined(better, jnp.concatenate(histories), skipped)


def _relief(mask: PhaseMask, limits: HeightLimits, u, drawn=1.0) -> PhaseMask:
    height = limits.nearest(limits.highest * jnp.sin(u) ** 2, drawn)
    return eqx.tree_at(lambda m: m.height, mask, height)


@functools.partial(jax.jit, static_argnames=("objective", "limits", "steps"))
def _descend(objective, mask: PhaseMask, limits: HeightLimits, data, start, steps: int):
    u, drawn, key = start

    def loss(u, step_key):
        value = objective(_relief(mask, limits, u, drawn), data, step_key)
        return value, value

    return adam(loss, u, key, jnp.asarray(_RATE, u.dtype), steps)


@functools.partial(jax.jit, static_argnames=("objective", "limits"))
def _better(objective, mask: PhaseMask, limits: HeightLimits, data, found) -> PhaseMask:
    """The mask found, or the one given."""
    u, key = found
    after = _relief(mask, limits, u)
    before = eqx.tree_at(lambda m: m.height, mask, limits.nearest(mask.height))
    improved = objective(after, data, key) < objective(before, data, key)
    height = jnp.where(improved, after.height, before.height)
    return eqx.tree_at(lambda m: m.height, mask, height)
