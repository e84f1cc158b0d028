"""A trained network as it comes with the package: its weights in half precision.

`python docs/ship_network.py NETWORK`: a denoiser. `python docs/ship_network.py NETWORK CONFIG`: a
refocusing network and the config of its training.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

from thincam_jax import learn
from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.learned.config import LearnedConfig
from thincam_jax.commands.learned.run import build_camera
from thincam_jax.learn.denoiser.network import load_network, network_card, save_network
from thincam_jax.learn.refocusing.store import network_description

ROOM = Path(__file__).parents[1] / "thincam_jax/learn"


def halved(weights):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float16), weights)


path, *config = sys.argv[1:]
if config:
    place = ROOM / "refocusing/shipped.thincam"
    network = learn.load(path, build_camera(load_as(LearnedConfig, config[0])))
    half = eqx.tree_at(lambda n: n.weights, network, halved(network.weights))
    learn.save(place, half, network_description(path)["training"])
else:
    place = ROOM / "denoiser/shipped.thincam"
    save_network(place, halved(load_network(path)), network_card(path)["training"])
print(f"{place}: {place.stat().st_size / 1e6:.1f} MB")
