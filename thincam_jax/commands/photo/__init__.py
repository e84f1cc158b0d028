"""Reconstructing captures from their files: read, prepare, reconstruct, write, keep a record."""

from thincam_jax.commands.photo.jobs import Job as Job
from thincam_jax.commands.photo.jobs import plan_jobs as plan_jobs
from thincam_jax.commands.photo.options import PSF_METHODS as PSF_METHODS
from thincam_jax.commands.photo.options import Output as Output
from thincam_jax.commands.photo.options import Recipe as Recipe
from thincam_jax.commands.photo.options import Sources as Sources
from thincam_jax.commands.photo.run import Failed as Failed
from thincam_jax.commands.photo.run import Finished as Finished
from thincam_jax.commands.photo.run import run_jobs as run_jobs
