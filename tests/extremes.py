"""The extremes of the PSF models: which cameras, how exact, and an independent reference.

Bounds are some two to three times what was measured; `docs/measured/extremes.md` quotes them.
"""

import dataclasses
import functools
import math

import mpmath
import numpy as np
import scipy.special

INF = math.inf
PARAMETERS = ("beta", "phase", "width", "distance", "wavelength", "object_distance")
COSINE = {0: 0.5, 1: 0.25, -1: 0.25}
POINTS = (48, 64)
AVERAGES = (6, 9)  # the reference of an average is some hundred points a pixel
DIGITS = 40  # of the reference's phases: exact to 1e-16 rad up to 1e24 rad


@dataclasses.dataclass(frozen=True)
class Extreme:
    """A camera, the grid it is looked at on, and what is promised for it.

    Lengths in mm. `pitch` spreads the grid over edges and interior; `centre` (y, x) moves the mask
    so that a fine grid sees an edge. `float32`, `float64`: largest relative L2 error of the PSF.
    `differences`: whether the phases leave digits to finite differences in float64. `nodes` a pixel
    for the reference of an average; the reference has `every` so many rows.
    """

    name: str
    float32: float
    float64: float
    model: str = "separable"
    pixel_integration: bool = False
    beta: float = 25.0
    phase: float = 0.7
    width: float = 5.632
    distance: float = 6.5
    wavelength: float = 500e-6
    object_distance: float = 250.0
    shape: tuple[int, int] = POINTS
    pitch: float = 0.11
    centre: tuple[float, float] = (0.0, 0.0)
    differences: bool = True
    nodes: int = 40
    every: int = 1

    def numbers(self, dtype) -> dict[str, float]:
        """The camera's numbers as that precision holds them."""
        names = (*PARAMETERS, "pitch")
        return {name: float(dtype(getattr(self, name))) for name in names}

    @property
    def epsilon(self) -> float:
        """ε = βλd/(πM)."""
        scale = 1 + self.distance / self.object_distance
        return self.beta * self.wavelength * self.distance / (math.pi * scale)

    def offset(self, dtype) -> tuple[float, float]:
        return float(dtype(self.centre[0])), float(dtype(self.centre[1]))


FOCUS = math.pi / (25.0 * 500e-6)  # ε = 1 for a plane wave, 251 mm
NYQUIST = math.pi / (5.5e-3 * 5.632)  # zones at the edge at half a cycle a pixel, 101 rad/mm²
FAR_PITCH = {"pitch": 0.2, "object_distance": INF}
FINE = {"shape": AVERAGES, "pixel_integration": True, "pitch": 5.5e-3}
B = math.pi / (500e-6 * 6.5)

EXTREMES = (
    Extreme("the thesis' camera", 2.2e-5, 4.5e-14),
    # ε → 1
    Extreme("focus", 9.8e-6, 1.3e-14, distance=FOCUS, object_distance=INF),
    Extreme("focus, double", 9.8e-6, 2.9e-14, distance=FOCUS * (1 + 1e-13), object_distance=INF),
    Extreme("focus missed by 1e-3", 7.5e-6, 1.4e-14, distance=FOCUS * 1.001, object_distance=INF),
    Extreme(
        "focus missed by 1e-6", 4.3e-6, 2.0e-14, distance=FOCUS * (1 + 1e-6), object_distance=INF
    ),
    Extreme(
        "focus, finite t",
        8.5e-6,
        1.3e-14,
        distance=2 * FOCUS,
        object_distance=2 * FOCUS,
        pitch=0.22,
    ),
    Extreme("focus by zones", 1.4e-4, 2.1e-13, beta=B, object_distance=INF),
    Extreme("focus spot", 2.6e-6, 9.4e-14, distance=FOCUS, object_distance=INF, pitch=2e-3),
    Extreme("focus, pixel average", 1.0e-6, 8.9e-14, distance=FOCUS, object_distance=INF, **FINE),
    # d → 0
    Extreme("d = 0.1 mm", 1.1e-4, 2.1e-13, distance=0.1),
    Extreme("d = 1 µm", 6.8e-4, 2.3e-12, distance=1e-3),
    Extreme(
        "d = 1 µm, corner", 4.0e-4, 1.7e-12, distance=1e-3, pitch=1.5e-4, centre=(2.816, -2.816)
    ),
    Extreme("d = 1 nm", 8.2e-5, 8.2e-11, differences=False, distance=1e-6),
    Extreme(
        "d = 1 mm, pixel average",
        1.3e-3,
        1.3e-3,
        distance=1.0,
        centre=(2.81, -2.81),
        nodes=200,
        **FINE,
    ),
    # d → 10 m
    Extreme("d = 1 m", 4.7e-6, 4.1e-13, distance=1e3, **FAR_PITCH),
    Extreme("d = 10 m", 1.7e-6, 2.5e-13, distance=1e4, **FAR_PITCH),
    Extreme("d = 10 m, far field", 6.8e-5, 4.8e-14, distance=1e4, pitch=5.0, object_distance=INF),
    Extreme("d = 10 m, t = 250 mm", 1.9e-5, 8.0e-14, distance=1e4, pitch=4.5),
    Extreme("d = 10 m, pixel average", 1.7e-6, 7.3e-13, distance=1e4, object_distance=INF, **FINE),
    # t
    Extreme("t = 0.1 mm", 2.1e-4, 1.6e-13, object_distance=0.1, pitch=7.3),
    Extreme(
        "t = 0.1 mm, pixel average",
        1.7e-5,
        2.2e-10,
        object_distance=0.1,
        centre=(2.81, -2.81),
        nodes=80,
        **FINE,
    ),
    Extreme("t = 1 mm", 3.2e-5, 9.2e-14, object_distance=1.0, pitch=0.82),
    Extreme("t = 10 mm", 3.0e-5, 5.5e-14, object_distance=10.0, pitch=0.18),
    Extreme("t = 1 km", 5.0e-5, 4.7e-14, object_distance=1e6),
    Extreme("t = ∞", 2.2e-5, 2.9e-14, object_distance=INF),
    Extreme(
        "t = ∞, pixel average",
        1.5e-5,
        2.1e-9,
        object_distance=INF,
        centre=(2.81, -2.81),
        nodes=80,
        **FINE,
    ),
    # β
    Extreme("β = 1e-6", 2.3e-5, 3.0e-14, beta=1e-6),
    Extreme("β = 1e-30", 2.1e-5, 3.7e-14, beta=1e-30),
    Extreme("β at Nyquist", 7.9e-5, 1.7e-13, beta=NYQUIST),
    Extreme(
        "β at Nyquist, pixel average",
        3.0e-5,
        1.6e-9,
        beta=NYQUIST,
        centre=(2.81, -2.81),
        nodes=80,
        **FINE,
    ),
    Extreme("β = 1e4", 1.1e-4, 2.5e-13, beta=1e4),
    Extreme("β = 1e6", 2.1e-5, 3.7e-14, beta=1e6, differences=False),
    # λ
    Extreme("λ = 200 nm", 3.6e-5, 5.7e-14, wavelength=200e-6),
    Extreme("λ = 12 µm", 1.2e-5, 2.3e-14, wavelength=12e-3),
    # φ
    Extreme("φ = 1e6", 2.3e-5, 4.3e-14, phase=1e6),
    Extreme("φ = 1e6, pixel average", 1.0e-6, 1.9e-15, phase=1e6, nodes=40, **FINE),
    # width
    Extreme("10 µm mask", 1.2e-6, 9.3e-14, width=0.01, pitch=0.02),
    Extreme(
        "10 µm mask at 10 m",
        6.8e-4,
        8.3e-13,
        width=0.01,
        distance=1e4,
        pitch=20.0,
        object_distance=INF,
    ),
    Extreme("100 mm mask", 3.2e-3, 1.2e-11, width=100.0, pitch=2.0),
    # sensors
    Extreme("1×1 sensor", 1.1e-5, 4.3e-15, shape=(1, 1)),
    Extreme(
        "16384×64 sensor",
        3.8e-5,
        6.1e-14,
        shape=(16384, 64),
        pitch=5e-4,
        centre=(0.0, 2.816),
        every=16,
    ),
    # other models
    Extreme("geometric: t = 0.1 mm", 2.5e-5, 3.7e-14, "geometric", object_distance=0.1, pitch=7.3),
    Extreme("geometric: β = 1e4", 7.8e-3, 1.2e-11, "geometric", beta=1e4),
    Extreme("geometric: φ = 1e6", 2.2e-5, 3.4e-14, "geometric", phase=1e6),
    Extreme("geometric: 100 mm mask", 5.9e-3, 9.6e-12, "geometric", width=100.0, pitch=2.0),
    Extreme("geometric: β = 1e-6, pixel average", 1.0e-6, 1.9e-15, "geometric", beta=1e-6, **FINE),
    Extreme(
        "geometric: β at Nyquist, pixel average",
        4.8e-5,
        1.5e-13,
        "geometric",
        beta=NYQUIST,
        centre=(2.81, -2.81),
        **FINE,
    ),
    Extreme(
        "geometric: t = 0.1 mm, pixel average",
        1.3e-5,
        2.8e-14,
        "geometric",
        object_distance=0.1,
        centre=(2.81, -2.81),
        **FINE,
    ),
    Extreme(
        "geometric: 10 µm mask, pixel average", 1.0e-6, 1.9e-15, "geometric", width=0.01, **FINE
    ),
    Extreme(
        "closed_form: ε = 0.999",
        1.1e-2,
        2.5e-10,
        "closed_form",
        distance=FOCUS * 0.999,
        object_distance=INF,
        differences=False,
    ),
    Extreme("closed_form: d = 1 nm", 1.6e-5, 5.8e-14, "closed_form", distance=1e-6),
    Extreme(
        "closed_form: d = 10 m", 1.0e-6, 1.9e-15, "closed_form", distance=1e4, object_distance=INF
    ),
    Extreme(
        "closed_form: t = 0.1 mm", 2.5e-5, 3.1e-14, "closed_form", object_distance=0.1, pitch=7.3
    ),
    Extreme(
        "closed_form: t = 0.1 mm, pixel average",
        1.7e-5,
        4.5e-14,
        "closed_form",
        object_distance=0.1,
        centre=(2.81, -2.81),
        **FINE,
    ),
    Extreme("paraxial: d = 1 nm", 1.6e-5, 9.2e-14, "paraxial", distance=1e-6),
    Extreme("paraxial: t = 0.1 mm", 1.9e-5, 6.5e-14, "paraxial", object_distance=0.1, pitch=7.3),
    Extreme("paraxial: φ = 1e6", 2.7e-5, 4.3e-14, "paraxial", phase=1e6),
)

# Largest relative error of float32 gradients, by `PARAMETERS`; None where the derivative is zero.
GRADIENTS: dict[str, tuple[float | None, ...]] = {
    "the thesis' camera": (7.0e-5, 4.5e-5, 3.5e-3, 4.0e-3, 3.7e-3, 7.0e-4),
    "φ = 1e6, pixel average": (1.6e-2, 8.0e-7, 3.8, 2.3, 2.2, 8.5e-1),
    "focus": (3.0e-5, 2.3e-5, 6.0e-5, 3.5e-5, 3.5e-5, None),
    "d = 0.1 mm": (1.6e-4, 1.3e-4, 1.6e-1, 2.2e-1, 2.2e-1, 7.5e-2),
    "d = 1 µm": (1.1e-3, 7.5e-4, 2.8, 2.8, 2.8, 2.8),
    "t = 0.1 mm": (2.8e-4, 1.8e-4, 2.5e-1, 2.1e-1, 3.8e-1, 1.2e-1),
    "t = ∞": (4.3e-5, 3.2e-5, 2.8e-3, 3.2e-3, 3.2e-3, None),
    "β = 1e4": (3.2e-3, 8.8e-4, 4.7e-3, 1.7e-3, 1.8e-3, 1.8e-3),
    "100 mm mask": (1.3e-2, 8.5e-3, 1.2, 1.2, 1.9, 1.5e-2),
    "geometric: 100 mm mask": (7.5e-3, 7.5e-3, None, 7.5e-3, None, 7.5e-3),
    "closed_form: ε = 0.999": (3.5, 4.2, None, 3.5, 3.5, None),
}
# A bound above this says that the derivative is lost; tests show errors above a quarter.
LOST = 0.8

# Where the prediction of the error is looked at, and what a tolerance of 1e-7 chooses.
CHOICES = ("focus", "d = 1 µm", "t = 0.1 mm", "λ = 12 µm", "100 mm mask", "16384×64 sensor")


def find(name: str) -> Extreme:
    return next(extreme for extreme in EXTREMES if extreme.name == name)


def reference(extreme: Extreme, dtype):
    """The PSF in float64 at the numbers that `dtype` holds, phases reduced in 40 digits."""
    camera, offset = extreme.numbers(dtype), extreme.offset(dtype)
    with mpmath.workdps(DIGITS):
        camera = {name: mpmath.mpf(value) for name, value in camera.items()}
        scale = 1 + camera["distance"] / camera["object_distance"]
        pitch = camera.pop("pitch")
        axes = [
            [
                mpmath.mpf(2 * i - n + 1) / 2 * pitch - scale * mpmath.mpf(c)
                for i in range(0, n, step)
            ]
            for n, step, c in zip(extreme.shape, (extreme.every, 1), offset, strict=True)
        ]
        if not extreme.pixel_integration:
            return _PSF[extreme.model](*axes, **camera)
        return _averages(extreme, axes, pitch, camera)


legendre = functools.cache(np.polynomial.legendre.leggauss)


def _averages(extreme, axes, pitch, camera):
    """Gauss-Legendre in every pixel; the shadow's edge, a step, divides its pixel."""
    half = camera["width"] / 2 * (1 + camera["distance"] / camera["object_distance"])
    nodes, weights = legendre(extreme.nodes)
    points, parts = [], []
    for axis in axes:
        low, high = [p - pitch / 2 for p in axis], [p + pitch / 2 for p in axis]
        if extreme.model == "geometric":
            low = [min(max(v, -half), half) for v in low]
            high = [min(max(v, -half), half) for v in high]
        points.append(
            [(a + b) / 2 + n * (b - a) / 2 for a, b in zip(low, high, strict=True) for n in nodes]
        )
        parts.append([float((b - a) / pitch) for a, b in zip(low, high, strict=True)])
    fine = _PSF[extreme.model](*points, **camera)
    fine = fine.reshape(len(axes[0]), extreme.nodes, len(axes[1]), extreme.nodes)
    return np.einsum("iajb,a,b,i,j->ij", fine, weights / 2, weights / 2, *parts)


def _reduced(phases):
    """Phases of many digits, in rad, modulo 2π."""
    return np.array([float(mpmath.fmod(phase, 2 * mpmath.pi)) for phase in phases])


def chirp(g, b, points, lower, upper):
    """∫ exp j[gξ² + b(x−ξ)²] dξ for numbers of many digits.

    Tails from each end to infinity by scaled complementary error functions, so that nothing is
    subtracted but what the result itself holds; slow integrands by 256 Gauss-Legendre nodes.
    """
    a = g + b
    turn = max(abs(g * (lower + upper) + b * (lower + upper - 2 * x)) for x in points)
    if abs(a) * (upper - lower) ** 2 / 4 + turn * (upper - lower) < 400:
        return _slow_chirp(g, b, points, lower, upper)
    root, sign = mpmath.sqrt(abs(a)), (1 if a > 0 else -1)
    turned = np.exp(-0.25j * np.pi * sign)  # √(−j) for a > 0

    def tail(end):
        slopes = [a * end - b * x for x in points]
        u = np.array([float(abs(s) / root) for s in slopes])
        side = np.array([1.0 if s >= 0 else -1.0 for s in slopes])
        phase = _reduced([g * end**2 + b * (x - end) ** 2 for x in points])
        return side * np.exp(1j * phase) * scipy.special.wofz(1j * turned * u), side

    (low, side_low), (high, side_high) = tail(lower), tail(upper)
    inside = (side_high - side_low) / 2
    stationary = 2 * inside * np.exp(1j * _reduced([g * b * x**2 / a for x in points]))
    return sign * math.sqrt(math.pi) / (2 * float(root)) / turned * (stationary - (high - low))


def _slow_chirp(g, b, points, lower, upper):
    nodes, weights = legendre(256)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    centre = _reduced([g * middle**2 + b * (x - middle) ** 2 for x in points])
    slope = np.array([float(2 * (g * middle + b * (middle - x))) for x in points])
    s = nodes * float(half)
    inner = np.exp(1j * (slope[:, None] * s + float(g + b) * s**2)) @ weights
    return np.exp(1j * centre) * inner * float(half)


def _separable(y, x, *, beta, phase, width, distance, wavelength, object_distance):
    b, s = (mpmath.pi / (wavelength * z) for z in (distance, object_distance))
    scale = float((1 + distance / object_distance) / (wavelength * distance))
    field = 0
    for (k, c), shift in zip(COSINE.items(), _reduced([k * phase for k in COSINE]), strict=True):
        rows, columns = (chirp(k * beta + s, b, p, -width / 2, width / 2) for p in (y, x))
        field = field + c * np.exp(1j * shift) * scale * np.outer(rows, columns)
    return np.abs(field) ** 2


def _zones(curvature, phase, y, x):
    """curvature·(x² + y²) + phase modulo 2π, (y, x)."""
    rows, columns = (_reduced([curvature * p**2 for p in axis]) for axis in (y, x))
    return rows[:, None] + columns + _reduced([phase])


def _geometric(y, x, *, beta, phase, width, distance, wavelength, object_distance):
    scale = 1 + distance / object_distance
    open_y, open_x = (np.array([abs(p) <= scale * width / 2 for p in axis]) for axis in (y, x))
    zones = _zones(beta / scale**2, phase, y, x)
    return ((1 + np.cos(zones)) / 2) ** 2 * np.outer(open_y, open_x)


def _closed_form(y, x, *, beta, phase, width, distance, wavelength, object_distance):
    scale = 1 + distance / object_distance
    epsilon = beta * wavelength * distance / (mpmath.pi * scale)
    field = 0
    for k, c in COSINE.items():
        gain = 1 / (1 + k * epsilon)
        zones = _zones(k * beta * gain / scale**2, k * phase, y, x)
        field = field + c * float(gain) * np.exp(1j * zones)
    return np.abs(field) ** 2


def _paraxial(y, x, *, beta, phase, width, distance, wavelength, object_distance):
    scale = 1 + distance / object_distance
    epsilon = beta * wavelength * distance / (mpmath.pi * scale)
    zones = np.cos(_zones(beta / scale**2, phase, y, x))
    diffraction = np.cos(_zones(epsilon * beta / scale**2, 0, y, x))
    return 0.25 + 0.5 * diffraction * zones + 0.25 * zones**2


_PSF = {
    "separable": _separable,
    "geometric": _geometric,
    "closed_form": _closed_form,
    "paraxial": _paraxial,
}
