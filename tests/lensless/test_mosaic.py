"""Masks side by side on one sensor: their PSFs, walls, parallax, steps of height, refusals."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference, quick, relative_l2, value_and_slope
from thincam_jax.lensless.masks.side_by_side import SideBySide
from thincam_jax.units import nm, um

LIGHT, DISTANCE, NEAR = 500 * nm, 4.0, 60.0
PHASES = ((0.0, math.pi / 2), (math.pi, 3 * math.pi / 2))
SENSOR = tc.Sensor((50, 71), 40 * um)  # 2 × 2.84 mm: cells of no whole number of pixels


def plate(phase=0.0, beta=50.0, centre=(0.0, 0.0)):
    return tc.FresnelZoneAperture(beta, phase, width=0.9, height=0.8, centre=centre)


def mosaic(wall: float | None = 0.1, **others):
    masks = [[plate(phase) for phase in row] for row in PHASES]
    return tc.Mosaic(masks, SENSOR, DISTANCE, wall=wall, **others)


def point(row, column):
    """A bright pixel as large as the sensor's on an object of 8 × 13, and its place (y, x), mm."""
    image = np.zeros((8, 13))
    image[row, column] = 1.0
    pixel = 40 * um * NEAR / DISTANCE
    place = (row - 3.5) * pixel, (column - 6) * pixel
    return tc.Scene(tc.ImagePlane(image, NEAR, 13 * pixel), LIGHT), np.array(place)


def scene(distance=NEAR):
    image = np.random.default_rng(0).uniform(0.1, 1.0, (12, 18))
    return tc.Scene(tc.ImagePlane(image, distance, 0.3 * distance), LIGHT)


def direct_field(masks, y, x, distance, away):
    """|U|² of (β, φ, height, width, centre) by midpoints of the Fresnel integral, 1 of no mask."""
    scale = 1 + distance / away
    b = math.pi * scale / (LIGHT * distance)
    field = 0.0
    for beta, phase, height, width, centre in masks:

        def along(at, side, middle, order, beta=beta):
            nodes = side * ((np.arange(20_000) + 0.5) / 20_000 - 0.5)
            waves = np.exp(1j * b * (at[:, None] / scale - middle - nodes) ** 2)
            return waves @ np.exp(1j * order * beta * nodes**2) * side / 20_000

        for order, weight in ((0, 0.5), (1, 0.25), (-1, 0.25)):  # ½(1 + cos(βr² + φ))
            down = along(y, height, centre[0], order)
            across = along(x, width, centre[1], order)
            wave = weight * np.exp(1j * order * phase) * np.outer(down, across)
            field = field + b / (1j * math.pi) * wave
    return np.abs(field) ** 2


def test_psf_without_walls_is_that_of_the_summed_fields():
    whole = tc.Mosaic([[plate(0.3), plate(2.0, 40.0, (0.0, 0.05))]], SENSOR, DISTANCE).whole
    value = tc.psf(whole, wavelength=LIGHT, object_distance=NEAR, pixel_integration=False)
    y, x = (np.asarray(axis, float) for axis in (SENSOR.grid.y, SENSOR.grid.x))
    both = [(50.0, 0.3, 0.8, 0.9, (0.0, -0.71)), (40.0, 2.0, 0.8, 0.9, (0.0, 0.76))]
    expected = direct_field(both, y, x, DISTANCE, NEAR)
    assert relative_l2(value, expected) < 1e-4
    apart = sum(direct_field([one], y, x, DISTANCE, NEAR) for one in both)
    assert relative_l2(value, apart) > 5e-3  # at the pixels' centres their light interferes


@pytest.mark.thorough
def test_pixels_average_the_interference_away():
    whole = mosaic(None).whole
    assert isinstance(whole.mask, SideBySide)
    light: Any = {"wavelength": LIGHT, "object_distance": NEAR}
    value = tc.psf(whole, **light)
    apart = sum(tc.psf(whole.replace(mask=mask), **light) for mask in whole.mask.masks)
    assert 1e-5 < relative_l2(value, apart) < 5e-3
    sampled = tc.psf(whole, **light, model=tc.PsfMethod("angular_spectrum", oversampling=15))
    assert relative_l2(value, sampled) < 5e-3
    shadow = tc.psf(whole, **light, model="geometric")
    shadows = (tc.psf(whole.replace(mask=m), **light, model="geometric") for m in whole.mask.masks)
    assert relative_l2(shadow, sum(shadows)) < 1e-9


@pytest.mark.parametrize("wall", quick([0.1, None], 0))
def test_parts_are_cameras_of_one_scene(wall):
    """A frame, split, is what the parts' cameras capture."""
    one = mosaic(wall)
    frame = tc.capture(one, scene())
    for part, camera in zip(one.split(frame), one.cameras, strict=True):
        # Without walls the scene is drawn on the whole sensor's pixels, half a pixel beside theirs.
        assert relative_l2(part, tc.capture(camera, scene())) < (1e-9 if wall else 1e-2)
    assert relative_l2(one.join(one.split(frame)), frame) < (1e-9 if wall else 0.2)


@pytest.mark.parametrize("wall", quick([0.1, None], 0))
def test_a_point_casts_each_mask_where_straight_lines_go(wall):
    """The shadows on the whole sensor of masks at their places; with walls, of each in its part."""
    one = mosaic(wall)
    seen, place = point(1, 11)
    frame = tc.capture(one, seen)
    moved = place / (1 + NEAR / DISTANCE)  # d/t of it, over M
    centres = [(y, x) for y in (-0.5, 0.5) for x in (-0.71, 0.71)]
    light: Any = {"wavelength": LIGHT, "object_distance": NEAR}
    shadows = []
    for phase, centre in zip(np.ravel(PHASES), centres, strict=True):
        mask = plate(phase, centre=tuple(centre - moved))
        shadows.append(tc.psf(tc.LenslessCamera(mask, SENSOR, DISTANCE), **light))
    if wall is None:
        expected = sum(shadows)
    else:
        expected = one.join([one.split(s)[number] for number, s in enumerate(shadows)])
    assert relative_l2(frame, expected * (40 * um) ** 2) < (1e-6 if wall else 5e-3)
    assert not wall or float(jnp.sum(frame[:, 34:37])) == 0.0  # under the wall


@pytest.mark.thorough
def test_a_place_is_a_point_beside_the_axis():
    camera = tc.LenslessCamera(plate(), SENSOR, DISTANCE)
    aside = camera.replace(place=(0.3, -0.4))
    for model in ("separable", tc.PsfMethod("angular_spectrum", oversampling=5)):
        for distance, at in ((NEAR, (0.7, 0.4)), (math.inf, (0.02, -0.01))):
            how = {"wavelength": LIGHT, "object_distance": distance, "model": model}
            opposite = (0.4, 0.8) if distance == NEAR else at
            value = tc.psf(aside, at=at, **how)
            assert relative_l2(value, tc.psf(camera, at=opposite, **how)) < 1e-6
    axis = tc.psf(aside, wavelength=LIGHT, object_distance=NEAR)
    exact = tc.psf(aside, wavelength=LIGHT, object_distance=NEAR, at=(0.0, 0.0))
    assert 0 < relative_l2(axis, exact) < 5e-3  # 0.5° from the part
    with pytest.raises(ValueError, match="is for points on the axis"):
        tc.psf(aside, wavelength=LIGHT, object_distance=NEAR, model="closed_form")


def test_parts_have_their_own_psf_at_each_point_of_the_field():
    part = mosaic().cameras[1]
    fit = tc.field_operator(part, LIGHT, object_distance=NEAR, field_shape=(20, 31), tolerance=3e-3)
    image = np.zeros((20, 31))
    image[2, 5] = 1.0
    value = np.asarray(fit.operator(jnp.asarray(image))) / SENSOR.pitch**2
    y, x = ((np.array([2, 5]) - (np.array([20, 31]) - 1) / 2) * 0.04 * -NEAR / DISTANCE).tolist()
    expected = tc.psf(part, wavelength=LIGHT, object_distance=NEAR, at=(y, x))
    place = np.asarray(part.place)
    fall = (1 + ((y - place[0]) / NEAR) ** 2 + ((x - place[1]) / NEAR) ** 2) ** -2
    assert relative_l2(value, expected * fall) < 5e-3


def test_spacers_change_the_distance_of_each():
    heights = [[0.0, 0.5], [0.0, 1.0]]
    distances = [float(c.distance) for c in mosaic(spacers=heights).cameras]
    assert distances == [4.0, 4.5, 4.0, 5.0]


@pytest.mark.parametrize("what", quick(["phase", "beta", "spacer"], 0))
def test_gradients_are_those_of_finite_differences(what):
    weights = jnp.asarray(np.random.default_rng(1).normal(size=SENSOR.shape))

    def seen(change):
        heights, beta, phase = jnp.zeros((1, 2)), 50.0, 0.3
        if what == "spacer":
            heights = heights.at[0, 1].set(0.2 + change)
        else:
            beta, phase = (50 + change, 0.3) if what == "beta" else (50.0, 0.3 + change)
        own = [[plate(), plate(phase, beta)]]
        one = tc.Mosaic(own, SENSOR, DISTANCE, wall=0.1, spacers=heights)
        psfs = [tc.psf(c, wavelength=LIGHT, object_distance=NEAR) for c in one.cameras]
        return jnp.sum(weights * one.join(psfs))

    value, slope = value_and_slope(seen)
    at, one = jnp.asarray(0.1), jnp.asarray(1e-4 if what == "spacer" else 1e-2)
    change = float(finite_difference(value, at, one, 0.1))
    assert float(slope(at) * one) == pytest.approx(change, rel=1e-6)


def test_batches_are_split_as_images_are():
    one = mosaic()
    frames = np.random.default_rng(0).random((3, 50, 71))
    parts = one.split(frames)
    assert [part.shape for part in parts] == [(3, *one.part_shape)] * 4
    np.testing.assert_array_equal(parts[3][1], one.split(frames[1])[3])
    joined = one.join(parts)
    np.testing.assert_array_equal(one.split(joined)[2], parts[2])


def test_faults_are_told_with_what_mends_them():
    masks = [[plate(phase) for phase in row] for row in PHASES]
    with pytest.raises(ValueError, match=r"mask 0 needs a cell of 0.8×0.9 mm .* thinner wall"):
        tc.Mosaic(masks, SENSOR, DISTANCE, wall=0.6)
    with pytest.raises(ValueError, match="2 cells of 3 mm .* do not fit 50 pixels of 40 um"):
        tc.Mosaic(masks, SENSOR, DISTANCE, pitch=3.0)
    tc.Mosaic(masks, SENSOR, DISTANCE, pitch=1.0)
    with pytest.raises(ValueError, match="give a wall between them"):
        tc.Mosaic(masks, SENSOR, DISTANCE, spacers=np.ones((2, 2)))
    with pytest.raises(ValueError, match=r"give .*\(2, 2\)"):
        tc.Mosaic(masks, SENSOR, DISTANCE, wall=0.0, spacers=[0.1, 0.2])
    with pytest.raises(ValueError, match="rows of masks"):
        tc.Mosaic(masks[0], SENSOR, DISTANCE)  # pyright: ignore
    rings = tc.RadialMask([1, 0, 1], ring=0.1)
    with pytest.raises(TypeError, match="put walls between them"):
        tc.Mosaic([[rings, rings]], SENSOR, DISTANCE)
    walled = tc.Mosaic([[rings, rings]], SENSOR, DISTANCE, wall=0.0)
    with pytest.raises(ValueError, match="mosaic.cameras"):
        _ = walled.whole
    with pytest.raises(ValueError, match="the frame has"):
        walled.split(np.ones((3, 4)))


def test_masks_side_by_side_move_together():
    pair = SideBySide([plate(centre=(0.0, -0.5)), plate(1.0, centre=(0.0, 0.5))])
    assert [float(side) for side in pair.extent] == pytest.approx([0.8, 1.9])
    assert float(np.asarray(pair.finest_frequency)) == pytest.approx(50 * 0.9 / (2 * math.pi))
    moved = pair.replace(centre=(0.12, 0.04))
    grid = tc.Grid((41, 71), 40 * um)
    value = moved.sample(grid)
    np.testing.assert_allclose(value[3:, 1:], pair.sample(grid)[:-3, :-1], atol=1e-9)
