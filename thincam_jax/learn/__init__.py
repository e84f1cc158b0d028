"""Learned parts: a denoiser, unrolled solvers, refocusing networks."""

from thincam_jax._core.names import modules_of
from thincam_jax.learn.denoiser.network import Denoiser as Denoiser
from thincam_jax.learn.refocusing.network import RefocusNetwork as RefocusNetwork
from thincam_jax.learn.tau import learn_tau as learn_tau
from thincam_jax.learn.unrolled import UnrolledAdmm as UnrolledAdmm

__getattr__ = modules_of(__name__)
