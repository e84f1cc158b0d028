"""A trained network as it comes with the package: its weights in half precision.

`python ship_network.py NETWORK`: a denoiser, or a reconstruction for the camera of DiffuserCam's
tutorial.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from thincam_jax import learn
from thincam_jax.learn.checkpoint import read_description
from thincam_jax.learn.trained import TrainedReconstruction

ROOM = Path(__file__).parents[1] / "thincam_jax/learn"
PSF = {
    "source": "github.com/Waller-Lab/DiffuserCam-Tutorial, commit 34674be, tutorial/psf_sample.tif",
    "licence": "BSD-3-Clause, Copyright (c) 2018, Waller Lab; notice in diffusercam.LICENSE",
    "preparation": "downsample=8, 150×200 pixels",
}


def halved(weights):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float16), weights)


(path,) = sys.argv[1:]
known = read_description(path)
if known["kind"] == "denoiser":
    place = ROOM / "denoiser/shipped.thincam"
    half = learn.Denoiser(halved(learn.Denoiser.load(path).network))
    half.save(place, known["training"])
else:
    place = ROOM / "diffusercam.thincam"
    halved(TrainedReconstruction.load(path)).save(place, {**known["training"], "psf": PSF})
print(f"{place}: {place.stat().st_size / 1e6:.1f} MB")
