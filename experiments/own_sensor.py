"""Which masks for a sensor of your own?
=====================================

Two zone plates before a sensor: which pitches β, and how far from it? Here you give the number and
the size of its pixels, and have an answer in seconds, with the range within which it does not
matter, and beside it the pair of the thesis and as many random designs.

Lengths are in mm, β in rad/mm².
"""

import os
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.units import um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer pixels
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "own_sensor"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The sensor, and the distances that your housing allows
# -------------------------------------------------------
#
# Seconds do not grow with the pixels: the same number of frequencies is looked at.

shape, pitch = {"full": ((1500, 2000), 3.45 * um), "small": ((60, 80), 40 * um)}[SIZE]
sensor = tc.Sensor(shape, pitch)
found = tc.design.for_sensor(sensor, distance=(3, 10))
print(found)

# %%
# How flat it is
# --------------
#
# The expected error over both pitches, at the distance found, in the double precision of the
# search. A mask within the plateau is as good.

with jax.enable_x64(True):
    landscape = tc.design.landscape_around(found.problem, found.best.design, count=25)
figure = landscape.plot({"thesis": found.problem.space.base, "found": found.best.design})
figure.savefig(FIGURES / "landscape.png", dpi=100)
plt.show()

# %%
# The masks
# ---------
#
# The first mask of each pitch. Simulate what is found, for the expected error knows nothing of a
# reconstruction that suffers at the sensor's border. ``thincam init design --sensor 1500x2000
# --pitch 3.45um`` writes a file that does all of it.

figure, panels = plt.subplots(2, 1, figsize=(7.6, 5.0), layout="constrained", squeeze=False)
for panel, camera in zip(panels[:, 0], found.best.design.cameras(sensor)[::2], strict=True):
    beta, width = float(camera.mask.beta), float(camera.mask.width)
    x = np.linspace(-width / 2, width / 2, 2001)
    panel.plot(x, (1 + np.cos(beta * x**2)) / 2)
    panel.set(xlabel="x on the mask, mm", ylabel="transmission", title=f"{beta:.2f} rad/mm²")
figure.savefig(FIGURES / "masks.png", dpi=100)
plt.show()
