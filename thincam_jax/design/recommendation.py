"""Kinds of mask for a sensor, a scene and its light, each by its best member.

A kind has one or two numbers, such as the side of an opening; all of its members are made of the
same cells and judged by exact diffraction and the error of the best linear image over the field
(`ExpectedError`). Several depths count alike, each in an image that is made for the middle one.
"""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Complex, Float
from scipy.spatial import KDTree

from thincam_jax._core.arguments import checked
from thincam_jax._core.precision import decimal_value
from thincam_jax._core.progress import watched
from thincam_jax._core.table import Table
from thincam_jax.design.cell_masks import CellMasks, drawn_cells
from thincam_jax.design.cell_search import CellJudge
from thincam_jax.design.objectives import Tolerances
from thincam_jax.design.setup import Setup
from thincam_jax.lensless.masks.cells import ModifiedUniformlyRedundantArray
from thincam_jax.lensless.masks.phase import relaxed_sites
from thincam_jax.lensless.masks.sampled import SampledMask

Transmittances = Float[np.ndarray, "capture y x"] | Complex[np.ndarray, "capture y x"]
# A member: what its numbers are, and the amplitudes of its captures.
Members = Iterator[tuple[str, Transmittances]]

_PRIMES = (5, 11, 23, 43, 101, 251, 509)
_DRAWN = 24  # random masks


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The best member of a kind.

    - `kind`, `member`: their names; `error`: expected, as a part of the scene's variance.
    - `amplitudes`: transmittance of every cell of each capture; `masks`: the masks.
    - `evaluations`: members judged.
    """

    kind: str
    member: str
    error: float
    amplitudes: Transmittances
    masks: list[SampledMask]
    evaluations: int

    @property
    def decibels(self) -> float:
        return 10 * math.log10(self.error)

    @property
    def numbers(self) -> Float[Array, "capture free"]:
        """Free numbers of open and closed cells, a `start` of `find_cells`."""
        if not np.all(np.isin(self.amplitudes, (0, 1))):
            raise ValueError(f"{self.kind} are not open and closed cells: start from another kind")
        return jnp.asarray(self.amplitudes.reshape(len(self.amplitudes), -1) - 0.5, float)


class Recommendations(tuple[Recommendation, ...]):
    """The best member of each kind, the best kind first; as text a table."""

    def table(self) -> Table:
        rows = [(r.kind, r.member, len(r.masks), r.decibels, r.evaluations) for r in self]
        headings = "masks", "best of them", "captures", "expected error, dB", "tried"
        title = "Judged by PSFs on the axis: off it, masks that focus lose more."
        return Table(headings, rows, (0, 0, 2, 0), title, words=(1,))

    def __str__(self) -> str:
        return str(self.table())

    def _repr_markdown_(self) -> str:
        return str(self)


@checked
def recommend(
    setup: Setup,
    space: CellMasks,
    *,
    depths: Sequence[float] | None = None,
    kinds: Sequence[str] | None = None,
    tolerances: Tolerances | None = None,
    seed: int = 0,
) -> Recommendations:
    """The best member of each kind of mask for a sensor, a scene and its light.

    **Arguments**

    - `setup`: sensor, scene and noise. All captures of a kind share its light.
    - `space`: cells, their distance from the sensor, and the wavelength; of it `captures`, `levels`
      and `rings` do not count, since kinds have their own.
    - `depths`: distances of the scene, mm, in each of which the image for the middle one is judged;
      by default the setup's alone.
    - `kinds`: by default all of `KINDS`; those of phases let all light through.
    - `tolerances`: standard deviations that the error is the mean over, see `find_cells`.
    - `seed`: seed for what is random.

    Some 120 members: two minutes for 512² cells before 1024² pixels. `find_cells` refines
    open and closed cells from there: `start=best.numbers`.

    **Validity**: that of `find_cells`. Several depths are judged without refocusing. PSFs are those
    on the axis: off it masks that focus lose more, phase lenses most (docs/measured/atlas.md).

    **Errors**: ValueError for names of no kind.

    ```python
    import thincam_jax as tc
    from thincam_jax.design.cell_masks import CellMasks
    from thincam_jax.design.recommendation import recommend
    from thincam_jax.units import nm, um

    light = tc.design.PhotonNoise(1e5)
    setup = tc.design.Setup(40 * um, 1.28, 100.0, 40.0, noise=light)
    space = CellMasks(40 * um, 24, distance=3.0, wavelength=500 * nm)
    best, *others = recommend(setup, space, kinds=("one opening", "random cells"))
    best.member
    ```

    **See also**: `cell_search.find_cells`, `limit`.
    """
    chosen = tuple(KINDS) if kinds is None else tuple(kinds)
    if unknown := [kind for kind in chosen if kind not in KINDS]:
        raise ValueError(f"kinds has {unknown[0]!r}; give some of {', '.join(KINDS)}")
    far = float(decimal_value(setup.object_distance))
    judge = MaskJudge(setup, space, depths or (), tolerances)
    found = []
    with watched("comparing masks") as tell:
        for number, kind in enumerate(chosen):
            rng, best, count = np.random.default_rng(seed), None, 0
            for member, amplitudes in KINDS[kind](space, far, rng):
                error, count = judge(amplitudes), count + 1
                tell(number, len(chosen), f"{kind}, {member}: {10 * math.log10(error):.2f} dB")
                # A mask that is dark has none at an SNR.
                if math.isfinite(error) and (best is None or error < best[0]):
                    best = error, member, amplitudes
            if best is not None:
                error, member, amplitudes = best
                masks = [SampledMask(one, space.cell) for one in amplitudes]
                found.append(Recommendation(kind, member, error, amplitudes, masks, count))
    return Recommendations(sorted(found, key=lambda one: one.error))


class MaskJudge:
    """Expected errors of masks: a function of the amplitudes of each capture's cells.

    - `depths`: distances of the scene, mm; the image is made for the middle one. The error is the
      mean over them and over `tolerances`.
    """

    def __init__(
        self,
        setup: Setup,
        space: CellMasks,
        depths: Sequence[float],
        tolerances: Tolerances | None = None,
    ):
        @functools.cache
        def judge_of(captures: int) -> CellJudge:
            several = space.replace(captures=captures)
            return CellJudge.of(setup, several, depths, tolerances)

        self._judge_of = judge_of

    def __call__(self, amplitudes: Transmittances) -> float:
        return float(_error(self._judge_of(len(amplitudes)), jnp.asarray(amplitudes)))


@eqx.filter_jit
def _error(judge: CellJudge, amplitudes: Array) -> Float[Array, ""]:
    return judge(amplitudes)


# ---- The kinds. Each gives its members, of `space.count`² cells. -----------------------------


def _centred(pattern: Array | np.ndarray, space: CellMasks, side: int = 1) -> np.ndarray:
    """A pattern of squares of cells in the middle of a mask."""
    cells = np.kron(np.asarray(pattern, float), np.ones((side, side)))
    before = (space.count - len(cells)) // 2
    return np.pad(cells, (before, space.count - len(cells) - before))[None]


def _places(space: CellMasks) -> np.ndarray:
    """Coordinates of the cells along an axis, mm."""
    return (np.arange(space.count) - (space.count - 1) / 2) * float(space.cell)


def _openings(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for side in np.unique(np.round(np.geomspace(1, max(3, space.count / 8), 16)).astype(int)):
        yield f"{side} cells wide", _centred(np.ones((side, side)), space)


def _muras(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for prime in _PRIMES:
        for side in (1, 2, 4, 8, 16):
            if prime * side <= space.count:
                cells = ModifiedUniformlyRedundantArray(prime, 1.0).cells
                yield f"order {prime}, {side} cells each", _centred(cells, space, side)


def _random_cells(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    one = space.replace(captures=1, rings=False)
    for _ in range(_DRAWN):
        cells = drawn_cells(one, rng).reshape(1, space.count, space.count)
        yield f"open {np.mean(cells):.2g}", cells.astype(float)


def _smooth_noise(size: float, space: CellMasks, rng: np.random.Generator) -> np.ndarray:
    noise = rng.normal(size=(space.count, space.count))
    return scipy.ndimage.gaussian_filter(noise, size, mode="wrap")


def _contours(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for size in np.geomspace(2, space.count / 8, 5):
        noise = _smooth_noise(size, space, rng)
        for width in (0.15, 0.5):
            lines = np.abs(noise) < width * noise.std()
            yield f"{size:.1f} cells, {width:g} of the spread", lines[None].astype(float)


def _centres(number: int, space: CellMasks, rng: np.random.Generator) -> np.ndarray:
    """Centres in the middle of the cells, evenly spread by some steps of Lloyd's; (centre, 2)."""
    half = float(space.width) / 2
    centres = np.zeros((1, 2)) if number == 1 else rng.uniform(-half, half, (number, 2))
    places = np.stack(np.meshgrid(*2 * [_places(space)[:: max(1, space.count // 64)]]), -1)
    return relaxed_sites(centres, places.reshape(-1, 2), 10 if number > 1 else 0)


def _lens_phase(number: int, space: CellMasks, far: float, rng: np.random.Generator):
    """Phase of lenses about centres that focus on the sensor, and the distance from the nearest."""
    places = np.stack(np.meshgrid(*2 * [_places(space)], indexing="ij"), -1).reshape(-1, 2)
    radius = KDTree(_centres(number, space, rng)).query(places)[0]
    distance, wavelength = float(space.distance), float(space.wavelength)
    phase = -np.pi / (wavelength * distance) * (1 + distance / far) * radius**2
    return (x.reshape(space.count, space.count) for x in (phase, radius))


def _radii(space: CellMasks) -> np.ndarray:
    """Radii of lenses up to where a zone is as wide as a cell."""
    most = float(space.wavelength) * float(space.distance) / float(space.cell) / 2
    return most * np.array([0.35, 0.5, 0.7, 1.0, 1.5])


def _zone_lenses(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for number in (1, 4, 16, 64, 256):
        phase, radius = _lens_phase(number, space, far, rng)
        for most in _radii(space):
            yield (
                f"{number}, radius {most:.3f} mm",
                ((np.cos(phase) > 0) & (radius < most))[None] * 1.0,
            )


def _phase_lenses(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for number in (1, 4, 16, 64, 256, 1024):
        phase, radius = _lens_phase(number, space, far, rng)
        for most in (*_radii(space), np.inf) if number == 1 else (np.inf,):
            width = "" if most == np.inf else f", radius {most:.3f} mm"
            yield f"{number}{width}", ((radius < most) * np.exp(1j * phase))[None]


def _diffusers(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    """Smooth reliefs, whose light reaches between a twentieth and a fifth of the mask's width."""
    distance, wavelength = float(space.distance), float(space.wavelength)
    for size in np.geomspace(4, space.count / 12, 4):
        relief = _smooth_noise(size, space, rng)
        slope = np.std(np.gradient(relief, float(space.cell))[0])
        for reach in (0.02, 0.06, 0.2):
            turn = 2 * np.pi / wavelength * reach * float(space.width) / distance
            if turn * float(space.cell) < np.pi:  # resolved by the cells
                phase = relief / slope * turn
                yield f"{size:.0f} cells, spread {reach:g}", np.exp(1j * phase)[None]


def _rates(space: CellMasks) -> np.ndarray:
    """β, rad/mm², up to where a fringe at the edge is three cells wide."""
    return 2 * np.pi / (3 * float(space.cell) * float(space.width)) * np.geomspace(0.1, 1, 6)


def zone_plates(
    rates: Iterable[float], phases: Iterable[float], space: CellMasks
) -> Float[np.ndarray, "capture y x"]:
    """Amplitudes of a grey zone plate in each capture, of β in rad/mm² and a phase."""
    squared = _places(space)[:, None] ** 2 + _places(space) ** 2
    each = zip(rates, phases, strict=True)
    return np.stack([np.abs(np.cos((rate * squared + phase) / 2)) for rate, phase in each])


def _zone_apertures(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for rate in _rates(space):
        yield f"β {rate:.1f} rad/mm²", zone_plates([rate], [0.0], space)


def _fringe_scanning(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for rate in _rates(space):
        yield f"β {rate:.1f} rad/mm²", zone_plates([rate] * 4, np.arange(4) * np.pi / 2, space)


def _method_b(space: CellMasks, far: float, rng: np.random.Generator) -> Members:
    for rate in _rates(space):
        for ratio in (0.84, 0.6):  # the thesis has 21 beside 25 rad/mm²
            rates = [rate, rate, ratio * rate, ratio * rate]
            label = f"β {rate:.1f} and {ratio * rate:.1f} rad/mm²"
            yield label, zone_plates(rates, [0.0, 1.5 * np.pi] * 2, space)


KINDS: dict[str, Callable[[CellMasks, float, np.random.Generator], Members]] = {
    "one opening": _openings,
    "MURA": _muras,
    "random cells": _random_cells,
    "contours": _contours,
    "lenses of zones": _zone_lenses,
    "phase lenses": _phase_lenses,
    "diffuser": _diffusers,
    "zone aperture": _zone_apertures,
    "fringe scanning": _fringe_scanning,
    "method B": _method_b,
}
