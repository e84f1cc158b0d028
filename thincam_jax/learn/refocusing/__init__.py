"""Learned refocusing of lensless captures at any distance."""

from thincam_jax.learn.refocusing.scenes import SceneOptions as SceneOptions
from thincam_jax.learn.refocusing.scenes import draw_batch as draw_batch
from thincam_jax.learn.refocusing.sources import drawn as drawn
from thincam_jax.learn.refocusing.sources import photographs as photographs
from thincam_jax.learn.refocusing.use import read as read
