"""Figures of cameras, captures and results, as `tc.plot`, with axes in mm or cycles/mm.

Each function draws a figure of pyplot and returns it. A notebook shows it once, a script shows it
with `matplotlib.pyplot.show()` and keeps it with `figure.savefig("psf.png")`.

What reports show of a study, a refocusing, a screen, a rig, a sweep or a training is in the modules
of these names, such as `thincam_jax.waveguide.plot`; results draw their main figure by `plot()`.
"""

from thincam_jax._core.names import modules_of
from thincam_jax.plot.cameras import mask as mask
from thincam_jax.plot.cameras import otf as otf
from thincam_jax.plot.cameras import psf as psf
from thincam_jax.plot.images import capture as capture
from thincam_jax.plot.images import compare as compare
from thincam_jax.plot.objectives import front as front
from thincam_jax.plot.objectives import history as history
from thincam_jax.plot.objectives import landscape as landscape
from thincam_jax.plot.objectives import sensitivity as sensitivity

__getattr__ = modules_of(__name__)
