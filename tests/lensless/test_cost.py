"""Predicted memory against what XLA allocates and against what a process really takes."""

import importlib
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import convolution_cost, kernel_shape
from thincam_jax.lensless.method import PsfMethod, psf_method
from thincam_jax.lensless.resolve import psf_cost

# The module itself: the package's attribute of that name is the function.
PSF = importlib.import_module("thincam_jax.lensless.psf")
CLOSED = ("geometric", "paraxial", "closed_form", "separable")
PITCH, WIDTH = 5.5e-3, 5.632
# From here on the prediction must be close from above too.
_LARGE = 2**20


def zones(**arguments):
    return tc.FresnelZoneAperture(25.0, 0.3, **({"width": WIDTH} | arguments))


def numbers(shape, pitch, kind=float):
    values = np.random.default_rng(0).uniform(size=shape)
    return tc.SampledMask(values.astype(kind), pitch)


def in_precision(tree, dtype):
    def convert(leaf):
        if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
            return leaf.astype(jnp.complex64 if dtype == jnp.float32 else jnp.complex128)
        return leaf.astype(dtype)

    return jax.tree.map(convert, tree)


def allocated(compiled):
    """Bytes of the result and of all buffers in between."""
    found = compiled.memory_analysis()
    return found.temp_size_in_bytes + found.output_size_in_bytes


def both(mask, shape, model, average, dtype, oversampling=None):
    """Measured and predicted bytes of a PSF."""
    camera = tc.LenslessCamera(mask, tc.Sensor(shape, PITCH), 6.5)
    camera, wavelength, far = in_precision((camera, jnp.asarray(5e-4), jnp.asarray(250.0)), dtype)
    path, grid = camera.path(wavelength, far), camera.sensor.grid
    method = psf_method(camera.mask, grid, PsfMethod(model, oversampling=oversampling), average)
    lowered = PSF._psf.lower(camera.mask, grid, path, method)
    return allocated(lowered.compile()), psf_cost(camera.mask, grid, method).bytes


def require_agreement(measured, predicted, line=False):
    """Of a line of pixels, whose few megabytes matter to nobody, less may be taken."""
    assert measured <= 1.5 * predicted
    if max(measured, predicted) > _LARGE and not line:
        assert predicted <= 4 * measured


def spread_over(step, **parameters):
    """All combinations of the parameters, of which a default run takes one in `step`.

    It takes those whose places in the lists add up to a multiple of `step`: every value comes with
    several of the others. A thorough run takes all. A parameter is a dictionary of its values by
    what they are called; a tuple counts as several arguments.
    """
    rows = []
    for places in itertools.product(*(enumerate(values.items()) for values in parameters.values())):
        values = [value for _, (_, value) in places]
        arguments = [a for v in values for a in (v if isinstance(v, tuple) else (v,))]
        taken = sum(place for place, _ in places) % step == 0
        marks = () if taken else pytest.mark.thorough
        rows.append(pytest.param(*arguments, marks=marks, id="-".join(n for _, (n, _) in places)))
    return rows


AVERAGE = {"points": False, "average": True}
DTYPE = {"float32": jnp.float32, "float64": jnp.float64}


@pytest.mark.parametrize(
    ("mask", "shape", "dtype", "model", "average"),
    spread_over(
        6,
        case={
            "tiny": (zones(), (7, 9), jnp.float32),
            "small": (zones(), (48, 80), jnp.float32),
            "medium": (zones(), (700, 300), jnp.float64),
            "flat": (zones(), (40, 3000), jnp.float32),
            "line": (zones(profile="binary"), (1, 5000), jnp.float64),
            "31 harmonics": (zones(profile="binary", harmonics=31), (300, 210), jnp.float32),
        },
        model={model: model for model in CLOSED},
        average=AVERAGE,
    ),
)
def test_closed_forms(mask, shape, dtype, model, average):
    """Most of the memory: chirp integrals of all nodes and orders, or the image."""
    require_agreement(*both(mask, shape, model, average, dtype), line=min(shape) == 1)


@pytest.mark.parametrize(
    ("mask", "shape", "average", "oversampling", "dtype", "model"),
    spread_over(
        5,
        case={
            "zones": (zones(width=0.5), (48, 80), False, 1),
            "display": (zones(width=0.5, pixel_pitch=0.01), (301, 200), True, 3),
            "binary": (zones(width=2.0, profile="binary"), (200, 101), False, 3),
            "numbers": (numbers((60, 90), 0.011), (48, 80), False, 1),
            "complex numbers": (numbers((300, 200), 5.5e-3, complex), (120, 500), True, 3),
            "fine numbers": (numbers((700, 1000), 2e-3), (48, 80), False, 1),
        },
        dtype=DTYPE,
        model={model: model for model in ("angular_spectrum", "rayleigh_sommerfeld")},
    ),
)
def test_sampled_models(mask, shape, average, oversampling, dtype, model):
    require_agreement(*both(mask, shape, model, average, dtype, oversampling))


@pytest.mark.parametrize(
    ("sensor", "field", "images", "dtype"),
    spread_over(
        2,
        case={
            "equal": ((48, 80), (48, 80), 1),
            "large fields": ((48, 80), (500, 601), 3),
            "large sensor": ((301, 700), (48, 80), 10),
            "both large": ((301, 700), (500, 601), 1),
        },
        dtype=DTYPE,
    ),
)
def test_convolutions(sensor, field, images, dtype):
    """The spectrum made from a given PSF, and one application or its adjoint: fields included."""
    kernel = jax.ShapeDtypeStruct(kernel_shape(sensor, field), dtype)
    stacks = [jax.ShapeDtypeStruct((images, *shape), dtype) for shape in (field, sensor)]

    def build(kernel):
        return CropConvolution(kernel, jnp.asarray(0.01, dtype), sensor, field)

    predicted = convolution_cost(sensor, field, images, jnp.dtype(dtype).itemsize).bytes
    for stack, apply in zip(stacks, (lambda c, f: c(f), lambda c, f: c.adjoint(f)), strict=True):
        whole = jax.jit(lambda kernel, f, apply=apply: apply(build(kernel), f))
        compiled = whole.lower(kernel, stack).compile()
        measured = allocated(compiled) + compiled.memory_analysis().argument_size_in_bytes
        require_agreement(measured, predicted)
