"""A camera designed in a notebook
===============================

Two masks of a thin camera, without any file: which β are best, how exactly must they be made,
what does the objective look like around them, and what does thickness buy?
"""

# sphinx_gallery_thumbnail_path = "images/design-landscape.png"

import os
from pathlib import Path

import jax

import thincam_jax as tc
from thincam_jax import design
from thincam_jax.reconstruction import phase_pairs
from thincam_jax.units import deg, nm, um

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "design_in_a_notebook"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# A camera, and what is free
# --------------------------
#
# A sensor 2 mm wide sees an object of 60 mm at 100 mm; each mask is shown with two phases. The β
# of either mask and the distance to the sensor, which both share, may be chosen.

setup = design.Setup(20 * um, sensor_width=2.0, object_distance=100.0, object_width=60.0)
base = design.shots((25.0, 21.0), 3.0, (0.0, 270 * deg), wavelength=500 * nm, width=2.0)
betas = [design.Variable("beta", 12.0, 60.0, captures) for captures in ((0, 1), (2, 3))]
distance = design.Variable("distance", 2.0, 3.0, (0, 1, 2, 3))
space = design.DesignSpace(base, (betas[0], distance, betas[1]))
problem = design.design_problem(design.BayesError(), space, setup, phase_pairs(2))

# %%
# The best design, and how exactly it must be made
# ------------------------------------------------
#
# The tolerance of a number is the change that makes the expected error 1 % worse.

settings = design.SearchSettings(1, 8) if SMALL else design.SearchSettings(2, 32)
best = design.find_designs(problem, settings, key=jax.random.key(0)).found[0]
tolerances = design.sensitivity_around(problem, best)
print(tolerances)
tc.plot.sensitivity(tolerances).savefig(FIGURES / "sensitivity.png")

# %%
# The objective over β and the distance, the other β held
# -------------------------------------------------------

landscape = design.landscape_around(problem, best.design, 21 if SMALL else 61)
figure = landscape.plot({"start": base, "found": best.design})
figure.savefig(FIGURES / "landscape.png")

# %%
# What thickness buys: the best design for each
# ---------------------------------------------

thin = {d: problem.with_thickness(d) for d in ((2.0, 3.0) if SMALL else (2.0, 2.5, 3.0))}
front = design.find_front(thin, settings, key=jax.random.key(0))
figure = tc.plot.front(front, "longest distance (mm)")
figure.savefig(FIGURES / "front.png", dpi=110)
