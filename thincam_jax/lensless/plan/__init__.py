"""Plans: the cheapest computation of a scene's capture within a tolerance."""
