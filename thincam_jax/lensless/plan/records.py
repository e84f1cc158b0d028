"""The plan of a capture: what is computed, what is left out, and what that costs."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from thincam_jax._core.memory import readable
from thincam_jax._core.precision import Precision
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.cost import Cost
from thincam_jax.lensless.psf import Model


class Effect(NamedTuple):
    """An effect of the camera and whether the plan models it.

    - `size`: relative to the capture; None where it is not known.
    """

    name: str
    modelled: bool
    size: float | None
    note: str


@dataclass(frozen=True, eq=False)
class Plan:
    """How `capture` computes a scene within a tolerance; made by `thincam_jax.plan`.

    Print it for a table. It holds for scenes with the same planes and wavelengths as the one that
    it was made for and images like its, and for cameras within 1 % of its own, at any phase of the
    mask.

    - `camera`: that it was made for.
    - `tolerance`, `predicted_error`: relative L2 error of the noise-free capture, of a
      batch as a whole.
    - `model`, `precision`, `pixel_integration`: arguments of `psf`.
    - `distances`: object distances in mm whose PSFs are computed, out of the scene's.
    - `mixing`: (distance, plane) weights: the PSF of a plane is this sum of the computed ones, so
      that planes are merged before they are convolved.
    - `wavelengths`, `weights`: wavelengths in mm that are computed, and their shares of the light.
    - `scene_distances`, `scene_wavelengths`, `scene_weights`: of the
      scene that the plan was made for.
    - `field_shape`: samples of the largest projected plane on the sensor's pitch.
    - `padded_shape`: window of the convolutions.
    - `cost`, `full_cost`: of the plan and of computing every plane and wavelength.
    - `shares`: predicted errors of the single decisions.
    - `effects`: what the capture holds and what it does not.
    """

    camera: LenslessCamera
    tolerance: float
    predicted_error: float
    model: Model
    precision: Precision
    pixel_integration: bool
    distances: tuple[float, ...]
    mixing: Float[np.ndarray, "distance plane"]
    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]
    scene_distances: tuple[float, ...]
    scene_wavelengths: tuple[float, ...]
    scene_weights: tuple[float, ...]
    field_shape: tuple[int, int]
    padded_shape: tuple[int, int]
    cost: Cost
    full_cost: Cost
    shares: dict[str, float]
    effects: tuple[Effect, ...]

    @property
    def meets_tolerance(self) -> bool:
        """False where no way of computing meets the tolerance; the plan is then the best one."""
        return self.predicted_error <= self.tolerance

    def __str__(self) -> str:
        average = "averaged over pixels" if self.pixel_integration else "at the pixels' centres"
        planes, colours = len(self.scene_distances), len(self.scene_wavelengths)
        shares = self.shares
        rows, columns = self.field_shape
        met = "" if self.meets_tolerance else "  NOT MET"
        lines = [
            ("tolerance", f"{self.tolerance:.1e}, predicted {self.predicted_error:.1e}{met}"),
            ("model", f"{self.model}, {self.precision}, {average}: {shares['model']:.1e}"),
            ("depth planes", f"{planes} by {len(self.distances)} PSFs: {shares['planes']:.1e}"),
            (
                "wavelengths",
                f"{colours} by {len(self.wavelengths)}: {shares['wavelengths']:.1e}",
            ),
            (
                "convolution",
                f"field {rows}×{columns}, window {self.padded_shape[0]}×{self.padded_shape[1]}",
            ),
            *((effect.name, effect.note) for effect in self.effects),
            (
                "cost",
                f"{self.cost.flops:.1e} operations of {self.full_cost.flops:.1e} in full, "
                f"{readable(self.cost.bytes)}",
            ),
        ]
        width = max(len(name) for name, _ in lines)
        return "\n".join(f"{name:<{width}}  {text}" for name, text in lines)
