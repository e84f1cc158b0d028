r"""`rayleigh_sommerfeld`: the direct sum, slow and without approximation but its samples."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from thincam_jax._core.grids import Grid, block_mean
from thincam_jax._core.precision import squared_modulus, turn_phasor
from thincam_jax.lensless.camera import ChiefRay, LightPath
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.propagation.angular_spectrum import lit_mask, planes, within

# Sensor samples done together: bounds the memory to this many copies of the mask plane.
_BATCH = 64


def rayleigh_sommerfeld_field(
    field: Complex[Array, "v u"],
    plane: Grid,
    sensor: Grid,
    path: LightPath,
    ray: ChiefRay | None = None,
) -> Complex[Array, "y x"]:
    r"""First Rayleigh-Sommerfeld integral as a midpoint sum over the samples of the mask plane.

    .. math::
        U(\mathbf r) = \frac{1}{2\pi}\sum U_0(\pmb\xi)\,\frac dR
            \Big(\frac1R - jk\Big)\frac{e^{jk(R-d)}}{R}\,\Delta^2,\qquad
        R = \sqrt{d^2 + |\mathbf r-\pmb\xi|^2}

    with the piston e^{jkd} dropped and R − d formed as ρ²/(R+d). Right while neighbouring samples
    of the summand differ by less than half a turn: Δ·(ν + ρ/(λR)) < ½ for a field of local
    frequency ν. Work and time grow with the product of both planes' samples.

    With a `ray` the field is without its carrier, and R is counted from the ray's,
    R − D − s·u for its length D = d/c and u from where it would pass.
    """
    d, wavelength = path.distance, path.wavelength
    wavenumber = 2 * jnp.pi / wavelength

    def at(point):
        y, x = point[0] - plane.y[:, None], point[1] - plane.x
        distance = jnp.sqrt(d**2 + y**2 + x**2)
        if ray is None:
            turns = (y**2 + x**2) / (distance + d) / wavelength
        else:
            turns = _behind_ray(ray, d, y, x, distance) / wavelength
        scale = d / distance**2 * plane.pitch**2 / (2 * jnp.pi)
        kernel = jax.lax.complex(scale / distance, -wavenumber * scale)
        return jnp.sum(field * kernel * turn_phasor(turns))

    y, x = jnp.meshgrid(sensor.y, sensor.x, indexing="ij")
    points = jnp.stack([y.ravel(), x.ravel()], axis=-1) + path.moved
    return jax.lax.map(at, points, batch_size=_BATCH).reshape(sensor.shape)


def _behind_ray(ray: ChiefRay, d, y, x, distance):
    """R − D − s·u, mm, without what cancels."""
    length = d / ray.cosine
    y, x = y - length * ray.down, x - length * ray.across
    along, squared = ray.down * y + ray.across * x, y**2 + x**2
    total = distance + length
    return (squared - along * (2 * length * along + squared) / total) / total


def rayleigh_sommerfeld(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> Float[Array, "y x"]:
    """PSF of any mask by direct summation: the reference for tests and small grids.

    Arguments as for `angular_spectrum`; only the mask plane is oversampled for the point-sampled
    PSF, both planes are for pixel averages.
    """
    plane, fine = planes(grid, method)
    sensor = fine if method.pixel_integration else grid
    field = rayleigh_sommerfeld_field(
        lit_mask(within(mask, plane), plane, path), plane, sensor, path, path.chief_ray(mask.centre)
    )
    irradiance = squared_modulus(field) * path.magnification**2
    return block_mean(irradiance, method.samples) if method.pixel_integration else irradiance
