"""Successive captures of a moving scene, each reconstructed from the previous state."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.module import AnyRank
from thincam_jax.imaging.operators import Stacked
from thincam_jax.reconstruction.admm import RELAXATION, AdmmMethod, State, admm_map
from thincam_jax.reconstruction.iterate import CHUNK
from thincam_jax.reconstruction.problem import InverseProblem
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.reconstruction.splittings import admm_method


@checked
class Stream(AnyRank):
    r"""ADMM-TV of successive captures, a few iterations each, with image and duals kept.

    .. math:: q_t = T^m(q_{t-1};\, g_t)

    with T of `thincam_jax.reconstruction.admm`. A static object is reconstructed to convergence, a
    moving one as far as m iterations reach::

        stream = tc.Stream(recording, tc.AdmmTV(0.5), steps=4)   # of the first capture
        stream, image = stream.next(captures)                    # of each that follows

    Units, penalties and weights stay those of the first recording: the scene may change, the
    camera and the noise may not.

    **Arguments**

    - `recording`: recording of the first capture.
    - `solver`: with τ a number; its iterations are those of the first capture.
    - `steps`: m, iterations for each later capture.

    **Errors**: ValueError, one line, for steps below 1, a τ given by a rule, or captures of another
    shape than the first, or with NaN where they are valid.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]), noise_variance=0.01)
    stream = tc.Stream(recording, tc.AdmmTV(0.5), steps=4)
    stream, image = stream.next(np.ones((1, 24, 32)))  # of each capture that follows
    ```

    **See also**: `AdmmTV`.
    """

    recording: Recording
    solver: AdmmTV
    method: AdmmMethod
    state: State
    steps: int = eqx.field(static=True)
    rows: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    ratios: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, recording: Recording, solver: AdmmTV, *, steps: int = 4):
        if isinstance(solver.tau, str):
            raise ValueError(f"tau = {solver.tau!r} is a rule for one capture; give a number")
        self.recording, self.solver = recording, solver
        self.steps = checks.whole("steps", steps, 1)
        problem = _posed(recording, solver)
        self.rows, self.ratios = (), ()
        if not isinstance(recording.imaging_model, Stacked):
            rows, ratios = recording.synthesis_rows(solver.synthesis)
            self.rows, self.ratios = tuple(map(tuple, rows.tolist())), tuple(ratios)
        method: Any = admm_method(problem)
        running = method.start(jnp.zeros(problem.image_shape, problem.captures[0].dtype))
        for done in range(CHUNK, solver.iterations + CHUNK, CHUNK):
            running = method.advance(running, CHUNK)
            if done <= solver.iterations // 2:
                method, running = method.adapt(running, method.residuals(running))
        self.method = eqx.tree_at(lambda m: m.arguments, method, method.arguments.settled())
        self.state = running.value

    def next(self, captures: Any) -> tuple["Stream", Float[Array, "*batch y x"]]:
        """The stream after the next captures, and their image."""
        wanted = [c.shape for c in self.recording.captures]
        alone = len(wanted) == 1 and getattr(captures, "shape", None) == wanted[0]
        given = [captures] if alone or not checks.shape_of(captures) else captures
        if (shapes := [checks.shape_of(c) for c in given]) != wanted:
            raise ValueError(
                f"captures have shapes {shapes}, the first recording's {wanted}; give captures of "
                "the same camera, or start another stream"
            )
        given = tuple(jnp.asarray(c) for c in given)
        # Of the same valid pixels: a new recording would leave out what is NaN now.
        eqx.tree_at(lambda r: r.captures, self.recording, given).require_finite()
        state, image = _next(self, given)
        return eqx.tree_at(lambda s: s.state, self, state), image


def _posed(recording: Recording, solver: AdmmTV) -> InverseProblem:
    return recording.problem(
        tau=solver.tau,
        regulariser=solver.prior,
        nonnegative=solver.nonnegative,
        synthesis=solver.synthesis,
    )


@eqx.filter_jit
def _next(stream: Stream, captures: tuple[Array, ...]):
    recording, state = replace(stream.recording, captures=captures), stream.state
    if stream.rows:  # a problem's PSFs would be computed anew
        captures = recording.channel_captures(stream.rows, stream.ratios)
    else:
        captures = _posed(recording, stream.solver).captures
    splitting = stream.method.arguments.with_captures(captures)
    for _ in range(stream.steps):
        mapped = admm_map(state, splitting)
        state = jax.tree.map(lambda q, t: q + RELAXATION * (t - q), state, mapped)
    return state, recording.shaped(splitting.image(state))
