"""Count the files that a call leads through: `python benchmarks/walks.py [--files] [WALK ...]`.

Without names it counts all, and writes them into the table of docs/measured/walks.md.

A reader follows a call as the interpreter does, but reads each function once, where it is first
called. Functions that follow each other in one file are one stay there; coming back to a file that
was left is a return. Compiled programs are forgotten before, so that what is traced is read, too.
Not counted is `_core`, whose checks and conversions every room calls. A second count takes
`lensless/resolve.py` by its word: all that is examined and chosen before a PSF is computed.
"""

import argparse
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import thincam_jax as tc
from thincam_jax.units import nm, um

PACKAGE = Path(tc.__file__).parent
PAGE = Path(__file__).parents[1] / "docs/measured/walks.md"
LEFT_OUT = ("_core/", "__init__.py")


@dataclass(frozen=True)
class Walk:
    """Files of the package in the order in which a call leads there."""

    stays: tuple[str, ...]

    @property
    def files(self) -> int:
        """Different files."""
        return len(set(self.stays))

    @property
    def returns(self) -> int:
        """Stays in a file that was left before."""
        return len(self.stays) - self.files

    def __str__(self) -> str:
        return f"{self.files} files, {len(self.stays)} stays, {self.returns} returns"


def walk(call: Callable[[], Any], closed: Collection[str] = ()) -> Walk:
    """The walk of a call, which is made once before, so that nothing is imported.

    `closed`: functions that are called, but not read.
    """
    stays: list[str] = []
    read: set[Any] = set()
    inside: list[Any] = []  # the frame of a closed function

    def profile(frame: Any, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "return" and inside == [frame]:
            inside.clear()
        file = Path(code.co_filename)
        if event != "call" or inside or code in read or not file.is_relative_to(PACKAGE):
            return
        read.add(code)
        path = file.relative_to(PACKAGE).as_posix()
        if not path.startswith(LEFT_OUT) and path != (stays or [""])[-1]:
            stays.append(path)
        if code.co_name in closed:
            inside.append(frame)

    call()
    jax.clear_caches()
    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
    return Walk(tuple(stays))


def psf() -> Callable[[], Any]:
    """A camera's PSF on the axis."""
    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    return lambda: tc.psf(camera, wavelength=500 * nm, object_distance=250.0)


def admm_tv() -> Callable[[], Any]:
    """A recording of one capture with a measured PSF, through ADMM-TV."""
    measured = np.random.default_rng(0).random((24, 32), dtype=np.float32)
    recording = tc.Recording([measured], tc.Psfs(measured[None]))
    return lambda: tc.reconstruct(recording, tc.AdmmTV(iterations=3))


def take() -> Callable[[], Any]:
    """One exposure of a study."""
    from thincam_jax.commands.kinds import load_experiment
    from thincam_jax.commands.study.build import build_study
    from thincam_jax.studies import evaluate

    study = build_study(load_experiment(PACKAGE.parent / "configs/quick.yaml"))
    return lambda: evaluate.take(study, study.exposures[0], study.targets[0])


def yaml_to_fringe() -> Callable[[], Any]:
    """β from an experiment file to the fringes that its zone plate casts."""
    from thincam_jax.commands.kinds import load_experiment
    from thincam_jax.commands.study.build import assemble

    def call() -> None:
        study = assemble(load_experiment(PACKAGE.parent / "configs/quick.yaml"))
        study.psf(study.exposures[0])

    return call


WALKS = (psf, admm_tv, take, yaml_to_fringe)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("walks", nargs="*", help=", ".join(one.__name__ for one in WALKS))
    parser.add_argument("--files", action="store_true", help="print the files in their order")
    asked = parser.parse_args()
    page = PAGE.read_text("utf-8").splitlines()
    first = next(n for n, line in enumerate(page) if line.startswith("|---")) + 1
    for row, one in enumerate(WALKS, first):
        if asked.walks and one.__name__ not in asked.walks:
            continue
        call = one()
        found, beside = walk(call), walk(call, {"resolve"})
        print(f"{one.__name__}: {found}; without what is resolved before: {beside}")
        if asked.files:
            print("  " + " ".join(beside.stays))
        counts = (f"{w.files}, {len(w.stays)}, {w.returns}" for w in (found, beside))
        page[row] = "|".join((*page[row].split("|")[:3], *(f" {text} " for text in counts), ""))
    if not asked.walks:
        PAGE.write_text("\n".join(page) + "\n", "utf-8")


if __name__ == "__main__":
    main()
