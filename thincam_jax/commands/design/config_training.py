"""The section `train` of a design's file: descents by the reconstruction of photographs."""

from typing import Annotated, Literal

import pydantic
from pydantic import Field

from thincam_jax.commands.study.config import Section
from thincam_jax.imaging.targets import sample_images


class TrainingConfig(Section):
    """Designs improved by the error of an actual reconstruction.

    - `images`: photographs of scikit-image; their middle square is taken.
    - `reconstruction`: `wiener`, the Wiener synthesis as in the simulation; `linear`, the best
      linear estimate, which knows of the crop, by conjugate gradients.
    - `pixels`: of the sensor's shorter side in training; by default as many as the finest fringes
      need, and no more than the sensor has.
    - `samples`: even ones over the bounds; descents begin at the best `starts` of these, of the
      search's designs and the reference; `steps` of each.
    """

    images: Annotated[tuple[str, ...], Field(min_length=1)]
    reconstruction: Literal["wiener", "linear"] = "wiener"
    pixels: Annotated[int, Field(ge=32, le=4096)] | None = None
    samples: Annotated[int, Field(ge=1, le=10_000)] = 64
    starts: Annotated[int, Field(ge=1, le=10)] = 4
    steps: Annotated[int, Field(ge=1, le=1000)] = 30

    @pydantic.field_validator("images")
    @classmethod
    def _known(cls, images: tuple[str, ...]) -> tuple[str, ...]:
        for image in images:
            if image not in sample_images():
                listed = ", ".join(sample_images())
                raise ValueError(f"image {image!r} is unknown; choose from {listed}")
        if len(set(images)) < len(images):
            raise ValueError("images hold an entry twice; give each once")
        return images
