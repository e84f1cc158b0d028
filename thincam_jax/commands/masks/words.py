"""What a comparison of masks says in words: who wins where, and why."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from thincam_jax.commands.masks.config import MasksConfig
from thincam_jax.commands.sections import Cells

# A difference of two images that a look at them would not tell, dB.
_EVEN = 0.3


@dataclass(frozen=True)
class Case:
    """Of which image a score is; `electrons` a pixel of the bare sensor, `distance` in mm."""

    mask: str
    scene: str
    electrons: float
    distance: float
    colours: str
    method: str


class Results:
    """The scores of a comparison, by mask and case."""

    def __init__(self, metrics: dict[str, Any], config: MasksConfig):
        self.metrics, self.config = metrics, config
        self.masks: dict[str, dict[str, Any]] = metrics["masks"]
        self.scenes = [scene.name for scene in config.compared]
        self.cases = {Case(*row[:6]): (row[6], row[7]) for row in metrics["cases"]}

    def score(self, mask: str, scene: str, electrons: float, **other: Any) -> float:
        """PSNR, dB; by default of total variation, far away, in one wavelength."""
        return self.cases[self.case(mask, scene, electrons, **other)][0]

    def similarity(self, mask: str, scene: str, electrons: float, **other: Any) -> float:
        """SSIM of the same."""
        return self.cases[self.case(mask, scene, electrons, **other)][1]

    def case(self, mask: str, scene: str, electrons: float, **other: Any) -> Case:
        far = self.config.object_distances[0]
        given = {"distance": far, "colours": "one wavelength", "method": "total variation"}
        return Case(mask, scene, electrons, **(given | other))

    def mean(self, mask: str, electrons: float, **other: Any) -> float:
        """Mean PSNR of the scenes."""
        scores = [self.score(mask, scene, electrons, **other) for scene in self.scenes]
        return float(np.mean(scores))

    def near(self, mask: str) -> float:
        """dB that the scenes lose on average at the other distance, at the strongest light."""
        light, near = self.config.light[-1], self.config.object_distances[1]
        return self.mean(mask, light) - self.mean(mask, light, distance=near)

    def unfocused(self, mask: str) -> float:
        """What the PSF of the first distance costs the linear estimate at the other one."""
        light, near = self.config.light[-1], self.config.object_distances[1]
        right = self.mean(mask, light, distance=near, method="linear")
        return right - self.mean(mask, light, distance=near, method="focused far")

    def broadband(self, mask: str) -> float:
        """What a band of wavelengths costs."""
        light = self.config.light[-1]
        return self.mean(mask, light) - self.mean(mask, light, colours="broadband")

    def of_family(self, *families: str) -> list[str]:
        """Masks that take one capture."""
        return [
            name
            for name, mask in self.masks.items()
            if mask["family"] in families and mask["captures"] == 1
        ]


def findings(results: Results) -> list[str]:
    """Sentences, made of the numbers alone."""
    parts = (_winners, _why, _literature, _pinhole, _costs, _phases, _solvers)
    return [sentence for part in parts for sentence in part(results)]


def _winners(results: Results) -> Iterable[str]:
    """The best three, and the last, at the weakest and the strongest light."""
    weak, *_, strong = results.config.light
    for scene in results.scenes:
        told = []
        for light in (weak, strong):
            scores = {name: results.score(name, scene, light) for name in results.masks}
            *order, last = sorted(scores, key=scores.__getitem__, reverse=True)
            best = ", ".join(f"{name} ({scores[name]:.1f} dB)" for name in order[:3])
            told.append(f"at {light:,.0f} electrons {best}; last {last} ({scores[last]:.1f} dB)")
        yield f"{scene}: {'; '.join(told)}."


def _why(results: Results) -> Iterable[str]:
    """Whether what is known from the PSF alone gives the order of the images."""
    names = [name for name, mask in results.masks.items() if mask["captures"] == 1]
    weak, *_, strong = results.config.light
    for light, key, noise in (
        (strong, "detail_in_shot_noise", "the root of its light (what rises from shot noise)"),
        (weak, "detail_in_read_noise", "its light (what rises from read noise)"),
    ):
        predicted = [results.masks[name][key] for name in names]
        means = [results.mean(name, light) for name in names]
        best, worst = names[int(np.argmax(predicted))], names[int(np.argmin(predicted))]
        yield (
            f"why, at {light:,.0f} electrons: the part of a mask's light that carries detail, "
            f"times {noise}, is {100 * max(predicted):.3g} % for {best} and "
            f"{100 * min(predicted):.2g} % for {worst}; its order is that of the images with a "
            f"rank correlation of {_rank_correlation(predicted, means):.2f}."
        )


def _literature(results: Results) -> Iterable[str]:
    """Few lenslets, then contours, then amplitude codes, in one wavelength and in focus."""
    groups = {
        "few lenses": results.of_family("lenslets", "voronoi_fresnel"),
        "contours": results.of_family("contours"),
        "amplitude codes": results.of_family("fza", *get_args(Cells)),
    }
    if not all(groups.values()):
        return
    light = results.config.light[-1]
    for scene in results.scenes:
        best = {
            group: max(results.score(name, scene, light) for name in names)
            for group, names in groups.items()
        }
        levels = list(best.values())
        agrees = all(a > b + _EVEN for a, b in zip(levels, levels[1:], strict=False))
        told = ", ".join(f"{group} {level:.1f} dB" for group, level in best.items())
        verdict = "as the literature has it" if agrees else "not the literature's order"
        yield f"{scene}, best of each group at {light:,.0f} electrons: {told}: {verdict}."


def _pinhole(results: Results) -> Iterable[str]:
    """Beside the codes in much and in little light."""
    pinholes = results.of_family("pinhole")
    codes = results.of_family("fza", *get_args(Cells))
    if not (pinholes and codes):
        return
    scene = results.scenes[0]
    told = []
    for light in results.config.light:
        for method in ("linear", "total variation"):
            gap = max(results.score(p, scene, light, method=method) for p in pinholes) - max(
                results.score(c, scene, light, method=method) for c in codes
            )
            told.append(f"{gap:+.1f} dB ({method})")
        told[-2:] = [f"at {light:,.0f} electrons {' and '.join(told[-2:])}"]
    throughput = max(results.masks[name]["throughput"] for name in pinholes)
    yield (
        f"the pinhole beside the best amplitude code, {scene}: {'; '.join(told)}. It passes "
        f"{100 * throughput:.2g} % of the light: {throughput * results.config.light[0]:.2g} "
        f"electrons a pixel at the weakest, beside {results.config.read_noise:g} of read noise."
    )


def _costs(results: Results) -> Iterable[str]:
    """Of colours and distance."""
    yield _extremes(results, results.broadband, "a band of wavelengths costs")
    near = results.config.object_distances[1]
    yield _extremes(results, results.near, f"an object at {near:g} mm, its PSF known, costs")
    text = f"the PSF of the wrong distance costs a linear image at {near:g} mm"
    yield _extremes(results, results.unfocused, text)


def _phases(results: Results) -> Iterable[str]:
    """Four phases beside one, of zone plates."""
    weak, *_, strong = results.config.light
    singles = results.of_family("fza")
    several = [name for name, mask in results.masks.items() if mask["captures"] > 1]
    for name in several:
        for single in singles:
            gains = []
            for light in (weak, strong):
                for method in ("linear", "total variation"):
                    both = [results.mean(one, light, method=method) for one in (name, single)]
                    gains.append(f"{both[0] - both[1]:+.1f} dB at {light:,.0f} ({method})")
            yield (
                f"{name} beside {single}, of as many photons, mean of the scenes: "
                f"{', '.join(gains)}."
            )


def _solvers(results: Results) -> Iterable[str]:
    gains = [
        results.score(mask, scene, light) - results.score(mask, scene, light, method="linear")
        for mask in results.masks
        for scene in results.scenes
        for light in results.config.light
    ]
    yield (
        f"total variation beside the best linear estimate: {np.mean(gains):+.1f} dB on average, "
        f"{min(gains):+.1f} to {max(gains):+.1f}."
    )


def _extremes(results: Results, cost: Callable[[str], float], text: str) -> str:
    """The least and the most, with who pays it."""
    order = sorted(results.masks, key=cost)
    told = [f"{name} {cost(name):.1f} dB" for name in (*order[:2], *order[-2:])]
    light = results.config.light[-1]
    return (
        f"{text}, at {light:,.0f} electrons, least {told[0]} and {told[1]}, most {told[3]} and "
        f"{told[2]}."
    )


def _rank_correlation(first: list[float], second: list[float]) -> float:
    """Spearman's: 1 where both are in one order."""
    a, b = (np.argsort(np.argsort(values)) for values in (first, second))
    return float(np.corrcoef(a, b)[0, 1])
