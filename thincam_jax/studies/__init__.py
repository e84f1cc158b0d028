"""Studies in memory: simulated captures, their reconstructions, and how good these are."""
