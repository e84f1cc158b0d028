"""Test patterns for edges, for all orientations and for single points."""

import math

import numpy as np
from jaxtyping import Float64

from thincam_jax._core import checks

# A pixel's extent across an edge below which it is taken as an infinitely thin line.
_THIN = 1e-6


def slanted_edge(
    shape: tuple[int, int],
    angle: float | int = math.radians(5.0),
    low: float | int = 0.1,
    high: float | int = 0.9,
) -> Float64[np.ndarray, "y x"]:
    """A straight edge through the centre, `low` on its left and `high` on its right.

    - `angle`: in radians, from the y axis; a small positive angle leans the top of the edge to the
      right. The image is `high` where x·cos(angle) + y·sin(angle) > 0, +y down.

    Each pixel holds its exact area average: across the edge the square pixel is a trapezoid, the
    convolution of two boxes of widths |cos| and |sin|, whose second integral is elementary. This is
    the input of the slanted-edge measurement of the MTF (ISO 12233), which wants an angle that is
    no multiple of 45°.

    Raises ValueError for a bad shape, or for an angle or level that is not finite.
    """
    shape = checks.shape2d("shape", shape)
    for name, value in {"angle": angle, "low": low, "high": high}.items():
        checks.finite(name, value, "")
    y, x = _coordinates(shape)
    cosine, sine = math.cos(angle), math.sin(angle)
    a, b = max(abs(cosine), _THIN), max(abs(sine), _THIN)
    reach = (a + b) / 2  # a pixel farther from the edge than that is all on one side
    distance = x * cosine + y * sine
    near = np.clip(distance, -reach, reach)
    covered = _pixel_mean(lambda t: np.maximum(t, 0.0) ** 2 / 2, near, a, b)
    covered = np.where(np.abs(distance) < reach, covered, distance > 0)
    return low + (high - low) * covered


def siemens_star(shape: tuple[int, int], *, spokes: int = 36) -> Float64[np.ndarray, "y x"]:
    """A star of `spokes` bright sectors (1) and as many dark ones (0) on a dark ground (0).

    The disc fills 95 % of the smaller side of `shape` and stands at its centre; the middle of a
    bright sector points along +x. At radius r pixels the pattern has spokes/(2πr) cycles/pixel, so
    that every radius tests one frequency in all orientations.

    Each pixel holds its area average, with the sector's edges taken as straight and parallel within
    the pixel. Between 0.4 cycles/pixel and the Nyquist frequency 0.5 the contrast fades smoothly;
    inside r = spokes/π, beyond Nyquist, the star is its mean 1/2 rather than an alias.

    Raises ValueError for a bad shape or less than 2 spokes.
    """
    shape = checks.shape2d("shape", shape)
    spokes = checks.whole("spokes", spokes, 2)
    y, x = _coordinates(shape)
    radius = np.hypot(y, x)
    safe = np.maximum(radius, 0.5)
    cycles = spokes / (2 * np.pi) * np.arctan2(y, x)
    # how many cycles a pixel spans along x and along y: |∂cycles/∂x| and |∂cycles/∂y|
    frequency = spokes / (2 * np.pi * safe)
    along_x = np.maximum(frequency * np.abs(y) / safe, _THIN)
    along_y = np.maximum(frequency * np.abs(x) / safe, _THIN)
    bright = 0.5 + _pixel_mean(_square_wave_integral, cycles, along_x, along_y)
    fade = np.cos(np.pi / 2 * np.clip((frequency - 0.4) / 0.1, 0.0, 1.0)) ** 2
    fade[frequency >= 0.5] = 0.0
    disc = np.clip(0.475 * min(shape) - radius + 0.5, 0.0, 1.0)
    return disc * np.clip(0.5 + fade * (bright - 0.5), 0.0, 1.0)


def point_grid(shape: tuple[int, int], count: tuple[int, int]) -> Float64[np.ndarray, "y x"]:
    """Single bright pixels (1) on a dark ground (0), `count` = (rows, columns) of them.

    The image is divided into that many equal cells, and the pixel at each cell's centre is bright;
    a centre on the border of two pixels goes to the one below or to the right. A camera's response
    to it is a map of its point spread over the field.

    Raises ValueError for a bad shape, or more points than pixels along an axis.
    """
    shape, count = checks.shape2d("shape", shape), checks.shape2d("count", count)
    if count[0] > shape[0] or count[1] > shape[1]:
        raise ValueError(f"count = {count} points do not fit into shape = {shape}; give fewer")
    rows, columns = (
        (2 * np.arange(c) + 1) * n // (2 * c) for n, c in zip(shape, count, strict=True)
    )
    image = np.zeros(shape)
    image[np.ix_(rows, columns)] = 1.0
    return image


def _coordinates(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pixel centres from the centre of the array, in pixels: a column of y and a row of x."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    return y[:, None], x[None, :]


def _pixel_mean(second_integral, position, a, b):
    """Mean of a profile over the trapezoid that is the convolution of boxes of widths a and b.

    With F the second integral of the profile: the mean at p is the mixed second difference
    [F(p + (a+b)/2) − F(p + (a−b)/2) − F(p − (a−b)/2) + F(p − (a+b)/2)]/(a·b).
    """
    wide, narrow = (a + b) / 2, (a - b) / 2
    outer = second_integral(position + wide) + second_integral(position - wide)
    inner = second_integral(position + narrow) + second_integral(position - narrow)
    return (outer - inner) / (a * b)


def _square_wave_integral(t):
    """Second integral, of period 1 and mean 0, of the square wave (1/2)·sign(cos 2πt)."""
    s = t - np.round(t)  # in −1/2 … 1/2, where the wave is +1/2 for |s| < 1/4
    inner = s**2 / 4 - 1 / 64
    outer = 1 / 64 - (0.5 - np.abs(s)) ** 2 / 4
    return np.where(np.abs(s) < 0.25, inner, outer)
