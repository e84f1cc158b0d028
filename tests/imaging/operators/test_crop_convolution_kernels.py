"""Crop-convolution with measured PSFs of any size, with planes, channels and larger windows."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
import scipy.signal
from imaging.operators.dense import numbers

from helpers import quick
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.imaging.operators.crop_convolution import kernel_shape, window_shape

PITCH = 0.05


@eqx.filter_jit
def operator(kernel, sensor, field, **more):
    return CropConvolution(kernel, PITCH, sensor, field, **more)


seen = eqx.filter_jit(lambda convolution, field: convolution(field))


@eqx.filter_jit
def seen_and_error(convolution, field, key):
    return convolution(field), adjoint_error(convolution, key)


def seen_directly(kernel, field, sensor):
    """The middle of the whole convolution, with nothing beyond it; no size but parity matters."""
    whole = PITCH**2 * scipy.signal.convolve(field, kernel, mode="full", method="direct")
    for axis, size in enumerate(sensor):
        surplus = whole.shape[axis] - size
        assert surplus % 2 == 0
        margin = [(0, 0), (0, 0)]
        margin[axis] = (max(0, -surplus // 2),) * 2
        start = max(0, surplus // 2)
        whole = np.pad(whole, margin).take(np.arange(start, start + size), axis=axis)
    return whole


# sensor, PSF, field: small measured PSFs, and ones larger than all differences
KERNELS = [
    ((5, 8), (5, 8), (9, 15)),  # the field is all that the PSF brings onto the sensor
    ((5, 8), (5, 8), (7, 11)),
    ((5, 8), (4, 8), (6, 9)),
    ((6, 9), (1, 1), (6, 9)),
    ((6, 9), (3, 2), (4, 4)),
    ((6, 7), (2, 5), (11, 3)),
    ((4, 7), (12, 4), (9, 6)),
    ((2, 3), (9, 10), (4, 2)),
    ((1, 6), (8, 9), (4, 2)),
    ((1, 1), (4, 1), (2, 5)),
]


@pytest.mark.parametrize(("sensor", "kernel", "field"), quick(KERNELS, 1, 7))
def test_a_kernel_of_another_size(sensor, kernel, field, key):
    """Smaller is zero outside, larger is cut: the sum is that of all samples it has."""
    h, f = numbers(kernel), numbers(field, 1)
    expected = seen_directly(h, f, sensor)
    convolution = operator(jnp.asarray(h), sensor, field)
    value, error = seen_and_error(convolution, jnp.asarray(f), key)
    np.testing.assert_allclose(value, expected, atol=1e-15)
    assert error < 1e-13
    larger = tuple(n + 3 for n in convolution.window)
    same = operator(jnp.asarray(h), sensor, field, window=larger)
    assert same.window == larger
    np.testing.assert_allclose(seen(same, jnp.asarray(f)), expected, atol=1e-15)


def test_a_field_that_fills_the_sensor_needs_no_margin():
    """The window of a small PSF is smaller than all differences of sensor and field."""
    sensor, kernel, field = KERNELS[0]
    h, f = numbers(kernel), numbers(field, 1)
    assert window_shape(sensor, field, kernel) == field
    assert all(np.less(field, kernel_shape(sensor, field)))
    expected = PITCH**2 * scipy.signal.convolve(f, h, mode="valid", method="direct")
    convolution = operator(jnp.asarray(h), sensor, field)
    assert convolution.window == field
    np.testing.assert_allclose(seen(convolution, jnp.asarray(f)), expected, atol=1e-15)


@pytest.mark.parametrize("sensor", range(1, 7))
def test_the_window_is_the_smallest(sensor):
    """In one sample less the far end of the field would come round onto the sensor."""
    sizes = ((f, k) for f in range(1, 7) for k in range(1 + (sensor + f) % 2, sensor + f, 2))
    for field, kernel in sizes:
        ends = np.arange(sensor + field - 1) - (field - 1)  # sample differences, r − r′
        centre = (sensor - field) / 2
        inside = abs(ends - centre) <= (kernel - 1) / 2

        def fits(window, ends=ends, inside=inside):
            aliased = np.isin(ends[~inside] % window, ends[inside] % window).any()
            return not aliased and len(set(ends[inside] % window)) == inside.sum()

        needed = max(sensor, field)
        while not fits(needed):
            needed += 1
        assert inside.sum() == kernel
        smallest = scipy.fft.next_fast_len(needed, real=True)
        assert window_shape((sensor, 1), (field, 1), (kernel, 1))[0] == smallest


def test_a_window_in_which_light_would_wrap():
    sensor, kernel, field = KERNELS[0]
    for window in ((8, 15), (9, 14)):
        with pytest.raises(ValueError, match=r"fewer than \(9, 15\) samples light wraps round"):
            CropConvolution(jnp.ones(kernel), PITCH, sensor, field, window=window)


@pytest.mark.parametrize("kernel", [(4, 8), (5, 7), (14, 22), (13, 23)])
def test_a_kernel_without_a_centre_for_sensor_and_field(kernel):
    with pytest.raises(ValueError, match=r"\(13, 22\) samples .* even number") as caught:
        operator(jnp.ones(kernel), (5, 8), (9, 15))
    assert "\n" not in str(caught.value)


# leading axes of kernel and field, how many are summed, those of the capture
PLANES = [
    ((3,), (3,), 1, ()),
    ((2, 3), (2, 3), 2, ()),  # depth and wavelength
    ((2,), (2,), 0, (2,)),  # colours
    ((2, 3), (2, 3), 1, (2,)),  # colours, each over depths
    ((1, 3), (4, 3), 1, (4,)),  # one PSF for all colours
]


@pytest.mark.parametrize(("planes", "images", "summed", "channels"), quick(PLANES, 4))
def test_planes_add_up_and_channels_stay(planes, images, summed, channels, key):
    sensor, kernel, field = (5, 8), (4, 6), (6, 11)
    h, f = numbers((*planes, *kernel)), numbers((2, *images, *field), 1)
    convolution = operator(jnp.asarray(h), sensor, field, summed=summed)
    h = np.broadcast_to(h, (*images, *kernel))
    expected = np.zeros((2, *images, *sensor))
    for index in np.ndindex(2, *images):
        expected[index] = seen_directly(h[index[1:]], f[index], sensor)
    expected = expected.sum(axis=tuple(range(-2 - summed, -2)))
    value, error = seen_and_error(convolution, jnp.asarray(f), key)
    assert value.shape == (2, *channels, *sensor)
    np.testing.assert_allclose(value, expected, atol=1e-15)
    assert error < 1e-13
    # a batch goes back image by image, each plane with its own PSF
    g = jnp.asarray(numbers((2, *channels, *sensor), 2))
    back = eqx.filter_jit(convolution.adjoint)(g)
    assert back.shape == f.shape
    np.testing.assert_allclose(np.vdot(back, f), np.vdot(g, expected), rtol=1e-12)


@pytest.mark.parametrize(("planes", "images", "summed", "channels"), quick(PLANES, 3))
def test_combine_and_spread_are_adjoint(planes, images, summed, channels):
    """⟨combine F, G⟩ = ⟨F, spread G⟩ with the complex inner product."""
    convolution = operator(jnp.asarray(numbers((*planes, 4, 6))), (5, 8), (6, 11), summed=summed)
    half = convolution.spectrum.shape[-2:]
    F = numbers((2, *images, *half), 1) + 1j * numbers((2, *images, *half), 2)
    G = numbers((2, *channels, *half), 3) + 1j * numbers((2, *channels, *half), 4)
    forward = np.vdot(eqx.filter_jit(convolution.combine)(jnp.asarray(F)), G)
    back = eqx.filter_jit(convolution.spread)(jnp.asarray(G))
    np.testing.assert_allclose(forward, np.vdot(F, back), rtol=1e-12)
    assert abs(forward.imag) > 1e-3  # the phases take part


def test_planes_or_channels_that_are_missing():
    """One image in place of three would be taken for all of them."""
    kernel = jnp.ones((2, 3, 4, 6))
    convolution = CropConvolution(kernel, PITCH, (5, 8), (6, 11), summed=1)
    for wrong in ((6, 11), (3, 6, 11), (2, 1, 6, 11), (1, 3, 6, 11), (2, 4, 6, 11), (3, 3, 6, 11)):
        with pytest.raises(ValueError, match=r"plane, plane, y, x\) = \(2, 3, 6, 11\)"):
            convolution(jnp.ones(wrong))
    for wrong in ((5, 8), (1, 5, 8), (3, 5, 8)):
        with pytest.raises(ValueError, match=r"\(…, plane, y, x\) = \(2, 5, 8\)"):
            convolution.adjoint(jnp.ones(wrong))
