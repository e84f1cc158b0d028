"""The examples of docs/reconstruction.md, on simulated files of a Bayer sensor."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
from commands.photo import simulated
from test_readme import run_examples


def test_examples(tmp_path, monkeypatch, capsys):
    """They run, the image is the scene, and the gradient is the slope of what it is said to be."""
    monkeypatch.chdir(tmp_path)
    simulated.bayer_files(tmp_path)
    with jax.enable_x64(False):  # the precision of a user
        names = run_examples("docs/reconstruction.md")
    printed = capsys.readouterr().out
    assert "(3, 30, 38)" in printed
    assert "nan" not in printed
    ready, image = names["ready"], np.asarray(names["result"].image)
    assert ready.log["background"]["capture"]["kind"] == "dark frame dark.tif"
    truth = simulated.scene().reshape(3, 30, 2, 38, 2).mean(axis=(2, 4))
    for channel, expected in zip(image, truth, strict=True):
        assert simulated.correlation(channel, expected) > 0.9
    with PIL.Image.open("result.png") as shown:
        assert shown.mode == "RGB" and shown.size == (38, 30)
    assert json.loads((tmp_path / "result.json").read_text("utf-8")) == json.loads(
        names["measured"].log_text(ready.log)
    )
    assert bool(jnp.isfinite(names["by_psf"]).all())
    for name in ("photo", "chart"):  # differences are taken in double precision
        names[name] = jnp.asarray(names[name], dtype=jnp.float64)
    psfs, step = jnp.asarray(names["psfs"], dtype=jnp.float64), 0.05
    ends = [float(names["misfit"](psfs, tau)) for tau in (2 - step, 2 + step)]
    np.testing.assert_allclose(float(names["by_tau"]), np.diff(ends)[0] / (2 * step), rtol=0.02)
