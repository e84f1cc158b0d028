r"""`fit_screen`: the parameters of a see-through screen from its matrix, or a few of its ghosts.

A matrix is valid for the distance at which it was measured, the fitted rays for all.
"""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy
from jaxtyping import Array, Float, Int

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.precision import allow, cast, precision_of
from thincam_jax._core.progress import watched
from thincam_jax._core.quantity import unchecked
from thincam_jax.imaging.operators import Matrix
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.measured.calibration.problem import Status, covariance, hardly_seen, verdict
from thincam_jax.measured.raw import MeasurementError
from thincam_jax.waveguide import ObjectPlane, SeeThroughCamera
from thincam_jax.waveguide.camera import seen_size
from thincam_jax.waveguide.measured.screen_state import DEFAULT, PARAMETERS, QUANTITIES, ScreenState
from thincam_jax.waveguide.rays import pixel_centres, trace
from thincam_jax.waveguide.smear import trace_band
from thincam_jax.waveguide.system import system_operator

_PIXELS = 400  # of the sensor whose rows of the matrix are fitted
_BLURS = (2.0, 0.7, 0.0)  # cells, one after another
_AGAIN = 8  # repetitions at most, until the smear is that of the fitted screen
_STEPS = 60
_TOLERANCE = 1e-5  # of scaled steps, and of the squares
_EXPLAINED = 0.5  # of the matrix' squares, at least
_UNEXPLAINED = 5.0  # standard deviations of χ² of positions, at most


class GhostPositions(eqx.Module):
    """Object points seen by pixels: a dot on a monitor, and the pixels lit by its ghosts.

    - `pixels`: (y, x) on the sensor, mm from its middle, (ghost, 2).
    - `points`: points of the object, (y, x) mm from its middle, (ghost, 2).
    - `orders`: order of each ghost; 0 is the image.
    - `deviation`: standard deviation of the points, mm.
    """

    pixels: Float[Array, "ghost 2"]
    points: Float[Array, "ghost 2"]
    orders: Int[Array, " ghost"]
    deviation: Float[Array, ""]

    def __init__(self, pixels: Numbers, points: Numbers, orders: Numbers, deviation: float | Array):
        numbers = np.asarray(orders)
        if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or (numbers < 0).any():
            raise ValueError(f"orders = {orders!r}; give a whole number from 0 for each ghost")
        self.pixels = checks.finite("pixels", pixels, "mm", shape=(len(numbers), 2))
        self.points = checks.finite("points", points, "mm", shape=(len(numbers), 2))
        self.orders = jnp.asarray(numbers)
        self.deviation = checks.positive("deviation", deviation, "mm")


class ScreenFit(Module):
    """Result of `fit_screen`.

    - `camera`, `plane`: those given, with the fitted parameters. `gain`: ratio of the matrix to the
      model's.
    - `values`, `standard_errors`: values and errors of the fitted parameters. The errors are
      √(σ²(JᵀJ)⁻¹) with the residual's own σ for a matrix, the given one for positions, without
      errors of the model.
    - `correlation`: correlation of the errors, in the order of `values`.
    - `explained`: fraction of the measured squares that the model explains.
    - `status`: "ok"; "ambiguous", where the data do not distinguish some parameters; "poor_fit";
      "not_converged". The last that applies.
    - `reasons`: one line for each problem.
    """

    camera: SeeThroughCamera
    plane: ObjectPlane
    gain: Float[Array, ""]
    values: dict[str, Float[Array, ""]] = eqx.field(converter=unchecked(parts=QUANTITIES))
    standard_errors: dict[str, Float[Array, ""]] = eqx.field(converter=unchecked(parts=QUANTITIES))
    correlation: Float[Array, "unknown unknown"]
    explained: Float[Array, ""]
    status: Status = eqx.field(static=True)
    reasons: tuple[str, ...] = eqx.field(static=True)
    orders: int = eqx.field(static=True)
    samples: int | None = eqx.field(static=True)

    def system(self, plane: ObjectPlane) -> Scaled:
        """Matrix for an object at another distance, in the unit of the measured one."""
        return Scaled(
            system_operator(self.camera, plane, orders=self.orders, samples=self.samples), self.gain
        )


class _Smear(eqx.Module):
    """Smear of each order and pixel: it changes little with the screen; renewed for each blur.

    - `offsets`: mm, of equal parts of the band from the Bragg wavelength's point.
    - `band`: weight of the band, of which edges of holograms cut off a part; its mean is that of
      `bragg`, the weight of the Bragg wavelength.
    """

    offsets: Array
    band: Array
    bragg: Array

    def weight(self, bragg: Array) -> Array:
        """Weights of the bands where those of the Bragg wavelengths have become `bragg`."""
        grown = jnp.where(self.bragg > 0, bragg / jnp.where(self.bragg > 0, self.bragg, 1), 1)
        return grown * self.band


def _no_smear() -> _Smear:
    return _Smear(jnp.zeros((1, 1, 1, 2)), jnp.ones((1, 1)), jnp.ones((1, 1)))


class _Problem(eqx.Module):
    """Data of the least squares.

    `names`: names of the parameters; `count`: number of orders. `unit`: unit of steps. `scale`: one
    over the residual's unit. `full`: mean weight of a pixel. `smear`: smear of each pixel's band.
    """

    start: ScreenState
    measured: Array
    pixels: Array
    orders: Array | None
    unit: Array
    scale: Array
    full: Array
    blur: Array
    smear: "_Smear"
    names: tuple[str, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def state(self, steps: Array) -> ScreenState:
        return self.start.moved(self.names, tuple(steps * self.unit))


@checked
@watched("fitting the screen")
def fit_screen(
    measured: Matrix | GhostPositions,
    camera: SeeThroughCamera,
    plane: ObjectPlane,
    *,
    parameters: Sequence[str] = DEFAULT,
    orders: int = 4,
    samples: int | None = 4,
) -> ScreenFit:
    r"""Fit rays to a measured matrix, or to ghosts' positions, by least squares.

    .. math:: \min \sum_{p, c} \Big[ H_{pc} - G \sum_i \frac{W_i(p)}{\bar W}\,
        a_{pc}\big(\mathbf P_i(p)\big) \Big]^2
        \qquad \text{or} \qquad \sum_g \frac{|\mathbf P_{i_g}(p_g) - \mathbf P_g|^2}{\sigma^2}

    with the rays of `trace`, for each part of the band, and the fraction a of a pixel's view within
    a cell; a ghost's position is the centroid of its band. Rows of the matrix are first blurred
    over the cells, then less and less, for starts whose ghosts are a few cells off. The band's
    smear is held in each fit, which is repeated until nothing changes. Levenberg-Marquardt
    (`optimistix`), in double precision, on 400 pixels spread over the sensor.

    **Identifiability.** At one distance only d1 + d2 acts. Points depend on the fringes' direction,
    `slant` and `tilt`, not on their period: the two recording angles act through half their
    difference (the slant), and shrinkage acts as a slant, too, except for small changes of the
    weights. The film acts on the weights only. `status` and `reasons` name undetermined parameters.

    **Arguments**

    - `measured`: H from `recover_matrix`, or `GhostPositions`.
    - `camera`, `plane`: initial values; the plane as in the measurement of H.
    - `parameters`: any of "glass_thickness", "lens_distance", "focal_distance", "index" (of film
      and glass), "slant" (of the fringes' normal from the plate's), "tilt" (of the plane of
      recording about the plate's normal), "plate_x", "plate_y" (the plate's own tilt, about x and
      y), "shrinkage" (further, of the film), "film_thickness", "index_modulation",
      "object_distance", "object_x", "object_y". A matrix' gain is always fitted. Others are held.
    - `orders`: number of ghosts. `samples`: parts of the band of each pixel and order, as in
      `system_operator`; None for a matrix without smear, such as a simulated one.

    **Errors**: MeasurementError (a ValueError), one line, for a matrix whose sizes differ from the
    plane's and sensor's, fewer data than unknowns, and unknown parameters.
    """
    if isinstance(parameters, str) or not parameters or len(set(parameters)) < len(parameters):
        raise ValueError(f"parameters = {parameters!r}: give a tuple of different names")
    for name in parameters:
        checks.choice("a name in parameters", name, PARAMETERS)
    names, blurs = tuple(parameters), (0.0,)
    if isinstance(measured, Matrix):
        _require_sizes(measured, camera, plane)
        names, blurs = (*names, "gain"), _BLURS
    precision = precision_of(camera.lens_distance)
    with allow("float64", camera):
        start = cast(ScreenState(camera, plane, jnp.ones(()), jnp.zeros(())), "float64")
        if isinstance(measured, Matrix):
            problem = _of_matrix(measured, start, names, orders)
        else:
            problem = _of_positions(measured, start, names, orders)
        if problem.measured.size <= len(names):
            raise MeasurementError(
                f"{problem.measured.size} measured numbers for {len(names)} unknowns: give more "
                "ghosts, or fewer parameters"
            )
        rows, converged = problem.measured, True
        for number, blur in enumerate((*blurs, *(0.0,) * _AGAIN)):
            problem = replace(problem, smear=_smear(problem, samples))
            problem = _scaled(_blurred(problem, rows, blur))
            solution = _least_squares(problem)
            converged = bool(solution.result == optx.RESULTS.successful)
            problem = replace(problem, start=problem.state(solution.value))
            if number >= len(blurs) - 1:
                # Errors from the residual itself: positions may be worse than their deviation.
                curvature, squares, freedom = _known(problem)
                errors = covariance(curvature, squares / freedom).standard_errors
                # Steps end at the solver's tolerance, whatever the noise.
                if np.all(np.abs(solution.value) < np.maximum(errors / 3, 10 * _TOLERANCE)):
                    break
        else:
            converged = False
        return cast(_report(problem, samples, converged), precision)


def _require_sizes(measured: Matrix, camera: SeeThroughCamera, plane: ObjectPlane) -> None:
    for what, given, wanted in (
        ("the plane has", plane.shape, measured.in_shape),
        ("the sensor has", camera.sensor.shape, measured.out_shape),
    ):
        if given != wanted:
            raise MeasurementError(
                f"{what} {given[0]} × {given[1]}, but the matrix was measured for "
                f"{' × '.join(map(str, wanted))}; give the plane and the camera of the calibration"
            )


def _of_matrix(
    measured: Matrix, start: ScreenState, names: tuple[str, ...], orders: int
) -> _Problem:
    rows, columns = measured.out_shape
    step = max(1.0, (rows * columns / _PIXELS) ** 0.5)
    ys, xs = (np.unique(np.arange(step / 2, n, step).astype(int)) for n in (rows, columns))
    chosen = (ys[:, None] * columns + xs).ravel()
    kept = jnp.asarray(measured.matrix[chosen], jnp.float64).reshape(-1, *start.plane.shape)
    pixels = pixel_centres(start.camera)[ys[:, None], xs].reshape(-1, 2)
    full = _mean_weight(start.camera, start.plane, pixels, orders)
    if not (full > 0 and jnp.sum(kept**2) > 0):
        raise MeasurementError(
            "no ray of the start reaches the object, or the matrix is 0; give another start"
        )
    zero, one = jnp.zeros(()), jnp.ones(())
    given = start, kept, pixels, None, one[None], one, full, zero, _no_smear()
    problem = _Problem(*given, names, orders)
    # The gain is linear: the best one at the start, at the widest blur.
    problem = _blurred(problem, kept, _BLURS[0])
    model = _model(start, problem)
    gain = jnp.sum(model * problem.measured) / jnp.sum(model**2)
    start = replace(start, gain=jnp.where(gain > 0, gain, 1.0))
    return replace(problem, start=start, measured=kept)


def _of_positions(
    measured: GhostPositions, start: ScreenState, names: tuple[str, ...], orders: int
) -> _Problem:
    most = int(measured.orders.max())
    if most >= orders:
        raise MeasurementError(f"a ghost of order {most}, but orders = {orders}; give more orders")
    seen = cast(measured, "float64")
    one, scale = jnp.ones(()), 1 / seen.deviation
    data = seen.points, seen.pixels, seen.orders
    return _Problem(start, *data, one[None], scale, one, one, _no_smear(), names, orders)


def _smear(problem: _Problem, samples: int | None) -> _Smear:
    if samples is None:
        return _no_smear()
    camera, distance = problem.start.camera, problem.start.plane.distance
    band = trace_band(camera, problem.pixels, distance, problem.count, samples)
    rays = trace(camera, problem.pixels, object_distance=distance, orders=problem.count)
    away = band.points - rays.points[..., None, 1::-1]
    mean = jnp.sum(rays.weight) / jnp.sum(band.weight)
    offsets = jnp.where(band.weight[..., None, None] > 0, away, 0)
    return _Smear(offsets, mean * band.weight, rays.weight)


def _blurred(problem: _Problem, rows: Array, blur: float) -> _Problem:
    """Problem with the measured rows blurred over the cells; positions are unchanged."""
    if problem.orders is not None:
        return problem
    if blur > 0:
        rows = jnp.asarray(scipy.ndimage.gaussian_filter(rows, (0, blur, blur), mode="constant"))
    scale = 1 / jnp.linalg.norm(rows)
    return replace(problem, measured=rows, blur=jnp.asarray(blur), scale=scale)


def _scaled(problem: _Problem) -> _Problem:
    """Problem whose unit steps each change the residual by a tenth of the data's norm."""
    units = jnp.asarray([PARAMETERS.get(n, 1.0) for n in problem.names])
    lengths = jnp.linalg.norm(_jacobian(replace(problem, unit=units)), axis=0)
    size = 0.1 * jnp.linalg.norm(problem.measured * problem.scale)
    return replace(problem, unit=units * size / jnp.where(lengths > 0, lengths, size))


def _residual(steps, problem: _Problem):
    model = _model(problem.state(steps), problem)
    return ((model - problem.measured) * problem.scale).reshape(-1)


@eqx.filter_jit
def _least_squares(problem: _Problem):
    solver = optx.LevenbergMarquardt(rtol=_TOLERANCE, atol=_TOLERANCE)
    none, options = jnp.zeros_like(problem.unit), {"jac": "fwd"}
    return optx.least_squares(
        _residual, solver, none, problem, options=options, max_steps=_STEPS, throw=False
    )


@eqx.filter_jit
def _jacobian(problem: _Problem):
    return jax.jacfwd(_residual)(jnp.zeros_like(problem.unit), problem)


@eqx.filter_jit
def _model(state: ScreenState, problem: _Problem):
    """The rows of the matrix, (pixel, y, x), or the points from the object's middle."""
    camera, plane = state.camera, state.plane
    rays = trace(camera, problem.pixels, object_distance=plane.distance, orders=problem.count)
    if problem.orders is not None:
        place = jnp.arange(problem.pixels.shape[0])
        centroid = rays.points[..., 1::-1] + jnp.mean(problem.smear.offsets, axis=2)
        return centroid[problem.orders, place] - plane.centre
    size = seen_size(camera, plane)
    offsets = problem.smear.offsets
    points = rays.points[..., None, 1::-1] + offsets
    down, across = (_parts(points[..., axis], plane, axis, size, problem.blur) for axis in (0, 1))
    weight = state.gain * problem.smear.weight(rays.weight) / problem.full / offsets.shape[2]
    return jnp.einsum("op,opsy,opsx->pyx", weight, down, across, precision="highest")


def _parts(points, plane: ObjectPlane, axis: int, size, blur):
    """Fraction of an interval of that size about each point within each cell of an axis.

    The second difference of F(u) = ∫ Φ(v/σ) dv with the normal distribution Φ, max(u, 0) for σ = 0.
    """
    number = plane.shape[axis]
    low = (points - size / 2 - plane.centre[axis]) / plane.pitch + number / 2
    edges = jnp.arange(number + 1, dtype=low.dtype)
    wide = jnp.where(blur > 0, blur, 1.0)

    def ramp(u):
        smooth = u * jax.scipy.stats.norm.cdf(u / wide) + wide * jax.scipy.stats.norm.pdf(u / wide)
        return jnp.where(blur > 0, smooth, jnp.maximum(u, 0))

    relative = edges - low[..., None]
    left = ramp(relative) - ramp(relative - size / plane.pitch)
    return jnp.diff(left, axis=-1) * plane.pitch / size


def _mean_weight(camera: SeeThroughCamera, plane: ObjectPlane, pixels, orders: int):
    """Mean total weight of a pixel's ghosts, which is 1 in `system_operator`."""
    rays = trace(camera, pixels, object_distance=plane.distance, orders=orders)
    return jnp.mean(jnp.sum(rays.weight, axis=0))


def _known(problem: _Problem):
    """JᵀJ, the residual's sum of squares, and its degrees of freedom."""
    residual = np.asarray(_residual(jnp.zeros_like(problem.unit), problem))
    slopes = np.asarray(_jacobian(problem))
    curvature, squares = slopes.T @ slopes, float(residual @ residual)
    return curvature, squares, residual.size - len(problem.names)


def _report(problem: _Problem, samples: int | None, converged: bool) -> ScreenFit:
    found, names, orders = problem.start, problem.names, problem.count
    curvature, squares, freedom = _known(problem)
    explained = 1 - squares / float(jnp.sum((problem.measured * problem.scale) ** 2))
    of_matrix, mean = problem.orders is None, squares / freedom
    known = covariance(curvature, mean if of_matrix else 1.0)
    errors = known.standard_errors * np.asarray(problem.unit)
    gain = found.gain
    if of_matrix:
        everywhere = _mean_weight(found.camera, found.plane, pixel_centres(found.camera), orders)
        gain, errors[-1] = (float(everywhere / problem.full) * v for v in (gain, errors[-1]))
    poor = ""
    if of_matrix and explained < _EXPLAINED:
        poor = f"the model explains {max(0.0, explained):.1%} of what was measured"
    elif not of_matrix and mean > 1 + _UNEXPLAINED * (2 / freedom) ** 0.5:
        poor = f"the model does not explain the positions: χ² is {mean:.3g} per degree of freedom"
    if poor:
        poor += "; the start is another camera or too far off, or the positions' deviation is wrong"
    stopped = "least squares did not converge; try fewer parameters, or a nearer start"
    alike = hardly_seen(names, curvature)
    values = {n: jnp.asarray(found.value(n)) for n in names} | ({"gain": gain} if of_matrix else {})
    return ScreenFit(
        found.camera,
        found.plane,
        jnp.asarray(gain),
        values,
        {n: jnp.asarray(e) for n, e in zip(names, errors, strict=True)},
        jnp.asarray(known.correlation),
        jnp.asarray(explained),
        *verdict(alike, poor, "" if converged else stopped),
        orders,
        samples,
    )
