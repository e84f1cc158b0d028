r"""Expected error of captures through any masks, from their PSFs and over the field.

From the direction θ of the object, the sensor of width L sees the part
:math:`h_\theta(x) = h(x)` of a PSF for :math:`|x + d\theta| \le L/2`, and nothing of the rest. Of
the best linear image that knows each direction's own part, the noise leaves

.. math:: E = \sum_\theta w_\theta \int \frac{\eta_f}{1 + \eta_f J_\theta}\,d\nu
    \Big/ \int \eta_f\,d\nu,
    \qquad J_\theta(\nu) = \sum_k \frac{d_k^2\,|\hat h_{k\theta}(\nu/d_k)|^2}{\eta_k}

with the noise spectra :math:`\eta_k = \sigma_k^2 p^2` of pixels p wide (thesis Eq 3.48, corrected:
ERRATA 3.46) and Gauss-Legendre nodes θ of the field. It is `bayes_error` for PSFs of any kind,
given by their samples; what the sensor cuts off is lost there, and noise here only where it is
seen. Photographs keep what it predicts (docs/measured/full_size.md).

An image made with other PSFs than the captures' own has their filters: `mismatch_error`.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from numpy.polynomial.legendre import leggauss

from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import Grid, fast_shape
from thincam_jax._core.precision import as_complex, scaled, squared_modulus
from thincam_jax.design.setup import PhotonNoise, Setup, SignalNoise

Psf = Float[Array, "y x"] | Float[Array, "node node y x"]
Psfs = Sequence[Psf] | Float[Array, "capture y x"]


class _Seen(eqx.Module):
    """Parts of one capture's PSF that the sensor sees from each node of the field.

    - `down`, `across`: the sensor's edges, and `middle`: what reaches its centre, all as parts of
      the grid's cells.
    - `response`: power of the pixel's average over that of the grid's, mm⁴; `solid`: d², mm².
    - `varying`: the part of a frequency's power that varies over the sensor.
    - `length`: size of the transforms; `columns`: the frequencies kept along an axis.
    """

    down: Float[Array, "node y"]
    across: Float[Array, "node x"]
    middle: tuple[Float[Array, " y"], Float[Array, " x"]]
    response: Float[Array, "v u"]
    varying: Float[Array, "v u"]
    area: Float[Array, ""]
    solid: Float[Array, ""]
    length: int = eqx.field(static=True)
    columns: int = eqx.field(static=True)

    def spectrum(self, psf: Psf, node) -> tuple[Complex[Array, "v u"], Float[Array, ""]]:
        """h_θ at the frequencies, before `response`, and the light of h_θ, mm²."""
        psf = psf[node[0], node[1]] if psf.ndim == 4 else psf
        part = psf * self.down[node[0]][:, None] * self.across[node[1]]
        spectrum = jnp.fft.rfft2(part, (self.length, self.length))[:, : self.columns]
        spectrum = jnp.concatenate([spectrum[: self.columns], spectrum[1 - self.columns :]])
        return spectrum, jnp.sum(part) * self.area

    def powers(self, psf: Psf, node) -> tuple[Float[Array, "v u"], Float[Array, ""]]:
        """|h_θ|² at the frequencies, and the light of h_θ, mm²."""
        spectrum, light = self.spectrum(psf, node)
        return squared_modulus(spectrum) * self.response, light

    def products(self, psf: Psf, assumed: Psf, node) -> Complex[Array, "v u"]:
        """h_θ times the assumed one's conjugate at the frequencies."""
        both = (self.spectrum(one, node)[0] for one in (psf, assumed))
        return scaled(next(both) * jnp.conj(next(both)), self.response)


@checked
class ExpectedError(eqx.Module):
    """Expected error of captures, from their PSFs: a function of them, differentiable.

    **Arguments**

    - `setup`: sensor, scene and noise; without its `crop` the sensor has no edge, and the field is
      one point.
    - `grids`: samples of each capture's PSF, as wide as the PSF, be it wider than the sensor; cells
      of up to two pixels, over which the PSF is averaged, as `tc.psf` gives it on a sensor.
    - `distances`: d of each capture, mm.
    - `nodes`: points of the field along an axis.
    - `padding`: frequencies are d over so many times the widest PSF apart.

    Call it with the PSFs, and with the captures' exposures if they are not alike: 1 is the share of
    `PhotonNoise.electrons`. A PSF that changes over the field is (node, node, y, x), from the first
    of its nodes, leggauss(nodes) · field/2, down and across. Frequencies reach up to d/(4p), half
    of the Nyquist frequency.

    ```python
    import thincam_jax as tc
    from thincam_jax.design.expected_error import ExpectedError
    from thincam_jax.units import nm, um

    sensor = tc.Sensor((48, 48), 40 * um)
    camera = tc.LenslessCamera(tc.Pinhole(0.1), sensor, distance=3.0)
    setup = tc.design.Setup(40 * um, 1.92, 100.0, 60.0, noise=tc.design.PhotonNoise(1e6))
    error = ExpectedError(setup, [sensor.grid], [3.0])
    error([tc.psf(camera, wavelength=500 * nm, object_distance=100.0)])  # of the scene's variance
    ```

    **Errors**: ValueError for grids whose cells are wider than two pixels, and for other numbers
    of grids and distances.

    **See also**: `limit`, `cell_search.find_cells`.
    """

    captures: tuple[_Seen, ...]
    nodes: Float[Array, " node"]
    density: Float[Array, "v u"]
    weight: Float[Array, "v u"]
    noise: SignalNoise | PhotonNoise
    pixel: Float[Array, ""]
    share: Float[Array, ""]
    crop: bool = eqx.field(static=True)

    def __init__(
        self,
        setup: Setup,
        grids: Sequence[Grid],
        distances: Sequence[float | int],
        *,
        nodes: int = 3,
        padding: float = 1.0,
    ):
        if not grids or len(grids) != len(distances):
            raise ValueError(
                f"{len(grids)} grids and {len(distances)} distances; give one of each a capture"
            )
        pitch, width = float(setup.pitch), float(setup.sensor_width)
        field, farthest = float(setup.field), float(max(distances))
        steps = [float(grid.pitch) for grid in grids]
        if max(steps) > 2 * pitch * (1 + 1e-6):
            raise ValueError(
                f"a PSF is given in cells of {max(steps):g} mm; give cells of at most two pixels, "
                f"{2 * pitch:g} mm"
            )
        # One spacing of angular frequencies for all captures: transforms as long as d asks.
        longest = [max(g.shape) * s / d for g, s, d in zip(grids, steps, distances, strict=True)]
        spacing, highest = 1 / (padding * max(longest)), farthest / (4 * pitch)
        lengths = [round(d / (spacing * s)) for d, s in zip(distances, steps, strict=True)]
        if len({*lengths}) == 1:  # others' spacings would differ
            lengths = [fast_shape((lengths[0], 1), real=True)[0]] * len(lengths)
        spacing = distances[0] / (lengths[0] * steps[0])
        columns = int(highest / spacing + 0.5) + 1
        v = np.concatenate([np.arange(columns), np.arange(1 - columns, 0)]) * spacing
        u = np.arange(columns) * spacing
        # The band ends within the cells of the last ones.
        down, across = (np.clip((highest - abs(f)) / spacing + 0.5, 0, 1) for f in (v, u))
        across = np.where(u == 0, 1.0, 2.0) * across
        self.weight = jnp.asarray(spacing**2 * down[:, None] * across, float)
        # The prior falls off within the cell of the first ones: its mean over 8² of their points.
        within, prior = (np.arange(8) - 3.5) / 8 * spacing, jnp.zeros_like(self.weight)
        for y, x in itertools.product(within, within):
            near = jnp.asarray((v[:, None] + y) ** 2 + (u + x) ** 2, float)
            prior = prior + setup.prior(near, setup.field)
        self.density = setup.contrast**2 * prior / jnp.sum(prior * self.weight)
        places, weights = leggauss(nodes) if setup.crop else (np.zeros(1), np.full(1, 2.0))
        self.nodes = jnp.asarray(weights / 2, float)

        def seen(grid: Grid, step: float, distance: float, length: int) -> _Seen:
            def edges(x):
                shifted = np.asarray(x) + (places * field * distance / 2)[:, None]
                if not setup.crop:
                    return jnp.ones((1, len(x)))
                return jnp.asarray(np.clip((width / 2 - abs(shifted)) / step + 0.5, 0, 1), float)

            def middle(x):
                inside = (field * distance / 2 - abs(np.asarray(x))) / step + 0.5
                return jnp.asarray(np.clip(inside, 0, 1), float)

            def average(frequency):
                over = np.sinc(pitch * frequency) if setup.pixel_integration else 1.0
                return over / np.sinc(step * frequency)

            down, across = (np.sinc(width * f / distance) ** 2 for f in (v, u))
            response = (average(v / distance)[:, None] * average(u / distance)) ** 2 * step**4
            return _Seen(
                edges(grid.y),
                edges(grid.x),
                (middle(grid.y), middle(grid.x)),
                jnp.asarray(response, float),
                jnp.asarray(1 - down[:, None] * across, float),
                jnp.asarray(step**2, float),
                jnp.asarray(distance**2, float),
                length,
                columns,
            )

        each = zip(grids, steps, distances, lengths, strict=True)
        self.captures = tuple(seen(*one) for one in each)
        self.noise, self.pixel, self.crop = setup.noise, setup.pitch**2, setup.crop
        # Of the light that is seen over the field, what a pixel has on average.
        self.share = (setup.field / setup.sensor_width) ** 2

    def __call__(
        self,
        psfs: Psfs,
        exposures: Sequence[float] | Float[Array, " capture"] | None = None,
        assumed: Psfs | None = None,
    ) -> Float[Array, ""]:
        """Error as a part of the scene's variance: 0 is a perfect image, 1 knows nothing.

        `assumed`: PSFs of the captures that the image is made with, where these are not their own.
        """
        count = len(self.captures)
        exposures = [1 / count] * count if exposures is None else exposures
        over = (self.nodes[:, None] * self.nodes).ravel()
        known: Any
        known, through, noisy = 0.0, 0j, 0.0
        thoughts = psfs if assumed is None else assumed
        every = zip(self.captures, psfs, thoughts, exposures, strict=True)
        for seen, psf, thought, exposure in every:
            power, noise = self._seen(seen, thought, exposure)
            weighted = seen.solid * self.density / noise
            known = known + power * weighted
            if assumed is not None:
                both = self._at_nodes(seen.products, psf, thought)
                through = through + scaled(both, weighted)
                noisy = noisy + power * weighted * (self._seen(seen, psf, exposure)[1] / noise)
        if assumed is None:
            left = 1 / (1 + known)
        else:
            left = (squared_modulus(as_complex(1 + known) - through) + noisy) / (1 + known) ** 2
        spread = self.density * self.weight
        return over @ jnp.sum(left * spread, (1, 2)) / jnp.sum(spread)

    def _at_nodes(self, function, *psfs: Psf):
        """A function of PSFs and a node at every node of the field."""
        count = np.arange(len(self.nodes))
        places = np.stack(np.meshgrid(count, count, indexing="ij"), -1).reshape(-1, 2)
        at = jax.checkpoint(lambda node: function(*psfs, node))
        return jax.lax.map(at, jnp.asarray(places))

    def _seen(self, seen: _Seen, psf: Psf, exposure) -> tuple[Float[Array, "point v u"], Any]:
        """Power of a capture's PSF at all nodes, and its noise, mm²."""
        over = (self.nodes[:, None] * self.nodes).ravel()
        power, light = self._at_nodes(seen.powers, psf)
        light = self.share * seen.solid * (over @ light)
        if not self.crop:
            down, across = seen.middle
            light = jnp.sum(psf * down[:, None] * across) * seen.area
        signal = over @ jnp.sum(power * seen.varying * self.density * self.weight, (1, 2))
        return power, self.noise.variance(light, signal, exposure) * self.pixel
