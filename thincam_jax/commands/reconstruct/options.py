"""What a run is asked for: its files, its method, and what it writes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from thincam_jax._core import checks
from thincam_jax.measured import MeasurementError, Preparation, Raw
from thincam_jax.measured.read import image_files
from thincam_jax.measured.write import WhiteBalance
from thincam_jax.reconstruction import SOLVERS, AbstractSolver, AdmmTV, Fista, Ridge, TotalVariation

# What works from a measured PSF and prepared captures; "auto" then is admm_tv.
PSF_METHODS = ("auto", "admm_tv", "fista", "ridge")
DEFAULT_TAU, DEFAULT_RIDGE = 2.0, 1.0

# Far beyond any use; its product with the captures' units stays within float32.
_LARGEST_TAU = 1e6

Background = Path | float | int | None


@dataclass(frozen=True)
class Sources:
    """What all captures of a run share; see `measured.prepare`.

    - `psf`: a file, or what `computed_psf` computed. `dead`: a file. `background`,
      `psf_background`: a dark frame's file, a number of counts, or None for the default.
    - `bits`: bit depth of the camera where its files do not tell it; `psf_bits` that of the PSF
      and its background where it is another.
    - `distances`: mm, increasing, of the PSFs that `psf` then holds, one for each; see
      `measured.read_images`. Without, it is one PSF.
    """

    psf: Path | Raw
    background: Background = None
    psf_background: Background = None
    dead: Path | None = None
    bits: int | None = None
    preparation: Preparation = Preparation()
    psf_bits: int | None = None
    distances: tuple[float, ...] = ()

    def paths(self) -> list[Path]:
        """Every file that is read."""
        given = (self.psf, self.background, self.psf_background, self.dead)
        paths = [path for path in given if isinstance(path, Path)]
        return paths + (image_files(paths[0]) if self.distances and paths[0].is_dir() else [])


@dataclass(frozen=True)
class Focusing:
    """A network in place of a solver, and the distance that its images are focused on, mm.

    - `network`: a `RefocusNetwork`, not named here: other methods need not wait for its import.
    """

    path: Path
    network: Any
    distance: float


@dataclass(frozen=True)
class Recipe:
    """How to reconstruct; see `thincam_jax.reconstruct`.

    - `method`: one of `PSF_METHODS`.
    - `tau`: weight of the variation relative to the noise; None: 2. `iterations`: at most.
    - `coupling`: of colours; None: "joint" for several channels.
    - `field`: "sensor" keeps the part of the image in front of the sensor, "full" all that sends
      light to it.
    - `flip`: turn the image by 180°.
    - `ridge`: of the method "ridge", which has neither tau nor coupling; None: 1.
    - `noise`: standard deviation of a raw pixel's noise, counts; None: estimated.
    - `focusing`: a network; `method` is then "learned", and nothing else of it is used.

    **Errors**: MeasurementError for what is unknown or out of range.
    """

    method: str = "admm_tv"
    tau: float | int | None = None
    iterations: int = 100
    coupling: Literal["none", "joint", "opponent"] | None = None
    field: Literal["sensor", "full"] = "sensor"
    flip: bool = False
    ridge: float | int | None = None
    noise: float | int | None = None
    focusing: Focusing | None = None

    def __post_init__(self):
        self._check_method()
        try:
            checks.non_negative("tau", self.relative_tau, "parts of one")
            if self.ridge is not None:
                checks.positive("ridge", self.ridge, "parts of one")
            if self.noise is not None:
                checks.positive("noise", self.noise, "counts")
        except ValueError as error:
            raise MeasurementError(str(error)) from None
        if self.relative_tau > _LARGEST_TAU:
            raise MeasurementError(
                f"tau = {self.relative_tau:g}: give about 1 to 3, at most {_LARGEST_TAU:g}"
            )
        if self.iterations < 1:
            raise MeasurementError(f"iterations = {self.iterations}: give at least 1")

    @property
    def is_ridge(self) -> bool:
        return self.method == "ridge"

    @property
    def relative_tau(self) -> float | int:
        return DEFAULT_TAU if self.tau is None else self.tau

    @property
    def relative_ridge(self) -> float | int:
        return DEFAULT_RIDGE if self.ridge is None else self.ridge

    def solver(self, channels: int) -> AbstractSolver:
        """The solver for a capture of so many colour channels."""
        if self.is_ridge:
            return Ridge(self.relative_ridge, iterations=self.iterations)
        variation = TotalVariation(coupling=self.coupling or ("joint" if channels > 1 else "none"))
        if self.method == "fista":
            return Fista(self.relative_tau, regulariser=variation, iterations=self.iterations)
        return AdmmTV(self.relative_tau, variation=variation, iterations=self.iterations)

    def _check_method(self) -> None:
        """Whether it is one, works from prepared captures, and uses what is given."""
        if self.focusing is not None:
            for name in ("coupling", "tau", "ridge"):
                if getattr(self, name) is not None:
                    raise MeasurementError(f"--network has no {name}; leave one of both out")
            return
        able = f"choose one of {', '.join(repr(m) for m in PSF_METHODS)}"
        if self.method in ("wiener", "fringe_scanning"):
            raise MeasurementError(
                f"method {self.method!r} needs a model of the camera; with a measured PSF {able}"
            )
        if self.method in SOLVERS and self.method not in PSF_METHODS:
            raise MeasurementError(
                f"method {self.method!r} needs raw counts, which prepared captures are not; {able}"
            )
        if self.method not in PSF_METHODS:
            raise MeasurementError(f"method = {self.method!r} is unknown; {able}")
        given = {"coupling": self.coupling, "tau": self.tau, "ridge": self.ridge}
        unused = ("coupling", "tau") if self.is_ridge else ("ridge",)
        for name in unused:
            if given[name] is not None:
                other = "'admm_tv'" if self.is_ridge else "'ridge'"
                raise MeasurementError(
                    f"method {self.method!r} cannot use {name}; leave it out, or use {other}"
                )


@dataclass(frozen=True)
class Output:
    """Where and how results are written.

    - `path`: an image file; or a folder, in which each result has the name of its capture.
    - `linear`: format of the float image beside a PNG, "npy" or "tif"; "none" for none.
    - `gamma`, `white_balance`: of the PNG; see `measured.to_display`.
    - `unsure`: also NAME-unsure.png, a learned image with what is not sure in red.
    """

    path: Path
    linear: Literal["npy", "tif", "none"] = "npy"
    gamma: float | int = 2.2
    white_balance: WhiteBalance = None
    unsure: bool = False
