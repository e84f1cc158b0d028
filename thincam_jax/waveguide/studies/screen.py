"""Captures through a see-through screen, reconstructed with right and wrong models of it.

The screen guides the light of an object to a camera at its edge, once for each reflection: the
capture is a sum of ghosts, whose shifts and weights differ from pixel to pixel (thesis section
5.3). What does a wrong model of the screen cost the image?
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thincam_jax import waveguide as wg
from thincam_jax._core.quantity import check_fields, choice, quantity
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax._core.table import Table
from thincam_jax.imaging.operators import AbstractOperator, Sparse
from thincam_jax.imaging.operators.base import dtype_of
from thincam_jax.imaging.sensor import AbstractNoise, electrons_per_unit, read_out
from thincam_jax.reconstruction import AbstractSolver
from thincam_jax.studies.pictures import (
    PublishedImage,
    Reconstructed,
    ScreenCaptures,
    beside,
    reconstructed,
)
from thincam_jax.units import deg, nm
from thincam_jax.waveguide.colours import colour_system
from thincam_jax.waveguide.display import DisplayLight, display_alone, require_display_fits
from thincam_jax.waveguide.field_of_view import FieldOfView, field_of_view
from thincam_jax.waveguide.hologram import directions
from thincam_jax.waveguide.lens import lens_views
from thincam_jax.waveguide.rays import Rays, RayStatus, bragg_rays, pixel_centres
from thincam_jax.waveguide.smear import SmearedRays
from thincam_jax.waveguide.studies.mask import MaskSystem, ScreenMask, require_mask_fits
from thincam_jax.waveguide.system import bandwidth, colour_operator, lens_matrix, smeared_rays

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Mistake = Literal[
    "none",
    "grating",
    "ghost_index",
    "shift_invariant",
    "no_ghosts",
    "no_smear",
    "no_defocus",
    "no_direct",
    "no_crosstalk",
]
MISTAKES: dict[Mistake, str] = {
    "none": "as the camera is",
    "grating": "K as printed in thesis Eq 5.4, with cos Θ_O − cos Θ_R: a transmission hologram",
    "ghost_index": "i of thesis Eq 5.9 counted from 0, as its text has it",
    "shift_invariant": "the ghosts of the axis everywhere: a convolution",
    "no_ghosts": "the first image alone",
    "no_smear": "each pixel's Bragg wavelength alone, without the band about it",
    "no_direct": "as if black tape stopped all light that comes straight through the plate",
    "no_defocus": "a pinhole in place of the lens, which shows all distances sharply",
    "no_crosstalk": "a sensor that separates the colours of the gratings",
}
# Numbers of the camera that are 0 in a model with that mistake.
LEFT_OUT: dict[Mistake, str] = {"no_defocus": "aperture", "no_direct": "direct_band"}

GLASS = quantity("mm", positive=True, optional=True)


@dataclass(frozen=True)
class ScreenModel:
    """A model of the camera, with which captures are reconstructed.

    - `mistake`: a key of `MISTAKES`.
    - `glass_thickness`: mm; None for that of the camera.
    """

    name: str
    mistake: Annotated[Mistake, choice(get_args(Mistake))] = "none"
    glass_thickness: Annotated[float | None, GLASS] = None

    def __post_init__(self):
        check_fields(self)

    @property
    def description(self) -> str:
        """The mistake in words."""
        words = MISTAKES[self.mistake]
        if self.glass_thickness is None:
            return words
        return f"{words}, with a glass of {self.glass_thickness:g} mm"


@dataclass(frozen=True, eq=False)
class ScreenStudy:
    """A see-through camera, the object before it, and the models that reconstruct its captures.

    - `cameras`: one, or one for each channel of a full-colour hologram, which differ in their
      hologram alone.
    - `plane`: cells that show the targets.
    - `targets`: by name, radiance 0 to 1 on the cells, (y, x), or (y, x, channel) with a
      full-colour hologram.
    - `noise`: noise of the captures; each target has noise of its own key.
    - `solvers`: by name.
    - `models`: the first one takes the captures.
    - `orders`: number of ghosts; `band_samples`: see `waveguide.system_operator`.
    - `recording_angles`: angles of the object and the reference wave in the film, rad, which the
      mistake "grating" needs.
    - `mask`: in the place of the lens, before a bare sensor; None for the lens.
    - `responses`: responses of a sensor with cross-talk, see `colour_system`; empty: it separates
      colours.
    - `display_light`: that of a display behind the plate, in all captures, less the mean of so many
      `display_frames`, exposures of it before a dark scene; with 0 it stays.
    - `config`: the sections of the file that it was read from, if any.

    ```python
    import thincam_jax as tc
    from thincam_jax import waveguide as wg
    from thincam_jax.imaging.targets import siemens_star
    from thincam_jax.waveguide.studies.screen import ScreenModel, ScreenStudy
    from thincam_jax.units import deg, nm, um

    film = wg.VolumeHologram.record(
        532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    sensor = tc.Sensor(shape=(22, 30), pitch=70.4 * um)
    study = ScreenStudy(
        cameras=(wg.SeeThroughCamera(wg.Screen(film, 5.0, 1.5), sensor, 6.0, 10.0),),
        plane=wg.ObjectPlane((8, 16), distance=550.0, width=120.0, centre=(27.0, 0.0)),
        targets={"star": siemens_star((8, 16), spokes=4)},
        noise=tc.GaussianNoise(snr_db=40.0),
        solvers={"ridge": tc.Ridge(1.0)},
        models=(ScreenModel("right"), ScreenModel("one image", "no_ghosts")),
    )
    result = study.run()
    print(result.models["right"].methods["ridge"].scores.mean_psnr_db)
    ```
    """

    cameras: tuple[wg.SeeThroughCamera, ...]
    plane: wg.ObjectPlane
    targets: dict[str, np.ndarray]
    noise: AbstractNoise
    solvers: dict[str, AbstractSolver]
    models: tuple[ScreenModel, ...] = (ScreenModel("exact rays"),)
    orders: int = 4
    band_samples: int | None = None
    recording_angles: tuple[float, float] | None = None
    seed: int = 0
    name: str = "screen"
    mask: ScreenMask | None = None
    responses: tuple[wg.ColourBand, ...] = ()
    config: Any = field(default=None, repr=False)
    display_light: DisplayLight | None = None
    display_frames: int = 1

    def __post_init__(self):
        if self.display_light is not None:
            require_display_fits(self.noise, len(self.cameras), self.mask is not None)
        if self.mask is not None:
            mistakes, tilt = [model.mistake for model in self.models], np.asarray(self.camera.tilt)
            require_mask_fits(mistakes, len(self.cameras), self.band_samples, tilt.tolist())
            for name in LEFT_OUT.values():
                if getattr(self.camera, name) > 0:
                    raise ValueError(f"{name} is of a camera with a lens; give 0 with a mask")

    @property
    def camera(self) -> wg.SeeThroughCamera:
        """The camera of the middle colour, green."""
        return self.cameras[len(self.cameras) // 2]

    def rays(self, camera: wg.SeeThroughCamera | None = None, pixels: Any = None) -> Rays:
        """Rays of all orders from every pixel, or some, of a camera; by default of `camera`."""
        camera = camera or self.camera
        pixels = pixel_centres(camera) if pixels is None else pixels
        return wg.trace(camera, pixels, object_distance=self.plane.distance, orders=self.orders)

    @property
    def wavelengths(self) -> np.ndarray:
        """Wavelength of each pixel's image, mm, (y, x), or (channel, y, x) of several cameras."""
        found = np.stack([np.asarray(self.rays(camera).wavelength) for camera in self.cameras])
        return found if len(self.cameras) > 1 else found[0]

    def check(self) -> None:
        """Refuse a screen that guides no light to the sensor; ValueError says why."""
        for camera in self.cameras:
            wg.check_screen(camera)
        # A few pixels suffice, but where none of them sees the object.
        pixels = pixel_centres(self.camera)
        step = max(1, min(pixels.shape[:2]) // 20)
        for some in (pixels[::step, ::step], pixels):
            status = np.asarray(self.rays(pixels=some).status)
            if (status == RayStatus.OK).any():
                break
        else:
            most = RayStatus(int(np.bincount(status.ravel()).argmax())).name.lower()
            raise ValueError(
                f"no ray from the sensor reaches the object's plane (most: "
                f"{most.replace('_', ' ')}); see docs/guide/screen.md for what a status means"
            )

    @cached_property
    def systems(self) -> list[Sparse | MaskSystem]:
        """The operator of each model.

        Matrices all have as many entries as the largest, the others in no pixel, for one compiled
        program.
        """
        systems = [self.system(model) for model in self.models]
        matrices = [system for system in systems if isinstance(system, Sparse)]
        if len(matrices) < len(systems):
            return systems
        most = max(system.values.size for system in matrices)
        outside = math.prod(systems[0].out_shape), math.prod(systems[0].in_shape)

        def padded(system: Sparse) -> Sparse | MaskSystem:
            entries = system.values, system.rows, system.columns
            longer = [
                jnp.pad(entry, (0, most - entry.size), constant_values=value)
                for entry, value in zip(entries, (0, *outside), strict=True)
            ]
            return eqx.tree_at(lambda s: (s.values, s.rows, s.columns), system, longer)

        return [padded(system) for system in matrices]

    def system(self, model: ScreenModel) -> Sparse | MaskSystem:
        """The matrix of one model, from the cells to the sensor."""
        cameras = self.cameras
        if model.glass_thickness is not None:
            cameras = [with_glass(camera, model.glass_thickness) for camera in cameras]
        if self.mask is not None:
            return self.mask.system(cameras[0], self.plane, self.orders, model.mistake)
        if self.responses and model.mistake in ("none", "no_ghosts"):
            orders = 1 if model.mistake == "no_ghosts" else self.orders
            camera = wg.ColourCamera(cameras, self.responses)
            return colour_system(camera, self.plane, orders, self.band_samples or 1)
        channels, follow = [], partial(mistaken_rays, self, mistake=model.mistake)
        for camera in cameras:
            left_out = LEFT_OUT.get(model.mistake)
            camera = replace(camera, **{left_out: 0.0}) if left_out else camera
            views = lens_views(camera, [self.plane], self.orders)
            matrix = lens_matrix(views, follow, self.plane, bandwidth(follow(camera)))
            channels.append(Sparse(matrix, self.plane.shape, camera.sensor.shape))
        return colour_operator(channels) if len(channels) > 1 else channels[0]

    @cached_property
    def captures(self) -> ScreenCaptures:
        """Every target as the sensor reads it."""
        return self.captured_through(self.systems[0])

    @cached_property
    def background(self) -> Array:
        """Irradiance of the display's light on the sensor, 0 without, where images are about 1."""
        if (light := self.display_light) is None:
            return jnp.zeros((), dtype_of(self.systems[0]))
        level = bandwidth(mistaken_rays(self, self.camera, self.models[0].mistake))
        return jnp.asarray(
            light.irradiance(self.camera.sensor.shape, level), dtype_of(self.systems[0])
        )

    def captured_through(self, system: AbstractOperator) -> ScreenCaptures:
        """Every target as the sensor of a camera with that matrix reads it.

        Less the display's light, where it is subtracted.
        """
        images = np.stack(list(self.targets.values()))
        images = np.moveaxis(images, -1, 1) if images.ndim == 4 else images
        images = jnp.asarray(images.reshape(-1, *system.in_shape), dtype_of(system))
        clean, sensor = system(images) + self.background, self.camera.sensor
        keys = [jax.random.fold_in(jax.random.key(self.seed), n) for n in range(len(images))]
        read = [
            read_out(sensor, one, noise=self.noise, key=key)
            for one, key in zip(clean, keys, strict=True)
        ]
        electrons = electrons_per_unit(sensor, clean)
        captures, variance = jnp.stack(read), self.noise.variance(clean, electrons)
        if electrons is not None and self.display_light is not None and self.display_frames > 0:
            key = jax.random.fold_in(jax.random.key(self.seed), len(images))
            given = self.background, electrons, (sensor, self.noise, key)
            alone, added = display_alone(*given, self.display_frames)
            captures, variance = captures - alone, variance + added
        return ScreenCaptures(captures, variance)

    def run(self, progress: Progress | None = None) -> "ScreenResult":
        """Reconstruct the captures of all targets with every model by every solver."""
        run = ScreenRun(self)
        carry_out(run.work, progress)
        return run.result


def with_glass(camera: wg.SeeThroughCamera, thickness: float) -> wg.SeeThroughCamera:
    """The camera behind a plate of another glass thickness, mm."""
    return replace(camera, screen=replace(camera.screen, glass_thickness=thickness))


def mistaken_rays(study: ScreenStudy, camera: wg.SeeThroughCamera, mistake: Mistake) -> SmearedRays:
    """The rays of a camera, followed with one of `MISTAKES`.

    **Errors**: ValueError for "grating" in a study without `recording_angles`.
    """
    plane, pixels = study.plane, pixel_centres(camera)
    samples = None if mistake == "no_smear" else study.band_samples
    rays = smeared_rays(camera, pixels, plane, study.orders, samples)
    if mistake == "no_ghosts":
        return SmearedRays(rays.points[:1], rays.weight[:1])
    if mistake == "shift_invariant":
        middle = jnp.zeros((1, 1, 2), pixels.dtype)
        axis = smeared_rays(camera, middle, plane, study.orders, samples)
        scale = (camera.lens_distance + plane.distance) / camera.focal_distance
        points = axis.points - scale * pixels[..., None, :]
        return SmearedRays(points, jnp.broadcast_to(axis.weight, rays.weight.shape))
    if mistake not in ("ghost_index", "grating"):
        return rays
    found = bragg_rays(camera, pixels)
    width, index = camera.screen.glass_thickness, camera.screen.glass_index(found.wavelength)
    bounce = _bounce(found.guided, index)
    if mistake == "ghost_index":
        return replace(rays, points=rays.points - 2 * width * bounce[..., None, ::-1])
    if study.recording_angles is None:
        raise ValueError(
            "the mistake 'grating' is one of the recording; give the study recording_angles"
        )
    hologram = camera.screen.hologram
    film = hologram.index(found.wavelength)
    toward, reference = (math.cos(angle) for angle in study.recording_angles)
    along = hologram.grating.at[2].multiply((toward - reference) / (toward + reference))
    printed = eqx.tree_at(lambda h: h.grating, hologram, along)
    guided = film[..., None] * printed.diffracted(directions(found.across, film))[..., :2]
    odd = (2 * jnp.arange(study.orders, dtype=pixels.dtype) + 1)[:, None, None, None]
    moved = odd * width * (_bounce(guided, index) - bounce)
    return replace(rays, points=rays.points + moved[..., None, ::-1])


def _bounce(guided: Array, index: Array) -> Array:
    """Path of guided light along a glass of thickness 1 between its surfaces."""
    left = index**2 - jnp.sum(guided**2, axis=-1)
    return guided / jnp.sqrt(jnp.maximum(left, 1e-6))[..., None]


@dataclass(frozen=True, eq=False)
class ModelResult:
    """Result of a model: its mistake in words, and the reconstructions by name of the solver."""

    mistake: str
    methods: dict[str, Reconstructed]


@dataclass(frozen=True, eq=False)
class ScreenResult:
    """A study and what each of its models gives, by name."""

    study: ScreenStudy
    models: dict[str, ModelResult]

    def table(self) -> Table:
        """Mean PSNR of every model by every method."""
        rows = [
            (name, *(one.scores.mean_psnr_db for one in model.methods.values()))
            for name, model in self.models.items()
        ]
        headings = ("model", *(f"{name}, mean dB" for name in self.study.solvers))
        return Table(headings, rows, (1,) * len(self.study.solvers))

    @property
    def right(self) -> ModelResult:
        """The model that takes the captures."""
        return self.models[self.study.models[0].name]

    def errors_table(self) -> Table:
        """PSNR of every target by the last solver with each model, and what its mistake costs."""
        last = list(self.study.solvers)[-1]
        right = self.right.methods[last].scores.mean_psnr_db
        rows = []
        for name, model in self.models.items():
            scores = model.methods[last].scores
            mean = scores.mean_psnr_db
            loss = None if right is None or mean is None else right - mean
            each = (scores.targets[target].psnr_db for target in self.study.targets)
            rows.append((name, *each, mean, loss, model.mistake))
        targets = list(self.study.targets)
        headings = ("model of the camera", *targets, "mean dB", "loss dB", "what it is")
        return Table(headings, rows, (1,) * (len(targets) + 2), words=(len(targets) + 3,))

    def published_table(self, published: Mapping[str, Mapping[str, PublishedImage]]) -> Table:
        """Every target with the right model, beside what was published of it (`beside`)."""
        return beside(self.right.methods, published)

    def plot(self) -> "Figure":
        """Targets, captures, and what the right model reconstructs by every solver."""
        from thincam_jax.plot.frame import new_figure
        from thincam_jax.waveguide.plot import draw_images

        return draw_images(self, new_figure(1.0, 1.0))


def screen_metrics(result: ScreenResult, rays: "RaySummary") -> dict[str, Any]:
    """Ranges of the rays, scores of every model by every solver, and the system's entries."""
    system, models = result.study.systems[0], {}
    for name, model in result.models.items():
        methods = {solver: asdict(one.scores) for solver, one in model.methods.items()}
        models[name] = {"mistake": model.mistake, "methods": methods}
    size = (system.matrix if isinstance(system, MaskSystem) else system.values).size
    known = {name: value for name, value in asdict(rays).items() if value is not None}
    light = {}
    if result.study.display_light is not None:
        light["display_light"] = round(float(result.study.background.mean()), 6)
    return {"rays": known, "models": models, "entries_of_the_system": int(size)} | light


class ScreenRun:
    """A screen study step by step: `work` fills `models`."""

    def __init__(self, study: ScreenStudy):
        self.study = study
        self.models = {model.name: ModelResult(model.description, {}) for model in study.models}
        self.work = [Step("rays and captures", lambda: study.captures)]
        for number, model in enumerate(study.models):
            self.work += [
                Step(f"{model.name}: {name}", partial(self._reconstruct, number, name))
                for name in study.solvers
            ]

    @property
    def result(self) -> ScreenResult:
        """All that is done."""
        return ScreenResult(self.study, self.models)

    def _reconstruct(self, number: int, name: str) -> None:
        study = self.study
        system, captures = study.systems[number], study.captures
        found = reconstructed(study.targets, study.solvers[name], system, captures)
        self.models[study.models[number].name].methods[name] = found


@dataclass(frozen=True)
class RaySummary:
    """Least and largest values over the field, and how rays ended, in per cent by status.

    - `first_ghost_down_mm`, `first_ghost_right_mm`: displacement of what a pixel sees by it. None
      where there is one order only, or no ray.
    - `field_of_view`: extreme angles of the image itself; `field_with_ghosts`: those of all orders.
      A full-colour hologram's are those of green, a mask's those through its middle.
    """

    wavelength_nm: tuple[float, float] | None
    guided_angle_deg: tuple[float, float] | None
    first_ghost_down_mm: tuple[float, float] | None
    first_ghost_right_mm: tuple[float, float] | None
    status_percent: dict[str, float]
    field_of_view: FieldOfView
    field_with_ghosts: FieldOfView

    def __str__(self) -> str:
        """Summary in three sentences; empty where no ray reaches the object."""
        if self.wavelength_nm is None or self.guided_angle_deg is None:
            return ""
        colours, angles, ghost = self.wavelength_nm, self.guided_angle_deg, ""
        if self.first_ghost_down_mm is not None and self.first_ghost_right_mm is not None:
            (near, far), (_, aside) = self.first_ghost_down_mm, self.first_ghost_right_mm
            ghost = f"; by its first ghost a pixel sees {near:.1f} to {far:.1f} mm further down "
            ghost += f"the object and up to {aside:.1f} mm further to the side"
        ended = (f"{kind.replace('_', ' ')} {part} %" for kind, part in self.status_percent.items())
        return (
            f"{colours[0]:.0f} to {colours[1]:.0f} nm, guided at {angles[0]:.1f}° to "
            f"{angles[1]:.1f}°{ghost}. Rays: {', '.join(ended)}. Field of view, vertical × "
            f"horizontal: {self.field_of_view}, with ghosts {self.field_with_ghosts}."
        )


def summarise_rays(study: ScreenStudy, rays: Rays) -> RaySummary:
    """Colours, guided angles, shifts of the first ghost, how rays ended, and the field of view."""
    status = np.asarray(rays.status)
    index = np.asarray(study.camera.screen.glass_index(rays.wavelength))
    sines = np.sqrt(np.sum(np.asarray(rays.guided) ** 2, axis=-1)) / index
    ranges = [np.asarray(rays.wavelength) / nm, np.arcsin(np.minimum(sines, 1)) / deg]
    sound = status[0] == RayStatus.OK
    if study.orders > 1:
        shift = np.asarray(rays.points[1] - rays.points[0])
        ranges += [shift[..., 1], shift[..., 0]]
        sound = sound & (status[1] == RayStatus.OK)
    found: list[tuple[float, float] | None] = [None] * 4
    if sound.any():
        for number, values in enumerate(ranges):
            low, high = values[sound].min(), values[sound].max()
            found[number] = round(float(low), 3), round(float(high), 3)
    endings = {
        kind.name.lower(): round(100 * float(np.mean(status == kind)), 2)
        for kind in RayStatus
        if (status == kind).any()
    }
    fields = (field_of_view(study.camera, orders=count) for count in (1, study.orders))
    return RaySummary(found[0], found[1], found[2], found[3], endings, *fields)
