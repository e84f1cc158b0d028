"""Layouts in which lensless cameras' data sets are published, and what is known of some of them.

- DiffuserCam (Monakhova et al., Opt. Express 27, 28075, 2019; Waller-Lab/LenslessLearning,
  commit eaab0fb): float NPY, blue, green, red, upside down; a PSF of four times the pixels.
- Hugging Face (LCAV/LenslessPiCam, commit dcb4aba): Parquet, see `measured.parquet_pairs`.
- Two folders of files with the same names, which may lie in a folder for each split, and in folders
  of their own. FlatNet (Khan et al., TPAMI 2020; siddiquesalman/flatnet, commits 2a5da19, d1dc179)
  lists the captures of its splits in text files, val_meas_….txt or val_source_….txt.
"""

import csv
import dataclasses
import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from thincam_jax._core.files import file_digest, natural_order, read_regular
from thincam_jax._core.text import shortened
from thincam_jax.measured.pairs import Pairs, Stored, TruthAlignment
from thincam_jax.measured.raw import MeasurementError
from thincam_jax.measured.read import SUFFIXES, image_files, read_image, read_photograph

_FOLDERS = (
    *(("captures", "truths"), ("lensless", "lensed"), ("measured", "original")),
    ("measured", "originals"),
    *(("caps_1cap", "orig"), ("imagenet_caps_384_12bit_Feb_19", "orig")),  # FlatNet's
)
_LISTS = ("filenames", "text_files", "data/text_files", ".")  # FlatNet's, of names of captures
_DIFFUSERCAM = (("diffuser_images", "ground_truth_lensed"), ("diffuser", "lensed"))
_ARRAYS = (".mat", ".npz", ".h5", ".hdf5")  # of one array each
_IMAGES = ("tiff", "tif", "png", "npy")
_PSFS = ("psf", "psf_measured", "psf_simulated")
_KNOWN = (
    "'diffuser_images/' with 'ground_truth_lensed/' (or 'diffuser/' with 'lensed/') and psf.tiff; "
    "Parquet files with columns lensless and lensed; folders 'captures/' with 'truths/', "
    "'lensless/' with 'lensed/' or 'measured/' with 'original/', of files with the same names, "
    "which may lie in a folder for each split"
)
CARD, TRUTHS = "README.md", "truth_alignment"  # the card, and its key for a `TruthAlignment`
_SOURCE = "LenslessPiCam dcb4aba, lensless/utils/dataset.py"
_DIGICAM = TruthAlignment((80, 280), (100, 366), turned=True, source=_SOURCE)
_MULTILENS = TruthAlignment((118, 241), (220, 343), source=_SOURCE)
_UPSIDE_DOWN = TruthAlignment(upside_down=True, source=_SOURCE)
# By the name of the repository, which is that of a folder.
PUBLISHED: Mapping[str, TruthAlignment] = {
    "DiffuserCam-Lensless-Mirflickr-Dataset": _UPSIDE_DOWN,
    "DiffuserCam-Lensless-Mirflickr-Dataset-NORM": _UPSIDE_DOWN,
    "TapeCam-Mirflickr-25K": TruthAlignment((45, 295), (95, 428), source=_SOURCE),
    **{
        f"DigiCam-Mirflickr-{masks}-{n}K": _DIGICAM
        for masks in ("SingleMask", "MultiMask")
        for n in (1, 25)
    },
    **dict.fromkeys(("MultiLens-Mirflickr-Ambient", "MultiLens-Mirflickr-Ambient-100"), _MULTILENS),
}


@dataclass(frozen=True, eq=False)
class FilePairs:
    """Files of captures and truths. `reversed_colours`: theirs are blue, green, red."""

    captures: Sequence[Path]
    truths: Sequence[Path]
    reversed_colours: bool = False

    @property
    def names(self) -> Sequence[str]:
        return [_name(path) for path in self.captures]

    def read(self, number: int, bits: int | None) -> Stored:
        capture, path = read_image(self.captures[number], bits=bits), self.truths[number]
        is_array = path.suffix.lower() in _ARRAYS
        truth = read_image(path) if is_array else read_photograph(read_regular(path), str(path))
        if self.reversed_colours:
            capture, truth = (
                dataclasses.replace(one, pixels=one.pixels[..., ::-1]) if one.channels == 3 else one
                for one in (capture, truth)
            )
        return Stored(_name(self.captures[number]), capture, truth)

    def digest(self, number: int) -> str:
        files = file_digest(self.captures[number]), file_digest(self.truths[number])
        return hashlib.sha256(" ".join(files).encode()).hexdigest()


def open_pairs(
    path: str | os.PathLike[str], split: str | None = None, *, bits: int | None = None
) -> Pairs:
    """Open a data set's split, of which nothing but the list of its files is read.

    - `path`: its folder, or a Parquet file. `split`: such as "test" or "train", or "all"; None:
      "test" where there is one.
    - `bits`: bit depth of the camera, where its files do not tell it.

    **Errors**: MeasurementError, one line, for a layout that is not known, which says what is there
    and what is known; for a split that there is not; and for pairs without a partner.
    """
    path = Path(path)
    if not path.exists():
        raise MeasurementError(f"{path}: does not exist; give the folder of a data set")
    found = next((one for maker in LAYOUTS if (one := maker(path, split))), None)
    if found is None:
        raise MeasurementError(f"{path}: {_content(path)}; known layouts are: {_KNOWN}")
    root = path if path.is_dir() else path.parent
    root = root.parent if root.name == "data" else root
    if not len(found):
        raise MeasurementError(f"{path}: its split {found.split!r} has no pairs")
    psfs = {None: psf} if (psf := image_beside(root, _PSFS)) else {}
    # A folder of a cache is named datasets--OWNER--NAME.
    above = (part.split("--")[-1] for part in reversed(root.resolve().parts))
    known = next((PUBLISHED[name] for name in above if name in PUBLISHED), None)
    notes, card = found.notes, _card(root)
    if known is None and TRUTHS in card:
        found = dataclasses.replace(found, alignment=_stated(root, card[TRUTHS]))
    if not psfs:
        masks = ", only patterns of masks" if (root / "masks").is_dir() else ""
        notes += (f"no PSF lies beside the captures{masks}: give --psf",)
    return dataclasses.replace(
        found,
        psfs=psfs,
        alignment=known or found.alignment,
        encoding="linear" if known is _UPSIDE_DOWN else found.encoding,
        psf_channels="mean" if known is _UPSIDE_DOWN else found.psf_channels,
        bits=bits,
        licence=_licence(root, card),
        notes=notes,
    )


def with_psf(pairs: Pairs, psf: Path) -> Pairs:
    """Pairs with a PSF's file; or a folder of one for each mask, named by its label: mask_3.npy.

    **Errors**: MeasurementError for what does not exist, and a folder that lacks one by name.
    """
    if not psf.exists():
        raise MeasurementError(f"{psf}: does not exist; give an image, or a folder of them")
    if not psf.is_dir():
        return dataclasses.replace(pairs, psfs={None: psf})
    labels = {file: re.findall(r"\d+", file.stem)[-1:] for file in image_files(psf)}
    if lone := [file.name for file, label in labels.items() if not label]:
        raise MeasurementError(f"{psf}: {lone[0]} has no label; name PSFs by masks, psf_3.npy")
    return dataclasses.replace(pairs, psfs={int(*n): file for file, n in labels.items()})


def chosen_split(path: Path, splits: Mapping[str, int], split: str | None) -> str:
    """The split that is asked for, or "test", or "all"; MeasurementError for another."""
    if split is None:
        return "test" if "test" in splits else "all"
    if split != "all" and split not in splits:
        there = ", ".join(dict.fromkeys(("all", *splits)))
        raise MeasurementError(f"{path}: has no split {split!r}; there are {there}")
    return split


def image_beside(folder: Path, names: Sequence[str]) -> Path | None:
    """The first image file of one of the names, without its suffix."""
    files = (folder / f"{name}.{suffix}" for name in names for suffix in _IMAGES)
    return next((file for file in files if file.is_file()), None)


def _diffusercam(path: Path, split: str | None) -> Pairs | None:
    here = next((n for n in _DIFFUSERCAM if all((path / one).is_dir() for one in n)), None)
    if here is None:
        return None
    files = _paired(path, *here)
    tables = {name: path / f"dataset_{name}.csv" for name in ("train", "test")}
    lists = {name: _listed(table) for name, table in tables.items() if table.is_file()}
    names = {capture.stem for capture, _ in files}
    splits = {name: len(names.intersection(one)) for name, one in lists.items()}
    split, notes = chosen_split(path, splits, split), ()
    if split != "all":
        named = set(lists[split])
        files = [pair for pair in files if pair[0].stem in named]
        if missing := len(named) - len(files):
            notes = (f"{missing} of the {len(named)} pairs of dataset_{split}.csv are not there",)
    source = "LenslessLearning eaab0fb, utils.py: preplot"
    return Pairs(
        layout="DiffuserCam",
        path=path,
        storage=_files(files, reversed_colours=True),
        split=split,
        splits=splits or {"all": len(files)},
        alignment=TruthAlignment(upside_down=True, source=source),
        encoding="linear",
        psf_channels="mean",
        notes=notes,
    )


def _files(pairs: Sequence[tuple[Path, Path]], reversed_colours: bool = False) -> FilePairs:
    captures, truths = ([pair[n] for pair in pairs] for n in (0, 1))
    return FilePairs(captures, truths, reversed_colours)


def _listed(table: Path) -> list[str]:
    """Names in the first column, im5 of im5.jpg.tiff; the first line is a heading, as published."""
    rows = csv.reader(read_regular(table).decode("utf-8", "replace").splitlines()[1:])
    return [row[0].strip().split(".")[0] for row in rows if row]


def _folders(path: Path, split: str | None) -> Pairs | None:
    if not path.is_dir():
        return None
    roots = {p.name: p for p in sorted(path.iterdir()) if p.is_dir() and _two(p)}
    if here := _two(path):
        roots = {"all": path}
    if not roots:
        return None
    files = {name: _paired(root, *_two(root)) for name, root in roots.items()}
    if here and (named := _lists(path)):
        every = files["all"]
        files = {n: [p for p in every if p[0].name in names] for n, names in named.items()}
        files = {name: pairs for name, pairs in files.items() if pairs} or {"all": every}
    splits = {name: len(pairs) for name, pairs in files.items()}
    split = chosen_split(path, splits, split)
    chosen = [p for name, pairs in files.items() if split in (name, "all") for p in pairs]
    return Pairs("two folders", path, _files(chosen), split, splits)


def _two(path: Path) -> tuple[str, str] | tuple[()]:
    return next((names for names in _FOLDERS if all((path / n).is_dir() for n in names)), ())


def _paired(path: Path, captures: str, truths: str) -> list[tuple[Path, Path]]:
    """Files of both folders with the same name; MeasurementError where none has a partner."""
    by_name = {_name(file): file for file in _listing(path / truths, ".jpg", ".jpeg")}
    listed = _listing(path / captures)
    found = [(file, by_name[_name(file)]) for file in listed if _name(file) in by_name]
    if not found or len(found) < len(listed):
        lone = next((file.name for file in listed if _name(file) not in by_name), "no capture")
        raise MeasurementError(
            f"{path}: of {len(listed)} files in {captures}/ {len(found)} have a partner of their "
            f"name in {truths}/ ({lone} has none); give each capture its truth"
        )
    return found


def _listing(folder: Path, *more: str) -> list[Path]:
    """Files of images and arrays, also in folders, im9 before im10, no hidden ones."""
    known = (*SUFFIXES, *_ARRAYS, *more)
    files = (p for p in folder.rglob("*") if p.suffix.lower() in known and p.name[0] != ".")
    return sorted(files, key=natural_order)


def _name(file: Path) -> str:
    """Name that capture and truth share: x of x.JPEG and of FlatNet's x..png."""
    return file.stem.rstrip(".")


def _lists(path: Path) -> dict[str, set[str]]:
    """Names of the captures that FlatNet lists, by split."""
    found: dict[str, set[str]] = {}
    for file in (file for folder in _LISTS for file in (path / folder).glob("*.txt")):
        split, _, kind = file.stem.partition("_")
        if kind.split("_")[0] in ("meas", "source"):
            lines = read_regular(file).decode("utf-8", "replace").splitlines()
            found.setdefault(split, set()).update(line.split("/")[-1].strip() for line in lines)
    return found


def _parquet(path: Path, split: str | None) -> Pairs | None:
    files = [path] if path.suffix == ".parquet" else sorted(path.glob("*.parquet"))
    files = files or sorted((path / "data").glob("*.parquet"))
    if not files:
        return None
    from thincam_jax.measured.parquet_pairs import open_parquet

    return open_parquet(path, files, split)


LAYOUTS: tuple[Callable[[Path, str | None], Pairs | None], ...] = (_diffusercam, _parquet, _folders)


def _content(path: Path) -> str:
    """Entries of a folder, for a message."""
    if path.is_file():
        return "is a file, no data set"
    entries = sorted(path.iterdir())
    folders = [f"{entry.name}/" for entry in entries if entry.is_dir()]
    others = [entry.name for entry in entries if not entry.is_dir()]
    names = shortened(", ".join([*folders, *others]) or "nothing")
    return f"holds {len(folders)} folders and {len(others)} files ({names})"


def _card(root: Path) -> dict[str, Any]:
    """Front matter of a data set's card; empty where there is none."""
    card = root / CARD
    if not card.is_file():
        return {}
    text = read_regular(card).decode("utf-8", "replace")
    try:
        said = yaml.safe_load(text.split("---")[1]) if text.startswith("---") else None
    except (yaml.YAMLError, IndexError):
        said = None
    return said if isinstance(said, dict) else {}


def _stated(root: Path, given: Any) -> TruthAlignment:
    """The alignment of truths that a card states; MeasurementError for one that is none."""
    try:
        rows, columns = ((int(given[n][0]), int(given[n][1])) for n in ("rows", "columns"))
        return TruthAlignment(rows, columns, turned=bool(given.get("turned")), source=CARD)
    except (TypeError, KeyError, ValueError, IndexError, AttributeError):
        raise MeasurementError(
            f"{root / CARD}: {TRUTHS} is {shortened(str(given))}; give rows: [first, end], "
            "columns: [first, end] and turned: true or false"
        ) from None


def _licence(root: Path, card: Mapping[str, Any]) -> str:
    """The licence of a data set's card, or the first line of its LICENSE."""
    if card.get("license"):
        return f"{card['license']} ({CARD})"
    for name in ("LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE"):
        if (root / name).is_file():
            lines = read_regular(root / name).decode("utf-8", "replace").strip().splitlines()
            return f"{shortened(lines[0]) if lines else 'empty'} ({name})"
    return "not stated"
