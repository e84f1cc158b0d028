"""Experiment files of `kind: masks`: which mask for which scene, at equal light."""

from typing import Annotated, Literal

import pydantic
from pydantic import Field

from thincam_jax.commands.sections import (
    Curvature,
    ExperimentConfig,
    Length,
    MaskConfig,
    Name,
    Section,
    SensorConfig,
    Wavelength,
    check_known,
    check_names,
    misfit,
)
from thincam_jax.commands.study.config import PictureConfig
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.reconstruction.wiener import Prior

Pixels = Annotated[int, Field(ge=2 * SSIM_WINDOW, le=2048)]
Electrons = Annotated[float, Field(gt=0, le=1e8)]


class ComparedMaskConfig(Section):
    """A mask by a name of its own; a zone plate has β, and one or the four phases of a turn."""

    name: Name
    mask: MaskConfig
    beta: Curvature | None = None
    synthesis: Literal["separate", "fringe_scanning"] = "separate"

    @pydantic.model_validator(mode="after")
    def _zones(self):
        zones = self.mask.family == "fza"
        if zones and self.beta is None:
            raise misfit("missing; this key is needed", "beta")
        if not zones and self.beta is not None:
            raise misfit("is of a zone plate; drop it", "beta")
        if not zones and self.synthesis != "separate":
            raise misfit("only a zone plate has phases; drop it", "synthesis")
        return self


class SceneConfig(PictureConfig):
    """A grey picture, and what the linear estimate takes for its spectrum."""

    prior: Prior = "inverse_square"


class TuningConfig(Section):
    """τ of total variation, for each mask and light: the best of `tau` on the scene of that name.

    The scene is not compared.
    """

    scene: Name
    tau: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)] = (0.5, 1, 2, 4)
    iterations: Annotated[int, Field(ge=1, le=10_000)] = 60


class MasksConfig(ExperimentConfig):
    """Masks of one width before one sensor, all in the same light.

    - `wavelength`, and a `band` of several of equal weight.
    - `distance`: mask to sensor; `field`: pixels (rows, columns) that the scene covers there.
    - `light`: electrons a pixel of the bare sensor before a white scene. `read_noise`: electrons.
    - `object_distances`: the first is that of all comparisons but the one of distances.
    """

    pictured = "scenes"
    kind: Literal["masks"]
    wavelength: Wavelength
    band: Annotated[tuple[Wavelength, ...], Field(min_length=2)]
    sensor: SensorConfig
    distance: Length
    field: tuple[Pixels, Pixels]
    light: Annotated[tuple[Electrons, ...], Field(min_length=2)]
    read_noise: Annotated[float, Field(ge=0)] = 3.0
    object_distances: Annotated[tuple[Length, ...], Field(min_length=2, max_length=2)]
    masks: Annotated[tuple[ComparedMaskConfig, ...], Field(min_length=2)]
    scenes: Annotated[tuple[SceneConfig, ...], Field(min_length=2)]
    tuning: TuningConfig
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "masks", "scenes")
        if self.sensor.counts:
            raise misfit("light says how long it is exposed; drop exposure and electrons", "sensor")
        if list(self.light) != sorted(set(self.light)):
            raise misfit(f"{list(self.light)} do not rise; give the weakest first", "light")
        names = [scene.name for scene in self.scenes]
        check_known(self.tuning.scene, "scene", names, "tuning", "scene")
        for index, entry in enumerate(self.masks):
            if entry.mask.family != "pinhole" and abs(entry.mask.width - self.width) > 1e-9:
                message = (
                    f"is {entry.mask.width:g} mm wide and another {self.width:g}; give all but "
                    "pinholes one width"
                )
                raise misfit(message, "masks", index, "mask")
        return self

    @property
    def width(self) -> float:
        """Of the masks, mm; pinholes are smaller."""
        return max(entry.mask.width for entry in self.masks)

    @property
    def compared(self) -> tuple[SceneConfig, ...]:
        """The scenes but the one that τ is found on."""
        return tuple(scene for scene in self.scenes if scene.name != self.tuning.scene)
