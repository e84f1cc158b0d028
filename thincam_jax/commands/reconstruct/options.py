"""Options of a reconstruction: its files, its camera, its method, and what it writes."""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from thincam_jax._core import checks
from thincam_jax.commands.kinds import load_study
from thincam_jax.commands.reconstruct import METHODS
from thincam_jax.commands.study.build import assemble, check_optics
from thincam_jax.measured import MeasurementError, Preparation, Raw
from thincam_jax.measured.read import image_files
from thincam_jax.measured.write import WhiteBalance
from thincam_jax.reconstruction import AbstractSolver, TotalVariation
from thincam_jax.reconstruction.depth.refocus import increasing
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.methods import SOLVERS
from thincam_jax.reconstruction.regularised import AdmmTV, Fista
from thincam_jax.reconstruction.ridge import Ridge
from thincam_jax.studies.intervals import Intervals
from thincam_jax.studies.prepared import computed_psf
from thincam_jax.units import parse_quantity

PSF_METHODS = tuple(name.replace("-", "_") for name in METHODS)
_TRAINED = ".thincam"  # suffix of the files of 'thincam train'
_SHIPPED = Path(__file__).parents[2] / "learn"  # networks that come with the package
DEFAULT_TAU, DEFAULT_RIDGE = 2.0, 1.0

# Far beyond any use; its product with the captures' units stays within float32.
_LARGEST_TAU = 1e6

Background = Path | float | int | Literal["corner", "found"] | None


@contextlib.contextmanager
def read_as(option: str = "", advice: str = "") -> Iterator[None]:
    """ValueErrors as a MeasurementError that names the option, with advice in place of its text."""
    try:
        yield
    except ValueError as error:
        text = advice or str(error)
        raise MeasurementError(f"{option}: {text}" if option else text) from None


@dataclass(frozen=True)
class Sources:
    """Sources that all captures of a run share; see `measured.prepare`.

    - `psf`: a file, files of its exposures, or what `computed_psf` has made. `dead`: a file.
      `background`, `psf_background`: a dark frame's file, a folder (see `pair_backgrounds`), a
      number of counts, "corner", "found", or None for the default.
    - `bits`: bit depth of the camera where its files do not tell it; `psf_bits` that of the PSF
      and its background where it is another.
    - `distances`: mm, increasing, of the PSFs that `psf` then holds, one for each; see
      `measured.read_images`. Without, it is one PSF.
    - `exposures`: s, of the PSF's files, then a capture's, where these do not say them.
    """

    psf: Path | Raw | tuple[Path, ...]
    background: Background = None
    psf_background: Background = None
    dead: Path | None = None
    bits: int | None = None
    preparation: Preparation = Preparation()
    psf_bits: int | None = None
    distances: tuple[float, ...] = ()
    exposures: tuple[float, ...] = ()

    def paths(self) -> list[Path]:
        """Every file that is read, also those of folders."""
        psfs = self.psf if isinstance(self.psf, tuple) else (self.psf,)
        given = (*psfs, self.background, self.psf_background, self.dead)
        paths = [path for path in given if isinstance(path, Path)]
        return paths + [file for path in paths if path.is_dir() for file in image_files(path)]


def is_trained(method: str) -> bool:
    """Whether a method is the file of a trained reconstruction."""
    return method.endswith(_TRAINED)


def read_method(text: str) -> str:
    """Method by its word in the shell, or the whole path of a trained reconstruction.

    That of a shipped one, such as "diffusercam", has the camera's name.
    """
    if text == Path(text).stem and (shipped := _SHIPPED / f"{text}{_TRAINED}").is_file():
        return str(shipped)
    return str(Path(text).resolve()) if is_trained(text) else text.replace("-", "_")


@functools.lru_cache(2)
def _read_trained(path: str, _: float) -> AbstractSolver:
    # Here: other methods need not wait for the learned parts.
    from thincam_jax.learn.trained import TrainedReconstruction

    return TrainedReconstruction.load(path)


@dataclass(frozen=True)
class Recipe:
    """Settings of a reconstruction; see `thincam_jax.reconstruct`.

    - `method`: one of `PSF_METHODS`, or the file of a trained reconstruction.
    - `tau`: weight of the variation relative to the noise; None: 2. `iterations`: at most;
      None: as many as the method has by default.
    - `coupling`: coupling of the colours' edges; None: "joint" for several channels.
    - `field`: "sensor" keeps the part of the image in front of the sensor, "full" all that sends
      light to it.
    - `flip`: turn the image by 180°.
    - `ridge`: strength of the method "ridge", which has neither tau nor coupling; None: 1.
    - `noise`: standard deviation of a raw pixel's noise, counts; None: estimated.
    - `strict`: severe findings of the examination are errors.
    - `refine`: correct the PSF by each capture before its reconstruction.

    **Errors**: MeasurementError for what is unknown or out of range.
    """

    method: str = "admm_tv"
    tau: float | int | None = None
    iterations: int | None = None
    coupling: Literal["none", "joint", "opponent"] | None = None
    field: Literal["sensor", "full"] = "sensor"
    flip: bool = False
    ridge: float | int | None = None
    noise: float | int | None = None
    strict: bool = False
    refine: bool = False

    def __post_init__(self):
        self._check_method()
        with read_as():
            checks.non_negative("tau", self.relative_tau, "parts of one")
            checks.positive("ridge", self.relative_ridge, "parts of one")
            if self.noise is not None:
                checks.positive("noise", self.noise, "counts")
        if self.relative_tau > _LARGEST_TAU:
            raise MeasurementError(
                f"tau = {self.relative_tau:g}: give about 1 to 3, at most {_LARGEST_TAU:g}"
            )
        if self.iterations is not None and self.iterations < 1:
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
        limit: dict[str, Any] = {} if self.iterations is None else {"iterations": self.iterations}
        if is_trained(self.method):
            return self._trained()
        if self.is_ridge:
            return Ridge(self.relative_ridge, **limit)
        if self.method == "pnp":
            # Here: other methods need not wait for the learned parts.
            from thincam_jax.learn.plug_and_play import PlugAndPlay

            return PlugAndPlay(**limit)
        variation = TotalVariation(coupling=self.coupling or ("joint" if channels > 1 else "none"))
        if self.method == "fista":
            return Fista(self.relative_tau, regulariser=variation, **limit)
        return AdmmTV(self.relative_tau, variation=variation, **limit)

    def _trained(self) -> AbstractSolver:
        """The reconstruction of a file; MeasurementError, one line, for one of no use."""
        try:
            return _read_trained(self.method, Path(self.method).stat().st_mtime)
        except FileNotFoundError:
            text = "is missing; give a file that 'thincam train' wrote, or a method"
            raise MeasurementError(f"--method {self.method}: {text}") from None
        except (ValueError, OSError) as error:
            raise MeasurementError(f"--method {error}") from None

    def _check_method(self) -> None:
        """Whether it is one, works from prepared captures, and uses what is given."""
        if is_trained(self.method):
            for name in ("coupling", "tau", "ridge", "iterations"):
                if getattr(self, name) is not None:
                    raise MeasurementError(f"a trained reconstruction has no {name}; leave it out")
            self._trained()
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
        unused = {"ridge": ("coupling", "tau"), "pnp": ("coupling", "tau", "ridge")}
        for name in unused.get(self.method, ("ridge",)):
            if given[name] is not None:
                other = "'ridge'" if name == "ridge" else "'admm_tv'"
                raise MeasurementError(
                    f"method {self.method!r} cannot use {name}; leave it out, or use {other}"
                )


@dataclass(frozen=True)
class Output:
    """Files and formats of the results.

    - `path`: an image file; or a folder, in which each result has the name of its capture.
    - `linear`: format of the float image beside a PNG, "npy" or "tif"; "none" for none.
    - `gamma`, `white_balance`: encoding of the PNG; see `measured.to_display`.
    - `intervals`: calibrated by 'thincam evaluate'; also NAME-lower and NAME-upper, linear, their
      ends at each pixel, and NAME-width.png, a map of their widths.
    """

    path: Path
    linear: Literal["npy", "tif", "none"] = "npy"
    gamma: float | int = 2.2
    white_balance: WhiteBalance = None
    intervals: Intervals | None = None


def read_intervals(path: Path | None, one_method: bool, field: str) -> Intervals | None:
    """Intervals of a file of 'thincam evaluate'.

    **Errors**: MeasurementError where there are none, and for images that they do not hold for.
    """
    if path is None:
        return None
    if not one_method or field != "sensor":
        text = "are of one PSF, a --method and the sensor's field"
        raise MeasurementError(f"--intervals {text}; leave out --distances and --field")
    try:
        return Intervals.load(path)
    except FileNotFoundError:
        text = "is missing; give intervals/METHOD.json of a run of 'thincam evaluate'"
        raise MeasurementError(f"--intervals {path}: {text}") from None
    except (OSError, ValueError) as error:
        raise MeasurementError(f"--intervals {error}") from None


def read_background(text: str | None) -> Background:
    """A path, a number of counts, "corner" or "found"."""
    if text is None or text == "corner" or text == "found":
        return text
    try:
        return float(text)
    except ValueError:
        return Path(text)


def known_psf(
    psf: Sequence[Path], camera: Path | None, overrides: list[str] | None
) -> Path | Raw | tuple[Path, ...]:
    """The files of a measured PSF; or the PSF of a camera.

    **Errors**: MeasurementError where not one is given; ConfigError of the camera.
    """
    if bool(psf) == (camera is not None):
        raise MeasurementError(
            "give either --psf, a measured PSF, or --camera, a study with the camera's numbers"
        )
    if psf:
        if overrides:
            raise MeasurementError("--set changes the file of --camera; leave it out with --psf")
        return psf[0] if len(psf) == 1 else tuple(psf)
    assert camera is not None
    return computed_psf(read_camera(camera, overrides or ()), f"camera of {camera}")


def read_exposures(texts: Sequence[str], *counts: int) -> tuple[float, ...]:
    """Exposures, s, of so many files of PSF and capture; MeasurementError for another number."""
    with read_as("--exposure"):
        times = tuple(parse_quantity(text, "time") for text in texts)
    if times and len(times) != sum(n for n in counts if n > 1):
        text = f"--exposure is given {len(times)} times, for {counts[0]} --psf and {counts[1]}"
        text += " --capture; give one for each of what is given several times, the PSF's first"
        raise MeasurementError(text)
    return times


def read_distances(text: str | None, psf: Sequence[Path]) -> tuple[float, ...]:
    """Distances of measured PSFs, mm, from "60mm,80mm,100mm".

    **Errors**: MeasurementError where they are none, not increasing, or not of one --psf.
    """
    if text is None:
        return ()
    if len(psf) != 1:
        raise MeasurementError(
            "--distances are those of measured PSFs; give them by one --psf, a folder or a TIFF"
        )
    with read_as(f"--distances {text}"):
        return tuple(increasing([parse_quantity(part, "length") for part in text.split(",")]))


def read_corner(text: str) -> tuple[int, int]:
    """The first pixel of the corner and the one after its last, from "5:15".

    **Errors**: MeasurementError for anything else.
    """
    with read_as(f"--corner {text}", "give the first pixel and the one after the last, as 5:15"):
        first, last = (int(part) for part in text.split(":"))
        if not 0 <= first < last:
            raise ValueError
    return first, last


def resolved(background: str | None) -> str | None:
    """A background with the whole path of its file; MeasurementError for a folder."""
    given = read_background(background)
    if not isinstance(given, Path):
        return background
    if given.is_dir():
        raise MeasurementError(f"{given}: is a folder; give one background for all captures")
    return str(given.resolve())


def read_crop(
    text: str | None, option: str = "--crop"
) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """The rows and the columns of the captures to use, from "100:740,200:1000"."""
    if text is None:
        return None
    advice = "give the first row and the one after the last, and the columns, as 100:740,200:1000"
    with read_as(f"{option} {text}", advice):
        rows, columns = text.split(",")
        return read_corner(rows), read_corner(columns)


def read_white_balance(text: str | None) -> WhiteBalance:
    """The gains of the colours, or how to find them.

    **Errors**: MeasurementError for anything else.
    """
    if text is None:
        return None
    if text.replace("-", "_") == "grey_world":
        return "grey_world"
    advice = "give grey-world, or the gains of red, green and blue as 1.8,1,1.4"
    with read_as(f"--white-balance {text}", advice):
        red, green, blue = (float(part) for part in text.split(","))
    return red, green, blue


def read_camera(config: Path, overrides: Sequence[str]) -> Cameras:
    """The camera of a study's first shot, and its object's distance.

    **Errors**: ConfigError, as of `load_study`.
    """
    study = assemble(load_study(config, tuple(overrides), "a camera is read from a study"))
    check_optics(study)
    shot = study.exposures[0]
    return Cameras(
        [study.camera(shot)],
        wavelength=shot.wavelength,
        object_distance=study.object_distance,
        model=study.model,
        pixel_integration=study.pixel_integration,
    )
