r"""Plug and play: any denoiser in the place of a proximal map.

A proximal map takes noise out of an image; so does any denoiser D, be it a filter or a network.
Put in its place (Venkatakrishnan, Bouman, Wohlberg, IEEE GlobalSIP 2013) it stands for an image
prior that need not have a formula. Both iterations here end where

.. math:: f = D\big(f - \tfrac1L \nabla E_{\mathrm{misfit}}(f)\big),

- "proximal": that map over and over (PnP-PGM), with momentum and restart;
- "admm": with the data split off as v = Hf, so that the crop of the sensor is modelled and each
  step is a division in the Fourier domain (Almeida and Figueiredo 2013, as in `admm`). Its penalty
  of the image is L, which makes its end the same.

With D = prox(τR/L) that is a minimiser of misfit + τR. With others it is a point of balance, no
minimum, and surely exists only if D − 1 is a contraction (Ryu et al., ICML 2019). The stronger D,
the smoother the image.
"""

import abc
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.reconstruction.admm import Penalties
from thincam_jax.reconstruction.drive import AbstractMethod, Callback, Outcome, Residuals, drive
from thincam_jax.reconstruction.fista import relative_length
from thincam_jax.reconstruction.normal import NormalInverse
from thincam_jax.reconstruction.problem import Deconvolution
from thincam_jax.reconstruction.regulariser import first_t, run_on
from thincam_jax.reconstruction.scaled import ScaledProblem, gradient, scaled_problem, start_image
from thincam_jax.reconstruction.total_variation import TotalVariation
from thincam_jax.reconstruction.tv_prox import tv_prox

Denoiser = Callable[[Array], Array]
Scheme = Literal["proximal", "admm"]


class VariationDenoiser(eqx.Module):
    """TV denoising of the strength that makes plug and play minimise a problem's objective."""

    strength: Float[Array, ""]
    variation: TotalVariation
    nonnegative: bool = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(self, problem: Deconvolution, iterations: int = 100):
        self.strength = problem.tau / scaled_problem(problem).curvature
        self.variation, self.nonnegative = problem.variation, problem.nonnegative
        self.iterations = iterations

    def __call__(self, image: Float[Array, "*batch channel plane y x"]):
        return tv_prox(
            image,
            self.strength,
            self.variation,
            nonnegative=self.nonnegative,
            iterations=self.iterations,
        )


class Plugged(eqx.Module):
    """A denoiser with the problem it is plugged into; `unit`: what an image is multiplied by."""

    scaled: ScaledProblem
    denoiser: Denoiser
    unit: Float[Array, ""]

    def denoised(self, image: Float[Array, "*batch channel plane y x"]):
        """D in the units of the scaled problem, and never negative if that is asked."""
        image = self.denoiser(image * self.unit) / self.unit
        return jnp.maximum(image, 0) if self.scaled.problem.nonnegative else image

    def mapped(self, image: Float[Array, "*batch channel plane y x"]):
        """D(f − ∇E), of which the end is a fixed point."""
        return self.denoised(image - gradient(self.scaled.problem, image))


class _Pulled(eqx.Module):
    """Image, lead and run-up of the accelerated iteration."""

    image: Float[Array, "*batch channel plane y x"]
    lead: Float[Array, "*batch channel plane y x"]
    t: Float[Array, "*batch 1 1 1 1"]


class _Split(eqx.Module):
    """q of the data and of the image, on the window: see `admm.State`."""

    data: tuple[Float[Array, "*batch channel v u"], ...]
    image: Float[Array, "*batch channel plane v u"]


class AbstractPlugAndPlay(AbstractMethod):
    """What both schemes share.

    There is no objective: what is to be small is how far an image is from a fixed point,
    ‖f − D(f − ∇E/L)‖, of each member of the batch.
    """

    plugged: Plugged

    @abc.abstractmethod
    def begin(self, image: Float[Array, "*batch channel plane y x"]) -> Any:
        """The state of an image in the scaled problem's units."""

    @abc.abstractmethod
    def step(self, state: Any) -> Any:
        """One iteration."""

    @abc.abstractmethod
    def shown(self, state: Any) -> Float[Array, "*batch channel plane y x"]:
        """The image that a state stands for, in the scaled problem's units."""

    @abc.abstractmethod
    def residuals(self, before: Any, after: Any) -> tuple[Array, Array]:
        """Primal and dual residual of an iteration."""

    def image(self, state):
        return _image(self, state)

    def start(self, image):
        return _start(self, image / self.plugged.scaled.image_unit)

    def advance(self, state, count):
        return _advance(self, state, count)

    def objective(self, image):
        return _distance(self.plugged, image / self.plugged.scaled.image_unit)

    def look(self, state):
        state, *numbers = _look(self, state)
        primal, dual = (float(n) for n in numbers)
        return state, Residuals(primal, dual)


class PlugAndPlayProximal(AbstractPlugAndPlay):
    """PnP-PGM. The primal residual is the length of the step, the dual one that of the move."""

    def begin(self, image):
        return _Pulled(image, image, first_t(image))

    def step(self, state: _Pulled) -> _Pulled:
        image = self.plugged.mapped(state.lead)
        (lead,), t = run_on((state.image,), (state.lead,), (image,), state.t)
        return _Pulled(image, lead, t)

    def shown(self, state: _Pulled):
        return state.image

    def residuals(self, before: _Pulled, after: _Pulled):
        return (
            relative_length(after.image - before.lead, after.image),
            relative_length(after.image - before.image, after.image),
        )


class PlugAndPlayAdmm(AbstractPlugAndPlay):
    """PnP-ADMM. The residuals are those of the data's and of the image's change, relative."""

    normal: NormalInverse
    penalties: Penalties

    def begin(self, image):
        operator = self.plugged.scaled.problem.operators[0]
        return self._seen(jnp.fft.rfft2(place(image, operator.field_corner, operator.window)))

    def step(self, state: _Split) -> _Split:
        problem, operator = self.plugged.scaled.problem, self.plugged.scaled.problem.operators[0]
        parts = zip(state.data, problem.operators, problem.captures, problem.weights, strict=True)
        data = tuple(self._data(q, *known) for q, *known in parts)
        image = place(self.shown(state), operator.field_corner, operator.window)
        back = [2 * z - q for z, q in zip(data, state.data, strict=True)]
        total = jnp.fft.rfft2(self.penalties.image * (2 * image - state.image))
        for other, part in zip(problem.operators, back, strict=True):
            total = total + other.spread(jnp.fft.rfft2(self.penalties.data * part))
        seen = self._seen(self.normal(total, self.penalties))
        return jax.tree.map(lambda q, k, z: q + k - z, state, seen, _Split(data, image))

    def shown(self, state: _Split):
        operator = self.plugged.scaled.problem.operators[0]
        return self.plugged.denoised(cut(state.image, operator.field_corner, operator.field_shape))

    def residuals(self, before: _Split, after: _Split):
        data = relative_length(*_joined(before.data, after.data))
        return data, relative_length(*_joined((before.image,), (after.image,)))

    def _data(self, q, operator, capture, weight):
        """v of one capture: drawn to what was seen, and free beside the sensor."""
        seen = cut(q, operator.sensor_corner, operator.sensor_shape)
        pull = weight / (weight + self.penalties.data) * (capture - seen)
        return q + place(pull, operator.sensor_corner, operator.window)

    def _seen(self, spectrum) -> _Split:
        window = self.plugged.scaled.problem.operators[0].window
        data = tuple(
            jnp.fft.irfft2(operator.combine(spectrum), s=window)
            for operator in self.plugged.scaled.problem.operators
        )
        return _Split(data, jnp.fft.irfft2(spectrum, s=window))


def solve_plug_and_play(
    problem: Deconvolution,
    denoiser: Denoiser,
    *,
    scheme: Scheme = "proximal",
    image: Float[Array, "..."] | None = None,
    brightness=1.0,
    iterations: int = 200,
    tolerance: float = 1e-5,
    look_every: int = 10,
    callback: Callback | None = None,
) -> Outcome:
    """The image on which the captures and a denoiser agree; the problem's τ and TV are not used.

    **Arguments**

    - `denoiser`: takes and returns images (*batch, channel, plane, y, x); pure JAX, an
      `equinox.Module` if it holds arrays (what is not JAX goes through `jax.pure_callback`).
      `VariationDenoiser(problem)` gives the problem's own minimiser.
    - `scheme`: "proximal" or "admm"; both end at the same image.
    - `brightness`: what the denoiser takes for 1, in the image's unit: a network for images from 0
      to 1 wants the brightness of white.
    - `tolerance`: relative length of a step at which to end.

    The history's objective is the distance from a fixed point, which also picks the image that
    is returned.
    """
    checks.choice("scheme", scheme, ("proximal", "admm"))
    start = start_image(problem, image)
    scaled = scaled_problem(problem)
    brightness = checks.positive("brightness", brightness, "the image's unit").astype(start.dtype)
    plugged = Plugged(scaled, denoiser, scaled.image_unit / brightness)
    if scheme == "proximal":
        method: AbstractPlugAndPlay = PlugAndPlayProximal(plugged)
    else:
        method = _admm(plugged)
    return drive(
        method,
        start,
        iterations=iterations,
        tolerance=tolerance,
        look_every=look_every,
        callback=callback,
    )


def _admm(plugged: Plugged) -> PlugAndPlayAdmm:
    problem = plugged.scaled.problem
    one, none = (jnp.asarray(x, problem.captures[0].dtype) for x in (1, 0))
    gains = [one] * len(problem.operators)
    normal = jax.jit(NormalInverse)(problem.operators, gains, none)
    return PlugAndPlayAdmm(plugged, normal, Penalties(one, none, one))


def _joined(before, after):
    """Difference and value of several arrays, each as one."""
    flat = [jnp.concatenate([x.ravel() for x in arrays]) for arrays in (before, after)]
    return flat[1] - flat[0], flat[1]


@eqx.filter_jit
def _start(method, image):
    return method.begin(image)


@eqx.filter_jit
def _image(method, state):
    return method.shown(state) * method.plugged.scaled.image_unit


@eqx.filter_jit
def _advance(method, state, count: int):
    for _ in range(count):
        state = method.step(state)
    return state


@eqx.filter_jit
def _look(method, state):
    after = method.step(state)
    return after, *method.residuals(state, after)


@eqx.filter_jit
def _distance(plugged: Plugged, image):
    difference = image - plugged.mapped(image)
    return jnp.sqrt(jnp.sum(difference**2, axis=(-4, -3, -2, -1))) * plugged.scaled.image_unit
