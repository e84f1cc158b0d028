r"""Families of phase masks: the random diffuser and the Voronoi-Fresnel lenses."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import fast_shape
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.precision import as_complex
from thincam_jax._core.random import Key, random_key
from thincam_jax.lensless.masks.phase import MaskBlank, PhaseMask

# Correlation lengths beyond the map, so that its opposite rims know nothing of each other.
_APART = 4.0


@checked
def diffuser(
    key: Key, blank: MaskBlank, *, correlation_length: Number, rms_slope: Number
) -> PhaseMask:
    r"""A diffuser: Gaussian random heights, between whose samples is interpolated.

    Their autocovariance is :math:`\sigma^2 e^{-r^2/\ell^2}`, so that the slope along an axis has
    the root mean square :math:`s = \sqrt2\,\sigma/\ell`: it bends light by about (n − 1)s. Its
    bumps have the rms curvature :math:`2\sqrt3\,\sigma/\ell^2`, and caustics are sharp near their
    focal length :math:`\ell/[\sqrt6\,(n-1)s]`.

    - `key`: key of `jax.random`, or a seed.
    - `correlation_length`: ℓ, mm, at least two cells.
    - `rms_slope`: s along an axis, dimensionless. The lowest height is 0.

    ```python
    from thincam_jax.lensless.masks import MaskBlank
    from thincam_jax.lensless.masks.reliefs import diffuser
    from thincam_jax.units import um

    blank = MaskBlank((24, 32), pitch=10 * um, material=1.5)
    mask = diffuser(0, blank, correlation_length=50 * um, rms_slope=0.03)
    print(mask.height.shape)  # (24, 32)
    ```

    **See also**: `PhaseMask`, `lensless.masks.reliefs.voronoi_fresnel`.
    """
    length = checks.positive("correlation_length", correlation_length, "mm")
    slope = checks.positive("rms_slope", rms_slope, "a ratio")
    cells = float(length / blank.pitch)
    if cells < 2:
        raise ValueError(
            f"correlation_length = {float(length):g} mm is {cells:.2g} cells of the blank; give at "
            f"least {2 * float(blank.pitch):g} mm, or smaller cells"
        )
    rows, columns = (n + int(np.ceil(_APART * cells)) for n in blank.shape)
    needed = 32 * rows * columns
    refuse_if_too_large("this diffuser", needed, "give a shorter correlation_length")
    window = fast_shape((rows, columns))
    v, u = (jnp.asarray(np.fft.fftfreq(n), length.dtype) / blank.pitch for n in window)
    # A Gaussian of width ℓ/√2 convolved with itself has the width ℓ.
    kernel = jnp.exp(-((jnp.pi * length) ** 2) * (v[:, None] ** 2 + u**2) / 2)
    kernel = kernel / jnp.sqrt(jnp.mean(kernel**2))
    noise = jax.random.normal(random_key(key), window, length.dtype)
    height = jnp.real(jnp.fft.ifft2(jnp.fft.fft2(noise) * as_complex(kernel)))
    height = height[: blank.shape[0], : blank.shape[1]] * (slope * length / jnp.sqrt(2.0))
    return blank.mask(height - jnp.min(height), "bilinear")


@checked
def voronoi_fresnel(
    key: Key,
    blank: MaskBlank,
    *,
    sites: int,
    focal_length: Number,
    wavelength: Number,
    relaxations: int = 20,
) -> PhaseMask:
    r"""Fresnel lenses in Voronoi cells, every one focused on the sensor (Fu et al., 2022).

    The cell of the site s holds the phase :math:`-\frac{2\pi}\lambda(\sqrt{|r-s|^2+f^2}-f)`,
    wrapped to one turn, 0 ≤ h < λ/(n − 1). Lloyd's relaxation moves random sites to the
    centroids of their cells: these become even in size and round, and the PSF a set of equal,
    unevenly spaced points (Optics Express 30, 45807).

    - `key`: key of `jax.random`, or a seed. `sites`: number of lenses. `relaxations`: steps of
      Lloyd's.
    - `focal_length`: f, mm: the mask-sensor distance for far objects.
    - `wavelength`: wavelength that the lenses are designed for, mm.

    **Sampling.** The rim of a lens turns the phase by r/(λf) cycles/mm, which the cells hold up to
    1/(2 pitch): lenses that reach farther are refused.

    ```python
    from thincam_jax.lensless.masks import MaskBlank
    from thincam_jax.lensless.masks.reliefs import voronoi_fresnel
    from thincam_jax.units import nm, um

    blank = MaskBlank((24, 32), pitch=10 * um, material=1.5)
    mask = voronoi_fresnel(0, blank, sites=3, focal_length=6.0, wavelength=550 * nm)
    ```

    **See also**: `PhaseMask`, `LensletArray`.
    """
    if not 1 <= sites <= blank.shape[0] * blank.shape[1]:
        raise ValueError(f"sites = {sites}; give 1 to the number of cells of the blank")
    focal_length = checks.positive("focal_length", focal_length, "mm")
    light = checks.wavelength("wavelength", wavelength)
    y, x = (np.asarray(a, float) for a in (blank.grid.y, blank.grid.x))
    cells = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    half = np.array(blank.shape) * float(blank.pitch) / 2
    places = jax.random.uniform(random_key(key), (sites, 2), minval=-1.0, maxval=1.0)
    places = np.asarray(places) * half
    for _ in range(relaxations):
        owner = scipy.spatial.KDTree(places).query(cells)[1]
        count = np.bincount(owner, minlength=sites)[:, None]
        sums = [np.bincount(owner, cells[:, axis], sites) for axis in (0, 1)]
        places = np.where(count > 0, np.stack(sums, axis=-1) / np.maximum(count, 1), places)
    squared = scipy.spatial.KDTree(places).query(cells)[0].reshape(blank.shape) ** 2
    _require_held(blank, float(np.sqrt(squared.max())), float(focal_length), float(light))
    f = float(focal_length)
    turns = -squared / (np.sqrt(squared + f**2) + f) / float(light)
    turns = jnp.asarray(turns - np.floor(turns), focal_length.dtype)
    return blank.mask(turns * blank.wrap_height(light))


def _require_held(blank: MaskBlank, reach: float, focal_length: float, wavelength: float) -> None:
    frequency = reach / np.hypot(reach, focal_length) / wavelength
    nyquist = 0.5 / float(blank.pitch)
    if frequency > nyquist:
        raise ValueError(
            f"a lens reaches {reach:.3g} mm from its centre, where its phase has {frequency:.3g} "
            f"cycles/mm, and cells of {float(blank.pitch):g} mm hold {nyquist:.3g}: give more "
            "sites, a longer focal_length or smaller cells"
        )
