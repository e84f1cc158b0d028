"""A 1024×1024 PSF of the thesis' camera: `separable` against a zero-padded FFT, in one run.

Both are timed in single precision, compiled beforehand, with the inputs on the device and the
result waited for. The FFT is `angular_spectrum` at one sample a pixel on a window of 2048×2048, the
smallest on which nothing wraps round. Errors are relative L2:

- `error_separable`: from `separable` in double precision, the exact Fresnel PSF;
- `error_fine`: from `angular_spectrum` in double precision with 3×3 samples a pixel and half as
  large a window again, the best sampled PSF that an ordinary machine holds. It is 1.4 % from the
  exact Fresnel PSF: in the fringes far from the edges, where Fresnel's phases are wrong by radians.

Gradients are those of a weighted sum of the PSF with respect to β and d. Any such gradient is an
inner product with the images ∂h/∂β and ∂h/∂d, so the errors are of these: the sum itself may be as
ill-conditioned as its weights please. ∂h/∂d is mostly the fringes of the edges' steepest waves,
whose phase of 7e3 rad single precision knows to 1e-3; the sampled model does not hold them at all.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.propagation.angular_spectrum import angular_spectrum
from thincam_jax.lensless.propagation.separable import separable

SHAPE, PITCH = (1024, 1024), 5.5e-3
THESIS = {"beta": 25.0, "distance": 6.5, "wavelength": 500e-6, "object_distance": 250.0}
RESULTS: dict[str, dict[str, float]] = {}


def psf(model, beta, distance, wavelength, object_distance, oversampling=1, padding=1.0):
    dtype = beta.dtype
    mask = tc.FresnelZoneAperture(
        beta,
        jnp.zeros((), dtype),
        width=jnp.asarray(5.632, dtype),
        centre=jnp.zeros(2, dtype),
        fill_factor=jnp.ones((), dtype),
    )
    grid = tc.Grid(SHAPE, jnp.asarray(PITCH, dtype))
    path = LightPath(wavelength, distance, object_distance)
    if model == "separable":
        return separable(mask, grid, path, pixel_integration=False).image()
    method = tc.PsfMethod(model, None, False, oversampling, SHAPE)
    return angular_spectrum(mask, grid, path, method, padding=padding)


def slopes(model, weight, beta, distance, wavelength, object_distance):
    """d/dβ and d/dd of Σ weight·h."""

    def total(beta, distance):
        return jnp.sum(weight * psf(model, beta, distance, wavelength, object_distance))

    return jnp.stack(jax.grad(total, argnums=(0, 1))(beta, distance))


def image_slope(model, name, p):
    """∂h/∂name, an image, by forward differentiation."""

    def along(p):
        moved = (jnp.ones_like(p[name]),)
        return jax.jvp(lambda v: psf(model, **(p | {name: v})), (p[name],), moved)[1]

    return np.asarray(jax.jit(along)(p))


def parameters(dtype):
    return {name: jnp.asarray(value, dtype) for name, value in THESIS.items()}


@pytest.fixture(scope="module")
def weight():
    """Smooth, as a loss's sensitivity is, of some twenty cycles over the sensor."""
    y, x = (np.linspace(-1, 1, n) for n in SHAPE)
    return jnp.asarray(np.cos(60 * y)[:, None] * np.cos(40 * x + 0.3), jnp.float32)


@pytest.fixture(scope="module")
def references():
    p = parameters(jnp.float64)
    found = {
        **{f"gradient {k}": image_slope("separable", k, p) for k in ("beta", "distance")},
        "value": np.asarray(jax.jit(lambda p: psf("separable", **p))(p)),
    }
    # 9216×9216 complex samples at 16 bytes: 1.3 GiB, and a few of them at once.
    fine = jax.jit(lambda p: psf("angular_spectrum", **p, oversampling=3, padding=1.5))
    found["fine"] = np.asarray(fine(p))
    return found


def relative_l2(value, reference):
    return float(np.linalg.norm(np.asarray(value) - reference) / np.linalg.norm(reference))


def measure(benchmark, function, rounds):
    """Compile apart, warm up, and time until the result is there."""
    p = parameters(jnp.float32)
    start = time.perf_counter()
    compiled = jax.jit(function).lower(p).compile()
    benchmark.extra_info["compile_s"] = round(time.perf_counter() - start, 2)
    value = jax.block_until_ready(compiled(p))
    assert value.dtype == jnp.float32
    benchmark.pedantic(
        lambda: jax.block_until_ready(compiled(p)), rounds=rounds, warmup_rounds=3, iterations=1
    )
    return value


ROUNDS = {"separable": 100, "angular_spectrum": 15}


@pytest.mark.parametrize("model", ROUNDS)
@pytest.mark.benchmark(group="value")
def test_value(benchmark, references, model):
    value = measure(benchmark, lambda p: psf(model, **p), ROUNDS[model])
    errors = {
        "error_separable": relative_l2(value, references["value"]),
        "error_fine": relative_l2(value, references["fine"]),
    }
    record(benchmark, f"value {model}", errors)


@pytest.mark.parametrize("model", ROUNDS)
@pytest.mark.benchmark(group="gradient")
def test_gradient(benchmark, references, weight, model):
    measure(benchmark, lambda p: slopes(model, weight, **p), ROUNDS[model])
    single = parameters(jnp.float32)
    errors = {
        f"error_{k}": relative_l2(image_slope(model, k, single), references[f"gradient {k}"])
        for k in ("beta", "distance")
    }
    record(benchmark, f"gradient {model}", errors)


def record(benchmark, name, errors):
    benchmark.extra_info.update(errors)
    RESULTS[name] = {
        "ms": benchmark.stats.stats.median * 1e3,
        "compile": benchmark.extra_info["compile_s"],
        **errors,
    }


def test_zz_ratios(references, capsys):
    """How much faster and how much closer: printed."""
    if len(RESULTS) < 4:
        pytest.skip("needs the four benchmarks before it")
    with capsys.disabled():
        print(f"\n\n{'1024×1024':<26}{'median ms':>10}{'compile s':>11}  relative L2 errors")
        for name, row in RESULTS.items():
            errors = ", ".join(f"{k[6:]} {v:.1e}" for k, v in row.items() if k.startswith("error"))
            print(f"{name:<26}{row['ms']:10.2f}{row['compile']:11.2f}  {errors}")
        for what, *kinds in (
            ("value", "error_separable"),
            ("gradient", "error_beta", "error_distance"),
        ):
            fast, slow = RESULTS[f"{what} separable"], RESULTS[f"{what} angular_spectrum"]
            closer = " and ".join(f"{slow[k] / fast[k]:.0f} ({k[6:]})" for k in kinds)
            print(
                f"{what}: separable is {slow['ms'] / fast['ms']:.0f} times faster, {closer} closer"
            )
        apart = relative_l2(references["fine"], references["value"])
        print(f"the fine sampled reference is {apart:.1e} from separable\n")


# 256×256 pixels of an ordinary camera: what a pixel average costs over point samples, four
# distances under vmap over one, a loss's gradient over its value, and one slope by forward
# differentiation over a PSF. The fastest of many, in one run.
_ORDINARY = {"beta": 25.0, "width": 1.408}


def _of_distances(pixel_integration):
    mask = tc.FresnelZoneAperture(**_ORDINARY)
    camera = tc.LenslessCamera(mask, tc.Sensor((256, 256), PITCH), THESIS["distance"])
    camera = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), camera)

    def one(object_distance):
        return tc.psf(
            camera,
            wavelength=THESIS["wavelength"],
            object_distance=object_distance,
            pixel_integration=pixel_integration,
        )

    return one


def _fastest(function, argument, rounds=60):
    compiled = jax.jit(function)
    times = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        jax.block_until_ready(compiled(argument))
        times.append(time.perf_counter() - start)
    return 1e3 * min(times[1:])


@pytest.mark.benchmark(group="pixel average")
def test_pixel_average(benchmark, capsys):
    benchmark.pedantic(lambda: None)
    near, four = jnp.float32(250.0), jnp.asarray([150.0, 200.0, 250.0, 300.0], jnp.float32)
    rows = {}
    for name, average in (("points", False), ("pixel averages", True)):
        one = _of_distances(average)

        def loss(t, one=one):
            return jnp.sum(one(t) ** 2)

        def slope(t, one=one):
            return jax.jvp(one, (t,), (jnp.ones_like(t),))[1]

        rows[name] = [_fastest(one, near), _fastest(jax.vmap(one), four)]
        rows[name] += [_fastest(f, near) for f in (slope, loss, jax.grad(loss))]
    benchmark.extra_info.update(rows)
    with capsys.disabled():
        print(f"\n\n{'256×256':<16}{'ms':>8}{'vmap of 4':>11}{'one slope':>11}{'gradient':>11}")
        for name, (one, some, slope, loss, gradient) in rows.items():
            ratios = some / one / 4, slope / one, gradient / loss
            print(f"{name:<16}{one:8.2f}{ratios[0]:7.2f} × 4{ratios[1]:9.2f} ×{ratios[2]:9.2f} ×")
        print(f"pixel averages cost {rows['pixel averages'][0] / rows['points'][0]:.1f} × points")
