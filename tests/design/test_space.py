"""Free numbers of a design within their limits, and the design for an own sensor."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design.setting import thesis_design

import thincam_jax as tc
from thincam_jax.design import DesignSpace, Variable, shots
from thincam_jax.design.design import Design
from thincam_jax.design.own_sensor import beta_bounds
from thincam_jax.design.space import Limits, active_limits
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.units import um

BASE = thesis_design()
BETA = Variable("beta", 8.0, 36.0, (0, 1))
LENGTH = Variable("distance", 2.0, 9.0, (0, 1, 2, 3))
WIDE = Variable("width", 3.0, 8.0)


def test_mask_pixels_hold_for_every_width():
    """β·width ≤ π/pixel at 500 random points of three variables and at the corners."""
    pixel = 0.02
    other = Variable("beta", 9.0, 60.0, (2, 3))
    space = DesignSpace(BASE, (BETA, other, WIDE), Limits(mask_pixel=pixel))
    assert [v.name for v in space.variables] == ["width", "beta", "beta"]
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    points = np.concatenate([np.random.default_rng(1).uniform(size=(500, 3)), corners])
    designs = jax.jit(jax.vmap(space.design))(jnp.asarray(points))
    finest = np.asarray(designs.beta * designs.width[:, None])
    assert np.all(finest[:, [0, 2]] <= math.pi / pixel * (1 + 1e-12))
    np.testing.assert_allclose(finest[:, [0, 2]].max(), math.pi / pixel, rtol=1e-12)
    assert np.all((designs.width >= 3) & (designs.width <= 8))
    assert np.all(designs.beta[:, 0] >= 8.0 - 1e-12)
    assert np.all(designs.beta[:, 0] <= 36.0 + 1e-12)


def test_mask_pixels_with_a_given_width():
    space = DesignSpace(BASE, (BETA,), Limits(mask_pixel=0.02))
    np.testing.assert_allclose(space.values(jnp.ones(1)), math.pi / 0.02 / 5.632)


def test_the_point_of_a_design():
    """It gives the design back, with the width's limit on β too; ½ where bounds leave no room."""
    other = Variable("beta", 9.0, 60.0, (2, 3))
    space = DesignSpace(BASE, (BETA, other, LENGTH, WIDE), Limits(mask_pixel=0.02))
    points = jnp.asarray(np.random.default_rng(2).uniform(size=(20, 4)))
    again = jax.jit(jax.vmap(lambda p: space.point(space.design(p))))(points)
    np.testing.assert_allclose(again, points, atol=1e-12)
    tight = DesignSpace(BASE, (BETA, Variable("distance", 6.5, 6.5, (0, 1, 2, 3))))
    np.testing.assert_allclose(tight.point(BASE), [17 / 28, 0.5])
    outside = shots([50.0, 21.0], 6.5, (0.0, 1.5), wavelength=5e-4, width=5.6)
    assert float(tight.point(outside)[0]) == pytest.approx(1.5)


def test_captures_share_an_exposure():
    """The free shares as chosen; the others divide the rest as their own shares are."""
    base = Design(
        Exposures(
            BASE.beta,
            6.5,
            phase=BASE.phase,
            wavelength=5e-4,
            width=5.6,
            relative_time=[1.0, 1.0, 1.0, 3.0],
        )
    )
    free = Variable("exposure", 0.5, 2.5, (0, 1))
    space = DesignSpace(base, (BETA, free), Limits(exposure=6.0))
    there, back = eqx.filter_jit(space.design), eqx.filter_jit(space.point)
    for place, shares in ((0.0, [0.5, 0.5, 1.25, 3.75]), (1.0, [2.5, 2.5, 0.25, 0.75])):
        design = there(jnp.asarray([0.3, place]))
        np.testing.assert_allclose(design.exposure, shares)
        np.testing.assert_allclose(back(design), [0.3, place], atol=1e-12)
    slope = jax.jit(jax.jacfwd(lambda p: space.design(p).exposure))(jnp.asarray([0.3, 0.5]))
    np.testing.assert_allclose(slope[:, 1], [2, 2, -1, -3])
    kept = DesignSpace(base, (BETA,), Limits(exposure=3.0)).design(jnp.asarray([0.3]))
    np.testing.assert_allclose(kept.exposure, [0.5, 0.5, 0.5, 1.5])


@pytest.mark.parametrize(
    ("variables", "limits", "message"),
    [
        ((), None, "no variable is free"),
        ((Variable("focus", 1.0, 2.0, (0,)),), None, "'focus' is unknown; choose one of beta"),  # pyright: ignore[reportArgumentType]
        ((Variable("distance", 0.0, 8.0, (1,)),), None, "begin at 0 mm; give a lower bound above"),
        ((Variable("beta", 1.0, 8.0),), None, "needs the captures it belongs to"),
        ((Variable("beta", 1.0, 8.0, (4,)),), None, "the design has captures 1 to 4"),
        ((WIDE, WIDE), None, "width is free twice"),
        ((BETA,), Limits(thickness=6.0), "distance of capture 1 ≥ 6.5 mm conflicts with a thick"),
        (
            (Variable("distance", 6.1, 9.0, (0, 1, 2, 3)),),
            Limits(thickness=6.0),
            "distance of capture 1, 2, 3, 4 ≥ 6.1 mm conflicts with a thickness of at most 6 mm",
        ),
        (
            (Variable("exposure", 0.5, 1.0, (0, 1)), Variable("exposure", 0.5, 2.0, (2, 3))),
            Limits(exposure=8.0),
            "of every capture is free, and all of them share 8; leave one that takes the rest",
        ),
        (
            (Variable("exposure", 0.5, 2.0, (0, 1)),),
            Limits(exposure=4.0),
            "free exposures of up to 4 shares conflict with the 4 that all captures have; end",
        ),
        (
            (WIDE,),
            Limits(mask_pixel=0.02),
            "width ≤ 8 mm conflicts with beta ≥ 25 rad/mm.2 on mask pixels of 0.02 mm; give a "
            "width of at most 6.283 mm",
        ),
    ],
)
def test_refused(variables, limits, message):
    with pytest.raises(ValueError, match=message):
        DesignSpace(BASE, variables, limits)


def test_bounds_are_two_zones_and_two_pixels_a_period():
    low, high = beta_bounds(0.00345, 5.175)
    assert low * 5.175**2 / 4 == pytest.approx(2 * 2 * np.pi)
    assert high * (5.175 / 2) / np.pi == pytest.approx(1 / (2 * 0.00345))  # cycles/mm at the edge
    few = beta_bounds(0.1, 0.8)
    assert 0 < few[0] < few[1]


@pytest.mark.parametrize("given", [(10.0, 3.0), (0.0, 3.0), (3.0, float("inf"))])
def test_distances_that_cross_are_refused(given):
    with pytest.raises(ValueError, match=r"give the least and the most in mm, such as \(3, 10\)"):
        tc.design.for_sensor(tc.Sensor((12, 16), 100 * um), distance=given)


def test_active_limits_in_words():
    space = DesignSpace(BASE, (BETA, LENGTH, Variable("phase", -1.0, 1.0, (3,))), Limits(0.02, 7.0))
    words = active_limits(space, jnp.asarray([1.0, 0.9999, 0.0]))
    assert words == (
        "beta of capture 1, 2 ≤ 27.8906 rad/mm^2 (mask pixels of 0.02 mm)",
        "distance of capture 1, 2, 3, 4 ≤ 6.9995 mm (thickness of 7 mm)",
        "phase of capture 4 ≥ -1 rad",
    )
    assert active_limits(space, jnp.full(3, 0.5)) == ()
    assert active_limits(DesignSpace(BASE, (BETA,)), jnp.ones(1)) == (
        "beta of capture 1, 2 ≤ 36 rad/mm^2",
    )
