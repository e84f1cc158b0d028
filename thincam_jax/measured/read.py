"""Image files: TIFF, PNG, NPY and JPEG by their first bytes, cameras' raw files by name."""

import contextlib
import io
import logging
import os
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Bool

from thincam_jax._core.arguments import checked
from thincam_jax._core.files import natural_order, open_regular
from thincam_jax._core.image_files import (
    RAW_SUFFIXES,
    ImageFileError,
    kind_of,
    kind_of_start,
    npy_header,
    opened,
    png_header,
    rawpy,
    read_whole,
    tiff_pages,
    whole_of,
)
from thincam_jax.imaging.encoding import ORIENTATION, decoded, upright
from thincam_jax.measured.bayer import PATTERNS, turned_pattern
from thincam_jax.measured.containers import OPENERS, read_array, read_bare, read_pgm
from thincam_jax.measured.raw import CaptureFileError, MeasurementError, Raw

# Bits, orientation, whether it is encoded, and those of `Raw`, where a file says them.
_Facts = dict[str, Any]

SUFFIXES = (".tif", ".tiff", ".png", ".npy", ".pgm", ".ppm", ".fits", *RAW_SUFFIXES)
_KEYED = re.compile(r"(?i)(.+\.(?:npz|mat|h5|hdf5|fits?)):(.+)")
_BARE = (".raw", ".raw8", ".raw10", ".raw12", ".raw16", ".bin")  # counts alone
# By their first bytes, or those after a length: names, and what imageio is to read.
_OTHERS = {
    **{b"GIF8": ("a GIF", ", index=0"), b"BM": ("a BMP", ""), b"WEBP": ("a WebP", "")},
    **{b"AVI ": ("an AVI film", ", index=0"), b"ftyp": ("an MP4 film or HEIF", ", index=0")},
    b"P2": ("a PGM in text", ""),
    **{b"jP  ": ("a JPEG 2000", ""), b"v/1\1": ("an OpenEXR", ""), b"8BPS": ("a PSD", "")},
}
# Photometric interpretations that hold counts: no palette, inverted scale or colour difference.
_PLAIN = (
    tifffile.PHOTOMETRIC.MINISBLACK,
    tifffile.PHOTOMETRIC.RGB,
    tifffile.PHOTOMETRIC.CFA,
    tifffile.PHOTOMETRIC.LINEAR_RAW,
)
_UNDAMAGED = "give an undamaged TIFF, PNG, JPEG or NPY file"
_EXIF, _EXPOSURE_TIME, _PROFILE = 34665, 33434, 34675  # tags
_BENT = 0.02  # light of a code of one half beside it, from which on a curve is said
_FLIPS = {0: 1, 3: 3, 5: 8, 6: 6}  # orientations by LibRaw
_NONLINEAR = (
    "a JPEG's counts are not in proportion to the light (gamma, tone curve, compression), so that "
    "images show rings and wrong greys; save the camera's raw frames as TIFF or PNG"
)
_ENCODED = (
    "its tags say that its counts are codes for displays (gamma), not in proportion to the light; "
    "give raw frames, or numpy.save('{}', thincam_jax.load_image('{}'))"
)


class NonlinearWarning(UserWarning):
    """A capture that is not in proportion to the light."""


@checked
def read_image(path: str | os.PathLike[str], *, bits: int | None = None) -> Raw:
    """Read one image as it is stored, without scaling or gamma.

    TIFF and PNG of 8 or 16 bit a sample, grey or RGB, and NPY; floats in TIFF and NPY; PGM and PPM;
    an array of NPZ, MATLAB, HDF5 or FITS, by its key as "file.mat:capture" where there are several;
    counts without a header by their rows and columns, as "file.raw10:480x640" or
    "file.raw:480x640x12" (see `unpack_raw`).
    An opaque alpha channel is dropped. `bits` is the bit depth of the camera (see `Raw`). A JPEG is
    read with a NonlinearWarning: its counts are not in proportion to the light. DNG and raw files
    of cameras need the extra `raw`; they give their mosaic (y, x) with the black level in it, and
    what the file says of it: pattern, black and white level. Images are turned upright, and their
    pattern with them, as their orientation (EXIF, TIFF) says. NaN are dead pixels. The exposure
    time is that of EXIF, TIFF or FITS.

    **Errors**: CaptureFileError, one line, for a file that is missing, truncated, damaged or no
    image, for a stack of images, and for everything that `Raw` refuses.
    """
    (pixels,), kind, facts = _decode(Path(path))
    _warn_of_codes(Path(path), kind, facts)
    return _raw(pixels, bits, kind, str(path), facts)


def _warn_of_codes(path: Path, kind: str, facts: _Facts) -> None:
    if facts.get("encoded") and kind != "jpeg":  # which warns itself
        text = _ENCODED.format(path.with_suffix(".npy"), path)
        warnings.warn(f"{path}: {text}", NonlinearWarning, stacklevel=3)


def read_photograph(data: bytes, name: str, bits: int | None = None) -> Raw:
    """Read an image from the bytes of its file, as `read_image` does.

    Codes of photographs are no counts: of a JPEG nothing is said. `name`: name in messages.
    """
    (pixels,), kind, facts = _decode(Path(name), data=data)
    return _raw(pixels, bits, kind, name, facts)


@checked
def read_images(path: str | os.PathLike[str], bits: int | None = None) -> list[Raw]:
    """Read the pages of a TIFF, or the files of a folder in the order of `image_files`.

    **Errors**: CaptureFileError as in `read_image`; a TIFF's pages must be of one size.
    """
    path = Path(path)
    if path.is_dir():
        return [read_image(one, bits=bits) for one in image_files(path)]
    pages, kind, facts = _decode(path, stack=True)
    _warn_of_codes(path, kind, facts)
    return [_raw(page, bits, kind, f"{path}, image {n}", facts) for n, page in enumerate(pages, 1)]


def _raw(pixels: np.ndarray, bits: int | None, kind: str, name: str, facts: _Facts) -> Raw:
    """The image, upright, with the facts of its file."""
    facts = dict(facts)
    facts.pop("encoded", None)  # no fact of `Raw`
    found, orientation = facts.pop("bits", None), facts.pop("orientation", 1)
    if bits is not None and "white_level" in facts and bits != found:
        raise CaptureFileError(
            f"{name}: bits = {bits}, but the file says {found} bit (white level "
            f"{facts['white_level']}); leave `bits` out"
        )
    try:
        if orientation != 1 and "bayer" in facts:
            facts["bayer"] = turned_pattern(facts["bayer"], pixels.shape, orientation)
        pixels = upright(pixels, orientation)
        return Raw(pixels, found if bits is None else bits, kind, name, **facts)
    except MeasurementError as error:
        raise CaptureFileError(str(error)) from None


@checked
def read_pixel_map(path: str | os.PathLike[str]) -> Bool[np.ndarray, "y x"]:
    """Read a map (y, x) from a one-channel image file, True where it is not zero.

    Such as a map of dead pixels. An NPY file may hold bool.

    **Errors**: CaptureFileError as in `read_image`.
    """
    (pixels,), _, facts = _decode(Path(path))
    if pixels.ndim != 2 or pixels.size == 0 or pixels.dtype.kind not in "buif":
        raise CaptureFileError(
            f"{path}: holds {pixels.dtype} values of shape {pixels.shape}; give a map (y, x) that "
            "is zero for all pixels but the marked ones"
        )
    return upright(pixels, facts.get("orientation", 1)) != 0


@checked
def list_captures(folder: str | os.PathLike[str], bits: int | None = None) -> list[Path]:
    """List the image files of a folder as `image_files` does, after reading each one.

    `bits` as in `read_image`. A damaged file is so found before a long computation.

    **Errors**: CaptureFileError, one line, for no such folder, no images in it, a file that cannot
    be read, or an image of another shape than most.
    """
    shapes = {path: read_image(path, bits=bits).pixels.shape for path in image_files(folder)}
    common, _ = Counter(shapes.values()).most_common(1)[0]
    for path, shape in shapes.items():
        if shape != common:
            same = next(p for p, s in shapes.items() if s == common)
            raise CaptureFileError(
                f"{path}: has shape {shape}, others, as {same.name}, have {common}; captures of "
                "one folder must be of one shape: take it out"
            )
    return list(shapes)


def image_files(folder: str | os.PathLike[str]) -> list[Path]:
    """List the files of a folder with `SUFFIXES`, capture_9 before capture_10, no hidden ones.

    **Errors**: CaptureFileError, one line, for no such folder or no such files.
    """
    try:
        entries = list(Path(folder).iterdir())
    except OSError as error:
        raise CaptureFileError(
            f"{folder}: cannot be read as a folder ({error.strerror}); give a folder of captures"
        ) from None
    paths = [p for p in entries if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    paths = [p for p in paths if not p.is_dir()]
    if not paths:
        raise CaptureFileError(
            f"{folder}: holds no capture; give a folder of TIFF, PNG, NPY or raw files"
        )
    return sorted(paths, key=natural_order)


def pair_backgrounds(captures: Sequence[Path], folder: Any) -> list[Path]:
    """List the background of each capture: that of its name, or all in order; none of no folder.

    **Errors**: CaptureFileError where only some names agree, or none does and the counts differ.
    """
    if not (isinstance(folder, Path) and folder.is_dir()):
        return []
    named = {path.stem: path for path in image_files(folder)}
    alike = [named[capture.stem] for capture in captures if capture.stem in named]
    if len(captures) not in (len(alike), len(named)) or 0 < len(alike) < len(captures):
        raise CaptureFileError(
            f"{folder}: holds {len(named)} backgrounds for {len(captures)} captures, {len(alike)} "
            "named as one; name all as their captures, give as many, or one file for all"
        )
    return alike or list(named.values())


def _decode(
    path: Path, stack: bool = False, data: bytes | None = None
) -> tuple[list[np.ndarray], str, _Facts]:
    """Pixels of each image, format, and facts of the file; several images only of a stack.

    `data`: its bytes, where they have been read; `path` is then a name.
    """
    named = _KEYED.fullmatch(str(path))
    inside = named and data is None and not path.exists()
    path, key = (Path(named[1]), named[2]) if named and inside else (path, None)
    if data is None and not path.exists() and (bare := read_bare(str(path))):
        return [bare[0]], "raw", bare[1]
    kind = _kind(path) if data is None else kind_of_start(data[:8], path.suffix)
    if not kind:
        raise CaptureFileError(f"{path}: is no image that can be read; {_UNDAMAGED}")
    readers: dict[str, Any] = {
        **{one: partial(_read_container, one, key) for one in OPENERS},
        "pgm": read_pgm,
        "png": _read_png,
        "jpeg": _read_jpeg,
        "tiff": partial(_read_tiff, stack=stack),
        "npy": _read_npy,
        "raw": _read_mosaic,
    }
    try:
        with _silence():
            whole = data and whole_of(io.BytesIO(data), len(data), kind)
            images, facts = readers[kind](whole or read_whole(path, kind))
    except (CaptureFileError, ImageFileError) as error:
        raise CaptureFileError(f"{path}: {error}") from None
    except Exception as error:  # each decoder raises its own kind
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        advice = "the file is cut short, damaged or of a rare kind: copy it again or save it anew"
        if "imagecodecs" in reason:
            advice = "pip install 'thincam_jax[codecs]', or save it as TIFF without compression"
        raise CaptureFileError(
            f"{path}: cannot be read as {kind.upper()} ({reason}); {advice}"
        ) from None
    if kind == "jpeg" and data is None:
        warnings.warn(f"{path}: {_NONLINEAR}", NonlinearWarning, stacklevel=3)
    return images, kind, facts


def _true_name(path: Path) -> str:
    """Kind of a file that is not read, and the line of Python that brings it in."""
    with open_regular(path) as (file, _):
        start = file.read(12)
    if path.suffix.lower() in _BARE:
        return f"is counts without their size; give it as {path.name}:ROWSxCOLUMNS, or with xBITS"
    array = f"numpy.save({str(path.with_suffix('.npy'))!r}"
    if start[:2] == b"\x1f\x8b":
        return f"is compressed by gzip; gunzip {path.name}"
    for first, (name, call) in _OTHERS.items():
        if first in (start[: len(first)], start[4 : 4 + len(first)], start[8 : 8 + len(first)]):
            return f"is {name}; {array}, imageio.v3.imread({str(path)!r}{call}))"
    return f"is not an image that can be read; {_UNDAMAGED}, or {array}, pixels)"


def _kind(path: Path) -> str:
    try:
        kind = kind_of(path)
    except FileNotFoundError:
        raise CaptureFileError(f"{path}: does not exist; give the path of an image") from None
    except IsADirectoryError:
        raise CaptureFileError(f"{path}: is a folder; give the path of one image") from None
    except OSError as error:
        raise CaptureFileError(f"{path}: cannot be read ({error.strerror or error})") from None
    if kind is None:
        raise CaptureFileError(f"{path}: {_true_name(path)}")
    if not kind:
        raise CaptureFileError(f"{path}: is empty or cut short; {_UNDAMAGED}")
    return kind


def _read_container(kind: str, key: str | None, data: bytes) -> tuple[list[np.ndarray], _Facts]:
    time = re.search(rb"EXP(?:TIME|OSURE) *= *([0-9.Ee+-]+)", data[:28800])  # of FITS, s
    facts = _exposure(time[1].decode()) if kind == "fits" and time else {}
    return [read_array(kind, data, key)], facts


def _exposure(*given: Any) -> _Facts:
    """The first exposure time, s, that is a number above 0; TIFF has (numerator, denominator)."""
    for one in given:
        with contextlib.suppress(TypeError, ValueError, ZeroDivisionError):
            if 0 < (time := float(one[0] / one[1] if isinstance(one, tuple) else one)) < np.inf:
                return {"exposure": time}
    return {}


def _read_npy(data: bytes) -> tuple[list[np.ndarray], _Facts]:
    stream = io.BytesIO(data)
    _, dtype = npy_header(stream)
    if dtype.hasobject or dtype.fields:
        raise CaptureFileError(f"holds {dtype} values, no image; give uint8, uint16 or float")
    stream.seek(0)
    return [np.load(stream, allow_pickle=False)], {}


def _read_png(data: bytes) -> tuple[list[np.ndarray], _Facts]:
    """Pixels (y, x) or (y, x, channel), and their bits and orientation."""
    _, _, depth, colour, *_ = png_header(data)
    if colour == 3:
        raise CaptureFileError("stores a palette, no counts; save it as grey or RGB")
    if depth < 8:
        raise CaptureFileError(f"has {depth} bit a sample; 8 to 16 are read")
    if b"acTL" in data[: data.find(b"IDAT")]:
        raise CaptureFileError("is animated; give one image a file")
    stored, facts = _by_pillow(data)
    if depth == 16 and colour:  # of which Pillow keeps 8 bits
        import imagecodecs

        pixels = imagecodecs.png_decode(data)
    else:
        pixels = stored.astype(f"uint{depth}", copy=False)
    pixels = _without_alpha(pixels, pixels.ndim == 3 and pixels.shape[2] in (2, 4))
    return [pixels], {"bits": depth, **facts}


def _by_pillow(data: bytes) -> tuple[np.ndarray, _Facts]:
    """Pixels as they are stored, their orientation and exposure."""
    with opened(data) as file:
        exif = file.getexif()
        time = exif.get_ifd(_EXIF).get(_EXPOSURE_TIME)
        if file.mode == "CMYK":
            raise CaptureFileError("stores colours as CMYK, no counts; save it as grey or RGB")
        facts = {"orientation": exif.get(ORIENTATION, 1), "encoded": _is_encoded(file.info)}
        return np.array(file), facts | _exposure(time)


def _is_encoded(tags: Any) -> bool:
    """Whether a profile, a mark of sRGB or a gamma says that codes are not linear."""
    return abs(float(decoded(np.array([0.5]), tags, photograph=False)[0]) - 0.5) > _BENT


def _read_mosaic(data: bytes) -> tuple[list[np.ndarray], _Facts]:
    """The mosaic of a camera's raw file, without the rows and columns beyond its image."""
    with rawpy().imread(io.BytesIO(data)) as file:
        pixels = file.raw_image_visible.copy()
        if pixels.ndim != 2:
            raise CaptureFileError("holds colours, no mosaic; save it as TIFF")
        letters, colours = file.color_desc.decode("ascii", "replace"), file.raw_colors_visible
        sites, pattern = "", np.asarray(file.raw_pattern).shape
        if len(pattern) == 2:  # else grey
            sites = "".join(letters[n] for n in colours[: pattern[0], : pattern[1]].ravel())
        black: Any = np.asarray(file.black_level_per_channel)
        black = black[colours[:2, :2]].ravel() if sites else black
        white = [int(file.white_level)]
        facts = _sensor_facts(sites, pattern, black, white)
        facts |= _exposure(getattr(getattr(file, "other", None), "shutter_speed", None))
        facts |= {"orientation": _FLIPS[file.sizes.flip]}
        return [_levelled(pixels, black, white)], {"bits": 16, **facts}


def _sensor_facts(sites: str, pattern: Any, black: Any, white: Any) -> _Facts:
    """Facts by the colours of a mosaic's `pattern` (rows, columns), and by its levels."""
    if sites and sites not in PATTERNS:
        size = "×".join(map(str, pattern))
        name = {"6×6": "X-Trans, 6×6", "2×2": sites}.get(size, size)
        raise CaptureFileError(
            f"has a mosaic of {name} pixels, and {', '.join(PATTERNS)} are read; save its colours, "
            "rawpy.imread(path).postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16)"
        )
    facts: _Facts = {"bayer": sites} if sites else {}
    facts |= {"black_level": float(np.max(black))} if len(black) in (1, 4) else {}
    if len(white) == 0 or white[0] >= 2**16 - 1:  # which may stand for none
        return facts
    return facts | {"white_level": int(white[0]), "bits": max(8, int(white[0]).bit_length())}


def _levelled(pixels: np.ndarray, black: Any, white: Any) -> np.ndarray:
    """Pixels of 2×2 black levels, raised to the highest of them; what is saturated stays so."""
    if len(black) != 4 or np.ptp(black) == 0 or pixels.dtype.kind != "u":
        return pixels
    tile = np.rint(np.max(black) - np.reshape(black, (2, 2))).astype(np.int64)
    rows, columns = pixels.shape
    raised = pixels + np.tile(tile, ((rows + 1) // 2, (columns + 1) // 2))[:rows, :columns]
    most = min([*map(int, white[:1]), np.iinfo(pixels.dtype).max])
    return np.where(pixels < most, np.minimum(raised, most), pixels).astype(pixels.dtype)


def _read_jpeg(data: bytes) -> tuple[list[np.ndarray], _Facts]:
    pixels, facts = _by_pillow(data)
    return [pixels], {"bits": 8, **facts}


def _read_tiff(data: bytes, *, stack: bool) -> tuple[list[np.ndarray], _Facts]:
    """Pixels (y, x) or (y, x, channel) of each image, and facts; no bits for floats."""
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        pages = _whole_pages(file, stack)
        facts, black, white = _tiff_facts(pages[0])
        return [_levelled(_read_page(page), black, white) for page in pages], facts


def _tiff_facts(page: tifffile.TiffPage) -> tuple[_Facts, Any, Any]:
    """Facts about an image by the tags of TIFF and DNG, and its black and white levels."""
    bits, facts = page.bitspersample, {"orientation": page.tags.valueof(ORIENTATION, 1)}
    exif = page.tags.valueof(_EXIF, {}) or {}
    facts |= _exposure(exif.get("ExposureTime"), page.tags.valueof(_EXPOSURE_TIME))
    facts["encoded"] = _is_encoded({"icc_profile": page.tags.valueof(_PROFILE, b"")})
    if page.dtype is not None and page.dtype.kind == "u" and isinstance(bits, int):
        facts |= {"bits": bits} if 8 <= bits <= 16 else {}
    if page.photometric != tifffile.PHOTOMETRIC.CFA:
        return facts, (), ()
    sites = "".join("RGBCMYW"[min(n, 6)] for n in bytes(page.tags.valueof(33422, b"")))
    black, white = (np.ravel(page.tags.valueof(tag, [])) for tag in (50714, 50717))
    return facts | _sensor_facts(sites, page.tags.valueof(33421, ()), black, white), black, white


def _read_page(page: tifffile.TiffPage) -> np.ndarray:
    if page.photometric not in _PLAIN:
        name = getattr(page.photometric, "name", page.photometric)
        raise CaptureFileError(f"stores colours as {name}, no counts; save it as grey or RGB")
    if page.axes not in ("YX", "YXS", "SYX"):
        raise CaptureFileError(f"has axes {page.axes}; give one image (y, x) or (y, x, channel)")
    pixels = page.asarray()
    if page.axes == "SYX":
        pixels = np.moveaxis(pixels, 0, -1)
    alpha = bool(page.extrasamples) and page.extrasamples[-1] in (1, 2)
    return _without_alpha(pixels, alpha and pixels.ndim == 3 and pixels.dtype.kind == "u")


def _whole_pages(file: tifffile.TiffFile, stack: bool) -> list[tifffile.TiffPage]:
    """The file's images, one or those of a stack, without previews of lower resolution."""
    whole = tiff_pages(file)
    same = len({page.shape for page in whole}) == 1
    if len(whole) > 1 and not (stack and same):
        what = "" if same else " of different sizes"
        raise CaptureFileError(f"holds {len(whole)} images{what}; give one image a file")
    return whole


def _without_alpha(pixels: np.ndarray, has_alpha: bool) -> np.ndarray:
    """Pixels without their alpha channel, which must be opaque."""
    if not has_alpha:
        return pixels
    if (pixels[..., -1] != np.iinfo(pixels.dtype).max).any():
        raise CaptureFileError("has transparent pixels, as no capture has; save it without alpha")
    opaque = pixels[..., :-1]
    return opaque[..., 0] if opaque.shape[-1] == 1 else opaque


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Suppress the decoders' remarks on standard error; the exception reports faults."""
    loggers = [logging.getLogger(name) for name in ("tifffile", "imagecodecs")]
    before = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled
