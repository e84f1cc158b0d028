r"""Scale and shift between two images of one scene."""

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.grids import block_mean, block_sum, central_blocks, centred_indices
from thincam_jax._core.module import Module
from thincam_jax._core.precision import allow
from thincam_jax._core.progress import watched
from thincam_jax.measured.calibration.problem import Status, verdict
from thincam_jax.measured.raw import image_with_contrast

_LOBES = 5  # of the Lanczos kernel on either side
_COARSE = 128  # approximate pixels a side of the images for the initial search
_SMALLEST = 32  # pixels a side; less leaves nothing between the margins
_BLOCK = 24  # pixels a side of blocks with independent errors
_LEAST_CORRELATION = 0.5
_TOLERANCE = 1e-6  # pixels
_WEIGHT = 1e3  # of residuals, so that the solver's initial damping of 1 is weak


class Registration(Module):
    """Result of `estimate_registration`.

    - `scale`: size of the image over that of the reference; `shift`: (y, x), pixels.
    - `scale_error`, `shift_error`: their standard errors.
    - `correlation`: correlation of the image with the registered reference where they overlap; 1 is
      perfect.
    - `registered`: the reference, scaled and shifted onto the image.
    - `status`: "ok"; "poor_fit" where the correlation is under 0.5; "not_converged".
    - `reasons`: one line for each problem.
    """

    scale: Float[Array, ""]
    shift: Float[Array, "2"]
    scale_error: Float[Array, ""]
    shift_error: Float[Array, "2"]
    correlation: Float[Array, ""]
    registered: Float[Array, "y x"]
    status: Status = eqx.field(static=True)
    reasons: tuple[str, ...] = eqx.field(static=True)


@checked
@watched("registering captures")
def estimate_registration(
    capture: Numbers,
    reference: Numbers,
    *,
    scale: float | int = 1.0,
    search: float | int = 0.15,
    smoothing: float | int = 1.0,
    max_steps: int = 50,
) -> Registration:
    r"""Scale s and shift a of one image of a scene against another.

    .. math:: \min_{s, a, G, B} \sum \big[ \mathrm{capture}(r)
        - B - G\,\mathrm{reference}((r - a)/s) \big]^2

    with r in pixels from the middle. For captures of one scene at two mask-sensor distances (the
    thesis' method A) s = d/d_ref: a scene point's shadow moves by d/t. `reconstruct.registration`
    then takes the ratio 1/s; a shift means that the mask moved sideways with the distance.

    **Input.** Images that *scale*: reconstructions of the scene, one for each distance (a Wiener
    filter of that distance alone, or fringe scanning), on the sensor's pitch. Raw captures of a
    zone aperture do not scale: their fringes have the curvature β/M² at every distance, and only
    the centres of the shadows move with d. The images may differ in brightness and contrast.
    Rotation is not fitted.

    Phase correlation of small images gives a shift for each of several scales; least squares start
    from the best, first on the small images. In double precision.

    **Standard errors** include misfits, and noise that is correlated over less than 24 pixels (sums
    over blocks of pixels, Liang and Zeger's estimate).

    **Arguments**

    - `capture`, `reference`: (y, x), of one shape, at least 32 pixels a side.
    - `scale`: initial value, such as d/d_ref as set on the stage; > 0.
    - `search`: relative search range, at most 0.5.
    - `smoothing`: σ, in pixels of the reference, of a Gaussian filter of both images, which keeps
      noise and interpolation from biasing the result to whole pixels; 0: none.
    - `max_steps`: highest number of steps of Levenberg-Marquardt.

    **Validity.** Both must show mostly the same part of the scene: what one shows beyond the edges
    of the other is ignored, but what is occluded counts.

    **Errors**: ValueError, one line, for images that are not finite, of different shapes, without
    contrast or too small, and for numbers out of range.
    """
    if any(checks.is_traced(leaf) for leaf in (capture, reference, scale)):
        raise TypeError("estimate_registration searches: call it outside jit and grad")
    capture = image_with_contrast("capture", capture)
    reference = image_with_contrast("reference", reference, capture.shape, "the capture")
    if min(capture.shape) < _SMALLEST:
        raise ValueError(f"images of {capture.shape} pixels; give at least {_SMALLEST} a side")
    scale = float(checks.positive("scale", scale, "parts of one"))
    search = float(checks.non_negative("search", search, "parts of one"))
    if search > 0.5:
        raise ValueError(f"search = {search:g} is too wide; give at most 0.5")
    smoothing = float(checks.non_negative("smoothing", smoothing, "pixels"))
    block = max(1, min(capture.shape) // _COARSE)
    inner = central_blocks(capture.shape, block)
    small, other = (block_mean(image[inner], block) for image in (capture, reference))
    with allow("float64"):
        start = _phase_correlation(small, other, scale, search)
        start, *_ = _fit(small, other, start, 1.0, max_steps)
        start = Place(start.scale, start.shift * block)
        place, pair, found, converged = _fit(capture, reference, start, smoothing, max_steps)
        return _report(capture, reference, place, pair, found, converged)


@dataclass(frozen=True, eq=False)
class Place:
    """Scale, and shift (y, x) in pixels."""

    scale: float
    shift: np.ndarray


class Pair(eqx.Module):
    """The data of `residual`: smoothed images, where to compare them, and from where."""

    capture: Float[Array, "y x"]
    reference: Float[Array, "y x"]
    weights: Float[Array, "y x"]
    scale: Float[Array, ""]
    shift: Float[Array, "2"]


def residual(unknowns: Float[Array, "5"], pair: Pair) -> Float[Array, "y x"]:
    """(offset + gain·reference((r − a)/s) − capture)·weights.

    The unknowns: the change of s, in pixels at the image's edge, that of a (y, x) in pixels, gain
    and offset.
    """
    scale, shift = _place(unknowns, pair)
    model = unknowns[4] + unknowns[3] * resample(pair.reference, scale, shift)
    return (model - pair.capture) * pair.weights


def resample(
    image: Float[Array, "y x"], scale: Float[Array, ""], shift: Float[Array, "2"]
) -> Float[Array, "y x"]:
    """image((r − shift)/scale) on the image's own pixels, r in pixels from the middle.

    The image is enlarged about its middle by `scale`, then moved by `shift` (y, x), by separable
    Lanczos interpolation, differentiable in both. Beyond its edges it is 0; near them the outermost
    pixels have more weight: exclude them with `covered`. A scale well under 1 causes aliasing.
    """
    middle = jnp.asarray(image.shape, scale.dtype) / 2
    return jax.image.scale_and_translate(
        image,
        image.shape,
        (0, 1),
        jnp.stack([scale, scale]),
        shift + middle * (1 - scale),
        "lanczos5",
        antialias=False,
    )


def covered(
    shape: tuple[int, int], scale: Float[Array, ""], shift: Float[Array, "2"], margin: int
) -> Float[Array, "y x"]:
    """1 where a resampled image comes from at least `margin` pixels inside its edges, else 0.

    The border of the result, `margin` wide, is 0 as well.
    """
    sides = []
    for count, offset in zip(shape, shift, strict=True):
        r = centred_indices(count, scale.dtype)
        reach = (count - 1) / 2 - margin
        inside = (jnp.abs((r - offset) / scale) <= reach) & (jnp.abs(r) <= reach)
        sides.append(inside.astype(scale.dtype))
    return sides[0][:, None] * sides[1]


def _place(unknowns: Float[Array, "5"], pair: Pair) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    edge = max(pair.capture.shape) / 2
    return pair.scale * (1 + unknowns[0] / edge), pair.shift + unknowns[1:3]


@eqx.filter_jit
def _least_squares(pair: Pair, max_steps: int):
    solver = optx.LevenbergMarquardt(rtol=_TOLERANCE, atol=_TOLERANCE)
    start = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0], pair.capture.dtype)
    return optx.least_squares(residual, solver, start, pair, max_steps=max_steps, throw=False)


def _fit(capture, reference, start: Place, smoothing: float, max_steps: int):
    """Least squares from `start` on images of unit contrast, smoothed on the scene's scale.

    Returns the place, the pair, its fitted unknowns and whether the solver converged.
    """
    smooth = [
        scipy.ndimage.gaussian_filter(image, sigma, mode="nearest")
        for image, sigma in ((capture, smoothing * start.scale), (reference, smoothing))
    ]
    first, second = (jnp.asarray((image - image.mean()) / image.std()) for image in smooth)
    scale, shift = jnp.asarray(start.scale, jnp.float64), jnp.asarray(start.shift, jnp.float64)
    margin = _LOBES + math.ceil(3 * smoothing * max(1.0, start.scale))
    margin = min(margin, min(capture.shape) // 6)
    weights = covered(capture.shape, scale, shift, margin)
    pair = Pair(first, second, weights * (_WEIGHT / capture.size**0.5), scale, shift)
    solution = _least_squares(pair, max_steps)
    converged = bool(solution.result == optx.RESULTS.successful)
    scale, shift = _place(solution.value, pair)
    return Place(float(scale), np.asarray(shift)), pair, solution.value, converged


def _phase_correlation(capture, reference, scale: float, search: float) -> Place:
    """Scale with the highest peak of phase correlation, and its shift.

    The scales move the edge in steps of half a pixel.
    """
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in capture.shape))
    spectrum = np.fft.fft2((capture - capture.mean()) * window)
    step = 1 / max(capture.shape)
    count = math.ceil(search / step)
    best, found = -math.inf, Place(scale, np.zeros(2))
    none = jnp.zeros(2)
    level = jnp.asarray(reference - reference.mean())
    for tried in scale * (1 + np.linspace(-search, search, 2 * count + 1)):
        enlarged = np.asarray(_resampled(level, jnp.asarray(tried, jnp.float64), none))
        inside = np.asarray(covered(capture.shape, jnp.asarray(tried, jnp.float64), none, 0))
        cross = spectrum * np.fft.fft2(enlarged * inside * window).conj()
        strength = np.abs(cross)
        # Weak components, mostly noise, get less weight.
        peak = np.fft.ifft2(cross / (strength + np.mean(strength))).real
        row, column = np.unravel_index(np.argmax(peak), peak.shape)
        if peak[row, column] > best:
            best = peak[row, column]
            wrapped = [
                (k + n // 2) % n - n // 2 for k, n in zip((row, column), peak.shape, strict=True)
            ]
            found = Place(float(tried), np.array(wrapped, float))
    return found


_resampled = eqx.filter_jit(resample)


def _report(
    capture, reference, place: Place, pair: Pair, unknowns: Array, converged: bool
) -> Registration:
    error = _standard_errors(pair, unknowns)
    registered = np.asarray(
        _resampled(jnp.asarray(reference), jnp.asarray(place.scale), jnp.asarray(place.shift))
    )
    inside = np.asarray(pair.weights) > 0
    correlation = 0.0
    if np.ptp(registered[inside]) > 0:
        correlation = float(np.corrcoef(registered[inside], capture[inside])[0, 1])
    poor = unfinished = ""
    if correlation < _LEAST_CORRELATION:
        poor = (
            f"the images correlate by {correlation:.2f} only: they show different scenes, too much "
            "noise, or are further apart than search"
        )
    if not converged:
        unfinished = "least squares did not converge; try max_steps"
    edge = max(capture.shape) / 2
    return Registration(
        jnp.asarray(place.scale),
        jnp.asarray(place.shift),
        jnp.asarray(error[0] * float(pair.scale) / edge),
        jnp.asarray(error[1:3]),
        jnp.asarray(correlation),
        jnp.asarray(registered),
        *verdict((), poor, unfinished),
    )


def _standard_errors(pair: Pair, unknowns: Array) -> np.ndarray:
    """Standard errors of the unknowns, from (JᵀJ)⁻¹ S (JᵀJ)⁻¹ with S = Σ_block (Jᵀr)(Jᵀr)ᵀ."""
    jacobian, values = (np.asarray(v) for v in _linearised(unknowns, pair))
    scores = jacobian * values[..., None]
    rows, columns = (n - n % _BLOCK for n in values.shape)
    blocks = block_sum(np.moveaxis(scores, -1, 0)[:, :rows, :columns], _BLOCK)
    blocks = blocks.reshape(len(blocks), -1)
    normal = np.einsum("yxi,yxj->ij", jacobian, jacobian)
    inverse = np.linalg.pinv(normal, hermitian=True)
    return np.sqrt(np.diag(inverse @ (blocks @ blocks.T) @ inverse))


@eqx.filter_jit
def _linearised(unknowns: Float[Array, "5"], pair: Pair):
    return jax.jacfwd(residual)(unknowns, pair), residual(unknowns, pair)
