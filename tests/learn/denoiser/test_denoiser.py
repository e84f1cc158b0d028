"""The denoiser: what holds by construction, what it refuses, its file."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import finite_difference, relative_l2
from thincam_jax.learn.checkpoint import CheckpointError, write_arrays
from thincam_jax.learn.denoiser import network as room
from thincam_jax.learn.denoiser.network import Denoiser, DenoiserOptions, create, network_card

OPTIONS = DenoiserOptions((4, 6), (1, 1))


@pytest.fixture(scope="module")
def network():
    """Not trained, but with a last convolution that is not zero."""
    made = create(OPTIONS, key=jax.random.key(0))
    leave = 0.1 * jax.random.normal(jax.random.key(1), made.leave.shape)
    return eqx.tree_at(lambda n: n.leave, made, leave)


@pytest.fixture(scope="module")
def image():
    return jax.random.uniform(jax.random.key(2), (2, 11, 14))


def test_images_of_any_size_and_batch(network, image):
    denoiser = Denoiser(network)
    found = denoiser(image, 0.1)
    assert found.shape == image.shape and relative_l2(found, image) > 1e-3
    each = denoiser(image, jnp.asarray([0.1, 0.2]))
    assert relative_l2(each[0], found[0]) < 1e-12 and relative_l2(each[1], found[1]) > 1e-4
    assert denoiser(image[0, :1, :1], 0.1).shape == (1, 1)
    assert denoiser(image.astype(jnp.float32), 0.1).dtype == jnp.float32


def test_units_and_offsets_do_not_matter(network, image):
    """D(a y + b, a σ) = a D(y, σ) + b, and the noise of a uniform image without any is none."""
    denoiser = Denoiser(network)
    scaled = denoiser(3.5 * image - 2.0, 0.35)
    assert relative_l2(scaled, 3.5 * denoiser(image, 0.1) - 2.0) < 1e-12


def test_an_image_is_padded_by_its_own_reflection(network, image):
    """A side that does not halve: the padded image gives the same inside."""
    padded = jnp.pad(image, ((0, 0), (0, 1), (0, 2)), "reflect")
    sigma, centre = jnp.full(2, 0.1), jnp.mean(image, axis=(1, 2))
    found = eqx.filter_jit(room.denoised)(network, padded, sigma, centre)[:, :11, :14]
    assert relative_l2(Denoiser(network)(image, 0.1), found) < 1e-12


def test_gradients(network, image):
    weights = jax.random.normal(jax.random.key(4), image.shape)

    @jax.jit
    @jax.value_and_grad
    def value_and_slope(given):
        y, sigma = given
        return jnp.sum(weights * Denoiser(network)(y, sigma))

    def value(given):
        return value_and_slope(given)[0]

    given = image, jnp.asarray(0.1)
    ways = jax.random.normal(jax.random.key(5), image.shape), jnp.asarray(0.3)
    slope = value_and_slope(given)[1]
    along = sum(jnp.sum(a * b) for a, b in zip(slope, ways, strict=True))
    assert float(along) == pytest.approx(float(finite_difference(value, given, ways, 1e-7)), 1e-5)


def test_a_file_comes_back(network, tmp_path):
    file = Denoiser(network).save(tmp_path / "net.thincam", {"steps": 3, "scores": [0.5]})
    card = network_card(file)
    assert card.scores == (0.5,) and card.options.widths == (4, 6)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), network)
    assert eqx.tree_equal(Denoiser.load(file).network, single)


def test_a_file_of_no_use_is_told(network, tmp_path):
    file = Denoiser(network).save(tmp_path / "net.thincam", {"images": ["a.png"]})
    with pytest.raises(CheckpointError, match="card of another version"):
        network_card(file)
    spoilt = eqx.tree_at(lambda n: n.leave, network, network.leave.at[0, 0, 1, 1].set(jnp.nan))
    Denoiser(spoilt).save(file)
    with pytest.raises(CheckpointError, match="weights that are not finite; give an earlier file"):
        Denoiser.load(file)


@pytest.mark.parametrize(
    ("widths", "blocks"),
    [
        ([], []),
        ([[[[4]]]], [1]),
        ([4] * 5000, [1] * 5000),
        ([4] * 16, [64] * 16),
        (["x"], [1]),
        (3, 3),
    ],
)
def test_options_of_a_file_that_are_not_to_be_trusted(widths, blocks, network, tmp_path):
    options = {"widths": widths, "blocks": blocks}
    card = {"kind": room._KIND, "options": options, "training": {}}
    file = write_arrays(tmp_path / "net.thincam", network, card)
    with pytest.raises(CheckpointError, match="options of another version") as told:
        Denoiser.load(file)
    assert len(str(told.value)) < 500


def test_untrained_it_changes_nothing(image):
    untrained = create(OPTIONS, key=jax.random.key(0))
    np.testing.assert_array_equal(Denoiser(untrained)(image, 0.1), image)
