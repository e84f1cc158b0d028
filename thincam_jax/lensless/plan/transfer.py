"""The PSF's transfer function at chosen frequencies, from one-dimensional factors."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.precision import Precision, allow, cast, product
from thincam_jax.lensless.accuracy.points import Points
from thincam_jax.lensless.accuracy.terms import closed_terms
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.plan.spectrum import Frequencies, centred, waves
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.lensless.propagation.separable import PIXEL_NODES


class TransferProbe:
    r"""H(v, u) of a camera with a zone mask at given frequencies, for any distance and wavelength.

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
        self.waves = [
            waves(f, i, n)
            for f, i, n in zip((frequencies.v, frequencies.u), indices, lengths, strict=True)
        ]

    def exact(
        self, wavelength, distance, model: str, precision: Precision, pixel_integration: bool
    ) -> Complex[np.ndarray, " k"]:
        """H with factors in that precision, transformed in double precision."""
        with allow("float64"):
            return self._transfer(
                self._double_waves,
                precision,
                wavelength,
                distance,
                model,
                pixel_integration,
                PIXEL_NODES,
            )

    @functools.cached_property
    def _double_waves(self) -> tuple[Float[Array, "n k2"], ...]:
        return tuple(jnp.asarray(w) for w in self.waves)

    @functools.cached_property
    def _single_waves(self) -> tuple[Float[Array, "n k2"], ...]:
        return tuple(jnp.asarray(w, jnp.float32) for w in self.waves)

    def quick(
        self, wavelength, distance, model: str, pixel_integration: bool, nodes: int
    ) -> Complex[np.ndarray, " k"]:
        """H in single precision, with a chosen number of nodes a pixel, for many PSFs."""
        return self._transfer(
            self._single_waves,
            "float32",
            wavelength,
            distance,
            model,
            pixel_integration,
            nodes,
        )

    def _transfer(
        self, waves_of, precision, wavelength, distance, model, pixel_integration, nodes
    ) -> Complex[np.ndarray, " k"]:
        path = self.camera.path(float(wavelength), float(distance))
        mask, pitch, path = cast((self.camera.mask, self.camera.sensor.pitch, path), precision)
        points = Points(self.places[0], self.places[1], pitch)
        transfer = _transfer(mask, points, path, *waves_of, model, pixel_integration, nodes)
        return np.asarray(transfer, complex)


@jax.jit(static_argnames=("model", "pixel_integration", "nodes"))
def _transfer(
    mask: AbstractMask,
    points: Points,
    path: Path,
    down: Float[Array, "m k2"],
    across: Float[Array, "n k2"],
    model: str,
    pixel_integration: bool,
    nodes: int,
) -> Complex[Array, " k"]:
    terms = closed_terms(mask, points, path, model, pixel_integration, nodes)
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
