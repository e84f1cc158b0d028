"""A study and a design in a notebook
==================================

In 25 lines, without any file: methods A and B of the thesis (section 3.5) with their table and
pictures; then two masks of a thin camera: which β are best, how exactly they must be made, what
the objective looks like around them, and what thickness buys. Every number may be another one.
"""

import os

import jax

import thincam_jax as tc
from thincam_jax.reconstruction import phase_pairs
from thincam_jax.units import deg, nm, um

# %%
# The study: cameras, noisy captures, reconstructions
# ---------------------------------------------------
#
# The noise is 6 dB less than the thesis', whose pixels have a quarter of the area.
# `configs/quick.yaml` is the same study as a file.

part, count = (4, 128) if os.environ.get("THINCAM_SIZE") == "small" else (1, 512)
betas, sensor = (25.0 * part, 21.0 * part), tc.Sensor((count, count), 11 * um)
at = {"distance": 250.0, "width": 180.0 / part}  # of the targets, mm
targets = [tc.studies.Target.usaf1951(**at), tc.studies.Target.photograph("astronaut", **at)]
result = tc.studies.superresolution(betas=betas, sensor=sensor, targets=targets, noise=36.0).run()
print(result.table())
pictures = [result.plot(target.name) for target in targets]

# %%
# The best β of both masks and distance to the sensor
# ---------------------------------------------------
#
# A sensor 2 mm wide sees an object of 60 mm at 100 mm; each mask is shown with two phases. The
# tolerance of a number is the change that makes the expected error 1 % worse.

setup = tc.design.Setup(20 * um, sensor_width=2.0, object_distance=100.0, object_width=60.0)
base = tc.design.shots((25.0, 21.0), 3.0, (0.0, 270 * deg), wavelength=500 * nm, width=2.0)
free = [tc.design.Variable("beta", 12.0, 60.0, captures) for captures in ((0, 1), (2, 3))]
space = tc.design.DesignSpace(base, (*free, tc.design.Variable("distance", 2.0, 3.0, (0, 1, 2, 3))))
problem = tc.design.design_problem(tc.design.BayesError(), space, setup, phase_pairs(2))
search, key = tc.design.SearchSettings(starts=2, samples=16), jax.random.key(0)
best = tc.design.find_designs(problem, search, key=key).found[0]
tolerances = tc.plot.sensitivity(tc.design.sensitivity_around(problem, best))

# %%
# The objective over both β, and the best design of each thickness
# ----------------------------------------------------------------

marked = {"start": base, "found": best.design}
landscape = tc.design.landscape_around(problem, best.design, count=31).plot(marked)
thin = {distance: problem.with_thickness(distance) for distance in (2.0, 2.5, 3.0)}
front = tc.design.find_front(thin, search, key=key)
curve = tc.plot.front(front, "longest distance (mm)")
