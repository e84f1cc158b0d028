"""Plans: the cheapest computation of a scene's capture within a tolerance."""

from thincam_jax.lensless.plan.make import plan as plan
