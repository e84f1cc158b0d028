"""Benchmarks of a study's models: what they cost, how far off they are and what that does."""

from thincam_jax.bench.accuracy import Options as Options
from thincam_jax.bench.accuracy import check as check
from thincam_jax.bench.accuracy import run_accuracy as run_accuracy
from thincam_jax.bench.accuracy import steps as steps
from thincam_jax.bench.folder import BenchFolder as BenchFolder
