"""Scenes: flat images at distances, and the light they send."""

import os
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import Grid, cell_overlap
from thincam_jax._core.module import Module
from thincam_jax._core.precision import product
from thincam_jax._core.quantity import quantity


def _photograph(given: Any) -> Any:
    """Counts as parts of the largest, and (y, x, 3) as (3, y, x); anything else as it is."""
    if checks.is_traced(given) or isinstance(given, jax.Array):
        return given
    array = checks.numbers("image", given)
    if array.ndim == 3 and checks.colours_last(array.shape):
        array = np.moveaxis(array[..., :3], -1, 0)
    return array / np.iinfo(array.dtype).max if array.dtype.kind == "u" else array


def _radiances(given: Any) -> Float[Array, "*batch y x"]:
    """The check of an image: floating, finite, not negative; a photograph as a batch of colours."""
    image = checks.array("image", _photograph(given))
    if not jnp.issubdtype(image.dtype, jnp.floating):
        image = image.astype(float)
    if image.ndim < 2 or 0 in image.shape:
        raise ValueError(f"image has shape {image.shape}; give a non-empty (…, y, x) array")
    if checks.is_traced(image):
        return image
    known = np.asarray(image)
    least, largest = known.min(), known.max()
    if not np.isfinite(least + largest):
        raise ValueError("image holds NaN or infinity; give finite radiances")
    if least < 0:
        raise ValueError(f"image holds {least:.3g}, a negative radiance; give radiances >= 0")
    checks.scaled("image", largest)
    return image


class ImagePlane(Module):
    """A flat, self-luminous image, centred on the optical axis, facing the camera.

    - `image`: radiance, (*batch, y, x), in any unit; a batch can hold the colour channels. A
      photograph is taken as it is, too: (y, x, 3), a PIL image, unsigned integers as parts of their
      largest value (its gamma is not undone).
    - `distance`: to the mask, mm.
    - `width`: physical width of the image, mm; its pixels are square.
    - `moves`: x of its middle at the beginning and the end of an exposure, mm: it moves uniformly,
      and the capture is the mean over the motion. None stays on the axis.

    ```python
    import thincam_jax as tc
    from thincam_jax.imaging.targets import sample_image

    plane = tc.ImagePlane(sample_image("camera"), distance=250.0, width=100.0)
    print(plane.height)  # 100.0
    ```

    **See also**: `Scene`, `load_image`.
    """

    image: Float[Array, "*batch y x"] = eqx.field(converter=_radiances)
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    moves: Float[Array, "2"] | None = eqx.field(
        default=None, converter=quantity("mm", shape=(2,), optional=True)
    )

    @property
    def height(self) -> Float[Array, ""]:
        """Physical height, mm."""
        return self.width * (self.image.shape[-2] / self.image.shape[-1])

    def sample(
        self, grid: Grid, *, magnification: float | Float[Array, ""] = -1.0
    ) -> Float[Array, "*batch y x"]:
        """The image, scaled by `magnification`, averaged over the cells of a grid.

        The image's pixels are taken as uniform squares, so that the average is exact and totals are
        kept at any ratio of the pitches. A negative magnification turns the image by 180°, as a
        pinhole does (thesis Eq 3.6 with its sign corrected).
        """
        down, across = self.weights(grid, magnification=magnification)
        return product(product(down, self.image.astype(down.dtype)), across.T)

    def weights(
        self, grid: Grid, *, magnification: float | Float[Array, ""] = -1.0
    ) -> tuple[Float[Array, "y m"], Float[Array, "x n"]]:
        """Matrices, left and (transposed) right, by which `sample` multiplies the image."""
        scale = jnp.asarray(magnification, dtype=grid.pitch.dtype)
        rows, columns = self.image.shape[-2:]
        moves = None if self.moves is None else self.moves.astype(scale.dtype) * scale
        both = (
            _cell_average(grid.y, grid.pitch, rows, self.height * jnp.abs(scale)),
            _cell_average(grid.x, grid.pitch, columns, self.width * jnp.abs(scale), moves),
        )
        down, across = (jnp.where(scale < 0, part[:, ::-1], part) for part in both)
        return down, across


def _cell_average(x, pitch, count: int, width, moves=None) -> Float[Array, "n count"]:
    """Weights of `count` pixels that span `width` in the averages over cells of `pitch` at x."""
    edges = (jnp.arange(count + 1, dtype=x.dtype) / count - 0.5) * width
    if moves is None:
        return cell_overlap(x, pitch, edges[:-1], edges[1:]) / pitch
    # How much of a cell lies before an edge: its mean while the edge moves from `low` to `high`.
    low, high = (edges + end - (x[:, None] - pitch / 2) for end in (jnp.min(moves), jnp.max(moves)))
    first, last = (jnp.clip(end, 0.0, pitch) for end in (low, high))
    beyond = jnp.maximum(high - jnp.maximum(low, pitch), 0.0)
    way = jnp.where(high > low, high - low, 1.0)
    mean = ((last - first) * (first + last) / 2 + pitch * beyond) / way
    return jnp.diff(jnp.where(high > low, mean, first), axis=1) / pitch


class Spectrum(Module):
    """Wavelengths and their shares of the captured light.

    - `wavelengths`: mm.
    - `weights`: non-negative; used as given, so that they sum to 1 for a plain average.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm

    light = tc.Spectrum([480 * nm, 520 * nm, 560 * nm], [1.0, 2.0, 1.0])
    print(light.weights)  # [1. 2. 1.]
    ```

    **See also**: `Scene`.
    """

    wavelengths: Float[Array, " n"] = eqx.field(converter=quantity("mm", check=checks.wavelengths))
    weights: Float[Array, " n"]

    def __init__(self, wavelengths: Numbers, weights: Numbers | None = None):
        wavelengths = jnp.atleast_1d(checks.array("wavelengths", wavelengths))
        if wavelengths.ndim > 1:
            raise ValueError(f"wavelengths has shape {wavelengths.shape}; give a list of them")
        count = wavelengths.size
        self.wavelengths = checks.wavelengths("wavelengths", wavelengths)
        if weights is None:
            weights = np.full(count, 1 / max(count, 1), self.wavelengths.dtype)
        self.weights = checks.finite("weights", weights, "parts of one", shape=(count,))
        if count == 0:
            raise ValueError("wavelengths is empty; give at least one wavelength in mm")
        if not checks.is_traced(self.weights) and (np.asarray(self.weights) < 0).any():
            raise ValueError(f"weights = {self.weights} has a negative share; give weights >= 0")

    @property
    def colours(self) -> list[tuple[Any, Any]]:
        """Pairs of wavelength, mm, and weight."""
        return list(zip(*map(checks.each, (self.wavelengths, self.weights)), strict=True))

    def filtered(self, wavelengths: Numbers, transmission: Numbers) -> "Spectrum":
        """This light behind a colour filter, such as one of a sensor's three.

        - `wavelengths`: wavelengths of the filter's curve, mm, ascending.
        - `transmission`: at these, ≥ 0; linear between them, 0 beyond.
        """
        places = checks.wavelengths("wavelengths", checks.array("wavelengths", wavelengths))
        curve = checks.array("transmission", transmission)
        if places.ndim != 1 or curve.shape != places.shape or places.size < 2:
            raise ValueError(
                f"wavelengths and transmission have shapes {places.shape} and {curve.shape}; give "
                "two lists of one length, of two or more"
            )
        if not checks.is_traced(places) and (np.diff(np.asarray(places)) <= 0).any():
            raise ValueError("wavelengths do not rise; give the filter's curve in ascending order")
        passed = jnp.interp(self.wavelengths, places, curve, left=0.0, right=0.0)
        return Spectrum(self.wavelengths, self.weights * passed.astype(self.weights.dtype))


class Scene(Module):
    """Image planes at distances, all with one spectrum. Planes do not hide each other.

    - `planes`: one `ImagePlane` or a sequence of them, with equal batch shapes.
    - `spectrum`: a `Spectrum` or one wavelength in mm.
    - `wavelength`: mm, in place of `spectrum`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm

    near, far = (tc.ImagePlane([[1.0, 0.5]], d, width=0.1 * d) for d in (100.0, 300.0))
    scene = tc.Scene([near, far], 500 * nm)
    print(len(scene.planes))  # 2
    ```

    **See also**: `ImagePlane`, `Spectrum`, `capture`.
    """

    planes: tuple[ImagePlane, ...]
    spectrum: Spectrum

    def __init__(
        self,
        planes: ImagePlane | Iterable[ImagePlane],
        spectrum: Spectrum | Numbers | None = None,
        *,
        wavelength: Number | None = None,
    ):
        lights = [light for light in (spectrum, wavelength) if light is not None]
        if len(lights) != 1:
            what = "is given twice" if lights else "is missing"
            raise TypeError(
                f"the light of the Scene {what}; give wavelength=530 * nm, or a Spectrum"
            )
        planes = (planes,) if isinstance(planes, ImagePlane) else planes
        if not isinstance(planes, Iterable) or not all(isinstance(p, ImagePlane) for p in planes):
            raise TypeError(f"planes is {checks.shown(planes)}; give an ImagePlane, or several")
        self.planes = tuple(planes)
        self.spectrum = lights[0] if isinstance(lights[0], Spectrum) else Spectrum(lights[0])
        if not self.planes:
            raise ValueError("planes is empty; give at least one ImagePlane")
        batches = {plane.image.shape[:-2] for plane in self.planes}
        if len(batches) > 1:
            raise ValueError(
                f"planes have different batch shapes {sorted(batches)}; make them equal"
            )

    def _repr_png_(self) -> bytes:
        """Picture for notebooks: its planes, axes in mm."""
        from thincam_jax.plot.frame import as_png
        from thincam_jax.plot.objects import draw_scene

        return as_png(draw_scene(self))

    @classmethod
    def photograph(
        cls,
        path: str | os.PathLike[str],
        *,
        distance: Number,
        width: Number,
        wavelength: Spectrum | Numbers = 550e-6,
    ) -> "Scene":
        """A photograph on a screen: its linear light, upright, colours as a batch (`load_image`).

        - `distance`, `width`: distance and width of the screen, mm.
        - `wavelength`: mm, or a `Spectrum`; the light of all colours, by default 550 nm.
        """
        from thincam_jax.imaging.targets.images import load_image  # slow, of other libraries

        if not isinstance(path, str | os.PathLike):
            raise TypeError(
                f"path is {checks.shown(path)}; give a file, or of an image "
                "tc.Scene(tc.ImagePlane(image, distance, width), 550e-6)"
            )
        return cls(ImagePlane(load_image(path), distance, width), wavelength)
