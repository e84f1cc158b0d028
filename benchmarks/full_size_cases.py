"""Cells found in other cases than one capture at 6.5 mm: `python benchmarks/full_size_cases.py`.

Camera, object and light are those of experiments/full_size_design.py. Cases: two and four captures
that share the exposure; masks 2, 4 and 8 mm before the sensor; depths of 150, 250 and 1000 mm that
are not refocused. Searches are the flips that end `find_cells` alone: from the best masks of
`recommend`, and from the cells found for one capture. Each case runs in a process of its own, whose
memory is its peak; what is finished is kept in a folder, and it goes on from there. Lengths in mm.
"""

import json
import math
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import thincam_jax as tc
from thincam_jax.design import CellMasks, limit, recommend
from thincam_jax.design.cell_masks import drawn_cells
from thincam_jax.design.cell_search import CellJudge, CellSettings, _logarithm, _Problem
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.design.recommendation import MaskJudge
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "full_size_cases"
IMAGES = Path(__file__).resolve().parents[1] / "docs/images"

full = SIZE == "full"
count, pitch, cells, cell = (1024, 5.5 * um, 512, 11 * um) if full else (64, 22 * um, 32, 44 * um)
far, wave, width = 250.0, 500 * nm, count * pitch
LITTLE, PLENTY = (2e3, 2e5) if full else (2e6, 2e7)
LIGHTS = {"plenty of": PLENTY, "little": LITTLE}
DRAWS = 24 if full else 2
KINDS = "lenses of zones", "random cells", "one opening"


class Case(NamedTuple):
    """Light, captures, distance between mask and sensor, and depths of the scene."""

    electrons: float
    captures: int = 1
    distance: float = 6.5
    depths: tuple[float, ...] = (far,)
    flips: int = 50


CASES = {
    "2 captures, little light": Case(LITTLE, 2),
    "4 captures, little light": Case(LITTLE, 4),
    "2 captures, plenty of light": Case(PLENTY, 2),
}
for light, electrons in LIGHTS.items():
    for away in (2.0, 4.0, 6.5, 8.0):
        CASES[f"{away:g} mm, {light} light"] = Case(electrons, distance=away, flips=40)
    CASES[f"150 mm to 1 m, {light} light"] = Case(electrons, depths=(150.0, far, 1000.0), flips=30)


def setup_of(electrons: float) -> tc.design.Setup:
    noise, prior = tc.design.PhotonNoise(electrons, 8.0), tc.design.PowerLaw(2.8)
    return tc.design.Setup(pitch, width, far, 179 * width / 5.632, noise=noise, prior=prior)


def known(electrons: float) -> np.ndarray:
    """Cells that were found for one capture at 6.5 mm."""
    if not full:
        return np.pad(np.ones((2, 2), bool), cells // 2 - 1)
    end = "-little" if electrons == LITTLE else ""
    return np.asarray(tc.read_mask(IMAGES / f"full-size-cells{end}.png", cell).amplitude) > 0


def judged(amplitudes: Any, case: Case) -> float:
    """Expected error, dB: at one depth by exact PSFs, over depths as `recommend` judges."""
    setup, grids = setup_of(case.electrons), len(amplitudes)
    if len(case.depths) > 1:
        space = CellMasks(cell, cells, distance=case.distance, wavelength=wave)
        return 10 * math.log10(MaskJudge(setup, space, case.depths)(np.asarray(amplitudes, float)))
    wide = tc.Sensor((count + count // 6 * 2,) * 2, pitch)
    masks = [tc.SampledMask(np.asarray(one, float), cell) for one in amplitudes]
    cameras = [tc.LenslessCamera(mask, wide, case.distance) for mask in masks]
    psfs = [tc.psf(camera, wavelength=wave, object_distance=far) for camera in cameras]
    error = ExpectedError(setup, [wide.grid] * grids, [case.distance] * grids, padding=1.5)
    return 10 * math.log10(float(jax.jit(lambda h, e: e(h))(psfs, error)))


def least_of_shadows(case: Case) -> float:
    """The limit, dB."""
    plate = tc.design.shots([25.0], case.distance, [0.0], wavelength=wave, width=width)
    free = tc.design.DesignSpace(plate, (tc.design.Variable("beta", 5.0, 30.0, (0,)),))
    setup = setup_of(case.electrons)
    return limit(tc.design.design_problem(tc.design.BayesError(), free, setup, np.eye(1))).decibels


def run(name: str) -> None:
    """Judge the rivals of a case, search from its starts, and write what is known."""
    case, file = CASES[name], FIGURES / f"{name}.json"
    record: dict[str, Any] = {"rivals": {}, "searches": {}}
    if file.exists():
        record = json.loads(file.read_text())
    space = CellMasks(cell, cells, distance=case.distance, wavelength=wave, captures=case.captures)
    setup, own = setup_of(case.electrons), known(case.electrons)
    starts: dict[str, Any] = {}
    if case.captures > 1:
        turned = np.stack([np.rot90(own, turn) for turn in range(case.captures)])
        starts = {"cells of one capture, turned": turned, "random cells": None}
        masks: dict[str, Any] = {"cells of one capture": own[None], [*starts][0]: turned}
    else:
        masks = {f"cells for {word} light": known(e)[None] for word, e in LIGHTS.items()}
        best = recommend(setup, space, depths=case.depths, kinds=KINDS)
        masks |= {f"{kind.kind}, {kind.member}": kind.amplitudes for kind in best}

    def kept(part: str, key: str, value: Any) -> None:
        record[part][key] = value
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(record, indent=1))

    problem = _Problem(space, CellJudge.of(setup, space, case.depths, nodes=4))
    record["limit"] = least_of_shadows(case)
    for rival, amplitudes in masks.items():
        if rival not in record["rivals"]:
            one_capture = case._replace(captures=len(amplitudes))
            kept("rivals", rival, judged(amplitudes, one_capture))
            print(f"{name}, {rival}: {record['rivals'][rival]:.2f} dB", flush=True)
    if case.captures == 1:  # the best of them, and the best opening
        leading = min(masks, key=record["rivals"].__getitem__)
        starts = {one: masks[one] for one in masks if "opening" in one or one == leading}
    for start, amplitudes in starts.items():
        if start in record["searches"]:
            continue
        begun, draws = time.perf_counter(), 0
        if amplitudes is None:
            draws = DRAWS
            rng = np.random.default_rng(0)
            every = [jnp.asarray(drawn_cells(space, rng), float) for _ in range(draws)]
            numbers = min(every, key=lambda cells: float(_logarithm(problem, cells))) - 0.5
        else:
            numbers = jnp.asarray(amplitudes.reshape(case.captures, -1) - 0.5, float)
        numbers, _, slopes = problem.flipped(numbers, CellSettings(flips=case.flips if full else 2))
        amplitudes = np.asarray(numbers).reshape(-1, cells, cells) > 0
        seconds = time.perf_counter() - begun
        np.savez_compressed(FIGURES / f"{name}, {start}.npz", np.packbits(amplitudes))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        each = [judged(amplitudes, case), seconds, draws + 3 * slopes, memory]
        kept("searches", start, each)
        print(f"{name}, from {start}: {each}", flush=True)


def table(several: bool) -> str:
    """Rows of the finished cases, of several captures or of one; costs are of all searches."""
    kinds = ("cells of one capture", "turned") if several else ("plenty", "little", *KINDS)
    costs = "seconds", "evaluations", "GB"
    head = "case", "limit", *kinds, "found from", "found from", *costs
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, case in CASES.items():
        file = FIGURES / f"{name}.json"
        if (case.captures > 1) is not several or not file.exists():
            continue
        record = json.loads(file.read_text())
        known = [f"{value:.2f}" for value in record["rivals"].values()]
        if not several:  # in the order of KINDS
            rivals = record["rivals"].items()
            known[2:] = [f"{v:.2f} ({k[len(n) + 2 :]})" for n in KINDS for k, v in rivals if n in k]
        each = record["searches"]
        found = [f"{one[0]:.2f} ({start.split(',')[0]})" for start, one in each.items()] + ["–"]
        seconds, evaluations = (sum(one[n] for one in each.values()) for n in (1, 2))
        memory = max([one[3] for one in each.values()], default=0.0)
        numbers = f"{seconds:.0f}", str(evaluations), f"{memory:.1f}"
        row = name, f"{record['limit']:.2f}", *known, *found[:2], *numbers
        lines.append("| " + " | ".join(row).replace("-", "−") + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    if names := sys.argv[1:]:
        for name in names:
            run(name)
    else:
        for name in CASES:
            subprocess.run([sys.executable, __file__, name], check=True)
        print(table(True), table(False), sep="\n\n")
