"""Total variation against loops over pixels; its proximal map against conditions of a minimum."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import finite_difference, quick
from thincam_jax.reconstruction.total_variation import (
    OPPONENT,
    TotalVariation,
    differences,
    differences_adjoint,
    field_masks,
    within_field,
)

RNG = np.random.default_rng(7)
KINDS, COUPLINGS = ("isotropic", "anisotropic"), ("none", "joint", "opponent")
EVERY = list(itertools.product(KINDS, COUPLINGS))


def by_loops(image, kind, coupling, depth_weight, chroma_weight):
    """One image (channel, plane, y, x), pixel by pixel; nothing of the package."""
    channels, planes, rows, columns = image.shape
    weights = [1.0] * channels
    if coupling == "opponent":
        red, green, blue = image
        image = np.stack(
            [
                (red + green + blue) / math.sqrt(3),
                (red - green) / math.sqrt(2),
                (red + green - 2 * blue) / math.sqrt(6),
            ]
        )
        weights = [1.0, chroma_weight, chroma_weight]
    total = 0.0
    for p, y, x in itertools.product(range(planes), range(rows), range(columns)):
        vectors = []
        for c in range(channels):
            here = image[c, p, y, x]
            vectors.append(
                [
                    image[c, p, y + 1, x] - here if y + 1 < rows else 0.0,
                    image[c, p, y, x + 1] - here if x + 1 < columns else 0.0,
                    depth_weight * (image[c, p + 1, y, x] - here) if p + 1 < planes else 0.0,
                ]
            )
        table = np.array(vectors)
        if coupling == "joint":
            lengths = np.sqrt((table**2).sum(0))
            total += np.sqrt((table**2).sum()) if kind == "isotropic" else lengths.sum()
        elif kind == "isotropic":
            total += np.dot(weights, np.sqrt((table**2).sum(1)))
        else:
            total += np.dot(weights, np.abs(table).sum(1))
    return total


# Compiled: operation by operation each is a program of its own.
value = jax.jit(lambda variation, image: variation(image))
shrink = jax.jit(lambda variation, slopes, step: variation.shrink(slopes, step))


@pytest.mark.parametrize(("kind", "coupling"), EVERY)
def test_every_kind_and_coupling_by_loops(kind, coupling):
    """Batches, planes and colours; an image of one row, too."""
    variation = TotalVariation(kind, coupling, depth_weight=0.6, chroma_weight=1.7)
    for shape in ((2, 3, 3, 4, 5), (1, 3, 1, 1, 6), (1, 3, 2, 5, 1)):
        images = RNG.normal(size=shape)
        expected = [by_loops(image, kind, coupling, 0.6, 1.7) for image in images]
        np.testing.assert_allclose(value(variation, jnp.asarray(images)), expected, rtol=1e-13)


def test_opponent_colours_are_orthonormal_and_the_first_is_grey():
    np.testing.assert_allclose(OPPONENT @ OPPONENT.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(OPPONENT @ np.ones(3), [math.sqrt(3), 0, 0], atol=1e-15)


@pytest.mark.parametrize("planes", [1, 2, 4])
def test_differences_and_their_transpose(planes):
    """The transpose by the matrix itself, column by column, and by dot products."""
    shape = (planes, 3, 5)
    size = planes * 15
    basis = jnp.asarray(np.eye(size).reshape(size, *shape))
    forward = np.concatenate(
        [np.asarray(s).reshape(size, -1) for s in differences(basis, 0.3)], axis=1
    )
    count = 2 if planes == 1 else 3
    assert forward.shape == (size, count * size)
    zero = [np.zeros((size, *shape)) for _ in range(count)]
    for direction in range(count):
        slopes = [jnp.asarray(basis if d == direction else z) for d, z in enumerate(zero)]
        back = np.asarray(differences_adjoint(tuple(slopes), 0.3)).reshape(size, size)
        block = forward[:, direction * size : (direction + 1) * size]
        np.testing.assert_allclose(back, block.T, atol=1e-15)
    image = np.zeros(shape)
    image[0, 2, 4] = 1.0  # a corner: its neighbours lie round the window's end
    down, right, *behind = (np.asarray(s) for s in differences(jnp.asarray(image), 0.3))
    assert down[0, 1, 4] == 1 and down[0, 2, 4] == -1 and right[0, 2, 3] == 1
    assert not behind or (behind[0][0, 2, 4] == -0.3 and not behind[0][-1].any())


def test_masks_keep_the_differences_inside_of_the_field():
    """A field of ones on a window of zeros has no slope inside, wherever it lies."""
    window, field, corner = (9, 8), (4, 5), (3, 1)
    rows, columns = slice(3, 7), slice(1, 6)
    image = np.full((2, *window), 9.0)
    image[:, rows, columns] = 1.0
    slopes = differences(jnp.asarray(image), 1.0)
    masks = field_masks(field, window, corner)
    for slope in within_field(slopes, masks):
        assert not np.asarray(slope).any()
    down, right, behind = (np.asarray(y & x) for y, x in masks)
    assert down.sum() == 3 * 5 and right.sum() == 4 * 4 and behind.sum() == 4 * 5
    assert down[3:6, columns].all() and right[rows, 1:5].all() and behind[rows, columns].all()


def penalty(slopes, kind, coupling, chroma):
    """Σ w ‖·‖ of given slopes (direction, channel, y): TV without the differences."""
    weights = np.ones(slopes.shape[1])
    if coupling == "opponent":
        slopes = np.einsum("dc,scy->sdy", OPPONENT, slopes)
        weights = np.array([1.0, chroma, chroma])
    axes = {"isotropic": (0,), "anisotropic": ()}[kind] + ((1,) if coupling == "joint" else ())
    lengths = np.sqrt((slopes**2).sum(axis=axes, keepdims=True)) if axes else np.abs(slopes)
    return float((lengths * (1.0 if coupling == "joint" else weights[:, None])).sum())


def shortened(slopes, step, kind, coupling, chroma=1.7):
    """The package's shrunk slopes (direction, channel, y)."""
    variation = TotalVariation(kind, coupling, chroma_weight=chroma)
    given = tuple(jnp.asarray(s[:, None, :, None]) for s in slopes)
    found = shrink(variation, given, jnp.asarray(step))
    return np.stack([np.asarray(v)[:, 0, :, 0] for v in found])


@pytest.mark.parametrize(("kind", "coupling"), EVERY)
def test_moreau(kind, coupling):
    """What is cut off lies in the dual ball and points along what is left.

    p = prox(s) if and only if (s − p)/step is a subgradient at p: ⟨s − p, p⟩ = step·φ(p), and
    ⟨s − p, v⟩ ≤ step·φ(v) for every v.
    """
    slopes, step = RNG.normal(size=(3, 3, 40)), 0.8
    left = shortened(slopes, step, kind, coupling)
    cut_off = slopes - left
    product = step * penalty(left, kind, coupling, 1.7)
    assert product > 1 and (np.abs(left).sum(axis=(0, 1)) < 1e-9).mean() < 0.9
    np.testing.assert_allclose((cut_off * left).sum(), product, rtol=1e-12)
    for other in (*RNG.normal(size=(50, *slopes.shape)), cut_off, slopes):
        assert (cut_off * other).sum() <= step * penalty(other, kind, coupling, 1.7) * (1 + 1e-12)
    # no step moves nothing; a step longer than every vector leaves nothing
    np.testing.assert_allclose(shortened(slopes, 0.0, kind, coupling), slopes, atol=1e-14)
    assert not shortened(slopes, 100.0, kind, coupling).any()


@pytest.mark.parametrize(("kind", "coupling"), quick(EVERY, 1, 5))
def test_gradients(kind, coupling):
    """Of the variation by differences; zero on a uniform image."""
    image = jnp.asarray(RNG.normal(size=(3, 2, 4, 5)))
    direction = jnp.asarray(RNG.normal(size=image.shape))
    variation = TotalVariation(kind, coupling, depth_weight=0.4)
    total, gradient = jax.jit(variation.__call__), jax.jit(jax.grad(variation))
    slope = jnp.vdot(gradient(image), direction)
    expected = finite_difference(total, image, direction, 1e-5)
    np.testing.assert_allclose(slope, expected, rtol=1e-7)
    np.testing.assert_array_equal(gradient(jnp.ones_like(image)), 0)


def test_what_is_refused():
    with pytest.raises(ValueError, match="for 3 colour channels, the image has 2"):
        TotalVariation(coupling="opponent")(jnp.ones((2, 1, 4, 5)))


@pytest.mark.parametrize(("kind", "coupling"), quick(EVERY, 2, 4))
def test_slope_of_the_prox_by_differences(kind, coupling):
    """In slopes and step; of vectors that are shortened and of those that vanish."""
    variation = TotalVariation(kind, coupling, chroma_weight=1.3)
    length = 2.0 if coupling == "joint" else 0.8  # of some vectors, more than they have
    rng = np.random.default_rng(2)
    place, way = (jnp.asarray(rng.normal(size=(2, 3, 1, 4, 5))) for _ in range(2))
    place, way = tuple(place.at[:, :, 0, 1, 2].set(0.0)), tuple(way)

    @jax.jit
    def along(t):
        moved = tuple(s[None] + t * w[None] for s, w in zip(place, way, strict=True))
        return jnp.stack(variation.shrink(moved, length + 0.7 * t))

    value, slope = jax.jvp(along, (0.0,), (1.0,))
    if coupling == "opponent":
        value = jnp.einsum("dc,...czyx->...dzyx", jnp.asarray(OPPONENT), value)
    assert 0.1 < float(jnp.mean(jnp.abs(value) < 1e-12)) < 0.9
    np.testing.assert_allclose(slope, (along(1e-6) - along(-1e-6)) / 2e-6, atol=1e-8)
    # Symbolic zeros: only the step changes, or only one direction.
    shrink = jax.jit(lambda slopes, step: jnp.stack(variation.shrink(slopes, step)))
    step = jax.jvp(lambda x: shrink(place, x), (length,), (1.0,))[1]
    up, down = (shrink(place, length + x) for x in (1e-6, -1e-6))
    np.testing.assert_allclose(step, (up - down) / 2e-6, atol=1e-8)
    energy = jax.jit(lambda x: jnp.sum(shrink((x, place[1]), length) ** 2))
    first = jax.grad(energy)
    moved = jnp.sum(first(place[0]) * way[0])
    up, down = (energy(place[0] + x * way[0]) for x in (1e-6, -1e-6))
    assert float(moved) == pytest.approx(float(up - down) / 2e-6, rel=1e-6)
    stacked = jax.jit(jax.vmap(first))(jnp.stack([place[0], way[0]]))
    np.testing.assert_allclose(stacked, [first(place[0]), first(way[0])], atol=1e-14)
