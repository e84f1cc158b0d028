"""Learned parts: unrolled solvers and suggestions of designs."""

from thincam_jax.learn.suggester_training import train_suggester as train_suggester
from thincam_jax.learn.suggestions import Suggester as Suggester
from thincam_jax.learn.suggestions import Suggestion as Suggestion
from thincam_jax.learn.suggestions import load_suggester as load_suggester
from thincam_jax.learn.suggestions import propose as propose
from thincam_jax.learn.suggestions import save_suggester as save_suggester
from thincam_jax.learn.suggestions import suggest as suggest
from thincam_jax.learn.unrolled import UnrolledAdmm as UnrolledAdmm
