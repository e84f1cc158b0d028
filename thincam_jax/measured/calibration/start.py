"""Initial estimate for a PSF fit: the camera to a fraction of a fringe."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.method import PIXEL_NODES, pixel_nodes
from thincam_jax.measured.calibration.chirp_search import Chirp, Ranges, find_chirp
from thincam_jax.measured.calibration.coarse import descend
from thincam_jax.measured.calibration.problem import PARAMETERS, FitState, Synthesis

# Smallest initial d/t of a free object distance: no step can leave infinity, and the shadow differs
# from that of infinity by a millionth.
_FARTHEST = 1e-6
_WIDEST = 0.5  # relative search range


@checked
@dataclass(frozen=True)
class PsfSearch:
    """Numbers that `fit_psf` fits, how far from the camera given, and by which model.

    - `parameters`: numbers to fit, of "beta", "phase", "centre", "width", "distance",
      "object_distance", "wavelength", "background", "gain"; the others are held. Without
      "background" it is 0, without "gain" 1.
    - `relative`: largest relative change of β, d and λ from their start.
    - `centre`: largest shift of the centre along y and x on the sensor, mm; by default a tenth of
      the sensor's shorter side.
    - `pixel_integration`: average h over each pixel, as a sensor does. Without, the waves from the
      far rim, up to 10 turns a pixel, are aliased, and d is then only as good as the start.
    - `max_steps`: highest number of steps of Levenberg-Marquardt.
    """

    parameters: tuple[str, ...] = ("beta", "phase", "centre", "distance", "background", "gain")
    relative: float = 0.12
    centre: float | None = None
    pixel_integration: bool = True
    max_steps: int = 60

    def __post_init__(self):
        if not isinstance(self.parameters, tuple) or not self.parameters:
            raise ValueError(f"parameters = {self.parameters!r}: give a tuple of at least one name")
        for name in self.parameters:
            checks.choice("a name in parameters", name, PARAMETERS)
        checks.non_negative("relative", self.relative, "parts of one")
        if self.relative > _WIDEST:
            raise ValueError(f"relative = {self.relative:g} is too wide; give at most {_WIDEST:g}")
        if self.centre is not None:
            checks.non_negative("centre", self.centre, "mm")

    def ranges(self, camera: LenslessCamera) -> Ranges:
        """Possible distance of the sensor's fringes from those of the camera given."""
        centre = self.centre
        if centre is None:
            centre = 0.1 * min(camera.sensor.shape) * float(camera.sensor.pitch)
        free = {name: name in self.parameters for name in ("beta", "distance", "wavelength")}
        # A free object or mask-sensor distance changes β/M² only by fractions of d/t.
        depth = "object_distance" in self.parameters or "distance" in self.parameters
        return Ranges(
            curvature=self.relative * (free["beta"] + 0.1 * depth),
            epsilon=self.relative * sum(free.values()),
            centre=centre * ("centre" in self.parameters),
        )


def given(
    camera: LenslessCamera,
    object_distance: Number,
    wavelength: Number,
    search: PsfSearch,
    synthesis: Synthesis | None = None,
) -> FitState:
    """State of the camera and the point as given, with no background and a gain of one."""
    path = camera.path(wavelength, object_distance)
    nearness = 1 / path.object_distance
    if "object_distance" in search.parameters:
        nearness = jnp.maximum(nearness, _FARTHEST / camera.distance)
    none = jnp.zeros_like(nearness)
    wavelength = path.wavelength.astype(none.dtype)
    nearest = replace(path, distance=(1 - search.relative) * path.distance)
    nodes = max(PIXEL_NODES, pixel_nodes(camera.mask, camera.sensor.grid, nearest, "float64"))
    return FitState(camera, wavelength, nearness, none, none + 1, synthesis, nodes)


def check_fringes(guess: FitState) -> None:
    """Refuse a sensor, or a shadow on it, with less than one fringe."""
    mask, sensor = guess.mask, guess.camera.sensor
    scale = float(guess.magnification)
    halves = [
        min(n * float(sensor.pitch) / scale, float(mask.width)) / 2  # on the mask's scale
        for n in sensor.shape
    ]
    fringes = float(mask.beta) * sum(h**2 for h in halves) / (2 * math.pi)
    if fringes < 1:
        raise ValueError(
            f"the sensor holds {fringes:.2g} fringes of the mask: a fit needs at least one; give a "
            "larger image"
        )


def start_near(image: np.ndarray, guess: FitState, search: PsfSearch) -> FitState:
    """The state whose fringes correlate best with the image, with the best background and gain.

    Only the parameters of the search differ from the guess.
    """
    pitch, ranges = float(guess.camera.sensor.pitch), search.ranges(guess.camera)
    found = find_chirp(_one_picture(image, guess), pitch, _fringes(guess), ranges)
    parameters, relative = search.parameters, search.relative
    near = _with_fringes(guess, found, parameters, relative)
    return descend(image, guess, near, parameters, relative, search.pixel_integration)


def _one_picture(image: np.ndarray, guess: FitState) -> np.ndarray:
    """The fringes cos(βr² + φ) of a synthesis.

    The weighted sum of the captures' cos(u + φ_k) is
    ½ e^{ju} Σ w_k e^{jφ_k} + ½ e^{−ju} Σ w_k e^{−jφ_k}, of which the stronger term is taken.
    """
    if guess.synthesis is None:
        return image
    turns = np.exp(1j * np.asarray(guess.synthesis.phases))
    weights, unit = np.asarray(guess.synthesis.weights), np.array([1, 1j])[: len(image)]
    ahead, behind = unit @ weights @ turns, unit @ weights @ turns.conj()
    strongest = ahead if abs(ahead) >= abs(behind) else behind
    return np.real(np.tensordot(unit, image, axes=1) / strongest)


def _fringes(state: FitState) -> Chirp:
    camera, scale = state.camera, float(state.magnification)
    beta = float(state.mask.beta)
    epsilon = beta * float(state.wavelength) * float(camera.distance) / (math.pi * scale)
    centre = np.asarray(state.mask.centre) * scale
    return Chirp(beta / scale**2, epsilon, centre, float(state.mask.phase))


def _with_fringes(
    guess: FitState, fringes: Chirp, parameters: Sequence[str], search: float
) -> FitState:
    """State whose free parameters give the fringes' β/M², ε, centre and phase.

    Weak diffraction determines ε poorly, so d and λ stay within `search` of the guess.
    """
    camera = guess.camera
    beta, distance = float(guess.mask.beta), float(camera.distance)
    wavelength, nearness = float(guess.wavelength), float(guess.nearness)
    scale = 1 + distance * nearness
    for _ in range(5):  # β and d are coupled through M, by fractions of d/t
        scale = 1 + distance * nearness
        if "beta" in parameters:
            beta = fringes.curvature * scale**2
        reduced = math.pi * fringes.epsilon / beta  # λd/M
        if "distance" in parameters:
            reduced = reduced / wavelength
            distance = _within(reduced / (1 - reduced * nearness), guess.camera.distance, search)
        elif "wavelength" in parameters:
            wavelength = _within(reduced * scale / distance, guess.wavelength, search)
    if "beta" not in parameters and "object_distance" in parameters:
        scale = max(math.sqrt(beta / fringes.curvature), 1 + _FARTHEST)
        nearness = (scale - 1) / distance
    mask = guess.mask
    centre = fringes.centre / scale if "centre" in parameters else np.asarray(mask.centre)
    phase = float(mask.phase)
    if "phase" in parameters:
        phase = phase + math.remainder(fringes.phase - phase, 2 * math.pi)
    numbers = {"beta": beta, "phase": phase, "centre": centre, "distance": distance}
    numbers |= {"wavelength": wavelength, "object_distance": nearness}
    return guess.with_numbers(**{name: jnp.asarray(n, jnp.float64) for name, n in numbers.items()})


def _within(value: float, guess, search: float) -> float:
    return min(max(value, float(guess) * (1 - search)), float(guess) * (1 + search))
