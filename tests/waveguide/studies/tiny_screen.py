"""A screen study of seconds: ERRATA's plate, 8×16 cells, 22×30 large pixels.

`tests/waveguide/commands/tiny.py` has it as a file.
"""

from typing import Any

import jax.numpy as jnp

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.targets import middle_square, resize, sample_image, siemens_star
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.studies.calibration import Calibration
from thincam_jax.waveguide.studies.screen import ScreenModel, ScreenStudy

CELLS = (8, 16)
MODELS = (
    ScreenModel("right"),
    ScreenModel("convolution", "shift_invariant"),
    ScreenModel("single", "no_ghosts", glass_thickness=5.2),
)
CALIBRATION = Calibration(
    bits=10,
    offset=20.0,
    noise_std=1.0,
    glass_thickness=5.3,
    fitted=("glass_thickness",),
    distances=(450.0,),
)


def camera(wavelength: float = 532 * nm, tilt: Any = None) -> wg.SeeThroughCamera:
    hologram = wg.VolumeHologram.record(
        wavelength, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    bottom = wg.Rectangle(jnp.asarray([25.0, 0.0]), jnp.asarray([50.0, 400.0]))
    screen = wg.Screen(hologram, 5.0, 1.5, bottom=bottom)
    return wg.SeeThroughCamera(screen, tc.Sensor((22, 30), 70.4 * um), 6.0, 10.0, tilt=tilt)


def study(*cameras: wg.SeeThroughCamera, **changed: Any) -> ScreenStudy:
    """The study with other cameras, or with other fields changed."""
    star = resize(siemens_star((40, 40)), CELLS)
    photograph = sample_image("camera", linear=True)
    photograph = middle_square(photograph, round(0.6 * min(photograph.shape)))
    targets = {"star": (star > star.mean()).astype(float), "camera": resize(photograph, CELLS)}
    fields: dict[str, Any] = {
        "cameras": cameras or (camera(),),
        "plane": wg.ObjectPlane(CELLS, 550.0, 120.0, jnp.asarray([27.0, 0.0])),
        "targets": targets,
        "noise": tc.GaussianNoise(40.0),
        "solvers": {"CGM": tc.Ridge(1.0), "smooth": tc.Ridge(3.0)},
        "models": MODELS,
        "orders": 3,
        "band_samples": 3,
        "recording_angles": (0.0, 61.2 * deg),
        "seed": 1,
        "name": "tiny-screen",
    }
    return ScreenStudy(**(fields | changed))
