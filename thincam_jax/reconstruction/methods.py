"""`reconstruct`, and the choice of a solver."""

import sys

from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.progress import watched
from thincam_jax.imaging.operators.low_rank import LowRank
from thincam_jax.reconstruction.display_codes import display_codes
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.imaging_model import Psfs, pedestal_of
from thincam_jax.reconstruction.iterate import Callback
from thincam_jax.reconstruction.noise import too_noisy
from thincam_jax.reconstruction.other_psf import negative_behind_operators
from thincam_jax.reconstruction.poisson import PoissonTV
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV, Fista
from thincam_jax.reconstruction.result import Reconstruction, saying
from thincam_jax.reconstruction.ridge import Ridge
from thincam_jax.reconstruction.solver import AbstractIterativeSolver, AbstractSolver, Synthesis
from thincam_jax.reconstruction.wiener import Wiener, filter_suffices


@checked
def reconstruct(
    recording: Recording,
    solver: AbstractSolver | str | None = None,
    *,
    start: Float[Array, "..."] | None = None,
    callback: Callback | None = None,
) -> Reconstruction:
    """Reconstruct the image of a scene from captures of it.

    **Arguments**

    - `recording`: captures with their imaging model and noise, see `Recording`.
    - `solver`: the method with its settings: `Wiener`, `FringeScanning` (filters, for `Cameras`),
      `AdmmTV`, `Fista`, `Ridge`, `PoissonTV` or `PlugAndPlay`; or the name of one with its
      defaults: "wiener", "fringe_scanning", "admm_tv", "fista", "ridge", "poisson", "pnp". Default:
      the one of `choose_solver`; the result has its reason.
    - `start`: a start image, such as an earlier result. By default it is uniform with cameras,
      matrices and `LowRank` operators and for `PoissonTV`, else black. With a start image `AdmmTV`
      omits its first part without the uniform light, see docs/guide/reconstruct.md.
    - `callback`: called with `Progress` every tenth iteration of `AdmmTV` and `Fista`; it stops
      the run by returning a true value. Ctrl-C returns the best image so far, with the status
      "interrupted".

    Images of a batch are reconstructed together. To filter many recordings call `prepare` of the
    filter once. Under jit, grad or vmap use `solve_fixed_point`.

    **Errors**: ValueError and TypeError, one line, for a recording, start or callback that the
    solver cannot use.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    optics = tc.Cameras([camera], wavelength=500 * nm, object_distance=250.0)
    recording = tc.Recording([tc.capture(camera, scene)], optics)
    result = tc.reconstruct(recording, tc.AdmmTV(tau=2.0, iterations=10))
    ```

    **See also**: `Recording`, `AdmmTV`, `Wiener`, `choose_solver`.
    """
    result = solved(recording, solver, start, callback)
    if not isinstance(recording.imaging_model, Psfs):
        return result
    noise = too_noisy(recording.captures, recording.valid, recording.noise_variance)
    return saying(result, result.reason, noise)


def solved(
    recording: Recording,
    solver: AbstractSolver | str | None = None,
    start: Float[Array, "..."] | None = None,
    callback: Callback | None = None,
) -> Reconstruction:
    """The result of `reconstruct`, where the noise was estimated and need not be doubted."""
    with watched("reconstructing") as tell:
        return _solved(recording, solver, start, callback, tell)


def _solved(recording: Recording, solver, start, callback, tell) -> Reconstruction:
    reason = ""
    if solver is None:
        solver, reason = choose_solver(recording)
    elif isinstance(solver, str):
        solver = named_solver(solver)
    if isinstance(solver, AbstractIterativeSolver):
        if any(checks.is_traced(capture) for capture in recording.captures):
            raise TypeError(
                f"{type(solver).__name__} checks its convergence between iterations: call it "
                "outside of jit, grad and vmap, or use tc.reconstruction.solve_fixed_point there"
            )

        def watcher(progress):
            tell(progress.iteration, getattr(solver, "iterations", 0))
            return callback is not None and callback(progress)

        in_one_piece = callback is None and isinstance(solver, PoissonTV)
        result = solver.solve(recording, start=start, callback=None if in_one_piece else watcher)
    elif start is not None or callback is not None:
        raise ValueError(f"{type(solver).__name__} runs in one piece; leave out start and callback")
    else:
        result = solver.solve(recording)
    negative, level = negative_behind_operators(recording), pedestal_of(recording.imaging_model)
    unlike = _unlike(recording, result.reason)
    is_filter = isinstance(solver, Wiener | FringeScanning)
    codes = "" if is_filter else display_codes(recording)
    return saying(result, reason, result.reason, unlike, negative, level, codes)


def _unlike(recording: Recording, reason: str) -> str:
    """A sentence where a measured PSF that misfits has another size than the captures."""
    model, shape = recording.imaging_model, recording.captures[0].shape[-2:]
    if not reason or not isinstance(model, Psfs) or (size := model.psfs.shape[-2:]) == shape:
        return ""
    if not any(words in reason for words in ("residual", "fit far better a PSF")):
        return ""
    text = f"the PSF has {size[0]}×{size[1]} pixels and the captures {shape[0]}×{shape[1]}"
    return f"{text}: give both equally binned, and turned alike"


@checked
def choose_solver(
    recording: Recording, *, synthesis: Synthesis | None = None
) -> tuple[AbstractSolver, str]:
    """Choose `Wiener`, `AdmmTV` or `Fista`, and give the reason in a sentence.

    The fast filter is chosen where it is as good, see `filter_suffices`; `Fista` for `LowRank`
    operators, of which each iteration of ADMM takes some 80 applications. `PlugAndPlay` gained with
    every camera measured and is named, but not chosen: what it has not learned, such as text, it
    may do worse.

    - `synthesis`: sums of captures for the solver; see `AdmmTV`.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    solver, reason = tc.choose_solver(recording)
    print(solver.name)  # admm_tv
    ```

    **See also**: `reconstruct`.
    """
    operators = getattr(recording.imaging_model, "operators", ())
    over_field = getattr(recording.imaging_model, "over_field", False)
    if synthesis is None and (over_field or any(isinstance(one, LowRank) for one in operators)):
        return Fista(), "a sum of many convolutions is applied once an iteration, ADMM solves it"
    suffices, reason = filter_suffices(recording, synthesis)
    if not suffices:
        reason += "; of photographs PlugAndPlay makes images 0.2 to 2 dB better"
    return (Wiener if suffices else AdmmTV)(synthesis=synthesis), reason


# The words of experiment files and commands, `method: admm_tv`.
SOLVERS: dict[str, type[AbstractSolver]] = {
    solver.name: solver for solver in (Wiener, FringeScanning, AdmmTV, Fista, Ridge, PoissonTV)
}

# Solvers of later packages, by their names of the first page.
_BEYOND = {"pnp": "PlugAndPlay"}


def named_solver(name: str) -> AbstractSolver:
    """The solver of a name, with its defaults."""
    checks.choice("solver", name, (*SOLVERS, *_BEYOND))
    kind = SOLVERS.get(name) or getattr(sys.modules["thincam_jax"], _BEYOND[name])
    return kind()
