"""The transfer function from factors is that of the sampled PSF."""

import numpy as np
import pytest
from lensless.plan.scenes import camera

import thincam_jax as tc
from thincam_jax.lensless.method import CLOSED, PsfMethod, models_of
from thincam_jax.lensless.plan.transfer import (
    TransferProbe,
    _rounded_up,
    centred,
    sample_frequencies,
)
from thincam_jax.units import nm

KERNEL = (45, 70)


def direct(h, frequencies):
    """Σ h e^{−2πj(vy+ux)} over the samples."""
    down = np.exp(-2j * np.pi * np.outer(frequencies.v, centred(h.shape[0])))
    across = np.exp(-2j * np.pi * np.outer(centred(h.shape[1]), frequencies.u))
    return np.einsum("km,mn,nk->k", down, np.asarray(h), across)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(m, marks=[pytest.mark.thorough] * (m != "closed_form"))
        for m in models_of(camera().mask)
        if m in CLOSED
    ],
)
@pytest.mark.parametrize("average", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_exact_and_quick_agree_with_the_sum_over_the_psf(model, average):
    own = camera()
    frequencies = sample_frequencies(max(KERNEL))
    probe = TransferProbe(own, KERNEL, frequencies)
    h = tc.psf(
        own.on_grid(tc.Grid(KERNEL, own.sensor.pitch)),
        wavelength=500 * nm,
        object_distance=250.0,
        model=model,
        pixel_integration=average,
    )
    expected = direct(h, frequencies)
    scale = np.abs(expected).max()
    method = PsfMethod(model, "float64", average)
    exact = probe.exact(500 * nm, 250.0, method)
    np.testing.assert_allclose(exact, expected, atol=1e-11 * scale)
    quick = probe.quick(500 * nm, 250.0, method)
    np.testing.assert_allclose(quick, expected, atol=2e-5 * scale)


def test_six_nodes_serve_to_compare():
    """6 nodes a pixel in place of 24 move H by 0.9 % here, with pixels as large as 44 µm."""
    own = camera()
    frequencies = sample_frequencies(max(KERNEL))
    probe = TransferProbe(own, KERNEL, frequencies)
    methods = (PsfMethod("separable", "float32", True, nodes=n) for n in (6, 24))
    few, many = (probe.quick(500 * nm, 250.0, method) for method in methods)
    energy = np.sum(frequencies.weights * np.abs(many) ** 2)
    moved = np.sum(frequencies.weights * np.abs(few - many) ** 2)
    assert 0 < np.sqrt(moved / energy) < 1.2e-2


def test_sizes_are_rounded_up_by_a_quarter_at_most():
    for count in [1, 31, 32, 33, 129, 1000, 1323, 5000]:
        assert count <= _rounded_up(count) <= max(64, 1.25 * count)
    assert len({_rounded_up(n) for n in range(1024, 2048)}) <= 5
