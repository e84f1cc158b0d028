"""Record of what a preparation did to a PSF and a capture."""

from dataclasses import dataclass

from thincam_jax.measured.options import Preparation


@dataclass(frozen=True)
class ImageLog:
    """One image before its channels and pixels were changed.

    - `name`, `format`, `shape`, `bits`, `full_scale`: properties of its file.
    - `minimum`, `maximum`: in counts. `pixels_at_maximum`: many have saturated, whatever the
      converter's highest level.
    - `background`: source of `level`, what was subtracted, the mean of each channel in fractions of
      full scale: "corner", "number", "black level of the file", the name of the dark frame; "lowest
      value" or "found with the image" where it is unknown.
    - `clipped`: pixels that this made negative, and that became 0.
    - `saturated`, `dead`: pixels. `noise`: by a sensor's calibration, root mean square, counts.
    """

    name: str
    format: str
    shape: tuple[int, ...]
    bits: int | None
    full_scale: float
    minimum: float
    maximum: float
    pixels_at_maximum: int
    background: str
    level: tuple[float, ...]
    clipped: int
    saturated: int
    dead: int
    noise: float | None = None


@dataclass(frozen=True)
class CleanUp:
    """Values of a PSF that were set to zero: below `level` in each channel.

    `zeroed`: their number; `light_removed`: their share of the light.
    """

    level: tuple[float, ...]
    zeroed: int
    light_removed: float


@dataclass(frozen=True)
class Centring:
    """Shift of a PSF by whole pixels, rows and columns.

    `found`: its centre before, pixels from the first; `light_lost`: share shifted out of the array.
    """

    found: tuple[float, float]
    shift: tuple[int, int]
    light_lost: float


@dataclass(frozen=True)
class PreparationLog:
    """Record of the steps of `prepare`; `dataclasses.asdict` gives it for a JSON file.

    - `psf`, `capture`: the images as they were read. `valid_share`: trusted pixels of the capture.
    - `psf_shape`: shape of the PSF on the capture's pixels, before `downsample`.
    - `first_pixel`, `cropped_to`: part of the capture that whole blocks of `downsample` cover;
      `shape`: after them.
    - `noise`: standard deviation of the PSF's pixels, for each channel.
    - `psf_divisor`, `capture_divisor`: divisors of fractions of full scale.
    """

    options: Preparation
    psf: ImageLog
    capture: ImageLog
    valid_share: float
    psf_shape: tuple[int, int]
    first_pixel: tuple[int, int]
    cropped_to: tuple[int, int]
    shape: tuple[int, int]
    noise: tuple[float, ...]
    clean_up: CleanUp
    centring: Centring | None
    psf_divisor: tuple[float, ...]
    capture_divisor: float
