"""The unbounded aperture's exact field: the thesis' formula, and the middle of the finite one."""

import numpy as np
import pytest
from lensless.propagation import reference

import thincam_jax as tc

WAVELENGTH = 500e-6


def psf_of(beta, distance, model, *, shape=(30, 41), pitch=0.01, t=np.inf, width=1.0, **mask):
    camera = tc.LenslessCamera(
        tc.FresnelZoneAperture(beta, width=width, **mask), tc.Sensor(shape, pitch), distance
    )
    return np.asarray(
        tc.psf(
            camera, wavelength=WAVELENGTH, object_distance=t, model=model, pixel_integration=False
        )
    )


@pytest.mark.parametrize(("distance", "t"), [(6.5, np.inf), (40.0, 250.0), (300.0, 900.0)])
def test_is_the_thesis_formula(distance, t):
    """Eq 3.22 corrected, squared, in the shadow's coordinates r/M with d/M; ε from 0.03 to 0.9."""
    beta, phase, (cy, cx) = 25.0, 0.8, (0.03, -0.07)
    m = 1 + distance / t
    eps = beta * WAVELENGTH * distance / m / np.pi
    y, x = reference.centred(30, 0.01) / m - cy, reference.centred(41, 0.01) / m - cx
    r2 = y[:, None] ** 2 + x**2
    ap, am = 1 / (1 + eps), 1 / (1 - eps)
    expected = (
        1 / 4
        + ap**2 / 16
        + am**2 / 16
        + ap / 4 * np.cos(beta * ap * r2 + phase)
        + am / 4 * np.cos(beta * am * r2 + phase)
        + ap * am / 8 * np.cos(beta * (ap + am) * r2 + 2 * phase)
    )
    value = psf_of(beta, distance, "closed_form", t=t, phase=phase, centre=(cy, cx))
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-12 * am**2)


def test_refuses_where_an_order_focuses():
    """ε = 1: no PSF of the unbounded mask, said in words; the finite one has it."""
    beta, t = 200.0, 100.0
    distance = np.pi / WAVELENGTH / (beta - np.pi / (WAVELENGTH * t))
    with pytest.raises(Exception, match=r"closed_form.*focuses on the sensor.*use 'separable'"):
        psf_of(beta, distance, "closed_form", t=t)
    finite = psf_of(beta, distance, "separable", t=t, width=0.5, shape=(1, 1))
    # The focused order alone, (1/4)·width²·M/(λd), with the wave of the order 0 about it.
    peak = 0.25 * 0.5**2 / (WAVELENGTH * distance) * (1 + distance / t)
    assert abs(np.sqrt(finite[0, 0]) - peak) < 0.75 and np.isfinite(finite).all()
