"""Photographs: from a file, from scikit-image's own samples, and resampled to a pixel count."""

import contextlib
import io
import os
import warnings
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import skimage
import tifffile
from jaxtyping import ArrayLike, Float64, Num

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.image_files import (
    ImageFileError,
    kind_of,
    opened,
    png_header,
    rawpy,
    read_whole,
)
from thincam_jax.imaging.encoding import ORIENTATION, decoded, upright

_DNG_VERSION = 50706  # tag

# Files inside the scikit-image package itself; other names of `skimage.data` need a download.
_PLAIN = (
    *("astronaut", "brick", "camera", "cell", "chelsea", "coffee", "coins", "grass", "gravel"),
    *("logo", "microaneurysms", "moon", "page", "text"),
)
_SAMPLES = {name: f"{name}.png" for name in _PLAIN} | {
    "cat": "chelsea.png",
    "clock": "clock_motion.png",
    "colorwheel": "color.png",
    "hubble_deep_field": "hubble_deep_field.jpg",
    "immunohistochemistry": "ihc.png",
    "retina": "retina.jpg",
    "rocket": "rocket.jpg",
}


@checked
def load_image(
    path: str | os.PathLike[str], *, linear: bool = False
) -> Float64[np.ndarray, "y x *channel"]:
    """An image file as linear light, float64 in [0, 1]: (y, x), or (y, x, 3) if it has colours.

    A photograph's codes are decoded: by the file's ICC profile, sRGB mark or gamma; without them,
    integers of 8 bit are sRGB, those of 16 bit and floats are linear. `linear=True` decodes
    nothing: for data, such as a mask's levels, and for codes that are to be taken as light. The
    image is turned upright, as its orientation (EXIF, TIFF) says.

    Unsigned integers of any depth are divided by their largest value, floats must be in [0, 1]
    already. An alpha channel is dropped, not blended. Colours of a camera's raw file (DNG and
    others) are LibRaw's, with the white balance of the camera.

    Raises FileNotFoundError if there is no such file; ValueError for a folder, a file that is no
    image or is damaged, an empty image, a stack of several, or values out of range.

    ```python
    import numpy as np
    import PIL.Image
    import thincam_jax as tc

    PIL.Image.fromarray(np.full((2, 3), 51, np.uint8)).save("photo.png")
    image = tc.load_image("photo.png")
    print(image.shape, image.max().round(4))  # (2, 3) 0.0331
    ```

    **See also**: `ImagePlane`, `read_mask`.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or a pipe"
        raise ValueError(f"{str(path)!r} is {what}; give the path of one image file")
    if not path.exists():
        raise FileNotFoundError(f"{str(path)!r} does not exist; give the path of an image file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data = read_whole(path, kind := kind_of(path))
            reader = {"tiff": _read_tiff, "raw": _read_raw}.get(kind or "", _read_other)
            pixels, tags, orientation = reader(data)
    except ImageFileError as error:
        raise ValueError(f"{str(path)!r} {error}") from None
    except Exception as error:  # each decoder raises its own kind
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(
            f"{str(path)!r} cannot be read as an image ({reason}); give an undamaged "
            "PNG, TIFF or JPEG"
        ) from error
    codes = upright(_unit_range(_without_alpha(pixels, path), path), orientation)
    return codes if linear else decoded(codes, tags, pixels.dtype == np.uint8)


def _read_tiff(data: bytes) -> tuple[np.ndarray, dict[Any, Any], int]:
    """Pixels as stored, tags of their encoding, and their orientation."""
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages[0].aspage()
        if _DNG_VERSION in page.tags:
            return _read_raw(data)
        if page.photometric in (3, 5):  # a palette, inks
            return _read_other(data)
        if page.photometric == tifffile.PHOTOMETRIC.CFA:
            raise ImageFileError("holds a colour filter's mosaic; save its colours as TIFF or PNG")
        pixels, found = file.asarray(), page.tags.get(ORIENTATION)
        tags = {"icc_profile": page.tags.valueof("InterColorProfile")}
    if page.photometric == 0 and pixels.dtype.kind == "u":
        pixels = np.iinfo(pixels.dtype).max - pixels
    return pixels, tags, found.value if found else 1


def _read_raw(data: bytes) -> tuple[np.ndarray, dict[Any, Any], int]:
    """Colours of a raw file, linear and upright, in the primaries of sRGB."""
    with rawpy().imread(io.BytesIO(data)) as file:
        # The white level stays that of the file, however bright the picture is.
        scale = {"no_auto_bright": True, "adjust_maximum_thr": 0.0, "output_bps": 16}
        return file.postprocess(gamma=(1, 1), use_camera_wb=True, **scale), {}, 1


def _read_other(data: bytes) -> tuple[np.ndarray, dict[Any, Any], int]:
    with opened(data) as file:
        tags: dict[Any, Any] = file.info
        orientation = file.getexif().get(ORIENTATION, 1)
        if file.mode in ("CMYK", "P") and file.format in ("JPEG", "TIFF"):
            turned = file.format == "TIFF"  # by Pillow
            return np.asarray(file.convert("RGB")), tags, 1 if turned else orientation
        deep = data[:4] == b"\x89PNG" and png_header(data)[2:4] in ((16, 2), (16, 6))
        if file.mode in ("L", "RGB") and not deep:
            return np.asarray(file), tags, orientation
    if deep:
        with contextlib.suppress(ImportError):  # without, 8 of the 16 bits
            import imagecodecs

            return imagecodecs.png_decode(data), tags, orientation
    return np.asarray(skimage.io.imread(io.BytesIO(data))), tags, orientation


@checked
def sample_image(name: str, *, linear: bool = False) -> Float64[np.ndarray, "y x *channel"]:
    """One of scikit-image's sample pictures by `load_image`: (y, x) or (y, x, 3), 0 to 1.

    With `linear=True` its codes are taken as light, as in published comparisons. Only those whose
    file is installed with scikit-image, so that nothing is downloaded;
    `sample_images()` lists them. Raises ValueError for another name, with that list.
    """
    available = sample_images()
    if name not in available:
        raise ValueError(
            f"name = {name!r} is not a sample image; choose one of {', '.join(available)}"
        )
    with resources.as_file(resources.files("skimage.data") / _SAMPLES[name]) as path:
        return load_image(path, linear=linear)


def sample_images() -> tuple[str, ...]:
    """The names that `sample_image` knows and that are installed here, in alphabetical order."""
    folder = resources.files("skimage.data")
    return tuple(sorted(name for name, file in _SAMPLES.items() if (folder / file).is_file()))


def resize(
    image: Num[ArrayLike, "..."], shape: tuple[int, int]
) -> Float64[np.ndarray, "y x *channel"]:
    """This picture on `shape` = (rows, columns) pixels; (y, x) or (y, x, channel).

    Both pictures cover the same field, border to border. If an axis shrinks, a Gaussian removes
    frequencies beyond the new Nyquist limit and the result is interpolated linearly; if none does,
    cubically. The result stays within its channel's range, and its mean stays the same up to the
    interpolation error.

    Raises ValueError for a bad shape, or an image of other dimensions, empty or not finite.
    """
    pixels = checks.numbers("image", image)
    rows, columns = checks.shape2d("shape", shape)
    if pixels.ndim not in (2, 3) or pixels.size == 0:
        raise ValueError(
            f"image has shape {pixels.shape}; give (y, x) or (y, x, channel), not empty"
        )
    if not np.isfinite(pixels).all():
        raise ValueError("image holds NaN or infinity; give finite numbers")
    pixels = pixels.astype(np.float64)
    if pixels.shape[:2] == (rows, columns):
        return pixels
    shrinks = rows < pixels.shape[0] or columns < pixels.shape[1]
    if pixels.ndim == 2:
        return _resample(pixels, (rows, columns), shrinks)
    channels = [
        _resample(channel, (rows, columns), shrinks) for channel in np.moveaxis(pixels, -1, 0)
    ]
    return np.stack(channels, axis=-1)


def _resample(plane: np.ndarray, shape: tuple[int, int], shrinks: bool) -> np.ndarray:
    resampled = skimage.transform.resize(
        plane,
        shape,
        order=1 if shrinks else 3,
        mode="reflect",
        anti_aliasing=shrinks,
        preserve_range=True,
    )
    return np.clip(np.asarray(resampled), plane.min(), plane.max())


def _without_alpha(pixels: np.ndarray, path: Path) -> np.ndarray:
    """(y, x) or (y, x, 3) of the pixels of a file."""
    if pixels.size == 0:
        raise ValueError(f"{str(path)!r} holds an empty image of shape {pixels.shape}")
    if pixels.ndim == 2:
        return pixels
    if pixels.ndim == 3 and pixels.shape[-1] in (1, 2):  # grey, grey and alpha
        return pixels[..., 0]
    if pixels.ndim == 3 and pixels.shape[-1] in (3, 4):  # colours, colours and alpha
        return pixels[..., :3]
    raise ValueError(
        f"{str(path)!r} holds an array of shape {pixels.shape}; give one image, (y, x) in grey or "
        "(y, x, 3) in colour"
    )


def _unit_range(pixels: np.ndarray, path: Path) -> np.ndarray:
    """The values as float64 in [0, 1], by the depth of their type."""
    if pixels.dtype.kind == "b":
        return pixels.astype(np.float64)
    if pixels.dtype.kind == "u":
        return pixels / np.float64(np.iinfo(pixels.dtype).max)
    if pixels.dtype.kind == "f" and pixels.min() >= 0 and pixels.max() <= 1:  # False for NaN
        return pixels.astype(np.float64)
    raise ValueError(
        f"{str(path)!r} holds {pixels.dtype} from {pixels.min()} to {pixels.max()}; allowed are "
        "unsigned integers, or floats from 0 to 1: rescale it"
    )


def placed(
    image: Float64[np.ndarray, "y x *channel"],
    width: float = 1.0,
    centre: tuple[float, float] = (0.0, 0.0),
    rotation: float = 0.0,
) -> Float64[np.ndarray, "y x *channel"]:
    """The image smaller, moved and turned on black of its own shape.

    - `width`, `centre`: width and centre of the image, in parts of the width of what it is on;
      `centre` is (y, x), y downwards.
    - `rotation`: clockwise as it is seen, rad, about its own middle.
    """
    if (width, *centre, rotation) == (1.0, 0.0, 0.0, 0.0):
        return image
    (rows, columns), size = image.shape[:2], image.shape[1]
    smaller = resize(image, (max(1, round(width * rows)), max(1, round(width * columns))))
    middle, own = ((np.array(i.shape[1::-1]) - 1) / 2 for i in (image, smaller))
    cosine, sine = np.cos(rotation), np.sin(rotation)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    there = middle + size * np.array(centre[::-1]) - turn @ own
    matrix = np.vstack([np.column_stack([turn, there]), [0, 0, 1]])
    found = skimage.transform.warp(smaller, np.linalg.inv(matrix), output_shape=(rows, columns))
    return np.clip(found, 0.0, 1.0)


def middle_square(image: np.ndarray, side: int) -> np.ndarray:
    """The middle (side, side, …) of an image, one pixel at least."""
    side = max(1, side)
    top, left = ((n - side) // 2 for n in image.shape[:2])
    return image[top : top + side, left : left + side]
