"""Every model at its extremes: finite, as exact as stated, differentiable, compiled once."""

import dataclasses
import functools
import math

import equinox as eqx
import extremes
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from extremes import CHOICES, EXTREMES, GRADIENTS, LOST, PARAMETERS, Extreme, find
from lensless.propagation.reference import chirp_by_quadrature

import thincam_jax as tc
from helpers import AS_IN_USE, ROOT, count_traces, finite_difference, quick, relative_l2

DTYPES = (np.float32, np.float64)
STATIC = ("shape", "model", "pixel_integration")


@count_traces
def loss_and_psf(camera, pitch, centre, weights, shape, model, pixel_integration):
    """A weighted sum of the PSF, whose gradient sees every pixel, and the PSF."""
    mask = tc.FresnelZoneAperture(
        camera["beta"], camera["phase"], width=camera["width"], centre=centre
    )
    lensless = tc.LenslessCamera(mask, tc.Sensor(shape, pitch), camera["distance"])
    h = tc.psf(
        lensless,
        wavelength=camera["wavelength"],
        object_distance=camera["object_distance"],
        model=model,
        pixel_integration=pixel_integration,
    )
    return jnp.sum(weights * h), h


# Single precision is compiled as users have it: there the order of operations shows.
gradient = jax.value_and_grad(loss_and_psf, has_aux=True)
compiled = {
    np.float32: jax.jit(gradient, static_argnames=STATIC, compiler_options=AS_IN_USE),
    np.float64: jax.jit(gradient, static_argnames=STATIC),
}


def loss_weights(extreme: Extreme, seed: int):
    """Normally distributed, in numbers that both precisions hold."""
    return np.random.default_rng(seed).standard_normal(extreme.shape, np.float32)


def evaluate(extreme: Extreme, dtype, camera, seed=0):
    weights = loss_weights(extreme, seed)
    return compiled[dtype](
        {name: jnp.asarray(camera[name], dtype) for name in PARAMETERS},
        *(jnp.asarray(v, dtype) for v in (extreme.pitch, extreme.centre, weights)),
        extreme.shape,
        extreme.model,
        extreme.pixel_integration,
    )


@functools.cache
def result(extreme: Extreme, dtype):
    """The PSF and the gradient by parameter, as NumPy arrays."""
    (_, h), gradient = evaluate(extreme, dtype, extreme.numbers(dtype))
    assert h.dtype == dtype
    return np.asarray(h), {name: float(gradient[name]) for name in PARAMETERS}


@functools.cache
def expected(extreme: Extreme, dtype):
    return extremes.reference(extreme, dtype)


def error(extreme: Extreme, dtype) -> float:
    """Relative L2 of the PSF at the numbers that `dtype` holds."""
    h, _ = result(extreme, dtype)
    return relative_l2(h[:: extreme.every].astype(float), expected(extreme, dtype))


def turning(extreme: Extreme) -> tuple[float, float]:
    """The largest phase, rad, and its slope in β, mm²: they set the steps of the differences."""
    scale = 1 + extreme.distance / extreme.object_distance
    reach = max(extreme.shape) * extreme.pitch / 2 + scale * max(map(abs, extreme.centre))
    if extreme.model == "separable":
        area = extreme.width**2 / 2
        b, s = (
            math.pi / (extreme.wavelength * z) for z in (extreme.distance, extreme.object_distance)
        )
        return b * (reach + extreme.width / 2) ** 2 + (extreme.beta + s) * area, area
    area = 2 * (reach / scale) ** 2
    if extreme.model == "closed_form":
        area /= min(1.0, abs(1 - extreme.epsilon)) ** 2
    return 2 * extreme.beta * area, 2 * area


def radian(extreme: Extreme, name: str) -> float:
    """The change of a parameter that turns the fastest phase by one."""
    phase, area = turning(extreme)
    return {"phase": 1.0, "beta": 1 / area}.get(name, getattr(extreme, name) / max(phase, 1.0))


def difference(extreme: Extreme, name: str) -> tuple[float, float]:
    """The loss's derivative by differences with steps of 0.015 rad, and its rounding error."""
    camera = extreme.numbers(np.float64)
    phase, _ = turning(extreme)
    step = 0.015 * radian(extreme, name) / 2
    slope = finite_difference(
        lambda value: evaluate(extreme, np.float64, {**camera, name: value})[0][0],
        jnp.asarray(camera[name]),
        jnp.asarray(step),
        1.0,
    )
    # What an evaluation is uncertain by: its phases' rounding, or more where the value shows more.
    turned = max(1.0, phase, abs(extreme.phase) if name == "phase" else 0.0)
    rounding = 8 * max(np.finfo(float).eps * turned, min(error(extreme, np.float64), 1e-11))
    spread = np.linalg.norm(result(extreme, np.float64)[0])
    return float(slope) / step, rounding * float(spread) / step


# Near and far, in focus, the finest zones and shadows larger than their mask: one program serves
# these, in either precision. A pixel average of the shadow's edge is a program of its own.
QUICK = ("focus", "d = 1 µm", "t = 0.1 mm", "t = ∞", "β = 1e6")
SINGLE = ("geometric: β at Nyquist, pixel average",)


def is_quick(extreme: Extreme, dtype) -> bool:
    """Whether it is among those that every run looks at."""
    return extreme.name in (QUICK if dtype is np.float64 else SINGLE)


def case(extreme: Extreme, dtype: type = np.float64):
    """A parameter of a test; thorough if its program takes long."""
    marks = [] if is_quick(extreme, dtype) else [pytest.mark.thorough]
    return pytest.param(extreme, dtype, id=f"{extreme.name}-{dtype.__name__}", marks=marks)


choices = pytest.mark.parametrize("name", quick(CHOICES, 1))


@pytest.mark.parametrize(("extreme", "dtype"), [case(e, d) for e in EXTREMES for d in DTYPES])
def test_value(extreme, dtype):
    """Finite, its gradient too, and within the stated error of 40 digits at the same numbers."""
    value, gradient = result(extreme, dtype)
    assert np.isfinite(value).all()
    assert error(extreme, dtype) < getattr(extreme, dtype.__name__)
    assert [name for name in PARAMETERS if not math.isfinite(gradient[name])] == []


@pytest.mark.parametrize(("extreme", "dtype"), [case(e) for e in EXTREMES if e.differences])
def test_gradient_against_differences(extreme, dtype):
    """Within 1e-6 and the differences' own rounding, which must leave digits to two parameters.

    At t = ∞ there is nothing beyond: the derivative with respect to t is zero.
    """
    _, gradient = result(extreme, dtype)
    telling = 0
    for name in PARAMETERS:
        if name == "object_distance" and math.isinf(extreme.object_distance):
            assert gradient[name] == 0
            continue
        slope, noise = difference(extreme, name)
        assert abs(gradient[name] - slope) <= 1e-6 * abs(slope) + noise, name
        telling += noise < 0.01 * abs(slope)
    assert telling >= 2


@pytest.mark.parametrize(
    ("name", "parameters", "tolerance"),
    [
        pytest.param(
            *("d = 1 nm", ("beta", "phase", "width", "distance", "wavelength"), 4e-5),
            marks=pytest.mark.thorough,
        ),
        ("β = 1e6", PARAMETERS, 1e-6),
        pytest.param(
            *("closed_form: ε = 0.999", ("beta", "phase", "distance", "wavelength"), 1e-7),
            marks=pytest.mark.thorough,
        ),
    ],
)
def test_gradient_against_the_reference(name, parameters, tolerance):
    """Where double precision leaves no digits to differences, those of the reference do.

    Over eight losses; measured 1.4e-5, 3.4e-7 and 2.3e-8, the second of them the differences'
    own. With respect to t at d = 1 nm, 1e-8 of the PSF a mm, not even the reference has digits.
    """
    extreme = find(name)
    assert not extreme.differences
    found = gradients(extreme, np.float64, 8)
    weights = [w.astype(float) for w in losses(extreme, 8)]
    for parameter in parameters:
        step, value = 0.015 * radian(extreme, parameter), getattr(extreme, parameter)

        def at(number, parameter=parameter):
            moved = dataclasses.replace(extreme, **{parameter: number})
            return extremes.reference(moved, np.float64)

        def central(h, value=value, at=at):
            return (at(value + h) - at(value - h)) / ((value + h) - (value - h))

        slope = (4 * central(step / 2) - central(step)) / 3
        exact = np.array([np.sum(w * slope) for w in weights])
        assert relative_l2(found[:, PARAMETERS.index(parameter)], exact) < tolerance, parameter


def losses(extreme: Extreme, count: int):
    return [loss_weights(extreme, seed) for seed in range(count)]


def gradients(extreme: Extreme, dtype, count: int):
    """Of `count` losses by `PARAMETERS`."""
    camera = extreme.numbers(np.float64)
    found = [evaluate(extreme, dtype, camera, seed)[1] for seed in range(count)]
    return np.array([[float(gradient[name]) for name in PARAMETERS] for gradient in found])


LOSSES = 32


@functools.cache
def single(name: str) -> Extreme:
    """An extreme at the numbers that float32 holds."""
    extreme = find(name)
    centre = extreme.offset(np.float32)
    return dataclasses.replace(extreme, centre=centre, **extreme.numbers(np.float32))


@functools.cache
def gradient_errors(name: str) -> tuple[float | None, ...]:
    """Relative L2 of the float32 gradient against float64, over the losses; None is 0 and 0."""
    value, exact = (gradients(single(name), dtype, LOSSES) for dtype in DTYPES)
    return tuple(
        relative_l2(v, e) if v.any() or e.any() else None
        for v, e in zip(value.T, exact.T, strict=True)
    )


@functools.partial(jax.jit, compiler_options=AS_IN_USE)
def residue(factor, rounded):
    return factor * factor - rounded


def has_fused_multiply_add() -> bool:
    """Whether a product is rounded only after something is added to it."""
    factor = np.float32(1 + 2**-12)
    return bool(residue(factor, factor * factor))


@pytest.mark.thorough
@pytest.mark.parametrize(("extreme", "dtype"), [case(find(name)) for name in GRADIENTS])
def test_gradient_in_single_precision(extreme, dtype):
    """Within the stated bounds; where they say that it is lost, it is.

    Without fused multiply-adds ab − ba is zero, with them it is the rounding of a product, which is
    more than these gradients: one may be lost on the one processor and not on the other.
    """
    fused = has_fused_multiply_add()
    name = extreme.name
    for parameter, error, bound in zip(
        PARAMETERS, gradient_errors(name), GRADIENTS[name], strict=True
    ):
        assert (error is None) == (bound is None), parameter
        if error is not None and bound is not None:
            assert error < bound, parameter
            assert bound < LOST or error > LOST / 4 or not fused, parameter


@functools.partial(jax.jit, static_argnames=STATIC)
@jax.grad
def slope_in_double(camera, pitch, centre, weights, shape, model, pixel_integration):
    mask = tc.FresnelZoneAperture(
        camera["beta"], camera["phase"], width=camera["width"], centre=centre
    )
    h = tc.psf(
        tc.LenslessCamera(mask, tc.Sensor(shape, pitch), camera["distance"]),
        wavelength=camera["wavelength"],
        object_distance=camera["object_distance"],
        model=tc.PsfMethod(model, "float64", pixel_integration),
        pixel_integration=False,
    )
    return jnp.sum(weights * h)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name", ["d = 0.1 mm", "d = 1 µm", "t = 0.1 mm", "100 mm mask", "closed_form: ε = 0.999"]
)
def test_double_precision_of_a_single_camera(name):
    """`precision="float64"` gives the gradient that float32 loses; the numbers stay float32."""
    extreme = single(name)
    (weights,) = losses(extreme, 1)
    found = slope_in_double(
        {p: jnp.asarray(getattr(extreme, p), jnp.float32) for p in PARAMETERS},
        *(jnp.asarray(v, jnp.float32) for v in (extreme.pitch, extreme.centre, weights)),
        extreme.shape,
        extreme.model,
        extreme.pixel_integration,
    )
    exact = evaluate(extreme, np.float64, extreme.numbers(np.float64))[1]
    for parameter in PARAMETERS:
        assert found[parameter].dtype == jnp.float32
        # Cotangents are rounded to float32 on their way in, one by one.
        np.testing.assert_allclose(found[parameter], exact[parameter], rtol=2e-6)


def fringe_error(extreme: Extreme, dtype) -> float | None:
    """Relative L2 of the PSF without its mean; None where it is constant."""
    value = result(extreme, dtype)[0][:: extreme.every].astype(float)
    exact = expected(extreme, dtype)
    fringes = exact - exact.mean()
    if np.linalg.norm(fringes) < 1e-6 * np.linalg.norm(exact):
        return None
    return relative_l2(value - value.mean(), fringes)


@pytest.mark.thorough
def test_fringes_in_single_precision():
    """No mean hides a loss but in one row; 4.0e-3 is the largest of the others."""
    errors = {e.name: fringe_error(e, np.float32) for e in EXTREMES}
    lost = errors.pop("closed_form: ε = 0.999")
    assert lost is not None and lost > 1
    assert max(v for v in errors.values() if v is not None) < 1e-2
    assert [name for name, v in errors.items() if v is None] == [
        "1×1 sensor",
        "geometric: β = 1e-6, pixel average",
    ]
    near_focus = find("closed_form: ε = 0.999")
    exact = expected(near_focus, np.float64)
    assert np.std(exact) < 4e-3 * np.mean(exact)
    double = fringe_error(near_focus, np.float64)
    exact_model = fringe_error(dataclasses.replace(near_focus, model="separable"), np.float32)
    assert double is not None and double < 1e-7
    assert exact_model is not None and exact_model < 1.5e-5


IN_SINGLE = tc.PsfMethod("separable", "float32")


def choice_of(name: str):
    """The camera and the conditions that `choose_model` takes."""
    extreme = find(name)
    mask = tc.FresnelZoneAperture(
        extreme.beta, extreme.phase, width=extreme.width, centre=extreme.centre
    )
    # Wider pixels than a sensor's spread the grid over the shadow.
    sensor = eqx.tree_at(
        lambda s: s.pitch, tc.Sensor(extreme.shape, 0.1), jnp.asarray(extreme.pitch)
    )
    camera = tc.LenslessCamera(mask, sensor, extreme.distance)
    return camera, {
        "wavelength": extreme.wavelength,
        "object_distance": extreme.object_distance,
        "pixel_integration": extreme.pixel_integration,
    }


def error_in_single(name: str) -> float:
    """Against the reference at the numbers in double precision: their rounding counts."""
    extreme = find(name)
    camera, conditions = choice_of(name)
    h = tc.psf(camera, model=IN_SINGLE, **conditions)
    return relative_l2(h[:: extreme.every], expected(extreme, np.float64))


@pytest.mark.thorough
@choices
def test_predicted_error(name):
    """Above the true error of float32 and below ten times that; measured 1.25 to 1.4 times."""
    camera, conditions = choice_of(name)
    predicted = tc.predict_error(camera, model=IN_SINGLE, **conditions)
    true = error_in_single(name)
    assert true < predicted.predicted_error < 10 * true


def test_every_extreme_is_one_program():
    """One trace for each shape, model and precision: new numbers never compile again."""
    both = [(e, dtype) for e in EXTREMES for dtype in DTYPES if is_quick(e, dtype)]
    for extreme, dtype in both:
        result(extreme, dtype)
    programs = {(e.shape, e.model, e.pixel_integration, dtype) for e, dtype in both}
    before = loss_and_psf.traces
    assert before >= len(programs)
    for extreme, dtype in both:
        evaluate(extreme, dtype, extreme.numbers(dtype), seed=1)
    assert loss_and_psf.traces == before


@pytest.mark.parametrize(
    ("order", "name", "x"),
    [
        (0, "focus", 0.3),
        (-1, "focus", 0.3),  # a sinc
        (-1, "focus missed by 1e-6", 0.0),
        (1, "d = 10 m", 4.0),
        (-1, "d = 10 m", 1.0),  # a < 0
        (-1, "10 µm mask", 0.5),
        (0, "10 µm mask at 10 m", 500.0),
        (1, "λ = 12 µm", 2.6),
    ],
)
def test_reference_against_quadrature(order, name, x):
    """The reference itself, within 1e-12 of the integral's natural size; measured 4e-14."""
    extreme = find(name)
    b, s = (math.pi / (extreme.wavelength * z) for z in (extreme.distance, extreme.object_distance))
    g, half = order * extreme.beta + s, extreme.width / 2
    with mpmath.workdps(extremes.DIGITS):
        numbers = [mpmath.mpf(v) for v in (g, b, x, half)]
        value = extremes.chirp(*numbers[:2], [numbers[2]], -numbers[3], numbers[3])[0]
    exact = chirp_by_quadrature(g, b, x, -half, half)
    assert abs(value - exact) < 1e-12 * min(2 * half, math.sqrt(math.pi / max(abs(g + b), 1e-30)))


def documented(first: str) -> dict[str, list[str]]:
    """The rows of the table that begins with that cell, by their own first cell."""
    page = (ROOT / "docs/measured/extremes.md").read_text(encoding="utf-8")
    table = page[page.index(f"| {first} |") :].split("\n\n")[0].splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]
    assert len({len(row) for row in rows}) == 1
    return {row[0]: row for row in rows[2:]}


def test_every_extreme_is_documented():
    """The pages' tables have all of them, in this order, and nothing else."""
    assert list(documented("extreme")) == [extreme.name for extreme in EXTREMES]
    assert len({extreme.name for extreme in EXTREMES}) == len(EXTREMES)
    assert list(documented("gradient at")) == list(GRADIENTS)


def check_quoted(cell: str, bound: float, floor: float) -> None:
    """*measured < bound*, two to three times that."""
    measured, quoted = (float(part) for part in cell.split(" < "))
    assert quoted == bound
    assert 2 * measured < bound < 3 * max(measured, floor)


@pytest.mark.parametrize("extreme", EXTREMES, ids=lambda extreme: extreme.name)
def test_documented_errors(extreme):
    """Each bound stands after the measured error, two to three times that, or nine eps."""
    *_, single_cell, double_cell = documented("extreme")[extreme.name]
    for dtype, cell in zip((np.float32, np.float64), (single_cell, double_cell), strict=True):
        check_quoted(cell, getattr(extreme, dtype.__name__), 3 * np.finfo(dtype).eps)


@pytest.mark.parametrize("name", GRADIENTS)
def test_documented_gradients(name):
    """As the values; bold is what is lost, a nought what is zero."""
    _, *cells = documented("gradient at")[name]
    for cell, bound in zip(cells, GRADIENTS[name], strict=True):
        if bound is None:
            assert cell == "0"
            continue
        assert ("**" in cell) == (bound > LOST)
        check_quoted(cell.replace("**", ""), bound, 0.0)
