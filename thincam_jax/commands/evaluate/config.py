"""Options of an evaluation but for its methods and the number of pairs, which may grow."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

from thincam_jax._core.text import slug
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.reconstruct.options import (
    PSF_METHODS,
    Recipe,
    Sources,
    is_trained,
    read_background,
)
from thincam_jax.commands.schema import Section
from thincam_jax.measured import MeasurementError, Preparation
from thincam_jax.measured.layouts import open_pairs, with_psf
from thincam_jax.measured.pairs import Encoding, Pairs, TruthAlignment
from thincam_jax.studies.agreement import Fit

# Options of solvers, and the methods that use them.
_VARIATION = ("admm_tv", "fista", "auto")
_USED_BY = {"tau": _VARIATION, "coupling": _VARIATION, "ridge": ("ridge",)}


def label_of(method: str) -> str:
    """Name of a method in tables and files."""
    return slug(Path(method).stem) if is_trained(method) else method


class EvaluationConfig(Section):
    """Options of `thincam evaluate` as they were resolved."""

    name: str
    title: str
    path: str
    split: str
    psf: str | None = None
    background: str | None = None
    psf_background: str | None = None
    dead: str | None = None
    bits: int | None = None
    psf_bits: int | None = None
    preparation: Preparation = Preparation()
    tau: float | None = None
    ridge: float | None = None
    coupling: Literal["none", "joint", "opponent"] | None = None
    iterations: int | None = None
    noise: float | None = None
    strict: bool = False
    truth: Encoding | None = None
    rows: tuple[int, int] | None = None
    columns: tuple[int, int] | None = None
    flip: bool = False
    fit: Fit = "levels"
    shift: int = 0

    def pairs(self) -> Pairs:
        """The split, with what these options say of its PSF, its truths and their place."""
        pairs = open_pairs(self.path, self.split, bits=self.bits)
        if self.psf is not None:
            pairs = with_psf(pairs, Path(self.psf))
        if not pairs.psfs:
            raise MeasurementError(f"{self.path}: {pairs.notes[-1]}, a file or a folder by masks")
        changes: dict[str, Any] = {}
        if self.truth is not None:
            changes["encoding"] = self.truth
        if self.rows is not None or self.flip:
            was = pairs.alignment
            changes["alignment"] = TruthAlignment(
                self.rows or was.rows,
                self.columns or was.columns,
                turned=was.turned != self.flip,
                upside_down=was.upside_down,
                source="given",
            )
        pairs = dataclasses.replace(pairs, **changes)
        try:
            first = pairs[0]
        except MeasurementError:
            return pairs  # reported with the scores
        pairs.alignment.check_shapes(first.capture.pixels.shape, first.truth.shape[1:])
        return pairs

    def sources(self, psf: Path, psf_scale: float | None) -> Sources:
        """Files and preparation as of `thincam reconstruct`, for the PSF of a mask."""
        options = {**vars(self.preparation), "psf_scale": self.preparation.psf_scale or psf_scale}
        return Sources(
            psf,
            read_background(self.background),
            read_background(self.psf_background),
            None if self.dead is None else Path(self.dead),
            self.bits,
            Preparation(**options),
            self.psf_bits,
        )

    def recipe(self, method: str) -> Recipe:
        """The method with those of the options that it has."""
        options = {name: getattr(self, name) for name, used in _USED_BY.items() if method in used}
        others = {name: getattr(self, name) for name in ("iterations", "noise", "strict")}
        if is_trained(method):
            del others["iterations"]
        return Recipe(method, **options, **others)

    def check(self, methods: tuple[str, ...]) -> None:
        """Refuse unknown methods, options that none of them has, and values out of range."""
        labels = [label_of(method) for method in methods]
        if len(set(labels)) < len(labels):
            raise ConfigError(f"--method: {', '.join(labels)} has one twice; give each once")
        for name, used in _USED_BY.items():
            if getattr(self, name) is not None and not set(used) & set(methods):
                able = ", ".join(one.replace("_", "-") for one in used)
                raise ConfigError(f"--{name} is used by {able}; leave it out, or add one of these")
        if self.shift < 0:
            raise ConfigError(f"--shift {self.shift}: give 0 or more pixels")
        for method in methods:
            if method not in PSF_METHODS and not is_trained(method):
                known = ", ".join(one.replace("_", "-") for one in PSF_METHODS)
                raise ConfigError(f"--method {method}: is unknown here; choose from {known}")
            self.recipe(method)
