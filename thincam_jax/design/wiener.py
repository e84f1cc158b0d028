r"""The error of the Wiener synthesis of training images, differentiated through it.

A response that is even in both frequencies, as that of every mask here, keeps the parity of what it
acts on. So an image is taken apart once,

.. math:: f(\pm y, \pm x) = \sum_{a,b} (\pm 1)^a (\pm 1)^b f_{ab}(y, x), \qquad a, b \in \{0, 1\}

and transformed by cosines (0) and sines (1) of the places and frequencies that are not negative:
an eighth to a quarter of the multiplications of a product with complex exponentials over all of
them, and no complex numbers. Places and frequencies may be any, so that a spectrum can be taken
where it is wanted.

`thincam_jax.reconstruction.wiener.WienerSynthesis` as a smooth function of every number of a
design, the distances too: captures are not enlarged to one scale; their spectra are taken where the
scene's angular frequencies ν fall on each sensor, at ν/d,

.. math:: G_c(\nu) = p^2 \sum_x g_c(x)\, e^{-2\pi j\nu x/d}, \qquad
    \hat F = \frac{\sum_c H_c\, d_c^2\, G_c/\eta_c}{\sum_c H_c^2\, d_c^4/\eta_c + 1/\eta_f}

with H_c in closed form at ν/d (`propagation.separable_transfer`). Spectra are densities
over the solid angle Ω_c = Np²/d_c² that a sensor's N pixels cover: η_c = E|N_c|²/Ω_c = σ_c²p²d_c²
for noise of variance σ_c², and η_f ∝ 1/(ν² + ν₀²) of a strength that is found from the captures'
own power |G_c|²/Ω_c. As there, the filter takes captures as if nothing had been cropped, and what
that costs is in the error. H_c is even, so that all of it is done in real numbers for the even and
odd parts of the images (`thincam_jax.design.wiener`).

It is not the same to the last digit: `WienerSynthesis` interpolates shorter captures, estimates the
mean, and finds the strength on its own window. In the thesis' camera the gain of one pair of
distances over another agrees within 0.3 dB (docs/measured/designs.md); on a few dozen pixels, where
few frequencies tell the strength, errors differ by up to 1.5 dB. Where designs rank near to each
other, the full simulation decides.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import centred_indices
from thincam_jax._core.precision import product
from thincam_jax.design.design import Design
from thincam_jax.design.setup import PowerLaw
from thincam_jax.design.training import Training, check_captures, noise_variance, relative_error
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.propagation.separable_transfer import transfer_factors
from thincam_jax.reconstruction.synthesis import keep_bias
from thincam_jax.reconstruction.wiener import crop_noise, inner_band, scene_power


def half_places(count: int, pitch: Number) -> Float[Array, " place"]:
    """Non-negative places among `count` centred samples, ascending, in the pitch's unit."""
    step = jnp.asarray(pitch)
    return centred_indices(count, step.dtype)[count // 2 :] * step


def fold(image: Float[Array, "y x"]) -> Float[Array, "2 2 half_y half_x"]:
    """Sums (0) and differences (1) of the samples at (±y, ±x), along each axis.

    Four times the parts above, so that a sum over these places is one over all; the middle line of
    an odd number of samples counts once.
    """
    return _fold(_fold(image, 0), 2).swapaxes(0, 1)


def unfold(parts: Float[Array, "2 2 half_y half_x"], shape: tuple[int, int]) -> Float[Array, "y x"]:
    """The image, of such a shape, with these parts."""
    return _unfold(_unfold(parts, shape[0], 2), shape[1], 2)


def waves(
    places: Float[Array, " place"], frequencies: Float[Array, " frequency"]
) -> Float[Array, "2 place frequency"]:
    """cos(2πxν) and sin(2πxν)."""
    phase = 2 * jnp.pi * places[:, None] * frequencies
    return jnp.stack([jnp.cos(phase), jnp.sin(phase)])


def transform(
    parts: Float[Array, "2 2 y x"], rows: Float[Array, "2 y v"], columns: Float[Array, "2 x u"]
) -> Float[Array, "2 2 v u"]:
    """Each part summed over the places with the waves of its parity."""
    across = product(parts, columns)
    return product(rows.swapaxes(-1, -2)[:, None], across)


def series(
    spectrum: Float[Array, "2 2 v u"], rows: Float[Array, "2 y v"], columns: Float[Array, "2 x u"]
) -> Float[Array, "2 2 y x"]:
    """Each part summed over the frequencies."""
    return transform(spectrum, rows.swapaxes(-1, -2), columns.swapaxes(-1, -2))


def both_signs(count: int) -> np.ndarray:
    """Multiplicity of each frequency 0 … N/2 in a sum over all N, an even number."""
    times = np.full(count // 2 + 1, 2.0)
    times[[0, -1]] = 1.0
    return times


def _fold(image, axis: int):
    """Even and odd part along an axis, stacked before the others."""
    count = image.shape[axis]
    half = (count + 1) // 2
    upper = jax.lax.slice_in_dim(image, count - half, count, axis=axis)
    lower = jnp.flip(jax.lax.slice_in_dim(image, 0, half, axis=axis), axis)
    once = np.ones([half if n == axis else 1 for n in range(image.ndim)])
    once.flat[0] = 0.5 if count % 2 else 1.0
    return jnp.stack([(upper + lower) * jnp.asarray(once, image.dtype), upper - lower])


def _unfold(parts, count: int, axis: int):
    """Array with these even and odd parts, given along the first axis, along `axis` of each."""
    even, odd = parts
    lower = jnp.flip(even - odd, axis - 1)
    lower = jax.lax.slice_in_dim(lower, 0, count // 2, axis=axis - 1)
    return jnp.concatenate([lower, even + odd], axis=axis - 1)


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
    count = training.images.shape[-1]
    pixel = training.setup.field / count
    # Along either axis of an image: at the middles of its pixels, and averaged over them.
    middles = waves(half_places(count, pixel), at)
    averaged = middles * jnp.sinc(pixel * at) * pixel
    # The mean's part in each capture: the prior concerns the contrast only.
    even = transform(fold(jnp.ones_like(training.images[0])), averaged, averaged)
    means = [[_captured(even, h, c, training, at) for h in c.each] for c in channels]

    def one(given):
        image, noise = given
        contrast = transform(fold(image - 1), averaged, averaged)
        spectra, variances = [], []
        for channel, mean, drawn in zip(channels, means, noise, strict=True):
            parts = [_captured(contrast, h, channel, training, at) for h in channel.each]
            whole = [m + p for m, p in zip(mean, parts, strict=True)]
            variance = noise_variance(
                whole, channel.weights, channel.exposure, training.setup, training.sensor.pitch
            )
            summed = sum(w * p for w, p in zip(channel.weights, parts, strict=True))
            noisy = summed + jnp.sqrt(variance) * drawn
            area = training.sensor.pitch**2
            spectra.append(transform(fold(noisy), channel.rows, channel.columns) * area)
            variances.append(variance)
        found = _filtered(channels, jnp.stack(spectra), jnp.stack(variances), training, at)
        return unfold(series(found * _measure(at), middles, middles), image.shape) + 1

    # One after the other: an image's spectra are larger than itself.
    return jax.lax.map(one, (training.images, training.noise))


def _frequencies(training: Training) -> Float[Array, " frequency"]:
    """Non-negative frequencies of the window, cycles/rad, the same along v and u."""
    window = training.window
    return jnp.asarray(np.fft.rfftfreq(window.samples, window.angle / window.samples), float)


class _Channel(eqx.Module):
    """A sum of captures at one distance.

    - `each`: H, mm², of its captures; `summed`: H d², mm⁴, of their sum.
    - `rows`, `columns`: cos and sin(2πxν/d) of the pixels and frequencies.
    - `distance`: mm; `weights`, `exposure`: weight and exposure of each capture.
    """

    each: tuple[Float[Array, "v u"], ...]
    summed: Float[Array, "v u"]
    rows: Float[Array, "2 y v"]
    columns: Float[Array, "2 x u"]
    distance: Float[Array, ""]
    weights: tuple[float, ...]
    exposure: tuple[Float[Array, ""], ...]


def _channel(
    design: Design, training: Training, row: tuple[float, ...], at: Float[Array, " frequency"]
) -> _Channel:
    setup, sensor = training.setup, training.sensor
    pitch = sensor.pitch if setup.pixel_integration else None
    used = [int(k) for k in np.flatnonzero(row)]
    distance = design.distance[used[0]]

    def response(k):
        path = LightPath(design.wavelength[k], distance, setup.object_distance)
        mask = design.mask(design.beta[k], design.phase[k])
        on_sensor = at / distance
        return transfer_factors(mask, path, on_sensor, on_sensor, pixel_pitch=pitch).response()

    each = tuple(response(k) for k in used)
    weights = tuple(row[k] for k in used)
    summed = sum(w * h for w, h in zip(weights, each, strict=True)) * distance**2
    rows, columns = (waves(half_places(n, sensor.pitch), at / distance) for n in sensor.shape)
    exposure = tuple(design.exposure[k] for k in used)
    return _Channel(each, summed, rows, columns, distance, weights, exposure)


def _captured(scene, response, channel: _Channel, training: Training, at) -> Float[Array, "y x"]:
    """A capture without noise, mm² times the scene's unit."""
    parts = series(scene * (response * _measure(at)), channel.rows, channel.columns)
    return unfold(parts, training.sensor.shape)


def _measure(at: Float[Array, " frequency"]) -> Float[Array, "v u"]:
    """Weight of each of the window's frequencies, of either sign, in a sum, 1/rad²."""
    along = jnp.asarray(both_signs(2 * len(at) - 2), at.dtype) * (at[1] - at[0])
    return along[:, None] * along


def _filtered(channels, spectra, variances, training: Training, at) -> Float[Array, "2 2 v u"]:
    """F̂, rad², in parts."""
    window, area = training.window, training.sensor.pitch**2
    squared = jnp.stack([c.distance**2 for c in channels])[:, None, None]
    responses = jnp.stack([c.summed for c in channels])
    shape = PowerLaw(2.0)(at[:, None] ** 2 + at**2, training.setup.field)
    density = variances[:, None, None] * area * squared
    # Summed over the parts it is the mean over the signs of the frequencies.
    power = jnp.sum(spectra**2, axis=(1, 2)) * squared / (training.noise[0, 0].size * area)
    padded, sensor = (window.samples,) * 2, (window.across,) * 2
    inner = inner_band(padded, sensor)[: len(at)]
    scene = shape * scene_power(power - density, responses**2 * shape, inner)
    biased = keep_bias(np.asarray(training.synthesis))
    if biased.any():
        half_plane = jnp.concatenate([power[:, :-1], power[:, :0:-1]], axis=1)
        steps = crop_noise(half_plane, padded, sensor)[:, : len(at)]
        density = density + jnp.where(biased[:, None, None], steps, 0.0)
    gain = jnp.sum(responses**2 / density, axis=0) + 1 / scene
    return jnp.sum((responses / density)[:, None, None] * spectra, axis=0) / gain
