"""Independent batch elements and colours, solved in parallel.

The images of a batch share only the operator, and so do colours without coupled variation. On a CPU
a single element stays in the cache, and cores that it leaves idle between its transforms serve
another (docs/measured/solvers.md has the comparison). Each element has its own units and
penalties.
"""

import contextlib
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from thincam_jax._core import checks
from thincam_jax._core.environment import usable_cores
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction.iterate import AbstractMethod, Residuals
from thincam_jax.reconstruction.problem import InverseProblem, convolutions
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.total_variation import TotalVariation


class ParallelMethod(AbstractMethod[tuple[Any, ...]]):
    """A method for each independent part of a problem; residuals are those of the worst.

    - `method`: makes the method of a part, from the part of an image `near` as well.
    """

    methods: tuple[AbstractMethod, ...]
    shape: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self, problem: InverseProblem, method: Callable[..., AbstractMethod], near: Any = None
    ):
        self.shape, parts = problem.image_shape, independent_parts(problem)
        images = [] if near is None else [_parts(near, (len(parts), -1, *self.shape[-3:]))]
        self.methods = tuple(_in_threads(method, parts, *images))

    def start(self, image: Image):
        return tuple(_in_threads(lambda m, i: m.start(i), self.methods, self._split(image)))

    def advance(self, state: tuple[Any, ...], count: int):
        return tuple(_in_threads(lambda m, s: m.advance(s, count), self.methods, state))

    def advance_unjudged(self, state: tuple[Any, ...], count: int):
        return tuple(_in_threads(lambda m, s: m.advance_unjudged(s, count), self.methods, state))

    def image(self, state: tuple[Any, ...]):
        images = _in_threads(lambda m, s: np.asarray(m.image(s)), self.methods, state)
        return checks.as_array(np.stack(images).reshape(self.shape))

    def objective(self, image: Image):
        values = _in_threads(
            lambda m, i: np.asarray(m.objective(i)), self.methods, self._split(image)
        )
        return checks.as_array(np.stack(values).reshape(*self.shape[:-4], -1).sum(axis=-1))

    def residuals(self, state: tuple[Any, ...]):
        each = tuple(m.residuals(s) for m, s in zip(self.methods, state, strict=True))
        primal, dual = max(r.primal for r in each), max(r.dual for r in each)
        return Residuals(primal, dual, elements=each)

    def adapt(self, state: tuple[Any, ...], residuals: Residuals):
        adapted = _in_threads(
            lambda m, s, r: m.adapt(s, r), self.methods, state, residuals.elements
        )
        methods, states = zip(*adapted, strict=True)
        return eqx.tree_at(lambda a: a.methods, self, methods), states

    def _split(self, image: Image):
        return _parts(image, (len(self.methods), -1, *self.shape[-3:]))


def in_parallel(
    problem: InverseProblem, method: Callable[..., AbstractMethod], near: Image | None = None
) -> AbstractMethod:
    """The method of a problem, or of its independent parts if `parallel_pays`.

    - `near`: an image that the method takes as well.
    """
    if parallel_pays(problem):
        return ParallelMethod(problem, method, near)
    return method(problem) if near is None else method(problem, near)


def parallel_pays(problem: InverseProblem) -> bool:
    """True on a CPU, for convolutions with several independent parts.

    Other devices run all parts in one program, and other operators apply to them together.
    """
    if convolutions(problem) is None:
        return False
    platforms = {device.platform for device in problem.captures[0].devices()}
    return platforms == {"cpu"} and _count(problem) > 1


def independent_parts(problem: InverseProblem) -> list[InverseProblem]:
    """A problem for each image of the batch and, without coupling, for each colour."""
    count = _count(problem)
    channels = problem.image_shape[-4]
    colours = channels if _colours_are_independent(problem) else 1
    operators = [
        [_of_colour(o, c, colours) for o in convolutions(problem) or ()] for c in range(colours)
    ]
    captures = [_parts(c, (count, channels // colours, *c.shape[-2:])) for c in problem.captures]
    weights = [
        _weights_of_parts(w, c, count, colours)
        for w, c in zip(problem.weights, problem.captures, strict=True)
    ]
    return [
        eqx.tree_at(
            lambda p: (p.operators, p.captures, p.weights),
            problem,
            (
                tuple(operators[i % colours]),
                tuple(c[i] for c in captures),
                tuple(w[i] for w in weights),
            ),
        )
        for i in range(count)
    ]


def _count(problem: InverseProblem) -> int:
    channels = problem.image_shape[-4] if _colours_are_independent(problem) else 1
    return math.prod(problem.image_shape[:-4]) * channels


def _colours_are_independent(problem: InverseProblem) -> bool:
    regulariser = problem.regulariser
    return isinstance(regulariser, TotalVariation) and regulariser.coupling == "none"


def _of_colour(operator: CropConvolution, colour: int, colours: int) -> CropConvolution:
    """The operator of one of several colours, or the operator that they share."""
    if colours == 1 or operator.spectrum.shape[0] == 1:
        return operator
    return eqx.tree_at(lambda o: o.spectrum, operator, operator.spectrum[colour : colour + 1])


def _weights_of_parts(weight, capture, count: int, colours: int):
    """The weights of each part; a single number serves all."""
    if weight.ndim == 0:
        return [weight] * count
    weight = np.asarray(weight).reshape((1,) * (capture.ndim - weight.ndim) + weight.shape)
    leading = np.broadcast_shapes(weight.shape[:-2], capture.shape[:-2])
    whole = np.broadcast_to(weight, (*leading, *weight.shape[-2:]))
    return _parts(whole, (count, leading[-1] // colours, *weight.shape[-2:]))


def _parts(array: Any, shape: tuple[int, ...]) -> list[Array]:
    """An array's parts along the first axis of a shape; on the host, where nothing is compiled."""
    return [checks.as_array(part) for part in np.asarray(array).reshape(shape)]


def _in_threads(function: Callable, *sequences) -> list:
    """Map a function over sequences, with a thread for each core.

    Ctrl-C drops the parts that have not started. JAX's settings of this thread hold in all.
    """
    wanted = _settings_of_thread()

    def run(*arguments):
        with contextlib.ExitStack() as stack:
            here = _settings_of_thread()
            for name, value in wanted.items():
                if here[name] != value:
                    stack.enter_context(_SETTINGS[name](value))
            return function(*arguments)

    with ThreadPoolExecutor(min(len(sequences[0]), usable_cores())) as pool:
        return list(pool.map(run, *sequences))


_SETTINGS = {
    "jax_enable_x64": jax.enable_x64,
    "jax_default_device": jax.default_device,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
    "jax_debug_nans": jax.debug_nans,
    "jax_disable_jit": jax.disable_jit,
}


def _settings_of_thread() -> dict[str, Any]:
    values = {name: getattr(jax.config, name) for name in _SETTINGS}
    return {name: getattr(value, "value", value) for name, value in values.items()}
