"""Comparison of masks of every family before one sensor, scene by scene, in equal light."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from matplotlib.figure import Figure
from tools.mask_captures import (
    ComparedMask,
    Setting,
    Strength,
    best_linear,
    capture,
    channels_of,
    kernels,
    strength,
    total_variation,
)

from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax._core.table import Table, number
from thincam_jax.imaging.metrics import align, psnr, ssim
from thincam_jax.imaging.targets import resize
from thincam_jax.plot.frame import drawing, new_figure
from thincam_jax.reconstruction.wiener import Prior

Colours = Literal["one wavelength", "broadband"]
Estimate = Literal["total variation", "linear", "focused far"]


@dataclass(frozen=True, eq=False)
class ComparedScene:
    """A scene on the field's pixels (y, x), 0 to 1, as it is cast on the sensor.

    - `prior`: spectrum that the linear estimate assumes for it.
    """

    image: Float[np.ndarray, "y x"]
    prior: Prior = "inverse_square"

    @classmethod
    def of_picture(
        cls,
        picture: Float[np.ndarray, "row column *channel"],
        shape: tuple[int, int],
        prior: Prior = "inverse_square",
    ) -> "ComparedScene":
        """A picture, grey or the mean of its colours, on so many pixels."""
        return cls(resize(np.atleast_3d(picture).mean(axis=-1), shape), prior)

    @property
    def precision(self) -> tuple[float, float]:
        """a and b of its prior exp{−½(a‖∇f‖² + b‖f − f̄‖²)}.

        They fit its own mean square of differences or, of a flat spectrum, its variance.
        """
        if self.prior == "flat":
            return 0.0, 1 / float(self.image.var())
        squares = sum(np.sum(np.diff(self.image, axis=axis) ** 2) for axis in (0, 1))
        slope = self.image.size / float(squares)
        return slope, slope * (2 * math.pi / max(self.image.shape)) ** 2


@dataclass(frozen=True, eq=False)
class Tuning:
    """τ of total variation, for each mask and light: the best of `tau` on a scene of its own."""

    scene: ComparedScene
    tau: tuple[float | int, ...] = (0.5, 1, 2, 4)
    iterations: int = 60


@dataclass(frozen=True)
class Case:
    """Key of a score: the image; `electrons` a pixel of the bare sensor, `distance` in mm."""

    mask: str
    scene: str
    electrons: float
    distance: float
    colours: Colours = "one wavelength"
    estimate: Estimate = "total variation"


@dataclass(frozen=True, eq=False)
class MaskComparison:
    """Masks of one width before one sensor, all in the same light.

    - `masks`, `scenes`: by name.
    - `wavelength`, and a `band` of several of equal weight, mm.
    - `light`: electrons a pixel of the bare sensor before a white scene, the weakest first.
    - `object_distances`: mm; the first is that of all comparisons but the one of distances.
    """

    setting: Setting
    masks: Mapping[str, ComparedMask]
    scenes: Mapping[str, ComparedScene]
    tuning: Tuning
    wavelength: float
    band: tuple[float, ...]
    light: tuple[float, ...]
    object_distances: tuple[float, float]
    seed: int = 0

    def run(self, progress: Progress | None = None) -> "Result":
        """All masks on all scenes; all but the times of PSFs is the same at every run."""
        result = Result(self)
        work: list[Step] = []
        for name in self.masks:
            work.append(Step(f"{name}: tau", partial(self._tune, result, name)))
            for distance in self.object_distances:
                for colours in ("one wavelength", "broadband"):
                    text = f"{name}: {distance:g} mm, {colours}"
                    do = partial(self._reconstruct, result, name, distance, colours)
                    work.append(Step(text, do))
        carry_out(work, progress)
        return result

    def _key(self, *numbers: int) -> PRNGKeyArray:
        """Random key of the noise, equal for all masks: a better image is a better mask."""
        key = jax.random.key(self.seed)
        for given in numbers:
            key = jax.random.fold_in(key, given)
        return key

    def _tune(self, result: "Result", name: str) -> None:
        """τ at each light, far away and in one wavelength, and what the PSF says by itself."""
        setting, compared, far = self.setting, self.masks[name], self.object_distances[0]
        psfs = kernels(setting, compared, (self.wavelength,), far)
        cameras, asked = channels_of(setting, compared, psfs), self.tuning
        scene, precision = _stack([asked.scene])
        for place, electrons in enumerate(self.light):
            key = self._key(place, len(self.scenes) + 1)
            seen = capture(setting, compared, psfs, scene, electrons, key)
            start = best_linear(cameras, seen, precision)
            tried = [
                total_variation(cameras, seen, start, float(tau), asked.iterations)
                for tau in asked.tau
            ]
            scores = [psnr(np.asarray(image[0]), np.asarray(scene[0])) for image in tried]
            result.tau[name, electrons] = float(asked.tau[int(np.argmax(scores))])
        result.psfs[name] = psfs
        result.strengths[name] = strength(setting, compared, psfs, self.wavelength, far)

    def _reconstruct(self, result: "Result", name: str, distance: float, colours: Colours) -> None:
        """All scenes at every light, by both estimates."""
        setting, compared, far_psfs = self.setting, self.masks[name], result.psfs[name]
        near, alone = distance == self.object_distances[1], colours == "one wavelength"
        light = (self.wavelength,) if alone else self.band
        other = near or not alone
        psfs = kernels(setting, compared, light, distance) if other else far_psfs
        cameras = channels_of(setting, compared, psfs)
        scenes, precision = _stack(list(self.scenes.values()))
        for place, electrons in enumerate(self.light):
            key = self._key(place, near, alone)
            seen = capture(setting, compared, psfs, scenes, electrons, key)
            linear = best_linear(cameras, seen, precision)
            options = result.tau[name, electrons], self.tuning.iterations
            found = total_variation(cameras, seen, linear, *options)
            estimates: dict[Estimate, Array] = {"linear": linear, "total variation": found}
            if near and alone and electrons == self.light[-1]:
                far = channels_of(setting, compared, far_psfs)
                estimates["focused far"] = best_linear(far, seen, precision)
            for estimate, images in estimates.items():
                for scene, image in zip(self.scenes, np.asarray(images), strict=True):
                    case = Case(name, scene, electrons, distance, colours, estimate)
                    truth = np.asarray(self.scenes[scene].image, image.dtype)
                    scores = round(psnr(image, truth), 3), round(ssim(image, truth), 4)
                    result.scores[case] = scores
                    result.images[case] = image


def _stack(scenes: Sequence[ComparedScene]) -> tuple[Array, Array]:
    """Images and precisions of scenes."""
    images = jnp.asarray(np.stack([scene.image for scene in scenes]), float)
    return images, jnp.asarray([scene.precision for scene in scenes], images.dtype)


@dataclass(frozen=True, eq=False)
class Result:
    """Result of a comparison.

    - `scores`: PSNR in dB, and SSIM, of each case; `images`: its reconstruction (y, x).
    - `tau`: by mask and light. `strengths`, `psfs`: by mask, far away in one wavelength.
    """

    comparison: MaskComparison
    scores: dict[Case, tuple[float, float]] = field(default_factory=dict)
    images: dict[Case, np.ndarray] = field(default_factory=dict)
    tau: dict[tuple[str, float], float] = field(default_factory=dict)
    strengths: dict[str, Strength] = field(default_factory=dict)
    psfs: dict[str, Array] = field(default_factory=dict)

    def case(
        self,
        mask: str,
        scene: str,
        electrons: float,
        *,
        colours: Colours = "one wavelength",
        near: bool = False,
        estimate: Estimate = "total variation",
    ) -> Case:
        """One of the cases; by default of total variation, far away, in one wavelength."""
        distance = self.comparison.object_distances[near]
        return Case(mask, scene, electrons, distance, colours, estimate)

    def mean(
        self,
        mask: str,
        *,
        colours: Colours = "one wavelength",
        near: bool = False,
        estimate: Estimate = "total variation",
    ) -> float:
        """Mean PSNR of the scenes in the strongest light, dB."""
        light, given = self.comparison.light[-1], {"near": near, "estimate": estimate}
        of_scene = partial(self.case, mask, electrons=light, colours=colours, **given)
        cases = [of_scene(scene=scene) for scene in self.comparison.scenes]
        return float(np.mean([self.scores[case][0] for case in cases]))

    def broadband(self, mask: str) -> float:
        """dB that a band of wavelengths costs."""
        return self.mean(mask) - self.mean(mask, colours="broadband")

    def near(self, mask: str) -> float:
        """dB that the scenes lose at the other distance, whose PSF is known."""
        return self.mean(mask) - self.mean(mask, near=True)

    def unfocused(self, mask: str) -> float:
        """dB that the PSF of the first distance costs the linear estimate at the other one."""
        right = self.mean(mask, near=True, estimate="linear")
        return right - self.mean(mask, near=True, estimate="focused far")

    def table(self, estimate: Estimate = "total variation") -> Table:
        """PSNR and SSIM of every mask on every scene in each light."""
        cases = [(scene, at) for scene in self.comparison.scenes for at in self.comparison.light]
        rows = []
        for name in self.comparison.masks:
            found = [self.scores[self.case(name, *one, estimate=estimate)] for one in cases]
            rows.append((name, *(f"{number(p, 1)} / {number(s, 2)}" for p, s in found)))
        headings = ("mask", *(f"{scene}\n{at:,.0f}" for scene, at in cases))
        return Table(headings, rows, title=f"PSNR dB / SSIM by {estimate}, at electrons a pixel")

    def strength_table(self) -> Table:
        """Properties of the PSF of every mask; see `Strength`."""
        rows = []
        for name, one in self.strengths.items():
            of_light = one.throughput, one.detail, one.in_shot_noise, one.in_read_noise
            rows.append(
                (
                    name,
                    *(100 * part for part in of_light),
                    one.flatness,
                    f"{one.weakest:.2g}",
                    one.weakest_at,
                    1000 * one.seconds,
                )
            )
        headings = ("mask", "light %", "detail %", "detail × √light, %", "detail × light, %")
        headings = (*headings, "flatness", "weakest", "at cycles/mm", "PSF ms")
        return Table(headings, rows, (1, 1, 1, 2, 2, 2, 1, 0))

    def cost_table(self) -> Table:
        """Costs of colours, of distance and of the PSF of a wrong distance, dB."""
        rows = [
            (name, self.broadband(name), self.near(name), self.unfocused(name))
            for name in self.comparison.masks
        ]
        near = f"{self.comparison.object_distances[1]:g} mm"
        headings = ("mask", "broadband", f"{near}, its PSF known", f"{near}, PSF of the first")
        return Table(headings, rows, (1, 1, 1), title="costs in dB")


# Dash and grey tell the sort of a mask, and the marker which it is: read without colours.
_SORTS = (
    ("-", "#000000"),
    ("--", "#404040"),
    (":", "#606060"),
    ("-.", "#808080"),
    ("-", "#b0b0b0"),
)
_MARKERS = "osD^v<>*XPphd"


def draw_error(result: Result) -> Figure:
    """Root mean square error against light, a line for each mask and a panel for each scene."""
    figure = new_figure(11.0, 4.4)
    comparison = result.comparison
    panels = figure.subplots(1, len(comparison.scenes), squeeze=False)[0]
    light = comparison.light
    sorts = list(dict.fromkeys(one.sort for one in comparison.masks.values()))
    for ax, scene in zip(panels, comparison.scenes, strict=True):
        for place, (name, mask) in enumerate(comparison.masks.items()):
            dash, grey = _SORTS[sorts.index(mask.sort) % len(_SORTS)]
            scores = (result.scores[result.case(name, scene, at)][0] for at in light)
            ax.loglog(
                light,
                [10 ** (-score / 20) for score in scores],
                label=name,
                color=grey,
                linestyle=dash,
                marker=_MARKERS[place % len(_MARKERS)],
                markersize=5,
                linewidth=1.2,
                markerfacecolor="white" if len(mask.masks) > 1 else grey,
            )
        ax.set_title(scene, fontsize=10)
        ax.set_xlabel("electrons a pixel of the bare sensor")
        ax.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("root mean square error (white = 1)")
    handles, labels = panels[0].get_legend_handles_labels()
    # The worst first, as the lines are at the left.
    order = np.argsort([result.mean(name) for name in labels])
    figure.legend(
        [handles[n] for n in order],
        [labels[n] for n in order],
        loc="outside right upper",
        fontsize=8,
    )
    return figure


def draw_images(result: Result) -> Figure:
    """A row for each mask: the mask, its PSF, and scenes at several lights, colours, distances."""
    comparison, setting = result.comparison, result.comparison.setting
    first, *_ = comparison.scenes
    *weaker, strong = comparison.light
    asked = {f"{first}\n{at:,.0f}": (first, at, {}) for at in weaker}
    asked |= {f"{scene}\n{strong:,.0f}": (scene, strong, {}) for scene in comparison.scenes}
    near = f"at {comparison.object_distances[1]:g} mm"
    asked[f"{first}\n{strong:,.0f}, broadband"] = first, strong, {"colours": "broadband"}
    asked[f"{first}\n{strong:,.0f}, {near}"] = first, strong, {"near": True}
    columns, rows = 2 + len(asked), len(comparison.masks)
    size = 1.5 * columns, 1.62 * rows + 0.5
    figure, axes = drawing(size, rows, columns, squeeze=False)
    grid = setting.sensor.grid
    for row, (name, compared) in zip(axes, comparison.masks.items(), strict=True):
        mask, h = compared.masks[0], np.asarray(result.psfs[name][0])
        t = np.asarray(mask.sample(grid, comparison.wavelength))
        shown = np.where(np.abs(t) > 0.5, np.angle(t), -np.pi) if mask.pure_phase else np.abs(t)
        row[0].imshow(shown, cmap="gray")
        down, right = ((a - b) // 2 for a, b in zip(h.shape, grid.shape, strict=True))
        seen = h[down : down + grid.shape[0], right : right + grid.shape[1]]
        row[1].imshow(seen, cmap="gray", vmin=0, vmax=np.quantile(seen, 0.998))
        row[0].set_ylabel(name, fontsize=8)
        for ax, (scene, electrons, other) in zip(row[2:], asked.values(), strict=True):
            case, truth = (
                result.case(name, scene, electrons, **other),
                comparison.scenes[scene].image,
            )
            ax.imshow(align(result.images[case], truth), cmap="gray", vmin=0, vmax=truth.max())
            ax.set_xlabel(f"{result.scores[case][0]:.1f} dB", fontsize=8, labelpad=1)
    for ax, title in zip(axes[0], ("mask", "PSF", *asked), strict=True):
        ax.set_title(title, fontsize=8)
    for ax in axes.ravel():
        ax.set(xticks=[], yticks=[])
    return figure
