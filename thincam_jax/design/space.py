r"""Design spaces: the numbers of a design that are free, within bounds and limits.

A search happens in the unit cube: `DesignSpace.design` maps each point of it to a design that keeps
every limit, those that tie two variables together too, so that no solver has to know them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import FieldError, Quantity, quantities, quantity, whole
from thincam_jax.design.design import MOST_CAPTURES, Design

_WITHIN = 1e-3  # distance in the cube below which a limit is active
QUANTITIES = quantities(Design)  # what may be free


@dataclass(frozen=True)
class ReportedNumber:
    """Format in which a number of a shot is reported, in the unit of its attribute; light in nm.

    - `name`: in tables and on axes.
    """

    name: str
    quantity: Quantity

    @property
    def _light(self) -> bool:
        return self.quantity.kind == "wavelength"

    @property
    def unit(self) -> str:
        return "nm" if self._light else self.quantity.symbol

    @property
    def scale(self) -> float:
        """Factor from the package's unit."""
        return 1e6 if self._light else 1.0

    @property
    def form(self) -> str:
        """Format of its digits."""
        return ".0f" if self._light else ".2f"

    @property
    def label(self) -> str:
        """Name and unit: "distance, mm"."""
        return self.of_shots(())

    def of_shots(self, shots: Sequence[int]) -> str:
        """Name, shots (from 1; none for what all share) and unit: "β of shot 1, rad/mm²"."""
        unit = f", {self.unit}" if self.unit else ""
        if not shots:
            return f"{self.name}{unit}"
        word = "shot" if len(shots) == 1 else "shots"
        return f"{self.name} of {word} {', '.join(str(s) for s in shots)}{unit}"


_NAMES = {"beta": "β", "width": "mask width"}  # of those reported by another name
REPORTED = {name: ReportedNumber(_NAMES.get(name, name), one) for name, one in QUANTITIES.items()}


@checked
@dataclass(frozen=True)
class Variable:
    """One free number of a design.

    - `name`: name of one of the numbers of `Design`; `DesignSpace` refuses any other.
    - `lower`, `upper`: its bounds, in the design's units.
    - `captures`: numbers of the captures that share it; none for the width, which all share.
    """

    name: str
    lower: float
    upper: float
    captures: tuple[int, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "captures", tuple(map(int, self.captures)))

    @property
    def unit(self) -> str:
        """Unit of the variable's values."""
        return QUANTITIES[self.name].unit

    def label(self) -> str:
        """Name of the variable, with the captures that it belongs to."""
        listed = ", ".join(str(c + 1) for c in self.captures)
        return f"{self.name} of capture {listed}" if self.captures else self.name

    def shots(self, design: Design) -> tuple[int, ...]:
        """Shots of a design that share it, counted from 1; none for the width."""
        return tuple(sorted({c // design.phases + 1 for c in self.captures}))


@checked
@dataclass(frozen=True)
class Limits:
    """Limits of a rig, beside the bounds of single variables.

    - `mask_pixel`: pixel of the display or printer, mm: the zones at the mask's edge keep a period
      of two of them, β·width ≤ π/mask_pixel.
    - `thickness`: the longest distance of mask and sensor, mm.
    - `captures`: largest number of captures.
    - `exposure`: exposure of all captures together, shares: what the free ones leave is divided
      among the others as their own shares are.
    """

    mask_pixel: Annotated[float | None, quantity("mm", positive=True, optional=True)] = None
    thickness: Annotated[float | None, quantity("mm", positive=True, optional=True)] = None
    captures: Annotated[int, whole(1, MOST_CAPTURES)] = MOST_CAPTURES
    exposure: float | None = None


@checked
class DesignSpace(eqx.Module):
    """Designs with some numbers free, the others as in `base`.

    **Errors**: FieldError for bounds that cross, for a number that is free twice, for captures
    that do not exist, and for limits that no design keeps, with the two that conflict.
    """

    base: Design
    lower: Float[Array, " variable"]
    upper: Float[Array, " variable"]
    variables: tuple[Variable, ...] = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)

    def __init__(self, base: Design, variables: tuple[Variable, ...], limits: Limits | None = None):
        self.base = base
        self.limits = Limits() if limits is None else limits
        # The width comes first: the bounds of β depend on it.
        self.variables = tuple(sorted(variables, key=lambda v: v.name != "width"))
        _check_variables(base, self.variables)
        _check_limits(base, self.variables, self.limits)
        _check_exposure(base, self.variables, self.limits)
        dtype = base.beta.dtype
        self.lower = jnp.asarray([v.lower for v in self.variables], dtype)
        upper = [self._upper(v) for v in self.variables]
        self.upper = jnp.asarray(upper, dtype)

    def _upper(self, variable: Variable) -> float:
        if variable.name == "distance" and self.limits.thickness is not None:
            return min(variable.upper, self.limits.thickness)
        return variable.upper

    @property
    def size(self) -> int:
        """Number of free numbers."""
        return len(self.variables)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the free numbers with shots and units."""
        return tuple(REPORTED[v.name].of_shots(v.shots(self.base)) for v in self.variables)

    def design(self, point: Float[Array, " variable"]) -> Design:
        """The design of a point of the unit cube."""
        return self._with_values(self.values(point))

    def values(self, point: Float[Array, " variable"]) -> Float[Array, " variable"]:
        """The free numbers of a point, in the order of `variables`."""
        width = self.base.width
        if self.variables[0].name == "width":
            # No wider than the lowest β allows, and β no higher than that width does.
            width = self.lower[0] + point[0] * (self.upper[0] - self.lower[0])
        return self.lower + point * (self.highest(width) - self.lower)

    def point(self, design: Design) -> Float[Array, " variable"]:
        """Place of a design in the unit cube, or outside of it; ½ along an axis without extent.

        Of a number that captures share, the first one's counts.
        """
        spans = self.highest(design.width) - self.lower
        inside = (self.numbers(design) - self.lower) / jnp.where(spans > 0, spans, 1)
        return jnp.where(spans > 0, inside, 0.5)

    def numbers(self, design: Design) -> Float[Array, " variable"]:
        """The free numbers of a design, of any space."""
        given = [
            getattr(design, v.name)[v.captures[0]] if v.captures else design.width
            for v in self.variables
        ]
        return jnp.stack(given)

    def highest(self, width: Float[Array, ""]) -> Float[Array, " variable"]:
        """The upper bounds of the free numbers of designs with masks of a width, mm."""
        if self.limits.mask_pixel is None:
            return self.upper
        finest = math.pi / self.limits.mask_pixel / width
        is_beta = jnp.asarray([v.name == "beta" for v in self.variables])
        return jnp.where(is_beta, jnp.minimum(self.upper, finest), self.upper)

    def reach(self, name: str) -> tuple[float, float]:
        """Least and largest value of a number: of the base's captures and within the bounds."""
        given = np.asarray(getattr(self.base, name), dtype=float).ravel().tolist()
        bounds = [end for v in self.variables if v.name == name for end in (v.lower, v.upper)]
        if name == "distance":
            bounds = [min(end, self.limits.thickness or math.inf) for end in bounds]
        return min([*given, *bounds]), max([*given, *bounds])

    def _with_values(self, values: Float[Array, " variable"]) -> Design:
        design = self.base
        for variable, value in zip(self.variables, values, strict=True):
            number = getattr(design, variable.name)
            changed = value
            if variable.captures:
                changed = number.at[jnp.asarray(variable.captures)].set(value)
            design = eqx.tree_at(lambda d, n=variable.name: getattr(d, n), design, changed)
        total = self.limits.exposure
        if total is None:
            return design
        shared = self._shared_out(design.exposure, total)
        return eqx.tree_at(lambda d: d.exposure, design, shared)

    def _shared_out(self, exposure: Float[Array, " capture"], total: float):
        """Exposures of that total: the captures whose exposure is not free divide the rest."""
        free = {c for v in self.variables if v.name == "exposure" for c in v.captures}
        rest = jnp.asarray([float(c not in free) for c in range(len(exposure))], exposure.dtype)
        left = total - jnp.sum((1 - rest) * exposure)
        scale = left / jnp.sum(rest * exposure)
        return exposure * (1 + rest * (scale - 1))


def active_limits(
    space: DesignSpace, point: Float[Array, " variable"] | Float[np.ndarray, " variable"]
) -> tuple[str, ...]:
    """Active limits at a point of the unit cube, in words."""
    words = []
    values = space.values(jnp.asarray(point))
    for variable, place, value in zip(space.variables, jax.device_get(point), values, strict=True):
        unit = variable.unit
        if place <= _WITHIN:
            words.append(f"{variable.label()} ≥ {float(value):.6g} {unit}")
        elif place >= 1 - _WITHIN:
            reason = _reason(space, variable, value)
            words.append(f"{variable.label()} ≤ {float(value):.6g} {unit}{reason}")
    return tuple(words)


def broken_limits(space: DesignSpace) -> tuple[str, ...]:
    """Limits that the base of a space does not keep, in words."""
    words = []
    pixel, thickness = space.limits.mask_pixel, space.limits.thickness
    for number, shot in enumerate(space.base.shots, 1):
        if pixel is not None:
            finest = math.pi / pixel / shot.width
            if shot.beta > finest * (1 + 1e-6):
                words.append(
                    f"β of shot {number}, {shot.beta:g} rad/mm², is more than the "
                    f"{finest:.4g} rad/mm² that mask pixels of {1000 * pixel:g} µm show"
                )
        if thickness is not None and shot.distance > thickness * (1 + 1e-6):
            words.append(
                f"the distance of shot {number}, {shot.distance:g} mm, is more than the thickness "
                f"of {thickness:g} mm"
            )
    return tuple(words)


def _reason(space: DesignSpace, variable: Variable, value) -> str:
    # As near to its own bound as what calls it active: no limit is needed to explain it.
    if float(value) >= variable.upper - (_WITHIN + 1e-6) * (variable.upper - variable.lower):
        return ""
    # A space that was narrowed since lies against its own bounds only.
    limit = space.limits.thickness if variable.name == "distance" else space.limits.mask_pixel
    if limit is None:
        return ""
    if variable.name == "distance":
        return f" (thickness of {limit:g} mm)"
    return f" (mask pixels of {limit:g} mm)"


def _check_variables(base: Design, variables: tuple[Variable, ...]) -> None:
    if not variables:
        raise FieldError("no variable is free; give at least one to search for", "variables")
    taken: set[tuple[str, int]] = set()
    for v in variables:
        if v.name not in QUANTITIES:
            known = ", ".join(QUANTITIES)
            raise FieldError(f"variable {v.name!r} is unknown; choose one of {known}", "variables")
        if not (math.isfinite(v.lower) and math.isfinite(v.upper) and v.lower <= v.upper):
            raise FieldError(
                f"bounds of {v.label()} cross: {v.lower:g} to {v.upper:g} {v.unit}; "
                "give the lower one first",
                "variables",
            )
        if v.lower <= 0 and v.name != "phase":
            raise FieldError(
                f"bounds of {v.label()} begin at {v.lower:g} {v.unit}; give a lower bound above 0",
                "variables",
            )
        if bool(v.captures) == (v.name == "width"):
            raise FieldError(
                f"{v.label()}: all captures share the width, and any other variable needs the "
                "captures it belongs to",
                "variables",
            )
        if any(not 0 <= c < base.captures for c in v.captures):
            raise FieldError(
                f"{v.label()}: the design has captures 1 to {base.captures}", "variables"
            )
        keys = {(v.name, c) for c in v.captures or (-1,)}
        if keys & taken:
            raise FieldError(
                f"{v.label()} is free twice; let each number be free once", "variables"
            )
        taken |= keys


def _check_limits(base: Design, variables: tuple[Variable, ...], limits: Limits) -> None:
    """Refuse limits that exclude each other, naming the two."""
    if base.captures > limits.captures:
        raise FieldError(
            f"no design is feasible: it takes {base.captures} captures, and the budget is "
            f"{limits.captures}; allow more, or drop captures",
            "limits",
        )
    if limits.thickness is not None:
        for shortest, label in _lowest(base, variables, "distance"):
            # In single precision a number may lie a rounding above its own limit.
            if shortest > limits.thickness * (1 + 1e-6):
                raise FieldError(
                    f"no design is feasible: {label} ≥ {shortest:g} mm conflicts with a thickness "
                    f"of at most {limits.thickness:g} mm",
                    "limits",
                )
    if limits.mask_pixel is not None:
        widths = [v for v in variables if v.name == "width"]
        widest = widths[0].upper if widths else float(base.width)
        width = widths[0].lower if widths else widest
        finest = math.pi / limits.mask_pixel / width
        for lowest, label in _lowest(base, variables, "beta"):
            if lowest > finest * (1 + 1e-6):
                raise FieldError(
                    f"no design is feasible: {label} ≥ {lowest:g} rad/mm^2 conflicts with mask "
                    f"pixels of {limits.mask_pixel:g} mm, which over a width of {width:g} mm show "
                    f"at most {finest:.4g} rad/mm^2",
                    "limits",
                )
        reach = max(low for low, _ in _lowest(base, variables, "beta"))
        if widest > math.pi / limits.mask_pixel / reach * (1 + 1e-6):
            raise FieldError(
                f"width ≤ {widest:g} mm conflicts with beta ≥ {reach:g} rad/mm^2 on mask pixels of "
                f"{limits.mask_pixel:g} mm; give a width of at most "
                f"{math.pi / limits.mask_pixel / reach:.4g} mm",
                "limits",
            )


def _check_exposure(base: Design, variables: tuple[Variable, ...], limits: Limits) -> None:
    """Refuse shares that leave the captures that are not free nothing."""
    if limits.exposure is None:
        return
    free = [v for v in variables if v.name == "exposure"]
    if sum(len(v.captures) for v in free) == base.captures:
        raise FieldError(
            f"the exposure of every capture is free, and all of them share {limits.exposure:g}; "
            "leave one that takes the rest, or free none",
            "variables",
        )
    most = sum(v.upper * len(v.captures) for v in free)
    if most >= limits.exposure * (1 - 1e-6):
        raise FieldError(
            f"no design is feasible: free exposures of up to {most:g} shares conflict with the "
            f"{limits.exposure:g} that all captures have; end their bounds lower, so that the "
            "others have some",
            "variables",
        )


def _lowest(base: Design, variables: tuple[Variable, ...], name: str):
    """The lowest value each capture's number may take: (value, words)."""
    free = {c: v for v in variables if v.name == name for c in v.captures}
    for capture in range(base.captures):
        if capture in free:
            yield free[capture].lower, free[capture].label()
        else:
            yield float(getattr(base, name)[capture]), f"{name} of capture {capture + 1}"
