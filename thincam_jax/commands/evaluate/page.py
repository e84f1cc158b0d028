"""The page of an evaluation: its table, the worst, median and best image, and how they compare."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml

from thincam_jax._core.files import read_regular
from thincam_jax._core.table import Cell, Table
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.evaluate.config import EvaluationConfig
from thincam_jax.commands.report import Gallery, Page, Part, Picture, Sentences
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.imaging.encoding import eight_bit, encode_srgb, png_bytes
from thincam_jax.measured.pairs import ENCODINGS, Pairs
from thincam_jax.studies.agreement import FITS, scores_table

if TYPE_CHECKING:
    from thincam_jax.commands.evaluate.run import Evaluated

_UNITS = (
    "parts of the truth's full scale, by one gain and offset for all images",
    "parts of the image's range, from the 1st to the 99th percentile, its gain and offset fitted",
)
_NEEDED = ("dataset", "method", "protocol", "source")
_MOST = 10  # failures, and findings, that a page lists


def whole_page(
    config: EvaluationConfig,
    pairs: Pairs,
    found: "Evaluated",
    pictures: Sequence[Part],
    published: Table | None,
) -> Page:
    """The page; `pictures`: parts of the worst, the median and the best pair."""
    shift = "not moved"
    if config.shift:
        shift = f"moved by up to {config.shift} pixels to where it correlates best"
    lines = [
        "PSNR and SSIM are of light, 1 being the truth's full scale, over all channels. Truths are "
        f"{ENCODINGS[pairs.encoding]}.",
        f"Levels: {FITS[config.fit]}.",
        f"Place: {pairs.alignment}; the image is {shift}.",
        "Intervals of 90 % about each pixel are calibrated by other images, and hold on average: a "
        f"single image may have fewer inside. Their width is in {_UNITS[config.fit == 'levels']}.",
        "Means have their interval of 95 % over the images, by Student's t. The residual is that "
        "of the capture, ‖Hf − g‖/‖g‖. Seconds are the median's.",
        "Images are those of `thincam reconstruct` with the same options.",
    ]
    failed = _first([f"{name}: {reason}" for name, reason in found.failures.items()])
    findings = _first([f"{name}: {'; '.join(words)}" for name, words in found.findings.items()])
    others = (published, "Protocols differ from ours and from each other.") if published else ()
    parts = (
        *pictures,
        Part("How images and truths are compared", (Sentences(lines),), "Comparison"),
        Part("Published figures", others),
        Part("Failed", (Sentences(failed),) if failed else ()),
        Part("Findings in files and images", (Sentences(findings),) if findings else ()),
        Part("Data set", (facts_table(pairs),)),
    )
    return Page((scores_table(found.scores),), parts, command="")


def _first(lines: list[str]) -> list[str]:
    more = len(lines) - _MOST
    return [*lines[:_MOST], *([f"and {more} more images"] if more > 0 else [])]


def pictures(
    folder: RunFolder,
    word: str,
    name: str,
    shown: Mapping[str, Mapping[str, np.ndarray]],
    psnrs: Mapping[str, float | None],
) -> Part:
    """Capture, truth and image of each method of a pair, written as images/WORD-….png."""
    drawn: dict[str, tuple[np.ndarray, str]] = {}
    for method, images in shown.items():
        for what in images:
            label = method.replace("_", "-") if what == "image" else what
            psnr = psnrs.get(method) if what == "image" else None
            drawn[label] = images[what], "" if psnr is None else f"\n{psnr:.2f} dB"
    found = []
    for label in sorted(drawn, key=lambda one: (one != "capture", one != "truth")):
        light, more = drawn[label]
        file = f"{word}-{label}.png"
        folder.write(f"images/{file}", _png(light, own_white=label == "capture"))
        found.append(Picture(file, f"{label} of the {word} pair", label + more))
    return Part(f"{word.capitalize()}: {name}", (Gallery(found),), word)


def _png(light: np.ndarray, own_white: bool) -> bytes:
    """PNG of light from 0 to 1, in sRGB; that of a capture ends at its own white."""
    light = light[:3] if len(light) > 2 else light[:1]
    codes = np.round(255 * encode_srgb(np.clip(light, 0, 1))).astype(np.uint8)
    codes = eight_bit(light) if own_white else codes
    return png_bytes(codes[0] if len(codes) == 1 else np.moveaxis(codes, 0, -1))


def facts_table(pairs: Pairs) -> Table:
    """Facts about a data set, and its first pair."""
    pair = pairs[0]
    raw, (channels, rows, columns) = pair.capture, pair.truth.shape
    bits = "floats" if raw.bits is None else f"{raw.bits} bit"
    low, high = raw.pixels.min(), raw.pixels.max()
    psf = "none" if pair.psf is None else _size(pair.psf.pixels)
    masks = f", one for each of {len(pairs.psfs)} masks" if len(pairs.psfs) > 1 else ""
    facts: dict[str, str] = {
        "layout": pairs.layout,
        "splits": ", ".join(f"{name}: {count}" for name, count in pairs.splits.items()),
        "this split": f"{pairs.split}, {len(pairs)} pairs",
        "captures": f"{_size(raw.pixels)}, {bits}, {low:.3g} to {high:.3g}",
        "truths": f"{rows}×{columns} pixels, channels: {channels}, {ENCODINGS[pairs.encoding]}",
        "PSF": psf + masks,
        "background": "an ambient capture each" if pair.background else "none here",
        "alignment": str(pairs.alignment),
        "licence": pairs.licence,
        "note": "; ".join(pairs.notes) or "none",
    }
    lines: list[list[Cell]] = [list(fact) for fact in facts.items()]
    return Table(("", str(pairs.path)), lines, words=(1,))


def _size(pixels: np.ndarray) -> str:
    rows, columns, *channels = pixels.shape
    return f"{rows}×{columns} pixels" + (f", channels: {channels[0]}" if channels else "")


def read_published(path: Path | None) -> Table | None:
    """A table of figures that others have published: a YAML list of entries.

    **Errors**: ConfigError, one line, for an entry without its protocol and source.
    """
    if path is None:
        return None
    try:
        entries = yaml.safe_load(read_regular(path).decode("utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"--published {path}: {' '.join(str(error).split())}") from None
    lines: list[list[Cell]] = []
    for number, entry in enumerate(entries if isinstance(entries, list) else [entries], 1):
        lacks = [n for n in _NEEDED if not isinstance(entry, dict) or not entry.get(n)]
        if lacks:
            raise ConfigError(f"--published {path}: entry {number} has no {', '.join(lacks)}")
        numbers = (entry.get(name) for name in ("images", "psnr_db", "ssim", "lpips"))
        scores = [None if value is None else str(value) for value in numbers]
        lines.append([*(entry[n] for n in _NEEDED[:2]), *scores, *(entry[n] for n in _NEEDED[2:])])
    headings = ("data set", "method", "images", "PSNR, dB", "SSIM", "LPIPS", "protocol", "source")
    return Table(headings, lines, published=(2, 3, 4, 5), words=(1, 6, 7))
