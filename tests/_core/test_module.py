"""What objects print: values of scalars with units, arrays by shape; also inside jit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.measured.calibration.psf_fit import PsfFit
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.units import nm, um

SENSOR = tc.Sensor((30, 41), 5.5 * um)
ZONES = tc.FresnelZoneAperture(25.0, width=5.632)
CAMERA = tc.LenslessCamera(ZONES, SENSOR, 6.5)
CELLS = tc.LenslessCamera(tc.SampledMask(np.ones((8, 9)), 30 * um), SENSOR, 6.5)
HOLOGRAM = wg.VolumeHologram(jnp.array([0.0, -15.0, 26e3]), 1.5, 16 * um, 0.02)
SCREEN = wg.Screen(hologram=HOLOGRAM, glass_thickness=5.0, glass_index=1.5)
ONE = jnp.asarray(1.0)
FIT = PsfFit(
    CAMERA,
    *(ONE,) * 4,
    values={"beta": jnp.asarray(25.1), "centre_x": jnp.asarray(3 * um)},
    standard_errors={},
    correlation=jnp.eye(2),
    residual=jnp.ones((3, 4)),
    names=("beta", "centre_x"),
    status="ok",
    reasons=(),
    iterations=1,
)


@pytest.mark.parametrize(
    ("built", "parts"),
    [
        (
            tc.Cameras([CAMERA], wavelength=500 * nm, object_distance=250.0),
            (
                "(beta=25 rad/mm², phase=0 rad, width=5.632 mm, centre=(0, 0) mm, ",
                "distance=6.5 mm",
                "Sensor(shape=(30, 41), pitch=5.5 µm, full_well=13500 electrons)",
                "wavelength=500 nm, object_distance=250 mm",
            ),
        ),
        (CELLS, ("SampledMask(amplitude=f64[8,9], pitch=30 µm",)),
        (
            wg.SeeThroughCamera(
                screen=SCREEN, sensor=SENSOR, focal_distance=6.0, lens_distance=10.0
            ),
            (
                "thickness=16 µm",
                "grating=(0, -15, 26000) rad/mm",
                "glass_thickness=5 mm",
                "focal_distance=6 mm, lens_distance=10 mm",
            ),
        ),
        (tc.GaussianNoise(snr_db=30.0), ("GaussianNoise(snr_db=30 dB, ",)),
        (
            tc.ImagePlane(np.ones((4, 5)), 250.0, 30.0),
            ("ImagePlane(image=f64[4,5], distance=250 mm, width=30 mm)",),
        ),
        (tc.Spectrum([500 * nm, 600 * nm]), ("(wavelengths=(500, 600) nm, weights=(0.5, 0.5))",)),
        (
            Reconstruction(jnp.ones((4, 5)), jnp.asarray(0.04), seconds=1.5),
            ("Reconstruction(image=f64[4,5], pitch=40 µm, seconds=1.5)",),
        ),
        (tc.AdmmTV(tau=2.0), ("AdmmTV(tau=2, ",)),
        (FIT, ("{'beta': 25.1 rad/mm², 'centre_x': 3 µm}", "correlation=f64[2,2]")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_values_have_units(built, parts):
    told = " ".join(repr(built).split()).replace("( ", "(").replace(" )", ")")
    for part in parts:
        assert part in told


def test_what_is_traced_has_no_value():
    seen = []
    jax.jit(lambda camera: seen.append(repr(camera)))(CAMERA)
    for part in (
        "beta=? rad/mm²",
        "centre=(?, ?) mm",
        "shape=(30, 41), pitch=? mm",
        "distance=? mm",
    ):
        assert part in seen[0]
