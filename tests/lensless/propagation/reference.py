"""The Fresnel field of a rectangular zone aperture, worked out again in NumPy, SciPy and mpmath.

Nothing here comes from the package, and no shortcut that the package takes is taken: the mask's
offset stays under the integral, no order is paired with another.
"""

import math

import mpmath
import numpy as np
import scipy.special

COSINE = {0: 0.5, 1: 0.25, -1: 0.25}


def chirp(g, b, x, lower, upper):
    """∫ exp j[gξ² + b(x−ξ)²] dξ by scipy.special.fresnel.

    With a = g + b: gξ² + b(x−ξ)² = a(ξ − bx/a)² + gbx²/a. Breaks down for a → 0.
    """
    a = g + b
    scale = np.sqrt(2 * abs(a) / np.pi)
    s_high, c_high = scipy.special.fresnel(scale * (upper - b * x / a))
    s_low, c_low = scipy.special.fresnel(scale * (lower - b * x / a))
    integral = (c_high - c_low) + 1j * np.sign(a) * (s_high - s_low)
    return np.exp(1j * g * b * x**2 / a) * integral / scale


def axis_field(order, x, *, beta, width, distance, wavelength, object_distance, centre=0.0):
    """√(M/(jλd)) ∫ exp j[kβ(ξ−c)² + πξ²/(λt) + π(x−ξ)²/(λd)] dξ over |ξ − c| ≤ width/2.

    The square with the offset c: a = kβ + s + b, q = kβc + bx; what remains of the exponent is
    [kβb(x−c)² + s(kβc² + bx²)]/a.
    """
    b = np.pi / (wavelength * distance)
    s = np.pi / (wavelength * object_distance)
    g = order * beta
    a, q = g + s + b, g * centre + b * x
    rest = (g * b * (x - centre) ** 2 + s * (g * centre**2 + b * x**2)) / a
    scale = np.sqrt(2 * abs(a) / np.pi)
    ends = [scale * (centre + side * width / 2 - q / a) for side in (-1, 1)]
    (s_low, c_low), (s_high, c_high) = (scipy.special.fresnel(end) for end in ends)
    integral = ((c_high - c_low) + 1j * np.sign(a) * (s_high - s_low)) / scale
    magnification = 1 + distance / object_distance
    return np.sqrt(magnification / (1j * wavelength * distance)) * np.exp(1j * rest) * integral


def psf(y, x, *, phase=0.0, centre=(0.0, 0.0), orders=None, height=None, **geometry):
    """|Σ_k c_k e^{jkφ} A_k(y) A_k(x)|², (y, x)."""
    along_y = geometry if height is None else {**geometry, "width": height}
    field = np.zeros((len(y), len(x)), complex)
    for k, c in (orders or COSINE).items():
        rows = axis_field(k, y, centre=centre[0], **along_y)
        columns = axis_field(k, x, centre=centre[1], **geometry)
        field += c * np.exp(1j * k * phase) * np.outer(rows, columns)
    return np.abs(field) ** 2


def chirp_by_quadrature(g, b, x, lower, upper):
    """The chirp integral by Gauss-Legendre quadrature in pieces of some 10 rad.

    The phase at each piece's middle is reduced in mpmath; from there it is a few rad.
    """
    span = abs(g + b) * (upper - lower) ** 2 / 4
    span += abs(g * (lower + upper) + b * (lower + upper - 2 * x)) * (upper - lower)
    pieces = math.ceil(span / 10) + 1
    phases, slopes = [], []
    with mpmath.workdps(20):
        half = (mpmath.mpf(upper) - mpmath.mpf(lower)) / (2 * pieces)
        for n in range(pieces):
            middle = mpmath.mpf(lower) + (2 * n + 1) * half
            beyond = mpmath.mpf(x) - middle
            phases.append(float(mpmath.fmod(g * middle**2 + b * beyond**2, 2 * mpmath.pi)))
            slopes.append(float(2 * (g * middle - b * beyond)))
    nodes, weights = np.polynomial.legendre.leggauss(32)
    s = nodes * float(half)
    turned = np.add.outer(phases, (g + b) * s**2) + np.outer(slopes, s)
    return complex(np.sum(np.exp(1j * turned) @ weights) * float(half))


def centred(count, pitch):
    """Pixel centres (i − (n−1)/2)·pitch."""
    return (np.arange(count) - (count - 1) / 2) * pitch
