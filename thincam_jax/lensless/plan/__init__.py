"""Plans: the cheapest computation of a scene's capture within a tolerance."""

from thincam_jax.lensless.plan.effects import Effect as Effect
from thincam_jax.lensless.plan.make import plan as plan
from thincam_jax.lensless.plan.run import Plan as Plan
from thincam_jax.lensless.plan.run import run_plan as run_plan
