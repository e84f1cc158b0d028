r"""Matched filter that finds a zone plate's fringes in an image from a rough guess.

Ten per cent of β are tens of fringes at the edge of a sensor: least squares started there converges
to the wrong fringe. A chirp, however, has one sharp peak over curvature and position. Relative to
their centre, the fringes of a zone aperture are (thesis Eq 3.22, corrected)

.. math::
    \mathrm{Re}\, w\, T(r), \qquad
    T = a_+ e^{j\gamma_+ r^2} + a_- e^{j\gamma_- r^2}, \qquad
    a_\pm = \frac1{1\pm\epsilon}, \quad \gamma_\pm = \gamma a_\pm

with γ = β/M² and ε = βλd/(πM). For given γ, ε and centre the complex w, whose angle is the phase φ,
follows in closed form; the search maximises the correlation :math:`|\langle T, h\rangle|/|T|`.
Division by a chirp of the expected curvature makes the image slowly varying, so that it can be
averaged over blocks of pixels first, and chirps are separable, so that a correlation is two matrix
products. In NumPy: a few hundredths of a second, once a fit.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from thincam_jax._core.grids import block_mean, central_blocks

# In units of the curvature π/R² and the shift π/(2γR), half a cycle of the outermost fringe.
_STEP = 0.5
_WEAK = 0.5  # ε above which order −1 is too near its focus for this model


@dataclass(frozen=True, eq=False)
class Chirp:
    """Parameters of the fringes on the sensor.

    - `curvature`: γ = β/M², rad/mm².
    - `epsilon`: ε, the strength of diffraction.
    - `centre`: (y, x), mm.
    - `phase`: φ, rad.
    """

    curvature: float
    epsilon: float
    centre: np.ndarray
    phase: float


@dataclass(frozen=True)
class Ranges:
    """Search range about the guess: γ and ε relative, the centre in mm; 0: held."""

    curvature: float
    epsilon: float
    centre: float


def find_chirp(image: np.ndarray, pitch: float, guess: Chirp, ranges: Ranges) -> Chirp:
    """Find the fringes within the ranges that correlate best with the image (y, x).

    The guess' phase is not used. For ε above 0.5 the guess is returned: the mask nearly focuses,
    and its image is not two chirps.
    """
    if guess.epsilon * (1 + ranges.epsilon) > _WEAK:
        return guess
    blocks = _Blocks(image, pitch, guess, ranges)
    lowest, highest = _bounds(guess, ranges)
    count = 2 + math.ceil((highest - lowest) / (_STEP * math.pi / blocks.reach**2))
    gammas = np.linspace(lowest, highest, count)
    places = _axis(ranges.centre, _STEP * math.pi / (2 * guess.curvature * blocks.reach))
    maps = np.abs(blocks.correlate(gammas, guess.centre, places))
    _, row, column = np.unravel_index(np.argmax(maps), maps.shape)
    found = replace(guess, centre=guess.centre + np.array([places[row], places[column]]))
    half = np.array([ranges.curvature, ranges.epsilon]) * (guess.curvature, guess.epsilon)
    fine = 0.2 * math.pi / blocks.reach**2
    found = _curvature_and_epsilon(blocks, found, half, fine)
    if ranges.centre > 0:
        # Again around the peak with both chirps, ten times finer.
        places = _axis(places[1] - places[0], (places[1] - places[0]) / 10)
        peak = np.abs(blocks.match(found, places))
        row, column = np.unravel_index(np.argmax(peak), peak.shape)
        found = replace(found, centre=found.centre + np.array([places[row], places[column]]))
        ahead = replace(guess, centre=found.centre)
        found = _curvature_and_epsilon(blocks, ahead, half, fine)
    around = np.minimum(half, (fine, fine / guess.curvature))
    found = _curvature_and_epsilon(blocks, found, around, fine / 20)
    return replace(found, phase=float(np.angle(blocks.match(found, np.zeros(1))[0, 0])))


class _Blocks:
    """The image divided by the expected chirp, averaged over blocks of pixels."""

    def __init__(self, image, pitch: float, guess: Chirp, ranges: Ranges):
        rows, columns = image.shape
        self.reach = max(rows, columns) * pitch / 2
        # Half the largest remaining frequency of the fringes within the ranges.
        lowest, highest = _bounds(guess, ranges)
        spread = max(highest - guess.curvature, guess.curvature - lowest)
        rate = (spread * self.reach + guess.curvature * ranges.centre) / math.pi
        size = max(1, min(min(image.shape) // 16, math.floor(1 / (4 * rate * pitch))))
        self.reference = guess.curvature
        y, x = ((np.arange(n) - (n - 1) / 2) * pitch for n in image.shape)
        y0, x0 = guess.centre
        kept = central_blocks(image.shape, size)
        slow = (image - image.mean()) * np.exp(-1j * self.reference * (x - x0) ** 2)
        slow = slow * np.exp(-1j * self.reference * (y - y0) ** 2)[:, None]
        self.values = block_mean(slow[kept], size)
        self.y, self.x = (
            r[part].reshape(-1, size).mean(axis=1) for r, part in zip((y, x), kept, strict=True)
        )
        self.origin = guess.centre

    def correlate(self, gammas: np.ndarray, centre, places) -> np.ndarray:
        """Σ h e^{−jγ|r−r₀|²} for each γ, for r₀ at `centre` plus each pair of `places`."""
        (y0, x0), (y_ref, x_ref) = centre, self.origin

        def waves(r, r0, r_ref):
            shifted = gammas[:, None, None] * (r - r0 - places[:, None]) ** 2
            return np.exp(-1j * (shifted - self.reference * (r - r_ref) ** 2))

        # One large product, and one without BLAS, whose threads slow many small products.
        rows = waves(self.y, y0, y_ref).reshape(-1, len(self.y)) @ self.values
        rows = rows.reshape(len(gammas), len(places), -1)
        return np.einsum("gik,gjk->gij", rows, waves(self.x, x0, x_ref))

    def match(self, chirp: Chirp, places) -> np.ndarray:
        """⟨T, h⟩ around the chirp's centre."""
        gains = np.array(_gains(chirp.epsilon))
        waves = self.correlate(chirp.curvature * gains, chirp.centre, places)
        return np.tensordot(gains, waves, axes=1)

    def overlap(self, gamma, centre) -> np.ndarray:
        """Σ e^{jγ|r−r₀|²} for each γ: the overlap of two chirps of that difference."""
        y, x = (r - r0 for r, r0 in zip((self.y, self.x), centre, strict=True))
        sums = (np.exp(1j * gamma[..., None] * r**2).sum(axis=-1) for r in (y, x))
        return np.prod(np.array(list(sums)), axis=0)


def _curvature_and_epsilon(blocks: _Blocks, chirp: Chirp, half, fine: float) -> Chirp:
    """γ and ε with the largest |⟨T, h⟩|/‖T‖ at the centre given, within `half` in steps `fine`."""
    gammas = _axis(half[0], fine) + chirp.curvature
    epsilons = _axis(half[1], fine / chirp.curvature) + chirp.epsilon
    lowest, highest = gammas[0] / (1 + epsilons[-1]), gammas[-1] / (1 - epsilons[-1])
    table = np.linspace(lowest, highest, 2 + math.ceil((highest - lowest) / (fine / 2)))
    values = blocks.correlate(table, chirp.centre, np.zeros(1))[:, 0, 0]
    gains = [g[None, :] for g in _gains(epsilons)]
    matched = sum(a * np.interp(gammas[:, None] * a, table, values) for a in gains)
    beat = blocks.overlap(gammas[:, None] * (gains[1] - gains[0]), chirp.centre).real  # pyright: ignore
    power = blocks.values.size * (gains[0] ** 2 + gains[1] ** 2) + 2 * gains[0] * gains[1] * beat
    score = np.abs(matched) ** 2 / power
    row, column = np.unravel_index(np.argmax(score), score.shape)
    return replace(chirp, curvature=float(gammas[row]), epsilon=float(epsilons[column]))


def _gains(epsilon):
    return 1 / (1 + epsilon), 1 / (1 - epsilon)


def _bounds(guess: Chirp, ranges: Ranges) -> tuple[float, float]:
    """Smallest and largest possible curvature of the fringes."""
    epsilon = guess.epsilon * (1 + ranges.epsilon)
    low, high = (guess.curvature * (1 + s * ranges.curvature) for s in (-1, 1))
    return low / (1 + epsilon), high / (1 - epsilon)


def _axis(half_range: float, step: float) -> np.ndarray:
    """−half_range … half_range with 0 among them."""
    count = math.ceil(half_range / step)
    return np.arange(-count, count + 1) * step
