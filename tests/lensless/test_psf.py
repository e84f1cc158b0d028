"""From camera to PSF and OTF: the models side by side, their gradients, and what is refused."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import count_traces, finite_difference, point_otf, point_psf, quick, value_and_slope

INF = float("inf")
WAVELENGTH = 500e-6


def camera_of(shape=(20, 27), pitch=0.03, *, beta=200.0, phase=0.3, width=0.5, distance=20.0, **m):
    mask = tc.FresnelZoneAperture(beta, phase, width=width, **m)
    return tc.LenslessCamera(mask, tc.Sensor(shape, pitch), distance)


# --- OTF ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "shape"),
    [
        ("geometric", (20, 27)),  # a sum of separable terms, as "separable" is
        pytest.param("geometric", (1, 8), marks=pytest.mark.thorough),
        pytest.param("separable", (9, 12), marks=pytest.mark.thorough),
        ("angular_spectrum", (21, 8)),
        pytest.param("angular_spectrum", (1, 1), marks=pytest.mark.thorough),
    ],
)
def test_otf_is_the_transform_of_the_psf(model, shape):
    """Σ h e^{−2πj(ux+vy)} pitch² with x, y from the centre of the grid, sizes odd and even."""
    camera = camera_of(shape, centre=(0.05, -0.08))
    h = np.asarray(point_psf(camera, wavelength=WAVELENGTH, model=model))
    y, x = ((np.arange(n) - (n - 1) / 2) * 0.03 for n in shape)
    v, u = (np.fft.fftshift(np.fft.fftfreq(n, 0.03)) for n in shape)
    expected = np.exp(-2j * np.pi * np.outer(v, y)) @ h @ np.exp(-2j * np.pi * np.outer(x, u))
    H = point_otf(camera, wavelength=WAVELENGTH, model=model)
    np.testing.assert_allclose(H, expected * 0.03**2, rtol=0, atol=1e-12)


def rho_squared(camera):
    return np.asarray(camera.sensor.grid.v)[:, None] ** 2 + np.asarray(camera.sensor.grid.u) ** 2


def otf_at(phase, *, distance=6.5, beta=25.0, model="paraxial", shape=(30, 41)):
    camera = camera_of(shape, 0.02, beta=beta, phase=phase, distance=distance)
    return np.asarray(point_otf(camera, wavelength=WAVELENGTH, model=model)), rho_squared(camera)


def test_paraxial_otf_is_eq_3_30_corrected():
    phase, beta, distance = 0.7, 25.0, 6.5
    H, rho2 = otf_at(phase)
    x = np.pi**2 * rho2 / beta
    expected = np.pi / (2 * beta) * np.cos(np.pi * WAVELENGTH * distance * rho2) * np.sin(
        x - phase
    ) + np.pi / (16 * beta) * np.sin(x / 2 - 2 * phase)
    expected[15, 20] += 3 / 8 * 30 * 41 * 0.02**2  # ⅜δ over the area of a frequency cell
    # Eq 3.30 is of first order in ε: its gains 1/(1 ± ε) and ε² in the phase are left out.
    eps = beta * WAVELENGTH * distance / np.pi
    bound = np.pi / (2 * beta) * (eps + eps**2 * x)
    assert np.all(np.abs(H - expected) <= bound + 1e-12)
    assert np.abs(H - expected)[rho2 < 200].max() < 0.06 * np.abs(H[rho2 > 0]).max()
    wrong_sign = np.pi / (2 * beta) * np.sin(x + phase) * np.cos(np.pi * WAVELENGTH * 6.5 * rho2)
    assert np.abs(H - wrong_sign).max() > 0.5 * np.pi / (2 * beta)


def test_closed_form_otf():
    """Every cosine c·cos(γr² + ψ) of the exact PSF is cπ/γ·sin(π²ρ²/γ − ψ)."""
    phase, beta = 0.7, 25.0
    H, rho2 = otf_at(phase, distance=30.0, model="closed_form")
    eps = beta * WAVELENGTH * 30.0 / np.pi
    ap, am = 1 / (1 + eps), 1 / (1 - eps)
    expected = sum(
        c * np.pi / g * np.sin(np.pi**2 * rho2 / g - psi)
        for c, g, psi in [
            (ap / 4, beta * ap, phase),
            (am / 4, beta * am, phase),
            (ap * am / 8, beta * (ap + am), 2 * phase),
        ]
    )
    expected[15, 20] += (1 / 4 + (ap**2 + am**2) / 16) * 30 * 41 * 0.02**2
    np.testing.assert_allclose(H, expected, rtol=0, atol=1e-12)


# --- gradients ------------------------------------------------------------------------------------

NAMES = ("beta", "phase", "distance", "wavelength", "object_distance", "width")
SHAPE, PITCH = (9, 12), 0.06
WEIGHT = jnp.asarray(np.random.default_rng(11).normal(size=SHAPE))
POINT = {
    k: jnp.asarray(v) for k, v in zip(NAMES, (200.0, 0.3, 20.0, 500e-6, 60.0, 0.43), strict=True)
}


def weighted(p, model, pixel_integration=False, transform=False):
    """A fixed random sum over the PSF, or over the real part of the OTF."""
    camera = camera_of(
        SHAPE,
        PITCH,
        beta=p["beta"],
        phase=p["phase"],
        width=p["width"],
        distance=p["distance"],
        centre=(0.02, -0.03),
    )
    arguments = {
        "wavelength": p["wavelength"],
        "object_distance": p["object_distance"],
        "model": model,
        "pixel_integration": pixel_integration,
    }
    h = tc.otf(camera, **arguments).real if transform else tc.psf(camera, **arguments)
    return jnp.sum(h * WEIGHT)


def steps(p):
    """A step for each parameter: 0.003 rad over the rate at which the fastest phase turns with it.

    The fastest are those of the edges' waves, π(x−ξ)²/(λd) with |x−ξ| ≤ L = the sensor's half
    diagonal plus the mask's: 200 rad here, whose rounding is 5e-14 rad, so that 0.003 rad (see
    `finite_difference`) leaves some 1e-10. In d and λ that phase turns by itself over d and over λ;
    in t the spherical wave's π ξ²/(λt) does; in β the zones', βr²; in the width the edge moves
    through the fringes, 2π L/(λd) per mm.
    """
    reach = 0.5 * np.hypot(*SHAPE) * PITCH + float(p["width"])
    fringe = float(np.pi * reach**2 / (p["wavelength"] * p["distance"]))
    rates = {
        "beta": 0.5 * float(p["width"]) ** 2,
        "phase": 1.0,
        "distance": fringe / float(p["distance"]),
        "wavelength": fringe / float(p["wavelength"]),
        "object_distance": fringe * float(p["distance"] / p["object_distance"] ** 2),
        "width": 2 * fringe / reach,
    }
    return {name: 0.003 / rate for name, rate in rates.items()}


def check_gradient(model, rtol, zero=(), **options):
    function, slope = value_and_slope(lambda p: weighted(p, model, **options))
    exact = slope(POINT)
    for name, step in steps(POINT).items():
        direction = {k: jnp.ones(()) if k == name else jnp.zeros(()) for k in POINT}
        difference = finite_difference(function, POINT, direction, step)
        if name in zero:
            assert exact[name] == 0.0 and abs(difference * step) < 1e-13, name
        else:
            assert abs(exact[name] * step) > 1e-9, name  # something to compare
            np.testing.assert_allclose(exact[name], difference, rtol=rtol, err_msg=name)


@pytest.mark.parametrize(
    ("model", "zero"),
    [
        ("geometric", ("wavelength", "width")),  # a step at the edge of the shadow
        # The mask has no edge.
        pytest.param("paraxial", ("width",), marks=pytest.mark.thorough),
        ("closed_form", ("width",)),
    ],
)
def test_gradients_of_the_closed_forms(model, zero):
    check_gradient(model, 1e-7, zero)


@pytest.mark.parametrize(
    "model", ["angular_spectrum", pytest.param("rayleigh_sommerfeld", marks=pytest.mark.thorough)]
)
def test_gradients_of_the_sampled_models(model):
    check_gradient(model, 1e-7)


@pytest.mark.parametrize(
    ("model", "zero"), quick([("paraxial", ("width",)), ("angular_spectrum", ())], 1)
)
def test_gradients_of_the_otf(model, zero):
    check_gradient(model, 1e-7, zero, transform=True)


# --- jit, vmap and compilation --------------------------------------------------------------------


@pytest.mark.parametrize("model", quick(["separable", "geometric"], 1))
def test_vmap_is_one_by_one(model):
    betas = jnp.array([150.0, 200.0, 320.0])

    def one(beta):
        return point_psf(
            camera_of(beta=beta), wavelength=WAVELENGTH, object_distance=60.0, model=model
        )

    together = jax.jit(jax.vmap(one))(betas)
    np.testing.assert_allclose(together[2], one(betas[2]), rtol=0, atol=1e-13)
    assert np.abs(together[0] - together[2]).max() > 0.3


def test_changing_a_value_compiles_nothing():
    """Neither in the user's jit nor in the one inside `tc.psf` and `tc.otf`."""
    module = importlib.import_module("thincam_jax.lensless.psf")

    @count_traces
    def h(beta, distance, wavelength, t):
        camera = camera_of(beta=beta, distance=distance)
        return point_psf(camera, wavelength=wavelength, object_distance=t, model="paraxial")

    compiled = jax.jit(h)
    values = [(200.0, 20.0, 5e-4, 60.0), (190.0, 21.0, 6e-4, 70.0), (150.0, 3.0, 4e-4, 1e9)]
    first, *_ = [compiled(*map(jnp.asarray, v)) for v in values]
    assert h.traces == 1
    for evaluate, inner in ((tc.psf, module._psf), (tc.otf, module._otf)):
        sizes = []
        for beta, distance, wavelength, t in [*values, (120, 2, 3e-4, INF)]:
            camera = camera_of(beta=beta, distance=distance)
            evaluate(camera, wavelength=wavelength, object_distance=t, model="paraxial")
            sizes.append(inner._cache_size())
        assert len(set(sizes)) == 1, sizes
    once = point_psf(camera_of(), wavelength=5e-4, object_distance=60.0, model="paraxial")
    np.testing.assert_allclose(first, once, rtol=0, atol=1e-14)


# --- bad and extreme input ------------------------------------------------------------------------


@pytest.mark.thorough
def test_mask_wider_than_its_plane_inside_jit():
    """A traced width cannot choose the plane: that is the sensor's, too small for this mask."""

    def energy(width):
        camera = camera_of(width=width)
        return jnp.sum(point_psf(camera, wavelength=WAVELENGTH, model="angular_spectrum"))

    compiled = jax.jit(energy)
    assert compiled(jnp.asarray(0.5)) > 0
    with pytest.raises(Exception, match="wider than the plane that samples it; give a larger"):
        compiled(jnp.asarray(0.7)).block_until_ready()
    assert energy(0.7) > compiled(jnp.asarray(0.5))  # known outside jit: the plane grows


def test_sizes_that_do_not_fit_are_refused_at_once():
    """10⁶×10⁶ pixels: the estimate, the memory there is, and what to do; before any work."""
    camera = camera_of((10**6, 10**6), 1e-3)
    with pytest.raises(
        MemoryError, match=r"1000000×1000000 pixels by model 'separable' needs about 7.3 TiB"
    ):
        point_psf(camera, wavelength=WAVELENGTH)
    with pytest.raises(
        MemoryError, match="'angular_spectrum' needs about .* are free; use a smaller"
    ):
        point_psf(
            camera_of((3000, 2000)),
            wavelength=WAVELENGTH,
            model=tc.PsfMethod("angular_spectrum", oversampling=99),
        )


def test_mask_without_terms_needs_a_sampled_model():
    camera = tc.LenslessCamera(tc.RadialMask([1.0], 0.2), tc.Sensor((4, 5), 0.1), 5.0)
    for model in ("closed_form", "paraxial"):
        with pytest.raises(
            TypeError, match=f"{model}.*RadialMask.*'radial', 'angular_spectrum' or 'rayleigh_"
        ):
            point_psf(camera, wavelength=WAVELENGTH, model=model)


def test_a_grid_replaces_the_sensor():
    elsewhere = point_psf(
        camera_of().on_grid(tc.Grid((3, 4), 0.05)), wavelength=WAVELENGTH, model="geometric"
    )
    same = point_psf(camera_of((3, 4), 0.05), wavelength=WAVELENGTH, model="geometric")
    np.testing.assert_array_equal(elsewhere, same)
