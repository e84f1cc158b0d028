"""Networks in files and in use: trained, gone on with, loaded for their camera and no other."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learn import tiny_network as tiny
from refocusing_baselines import wiener
from refocusing_scores import capture_scene, flat_scene, scores

import thincam_jax as tc
from thincam_jax.commands.checked_config import load_as
from thincam_jax.learn.checkpoint import CheckpointError, network_description, write_arrays
from thincam_jax.learn.commands.refocusing import LearnedConfig, build_camera
from thincam_jax.learn.refocusing.learned import Learned, doubt
from thincam_jax.learn.refocusing.network import RefocusNetwork
from thincam_jax.learn.refocusing.sources import as_json, dead_leaves
from thincam_jax.learn.refocusing.store import KIND, SHIPPED, SHIPPED_FILE
from thincam_jax.learn.refocusing.train import NETWORK
from thincam_jax.units import nm


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """An untrained network in a file."""
    path = tmp_path_factory.mktemp("network") / NETWORK
    return tiny.network().save(path, {"images": as_json(tiny.lessons().images)})


@pytest.mark.thorough
def test_a_network_comes_back_for_its_camera(file):
    (entry,) = network_description(file, KIND)["training"]["images"]["trained on"]
    assert entry["licence"] == "drawn" and re.fullmatch("[0-9a-f]{64}", entry["sha256"])
    # Whatever its sensor makes of the light; as all it was trained for; or with its light.
    seen = tc.Cameras([tiny.camera()], wavelength=500 * nm, object_distance=80.0)
    for given in (tiny.camera(exposure=0.5), tiny.network().camera, seen):
        found = RefocusNetwork.load(file, given)
        assert eqx.tree_equal(found.weights, tiny.network().weights)
    assert eqx.tree_equal(found.planes.operator, tiny.network().planes.operator)


@pytest.mark.thorough
def test_another_camera_is_refused_with_both_numbers(file):
    with pytest.raises(CheckpointError, match=r"camera\.mask\.beta was 13\.0 and is 13\.1 here"):
        RefocusNetwork.load(file, tiny.camera(beta=13.1))
    seen = tc.Cameras([tiny.camera()], wavelength=600 * nm)
    with pytest.raises(CheckpointError, match=r"wavelengths\.0 was 0\.0005 and is 0\.0006 here"):
        RefocusNetwork.load(file, seen)
    with pytest.raises(CheckpointError, match="takes one capture, not 2"):
        RefocusNetwork.load(file, tc.Cameras([tiny.camera()] * 2))


def test_a_file_that_holds_something_else_is_told(file, tmp_path):
    other = write_arrays(tmp_path / "other", tiny.network().weights, {"kind": "something else"})
    with pytest.raises(CheckpointError, match="holds no refocusing network"):
        RefocusNetwork.load(other, tiny.camera())
    tiny.network().save(other)
    known = network_description(other, KIND)
    known["camera"].pop("light")
    write_arrays(other, tiny.network().weights, known)
    with pytest.raises(CheckpointError, match="tells no whole camera"):
        RefocusNetwork.load(other, tiny.camera())
    known = network_description(file, KIND)
    plain = known["options"]
    for wrong in ({"wings": 2}, {"widths": []}, {"widths": [0]}, {"widths": [4] * 5000}):
        known["options"] = {**plain, **wrong}
        write_arrays(other, tiny.network().weights, known)
        with pytest.raises(CheckpointError, match="options of another version") as told:
            RefocusNetwork.load(other, tiny.camera())
        assert len(str(told.value)) < 500


def recording(distance: object = 80.0, **more):
    capture = tiny.network().planes.uniform * (1 + 0.1 * np.arange(18) / 18)
    cameras = tc.Cameras([tiny.camera()], wavelength=500 * nm, object_distance=distance)
    return tc.Recording([capture], cameras, noise_variance=1e-4, **more)


def test_what_it_cannot_do_is_told_in_a_line():
    network = tiny.network()
    for distance in (49.0, [80.0, 201.0]):
        with pytest.raises(ValueError, match=r"distance = (49|201) mm lies .* 50 to 200"):
            tc.reconstruct(recording(distance), Learned(network))
    with pytest.raises(ValueError, match="distance = 49 mm lies outside"):
        network.focus(recording().captures[0], 49.0, 0.01)
    capture, map_ = recording().captures[0], np.full((32, 32), 80.0)
    with pytest.raises(ValueError, match=r"shape \(32, 32\); give one .* map .*pixels, \(14, 12\)"):
        network.focus(capture, map_, 0.01)
    with pytest.raises(ValueError, match=r"shape \(32, 32\); give a list of them, such as"):
        network.sweep(capture, map_, 0.01)
    for image in (network.sweep(capture, [60, 120], 0.01)[1], network.all_in_focus(capture, 0.01)):
        assert image.shape == network.camera.field_shape
    with pytest.raises(ValueError, match=r"captures have shape \(18, 16\)"):
        network.focus(jnp.ones((18, 16)), 80.0, 0.01)
    with pytest.raises(ValueError, match="takes every pixel of a capture"):
        valid = jnp.ones((16, 18), bool).at[3, 4].set(False)
        tc.reconstruct(recording(valid=valid), Learned(network))
    with pytest.raises(ValueError, match=r"give a recording by tc\.Cameras"):
        psfs = tc.Psfs(np.ones((1, 5, 5)))
        tc.reconstruct(tc.Recording(np.ones((1, 16, 18)), psfs), Learned(network))


def test_each_part_of_an_image_is_focused_on_its_own_distance():
    """Thesis Fig 4.8, where a control code with two halves is obeyed by neither."""
    network, captures = tiny.network(), jnp.stack([recording().captures[0]] * 2)
    shape = network.camera.field_shape
    near, far = (network.focus(captures, t, 0.01) for t in (60.0, 150.0))
    halves = np.where(np.arange(shape[1]) < 4, 60.0, 150.0) * np.ones(shape)
    found = network.focus(captures, halves, 0.01)
    np.testing.assert_allclose(found, np.where(halves == 60.0, near, far), rtol=1e-5)
    slope = np.linspace(60.0, 150.0, shape[0] * shape[1]).reshape(shape)
    found = np.asarray(network.focus(captures[0], slope, 0.01))
    for at in ((0, 0), (3, 5), (shape[0] - 1, shape[1] - 1)):
        alone = np.asarray(network.focus(captures[0], slope[at], 0.01))
        scale = np.abs(alone).max()
        assert abs(found[at] - alone[at]) < 1e-2 * scale
    with pytest.raises(TypeError, match="map of distances needs known numbers"):
        jax.jit(lambda t: network.focus(captures, t, 0.01))(halves)


def test_what_does_not_explain_its_capture_is_doubted():
    assert doubt(1.1) == "" and "misses the capture by 3.0 times the noise" in doubt(3.0)


def test_what_is_shipped_may_be_given_on():
    """No photograph of a licence that binds those who use the weights, and few bytes."""
    told = network_description(SHIPPED_FILE, KIND)["training"]["images"]
    licences = {entry["licence"] for entries in told.values() for entry in entries}
    assert licences == {"scikit-image's own (its data folder's README)", "drawn", "CC0 1.0"}
    assert SHIPPED_FILE.stat().st_size < 4e6


@pytest.mark.thorough
def test_what_is_shipped_beats_a_wiener_filter():
    """By 2.3 dB when written, whatever its strength, on a scene that it was not trained on."""
    config = load_as(LearnedConfig, Path(__file__).parents[2] / "configs/learned_refocus.yaml")
    network = RefocusNetwork.load(SHIPPED, build_camera(config))
    planes, picture = network.planes, dead_leaves(7, 1, 384)[0][:128, :128]
    scene = flat_scene(planes.camera, [picture], [np.ones(picture.shape)], [60.0])
    noise = tc.GaussianNoise(30.0)
    seen, deviation = capture_scene(planes.camera, scene, noise, jax.random.key(0))
    found = scores(network.focus(seen, 60.0, deviation), picture)["psnr"]
    linear = max(
        scores(wiener(planes, seen, deviation, jnp.asarray(60.0), s), picture)["psnr"]
        for s in (0.1, 0.3, 1.0)
    )
    assert found > linear + 1.5
