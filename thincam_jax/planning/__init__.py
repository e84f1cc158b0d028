"""Plans: the cheapest computation of a scene's capture within a tolerance."""

from thincam_jax.planning.make import plan as plan
from thincam_jax.planning.plan import Effect as Effect
from thincam_jax.planning.plan import Plan as Plan
from thincam_jax.planning.run import run_plan as run_plan
