r"""Objectives of a design: pure functions, differentiable in every number of it, and their objects.

All rest on what the captures tell of each frequency of the scene. With responses H_k, noise spectra
η_k and the synthesis W (`reconstruction.synthesis`) this is

.. math:: J(\nu) = \sum_c \frac{|\sum_k W_{ck} \bar H_k|^2}
    {\sum_k W_{ck}^2 \eta_k + \eta_c^{crop}}

where H̄ is what the sensor sees of H, and η^crop what it cuts off (`thincam_jax.design.response`).
An `AbstractObjective` makes a cost to minimise of them, and knows how to report it.
"""

import functools
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import quantity
from thincam_jax.design.design import Design
from thincam_jax.design.response import capture_light, responses, signal_variance, spectral_density
from thincam_jax.design.setup import Frequencies, Setup

DEFAULT_BAND = (0.05, 0.5)  # of the highest frequency
# Increase counted as 1 % worse, and 10 log10(1.01) dB for values in dB.
_ONE_PERCENT, _ONE_PERCENT_DB = 0.01, 0.0432
_LENGTH = quantity("mm", non_negative=True)
_PART = quantity(check=functools.partial(checks.between, unit="a ratio", least=0.0, most=0.5))


@checked
class Channels(eqx.Module):
    """The sums of captures that a reconstruction starts from, at each frequency.

    - `response`: transfer function H̄ of each sum, as seen at one distance, mm²·mm.
    - `noise`: its noise spectrum η, with what the sensor cuts off.
    - `density`: η_f of the scene.
    - `weight`: weight of each frequency in integrals over the plane.
    """

    response: Float[Array, "channel *point"]
    noise: Float[Array, "channel *point"]
    density: Float[Array, "*point"]
    weight: Float[Array, "*point"]

    @property
    def information(self) -> Float[Array, "*point"]:
        """J."""
        return jnp.sum(self.response**2 / self.noise, axis=0)

    @property
    def signal_to_noise(self) -> Float[Array, "*point"]:
        """η_f J: signal over noise of a frequency."""
        return self.density * self.information


@checked
def channels(
    design: Design,
    setup: Setup,
    synthesis: Float[Array, "channel capture"],
    frequencies: Frequencies,
) -> Channels:
    """Sums of a design's captures; `synthesis`: a matrix with orthogonal rows."""
    matrix = jnp.asarray(synthesis, design.beta.dtype)
    if matrix.ndim != 2 or matrix.shape[1] != design.captures:
        raise ValueError(
            f"synthesis has shape {matrix.shape}; give (channel, {design.captures}), one column "
            "for each capture"
        )
    found = responses(design, setup, frequencies)
    # Kept apart: fused into all that uses it, the power law would be computed for each.
    density = jax.lax.optimization_barrier(spectral_density(setup, frequencies))
    signal = signal_variance(design, setup, frequencies, found.whole, density)
    light = capture_light(design, setup)
    noise = setup.noise.variance(light, signal, design.exposure) * setup.pitch**2
    # Per area of the sensor the scene's density grows with the distance squared, noise does not.
    whole, seen = (_sums(matrix * design.distance, h) for h in (found.whole, found.seen))
    cut_off = jnp.maximum(whole * seen - seen**2, 0.0) * density
    return Channels(seen, (matrix**2 @ noise)[:, None, None] + cut_off, density, frequencies.weight)


def _sums(
    matrix: Float[Array, "channel capture"], responses: Float[Array, "capture *point"]
) -> Float[Array, "channel *point"]:
    """Written out: compiled as a matrix product, it would be computed for each of its uses."""
    return jnp.stack([sum(w * h for w, h in zip(row, responses, strict=True)) for row in matrix])  # pyright: ignore


@checked
def bayes_error(known: Channels) -> Float[Array, ""]:
    r"""Error of the best linear reconstruction, as a part of the scene's variance.

    .. math:: \int \frac{d^2\nu}{1/\eta_f + J(\nu)} \Big/ \int \eta_f\, d^2\nu

    (thesis Eq 3.48, corrected: ERRATA 3.46). 0 is a perfect image, 1 knows nothing.
    """
    error = known.density / (1 + known.signal_to_noise)
    return jnp.sum(error * known.weight) / jnp.sum(known.density * known.weight)


@checked
def mismatch_error(known: Channels, actual: Channels) -> Float[Array, ""]:
    r"""Error of that reconstruction where the camera differs from the assumed one.

    .. math:: \int \eta_f\Big(1 - \sum_c P_c H'_c\Big)^2 + \sum_c P_c^2\,\eta'_c,
        \qquad P_c = \frac{H_c/\eta_c}{1/\eta_f + J}

    with H′, η′ of the camera as it is. For H′ = H it is `bayes_error`.
    """
    filters = known.response / known.noise * known.density / (1 + known.signal_to_noise)
    transfer = jnp.sum(filters * actual.response, axis=0)
    error = known.density * (1 - transfer) ** 2 + jnp.sum(filters**2 * actual.noise, axis=0)
    return jnp.sum(error * known.weight) / jnp.sum(known.density * known.weight)


def ring_means(known: Channels, frequencies: Frequencies, rings: int) -> Float[Array, " ring"]:
    """The signal-to-noise ratio, averaged over rings of equal width.

    Its fringes are finer than what a picture shows; a ring's mean is what an edge of that
    fineness meets.
    """
    return over_rings(known.signal_to_noise, frequencies, rings)


def over_rings(
    values: Float[Array, "*point"], frequencies: Frequencies, rings: int
) -> Float[Array, " ring"]:
    """Means over rings of equal width, by area."""
    ring = frequencies.ring(rings)
    weight = frequencies.weight
    total = jax.ops.segment_sum((values * weight).ravel(), ring, rings + 1)[:-1]
    return total / jax.ops.segment_sum(weight.ravel(), ring, rings + 1)[:-1]


@checked
def worst_ratio_db(
    known: Channels, frequencies: Frequencies, band: tuple[float, float], *, rings: int = 64
) -> Float[Array, ""]:
    """The lowest signal-to-noise ratio of a ring in a band, dB, as a soft minimum (1 dB).

    `band`: lowest and highest frequency as parts of the highest looked at.
    """
    level = 10 * jnp.log10(ring_means(known, frequencies, rings) + _tiny(known))
    inside = _in_band(band, rings, level.dtype)
    return -jax.nn.logsumexp(jnp.where(inside, -level, -jnp.inf))


@checked
def unevenness(
    known: Channels, frequencies: Frequencies, band: tuple[float, float], *, rings: int = 64
) -> Float[Array, ""]:
    """Standard deviation of the information over the rings of a band, in dB: 0 is flat.

    The thesis asks for a flat amplitude (after Eq 3.48): no frequency is amplified into noise.
    """
    flat = replace(known, density=jnp.ones_like(known.density))
    level = 10 * jnp.log10(ring_means(flat, frequencies, rings) + _tiny(known))
    inside = _in_band(band, rings, level.dtype)
    count = jnp.sum(inside).astype(level.dtype)
    mean = jnp.sum(jnp.where(inside, level, 0.0)) / count
    spread = jnp.sum(jnp.where(inside, (level - mean) ** 2, 0.0)) / count
    return jnp.sqrt(spread + jnp.finfo(level.dtype).eps)


@checked
def limit(
    known: Channels, frequencies: Frequencies, *, ratio: float = 1.0, rings: int = 64
) -> Float[Array, ""]:
    """The frequency up to which every ring is above a signal-to-noise ratio, cycles/rad.

    The first zero, if it is wider than a ring; else the cut-off of aperture, pixel and noise.
    Interpolated between rings on a logarithmic scale; the highest frequency if none falls below.
    """
    level = jnp.log(ring_means(known, frequencies, rings) + _tiny(known)) - jnp.log(ratio)
    below = level < 0
    first = jnp.where(jnp.any(below), jnp.argmax(below), rings)
    before, after = level[jnp.maximum(first - 1, 0)], level[jnp.minimum(first, rings - 1)]
    fall = jnp.where(below[jnp.minimum(first, rings - 1)], before - after, 1.0)
    place = first.astype(level.dtype) - 0.5 + before / jnp.where(fall > 0, fall, 1.0)
    place = jnp.where(first == 0, 0.0, jnp.where(first == rings, float(rings), place))
    return frequencies.highest * place / rings


def _in_band(band: tuple[float, float], rings: int, dtype) -> Bool[Array, " ring"]:
    places = jnp.asarray((np.arange(rings) + 0.5) / rings, dtype)
    return (places >= band[0]) & (places <= band[1])


def _tiny(known: Channels):
    return jnp.finfo(known.density.dtype).tiny


@checked
@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of the numbers that a reconstruction assumes; 0 is exact.

    - `beta`: relative, of each capture's mask on its own.
    - `distance`: mm, of each capture on its own; `wavelength`: mm, `object_distance`: mm, of all.
    - `tilt`: angle of the mask against the sensor, rad. Over a mask of width w it makes the
      distance vary evenly with a standard deviation of tilt·w/√12, and is counted as an error of
      that size.
    """

    beta: Annotated[float, _PART] = 0.0
    distance: Annotated[float, _LENGTH] = 0.0
    wavelength: Annotated[float, _LENGTH] = 0.0
    object_distance: Annotated[float, _LENGTH] = 0.0
    tilt: Annotated[float, quantity("rad", non_negative=True)] = 0.0


_TOO_LARGE = (
    "tolerances move a distance or a wavelength to below zero; give tolerances that are small "
    "against these"
)


@checked
def robust_error(
    design: Design,
    setup: Setup,
    synthesis: Float[Array, "channel capture"],
    frequencies: Frequencies,
    tolerances: Tolerances,
    *,
    how: Literal["mean", "worst"] = "mean",
) -> Float[Array, ""]:
    r"""`mismatch_error` over the tolerances, of a reconstruction made for the exact design.

    "mean": its expectation for independent errors, to second order,
    :math:`E_0 + \sum_i [\tfrac12(E_{+i} + E_{-i}) - E_0]` with each number moved by its standard
    deviation. "worst": the largest of all E±i, as a soft maximum. The scale of the image on the
    sensor is taken to be registered.
    """
    checks.choice("how", how, ("mean", "worst"))
    known = channels(design, setup, synthesis, frequencies)
    exact = bayes_error(known)
    moved = list(_moved(design, setup, tolerances))
    if not moved:
        return exact

    def error(one: tuple[Design, Setup]):
        actual = channels(one[0], one[1], synthesis, frequencies)
        return mismatch_error(known, actual)

    # Stacked, they are one program in place of one for each.
    designs, setups = jax.tree.map(lambda *leaves: jnp.stack(leaves), *moved)
    lengths = designs.distance, designs.wavelength, setups.object_distance
    lost = jnp.min(jnp.stack([jnp.min(length) for length in lengths])) <= 0
    every = eqx.error_if(jax.vmap(error)((designs, setups)), lost, _TOO_LARGE)
    if how == "mean":
        return exact + jnp.sum(every - exact) / 2
    # Soft to a hundredth of the error: smooth where two tolerances cost the same.
    scale = 100 / exact
    return jax.nn.logsumexp(scale * jnp.append(every, exact)) / scale


def _moved(design: Design, setup: Setup, tolerances: Tolerances):
    """The design and the setup with one number moved, either way."""
    captures = range(design.captures)
    for sign in (-1.0, 1.0):
        for k in captures:
            if tolerances.beta:
                beta = design.beta.at[k].multiply(1 + sign * tolerances.beta)
                yield eqx.tree_at(lambda d: d.beta, design, beta), setup
            if tolerances.distance:
                yield _farther(design, design.distance.at[k].add(sign * tolerances.distance)), setup
        if tolerances.tilt:
            depth = (
                sign * tolerances.tilt * design.width / jnp.sqrt(12.0).astype(design.width.dtype)
            )
            yield _farther(design, design.distance + depth), setup
        if tolerances.wavelength:
            wavelength = design.wavelength + sign * tolerances.wavelength
            yield eqx.tree_at(lambda d: d.wavelength, design, wavelength), setup
        if tolerances.object_distance:
            there = setup.object_distance + sign * tolerances.object_distance
            yield design, eqx.tree_at(lambda s: s.object_distance, setup, there)


def _farther(design: Design, distance: Float[Array, " capture"]) -> Design:
    return eqx.tree_at(lambda d: d.distance, design, distance)


@checked
class ObjectiveData(eqx.Module):
    """Setup, synthesis and frequencies that an objective is evaluated with.

    - `synthesis`: real weights of the captures, a matrix with orthogonal rows.
    """

    setup: Setup
    synthesis: Float[Array, "channel capture"]
    frequencies: Frequencies

    def channels(self, design: Design) -> Channels:
        """`channels` of a design."""
        return channels(design, self.setup, self.synthesis, self.frequencies)


class AbstractObjective:
    """Objective of a design: its cost to minimise, and how its value is reported.

    A subclass is a frozen dataclass of its settings, so that equal objectives are compiled once.
    It defines `value`, and as class variables:

    - `name`: name in experiment files; `quantity`: reported quantity in words; `unit`: its unit.
    - `maximised`: whether larger values are better; the cost is then the negative value.
    """

    name: ClassVar[str]
    quantity: ClassVar[str]
    unit: ClassVar[str] = "dB"
    maximised: ClassVar[bool] = False

    def value(self, design: Design, data: Any) -> Float[Array, ""]:
        """Value of a design; `data` is `ObjectiveData` but for objectives of training images."""
        raise NotImplementedError

    def __call__(self, design: Design, data: Any) -> Float[Array, ""]:
        """Cost to minimise."""
        value = self.value(design, data)
        return -value if self.maximised else value

    @property
    def label(self) -> str:
        """Quantity and unit of the reported value."""
        return f"{self.quantity} ({self.unit})"

    def reported(self, cost: Any) -> Any:
        """Value that is reported for a cost, in `unit`."""
        cost = np.asarray(cost, dtype=float)
        return -cost if self.maximised else cost

    def gain(self, reference: float, found: float) -> float:
        """Improvement of the cost `found` over that of a reference, in `unit`."""
        gain = float(self.reported(reference) - self.reported(found))
        return -gain if self.maximised else gain

    def increase(self, cost: float) -> float:
        """Increase of a cost that counts as 1 % worse."""
        return _ONE_PERCENT * abs(cost)


class _RelativeError(AbstractObjective):
    """An error as a part of a variance, reported in dB."""

    def reported(self, cost: Any) -> Any:
        return 10 * np.log10(np.asarray(cost, dtype=float))


class _OfBand(AbstractObjective):
    """A level in dB of a band of frequencies."""

    def increase(self, cost: float) -> float:
        return _ONE_PERCENT_DB


@dataclass(frozen=True)
class BayesError(_RelativeError):
    """`bayes_error`."""

    name: ClassVar[str] = "bayes_error"
    quantity: ClassVar[str] = "predicted error over the scene's variance"

    def value(self, design: Design, data: ObjectiveData) -> Float[Array, ""]:
        return bayes_error(data.channels(design))


@checked
@dataclass(frozen=True)
class RobustError(_RelativeError):
    """`robust_error` with these tolerances."""

    name: ClassVar[str] = "robust_error"
    quantity: ClassVar[str] = "predicted error with the tolerances"
    tolerances: Tolerances = Tolerances()
    how: Literal["mean", "worst"] = "mean"

    def value(self, design: Design, data: ObjectiveData) -> Float[Array, ""]:
        given = data.setup, data.synthesis, data.frequencies
        return robust_error(design, *given, self.tolerances, how=self.how)


@checked
@dataclass(frozen=True)
class WorstRatio(_OfBand):
    """`worst_ratio_db` of a band."""

    name: ClassVar[str] = "worst_ratio"
    quantity: ClassVar[str] = "lowest signal-to-noise ratio of the band"
    maximised: ClassVar[bool] = True
    band: tuple[float, float] = DEFAULT_BAND

    def value(self, design: Design, data: ObjectiveData) -> Float[Array, ""]:
        return worst_ratio_db(data.channels(design), data.frequencies, self.band)


@checked
@dataclass(frozen=True)
class Unevenness(_OfBand):
    """`unevenness` of a band."""

    name: ClassVar[str] = "unevenness"
    quantity: ClassVar[str] = "unevenness of the band"
    band: tuple[float, float] = DEFAULT_BAND

    def value(self, design: Design, data: ObjectiveData) -> Float[Array, ""]:
        return unevenness(data.channels(design), data.frequencies, self.band)


@dataclass(frozen=True)
class ResolutionLimit(AbstractObjective):
    """`limit` of resolution."""

    name: ClassVar[str] = "limit"
    quantity: ClassVar[str] = "limit of resolution"
    unit: ClassVar[str] = "cycles/rad"
    maximised: ClassVar[bool] = True

    def value(self, design: Design, data: ObjectiveData) -> Float[Array, ""]:
        return limit(data.channels(design), data.frequencies)


OBJECTIVES = {
    objective.name: objective
    for objective in (BayesError, RobustError, WorstRatio, ResolutionLimit, Unevenness)
}
