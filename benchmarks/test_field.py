"""The price of the field: PSFs off the axis, and the operator over it, beside their rivals.

- A PSF of 1024² pixels along an axis of the field, and off both, over that on the axis.
- The operator of 512² pixels of a field of ±20° within 1e-2, over one convolution, and the rival
  that needs no theory: 9 × 9 patches of the field, each convolved with its own PSF.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.lensless.forward import imaging_operator
from thincam_jax.units import deg, nm

TURNS = 12


def least(function, *given):
    """Seconds, the least of a few, compiled before."""
    jax.block_until_ready(function(*given))
    taken = []
    for _ in range(TURNS):
        start = time.perf_counter()
        jax.block_until_ready(function(*given))
        taken.append(time.perf_counter() - start)
    return min(taken)


def camera(count):
    mask = tc.FresnelZoneAperture(25.0, width=5.632)
    return tc.LenslessCamera(mask, tc.Sensor((count, count), 5.632 / count), 6.5)


def test_psf_off_the_axis(benchmark):
    """At 20°, of the pixels' centres and of their averages."""
    own = camera(1024)
    for average in (False, True):

        def psf(at, average=average):
            model = tc.PsfMethod("separable", "float32", average)
            return tc.psf(own, wavelength=500 * nm, at=at, model=model)

        tangent = np.tan(20 * deg)
        places = [None, (0.0, tangent), tuple(tangent * np.sqrt([0.5, 0.5]))]
        axis, along, skew = (least(psf, at) for at in places)
        ratios = along / axis, skew / axis
        name = "averaged" if average else "centres"
        benchmark.extra_info[name] = [round(r, 1) for r in ratios]
        print(name, benchmark.extra_info[name])
        assert ratios[0] < 3 and ratios[1] < 10
    benchmark.pedantic(lambda: None)


@pytest.mark.parametrize("way", ["forward", "adjoint"])
def test_operator_over_the_field(benchmark, way):
    own, shape = camera(512), (426, 426)
    fit = tc.field_operator(own, 500 * nm, object_distance=250.0, field_shape=shape)
    one = imaging_operator(own, 500 * nm, 250.0, field_shape=shape)
    pieces = jnp.zeros((81, *shape), jnp.float32)
    kernels = jnp.ones((81, 937, 937), jnp.float32)
    patches = CropConvolution(kernels, own.sensor.pitch, (512, 512), shape, summed=1)
    image = np.random.default_rng(0).uniform(size=shape).astype(np.float32)
    capture = np.random.default_rng(0).uniform(size=(512, 512)).astype(np.float32)
    if way == "forward":
        operator, convolution = fit.operator, one
        given, rival = (image,), (lambda: patches(pieces))
    else:
        operator, convolution = fit.operator.adjoint, one.adjoint
        given, rival = (capture,), (lambda: patches.adjoint(capture))
    single = least(jax.jit(lambda x: convolution(x)), *given)
    ratios = least(jax.jit(lambda x: operator(x)), *given) / single, least(rival) / single
    benchmark.extra_info["operator, patches"] = [round(r, 1) for r in ratios]
    print(way, fit.operator.weights.shape[0], benchmark.extra_info["operator, patches"])
    assert ratios[0] < 8
    benchmark.pedantic(lambda: None)
