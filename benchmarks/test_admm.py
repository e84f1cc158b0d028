"""ADMM-TV against the same algorithm in NumPy and scipy.fft, on the same data, in one run.

Equal objective, not equal iterations: SciPy runs its number of iterations; ours runs until its
image is no worse. SciPy is given three settings: the penalties of the DiffuserCam tutorial, ours in
plain ADMM, and ours with our relaxation, so that little but the speed of an iteration differs.
Medians after a warm-up; compilation apart. Neither side computes its objective while it is timed;
`iterate` does so every tenth iteration.
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.data
import tifffile

sys.path.insert(0, str(Path(__file__).parent))
from scipy_admm import ScipyAdmm

from thincam_jax import Psfs, Recording
from thincam_jax.reconstruction.admm import RELAXATION
from thincam_jax.reconstruction.iterate import CHUNK, _advance_donated
from thincam_jax.reconstruction.parallel import ParallelMethod, in_parallel
from thincam_jax.reconstruction.splittings import admm_method

DATA = Path(__file__).parents[2] / "shared" / "data" / "diffusercam-hand"


def hand():
    """The measured capture and PSF at a quarter of their resolution, and 100 iterations."""
    if not DATA.exists():
        pytest.skip("needs ../shared/data/diffusercam-hand beside the checkout")
    psf, raw = (
        tifffile.imread(DATA / name).astype(np.float32)
        for name in ("psf_sample.tif", "rawdata_hand_sample.tif")
    )
    background = psf[5:15, 5:15].mean()
    psf, raw = (
        np.maximum(i - background, 0).reshape(300, 4, 400, 4).mean((1, 3)) for i in (psf, raw)
    )
    return raw[None, None], (psf / psf.sum())[None], 100


def photograph():
    """A diffuser's capture of a photograph, 1024²×3, with 1 % noise, and 50 iterations."""
    random = np.random.default_rng(0)
    scene = np.zeros((1024, 1024, 3), np.float32)
    scene[256:768, 256:768] = skimage.data.astronaut() / 255
    speckle = np.fft.rfft2(random.normal(size=(1024, 1024)))
    smooth = np.exp(-((np.hypot(*np.meshgrid(*_frequencies(1024), indexing="ij")) / 0.06) ** 2))
    psf = np.fft.irfft2(speckle * smooth, s=(1024, 1024))
    psf = np.maximum(psf - psf.std(), 0).astype(np.float32)
    psf /= psf.sum()
    problem = posed(np.zeros((1, 3, 1024, 1024), np.float32), psf[None])
    image = jnp.asarray(np.moveaxis(scene, -1, 0))[:, None]
    margins = [(n // 2 - 512, n - n // 2 - 512) for n in problem.field_shape]
    field = jnp.pad(image, [(0, 0), (0, 0), *margins])
    clean = np.asarray(problem.operators[0](field))
    noisy = clean + 0.01 * clean.max() * random.normal(size=clean.shape)
    return noisy.astype(np.float32)[None], psf[None], 50


def posed(captures, psfs):
    """Captures (capture, channel, y, x) with measured PSFs, and τ = 2."""
    return Recording(jnp.asarray(captures), Psfs(jnp.asarray(psfs))).problem(tau=2.0)


def _frequencies(count):
    return np.fft.fftfreq(count), np.fft.rfftfreq(count)


def run(method, state, iterations):
    """As `iterate` does between two checks."""
    return jax.block_until_ready(method.advance(state, iterations))


def zeros(problem):
    return jnp.zeros(problem.image_shape, jnp.float32)


def median_time(function, rounds, *, warm_up=True):
    if warm_up:
        function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def scipy_of(method, penalties, relaxation):
    splitting = method.arguments
    operator = splitting.operators[0]
    solver = ScipyAdmm(
        np.asarray(operator.spectrum[0, 0]) * float(splitting.gains[0]),
        np.asarray(splitting.captures[0]),
        operator.window,
        operator.sensor_corner,
        operator.field_corner,
        operator.field_shape,
    )
    solver.set(penalties, float(splitting.tau), relaxation)
    return solver


def restart(solver):
    for array in solver.state:
        array.fill(0)


def tutorial_penalties(method):
    """μ = 1e-6, 1e-5, 4e-5 for an operator with a mean square of 1/(samples of the window)."""
    samples = np.prod(method.arguments.operators[0].window)
    return 1e-6, 1e-5 * samples, 4e-5 * samples


def iterations_to(method, problem, goal, most=400):
    """The first multiple of the chunk after which the objective is no worse."""
    state = method.start(zeros(problem))
    for done in range(CHUNK, most, CHUNK):
        state = method.advance(state, CHUNK)
        if float(jnp.sum(method.objective(method.image(state)))) <= goal:
            return done
    return None


def transforms_time(problem, rounds):
    """The FFTs of one iteration, each started by itself, so that all cores work on it."""
    window = problem.operators[0].window
    channels = problem.image_shape[-4]
    real = jnp.ones((channels, 1, *window), jnp.float32)
    forward = jax.jit(jnp.fft.rfft2)
    backward = jax.jit(lambda x: jnp.fft.irfft2(x, s=window))
    half = forward(real)

    def iteration():
        jax.block_until_ready((forward(real), forward(real)))
        jax.block_until_ready((backward(half), backward(half)))

    return median_time(iteration, rounds)


@pytest.mark.parametrize("case", [hand, photograph], ids=["hand", "photograph"])
@pytest.mark.benchmark(group="admm")
def test_admm(benchmark, capsys, case):
    captures, psfs, count = case()
    problem = posed(captures, psfs)
    method, whole = in_parallel(problem, admm_method), admm_method(problem)
    rounds = 5
    own = [float(p) for p in jax.tree.leaves(whole.arguments.penalties)]
    lines = []
    for name, penalties, relaxation in (
        ("tutorial's penalties", tutorial_penalties(whole), 1.0),
        ("our penalties, plain", own, 1.0),
        ("our penalties and relaxation", own, RELAXATION),
    ):
        solver = scipy_of(whole, penalties, relaxation)

        def theirs(solver=solver):
            restart(solver)
            solver.run(count)

        # NumPy compiles nothing, and half a minute needs no second try.
        slow = median_time(theirs, rounds if case is hand else 1, warm_up=case is hand)
        image = solver.image() * float(whole.arguments.image_unit)
        goal = float(jnp.sum(method.objective(jnp.asarray(image)[:, None])))
        needed = iterations_to(method, problem, goal * (1 + 1e-6))
        assert needed is not None, f"never as good as SciPy with {name}"
        fast = median_time(lambda n=needed: run(method, method.start(zeros(problem)), n), rounds)
        lines.append(
            f"  SciPy, {name}: {count} iterations in {slow:.3g} s; as good after {needed} of ours "
            f"in {fast:.3g} s: {slow / fast:.1f} times faster, an iteration "
            f"{slow / count * needed / fast:.1f} times"
        )
    many = median_time(lambda: run(method, method.start(zeros(problem)), 5 * CHUNK), rounds)
    one = many / (5 * CHUNK)
    transforms = transforms_time(problem, 10)
    lines.append(
        f"  an iteration {one * 1e3:.1f} ms, {one / transforms:.2f} times its transforms "
        f"({transforms * 1e3:.1f} ms)"
    )
    lines.append(memory_line(whole))
    if isinstance(method, ParallelMethod):
        lines.append(apart_line(whole, problem, one))
    if case is hand:
        lines.append(batch_line(captures, psfs, one))
    benchmark.pedantic(lambda: run(method, method.start(zeros(problem)), CHUNK), rounds=3)
    with capsys.disabled():
        channels = problem.image_shape[-4]
        print(f"\n{case.__name__}, window {problem.operators[0].window}, {channels} channels")
        print("\n".join(lines))


def memory_line(method):
    """What the compiled chunk allocates, against the arrays it must hold."""
    state = method.start(zeros(method.problem))
    memory = (
        _advance_donated.lower(method, state, np.int32(CHUNK)).compile().compiled.memory_analysis()
    )
    held = sum(x.nbytes for x in jax.tree.leaves((state, method.arguments)))
    peak = (
        memory.argument_size_in_bytes
        + memory.temp_size_in_bytes
        + memory.output_size_in_bytes
        - memory.alias_size_in_bytes
    )
    return f"  memory: {peak / 1e6:.0f} MB at most, {peak / held:.2f} times what it must hold"


def apart_line(whole, problem, one):
    together = median_time(lambda: run(whole, whole.start(zeros(problem)), CHUNK), 3) / CHUNK
    return f"  all parts in one program: an iteration {together / one:.2f} times as long"


def batch_line(captures, psfs, one):
    eight = posed(np.repeat(captures[:, None], 8, axis=1), psfs)
    method = admm_method(eight)
    run(method, method.start(zeros(eight)), CHUNK)
    time_of_eight = median_time(lambda: run(method, method.start(zeros(eight)), 5 * CHUNK), 5) / (
        5 * CHUNK
    )
    return f"  8 captures in a batch: {time_of_eight / one:.2f} times one"
