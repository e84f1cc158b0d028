r"""Contours of gradient noise: thin closed lines in all directions, a PSF to aim for."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid

# Of unit gradients the noise lies within ±0.7. Zero itself is taken at every node of the lattice,
# where its contours would meet in a regular pattern.
_LEVELS = (-0.12, 0.12)


def contour_target(
    key: PRNGKeyArray,
    grid: Grid,
    *,
    feature: Number,
    line_width: Number,
    levels: tuple[float, ...] = _LEVELS,
) -> Float[Array, "y x"]:
    r"""A PSF of thin lines: iso-contours of gradient noise (Perlin 1985), of the sum 1.

    Its lines run in all directions and are sparse and sharp, so that its spectrum falls slowly and
    has no zeros: the target of PhlatCam (Boominathan et al., IEEE PAMI 42, 1618 (2020)). Lines of
    even width are those where :math:`|N - c| < \tfrac w2 |\nabla N|`.

    - `grid`: of the PSF; beyond it there is no light.
    - `feature`: distance of the noise's nodes, mm: how far lines are apart. At least four samples.
    - `line_width`: w, mm, from a sample to `feature`.
    - `levels`: the c; the noise has a standard deviation of about 0.25.
    """
    feature = checks.positive("feature", feature, "mm")
    width = checks.positive("line_width", line_width, "mm")
    pitch = float(grid.pitch)
    if float(feature) < 4 * pitch or not pitch <= float(width) <= float(feature):
        raise ValueError(
            f"feature = {float(feature):g} mm and line_width = {float(width):g} mm on samples of "
            f"{pitch:g} mm; give at least {4 * pitch:g} and {pitch:g} mm, lines within the feature"
        )
    noise, (down, across) = _noise(key, grid, feature)
    slope = jnp.sqrt(down**2 + across**2) + jnp.finfo(noise.dtype).eps
    lines = jnp.zeros_like(noise)
    for level in levels:
        beyond = width / 2 - jnp.abs(noise - level) / slope
        # The part of a sample that a line through it covers, across the line.
        lines = jnp.maximum(lines, jnp.clip(beyond / grid.pitch + 0.5, 0.0, 1.0))
    total = jnp.sum(lines)
    if not float(total) > 0:
        raise ValueError(
            f"no contour of the levels {levels} lies on the grid; give a smaller feature or levels "
            "nearer to 0"
        )
    return lines / total


def _noise(key: PRNGKeyArray, grid: Grid, feature):
    """Gradient noise on the grid, and its derivatives along y and x, 1/mm."""
    nodes = tuple(int(n * float(grid.pitch) / float(feature)) + 3 for n in grid.shape)
    angle = jax.random.uniform(key, nodes, feature.dtype, maxval=2 * jnp.pi)
    y, x = (a / feature + (n - 1) / 2 for a, n in zip((grid.y, grid.x), nodes, strict=True))

    def value(y, x):
        row, column = jnp.floor(y).astype(int), jnp.floor(x).astype(int)
        v, u = y - jnp.floor(y), x - jnp.floor(x)
        fade_v, fade_u = (t**3 * (t * (6 * t - 15) + 10) for t in (v, u))
        total = jnp.zeros_like(y)
        for i in (0, 1):
            for j in (0, 1):
                turn = angle[row + i, column + j]
                ramp = jnp.sin(turn) * (v - i) + jnp.cos(turn) * (u - j)
                weight = (fade_v if i else 1 - fade_v) * (fade_u if j else 1 - fade_u)
                total = total + weight * ramp
        return total

    field = jax.vmap(jax.vmap(jax.value_and_grad(value, (0, 1)), (None, 0)), (0, None))
    noise, slopes = jax.jit(field)(y, x)
    return noise, tuple(slope / feature for slope in slopes)
