"""A dense measured matrix: ADMM-TV on what it is reduced to, against CG inner solves in SciPy.

Both minimise ½‖Hf − g‖² + τ TV(f), f ≥ 0, by as many iterations from zero. `THINCAM_DENSE=full`
takes the 193600 × 4096 numbers of a real calibration (3.2 GB, minutes); by default 1/149 of them.
The matrix has a strong uniform part, as light that scatters makes it.
"""

import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

import thincam_jax as tc
from thincam_jax.imaging.operators import ReducedMatrix
from thincam_jax.reconstruction.problem import objective

PIXELS, CELLS = (440, 64) if os.environ.get("THINCAM_DENSE") == "full" else (96, 24)
ITERATIONS = 50


def test_fifty_iterations_against_scipy(capsys):
    """In one run on one machine: seconds, their ratio, and the objectives that are reached."""
    rng = np.random.default_rng(0)
    matrix = rng.random((PIXELS**2, CELLS**2), dtype=np.float32) ** 8 / CELLS
    scene = np.zeros((CELLS, CELLS), np.float32)
    scene[CELLS // 4 : CELLS // 2, CELLS // 3 : -4] = 1
    capture = matrix @ scene.ravel()
    noise = np.float32(0.03 * capture.std())
    capture += noise * rng.standard_normal(capture.shape, dtype=np.float32)

    began = time.perf_counter()
    system = ReducedMatrix.of(matrix, scene.shape)
    system.vectors.block_until_ready()
    once = time.perf_counter() - began
    projected = system.project(matrix, capture)
    recording = tc.Recording(projected, system, noise_variance=float(noise**2))
    solver = tc.AdmmTV(1.0, iterations=ITERATIONS, tolerance=0.0)
    ours, found = [timed(lambda: tc.reconstruct(recording, solver)) for _ in range(3)][-1]
    six = tc.Recording(jnp.stack([projected] * 6), system, noise_variance=float(noise**2))
    batch, _ = [timed(lambda: tc.reconstruct(six, solver)) for _ in range(3)][-1]

    problem = recording.problem(tau=1.0)
    tau = float(problem.absolute_tau) * float(noise) ** 2
    theirs, images = timed(lambda: scipy_admm(matrix, capture, scene.shape, tau))
    course = [float(objective(problem, i.reshape(problem.image_shape))) for i in images]
    with capsys.disabled():
        print(f"\n{PIXELS**2} × {CELLS**2}: reduced in {once:.1f} s, once; {ITERATIONS} iterations")
        print(f"  one image {ours:.3f} s, six {batch:.3f} s")
        print(f"  scipy with CG {theirs:.2f} s, {theirs / ours:.0f} times as long")
        print("  iteration   objective     scipy's")
        for progress, other in zip(found.history[1:], course, strict=True):
            print(f"  {progress.iteration:9d} {progress.objective:11.6g} {other:11.6g}")
    assert found.history[-1].objective < 1.01 * course[-1]
    assert theirs > 5 * ours


def timed(function):
    began = time.perf_counter()
    result = jax.block_until_ready(function())
    return time.perf_counter() - began, result


def scipy_admm(matrix, capture, shape, tau):
    """ADMM with (HᵀH + μ(DᵀD + 1)) f = Hᵀg + μ(Dᵀ(u − λ) + v − κ) by conjugate gradients.

    Gives the image of every tenth iteration.
    """
    down, right = (
        scipy.sparse.diags_array([-np.ones(n), np.ones(n - 1)], offsets=[0, 1]).tolil()
        for n in shape
    )
    down[-1, -1] = right[-1, -1] = 0
    eyes = [scipy.sparse.eye_array(n) for n in shape]
    differences = scipy.sparse.vstack(
        [scipy.sparse.kron(down, eyes[1]), scipy.sparse.kron(eyes[0], right)]
    ).astype(np.float32)
    differences = scipy.sparse.csr_array(differences)
    size = matrix.shape[1]
    vector = np.ones(size, np.float32)
    for _ in range(20):
        vector = matrix.T @ (matrix @ vector)
        largest = np.linalg.norm(vector)
        vector /= largest
    penalty = np.float32(0.01 * largest)
    operator = scipy.sparse.linalg.LinearOperator(
        (size, size),
        lambda f: matrix.T @ (matrix @ f) + penalty * (differences.T @ (differences @ f) + f),
        dtype=np.float32,
    )
    pulled = matrix.T @ capture
    image, sign = np.zeros(size, np.float32), np.zeros(size, np.float32)
    slopes, force = (np.zeros(2 * size, np.float32) for _ in range(2))
    allowed, images = image, []
    for number in range(ITERATIONS):
        right_side = pulled + penalty * (differences.T @ (slopes - force) + allowed - sign)
        image, _ = scipy.sparse.linalg.cg(operator, right_side, image, rtol=1e-4, maxiter=30)
        changes = differences @ image
        pairs = (changes + force).reshape(2, -1)
        length = np.maximum(np.linalg.norm(pairs, axis=0), 1e-30)
        slopes = (pairs * np.maximum(0, 1 - tau / penalty / length)).ravel()
        force = force + changes - slopes
        allowed = np.maximum(image + sign, 0)
        sign = sign + image - allowed
        if number % 10 == 9:
            images.append(allowed.astype(np.float32))
    return images
