r"""The conventional reconstruction: fringe scanning and the geometric inverse filter."""

import math
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.grids import Grid, fast_shape, same_parity
from thincam_jax._core.precision import as_complex, phasor, turn_phasor
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.solver import AbstractSolver
from thincam_jax.reconstruction.wiener import each_image, require_cameras, require_captures


class FringeFilter(eqx.Module):
    r"""Captures of four phases, or of two in quadrature, and the inverse of the mask's shadow.

    .. math::
        G_{FS} = j\,(G_0 - G_\pi) + (G_{3\pi/2} - G_{\pi/2}),\qquad
        \hat F = G_{FS}\, \frac{\beta'}{\pi} \exp(-j\pi^2\rho^2/\beta'),\quad \beta' = \beta/M^2

    (thesis Eq 3.14-3.17 with the dropped factor π/β and the magnification M restored). It neglects
    diffraction, and so the zeros of cos(πλdρ²/…) are missing frequencies. Where the filter's chirp
    turns by more than π between frequencies of the padded window it is set to zero; for a mask no
    larger than the sensor these frequencies hold only noise.

    Of two phases, 0 and 3π/2, it is
    :math:`G = 2j\,[(G_0 - \bar G_0) - j\,(G_{3\pi/2} - \bar G_{3\pi/2})]`, with +j for 0 and π/2.
    Only the mean of the background is subtracted, while four phases cancel all of it: good for few
    bright objects on black, not for a bright field; use `AdmmTV` for that.

    **Arguments**: `cameras`, of one sensor, distance and β, with the phases 0, π/2, π, 3π/2, or 0
    and one of π/2 and 3π/2, in any order, that of the captures. Their wavelength is not used.
    The parts of a `Mosaic`, whose shadows lie elsewhere on each, are brought together first.
    """

    inverse: Complex[Array, "#capture v u"]
    weights: Complex[Array, " capture"]
    light: Float[Array, "m n"]
    object_pitch: Float[Array, ""]
    sensor_shape: tuple[int, int] = eqx.field(static=True)
    field_shape: tuple[int, int] = eqx.field(static=True)

    def __init__(self, cameras: Cameras):
        cameras.require("object_distance")
        (beta, weights), found = _check_phases(cameras.cameras), cameras.cameras
        camera = found[0]
        sensor = camera.sensor.grid
        self.sensor_shape = sensor.shape
        self.field_shape = same_parity(cameras.pixels or sensor.shape, sensor.shape)
        sizes = zip(sensor.shape, self.field_shape, strict=True)
        rows, columns = (s + max(s, f) for s, f in sizes)
        padded = fast_shape((rows, columns))
        object_distance = checks.positive("object_distance", cameras.object_distance, "mm")
        grid, ratio = Grid(padded, sensor.pitch), (camera.distance, object_distance)
        shadows = np.stack([_shadow(c, np.asarray(object_distance)) for c in found])
        if (shadows == shadows[0]).all():
            shadows = shadows[:1]  # one filter for all
        self.inverse = _inverse_filter(grid, beta, ratio, shadows)
        self.weights = checks.as_array(weights.astype(self.inverse.dtype))
        self.light = cameras.light(self.field_shape).astype(sensor.pitch.dtype)
        self.object_pitch = cameras.pitch

    def __call__(self, captures: Numbers) -> Reconstruction:
        """The reconstruction of captures (capture, *batch, y, x), in the order of the cameras."""
        known = checks.at_hand(captures, self.object_pitch.dtype)
        require_captures(known.shape, (len(self.weights), *self.sensor_shape))
        count, *batch, rows, columns = known.shape
        image = each_image(self._image, known.reshape(count, -1, rows, columns))
        image = image.reshape(*batch, *self.field_shape)
        return Reconstruction(image, self.object_pitch, "fringe_scanning")

    @eqx.filter_jit
    def _image(self, captures: Float[Array, "capture y x"]) -> Float[Array, "m n"]:
        # Four phases cancel the whole background if all have it in one place, others its mean.
        if len(self.weights) == 2 or len(self.inverse) > 1:
            captures = captures - jnp.mean(captures, axis=(1, 2), keepdims=True)
        scanned = self.weights[:, None, None] * as_complex(captures)
        if len(self.inverse) == 1:
            scanned = jnp.sum(scanned, axis=0, keepdims=True)
        padded = self.inverse.shape[1:]
        margins = [(0, p - s) for p, s in zip(padded, self.sensor_shape, strict=True)]
        spectrum = jnp.fft.fft2(jnp.pad(scanned, [(0, 0), *margins])) * self.inverse
        full = jnp.fft.ifft2(jnp.sum(spectrum, axis=0)).real
        # Sample j of the field is sample j + (sensor − field)/2 of the sensor.
        shift = [(f - s) // 2 for f, s in zip(self.field_shape, self.sensor_shape, strict=True)]
        field = jnp.roll(full, shift, axis=(0, 1))[: self.field_shape[0], : self.field_shape[1]]
        return field[::-1, ::-1] / self.light


class FringeScanning(AbstractSolver):
    """The conventional geometric inverse of two or four phases, see `FringeFilter`; for comparison.

    It needs `Cameras`; neither noise nor wavelength is used.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    masks = [tc.FresnelZoneAperture(25.0, phase, width=1.6) for phase in (0.0, 4.712)]
    cameras = [tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), 5.0) for mask in masks]
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    optics = tc.Cameras(cameras, wavelength=500 * nm, object_distance=250.0)
    recording = tc.Recording([tc.capture(camera, scene) for camera in cameras], optics)
    result = tc.reconstruct(recording, tc.FringeScanning())
    ```

    **See also**: `Wiener`, `lensless.phase_shift.fringe_scanned_otf`.
    """

    name: ClassVar[str] = "fringe_scanning"

    def prepare(self, cameras: Cameras) -> FringeFilter:
        """The filter of these cameras, a function of the captures."""
        return FringeFilter(cameras)

    def solve(self, recording: Recording):
        return self.prepare(require_cameras(recording, self.name))(jnp.stack(recording.light))


def _shadow(camera: LenslessCamera, object_distance: np.ndarray) -> Float[np.ndarray, "2"]:
    """Middle (y, x) of the shadow of a point of the scene's axis on the camera's sensor, mm."""
    reach = np.asarray(camera.distance) / object_distance
    aside = 0.0 if camera.place is None else reach * np.asarray(camera.place)
    return (1 + reach) * np.asarray(camera.mask.centre) + aside


@jax.jit
def _inverse_filter(grid: Grid, beta, distances, shadows) -> Complex[Array, "n v u"]:
    """(β'/π)·exp(−jπ²ρ²/β') where the window samples it, else zero; for each shadow's middle."""
    distance, object_distance = distances
    magnification = 1 + distance / object_distance
    beta = beta / magnification**2
    v, u = jnp.fft.ifftshift(grid.v)[:, None], jnp.fft.ifftshift(grid.u)
    sampled = (jnp.abs(v) < beta * grid.shape[0] * grid.pitch / (2 * jnp.pi)) & (
        jnp.abs(u) < beta * grid.shape[1] * grid.pitch / (2 * jnp.pi)
    )
    gain = jnp.where(sampled, beta / jnp.pi, 0.0)
    filtered = phasor(-(jnp.pi**2) * (u**2 + v**2) / beta)
    down, right = shadows.T[:, :, None, None]
    return gain.astype(filtered.dtype) * filtered * turn_phasor(v * down + u * right)


def _check_phases(
    cameras: Sequence[LenslessCamera],
) -> tuple[Float[Array, ""], Complex[np.ndarray, " capture"]]:
    """β, and the weight j·e^{jφ} of each capture, twice that where there are two."""
    count = len(cameras)
    masks = [c.mask for c in cameras if isinstance(c.mask, FresnelZoneAperture)]
    if count not in (2, 4) or len(masks) != count:
        raise ValueError(
            "fringe scanning takes four cameras with a FresnelZoneAperture, or two in quadrature; "
            f"got {count}"
        )
    phases = np.array([float(m.phase) for m in masks])
    quarters = np.round(phases / (math.pi / 2))
    found = sorted(int(q) for q in quarters % 4)
    is_near = np.abs(phases - quarters * math.pi / 2).max() < 1e-3
    if not is_near or found not in ([0, 1, 2, 3], [0, 1], [0, 3]):
        raise ValueError(
            f"phases are {np.round(phases, 4).tolist()} rad; give 0, π/2, π, 3π/2, or 0 and one of "
            "π/2 and 3π/2"
        )
    settings = {
        (float(c.distance), c.sensor.shape, float(c.sensor.pitch)) + _fixed_numbers(m)
        for c, m in zip(cameras, masks, strict=True)
    }
    if len(settings) > 1:
        raise ValueError(
            "the cameras differ in distance, sensor or mask; make them equal in all but the phase"
        )
    return masks[0].beta, 4 / count * 1j * np.array([1, 1j, -1, -1j])[(quarters % 4).astype(int)]


def _fixed_numbers(mask: FresnelZoneAperture) -> tuple:
    numbers = mask.beta, *mask.extent, mask.fill_factor
    return *(float(n) for n in numbers), mask.profile, mask.harmonics, mask.pixels
