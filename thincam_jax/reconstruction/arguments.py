"""Which arguments of `reconstruct` serve which method, and what is said of those that do not."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.automatic import CANDIDATES, are_cameras
from thincam_jax.reconstruction.drive import Callback
from thincam_jax.reconstruction.regularised import Acceleration, TauRule
from thincam_jax.reconstruction.regulariser import AbstractRegulariser
from thincam_jax.reconstruction.total_variation import TotalVariation

Method = Literal[
    "auto", "wiener", "fringe_scanning", "admm_tv", "fista", "twist", "ridge", "poisson"
]
METHODS: tuple[Method, ...] = get_args(Method)
# Computed from a model of the camera, not from a measured PSF.
FILTERS = ("wiener", "fringe_scanning")

_VARIATION = (
    *("tau", "variation", "nonnegative", "valid", "iterations", "tolerance"),
    *("start", "callback", "noise_variance", "synthesis"),
)
# What may be left out is named here with the methods that can use it. Fringe scanning is told of
# noise and sums so that it can stand where the other filter stands.
_FILTER = ("noise_variance", "synthesis")
USES: dict[str, tuple[str, ...]] = {
    "wiener": _FILTER,
    "fringe_scanning": _FILTER,
    "admm_tv": (*_VARIATION, "relaxation", "acceleration"),
    "fista": (*_VARIATION, "regulariser"),
    "twist": (*_VARIATION, "regulariser"),
    "ridge": ("ridge", "valid", "iterations", "tolerance", "noise_variance", "synthesis"),
    "poisson": ("background", "tau", "variation", "valid", "iterations", "tolerance", "start"),
}
USES["auto"] = tuple({name for method in CANDIDATES for name in USES[method]})

DEFAULT_TAU = 2.0
DEFAULT_RIDGE = 1.0
DEFAULT_TOLERANCE = 1e-4
DEFAULT_RELAXATION = 1.8
_UNITS = {"object_distance": "mm", "wavelength": "mm", "noise_variance": "units²"}


class Settings(NamedTuple):
    """How a method is tuned, as given to `reconstruct`; None where nothing was."""

    tau: Any = None
    variation: TotalVariation | None = None
    regulariser: AbstractRegulariser | None = None
    ridge: Any = None
    background: Any = None
    nonnegative: bool | None = None
    iterations: int | None = None
    tolerance: float | None = None
    relaxation: float | None = None
    acceleration: Acceleration | None = None
    start: Float[Array, "..."] | None = None
    callback: Callback | None = None

    @property
    def rule(self) -> str | None:
        """The name of what is to find τ."""
        return self.tau if isinstance(self.tau, str) else None

    @property
    def number(self):
        """The relative τ, from which a rule starts."""
        return DEFAULT_TAU if self.tau is None or self.rule is not None else self.tau

    @property
    def limit(self) -> float:
        """The tolerance."""
        return DEFAULT_TOLERANCE if self.tolerance is None else self.tolerance

    def at_most(self, default: int) -> int:
        """The iterations."""
        return default if self.iterations is None else self.iterations


def check_settings(method: str, settings: Settings, **more) -> None:
    """What a method cannot use is refused: the answer would be to another question than was asked.

    `more`: other arguments of `USES`.
    """
    refuse_unused(method, **settings._asdict(), **more)
    _check_values(settings)
    if settings.regulariser is not None and settings.variation is not None:
        raise ValueError(
            "regulariser and variation are given; the regulariser takes the place of total "
            "variation: leave one of them out"
        )
    if settings.rule is not None and (settings.regulariser is not None or method == "poisson"):
        raise ValueError(
            f"tau = {settings.tau!r} is found for total variation and Gaussian noise only; give "
            "a number, about 1 to 3"
        )


def _check_values(settings: Settings) -> None:
    """Each by itself, whatever method will use it."""
    kinds = (("variation", TotalVariation), ("regulariser", AbstractRegulariser))
    for name, kind in kinds:
        value = getattr(settings, name)
        if value is not None and not isinstance(value, kind):
            wanted = kind.__name__.removeprefix("Abstract")
            raise ValueError(f"{name} is a {type(value).__name__}; give a {wanted}")
    if settings.rule is not None:
        checks.choice("tau", settings.rule, get_args(TauRule))
    _check_limits(settings.at_most(1), settings.limit)
    if settings.relaxation is not None:
        _check_relaxation(settings.relaxation)
    if settings.acceleration is not None:
        checks.choice("acceleration", settings.acceleration, get_args(Acceleration))


def _check_relaxation(relaxation) -> None:
    """Whether ADMM converges with it."""
    value = float(checks.finite("relaxation", relaxation, "parts of one"))
    if not 0 < value < 2:
        raise ValueError(f"relaxation = {value:g} is out of range; give 0 < α < 2")


def _check_limits(iterations: int, tolerance: float) -> None:
    """When to end."""
    if not isinstance(iterations, int) or iterations < 1:
        raise ValueError(f"iterations = {iterations}; give a whole number of at least 1")
    checks.non_negative("tolerance", tolerance, "parts of one")


def refuse_unused(method: str, **given) -> None:
    """One line on what is given and not used by a method."""
    names = [name for name, value in given.items() if value is not None]
    unused = [name for name in names if name not in USES[method]]
    if not unused:
        return
    # First those that take measured PSFs too.
    methods = (*(m for m in METHODS if m not in ("auto", *FILTERS)), *FILTERS)
    able = [m for m in methods if all(name in USES[m] for name in unused)]
    other = f", or use {able[0]!r}" if able else ""
    raise ValueError(f"method {method!r} cannot use {' and '.join(unused)}; leave out{other}")


def require(method: str, **given) -> None:
    """What a method needs."""
    missing = [f"{name} ({_UNITS[name]})" for name, value in given.items() if value is None]
    if missing:
        raise ValueError(f"method {method!r} needs {' and '.join(missing)}")


def cameras_or_psfs(cameras) -> Sequence[LenslessCamera] | Array:
    """Camera models as they are, anything else as an array of PSFs."""
    if isinstance(cameras, LenslessCamera):
        raise TypeError("cameras is one camera; give a list, [camera], one for each capture")
    if isinstance(cameras, Sequence) and not cameras:
        raise ValueError("cameras is empty; give one camera, or one PSF, for each capture")
    if are_cameras(cameras):
        return cameras
    psfs = jnp.asarray(cameras)
    if psfs.ndim < 3:
        raise ValueError(
            f"PSFs have shape {psfs.shape}; give (capture, k, l), such as psf[None] for one"
        )
    return psfs


def floating_captures(captures, count: int) -> Float[Array, "capture *batch y x"]:
    """One array of real numbers, as many captures as cameras."""
    captures = jnp.asarray(captures)
    if not jnp.issubdtype(captures.dtype, jnp.floating):
        captures = captures.astype(float)
    if captures.ndim < 3 or captures.shape[0] != count:
        raise ValueError(
            f"captures have shape {captures.shape} for {count} cameras; give ({count}, …, y, x)"
        )
    return captures
