"""Masks whose every cell is free, beside random ones, other kinds and the limit of shadows."""

import importlib.util
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from thincam_jax._core.table import Table
from thincam_jax.design.cell_masks import CellMasks
from thincam_jax.design.cell_search import CellDesign, CellJudge, CellSettings, find_cells
from thincam_jax.design.design import shots
from thincam_jax.design.least_error import limit
from thincam_jax.design.objectives import BayesError, Tolerances
from thincam_jax.design.own_sensor import beta_bounds
from thincam_jax.design.problem import design_problem
from thincam_jax.design.recommendation import recommend
from thincam_jax.design.setup import PhotonNoise, Setup
from thincam_jax.design.space import DesignSpace, Variable
from thincam_jax.studies.design_scores import signed


@dataclass(frozen=True)
class KindScores:
    """The best member of a kind of mask; `tried`: members judged."""

    kind: str
    member: str
    captures: int
    error_db: float
    tried: int


@dataclass(frozen=True, eq=False)
class CellStudy:
    """A search for cells, and the `kinds` of `recommend` that it is compared with.

    - `config`: configuration that it was made from, if any.
    """

    setup: Setup
    space: CellMasks
    settings: CellSettings
    tolerances: Tolerances
    kinds: tuple[str, ...]
    config: Any = None

    @property
    def warnings(self) -> list[str]:
        """Warnings before it runs."""
        lacks = self.space.levels == "binary" and importlib.util.find_spec("gdstk") is None
        return ["no mask.gds: layouts need pip install 'thincam_jax[layout]'"] if lacks else []

    def judge(self) -> CellJudge:
        """The judge of all masks.

        **Errors**: MemoryError for more cells than fit, ValueError for tolerances too large.
        """
        return CellJudge.of(self.setup, self.space, self.settings.depths, self.tolerances)

    def limit_db(self) -> float | None:
        """Least error of masks that cast shadows, exact at one distance; None for noise at an SNR.

        As wide, far and many as those searched, in the same light.
        """
        if not isinstance(self.setup.noise, PhotonNoise):
            return None
        width, count = float(self.space.width), self.space.captures
        light, betas = float(self.space.wavelength), beta_bounds(float(self.setup.pitch), width)

        def plates(number: int) -> DesignSpace:
            given = [betas[0]] * number, float(self.space.distance), [0.0]
            free = (Variable("beta", *betas, tuple(range(number))),)
            return DesignSpace(shots(*given, wavelength=light, width=width), free)

        problem = design_problem(BayesError(), plates(1), self.setup, np.eye(1))
        return limit(problem.with_captures(plates(count), np.eye(count))).decibels

    def best_of(self, kind: str) -> list[KindScores]:
        """Scores of a kind's best member; none of a kind that the cells are too coarse for."""
        over = {"depths": self.settings.depths, "tolerances": self.tolerances}
        found = recommend(self.setup, self.space, kinds=(kind,), seed=self.settings.seed, **over)
        return [
            KindScores(one.kind, one.member, len(one.masks), one.decibels, one.evaluations)
            for one in found
        ]

    def find(self, folder: str | os.PathLike[str] | None = None) -> CellDesign:
        """The search, which goes on from its folder."""
        given = self.setup, self.space, self.settings
        return find_cells(*given, folder=folder, tolerances=self.tolerances)

    def scores(
        self, found: CellDesign, limit_db: float | None, kinds: Sequence[KindScores]
    ) -> "CellScores":
        """Figures of what was found."""
        best, random = (10 * math.log10(error) for error in (found.error, found.random))
        counts = self.space.captures, found.evaluations, self.settings.draws
        return CellScores(best, random, *counts, limit_db, kinds)

    def psfs(self, found: CellDesign) -> tuple[np.ndarray, float]:
        """PSFs (capture, y, x) of the masks, as wide as the sensor, and their samples' pitch."""
        optics = self.judge().optics
        pitch, amplitudes = float(optics.grid.pitch), [mask.amplitude for mask in found.masks]
        psfs = np.stack([np.asarray(optics(jnp.asarray(one))) for one in amplitudes])
        cut = max(0, (psfs.shape[-1] - round(float(self.setup.sensor_width) / pitch)) // 2)
        return psfs[:, cut : psfs.shape[1] - cut, cut : psfs.shape[2] - cut], pitch


@dataclass(frozen=True)
class CellScores:
    """Expected errors, dB of the scene's variance.

    - `found_db`: error of the cells found, by so many `evaluations`.
    - `random_db`: error of the best of `draws` random masks.
    - `kinds`: other kinds of mask. `limit_db`: limit of shadows, if any.
    """

    found_db: float
    random_db: float
    captures: int
    evaluations: int
    draws: int
    limit_db: float | None
    kinds: Sequence[KindScores]

    def table(self) -> Table:
        """All masks, the best first, and the limit."""
        rows = [
            ("cells found", self.found_db, None, self.captures, self.evaluations),
            ("best random masks", self.random_db, None, self.captures, self.draws),
            *((k.kind, k.error_db, k.member, k.captures, k.tried) for k in self.kinds),
        ]
        if (least := self.limit_db) is not None:
            rows.append(("limit of shadows", least, None, None, None))
        rows.sort(key=lambda row: row[1])
        headings = "masks", "expected\nerror, dB", "best of them", "captures", "tried"
        if least is None:
            return Table(headings, rows, (2,), words=(2,))
        beside = [None if row[1] == least else signed(row[1] - least, 2) for row in rows]
        rows = [(*row[:2], text, *row[2:]) for row, text in zip(rows, beside, strict=True)]
        headings = *headings[:2], "beside the\nlimit, dB", *headings[2:]
        return Table(headings, rows, (2,), words=(3,))

    def findings(self) -> list[str]:
        """The result in sentences, the main one first."""
        first = f"The cells found have an expected error of {self.found_db:.2f} dB"
        if self.limit_db is not None:
            beside = self.found_db - self.limit_db
            side = "below" if beside < 0 else "above"
            first += f", {abs(beside):.2f} dB {side} the limit of shadows"
        lines = [f"{first}.", self._beside(self.random_db, "the best random masks")]
        if self.kinds:
            best = min(self.kinds, key=lambda one: one.error_db)
            words = f"{best.kind} ({best.member}), the best of the other kinds"
            lines.append(self._beside(best.error_db, words))
        return lines

    def _beside(self, decibels: float, words: str) -> str:
        side = "better" if self.found_db < decibels else "worse"
        return f"They are {abs(self.found_db - decibels):.2f} dB {side} than {words}."

    def levels(self) -> str:
        """The main result, a line below the table."""
        return self.findings()[0]
