"""The sampled model: converges to the exact ones, keeps energy, and knows when it is sampled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation import reference

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.propagation.angular_spectrum import angular_spectrum, propagate
from thincam_jax.lensless.propagation.separable import separable

WAVELENGTH = 500e-6
# A gentle set-up: at d = 20 mm the waves of the edges stay under 2°, where Fresnel holds.
MASK = tc.FresnelZoneAperture(200.0, 0.3, width=0.5, centre=(0.02, -0.03))
GRID = tc.Grid((60, 76), 0.01)
GENTLE = LightPath(WAVELENGTH, 20.0)

sampled = jax.jit(
    lambda mask, grid, path, padding=2.0, **settings: angular_spectrum(
        mask,
        grid,
        path,
        tc.PsfMethod("angular_spectrum", **{"pixel_integration": False} | settings),
        padding=padding,
    ),
    static_argnames=("mask_shape", "oversampling", "padding", "pixel_integration"),
)
exact = jax.jit(
    lambda mask, grid, path: separable(mask, grid, path, pixel_integration=False).image()
)
sample = jax.jit(lambda mask, grid: mask.sample(grid))
carry = jax.jit(propagate)


@pytest.mark.thorough
def test_finite_object_distance():
    """The exact spherical wave and the scale M² lead to the same PSF as Eq 3.2's scaling."""
    path = LightPath(WAVELENGTH, 20.0, 60.0)
    value = sampled(MASK, GRID, path, mask_shape=(54, 56), oversampling=3, padding=2.0)
    assert relative_l2(value, exact(MASK, GRID, path)) < 5e-3


def test_pixel_average():
    """The mean of the 3×3 samples of a pixel, of which the middle one is the point-sampled PSF."""
    grid, fine = tc.Grid((20, 26), 0.03), tc.Grid((60, 78), 0.01)
    samples = np.asarray(sampled(MASK, fine, GENTLE, mask_shape=(54, 60)))
    blocks = samples.reshape(20, 3, 26, 3)
    arguments = {"mask_shape": (18, 20), "oversampling": 3}
    average = sampled(MASK, grid, GENTLE, pixel_integration=True, **arguments)
    np.testing.assert_allclose(average, blocks.mean(axis=(1, 3)), rtol=0, atol=1e-12)
    points = sampled(MASK, grid, GENTLE, **arguments)
    np.testing.assert_allclose(points, blocks[:, 1, :, 1], rtol=0, atol=1e-12)
    assert relative_l2(points, average) > 0.05


@pytest.mark.parametrize(("padding", "tolerance"), [(1.0, 0.04), (2.0, 0.02)])
def test_nothing_wraps_round(padding, tolerance):
    """A bright hole at one corner of the plane; the far corner gets its diffraction alone.

    On a window that is not padded the hole's light comes back in on the other side.
    """
    hole = tc.SampledMask(np.ones((6, 5)), 0.01, centre=(0.26, 0.34))
    path = LightPath(WAVELENGTH, 40.0)
    rows, columns = (reference.centred(n, 0.01) for n in GRID.shape)
    b = float(path.fresnel_curvature)
    field = np.outer(
        reference.chirp(0.0, b, rows, 0.23, 0.29), reference.chirp(0.0, b, columns, 0.315, 0.365)
    )
    expected = np.abs(field * b / np.pi) ** 2
    value = np.asarray(sampled(hole, GRID, path, oversampling=3, padding=padding))
    far = np.s_[:20, :25]
    assert np.abs(value - expected).max() < tolerance * expected.max()
    assert value[far].max() < 3 * expected[far].max()
    wrapped = carry(sample(hole, GRID).astype(complex), GRID.pitch, path)
    assert (np.abs(wrapped[far]) ** 2).max() > 10 * expected[far].max()


def test_a_plane_wave_turns_by_its_angle():
    """e^{2πjνx} becomes e^{jkd(√(1−λ²ν²)−1)} times itself: k·sin²θ/(1+cosθ), no piston."""
    pitch, shape, d = 0.002, (8, 250), 0.9
    x = np.arange(250) * pitch
    frequency = 40 / (250 * pitch)  # 80 cycles/mm, 2.3°
    wave = jnp.asarray(np.exp(2j * np.pi * frequency * x) * np.ones((8, 1)))
    out = carry(wave, jnp.asarray(pitch), LightPath(WAVELENGTH, d))
    cosine = np.cos(np.arcsin(WAVELENGTH * frequency))
    expected = wave * np.exp(2j * np.pi * d / WAVELENGTH * (cosine - 1))
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-10)
    assert out.shape == shape


def random_field(seed, shape=(48, 63)):
    """A band-limited field: frequencies to a quarter of Nyquist."""
    rng = np.random.default_rng(seed)
    spectrum = rng.normal(size=(2, *shape))
    keep = [np.abs(np.fft.fftfreq(n)) < 0.125 for n in shape]
    spectrum = (spectrum[0] + 1j * spectrum[1]) * keep[0][:, None] * keep[1]
    return jnp.asarray(np.fft.ifft2(spectrum))


def test_energy_and_adjoint():
    """|U|² is kept; the adjoint, ⟨Pu, w⟩ = ⟨u, P*w⟩, runs the light backwards: P*w = (P w*)*."""
    u, w = random_field(1), random_field(2)
    pitch, path = jnp.asarray(0.01), LightPath(WAVELENGTH, 9.0)
    forward = carry(u, pitch, path)
    np.testing.assert_allclose(jnp.vdot(forward, forward), jnp.vdot(u, u), rtol=1e-12)
    backward = carry(w.conj(), pitch, path).conj()
    np.testing.assert_allclose(jnp.vdot(w, forward), jnp.vdot(backward, u), rtol=1e-12)
    transposed = jax.linear_transpose(lambda f: carry(f, pitch, path), u)(w.conj())[0].conj()
    np.testing.assert_allclose(transposed, backward, rtol=0, atol=1e-14)
    assert relative_l2(forward, u) > 0.5


def test_even_oversampling_is_refused():
    with pytest.raises(ValueError, match="oversampling = 2: give an odd number"):
        tc.PsfMethod("angular_spectrum", oversampling=2)
