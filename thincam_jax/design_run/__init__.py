"""From a design's file to designs found, and what the full simulation says of them."""

from thincam_jax.design_run.compare import compare as compare
from thincam_jax.design_run.problem import Goal as Goal
from thincam_jax.design_run.problem import broken_limits as broken_limits
from thincam_jax.design_run.problem import build_problem as build_problem
from thincam_jax.design_run.ranking import FIND_STEPS as FIND_STEPS
from thincam_jax.design_run.ranking import Candidate as Candidate
from thincam_jax.design_run.ranking import Landscape as Landscape
from thincam_jax.design_run.ranking import Result as Result
from thincam_jax.design_run.ranking import find as find
from thincam_jax.design_run.simulate import simulate as simulate
from thincam_jax.design_run.simulated import build_study as build_study
from thincam_jax.design_run.simulated import check_design as check_design
from thincam_jax.design_run.simulated import full_well as full_well
