"""Bragg wavelengths and directions, with and without dispersion, and what processing changes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import RECORDED, hologram

from thincam_jax import waveguide as wg
from thincam_jax.imaging.refractive_index import CauchyIndex, bk7
from thincam_jax.units import deg, nm
from thincam_jax.waveguide.hologram import directions, refracted


def cosines(count=300):
    """About all of what the plate guides: along x = 0, from −29.87° to 46.27° in air."""
    ends = [-0.35, -0.498], [0.35, 0.723]
    return jnp.asarray(np.random.default_rng(2).uniform(*ends, (count, 2)))


def test_recorded_light_is_matched():
    """The object wave is diffracted into the reference wave at the recording wavelength."""
    film = wg.VolumeHologram.record(
        RECORDED, 10 * deg, 55 * deg, index=1.52, thickness=0.02, index_modulation=0.01
    )
    across = jnp.array([0.0, 1.52 * np.sin(10 * deg)])
    wavelength, found = film.bragg_wavelength(across)
    assert found
    np.testing.assert_allclose(wavelength, RECORDED, rtol=1e-14)
    ended = film.diffracted(directions(across, jnp.asarray(1.52)))
    np.testing.assert_allclose(ended, [0, np.sin(55 * deg), -np.cos(55 * deg)], atol=1e-14)


@pytest.mark.parametrize("film", [bk7(), CauchyIndex(1.49, 4.5e-9, (300e-6, 900e-6))])
def test_dispersion(film):
    """The diffracted wave has the film's wavenumber, to 1e-9 nm."""
    processed = hologram(film).processed(shrinkage=0.02, index_change=0.003)
    across = cosines()
    wavelength, found = eqx.filter_jit(processed.bragg_wavelength)(across)
    assert found.all()
    index = np.asarray(processed.index(wavelength))
    k = 2 * np.pi * index / np.asarray(wavelength)
    outgoing = k[:, None] * np.asarray(directions(across, jnp.asarray(index)))
    outgoing = outgoing - np.asarray(processed.grating)
    # |k s − K| − k as an error of the wavelength.
    error = (np.linalg.norm(outgoing, axis=-1) / k - 1) * np.asarray(wavelength)
    assert np.abs(error).max() < 1e-9 * nm


def test_where_no_wavelength_is_matched():
    narrow = hologram(CauchyIndex(1.49, 4.5e-9, (500e-6, 520e-6)))
    wavelength, found = narrow.bragg_wavelength(jnp.zeros((3, 2)))
    assert not found.any()
    assert np.isfinite(wavelength).all()


def test_shrinkage_turns_and_shortens():
    """Fringes come nearer along z only: blue shift on the axis, n²-law of a fixed wave."""
    film = hologram()
    shrunk = film.processed(shrinkage=0.03)
    np.testing.assert_allclose(shrunk.grating, np.asarray(film.grating) / [1, 1, 0.97], rtol=1e-14)
    np.testing.assert_allclose(shrunk.thickness, 0.97 * 0.016, rtol=1e-14)
    before, after = (f.bragg_wavelength(jnp.zeros(2))[0] for f in (film, shrunk))
    assert after < before


def test_glass():
    """BK7 at the lines of its data sheet."""
    lines = jnp.array([486.1327, 587.5618, 656.2725]) * nm
    np.testing.assert_allclose(bk7()(lines), [1.52238, 1.51680, 1.51432], atol=5e-6)


def test_refracted():
    np.testing.assert_allclose(refracted(30 * deg, 1.0, 1.5), np.arcsin(1 / 3), rtol=1e-14)
    with pytest.raises(ValueError, match="is totally reflected.*give a smaller angle"):
        refracted(60 * deg, 1.5, 1.0)
