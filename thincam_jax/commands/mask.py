"""The mask of an experiment file: a Fresnel zone aperture, or a mask of another family."""

import inspect
from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

import numpy as np
import pydantic
from numpy.lib.format import open_memmap
from pydantic import Field

from thincam_jax._core import checks
from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import Length, section
from thincam_jax.imaging.targets.images import load_image
from thincam_jax.lensless import masks
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.cells import (
    Combination,
    ModifiedUniformlyRedundantArray,
    SeparableMask,
)
from thincam_jax.lensless.masks.display import on_display
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.masks.openings import LensletArray, Pinhole
from thincam_jax.lensless.masks.phase import MaskBlank, PhaseMask, diffuser, voronoi_fresnel
from thincam_jax.lensless.masks.sampled import SampledMask, read_mask

APERTURE = ("width", "profile", "pixel_pitch", "fill_factor")


class ApertureConfig(section(FresnelZoneAperture, only=APERTURE)):
    """Keys of all Fresnel zone apertures; `pixel_pitch`, `fill_factor`: for a display."""

    @pydantic.model_validator(mode="after")
    def _display(self):
        if self.pixel_pitch is None and self.fill_factor != 1:
            raise FieldError("is of a display's pixels; give their pixel_pitch, too", "fill_factor")
        return self


Index = Annotated[float, Field(gt=1, le=4)]  # of refraction
_WIDEST = 300.0  # mask of a thin camera, mm
Relief = Literal["diffuser", "voronoi_fresnel", "contours"]
Cells = Literal["mura", "ura", "mls", "random"]
Family = Literal["fza", Cells, "pinhole", "lenslets", "file", "phase", Relief]


def _sequences(length: int, cell: float, combine: Combination = "xor") -> SeparableMask:
    code = masks.maximum_length_sequence(length)
    return SeparableMask(code, code, cell, combine=combine)


def _lenslets(focal_length: float, cell: float, lenses: tuple[int, int]) -> LensletArray:
    return LensletArray(focal_length, cell, lenses)


def _image(path: str, width: float) -> SampledMask:
    amplitude = read_mask(path, 1.0).amplitude
    return SampledMask(amplitude, width / amplitude.shape[1])


def _phases(path: str, width: float) -> SampledMask:
    phase = (
        open_memmap(path, "r")
        if path.endswith(".npy")
        else 2 * np.pi * load_image(path, linear=True)
    )
    return SampledMask(np.exp(1j * phase), width / phase.shape[-1])


def _contours(
    key: int, blank: MaskBlank, light: LightPath, *, feature: float, line_width: float
) -> PhaseMask:
    from thincam_jax.design.phase_mask import contour_mask  # slow, and not needed by other masks

    return contour_mask(key, blank, light, feature=feature, line_width=line_width)


# What makes a mask of each family; a file gives what these need, and may give the rest.
FAMILIES: dict[Family, Callable[..., AbstractMask]] = {
    "fza": FresnelZoneAperture,
    "mura": ModifiedUniformlyRedundantArray,
    "ura": masks.UniformlyRedundantArray,
    "mls": _sequences,
    "random": masks.random_cells,
    "pinhole": Pinhole,
    "lenslets": _lenslets,
    "file": _image,
    "phase": _phases,
    "diffuser": diffuser,
    "voronoi_fresnel": voronoi_fresnel,
    "contours": _contours,
}
# Keys of a file that parameters are made of.
_MADE_OF = {"blank": ("width", "cell", "index"), "key": ("seed",)}

_ARRAYS = (
    *(ModifiedUniformlyRedundantArray, masks.UniformlyRedundantArray),
    *(LensletArray, SeparableMask),
)
# Left out where the family has none.
_OTHERS = dict.fromkeys(("order", "orders", "focal_length", "cell")) | {"combine": "xor"}


class MaskConfig(
    section(*_ARRAYS, only=tuple(_OTHERS), defaults=_OTHERS),
    section(FresnelZoneAperture, only=("height", "harmonics")),
    ApertureConfig,  # the keys of the last come first
):
    """The mask of a study: a Fresnel zone aperture, or of another `family` with its numbers.

    - `height`, `harmonics`: height of a rectangle, and orders of a zone plate that are computed.
    - `cell`: side of a cell or of a lens. Arrays have the `width` of their cells.
    - `order`: p of a "mura"; `orders`: (r, s) of a "ura"; `length`: 2^m − 1 of an "mls", whose code
      and itself `combine`; `tiles`: how often an array is repeated along each axis.
    - `seed`: seed of what is random; `focal_length`, `lenses` (down, across): for "lenslets".
    - `path`: path of a grey image, a "file", whose pixels make up the `width`; of a "phase", rad in
      a .npy or parts of a turn in an image.
    - `correlation_length`, `rms_slope`: scale and slope of a "diffuser"; `sites`: lenses of
      "voronoi_fresnel", made for the wavelength; `feature`, `line_width`: size of the "contours"
      that are the PSF far away, at the wavelength and distance of the first shot. `index`:
      refractive index of all three, whose PSFs are by "angular_spectrum".
    """

    beside: ClassVar[tuple[str, ...]] = ()  # keys of a section that are not of the mask itself
    width: Length = 0.0
    family: Family = "fza"
    length: int | None = None
    tiles: Annotated[int, Field(ge=1)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    lenses: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    path: str | None = None
    correlation_length: Length | None = None
    rms_slope: Annotated[float, Field(gt=0, le=1)] | None = None
    sites: Annotated[int, Field(ge=1)] | None = None
    feature: Length | None = None
    line_width: Length | None = None
    index: Index = 1.52

    @pydantic.model_validator(mode="after")
    def _family_fits(self):
        known = {"pixel_pitch", "fill_factor", "family", "width", *self.beside}
        for name, parameter in inspect.signature(FAMILIES[self.family]).parameters.items():
            for key in _MADE_OF.get(name, (name,)):
                known.add(key)
                given = {"seed", "index", *self.model_fields_set}
                needed = parameter.default is inspect.Parameter.empty
                if needed and key in type(self).model_fields.keys() - given:
                    raise FieldError("missing; this key is needed", key)
        for key in sorted(self.model_fields_set - known):
            if getattr(self, key) != type(self).model_fields[key].default:
                message = f"is no number of a mask of the family {self.family}; drop it"
                raise FieldError(message, key)
        across = self._cells_across()
        if across is not None and self.cell is not None:
            width = across * (self.tiles or 1) * self.cell
            # A resolved file has the width too.
            if "width" in self.model_fields_set and abs(self.width - width) > 1e-9:
                raise FieldError(f"the cells make {width:g} mm; drop it", "width")
            object.__setattr__(self, "width", width)
        if self.width > _WIDEST:
            key = "width" if across is None else "cell"
            message = f"makes a mask of {self.width:g} mm, which is none; give at most {_WIDEST:g}"
            raise FieldError(message, key)
        return self

    def _cells_across(self) -> int | None:
        """Number of cells across one array, where its numbers give it."""
        pair = self.orders or self.lenses
        return pair[1] if pair else self.order or self.length

    @property
    def label(self) -> str:
        """Label in a line of a report: size and kind."""
        if self.family == "fza":
            height = f"×{self.height:g}" if self.height else ""
            return f"{self.width:g}{height} mm ({self.profile})"
        order = self.order or self.length or self.orders or self.lenses
        numbers = [] if order is None else [str(order)]
        cells = [] if self.cell is None else [f"cells of {1e3 * self.cell:g} µm"]
        return ", ".join([" ".join([self.family, *numbers]), *cells, f"{self.width:g} mm wide"])


def built_mask(config: MaskConfig, exposure: Exposure) -> AbstractMask:
    """The mask of an exposure but for a profile of its own, on its display.

    **Errors**: ValueError for numbers that make none.
    """
    names = ("beta", "phase", "width", "wavelength", "distance")
    numbers = dict(config) | {name: getattr(exposure, name) for name in names}
    numbers |= {"key": config.seed or 0, "light": LightPath(exposure.wavelength, exposure.distance)}
    maker = FAMILIES[config.family]
    parameters = inspect.signature(maker).parameters
    if "blank" in parameters:
        count = checks.whole_cells("width", config.width, "cell", config.cell or 0.0)
        numbers["blank"] = MaskBlank((count, count), config.cell or 0.0, config.index)
    given = {name: numbers.get(name) for name in parameters}
    mask = maker(**{name: value for name, value in given.items() if value is not None})
    if config.family == "fza" or config.pixel_pitch is None:
        return mask
    return on_display(mask, config.pixel_pitch, config.fill_factor)
