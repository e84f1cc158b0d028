"""A study of a second, built in Python: that of tests/commands/study/tiny.py, which is a file.

48×64 pixels of 40 µm (Nyquist 12.5 cycles/mm), a mask of 2 mm whose zones end at βR/π = 8.0
cycles/mm, an object of 80 mm at 100 mm that fills 60 of the 64 columns at d = 3.0 mm.
"""

from dataclasses import replace
from typing import Any

import numpy as np

import thincam_jax as tc
from thincam_jax.studies import Method, Study, Target
from thincam_jax.studies.study import Published
from thincam_jax.units import nm, um

LIGHT: dict[str, Any] = {"wavelength": 500 * nm, "width": 2.0}


def picture() -> np.ndarray:
    """Blobs in colour, 45×60, no symmetry."""
    y, x = np.mgrid[:45, :60]
    image = np.full((45, 60, 3), 0.2)
    for channel, (row, column) in enumerate([(12, 15), (30, 40), (20, 45)]):
        image[..., channel] += 0.7 * np.exp(-((y - row) ** 2 + (x - column) ** 2) / 60)
    return np.round(image * 255).astype(np.uint8)


def methods() -> tuple[Method, ...]:
    scanned = tc.Exposures(25.0, 3.0, **LIGHT).fringe_scanned()
    pairs = tc.Exposures([25.0, 21.0], 3.0, **LIGHT).phase_pairs()
    return (
        Method(
            "conventional",
            scanned,
            tc.FringeScanning(),
            "fringe_scanning",
            published=Published(20.3, 4.6, 10.8),
        ),
        Method("pairs", pairs, tc.Wiener(), "phase_pairs"),
    )


def study(**changes: Any) -> Study:
    given: dict[str, Any] = {
        "mask": tc.FresnelZoneAperture(25.0, width=2.0),
        "sensor": tc.Sensor((48, 64), 40 * um),
        "methods": methods(),
        "targets": (
            replace(Target.usaf1951(100.0, 80.0, 120), name="chart"),
            Target.of_image("picture", picture() / 255, 100.0, 80.0),
        ),
        "object_distance": 100.0,
        "noise": tc.GaussianNoise(30.0, "without_mean"),
        "model": "geometric",  # it compiles fastest
        "pixel_integration": False,
        "seed": 3,
        "name": "tiny",
    }
    return Study(**(given | changes))
