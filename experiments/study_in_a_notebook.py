"""A study in a notebook
=====================

Methods A and B of the thesis (section 3.5) beside the conventional method, without any file:
cameras, noisy captures, reconstructions, a table and pictures. Every number may be another one.
"""

# sphinx_gallery_thumbnail_path = "images/usaf-1951.png"

import os
from pathlib import Path

import thincam_jax as tc
from thincam_jax.units import um

SMALL = os.environ.get("THINCAM_SIZE") == "small"  # a quarter as wide, with zones as fine
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "study_in_a_notebook"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
part, count = (4, 128) if SMALL else (1, 512)
place = {"distance": 250.0, "width": 180.0 / part}  # of the targets, mm
chart = tc.studies.Target.usaf1951(**place, pixels=2 * count)
astronaut = tc.studies.Target.photograph("astronaut", **place)
study = tc.studies.superresolution(
    betas=(25.0 * part, 21.0 * part),
    sensor=tc.Sensor((count, count), 11 * um),
    targets=[chart, astronaut],
    noise=36.0,  # dB; a pixel has four times the area of the thesis'
)
result = study.run()
print(result.table())

# %%
for name in ("USAF-1951", "astronaut"):
    result.plot(name).savefig(FIGURES / f"{name}.png", dpi=110)
result.plot_responses().savefig(FIGURES / "responses.png", dpi=110)

# %%
# Method A gains more than 2 dB over the distances that it joins. `configs/quick.yaml` is the same
# study as a file.

scores = result.scores.methods
near, far, method_a, _ = (s.mean_psnr_of_pictures_db for s in scores.values())
assert method_a > max(near, far) + 2
