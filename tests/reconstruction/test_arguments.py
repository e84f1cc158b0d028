"""Which arguments go with which method: the others are refused, in one line."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig

import thincam_jax as tc
from thincam_jax.reconstruction import METHODS, TotalVariation
from thincam_jax.reconstruction.arguments import USES
from thincam_jax.reconstruction.sparsity import Sparsity

CAMERAS = {"object_distance": rig.OBJECT_DISTANCE, "wavelength": rig.WAVELENGTH}
GIVEN = {
    "tau": 2.0,
    "variation": TotalVariation(),
    "regulariser": Sparsity(),
    "ridge": 1.0,
    "background": 3.0,
    "nonnegative": True,
    "valid": jnp.ones((2, 96, 85), bool),
    "iterations": 100,
    "tolerance": 1e-4,
    "relaxation": 1.8,
    "acceleration": "none",
    "start": jnp.ones(rig.FIELD),
    "callback": print,
}
BY_FILTERS: tuple[str, ...] = ()
BY_VARIATION = (
    *("tau", "variation", "nonnegative", "valid", "iterations", "tolerance", "start"),
    "callback",
)
USED = {
    "auto": (*BY_VARIATION, "relaxation", "acceleration"),
    "wiener": BY_FILTERS,
    "fringe_scanning": BY_FILTERS,
    "admm_tv": (*BY_VARIATION, "relaxation", "acceleration"),
    "fista": (*BY_VARIATION, "regulariser"),
    "twist": (*BY_VARIATION, "regulariser"),
    "ridge": ("ridge", "valid", "iterations", "tolerance"),
    "poisson": ("tau", "variation", "background", "valid", "iterations", "tolerance", "start"),
}
INSTEAD = {"regulariser": "fista", "ridge": "ridge", "background": "poisson"}


def refused(captures, cameras, **settings) -> str:
    with rig.unchecked(), pytest.raises(ValueError) as error:
        tc.reconstruct(captures, cameras, **settings)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("method", METHODS)
def test_what_a_method_cannot_use_is_refused(method):
    """Also at the default value: it would be thought to have done something."""
    captures = jnp.ones((2, *rig.SENSOR.shape))
    more = CAMERAS if method == "poisson" else CAMERAS | {"noise_variance": 1e-7}
    for name, value in GIVEN.items():
        if name not in USED[method]:
            told = refused(captures, rig.pair(), method=method, **more, **{name: value})
            other = INSTEAD.get(name, "admm_tv")
            assert told == f"method {method!r} cannot use {name}; leave out, or use {other!r}"
    assert set(USES[method]) - {"noise_variance", "synthesis"} == set(USED[method])


def test_several_at_once_and_what_no_method_uses_together():
    captures = jnp.ones((2, *rig.SENSOR.shape))
    told = refused(captures, rig.pair(), tau=1.0, start=jnp.ones(rig.FIELD), **CAMERAS)
    assert "cannot use tau and start; leave out, or use 'admm_tv'" in told
    told = refused(captures, rig.pair(), ridge=1.0, callback=print, **CAMERAS)
    assert told == "method 'wiener' cannot use ridge and callback; leave out"


def test_poisson_knows_its_noise_and_takes_no_sums():
    captures = jnp.ones((2, *rig.SENSOR.shape))
    for name, value in (("noise_variance", 1.0), ("synthesis", np.eye(2))):
        told = refused(captures, rig.pair(), method="poisson", **CAMERAS, **{name: value})
        assert told == f"method 'poisson' cannot use {name}; leave out, or use 'admm_tv'"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"method": "fista", "regulariser": Sparsity(), "variation": GIVEN["variation"]},
            "takes the place of total variation: leave one of them out",
        ),
        (
            {"method": "twist", "regulariser": Sparsity(), "tau": "sure"},
            "tau = 'sure' is found for total variation and Gaussian noise only; give a number",
        ),
        ({"method": "poisson", "tau": "discrepancy"}, "tau = 'discrepancy' is found for"),
        ({"method": "ridge", "ridge": 0.0}, "ridge = 0.0 .* is not positive"),
        ({"method": "ridge", "iterations": 0}, "iterations = 0; give a whole number"),
        ({"method": "poisson", "tolerance": -1.0}, "tolerance = -1.0 .* is negative"),
        ({"method": "poisson", "background": [1.0, 2.0]}, "2 backgrounds for 1 captures"),
        ({"method": "poisson", "background": jnp.ones((1, 3))}, r"background has shape \(3,\)"),
        ({"method": "poisson", "background": ["dark"]}, "background 'dark' is no number"),
        ({"method": "poisson", "background": jnp.ones((4, 3))}, r"such as \[frame\] for one"),
        ({"method": "auto", "iterations": 0}, "iterations = 0; give a whole number"),
        ({"method": "auto", "relaxation": 7.0}, "relaxation = 7 is out of range"),
        ({"method": "auto", "acceleration": "fast"}, "choose one of 'none', 'anderson'"),
        ({"method": "auto", "tau": "best"}, "choose one of 'discrepancy', 'sure'"),
        (
            {"method": "auto", "variation": Sparsity()},
            "variation is a Sparsity; give a TotalVariation",
        ),
        (
            {"method": "fista", "regulariser": TotalVariation()},
            "regulariser is a TotalVariation; give a Regulariser",
        ),
        ({"method": "admm_tv", "start": jnp.ones(7)}, r"start has shape \(7,\)"),
        ({"method": "poisson", "background": -1.0}, "background is negative"),
        ({"method": "admm_tv", "wavelength": 5e-4}, "measured PSFs cannot use wavelength"),
        (
            {"method": "wiener"},
            "use 'admm_tv', 'fista', 'twist', 'ridge' or 'poisson'",
        ),
    ],
)
def test_what_does_not_go_together(settings, message):

    told = refused(jnp.ones((1, 20, 21)), jnp.ones((1, 5, 6)), **settings)
    assert re.search(message, told)


def test_the_choice_is_not_hindered_by_settings_of_the_method_not_chosen():
    """The filter takes none of them, and gives the image it gives without."""
    captures = rig.captures(rig.pair(), rig.picture())
    captures = captures + 1e-5 * captures.max() * jnp.asarray(
        np.random.default_rng(6).normal(size=captures.shape)
    )
    where = CAMERAS | {"synthesis": np.array([[1.0, -1.0]]), "field_shape": rig.FIELD}
    where |= {"model": "geometric", "pixel_integration": False}
    settings = {k: v for k, v in GIVEN.items() if k in USED["auto"] and k != "valid"}
    found = tc.reconstruct(captures, rig.pair(), method="auto", **where, **settings)
    alone = tc.reconstruct(captures, rig.pair(), method="auto", **where)
    assert found.method == "wiener" and "contrast" in found.reason and found.tau is None
    np.testing.assert_array_equal(found.image, alone.image)
