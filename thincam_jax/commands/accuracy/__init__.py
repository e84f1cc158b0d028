"""Benchmarks of a study's models: what they cost, how far off they are and what that does."""

from thincam_jax.commands.accuracy.folder import BenchFolder as BenchFolder
from thincam_jax.commands.accuracy.run import Options as Options
from thincam_jax.commands.accuracy.run import check as check
from thincam_jax.commands.accuracy.run import run_accuracy as run_accuracy
from thincam_jax.commands.accuracy.run import steps as steps
