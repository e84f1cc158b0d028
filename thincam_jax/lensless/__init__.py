"""The lensless camera: a coded mask at a distance in front of a sensor."""

from thincam_jax.lensless.light import shading as shading
