"""`thincam reconstruct --network`: a capture's file focused by a network of its camera."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import skimage.io
from commands.reconstruct import simulated
from commands.reconstruct.test_command import one_line
from learn import tiny_network as tiny
from learn.commands.test_train import FILE
from typer.testing import CliRunner

from thincam_jax.commands import cli


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A camera, its network and a capture of 12 bit of a square at 80 mm."""
    folder, network = tmp_path_factory.mktemp("network"), tiny.network()
    (folder / "camera.yaml").write_text(FILE, "utf-8")
    network.save(folder / "net.thincam")
    scene = np.zeros((1, 14, 12))
    scene[0, 4:9, 3:8] = 1
    seen = network.camera.operator(jnp.asarray([80.0]))(jnp.asarray(scene + 0.2))
    simulated.write_tiff(folder / "capture.tif", simulated.counts(np.asarray(seen)))
    return folder


def call(folder, *more, network="net.thincam", background=simulated.DARK, distance="80 mm"):
    given = {"--capture": "capture.tif", "--camera": "camera.yaml", "--network": network}
    typed = [part for option, name in given.items() for part in (option, folder / name)]
    typed += ["--out", folder / "image.png", "--bits", 12, "--background", background]
    typed += [] if distance is None else ["--distance", distance]
    return CliRunner().invoke(cli.app, ["reconstruct", *(str(part) for part in (*typed, *more))])


@pytest.mark.thorough
def test_a_capture_is_focused_and_what_is_not_sure_is_marked(files):
    result = call(files)
    assert result.exit_code == 0, result.output
    assert "image.png: focused on 80 mm, residual" in result.stdout
    assert np.load(files / "image.npy").shape == (14, 12)
    done = json.loads((files / "image.json").read_text("utf-8"))["reconstruction"]
    assert done["method"] == "learned" and done["focused_on_mm"] == 80.0
    assert done["network"].endswith("net.thincam") and 0 <= done["unsure"] <= 1
    assert skimage.io.imread(files / "image-unsure.png").std() > 1


@pytest.mark.thorough
def test_what_does_not_fit_is_one_line(files):
    for given, message in (
        ((call(files, distance="3 m")), "distance = 3000 mm lies outside of what the network was"),
        ((call(files, distance=None)), "tells no object's distance; give a --distance"),
        ((call(files, distance="80")), "--distance: "),
        ((call(files, "--tau", 2)), "--network has no tau; leave one of both out"),
        (
            (call(files, "--set", "mask.beta=14 rad/mm^2")),
            "net.thincam: was trained for a camera whose camera.mask.beta was 13.0 and is 14.0",
        ),
        ((call(files, network="capture.tif")), "is no file of a network"),
        ((call(files, "--psf", files / "capture.tif")), "give either --psf"),
        ((call(files, background="found")), "a network finds no background, as solvers do; give"),
    ):
        assert message in one_line(given)
