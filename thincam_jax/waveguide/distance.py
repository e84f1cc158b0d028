r"""Distance of a flat object from the displacement of its ghosts in one capture.

Pixels are read in rows. Each is predicted from six neighbours that were read before it, with
weights fitted to the pixels around them (edge-directed prediction, Li and Orchard 2001), and its
error has Student's t distribution with the spread of the errors nearby:

.. math:: \log p(F) = \sum_k \log t_\nu\!\left(\frac{F_k - \hat F_k}{s_k}\right) - \log s_k

Every factor is a density given the pixels before, so that the product is a density of the whole
picture: no spectrum or sparsity is assumed, and pictures of other transforms of unit determinant
compare. A repetition within a picture that the neighbours do not explain, such as a ghost, costs
likelihood.

The first image F(u) of an object on the sensor is the same at all distances d2, for an object of
the same angular size. Its ghosts are displaced by parallax, in proportion to 1/(d1 + d2):

.. math:: g(\mathbf u) = \sum_i W_i(\mathbf u)\, F(\mathbf u_i), \qquad
    \mathbf P_0(\mathbf u_i; d_2) = \mathbf P_i(\mathbf u; d_2)

with the object points and weights of `trace` (thesis Eq 5.9 and 5.10). For each distance this is
solved for F, and a distance is as likely as the picture that it leaves:

.. math:: \log L(d_2) = \log p(F_{d_2}) - \log\left|\det \partial g/\partial F\right|

A wrong distance leaves ghosts and adds negative ones, which no neighbouring pixel predicts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax.waveguide.camera import SeeThroughCamera
from thincam_jax.waveguide.rays import bragg_rays, check_screen, object_points, pixel_centres, trace

_BEFORE = ((0, -1), (-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0))  # (y, x) from the pixel
_REACH = 5  # pixels before, in each direction, that the weights are fitted to
_NEARBY = 1  # pixels before, in each direction, whose errors give the spread
_FREEDOM = 4.0  # ν of Student's t
_FLOOR = 0.1  # least variance, of the typical one: no spread is learnt exactly


def picture_likelihood(
    picture: Float[np.ndarray, "y x"], variance: float
) -> Float[np.ndarray, "y x"]:
    """Logarithm of each pixel's density, up to a constant, the mean of two orders of reading.

    - `picture`: picture in any unit. It is read from the top row and from the bottom row.
    - `variance`: variance of the typical error, the picture's unit squared; see `typical_variance`.
    """
    down = _log_density(_errors(picture), variance)
    up = _log_density(_errors(picture[::-1]), variance)
    return (down + up[::-1]) / 2


def typical_variance(picture: Float[np.ndarray, "y x"]) -> float:
    """Variance of a normal distribution with the geometric mean of the squared errors."""
    squared = _errors(picture) ** 2
    least = 1e-12 * max(float(np.mean(picture**2)), np.finfo(float).tiny)
    return 3.56 * float(np.exp(np.mean(np.log(squared + least))))


def _errors(picture: np.ndarray) -> np.ndarray:
    """Errors of the predictions of each pixel from those before it."""
    shape, (rows, columns) = picture.shape, picture.shape
    padded = np.pad(picture, ((2, 0), (2, 2)), mode="edge")
    seen = [padded[2 + y : 2 + y + rows, 2 + x : 2 + x + columns] for y, x in _BEFORE]
    start = (seen[0] + seen[1]) / 2
    details = np.stack([seen[0], *seen[2:]]) - start  # of seen[1] it is that of seen[0], negative
    target, count = picture - start, len(details)
    # Weights for the whole picture first, then what the pixels nearby change them by.
    whole = np.einsum("iyx,jyx->ij", details, details) / picture.size
    whole = whole + 1e-9 * (np.trace(whole) + np.finfo(float).tiny) * np.eye(count)
    mean = np.einsum("iyx,yx->i", details, target) / picture.size
    left = target - np.tensordot(np.linalg.solve(whole, mean), details, 1)
    first, second = np.triu_indices(count)
    products = _sum_before(details[first] * details[second], _REACH)
    nearby = np.empty((*shape, count, count))
    nearby[..., first, second] = nearby[..., second, first] = np.moveaxis(products, 0, -1)
    strength = np.trace(nearby, axis1=-2, axis2=-1) / np.trace(whole) / _count(_REACH)
    nearby += np.maximum(strength, 1e-3)[..., None, None] * whole
    moments = np.moveaxis(_sum_before(details * left, _REACH), 0, -1)
    change = np.linalg.solve(nearby, moments[..., None])[..., 0]
    return left - np.einsum("yxi,iyx->yx", change, details)


def _log_density(errors: np.ndarray, variance: float) -> np.ndarray:
    squared = errors**2
    spread = (_sum_before(squared, _NEARBY) + variance) / (_count(_NEARBY) + 1) + _FLOOR * variance
    tail = np.log1p(squared / (_FREEDOM * spread))
    return -0.5 * np.log(spread) - 0.5 * (_FREEDOM + 1) * tail


def _count(reach: int) -> int:
    """Number of the pixels before one within a reach."""
    return 2 * reach * (reach + 1)


def _sum_before(values: np.ndarray, reach: int) -> np.ndarray:
    """Sum over the pixels before each, within a reach: above and in its row, (*batch, y, x)."""
    wide = (2 * reach + 1) * scipy.ndimage.uniform_filter1d(values, 2 * reach + 1, mode="nearest")
    return _sum_of_last(wide, reach, -2) + _sum_of_last(values, reach, -1)


def _sum_of_last(values: np.ndarray, reach: int, axis: int) -> np.ndarray:
    """Sum of the `reach` entries before each along an axis."""
    values = np.moveaxis(values, axis, -1)
    sums = np.cumsum(np.pad(values, [(0, 0)] * (values.ndim - 1) + [(reach + 1, 0)]), axis=-1)
    size = values.shape[-1]
    return np.moveaxis(sums[..., reach : reach + size] - sums[..., :size], -1, axis)


_STEP = 0.25  # pixels that the first ghost moves between neighbouring distances of the search
_APART = 0.75  # pixels between the first ghosts of a distance and of its rivals
_MODEL_ERROR = 0.05  # pixels, of the first ghost's displacement; from photographs, CC0 set
_BORDER = 4  # pixels along the edges that have too few neighbours
_LEAST = 16  # rows and columns of a capture
_TILES = 5, 6  # parts of a capture, (y, x), taken for independent
_LEVEL = 0.025  # chance to prefer a distance to one that is as good
_GAIN = math.log(20.0)  # least difference of log-likelihoods to every rival
_SOLUTIONS = 6  # fixed-point steps; ghosts have a fifth of the light, so 0.2⁶ is left

DistanceStatus = Literal["determined", "ambiguous", "at_end"]


@dataclass(frozen=True, eq=False)
class GhostDistance:
    """Distance of a flat object, and how well its capture determines it.

    - `distance`: the likeliest, mm. `standard_error`: mm; infinite unless it is determined.
    - `status`: "determined"; "ambiguous" where other distances explain the capture as well, within
      its statistics; "at_end" of the range, outside of which the object may be.
    - `distances`: all that were compared, mm, increasing.
    - `log_likelihood`: log-likelihood of each distance, 0 at the likeliest.
    - `lead`: Student's t by which the likeliest is better than each, over parts of the capture.
    """

    distance: float
    standard_error: float
    status: DistanceStatus
    distances: Float[np.ndarray, " distance"]
    log_likelihood: Float[np.ndarray, " distance"]
    lead: Float[np.ndarray, " distance"]

    @property
    def plausible(self) -> Float[np.ndarray, " plausible"]:
        """Distances that the capture does not exclude, mm: the answer where it is ambiguous."""
        return self.distances[~_excluded(self.log_likelihood, self.lead)]


@checked
def distance_from_ghosts(
    camera: SeeThroughCamera,
    capture: Numbers,
    *,
    nearest: Number = 200.0,
    farthest: Number = 2000.0,
    orders: int = 4,
) -> GhostDistance:
    r"""Distance of an unknown flat object, from one capture with its ghosts.

    The picture is unknown, too. `camera` knows where the ghosts of every distance are and how
    strong, so that they can be removed from the capture for each distance; the right one leaves
    the likeliest picture (`picture_likelihood`). Distances are compared at equal steps of
    1/(d1 + d2), of a quarter of a pixel of the first ghost.

    A picture may repeat itself as if by a ghost. So the capture is divided into 30 tiles, and the
    likeliest distance is "determined" only if it is better than every other that moves the first
    ghost by 3/4 of a pixel or more, by Student's t of the tiles' differences at a one-sided level
    of 2.5 % (Vuong 1989) and by a likelihood ratio of 20; and better, likewise, than ghosts on the
    opposite side of the image, where no distance puts them and patterns repeat as well. The
    standard error is that of the tiles' derivatives (the sandwich estimate), and 0.05 pixels of
    the ghost's place for the model.

    **Arguments**

    - `capture`: irradiance in any unit, (y, x), without the sensor's offset. The object fills the
      field or is before a dark ground.
    - `nearest`, `farthest`: the range searched, d2 from the plate's front surface, mm. Pixels
      whose first ghost comes from beyond the sensor at `nearest` are not compared.
    - `orders`: number of ghosts.

    **Errors**: ValueError for a capture of another shape than the sensor, without light or with
    less than 16 rows or columns, for `nearest` that is not below `farthest`, so near that less than
    half of the pixels can be compared, or with too little parallax between them; and where
    `check_screen` finds no light.

    **Validity**: a flat object, parallel to the plate, with no other light. The error grows as
    (d1 + d2)²: on 66² pixels of 32 µm at 40 dB about 1 mm at 300, 3 mm at 550 and 16 mm at 900 mm.
    Nothing is determined of a blank object that fills the field; of 48 photographs of natural
    scenes 14 were determined, never wrong, and 34 left several `plausible` distances. It takes 2 s
    for 66² pixels, growing as the cube of the side: bin finer captures. Eager: the result holds
    plain numbers.

    ```python
    import jax.numpy as jnp
    import numpy as np

    import thincam_jax as tc
    from thincam_jax import waveguide as wg
    from thincam_jax.imaging.targets import resize, sample_image
    from thincam_jax.units import deg, nm, um

    hologram = wg.VolumeHologram.record(
        532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    screen = wg.Screen(hologram, glass_thickness=5.0, glass_index=1.5)
    camera = wg.SeeThroughCamera(screen, tc.Sensor((44, 36), 48 * um), 6.0, 10.0)
    plane = wg.ObjectPlane((80, 80), distance=430.0, width=250.0, centre=(60.0, 0.0))
    picture = jnp.asarray(resize(sample_image("camera", linear=True), (80, 80)), jnp.float32)
    capture = wg.system_operator(camera, plane)(picture)
    found = wg.distance_from_ghosts(camera, np.asarray(capture), nearest=300.0, farthest=1000.0)
    print(found.status, found.distance, found.standard_error)
    ```

    See also `trace`, `ObjectPlane`.
    """
    near = float(checks.positive("nearest", nearest, "mm"))
    far = float(checks.positive("farthest", farthest, "mm"))
    if not near < far:
        raise ValueError(f"nearest = {near:g} mm, farthest = {far:g} mm; give nearest below it")
    if orders < 2:
        raise ValueError(f"orders = {orders}; give at least 2, the image and its first ghost")
    image = checks.finite("capture", capture, "irradiance", shape=camera.sensor.shape)
    return find_distances_of(camera, [np.asarray(image, float)], (near, far), orders)[0]


def find_distances_of(
    camera: SeeThroughCamera,
    captures: Sequence[Float[np.ndarray, "y x"]],
    ends: tuple[float, float],
    orders: int = 4,
) -> list[GhostDistance]:
    """`distance_from_ghosts` of several captures, whose ghosts are traced once."""
    if not all(capture.any() for capture in captures):
        raise ValueError("capture is dark; give one with light")
    search = _search(camera, ends, orders)
    images = [capture / search.first for capture in captures]
    typical = [typical_variance(image) for image in images]
    parts, here = [], np.moveaxis(np.indices(camera.sensor.shape), 0, -1)
    for distance in search.distances:
        places = _places(camera, float(distance), orders)
        for side in (places, 2 * here - places):
            matrix = _ghost_matrix(search.ghosts, side)
            volume = _log_determinant(matrix).reshape(camera.sensor.shape)
            pairs = zip(images, typical, strict=True)
            logs = [picture_likelihood(_without_ghosts(i, matrix), t) - volume for i, t in pairs]
            parts.append([_tiled(values, search.used) for values in logs])
    return [_judged(search, one) for one in np.moveaxis(np.asarray(parts), 0, -1)]


@dataclass(frozen=True, eq=False)
class _Search:
    """Distances to compare and the pixels that compare them.

    - `inverse`: 1/(d1 + d2), equally spaced, falling. `pixels`: that the first ghost moves a step.
    - `first`: weight of the first image, 1 in the mean. `ghosts`: weights relative to it.
    - `used`: pixels whose first ghost comes from the sensor at all distances.
    """

    distances: Float[np.ndarray, " distance"]
    inverse: Float[np.ndarray, " distance"]
    pixels: float
    first: Float[np.ndarray, "y x"]
    ghosts: Float[np.ndarray, "order y x"]
    used: Bool[np.ndarray, "y x"]


def _search(camera: SeeThroughCamera, ends: tuple[float, float], orders: int) -> _Search:
    if min(camera.sensor.shape) < _LEAST:
        raise ValueError(
            f"the sensor has {camera.sensor.shape} pixels; give at least {_LEAST} in each direction"
        )
    check_screen(camera)
    weight = np.asarray(
        trace(camera, pixel_centres(camera), object_distance=ends[0], orders=orders).weight, float
    )
    lit = weight[0] > 1e-3 * weight[0].max()
    near, far = (_places(camera, end, 2)[0] for end in ends)
    moved = float(np.median(np.linalg.norm(near - far, axis=-1)[lit]))
    if not moved > 2:
        raise ValueError(
            f"from {ends[0]:g} to {ends[1]:g} mm the first ghost moves by {moved:.2g} pixels; give "
            "a range of distances, or pixels, over which it moves by more than 2"
        )
    shape = np.array(camera.sensor.shape)
    used = lit & ((near >= -1.5) & (near <= shape + 0.5)).all(axis=-1)
    kept = np.zeros_like(used)
    kept[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
    used &= kept
    if 2 * np.count_nonzero(used) < np.count_nonzero(lit & kept):
        raise ValueError(
            f"at nearest = {ends[0]:g} mm most pixels have their first ghost from beyond the "
            "sensor; give a larger nearest distance"
        )
    offset, count = float(camera.lens_distance), math.ceil(moved / _STEP) + 1
    inverse = np.linspace(1 / (offset + ends[0]), 1 / (offset + ends[1]), count)
    first = np.where(lit, weight[0], np.inf)
    return _Search(
        distances=1 / inverse - offset,
        inverse=inverse,
        pixels=moved / (count - 1),
        first=np.where(lit, weight[0] / weight[0].mean(where=lit), 1.0),
        ghosts=weight[1:] / first,
        used=used,
    )


def _places(camera: SeeThroughCamera, distance: float, orders: int) -> np.ndarray:
    """Rows and columns, from 0, at which the first image shows what ghosts add to each pixel,
    (order, y, x, 2)."""
    pixels = pixel_centres(camera)
    found = np.asarray(_sources(camera, pixels, jnp.asarray(distance, pixels.dtype), orders), float)
    middle = (np.array(camera.sensor.shape) - 1) / 2
    return found / float(camera.sensor.pitch) + middle


@eqx.filter_jit
def _sources(
    camera: SeeThroughCamera, pixels: Array, distance: Float[Array, ""], orders: int
) -> Float[Array, "order y x 2"]:
    """Solutions u_i of P_0(u_i) = P_i(u), mm; P_0 is nearly −(d1 + d2)/d0 u."""

    def ended(places):
        return object_points(camera, bragg_rays(camera, places), distance, orders).ended

    targets = ended(pixels)[1:]
    places = jnp.broadcast_to(pixels, targets.shape)
    scale = camera.focal_distance / (camera.lens_distance + distance)
    for _ in range(5):
        places = places - scale * (targets - ended(places)[0])
    return places


def _ghost_matrix(ghosts: np.ndarray, places: np.ndarray) -> scipy.sparse.csr_array:
    """Ghosts added to each pixel, by cubic convolution; beyond the edges the picture goes on."""
    shape, size = ghosts.shape[1:], ghosts[0].size
    low = np.floor(places)
    taps = low[..., None, :] + np.arange(-1, 3)[:, None]
    parts = _cubic(np.abs(places[..., None, :] - taps))
    values = ghosts[..., None, None] * parts[..., :, None, 0] * parts[..., None, :, 1]
    rows, columns = (np.clip(taps[..., k], 0, shape[k] - 1).astype(int) for k in (0, 1))
    seen = rows[..., :, None] * shape[1] + columns[..., None, :]
    pixel = np.broadcast_to(np.arange(size).reshape(*shape, 1, 1), seen.shape)
    kept = values != 0
    return scipy.sparse.csr_array((values[kept], (pixel[kept], seen[kept])), shape=(size, size))


def _cubic(t: np.ndarray) -> np.ndarray:
    """Kernel of cubic convolution (Keys 1981, a = −1/2) at distances t in pixels."""
    near, further = (1.5 * t - 2.5) * t**2 + 1, ((-0.5 * t + 2.5) * t - 4) * t + 2
    return np.where(t < 1, near, np.where(t < 2, further, 0))


def _log_determinant(matrix: scipy.sparse.csr_array) -> np.ndarray:
    """Part of each pixel in log det(1 + R), to second order: R is nearly triangular."""
    return matrix.diagonal() - np.asarray((matrix * matrix.T).sum(axis=1)) / 2


def _without_ghosts(image: np.ndarray, matrix: scipy.sparse.csr_array) -> np.ndarray:
    found = image.ravel()
    for _ in range(_SOLUTIONS):
        found = image.ravel() - matrix @ found
    return found.reshape(image.shape)


def _tiled(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Sums over the parts of a capture."""
    rows, columns = (np.flatnonzero(used.any(axis=axis)) for axis in (1, 0))
    values = np.where(used, values, 0)
    across = np.array_split(columns, _TILES[1])
    down = np.array_split(rows, _TILES[0])
    return np.array([values[np.ix_(y, x)].sum() for y in down for x in across])


def _excluded(log_likelihood: np.ndarray, lead: np.ndarray) -> np.ndarray:
    critical = scipy.stats.t.ppf(1 - _LEVEL, math.prod(_TILES) - 1)
    return (lead > critical) & (log_likelihood < -_GAIN)


def _lead(one: Float[np.ndarray, "tile 1"], others: Float[np.ndarray, "tile distance"]):
    """Student's t by which one is better than each of others, over parts of the capture."""
    gains = one - others
    spread = gains.std(axis=0, ddof=1) * math.sqrt(len(gains))
    return gains.sum(axis=0) / np.where(spread > 0, spread, np.inf)


def _judged(search: _Search, sides: Float[np.ndarray, "tile distance_and_side"]) -> GhostDistance:
    """The likeliest distance, from the log-likelihoods of each part of a capture; every second
    is that of ghosts on the opposite side."""
    parts, opposite = sides[:, ::2], sides[:, 1::2]
    total = parts.sum(axis=0)
    best = int(total.argmax())
    likeliest = parts[:, [best]]
    lead, log_likelihood = _lead(likeliest, parts), total - total[best]
    control = _excluded(opposite.sum(axis=0) - total[best], _lead(likeliest, opposite)).all()
    rivals = abs(np.arange(total.size) - best) >= round(_APART / search.pixels)
    place, error = _peak(parts, best)
    step = search.inverse[0] - search.inverse[1]
    inverse = search.inverse[0] - place * step
    error = math.hypot(error, _MODEL_ERROR / search.pixels) * step / inverse**2
    if not 2 <= best <= total.size - 3:
        status = "at_end"
    elif control and math.isfinite(error) and _excluded(log_likelihood, lead)[rivals].all():
        status = "determined"
    else:
        status = "ambiguous"
    if status != "determined":
        error = math.inf
    distance = float(1 / inverse - (1 / search.inverse[0] - search.distances[0]))
    order = np.argsort(search.distances)
    ordered = (one[order] for one in (search.distances, log_likelihood, lead))
    return GhostDistance(distance, float(error), status, *ordered)


def _peak(parts: np.ndarray, best: int) -> tuple[float, float]:
    """Place of the maximum and its standard error, steps, by parabolas through five distances."""
    low = min(max(best - 2, 0), parts.shape[1] - 5)
    steps = np.arange(-2.0, 3.0)
    local = parts[:, low : low + 5]
    slopes, bends = local @ steps / 10, local @ (steps**2 - 2) / 7
    bend = bends.sum()
    if not bend < 0:
        return float(best), math.inf
    shift = min(max(-slopes.sum() / bend, -2.0), 2.0)
    scores = slopes + bends * shift
    error = math.sqrt(len(parts) * scores.var(ddof=1)) / -bend
    return low + 2 + shift, error
