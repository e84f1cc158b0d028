"""Sections of files whose targets are pictures on cells, which a matrix reconstructs."""

from collections.abc import Sequence
from typing import Any, Literal

import pydantic

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import section
from thincam_jax.commands.sections import Name, PictureConfig, VariationConfig
from thincam_jax.reconstruction import AbstractSolver, TotalVariation
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.reconstruction.ridge import Ridge
from thincam_jax.studies.pictures import PublishedImage


class ScreenMethodConfig(section(Ridge, only=("ridge",), defaults={"ridge": None})):
    """A reconstruction: ridge regression by conjugate gradients, or total variation by ADMM."""

    name: Name
    kind: Literal["ridge", "admm_tv"]
    variation: VariationConfig | None = None

    @pydantic.model_validator(mode="after")
    def _fits(self):
        other = "variation" if self.kind == "ridge" else "ridge"
        if getattr(self, other) is not None:
            raise FieldError(f"kind {self.kind} does not take it; drop {other!r}", other)
        return self

    def build(self, *_: Any, **others: Any) -> AbstractSolver:
        """The solver."""
        if self.kind == "ridge":
            return Ridge(self.ridge or 1.0)
        options = self.variation or VariationConfig()
        variation = TotalVariation(options.kind)
        return AdmmTV(options.tau, variation=variation, iterations=options.iterations)


class PublishedImageConfig(section(PublishedImage, defaults={"psnr_db": ..., "seconds": ...})):
    """Published figures of a target."""


class ScreenTargetConfig(PictureConfig):
    """A picture on the monitor's cells, in grey before a hologram of one colour.

    - `published`: by the method's name.
    """

    published: dict[str, PublishedImageConfig] = {}


def published_figures(targets: Sequence[ScreenTargetConfig]) -> dict[str, dict[str, Any]]:
    """Published figures of each target, by method."""
    return {
        target.name: {method: one.build() for method, one in target.published.items()}
        for target in targets
    }
