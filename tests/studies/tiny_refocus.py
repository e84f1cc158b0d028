"""A refocusing study of a few seconds: the small camera, two charts at 20 and 45 mm.

`tests/commands/refocus/tiny.py` has it as a file.
"""

import thincam_jax as tc
from thincam_jax.imaging.targets import siemens_star
from thincam_jax.studies import Method, Study
from thincam_jax.studies.refocus import FocusRange, RefocusStudy, SceneObject
from thincam_jax.units import nm, um

SWEEP = FocusRange("wiener", nearest=15.0, farthest=90.0, count=13, window=3.0)


def objects() -> list[SceneObject]:
    star = siemens_star((64, 64))
    near = SceneObject("near", star, distance=20.0, width=2.4, x=-1.9)
    return [near, SceneObject("far", star, distance=45.0, width=5.4, x=4.0, y=0.4)]


def cameras() -> Study:
    scanned = tc.Exposures(80.0, 5.0, wavelength=500 * nm, width=1.92).fringe_scanned()
    return Study(
        mask=tc.FresnelZoneAperture(80.0, width=1.92),
        sensor=tc.Sensor((96, 112), 20 * um),
        methods=(
            Method("conventional", scanned, tc.FringeScanning(), "fringe_scanning"),
            Method("wiener", scanned, tc.Wiener(), "fringe_scanning"),
        ),
        noise=tc.GaussianNoise(30.0, "without_mean"),
        model="geometric",  # it compiles fastest
        pixel_integration=False,
        seed=2,
        name="tiny-refocus",
    )


def study() -> RefocusStudy:
    return RefocusStudy.of_objects(cameras(), objects(), SWEEP)
