r"""A recording as the linear model of other packages: SciPy and PyLops, scico, deepinv.

Their solvers and priors want a linear operator, its adjoint, measurements, and the deviation of
white noise. Of captures :math:`g_k = A_k f + b_k + n_k` with the weights w_k = 1/variance they get

.. math:: \tilde A_k = \sqrt{w_k/\bar w}\,(1 - P_k) A_k, \qquad
    \tilde g_k = \sqrt{w_k/\bar w}\,(1 - P_k)\, g_k, \qquad \sigma = 1/\sqrt{\bar w}

with the mean w̄ of all weights above 0. Where a background is to be found, P_k takes the mean by the
weights, so that none is left; pixels that are not valid are 0 on both sides.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse.linalg
from jaxtyping import Array, Float

from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_projected,
    forward,
    without_background,
)
from thincam_jax.reconstruction.recording import Recording


@dataclass(frozen=True, eq=False)
class LinearModel:
    r""":math:`\tilde A`, its adjoint, and :math:`\tilde g`, as functions and arrays of JAX.

    Captures are (capture, *batch, channel, y, x), those of a recording in its units, and images
    (*batch, channel, plane, y, x), upright. `noise_std` is σ, the same for every pixel.

    **Errors**: ValueError for captures of several shapes.

    ```python
    import numpy as np
    import thincam_jax as tc
    from thincam_jax.reconstruction.exchange import LinearModel

    random = np.random.default_rng(0)
    recording = tc.Recording(random.random((1, 24, 32)), tc.Psfs(random.random((1, 9, 9))))
    model = LinearModel.of(recording)
    print(model.image_shape, model.measurements.shape)  # (1, 1, 32, 40) (1, 1, 24, 32)
    ```

    See also: `scipy_operator`, `scico_operator`, `deepinv_physics`.
    """

    recording: Recording
    problem: InverseProblem

    @classmethod
    def of(cls, recording: Recording) -> "LinearModel":
        """The model of a recording, with the field and the noise that its solvers take."""
        problem = recording.problem()
        if len({capture.shape for capture in problem.captures}) > 1:
            shapes = [capture.shape for capture in problem.captures]
            raise ValueError(f"captures have the shapes {shapes}; give captures of one shape")
        return cls(recording, problem)

    @property
    def image_shape(self) -> tuple[int, ...]:
        """Shape of images."""
        return self.problem.image_shape

    @cached_property
    def noise_std(self) -> float:
        """Standard deviation of the measurements' noise."""
        weights = np.concatenate([np.ravel(w) for w in self.problem.weights])
        return float(np.mean(weights[weights > 0]) ** -0.5)

    @cached_property
    def measurements(self) -> Float[Array, "capture ..."]:
        """The captures, weighted, less their background."""
        return self._weighted(self.problem.captures)

    @cached_property
    def apply(self) -> Any:
        """Function of an image that gives its measurements without noise."""

        def seen(image):
            image = self.recording.oriented(image)
            return self._weighted([forward(o, image) for o in self.problem.operators])

        return jax.jit(seen)

    @cached_property
    def adjoint(self) -> Any:
        """Function of measurements that gives an image; the transpose of `apply`."""

        def spread(measured):
            parts = zip(self.problem.weights, measured, strict=True)
            plain = [
                jnp.where(w > 0, one / jnp.sqrt(jnp.where(w > 0, w, 1)), 0) * self.noise_std
                for w, one in parts
            ]
            return self.recording.oriented(back_projected(self.problem, plain))

        return jax.jit(spread)

    def _weighted(self, captures: Any) -> Array:
        parts = zip(self.problem.weights, without_background(self.problem, captures), strict=True)
        return jnp.stack([jnp.sqrt(w) * self.noise_std * one for w, one in parts])


def scipy_operator(
    recording: Recording,
) -> tuple[scipy.sparse.linalg.LinearOperator, Float[np.ndarray, " n"], float]:
    """Operator, measurements and σ of a recording, flat, for SciPy; PyLops takes the same.

    `pylops.aslinearoperator(operator)` makes one of PyLops. See `LinearModel` for the equations.

    ```python
    import numpy as np
    import thincam_jax as tc
    from scipy.sparse.linalg import lsqr
    from thincam_jax.reconstruction.exchange import scipy_operator

    random = np.random.default_rng(0)
    recording = tc.Recording(random.random((1, 24, 32)), tc.Psfs(random.random((1, 9, 9))))
    operator, measured, noise_std = scipy_operator(recording)
    image = lsqr(operator, measured, damp=noise_std, iter_lim=20)[0].reshape(32, 40)
    ```
    """
    model = LinearModel.of(recording)
    measured, whole = np.asarray(model.measurements), model.image_shape

    def matvec(image: np.ndarray) -> np.ndarray:
        return np.ravel(model.apply(jnp.asarray(image.reshape(whole), measured.dtype)))

    def rmatvec(capture: np.ndarray) -> np.ndarray:
        return np.ravel(model.adjoint(jnp.asarray(capture.reshape(measured.shape), measured.dtype)))

    shape, dtype = (measured.size, int(np.prod(whole))), measured.dtype
    make: Any = scipy.sparse.linalg.LinearOperator
    return (
        make(shape, matvec=matvec, rmatvec=rmatvec, dtype=dtype),
        measured.ravel(),
        model.noise_std,
    )


def scico_operator(recording: Recording) -> tuple[Any, Float[Array, "..."], float]:
    """Operator (`scico.linop.LinearOperator`), measurements and σ of a recording, for scico.

    **Errors**: ImportError without scico, which caps the release of JAX.
    """
    from scico.linop import LinearOperator  # pyright: ignore[reportMissingImports]

    model = LinearModel.of(recording)
    operator = LinearOperator(
        input_shape=model.image_shape,
        output_shape=model.measurements.shape,
        eval_fn=model.apply,
        adj_fn=model.adjoint,
        input_dtype=model.measurements.dtype,
        output_dtype=model.measurements.dtype,
    )
    return operator, model.measurements, model.noise_std


def deepinv_physics(recording: Recording) -> tuple[Any, Any]:
    """Physics (`deepinv.physics.LinearPhysics`) and measurements of a recording, for deepinv.

    Images are (batch, channel·plane, y, x), measurements (batch, capture·channel, y, x) with its
    Gaussian noise of the deviation σ. Arrays go through DLPack, and gradients through `A` and
    `A_adjoint`, so that networks can be trained around them.

    **Errors**: ImportError without deepinv; ValueError for a recording with batch axes.
    """
    import deepinv  # pyright: ignore[reportMissingImports]
    import torch  # pyright: ignore[reportMissingImports]

    model = LinearModel.of(recording)
    _, *batch, _, height, width = model.measurements.shape
    if batch:
        raise ValueError(f"captures have the batch axes {batch}; give a recording of each")
    channels, planes, rows, columns = model.image_shape

    def call(function: Any, tensor: torch.Tensor) -> torch.Tensor:
        return torch.from_dlpack(function(jnp.from_dlpack(tensor.detach().contiguous())))

    def apply(images: torch.Tensor) -> torch.Tensor:
        each = images.reshape(-1, channels, planes, rows, columns)
        found = [call(model.apply, one) for one in each]
        return torch.stack(found).reshape(len(each), -1, height, width)

    def adjoint(measured: torch.Tensor) -> torch.Tensor:
        each = measured.reshape(-1, *model.measurements.shape)
        found = [call(model.adjoint, one) for one in each]
        return torch.stack(found).reshape(len(each), channels * planes, rows, columns)

    def linear(there: Any, back: Any) -> Any:
        class Linear(torch.autograd.Function):
            @staticmethod
            def forward(ctx: Any, tensor: torch.Tensor) -> torch.Tensor:
                return there(tensor)

            @staticmethod
            def backward(ctx: Any, tensor: torch.Tensor) -> torch.Tensor:
                return back(tensor)

        return lambda tensor, **_: Linear.apply(tensor)

    physics = deepinv.physics.LinearPhysics(
        A=linear(apply, adjoint),
        A_adjoint=linear(adjoint, apply),
        noise_model=deepinv.physics.GaussianNoise(sigma=model.noise_std),
    )
    measured = torch.from_dlpack(model.measurements)
    return physics, measured.reshape(1, -1, height, width).clone()
