"""Point spread function and optical transfer function of a camera."""

import functools
import math
import operator
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers, Position
from thincam_jax._core.grids import Grid, SparseGrid
from thincam_jax._core.precision import (
    allow,
    as_complex,
    cast,
    flat_root,
    precision_of,
    product,
    squared_modulus,
    turn_phasor,
)
from thincam_jax._core.progress import watched
from thincam_jax.lensless.camera import LenslessCamera, LightPath
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AbstractMask, has_few_terms
from thincam_jax.lensless.method import PIXEL_NODES, SAMPLED, Model, PsfMethod, as_method
from thincam_jax.lensless.propagation.angular_spectrum import angular_spectrum
from thincam_jax.lensless.propagation.closed_form import ChirpSum, closed_form, in_focus, paraxial
from thincam_jax.lensless.propagation.geometric import geometric
from thincam_jax.lensless.propagation.radial import radial
from thincam_jax.lensless.propagation.rayleigh_sommerfeld import rayleigh_sommerfeld
from thincam_jax.lensless.propagation.separable import (
    SeparableSum,
    centre_phase,
    image_of_terms,
    separable,
    separable_image,
    transform_of_terms,
)
from thincam_jax.lensless.propagation.skew import skew_image
from thincam_jax.lensless.resolve import resolve

# Samples along an axis of the programs of closed forms, and of each more.
_FEW, _STEP = 256, 1024


@checked
def psf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    at: Position | None = None,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Float[Array, "y x"]:
    """Point spread function on the sensor: irradiance relative to the open aperture.

    **Arguments**

    - `wavelength`: λ, mm.
    - `object_distance`: t, mm; infinity is a plane wave.
    - `at`: (y, x) of the point, mm, by default on the axis; of a plane wave the tangents of its
      angles. The shadow then moves by −d/t of it, and the waves are those about the ray through the
      mask's middle (`thincam_jax.lensless.LightPath`). Of cells off both axes, and of rings,
      "separable" then samples: for a MURA of 23 × 23 cells of 62 µm (d = 6.5 mm, averages over
      pixels of 22 µm) 0.8 % off at 20° and 30°, at azimuths of 30° and 45°; 6 % at the centres of
      pixels. A traced point counts as off both axes, unless one coordinate is a plain 0.
    - `model`: "geometric", "paraxial", "closed_form", "separable" (of rings "radial"),
      "angular_spectrum" or "rayleigh_sommerfeld"; each is documented in
      `thincam_jax.lensless.propagation`. A `PsfMethod` sets the precision and the samples of a
      model, too.
    - `pixel_integration`: average over each pixel; False is the value at its centre. "separable"
      averages by as many nodes as its fringes need, at most 320, which leave up to 0.2 % where a
      pixel holds more than 197, pitch·width/(λd). Where these are traced there are 24 nodes, for
      9.5 fringes; `PsfMethod(nodes=)` sets others, `predict_error` tells what they leave.

    **Returns** (y, x), dimensionless. Differentiable in every number of `camera` and in
    `wavelength` and `object_distance`.

    **Errors**: ValueError for what is out of range, for unknown models and for phases that float32
    does not hold (see `thincam_jax.lensless.resolve`), TypeError for a mask
    that the model cannot take, MemoryError (before any work, with the estimate) for a size that
    does not fit.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm, object_distance=250.0)  # (y, x)
    print(h.shape)  # (24, 32)
    ```

    **See also**: `otf`, `choose_model`, `capture`.
    """
    return _computed(_PSF, camera, (wavelength, object_distance, at), model, pixel_integration)


def psf_about_ray(
    camera: LenslessCamera,
    wavelength: Number,
    object_distance: Number,
    at: Position | None,
    method: PsfMethod,
    grid: Grid | None = None,
) -> Float[Array, "y x"]:
    """`psf` on a sensor whose middle is where the ray through the mask's plane at (0, 0) meets.

    `grid`: samples in place of the sensor's.
    """
    light, grid = (wavelength, object_distance, at), camera.sensor.grid if grid is None else grid
    return _computed(_PSF, camera, light, method, about_ray=grid)


def spectral_psf(
    camera: LenslessCamera,
    light: Iterable[tuple[Number, Number]],
    object_distance: Number,
    method: PsfMethod,
    grid: Grid,
    at: Position | None = None,
) -> Float[Array, "y x"]:
    """Sum of the PSFs of (wavelength, weight) pairs; with `at`, about the ray of that point."""
    parts = []
    for wavelength, weight in light:
        h = psf_about_ray(camera, wavelength, object_distance, at, method, grid)
        is_whole = not checks.is_traced(weight) and bool(np.asarray(weight) == 1)
        parts.append(h if is_whole else weight * h)  # of one colour nothing to compile
    return functools.reduce(operator.add, parts)


@checked
def otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    at: Position | None = None,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Complex[Array, "v u"]:
    """Optical transfer function H(u,v) = ∬ h e^{−2πj(ux+vy)} dx dy, zero frequency at n//2, mm².

    Arguments as for `psf`. For the models with an edge it is the transform of the PSF on the grid
    (sum times pitch²). For "paraxial" and "closed_form", whose PSF has no end, it is the
    analytic transform, without pixel average: a δ at zero frequency is one over the area of a
    frequency cell.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    H = tc.otf(camera, wavelength=500 * nm, object_distance=250.0)  # (v, u), centred
    print(H.shape)  # (24, 32)
    ```

    **See also**: `psf`, `lensless.phase_shift.fringe_scanned_otf`.
    """
    return _computed(_OTF, camera, (wavelength, object_distance, at), model, pixel_integration)


@checked
def mtf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    frequencies: Numbers | None = None,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Float[Array, " frequency"]:
    r"""Modulation transfer function: contrast of the shadow of fringes, over their frequency.

    .. math:: \mathrm{MTF}(\rho) = \frac{1}{H(0)} \sqrt{\langle |H(\rho\cos\vartheta,
        \rho\sin\vartheta)|^2 \rangle_\vartheta}

    over 32 directions of a half turn, with H of `otf` on the sensor's area: 1 at zero frequency.
    Other arguments are described at `psf`.

    - `frequencies`: ρ on the sensor, cycles/mm, at most 1/(2 pitch); by default 64 from 0 to there.

    **Returns** (frequency,), dimensionless, differentiable as `psf` is.

    **Errors**: those of `psf`; ValueError for frequencies that the pixels do not resolve.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    contrast = tc.mtf(camera, wavelength=500 * nm, frequencies=[2.0, 4.0])
    print(contrast.shape)  # (2,)
    ```

    **See also**: `otf`, `plot.otf`, `design.ranking.modulation_transfer`.
    """
    grid = camera.sensor.grid
    given = jnp.linspace(0.0, 0.5, 64) / grid.pitch if frequencies is None else frequencies
    rho = jnp.ravel(checks.array("frequencies", given)).astype(grid.pitch.dtype)
    if not checks.holds_traced(rho, grid.pitch):
        most = (0.5 + 1e-6) / float(grid.pitch)  # but for rounding
        checks.between("max(frequencies)", jnp.max(jnp.abs(rho)), "cycles/mm", 0.0, most)
    h = _computed(_PSF, camera, (wavelength, object_distance), model, pixel_integration)
    return _contrast(h, grid, rho)


@jax.jit
def _contrast(h: Float[Array, "y x"], grid: Grid, rho: Float[Array, " n"]) -> Float[Array, " n"]:
    angles = np.pi * (np.arange(32) + 0.5) / 32
    along = (np.asarray(part(angles), h.dtype) for part in (np.sin, np.cos))
    rows, columns = (
        turn_phasor(jnp.ravel(rho[:, None] * part)[:, None] * place)
        for part, place in zip(along, (grid.y, grid.x), strict=True)
    )
    power = squared_modulus(jnp.sum(product(rows, as_complex(h)) * columns, axis=1))
    return flat_root(jnp.mean(power.reshape(-1, 32), axis=1)) / jnp.sum(h)


def _irradiance(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> SeparableSum | ChirpSum | Float[Array, "y x"]:
    """The PSF in the form in which the model has it: terms where there are terms, else an image."""
    if method.model not in SAMPLED:
        mask = _unfocused(mask, path) if method.model == "closed_form" else mask
        nodes = method.nodes if method.pixel_integration else None
        if method.model == "separable" and path.skew:
            return skew_image(mask, grid, path, nodes=nodes)
        if method.model == "separable" and not has_few_terms(mask):
            assert isinstance(mask, AbstractFactoredMask)  # by `psf_method`
            return separable_image(mask, grid, path, nodes=nodes)
        if method.model == "radial":
            return radial(mask, grid, path, method)
        return _closed(mask, grid, path, method)
    sampled = angular_spectrum if method.model == "angular_spectrum" else rayleigh_sommerfeld
    return sampled(mask, grid, path, method)


def _closed(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> SeparableSum | ChirpSum | Float[Array, "y x"]:
    model, average = method.model, method.pixel_integration
    if model == "geometric":
        return geometric(mask, grid, path, pixel_integration=average)
    if model == "separable":
        nodes = method.nodes or PIXEL_NODES
        assert isinstance(mask, AbstractFactoredMask)  # by `psf_method`
        return separable(mask, grid, path, pixel_integration=average, nodes=nodes)
    return paraxial(mask, path) if model == "paraxial" else closed_form(mask, path)


@jax.jit(static_argnames="method")
def closed_terms(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> SeparableSum:
    """The PSF of a mask of separable terms by one of the closed forms, as separable terms."""
    h = _closed(mask, grid, path, method)
    if isinstance(h, ChirpSum):
        h = h.sample(grid, pixel_integration=method.pixel_integration)
    assert isinstance(h, SeparableSum)  # of a mask of terms
    return h


@jax.jit(static_argnames="method")
def _psf(mask, grid: Grid, path, method):
    h = _irradiance(mask, grid, path, method)
    if isinstance(h, ChirpSum):
        h = h.sample(grid, pixel_integration=method.pixel_integration)
    return h.image() if isinstance(h, SeparableSum) else h


@jax.jit(static_argnames="method")
def _otf(mask, grid: Grid, path, method):
    h = _irradiance(mask, grid, path, method)
    if isinstance(h, ChirpSum):
        return h.transform(grid)
    if isinstance(h, SeparableSum):
        return h.transform()
    spectrum = jnp.fft.fftshift(jnp.fft.fft2(h)) * as_complex(grid.pitch**2)
    rows, columns = (centre_phase(n, grid.pitch.dtype) for n in grid.shape)
    return spectrum * rows[:, None] * columns


# Of any model, and of known terms.
_PSF, _OTF = (_psf, image_of_terms), (_otf, transform_of_terms)


def _computed(
    functions: tuple[Callable[..., Any], Callable[..., Any]],
    camera: LenslessCamera,
    light: tuple[Any, ...],
    model: Model | PsfMethod,
    pixel_integration: bool = True,
    about_ray: Grid | None = None,
):
    """A function of what `resolve` gives for the path of light, in the grid's precision.

    `about_ray`: samples about the point's ray, in place of the sensor's about the axis.
    """
    path, grid = camera.path(*light), about_ray
    if grid is None:
        grid = camera.sensor.grid
    elif path.at is not None:
        path = replace(path, follows=True)
    if path.at is None and path.place is not None and as_method(model).model in SAMPLED:
        path = replace(path, at=jnp.zeros_like(path.place))  # these follow the ray
    own, (of_mask, of_terms) = precision_of(grid.pitch), functions
    mask, grid, path, method = resolve(camera.mask, grid, path, model, pixel_integration)
    with allow(method.precision or own, mask, grid, path), watched("computing the PSF"):
        terms = _known_terms(mask, grid, path, method)
        result = of_mask(mask, grid, path, method) if terms is None else of_terms(terms, grid)
    return result if method.precision == own else cast(result, own)


def _known_terms(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> SeparableSum | None:
    """Terms of the closed form of known numbers, on samples that go on beyond the grid.

    All grids of up to as many samples share their program, which takes a second to compile.
    """
    closed = method.model == "separable" and not path.skew and has_few_terms(mask)
    if not closed or checks.holds_traced(mask, grid, path):
        return None
    most = max(grid.shape)
    count = _FEW if most <= _FEW else _STEP * math.ceil(most / _STEP)
    rows, columns = (np.arange(count) - (n - 1) / 2 for n in grid.shape)
    return closed_terms(mask, SparseGrid(rows, columns, grid.pitch), path, method)


def _unfocused(mask: AbstractMask, path: LightPath) -> AbstractMask:
    return eqx.error_if(
        mask,
        in_focus(mask, path),
        "model 'closed_form' has no PSF where an order focuses on the sensor (k·ε = −1); "
        "use 'separable'",
    )
