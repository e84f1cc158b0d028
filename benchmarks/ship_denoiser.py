"""A trained denoiser as it comes with the package: its weights in half precision.

`python ship_denoiser.py NETWORK`.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from thincam_jax import learn
from thincam_jax.learn.checkpoint import read_description

(path,) = sys.argv[1:]
place = Path(__file__).parents[1] / "thincam_jax/learn/denoiser/shipped.thincam"
network = learn.Denoiser.load(path).network
half = learn.Denoiser(jax.tree.map(lambda leaf: leaf.astype(jnp.float16), network))
half.save(place, read_description(path)["training"])
print(f"{place}: {place.stat().st_size / 1e6:.1f} MB")
