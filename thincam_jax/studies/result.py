"""Results of a study: the scores of every method on every target, as records, table and figures."""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.table import Table, number
from thincam_jax.imaging.metrics.mtf import cut_off, first_common_zero
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.phase_shift import without_carrier
from thincam_jax.lensless.psf import otf
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.studies.evaluate import Evaluation, Resolved, Scores, evaluate_method, take
from thincam_jax.studies.study import Method, Published, Study, Target

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ResponseLimits:
    """Frequencies of a response's first zero crossing, None without one, and of its end."""

    first_zero_cycles_per_mm: float | None
    first_zero_object_mm: float | None
    cut_off_cycles_per_mm: float
    cut_off_object_mm: float


@dataclass(frozen=True, eq=False)
class Response:
    """A method's transfer function along u, v = 0, on its reference plane.

    - `frequency`: cycles/mm, ≥ 0.
    - `magnitude`: root of the mean over the shots of Σ|H|² of a shot's channels, mm²; contrasts
      belong to all shots together.
    """

    frequency: np.ndarray
    magnitude: np.ndarray
    limits: ResponseLimits


@checked
def method_response(study: Study, method: Method) -> Response:
    """The response with the finite mask, for a point on the axis, and its limits.

    - First zero crossing: the lowest frequency that no shot of the method carries. A fringe-scanned
      response is real once its carrier e^{jX} is taken off, and so is a harmonic's without its
      e^{jX/m}. Every other response swings with its
      carrier, sin X − cos X for a phase pair: its notches are narrower than the sensor can tell
      apart, no frequency band is missing, and there is no first zero (None).
    - Cut-off: where the magnitude stays under 5 % of its low-frequency value.
    """
    reference = method.distance
    columns = study.sensor.shape[1]
    frequency = np.arange(columns - columns // 2) / (columns * study.pitch)
    signed, powers = [], []
    for shot, channels in _groups(study, method):
        ratio = reference / shot.distance
        # A frequency on the reference plane is ratio times higher on this shot's sensor.
        power = np.sum(np.abs(channels) ** 2, axis=0)
        powers.append(np.interp(frequency * ratio, frequency, power, right=0.0))
        orders = (1,) if method.synthesis == "fringe_scanning" else method.harmonics
        parts = channels[0::2] + 1j * channels[1::2] if orders else ()
        for order, part in zip(orders, parts, strict=True):
            shadow = 1 + shot.distance / study.object_distance
            response = without_carrier(frequency, part, shot.beta, shadow, order)
            signed.append(np.interp(frequency * ratio, frequency, response, right=0.0))
    magnitude = np.sqrt(np.mean(powers, axis=0))
    limit = cut_off(frequency, magnitude)
    zero = first_common_zero(frequency, signed) if signed else None
    magnification = study.object_distance / reference
    return Response(
        frequency,
        magnitude,
        ResponseLimits(
            None if zero is None else round(zero, 3),
            None if zero is None else round(magnification / zero, 3),
            round(limit, 3),
            round(magnification / limit, 3),
        ),
    )


def _groups(study: Study, method: Method) -> list[tuple[Exposure, np.ndarray]]:
    """Shots with the responses (channel, u) of their channels; contrasts are one group."""
    profiles = np.stack([_profile(study, exposure) for exposure in method.exposures])
    if method.synthesis == "contrasts":
        return [(method.shots[0], method.synthesis_matrix @ profiles)]
    single = method.weights(1)
    each = profiles.reshape(len(method.shots), method.phases, -1)
    return [(shot, single @ own) for shot, own in zip(method.shots, each, strict=True)]


def _profile(study: Study, exposure: Exposure) -> np.ndarray:
    """The OTF of one exposure along u ≥ 0, v = 0."""
    light = {"wavelength": exposure.wavelength, "object_distance": study.object_distance}
    how = {"model": study.model, "pixel_integration": study.pixel_integration}
    # A part of a mosaic, as if it were alone.
    camera = study.camera(exposure).replace(place=None).on_grid(study.sensor.grid)
    response = np.asarray(otf(camera, **light, **how))
    rows, columns = study.sensor.shape
    return response[rows // 2, columns // 2 :]


@dataclass(frozen=True)
class MethodScores:
    """A method's figures of merit; `targets` by name, beside what was `published`."""

    captures: int
    mean_psnr_of_pictures_db: float | None
    limits: ResponseLimits
    targets: dict[str, Scores]
    published: Published

    @property
    def resolved(self) -> Resolved | None:
        """The finest element resolved; of the first chart."""
        found = (scores.resolved for scores in self.targets.values())
        return next((one for one in found if one is not None), None)

    @property
    def resolved_mm(self) -> float | None:
        """Line pair that is resolved on the object, mm."""
        return None if self.resolved is None else self.resolved.object_mm


@dataclass(frozen=True)
class StudyScores:
    """The figures of merit of all methods, by name."""

    study: str
    seed: int
    methods: dict[str, MethodScores]
    warnings: list[str]

    def table(self) -> Table:
        """Every method beside what was published of it."""
        return Table(
            ("method", "PSNR dB", "published", "resolved mm", "published", "cut-off /mm"),
            tuple(
                (
                    name,
                    one.mean_psnr_of_pictures_db,
                    one.published.psnr_db,
                    one.resolved_mm,
                    one.published.resolved_object_mm,
                    one.limits.cut_off_cycles_per_mm,
                )
                for name, one in self.methods.items()
            ),
            (1, 1, 2, 2, 1),
        )

    def quality_table(self) -> Table:
        """PSNR and SSIM of every method on every target, beside what was published."""
        rows, targets = [], list(dict.fromkeys(t for m in self.methods.values() for t in m.targets))
        for name, one in self.methods.items():
            found = (one.targets[target] for target in targets)
            both = (f"{number(s.psnr_db, 1)} / {number(s.ssim, 2)}" for s in found)
            means = one.mean_psnr_of_pictures_db, one.published.psnr_db
            rows.append((name, one.captures, *both, *means))
        each = (f"{target}\nPSNR dB / SSIM" for target in targets)
        last = "mean PSNR of\npictures, dB", "published\ndB"
        headings = ("method", "captures", *each, *last)
        return Table(headings, rows, (1,) * (len(headings) - 1), published=(len(headings) - 1,))

    def resolution_table(self) -> Table:
        """Resolution and limits of every method, beside published ones."""
        rows = [
            (
                name,
                one.resolved_mm,
                one.resolved and one.resolved.sensor_cycles_per_mm,
                one.published.resolved_object_mm,
                one.limits.first_zero_cycles_per_mm,
                one.limits.cut_off_cycles_per_mm,
                one.limits.cut_off_object_mm,
                one.published.limit_cycles_per_mm,
            )
            for name, one in self.methods.items()
        ]
        headings = (
            "method",
            "resolved line pair\non the object, mm",
            "the same on the\nsensor, cycles/mm",
            "published\nmm",
            "first zero\ncycles/mm",
            "cut-off\ncycles/mm",
            "cut-off on\nthe object, mm",
            "published limit\ncycles/mm",
        )
        return Table(headings, rows, (2, 1, 2, 2, 1, 2, 1), published=(3, 7))


def mean_psnr_of_pictures(targets: Sequence[Target], scores: Mapping[str, Scores]) -> float | None:
    """The mean over photographs and files, dB, from scores by target; None without any.

    Drawn targets are left out, and exact reconstructions, which have no PSNR.
    """
    return _mean_psnr(scores[target.name] for target in targets if target.is_picture)


def _mean_psnr(scores: Iterable[Scores]) -> float | None:
    known = [one.psnr_db for one in scores if one.psnr_db is not None]
    return round(float(np.mean(known)), 4) if known else None


def metrics_row(study: Study) -> dict[str, float | int | str | None]:
    """The study's scores as one row of a table, and the seconds that they took.

    Columns are `psnr_db/METHOD/TARGET`, `resolved_object_mm/METHOD/TARGET` of an inner number, and
    `mean_psnr_db/METHOD` over all targets.
    """
    started, row = time.perf_counter(), {}
    found: dict[str, dict[str, Scores]] = {method.name: {} for method in study.methods}
    for target in study.targets:
        for method, evaluation in evaluate_target(study, target).items():
            found[method][target.name] = evaluation.scores
            row |= _columns(f"{method}/{target.name}", asdict(evaluation.scores))
    for method, targets in found.items():
        row[f"mean_psnr_db/{method}"] = _mean_psnr(targets.values())
        pictures = mean_psnr_of_pictures(study.targets, targets)
        if pictures is not None:
            row[f"mean_psnr_of_pictures_db/{method}"] = pictures
    return {**row, "seconds": round(time.perf_counter() - started, 4)}


def _columns(place: str, metrics: dict[str, Any]) -> dict[str, Any]:
    flat = {}
    for name, value in metrics.items():
        if isinstance(value, dict):
            flat |= {f"{name}_{inner}": number for inner, number in value.items()}
        elif value is not None or name != "resolved":
            flat[name] = value
    return {f"{name}/{place}": value for name, value in flat.items()}


def summarise(
    study: Study,
    targets: Sequence[Target],
    scores: Mapping[str, Mapping[str, Scores]],
    responses: Mapping[str, Response],
) -> StudyScores:
    """The scores, by target and method, and the limits of the methods' responses as one record."""

    def of_method(method: Method) -> MethodScores:
        own = {target.name: scores[target.name][method.name] for target in targets}
        return MethodScores(
            len(method.exposures),
            mean_psnr_of_pictures(targets, own),
            responses[method.name].limits,
            own,
            method.published,
        )

    methods = {method.name: of_method(method) for method in study.methods}
    return StudyScores(study.name, study.seed, methods, study.warnings)


def findings(study: Study, scores: StudyScores) -> list[str]:
    """Main results of a study in sentences, the main one first; then beside what was published."""
    sentences = _main_result(study, scores)
    for name, method in scores.methods.items():
        mean, stated = method.mean_psnr_of_pictures_db, method.published.psnr_db
        if mean is not None and stated is not None:
            sentences.append(
                f"{name}: {mean:.1f} dB on average over the pictures, published {stated:.1f} dB "
                f"({mean - stated:+.1f} dB)."
            )
        own, stated = method.resolved_mm, method.published.resolved_object_mm
        if own is not None and stated is not None:
            word = "finer" if own < 0.97 * stated else "coarser"
            word = "the same within 3 %" if abs(own / stated - 1) <= 0.03 else word
            sentences.append(
                f"{name}: resolves a line pair of {own:.2f} mm on the object, published "
                f"{stated:.2f} mm: {word}."
            )
    sentences += _gains(study, scores)
    ranked = sorted(
        (one.resolved_mm, name)
        for name, one in scores.methods.items()
        if one.resolved_mm is not None
    )
    if len(ranked) > 1:
        order = ", ".join(f"{name} ({period:.2f} mm)" for period, name in ranked)
        sentences.append(f"From finest to coarsest on the chart: {order}.")
    return sentences


def _main_result(study: Study, scores: StudyScores) -> list[str]:
    """The best method beside the best conventional one, or else beside the first."""
    conventional = {m.name for m in study.methods if m.solver.name == FringeScanning.name}
    names = [name for name in scores.methods if name in conventional] or [*scores.methods][:1]
    others = [name for name in scores.methods if name not in names]
    if not others:
        target, found = next(iter(scores.methods[names[0]].targets.items()))
        return [f"{names[0]} on {target}: {found.words}."]
    before, after = (
        min(group, key=lambda name: _rank(scores.methods[name])) for group in (names, others)
    )
    old, new = scores.methods[before], scores.methods[after]
    parts, beside = [], ""
    if old.resolved_mm and new.resolved_mm:
        parts.append(f"resolves a line pair of {new.resolved_mm:.2f} mm")
        beside = f", which resolves {old.resolved_mm:.2f} mm"
    if (was := old.mean_psnr_of_pictures_db) and (now := new.mean_psnr_of_pictures_db):
        gain = f"{'gains' if now >= was else 'loses'} {abs(now - was):.1f} dB"
        parts.append(f"{gain} on the pictures")
    if not parts:
        return []
    return [f"Beside “{before}”{beside}, {after} {' and '.join(parts)}."]


def _rank(method: MethodScores) -> tuple[float, float]:
    """The finest line pair first, then the highest PSNR."""
    return method.resolved_mm or math.inf, -(method.mean_psnr_of_pictures_db or -math.inf)


def _sums(method: Method) -> tuple:
    """Captures and synthesis of a method; equal for methods that add the same captures alike."""
    return tuple(method.exposures), method.synthesis, method.phases, method.harmonics


def _gains(study: Study, scores: StudyScores) -> list[str]:
    """Gain of total variation over the Wiener synthesis of the same captures."""
    sentences = []
    for method in (m for m in study.methods if m.solver.name == "admm_tv"):
        for other in (m for m in study.methods if m.solver.name == "wiener"):
            if _sums(method) != _sums(other):
                continue
            both = [scores.methods[one.name].targets for one in (method, other)]
            pairs = ((name, *(of[name].psnr_db for of in both)) for name in both[0])
            gains = [
                f"{a - b:+.1f} dB on {t}" for t, a, b in pairs if a is not None and b is not None
            ]
            if gains:
                sentences.append(f"{method.name}: {', '.join(gains)} over {other.name}.")
    return sentences


@dataclass(frozen=True, eq=False)
class StudyResult:
    """All that a study found: `evaluations` by target and method, `responses` by method."""

    study: Study
    targets: tuple[Target, ...]
    evaluations: dict[str, dict[str, Evaluation]]
    responses: dict[str, Response]

    @property
    def scores(self) -> StudyScores:
        """The figures of merit, without images."""
        scores = {
            target: {name: found.scores for name, found in methods.items()}
            for target, methods in self.evaluations.items()
        }
        return summarise(self.study, self.targets, scores, self.responses)

    def table(self) -> Table:
        """Every method beside what was published of it."""
        return self.scores.table()

    def findings(self) -> list[str]:
        """Main results in sentences, beside what was published."""
        return findings(self.study, self.scores)

    def plot(self, target: str | None = None) -> "Figure":
        """The scene and every reconstruction of it, whole and enlarged; by default the first."""
        name = self.targets[0].name if target is None else target
        if name not in self.evaluations:
            listed = ", ".join(self.evaluations)
            raise ValueError(f"{name!r} is no target of this result; choose one of {listed}")
        chosen = next(one for one in self.targets if one.name == name)
        from thincam_jax.plot import studies as plot
        from thincam_jax.plot.frame import new_figure

        return plot.draw_found(chosen, self.evaluations[name], figure=new_figure(1.0, 1.0))


def run(study: Study, targets: Sequence[Target]) -> StudyResult:
    """Every method on every target, and the methods' transfer functions."""
    evaluations = {target.name: evaluate_target(study, target) for target in targets}
    responses = {method.name: method_response(study, method) for method in study.methods}
    return StudyResult(study, tuple(targets), evaluations, responses)


@checked
def evaluate_target(study: Study, target: Target) -> dict[str, Evaluation]:
    """Every method on one target; captures that methods share are taken once."""
    captures = {exposure: take(study, exposure, target) for exposure in study.exposures}
    return {
        method.name: evaluate_method(study, method, target, captures) for method in study.methods
    }
