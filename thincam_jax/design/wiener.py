r"""The error of the Wiener synthesis of training images, differentiated through it.

`thincam_jax.reconstruct.WienerSynthesis` as a smooth function of every number of a design, the
distances too: captures are not enlarged to one scale; their spectra are taken where the scene's
angular frequencies ν fall on each sensor, at ν/d,

.. math:: G_c(\nu) = p^2 \sum_x g_c(x)\, e^{-2\pi j\nu x/d}, \qquad
    \hat F = \frac{\sum_c H_c\, d_c^2\, G_c/\eta_c}{\sum_c H_c^2\, d_c^4/\eta_c + 1/\eta_f}

with H_c in closed form at ν/d (`thincam_jax.propagation.separable_transfer`), the noise's η_c, and
η_f ∝ 1/(ν² + ν₀²) of a strength that is found from the captures' own power. As there, the filter
takes captures as if nothing had been cropped, and what that costs is in the error.

It is not the same to the last digit: `WienerSynthesis` interpolates shorter captures and counts
the noise of each by its samples after that, estimates the mean, and finds the strength per sample.
At one distance the errors agree within some tenths of a dB, at two within one; where designs rank
near to each other, the full simulation decides.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._phase import as_complex, phasor
from thincam_jax._precision import product
from thincam_jax.design.design import Design
from thincam_jax.design.prior import PowerLaw
from thincam_jax.design.training import Training, check_captures, noise_variance, relative_error
from thincam_jax.propagation.path import Path
from thincam_jax.propagation.separable_transfer import transfer_factors
from thincam_jax.reconstruct.spectra import crop_noise, inner_band, scene_power
from thincam_jax.reconstruct.synthesis import keep_bias


def wiener_error(design: Design, training: Training) -> Float[Array, ""]:
    """Squared error of the Wiener synthesis, as a part of the images' variance, averaged.

    The PSNR in dB is −10·log₁₀ of this, up to a constant of the images.
    """
    return relative_error(restore_by_wiener(design, training), training)


def restore_by_wiener(design: Design, training: Training) -> Float[Array, "image v u"]:
    """The images as the Wiener synthesis restores them from their noisy captures.

    Their mean is taken as known. Of the setup's prior nothing is used.
    """
    check_captures(design, training)
    at = _frequencies(training)
    channels = tuple(_channel(design, training, row, at) for row in training.synthesis)
    # The mean's part in each capture: the prior concerns the contrast only.
    even = _scene_spectrum(jnp.ones_like(training.images[0]), training, at)
    means = [[_captured(even, h, c, at) for h in c.each] for c in channels]
    responses = jnp.stack([c.summed for c in channels])

    def one(given):
        image, noise = given
        contrast = _scene_spectrum(image - 1, training, at)
        spectra, noises = [], []
        for channel, mean, drawn in zip(channels, means, noise, strict=True):
            parts = [_captured(contrast, h, channel, at) for h in channel.each]
            whole = [m + p for m, p in zip(mean, parts, strict=True)]
            variance = noise_variance(
                whole, channel.weights, channel.exposure, training.setup, training.sensor.pitch
            )
            summed = sum(w * p for w, p in zip(channel.weights, parts, strict=True))
            spectra.append(
                _spectrum(summed + jnp.sqrt(variance) * drawn, channel, training.sensor.pitch)
            )
            noises.append(variance * training.sensor.pitch**4 * drawn.size)
        scene = _filtered(responses, jnp.stack(spectra), jnp.stack(noises), training, at)
        return _image(scene, image.shape[-1], training, at) + 1

    # One after the other: an image's spectra are larger than itself.
    return jax.lax.map(one, (training.images, training.noise))


class _Frequencies(NamedTuple):
    """Of a real transform on the window, cycles/rad."""

    v: Float[Array, " v"]
    u: Float[Array, " u"]


def _frequencies(training: Training) -> _Frequencies:
    window, dtype = training.window, training.images.dtype
    step = window.angle / window.samples
    made = (f(window.samples, step) for f in (np.fft.fftfreq, np.fft.rfftfreq))
    return _Frequencies(*(jnp.asarray(f, dtype) for f in made))


class _Channel(NamedTuple):
    """A sum of captures at one distance.

    - `each`: H, mm², of its captures; `summed`: H d², mm⁴, of their sum.
    - `rows`, `columns`: e^{2πjνx/d} of each pixel and frequency.
    - `weights`, `exposure`: of its captures.
    """

    each: tuple[Float[Array, "v u"], ...]
    summed: Float[Array, "v u"]
    rows: Complex[Array, "y v"]
    columns: Complex[Array, "x u"]
    weights: tuple[float, ...]
    exposure: tuple[Float[Array, ""], ...]


def _channel(
    design: Design, training: Training, row: tuple[float, ...], at: _Frequencies
) -> _Channel:
    setup, sensor = training.setup, training.sensor
    pitch = sensor.pitch if setup.pixel_integration else None
    used = [int(k) for k in np.flatnonzero(row)]
    distance = design.distance[used[0]]

    def response(k):
        path = Path(design.wavelength[k], distance, setup.object_distance)
        mask = design.mask(design.beta[k], design.phase[k])
        v, u = (f / distance for f in at)
        return transfer_factors(mask, path, v, u, pixel_pitch=pitch).response()

    each = tuple(response(k) for k in used)
    weights = tuple(row[k] for k in used)
    summed = sum(w * h for w, h in zip(weights, each, strict=True)) * distance**2
    places = (sensor.grid.y, sensor.grid.x)
    rows, columns = (
        phasor(2 * jnp.pi * x[:, None] * (f / distance)) for f, x in zip(at, places, strict=True)
    )
    return _Channel(each, summed, rows, columns, weights, tuple(design.exposure[k] for k in used))


def _scene_spectrum(image, training: Training, at: _Frequencies) -> Complex[Array, "v u"]:
    """F, rad², of an image of uniform square pixels."""
    rows, columns = _image_waves(image.shape[-1], training, at)
    pixel = training.setup.field / image.shape[-1]
    soft = jnp.sinc(pixel * at.v)[:, None] * jnp.sinc(pixel * at.u) * pixel**2
    whole = product(product(rows.conj().T, as_complex(image)), columns.conj())
    return whole * as_complex(soft)


def _captured(scene, response, channel: _Channel, at: _Frequencies) -> Float[Array, "y x"]:
    """A capture without noise, mm² times the scene's unit."""
    return _series(scene * as_complex(response), channel.rows, channel.columns, at)


def _spectrum(capture, channel: _Channel, pitch) -> Complex[Array, "v u"]:
    """G_c, mm² times the capture's unit."""
    across = product(as_complex(capture), channel.columns.conj())
    return product(channel.rows.conj().T, across) * as_complex(pitch**2)


def _filtered(responses, spectra, noises, training: Training, at: _Frequencies):
    """F̂, rad²."""
    window = training.window
    shape = PowerLaw(2.0)(at.v[:, None] ** 2 + at.u**2, training.setup.field)
    density = noises[:, None, None]
    power = jnp.abs(spectra) ** 2
    padded, sensor = (window.samples,) * 2, (window.across,) * 2
    expected = responses**2 * shape
    scene = shape * scene_power(power - density, expected, inner_band(padded, sensor))
    biased = keep_bias(np.asarray(training.synthesis))
    if biased.any():
        steps = crop_noise(power, padded, sensor)
        density = density + jnp.where(biased[:, None, None], steps, 0.0)
    gain = jnp.sum(responses**2 / density, axis=0) + 1 / scene
    return jnp.sum(as_complex(responses / density) * spectra, axis=0) / as_complex(gain)


def _image(scene, count: int, training: Training, at: _Frequencies) -> Float[Array, "v u"]:
    """The scene at the middles of its pixels."""
    rows, columns = _image_waves(count, training, at)
    return _series(scene, rows, columns, at)


def _image_waves(count: int, training: Training, at: _Frequencies):
    """e^{2πjνθ} at the middles θ of the pixels: (pixel, frequency), along either axis."""
    places = (jnp.arange(count, dtype=at.v.dtype) - (count - 1) / 2) * training.setup.field / count
    return tuple(phasor(2 * jnp.pi * places[:, None] * f) for f in at)


def _series(spectrum, rows, columns, at: _Frequencies) -> Float[Array, "y x"]:
    """The real sum over the window's frequencies at the places of `rows` and `columns`."""
    # Half of a real image's spectrum is here; what is not makes this count twice, but at both ends.
    twice = np.full(len(at.u), 2.0)
    twice[[0, -1]] = 1.0
    step = at.u[1] - at.u[0]
    weights = as_complex(jnp.asarray(twice, step.dtype) * step**2)
    return product(product(rows, spectrum * weights), columns.T).real
