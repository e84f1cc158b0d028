"""Learned parts: a denoiser, unrolled solvers, refocusing networks, suggestions of designs."""

from thincam_jax.learn.denoiser.network import Denoiser as Denoiser
from thincam_jax.learn.plug_and_play import PlugAndPlay as PlugAndPlay
from thincam_jax.learn.refocusing.cameras import RefocusCamera as RefocusCamera
from thincam_jax.learn.refocusing.network import NetworkOptions as NetworkOptions
from thincam_jax.learn.refocusing.network import RefocusNetwork as RefocusNetwork
from thincam_jax.learn.refocusing.store import load as load
from thincam_jax.learn.refocusing.store import save as save
from thincam_jax.learn.refocusing.train import Lessons as Lessons
from thincam_jax.learn.refocusing.train import train as train
from thincam_jax.learn.suggester_training import train_suggester as train_suggester
from thincam_jax.learn.suggestions import load_suggester as load_suggester
from thincam_jax.learn.suggestions import propose as propose
from thincam_jax.learn.suggestions import save_suggester as save_suggester
from thincam_jax.learn.suggestions import suggest as suggest
from thincam_jax.learn.tau import learn_tau as learn_tau
from thincam_jax.learn.training import TrainingOptions as TrainingOptions
from thincam_jax.learn.unrolled import UnrolledAdmm as UnrolledAdmm
