"""The study of super-resolution of the thesis, section 3.5.1."""

from collections.abc import Sequence
from dataclasses import replace

from thincam_jax._core.arguments import checked
from thincam_jax._core.precision import decimal_value
from thincam_jax.imaging.sensor import AbstractNoise, GaussianNoise, Sensor
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.wiener import Wiener
from thincam_jax.studies.study import Method, Published, Study, Target
from thincam_jax.units import nm, um

# Not given in the thesis; follows from its zero at 12.4 cycles/mm (Eq 3.32).
_WAVELENGTH = 500 * nm
_OBJECT_DISTANCE, _OBJECT_WIDTH = 250.0, 180.0
_PICTURES = ("astronaut", "chelsea", "coffee")
# PSNR, dB, resolved line pair, mm, and limit, cycles/mm, in the order of the methods.
_PUBLISHED = (
    Published(20.3, 4.6, 10.8),
    Published(20.4, 3.2, 12.4),
    Published(23.4, 1.6, 22.9),
    Published(23.8, 0.71, 57.5),
)


@checked
def superresolution(
    *,
    betas: tuple[float, float] = (25.0, 21.0),
    distances: tuple[float, float] = (5.0, 6.5),
    sensor: Sensor | None = None,
    targets: Sequence[Target] | None = None,
    noise: AbstractNoise | float | int | None = 30.0,
    seed: int = 0,
) -> Study:
    """The conventional method at two distances beside methods A and B, as the thesis compares them.

    **Arguments**

    - `betas`: β₁ of all methods and β₂ of method B's second pair, rad/mm².
    - `distances`: mask to sensor, mm: both of method A, the second of method B.
    - `sensor`: default 1024 × 1024 pixels of 5.5 µm. The masks are as wide as it is.
    - `targets`: default the USAF-1951 chart and three photographs, 180 mm wide at 250 mm.
    - `noise`: a number is the ratio of the captures' variance to that of Gaussian noise, dB; the
      thesis does not say which power its 30 dB refer to. None leaves noise out.

    ```python
    import thincam_jax as tc

    study = tc.studies.superresolution(betas=(25.0, 20.0))
    print([method.name for method in study.methods][2:])  # ['method A', 'method B']
    ```

    **See also**: `configs/fza_superresolution.yaml`, the same as a file.
    """
    sensor = Sensor((1024, 1024), 5.5 * um) if sensor is None else sensor
    if targets is None:
        place = _OBJECT_DISTANCE, _OBJECT_WIDTH
        targets = [Target.usaf1951(*place), *(Target.photograph(p, *place) for p in _PICTURES)]
    if isinstance(noise, float | int):
        noise = GaussianNoise(noise, "without_mean")
    width = sensor.shape[1] * decimal_value(sensor.pitch)
    light = {"wavelength": _WAVELENGTH, "width": width}
    near, far = distances
    conventional = (
        Method(
            f"conventional, d = {distance:.1f} mm",
            Exposures(betas[0], distance, **light).fringe_scanned(),
            FringeScanning(),
            "fringe_scanning",
        )
        for distance in (near, far)
    )
    scanned = Exposures(betas[0], distances, **light).fringe_scanned()
    pairs = Exposures(betas, far, **light).phase_pairs()
    methods = (
        *conventional,
        Method("method A", scanned, Wiener(), "fringe_scanning"),
        Method("method B", pairs, Wiener(), "phase_pairs"),
    )
    return Study(
        FresnelZoneAperture(betas[0], width=width),
        sensor,
        tuple(replace(m, published=p) for m, p in zip(methods, _PUBLISHED, strict=True)),
        tuple(targets),
        object_distance=targets[0].distance,
        noise=noise,
        seed=seed,
        name="fza_superresolution",
    )
