"""Pairs of captures and their truths: one object over the layouts in which data sets are published.

Nothing is read before it is asked for. `measured.layouts` recognises the layouts.
"""

import collections
import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import skimage
from jaxtyping import Float32

from thincam_jax._core.grids import block_mean
from thincam_jax.imaging.encoding import decode_srgb
from thincam_jax.measured.raw import MeasurementError, Raw
from thincam_jax.measured.read import read_image
from thincam_jax.measured.write import PreparationLog

Encoding = Literal["linear", "srgb"]
ENCODINGS: dict[Encoding | None, str] = {
    "linear": "linear in light",
    "srgb": "decoded from sRGB",
    None: "decoded from sRGB where they have 8 bit, else linear in light",
}
Span = tuple[int, int]
_STRETCHED = 0.02  # ratio of the truth's pixels that nobody stated


@dataclass(frozen=True)
class TruthAlignment:
    """Part of a camera's image that the truth shows, and how both lie.

    - `rows`, `columns`: the first one and the one after the last, in pixels of the capture, of the
      upright image; None: all.
    - `turned`: captures and PSF are stored turned by 180°, the truths are not.
    - `upside_down`: captures, PSF and truths are all stored upside down.
    - `source`: who says so.
    """

    rows: Span | None = None
    columns: Span | None = None
    turned: bool = False
    upside_down: bool = False
    source: str = "taken for granted: truth and capture cover the same field"

    def __str__(self) -> str:
        spans = (("rows", self.rows), ("columns", self.columns))
        parts = [f"{axis} {span[0]}:{span[1]}" for axis, span in spans if span]
        text = f"truth covers {', '.join(parts) or 'the field of the sensor'}"
        text += "; captures are turned by 180°" * self.turned
        return text + "; all are upside down" * self.upside_down + f" ({self.source})"

    def matched(
        self,
        image: Float32[np.ndarray, "channel y x"],
        truth: Float32[np.ndarray, "colour v u"],
        log: PreparationLog,
    ) -> tuple[Float32[np.ndarray, "channel p q"], Float32[np.ndarray, "channel p q"]]:
        """Image and truth on the same pixels, those of the image, upright, of as many channels.

        - `image`: the part in front of the sensor, by a preparation with this `log`.

        The truth is averaged, or where that does not fit, interpolated linearly. A grey capture is
        compared with the mean of the truth's channels.

        **Errors**: MeasurementError where they do not overlap.
        """
        halved = log.options.bayer is not None and log.options.demosaicing == "superpixel"
        parts: list[tuple[slice, slice]] = []
        for axis, span in enumerate((self.rows, self.columns)):
            whole = log.capture.shape[axis] // (2 if halved else 1)
            low, high = (n // (2 if halved else 1) for n in span) if span else (0, whole)
            begin, size = log.first_pixel[axis], log.cropped_to[axis]
            begin = whole - begin - size if self.turned else begin
            first, last = max(low, begin), min(high, begin + size)
            if last <= first:
                raise MeasurementError(
                    f"the truth covers pixels {low}:{high}, of which the capture has none; give "
                    f"others, up to {whole}"
                )
            pixel, scale = size / image.shape[1 + axis], truth.shape[1 + axis] / (high - low)
            here = slice(round((first - begin) / pixel), round((last - begin) / pixel))
            parts.append((here, slice(round((first - low) * scale), round((last - low) * scale))))
        self.check_shapes(log.capture.shape, truth.shape[1:])
        image = image[:, ::-1, ::-1] if self.turned else image
        (rows, seen_rows), (columns, seen_columns) = parts
        image, truth = image[:, rows, columns], truth[:, seen_rows, seen_columns]
        if len(image) == 1 or len(truth) == 1:
            truth = truth.mean(axis=0, keepdims=True).repeat(len(image), axis=0)
        if len(image) != len(truth):
            raise MeasurementError(f"the image has {len(image)} channels and truth {len(truth)}")
        truth = _resized(truth, (image.shape[1], image.shape[2]))
        return (image[:, ::-1], truth[:, ::-1]) if self.upside_down else (image, truth)

    def check_shapes(self, capture: Sequence[int], truth: Sequence[int]) -> None:
        """MeasurementError where nobody said what truths cover, and pixels would be stretched."""
        (rows, columns), (high, wide) = capture[:2], truth[:2]
        given = zip((self.rows, self.columns), (rows, columns), strict=True)
        seen = [span[1] - span[0] if span else whole for span, whole in given]
        stretched = abs(seen[0] * wide / (seen[1] * high) - 1) > _STRETCHED
        if self.source == TruthAlignment.source and stretched:
            raise MeasurementError(
                f"truths of {high}×{wide} pixels do not cover the capture of {rows}×{columns}; "
                "give what they cover: --truth-area"
            )


def _resized(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    sizes = {n / m for n, m in zip(image.shape[1:], shape, strict=True)}
    factor = min(sizes)
    if len(sizes) == 1 and factor == int(factor):
        return block_mean(image, int(factor))
    whole = (len(image), *shape)
    smooth = skimage.transform.resize(image, whole, order=1, mode="edge", anti_aliasing=True)
    return np.asarray(smooth)


@dataclass(frozen=True, eq=False)
class Stored:
    """Stored images of a pair. `ambient`: capture without the scene; `label`: number of a mask."""

    name: str
    capture: Raw
    truth: Raw
    ambient: Raw | None = None
    label: int | None = None


@runtime_checkable
class Storage(Protocol):
    """Where the pairs are: `names` of them, `read` of one, and `digest` of all that it reads."""

    @property
    def names(self) -> Sequence[str]: ...
    def read(self, number: int, bits: int | None) -> Stored: ...
    def digest(self, number: int) -> str: ...


@dataclass(frozen=True, eq=False)
class PairedCapture:
    """A capture and what it shows.

    - `truth`: (channel, y, x), light, 1 at full scale, on pixels of its own: see `TruthAlignment`.
    - `psf`: that of the mask that took the capture. `background`: an ambient capture, or None.
    - `mask_label`: number of the mask, of a camera that has several.
    """

    name: str
    capture: Raw
    truth: Float32[np.ndarray, "channel y x"]
    psf: Raw | None
    background: Raw | None = None
    mask_label: int | None = None


@dataclass(frozen=True, eq=False)
class Pairs:
    """Captures and truths of a data set's split, read when they are asked for: `pairs[3]`.

    - `layout`, `path`, `split`: kind and place of the files; `splits`: number of pairs of each.
    - `psfs`: file of the PSF by the label of its mask; of one mask by None. May be empty.
    - `alignment`: see `TruthAlignment`. `encoding`: encoding of truths; None: integers of 8 bit are
      sRGB, deeper ones and floats are linear in light.
    - `psf_channels`: published use of the PSF: one for each colour, or their "mean".
    - `bits`: bit depth of the camera; None: that of the files. `licence`: words of the files.
    - `notes`: facts that a user should know, in sentences.

    ```python
    import numpy as np
    from pathlib import Path
    from thincam_jax.measured.layouts import open_pairs

    random = np.random.default_rng(0)
    for folder in ("captures", "truths"):
        Path("mine", folder).mkdir(parents=True)
        for name in "ab":
            np.save(Path("mine", folder, name), random.uniform(size=(12, 16)))
    pairs = open_pairs("mine")
    print(len(pairs), pairs[1].name, pairs[1].truth.shape)  # 2 b (1, 12, 16)
    for batch in pairs.batches(2):
        captures = np.stack([pair.capture.pixels for pair in batch])
    ```
    """

    layout: str
    path: Path
    storage: Storage
    split: str = "all"
    splits: Mapping[str, int] = dataclasses.field(default_factory=dict)
    psfs: Mapping[int | None, Path] = dataclasses.field(default_factory=dict)
    alignment: TruthAlignment = TruthAlignment()
    encoding: Encoding | None = None
    psf_channels: Literal["each", "mean"] = "each"
    bits: int | None = None
    licence: str = "not stated"
    notes: tuple[str, ...] = ()

    @functools.cached_property
    def names(self) -> Sequence[str]:
        """Names of the pairs, listed once: a data set holds ten thousands."""
        return self.storage.names

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, number: int) -> PairedCapture:
        """A pair; MeasurementError, one line, for files that cannot be read."""
        if not 0 <= number < len(self):
            raise IndexError(f"pair {number} of {len(self)}")
        one = self.storage.read(number, self.bits)
        path = self.psf_file(one.label)
        psf = None if path is None else _psf(path)
        light = as_light(one.truth, self.encoding)
        return PairedCapture(one.name, one.capture, light, psf, one.ambient, one.label)

    def psf_file(self, label: int | None = None) -> Path | None:
        """The PSF's file of a mask; None where there is none."""
        return self.psfs.get(label)

    def digest(self, number: int) -> str:
        """SHA-256 of all that is stored of a pair."""
        return self.storage.digest(number)

    def batches(self, size: int, *, ahead: int = 2) -> Iterator[list[PairedCapture]]:
        """All pairs in order, `size` together, the last of them fewer.

        - `ahead`: batches that threads read while the one at hand is worked on.
        """
        if size < 1 or ahead < 0:
            raise ValueError(f"size = {size}, ahead = {ahead}: give at least 1 and 0")
        numbers = [range(n, min(n + size, len(self))) for n in range(0, len(self), size)]
        with ThreadPoolExecutor(max(1, ahead)) as pool:
            reading: collections.deque = collections.deque()
            for chosen in numbers:
                reading.append(pool.submit(lambda part: [self[n] for n in part], chosen))
                if len(reading) > ahead:
                    yield reading.popleft().result()
            while reading:
                yield reading.popleft().result()


_psf = functools.lru_cache(4)(read_image)


def as_light(image: Raw, encoding: Encoding | None = None) -> Float32[np.ndarray, "channel y x"]:
    """Light (channel, y, x) of an image's codes, 1 at full scale; see `Pairs`."""
    codes = np.moveaxis(np.atleast_3d(image.pixels), -1, 0) / image.full_scale
    srgb = encoding == "srgb" or (encoding is None and image.pixels.dtype == np.uint8)
    light = decode_srgb(np.clip(codes, 0, 1)) if srgb else codes
    return light.astype(np.float32)


def relative_pitch(psf: Raw, capture: Raw) -> float | None:
    """`Preparation.psf_scale` of a PSF that covers the capture's field with other pixels.

    Data sets publish PSFs with several times the pixels of their captures. None for equal ones, and
    where rows and columns have different ratios.
    """
    (rows, columns), (k, n) = capture.pixels.shape[:2], psf.pixels.shape[:2]
    return rows / k if (rows, columns) != (k, n) and rows * n == columns * k else None
