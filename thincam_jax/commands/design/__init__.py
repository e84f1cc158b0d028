"""From a design's file to designs found, and what the full simulation says of them."""

from thincam_jax.commands.design.landscape import Landscape as Landscape
from thincam_jax.commands.design.landscape import landscape_of as landscape_of
from thincam_jax.commands.design.pareto import Front as Front
from thincam_jax.commands.design.pareto import Fronts as Fronts
from thincam_jax.commands.design.pareto import Point as Point
from thincam_jax.commands.design.pareto import find_fronts as find_fronts
from thincam_jax.commands.design.pareto import pareto_steps as pareto_steps
from thincam_jax.commands.design.problem import Goal as Goal
from thincam_jax.commands.design.problem import broken_limits as broken_limits
from thincam_jax.commands.design.problem import build_problem as build_problem
from thincam_jax.commands.design.ranking import Candidate as Candidate
from thincam_jax.commands.design.ranking import Result as Result
from thincam_jax.commands.design.ranking import find as find
from thincam_jax.commands.design.ranking import find_steps as find_steps
from thincam_jax.commands.design.simulated import build_study as build_study
from thincam_jax.commands.design.simulated import check_design as check_design
from thincam_jax.commands.design.train import TrainingGoal as TrainingGoal
from thincam_jax.commands.design.transfer import Transfer as Transfer
from thincam_jax.commands.design.transfer import modulation_transfer as modulation_transfer
