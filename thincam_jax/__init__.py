"""Simulate, reconstruct and design thin computational cameras, in JAX.

>>> import thincam_jax as tc
>>> from thincam_jax.units import nm, um
>>> mask = tc.FresnelZoneAperture(beta=25.0, phase=0.0, width=5.632)  # rad/mm², rad, mm
>>> camera = tc.LenslessCamera(mask, tc.Sensor((64, 96), 60 * um), distance=6.5)
>>> tc.psf(camera, wavelength=500 * nm, object_distance=250.0).shape
(64, 96)

Lengths are in millimetres, angles in radians, arrays (…, y, x). `help(tc.psf)` explains one name.

- cameras: `LenslessCamera`, `Mosaic`, `Sensor`; `waveguide.SeeThroughCamera`
- masks: `FresnelZoneAperture`, `ModifiedUniformlyRedundantArray`, `SeparableMask`, `Pinhole`,
  `RadialMask`, `LensletArray`, `PhaseMask`, `SampledMask`; own ones by
  `lensless.masks.AbstractFactoredMask`
- scenes: `ImagePlane`, `Scene`, `Spectrum`, `load_image`, `imaging.targets`
- simulation: `psf`, `otf`, `mtf`, `capture`, `record`, `field_operator`, `GaussianNoise`,
  `PoissonGaussianNoise`
- accuracy: `choose_model`, `predict_error`, `plan_capture`, `PsfMethod`
- reconstruction: `Recording` of `Cameras`, `Psfs` or operators; `reconstruct` by `Wiener`,
  `FringeScanning`, `AdmmTV`, `Fista`, `Ridge`, `PoissonTV` or `PlugAndPlay`; `Stream`
- calibration: `fit_psf`, `check_psf`, `refine`, `measured`
- experiments: `studies`, `design`, `learn`, `plot`, `explore`, `hardware`

The names stand in `__init__.pyi`. Each is imported at its first use: JAX takes a second to import,
which `thincam --help` need not wait for.
"""

import sys

from thincam_jax._core.names import lazy_face

# Without `__all__`, for which `help` would print every class in full.
_attribute, __dir__ = lazy_face(__name__)


def __getattr__(name: str):
    if name == "__version__":
        from importlib.metadata import version

        return version("thincam_jax")
    if "jax" not in sys.modules:
        from thincam_jax._core.program_cache import keep_programs

        keep_programs()
    return _attribute(name)
