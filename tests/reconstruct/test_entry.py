"""`reconstruct`: the settings go to the right method, bad ones are refused with a list."""

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruct import rig

import thincam_jax as tc
from thincam_jax.reconstruct import METHODS, Reconstruction, phase_pairs, separate

SETTINGS = {
    "object_distance": rig.OBJECT_DISTANCE,
    "wavelength": rig.WAVELENGTH,
    "noise_variance": 1e-7,
    "field_shape": rig.FIELD,
    "model": "geometric",
    "pixel_integration": False,
}


def test_it_is_the_wiener_synthesis():
    """With the same settings; by default each capture by itself."""
    cameras = rig.pair()
    captures = rig.captures(cameras, rig.picture())
    fixed = {k: v for k, v in SETTINGS.items() if k != "noise_variance"}
    value = tc.reconstruct(list(captures), cameras, prior="flat", **SETTINGS)
    direct = tc.WienerSynthesis(cameras, synthesis=separate(2), prior="flat", **fixed)
    np.testing.assert_array_equal(value.image, direct(captures, 1e-7).image)
    assert value.status == "ok" and float(value.pitch) == pytest.approx(rig.OBJECT_PITCH)


def test_raw_counts_are_taken_as_they_are():
    """Whole numbers from a camera's file, in which a variance below one would be lost."""
    cameras = rig.pair()
    captures = rig.captures(cameras, rig.picture())
    counts = jnp.round(captures / captures.max() * 4000)
    settings = SETTINGS | {"synthesis": phase_pairs(1), "noise_variance": 0.3}
    expected = tc.reconstruct(counts, cameras, **settings)
    with rig.unchecked():
        value = tc.reconstruct(np.asarray(counts).astype(np.uint16), cameras, **settings)
    np.testing.assert_array_equal(value.image, expected.image)
    assert rig.correlation(value.image, rig.picture()) > 0.9


def test_status_tells_of_what_is_not_a_number():
    assert Reconstruction(jnp.ones((2, 3)), jnp.asarray(0.1)).status == "ok"
    cameras = rig.pair()
    captures = rig.captures(cameras, rig.picture()).at[0, 3, 5].set(jnp.nan)
    assert tc.reconstruct(captures, cameras, **SETTINGS).status == "non_finite"


def test_what_is_refused():
    cameras = rig.pair()
    captures = jnp.ones((2, *rig.SENSOR.shape))
    assert METHODS == ("wiener", "fringe_scanning")
    with rig.unchecked():
        for name, message in (
            ("method", "method = 'x' is unknown; choose one of 'wiener', 'fringe_scanning'"),
            ("prior", "prior = 'x' is unknown; choose one of 'inverse_square', 'flat'"),
            ("model", "model = 'x' is unknown; choose one of 'geometric', 'paraxial'"),
        ):
            with pytest.raises(ValueError, match=message):
                tc.reconstruct(captures, cameras, **(SETTINGS | {name: "x"}))
    with pytest.raises(ValueError, match=r"captures have shape \(2, 96, 85\) for 1 cameras"):
        tc.reconstruct(captures, cameras[:1], **SETTINGS)
    message = r"shape \(96, 85\) for 2 cameras; give \(2, …, y, x\)"
    with rig.unchecked(), pytest.raises(ValueError, match=message):
        tc.reconstruct(list(captures[0]), cameras, **SETTINGS)
    for missing in ("wavelength", "noise_variance"):
        with pytest.raises(ValueError, match="needs wavelength .* and noise_variance"):
            tc.reconstruct(captures, cameras, **(SETTINGS | {missing: None}))
