r"""The PSF's transfer function and a scene's spectrum at a few frequencies.

A capture is a linear convolution, so that by Parseval its energy is
:math:`\iint |\sum_t H_t F_t|^2\,dv\,du` over the frequencies of the samples. The integral is taken
at a few hundred random ones, closer together towards zero, where scenes have their light: that
shows how an error of the PSF shows in the image of this scene.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.grids import SparseGrid
from thincam_jax._core.precision import PRECISIONS, Precision, allow, cast, product
from thincam_jax.lensless.camera import LenslessCamera, LightPath
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.psf import closed_terms, spectral_psf

Point = tuple[float, float] | None
Transfer = Complex[np.ndarray, " k"]

# Rings of frequencies, and frequencies in each.
_RINGS, _IN_RING = 32, 16


@dataclass(frozen=True, eq=False)
class Frequencies:
    """Frequencies in cycles per sample, and the area that each stands for.

    - `v`, `u`: down and across; of a pair of opposite frequencies one stands for both.
    - `weights`: areas; together 1, the whole band.
    """

    v: Float[np.ndarray, " k"]
    u: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, " k"]


def sample_frequencies(longest: int, seed: int = 0) -> Frequencies:
    """Stratified over rings that grow geometrically from a quarter of 1/`longest`."""
    random = np.random.default_rng(seed)
    edges = [0.0, *np.geomspace(min(0.25 / longest, 0.25), 0.5, _RINGS - 1), math.sqrt(0.5)]
    found = [_ring(random, low, high) for low, high in zip(edges[:-1], edges[1:], strict=True)]
    v, u, weights = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Frequencies(v, u, weights / weights.sum())


def _ring(random, low: float, high: float):
    """Frequencies of one ring inside the square band, and the ring's area shared among them."""
    tried = 4096 if high > 0.5 else _IN_RING
    radius = np.sqrt(random.uniform(low**2, high**2, tried))
    angle = random.uniform(-np.pi / 2, np.pi / 2, tried)
    v, u = radius * np.sin(angle), radius * np.cos(angle)
    inside = (np.abs(v) < 0.5) & (u < 0.5)
    area = np.pi * (high**2 - low**2) * inside.mean()
    v, u = v[inside][:_IN_RING], u[inside][:_IN_RING]
    return v, u, np.full(len(v), area / len(v))


def waves(
    frequencies: Float[np.ndarray, " k"], indices: Float[np.ndarray, " n"], length: int
) -> Float[np.ndarray, "length k2"]:
    """cos and −sin of the frequencies at centred indices, side by side; zero beyond them."""
    phase = 2 * np.pi * indices[:, None] * frequencies
    filled = np.zeros((length, 2 * len(frequencies)))
    filled[: len(indices)] = np.concatenate([np.cos(phase), -np.sin(phase)], axis=1)
    return filled


def centred(count: int) -> Float[np.ndarray, " n"]:
    return np.arange(count) - (count - 1) / 2


def image_spectrum(
    images: Float[np.ndarray, "batch m n"], frequencies: Frequencies
) -> Complex[np.ndarray, "batch k"]:
    """F(v, u) = Σ f e^{−2πj(vy+ux)} of images about their centres."""
    rows, columns = (centred(n) for n in images.shape[-2:])
    # cos and −sin side by side: one real product, at half the cost of a complex one.
    half = images @ waves(frequencies.u, columns, len(columns))
    cosine, sine = np.split(half, 2, axis=-1)
    down = np.exp(-2j * np.pi * np.outer(rows, frequencies.v))
    return np.einsum("bmk,mk->bk", cosine + 1j * sine, down)


class TransferProbe:
    r"""H(v, u) of a camera with a mask of few terms, at given frequencies.

    A separable sum transforms axis by axis, :math:`H = \sum_f \hat Y_f(v)\hat X_f(u)`: a thousandth
    of the work of an image and its transform. Frequencies are in cycles per sample of the kernel's
    grid, and H is that of its samples, aliasing included: it is what a discrete convolution uses.
    """

    def __init__(
        self, camera: LenslessCamera, kernel_shape: tuple[int, int], frequencies: Frequencies
    ) -> None:
        self.camera = camera
        lengths = [_rounded_up(n) for n in kernel_shape]
        indices = [centred(n) for n in kernel_shape]
        self.places = [
            np.concatenate([i, np.zeros(n - len(i))]) for i, n in zip(indices, lengths, strict=True)
        ]
        both = zip((frequencies.v, frequencies.u), indices, lengths, strict=True)
        found = [waves(*given) for given in both]
        with allow("float64"):
            self.waves = {p: tuple(jnp.asarray(w, p) for w in found) for p in PRECISIONS}

    def exact(
        self, wavelength: float, distance: float, method: PsfMethod, at: Point = None
    ) -> Transfer:
        """H with factors in the model's precision, transformed in double precision.

        `at`: a point on one of the mask's axes; H is then about the middle of its shadow.
        """
        with allow("float64"):
            return self._transfer("float64", self._path(wavelength, distance, at), method)

    def quick(
        self, wavelength: float, distance: float, method: PsfMethod, at: Point = None
    ) -> Transfer:
        """H in single precision, with the nodes a pixel of `method`, for many PSFs."""
        method = replace(method, precision="float32")
        return self._transfer("float32", self._path(wavelength, distance, at), method)

    def _path(self, wavelength: float, distance: float, at: Point) -> LightPath:
        path = self.camera.path(float(wavelength), float(distance), at)
        return path if at is None else replace(path, follows=True, skew=False)

    def _transfer(self, precision: Precision, path: LightPath, method: PsfMethod) -> Transfer:
        given = self.camera.mask, self.camera.sensor.pitch, path
        mask, pitch, path = cast(given, method.float_type)
        points = SparseGrid(self.places[0], self.places[1], pitch)
        return np.asarray(_transfer(mask, points, path, *self.waves[precision], method), complex)


class SampledProbe:
    """H(v, u) of a camera whose mask has no few terms, from its whole PSF, a wavelength a time."""

    def __init__(
        self, camera: LenslessCamera, kernel_shape: tuple[int, int], frequencies: Frequencies
    ) -> None:
        self.camera = camera.on_grid(camera.sensor.grid.with_shape(kernel_shape))
        self.frequencies = frequencies

    def quick(
        self, wavelength: float, distance: float, method: PsfMethod, at: Point = None
    ) -> Transfer:
        """H of the PSF as a plan computes it; with `at`, about the ray of that point."""
        grid = self.camera.sensor.grid
        h = spectral_psf(self.camera, [(wavelength, 1.0)], distance, method, grid, at)
        return image_spectrum(np.asarray(h, float)[None], self.frequencies)[0]


@jax.jit(static_argnames="method")
def _transfer(
    mask: AbstractMask,
    points: SparseGrid,
    path: LightPath,
    down: Float[Array, "m k2"],
    across: Float[Array, "n k2"],
    method: PsfMethod,
) -> Complex[Array, " k"]:
    terms = closed_terms(mask, points, path, method)
    spectra = []
    for factor, wave in zip(terms.real_factors(), (down, across), strict=True):
        both = product(factor.astype(wave.dtype), wave)
        real, imaginary = jnp.split(both, 2, axis=-1)
        spectra.append(jax.lax.complex(real, imaginary))
    return jnp.sum(spectra[0] * spectra[1], axis=0)


def _rounded_up(count: int) -> int:
    """The next of a few sizes, so that similar scenes share their compilation."""
    step = max(32, 2 ** (max(count - 1, 1).bit_length() - 3))
    return -(-count // step) * step
