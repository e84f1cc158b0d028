"""A trained network as it comes with the package: its weights in half precision.

`python docs/ship_network.py CONFIG NETWORK`: a training's config and its network.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

from thincam_jax import learn
from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.learned.build import build_camera
from thincam_jax.commands.learned.config import LearnedConfig
from thincam_jax.learn.refocusing.store import network_description

PLACE = Path(__file__).parents[1] / "thincam_jax/learn/refocusing/shipped.thincam"

config, path = sys.argv[1:]
network = learn.load(path, build_camera(load_as(LearnedConfig, config)))
half = jax.tree.map(lambda leaf: leaf.astype(jnp.float16), network.weights)
told = network_description(path)["training"]
learn.save(PLACE, eqx.tree_at(lambda n: n.weights, network, half), told)
print(f"{PLACE}: {PLACE.stat().st_size / 1e6:.1f} MB")
