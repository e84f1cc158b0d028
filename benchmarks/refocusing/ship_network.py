"""A trained network as it comes with the package: its weights in half precision.

`python ship_network.py NETWORK`: a denoiser, or a refocusing network of the camera of
score_refocusing.py.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from score_refocusing import refocus_camera

from thincam_jax import learn
from thincam_jax.learn.checkpoint import read_description

ROOM = Path(__file__).parents[2] / "thincam_jax/learn"


def halved(weights):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float16), weights)


(path,) = sys.argv[1:]
known = read_description(path)
if known["kind"] == "refocusing network":
    place = ROOM / "refocusing/shipped.thincam"
    network = learn.RefocusNetwork.load(path, refocus_camera())
    half = eqx.tree_at(lambda n: n.weights, network, halved(network.weights))
    half.save(place, known["training"])
else:
    place = ROOM / "denoiser/shipped.thincam"
    half = learn.Denoiser(halved(learn.Denoiser.load(path).network))
    half.save(place, known["training"])
print(f"{place}: {place.stat().st_size / 1e6:.1f} MB")
