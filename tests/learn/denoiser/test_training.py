"""Training of a denoiser: its pictures and crops, and how it is gone on with after a kill."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

from thincam_jax.learn.denoiser.network import LEAST, MOST, Denoiser, DenoiserOptions, create
from thincam_jax.learn.denoiser.pictures import TILE, drawn, photographs, split
from thincam_jax.learn.denoiser.reconstructions import draw_crops, loss
from thincam_jax.learn.denoiser.train import NETWORK, DenoisingLessons, train_denoiser
from thincam_jax.learn.training import TrainingOptions

OPTIONS = TrainingOptions(steps=60, rate=2e-2, warm_up=5, check_every=20, averaging=0.9)
# As many pictures to judge as to train with: crops of both are drawn by one program.
LESSONS = DenoisingLessons(drawn(0, 6), drawn(1, 6), batch=8, crop=16, judged=4)


def untrained():
    return create(DenoiserOptions((16, 16), (1, 0)), key=jax.random.key(0))


@pytest.mark.thorough
def test_crops_have_the_noise_that_they_say():
    tiles = jnp.asarray(LESSONS.pictures.tiles)
    draws = [draw_crops(tiles, 8, 16, key) for key in jax.random.split(jax.random.key(3), 32)]
    crops = jax.tree.map(lambda *leaves: np.stack(leaves), *draws)
    noise = (crops.noisy - crops.clean) / crops.sigma[..., None, None]
    np.testing.assert_allclose(np.std(noise, axis=(0, 2, 3)), 1, atol=0.06)
    assert crops.sigma.min() > LEAST and crops.sigma.max() < MOST
    assert (np.diff(crops.sigma) > 0).all()
    assert crops.clean.min() >= 0 and crops.clean.shape == (32, 8, 16, 16)
    spread = np.std(crops.centre - crops.noisy.mean(axis=(2, 3)))
    assert 0.05 < spread < 0.3


def test_tiles_cover_a_picture_at_several_scales(tmp_path):
    y, x = np.mgrid[:200, :300]
    levels = np.uint8(np.stack([y, x * 0.8, 0 * x], axis=-1))
    PIL.Image.fromarray(levels).save(tmp_path / "ramp.png")
    PIL.Image.fromarray(levels[..., 0]).save(tmp_path / "grey.png")
    (tmp_path / "LICENSE").write_text("CC0 1.0\n", "utf-8")
    found = photographs(tmp_path)
    tiles = found["ramp"].tiles
    assert tiles.shape == (4, TILE, TILE, 3)  # two by two: smaller scales hold no tile
    assert tiles[..., 0].min() == 0 and tiles[0, -1, -1, 1] < tiles[1, -1, -1, 1]
    assert found["ramp"].manifest[0].licence == "CC0 1.0"
    assert (np.ptp(found["grey"].tiles, axis=-1) == 0).all()
    (kept,), (held_out,) = split(found, ["ramp"])
    assert held_out is found["ramp"] and kept is found["grey"]
    with pytest.raises(ValueError, match="held_out names 'ramps'; there are grey, ramp"):
        split(found, ["ramps"])


@pytest.fixture(scope="module")
def whole():
    return train_denoiser(untrained(), LESSONS, OPTIONS)


@pytest.mark.thorough
def test_it_learns_what_holds_for_pictures_that_it_has_not_seen(whole):
    validation = LESSONS.task(0).validation
    before, after = (
        np.asarray([float(loss(net, crops)[0]) for crops in validation])
        for net in (jax.tree.map(jnp.asarray, untrained()), whole.model)
    )
    noise = np.asarray([float(jnp.mean(jnp.sqrt(crops.sigma))) for crops in validation])
    gain = 20 * np.log10(before / after)
    assert before == pytest.approx(noise, rel=0.05)  # the noise as it is
    assert gain.mean() > 1.0 and gain.mean() > 4 * gain.std() / np.sqrt(len(gain))  # dB


@pytest.mark.thorough
def test_an_interrupted_training_ends_with_the_same_numbers(whole, tmp_path):
    train_denoiser(untrained(), LESSONS, OPTIONS, folder=tmp_path, callback=lambda p: p.step == 27)
    steps = []
    resumed = train_denoiser(
        untrained(), LESSONS, OPTIONS, folder=tmp_path, callback=lambda p: steps.append(p.step)
    )
    assert steps[0] == 21 and steps[-1] == 60
    assert eqx.tree_equal(resumed.state, whole.state)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), whole.model)
    assert eqx.tree_equal(Denoiser.load(tmp_path / NETWORK).network, single)
