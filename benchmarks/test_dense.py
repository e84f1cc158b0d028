"""A dense measured matrix: ADMM-TV on its reduction, against NumPy with a cached inverse.

Both minimise ½‖Hf − g‖² + τ TV(f), f ≥ 0. NumPy splits off differences and non-negative image,
and finds f by one product with the inverse of HᵀH + μ(DᵀD + 1), computed once. Its penalty and
relaxation are tuned on this very capture: of `TUNED` those with the lowest objective after
`ITERATIONS`. Seconds are to equal objective, 0.1 % above the lowest that both sides reach.

`THINCAM_DENSE=full` takes the 193600 × 4096 numbers of a real calibration (3.2 GB, minutes); by
default 1/149 of them. The matrix has a strong uniform part, as light that scatters makes it.
"""

import itertools
import os
import time

import jax
import numpy as np
import scipy.linalg

import thincam_jax as tc
from thincam_jax.imaging.operators import ReducedMatrix
from thincam_jax.reconstruction.problem import compiled_objective

FULL = os.environ.get("THINCAM_DENSE") == "full"
PIXELS, CELLS = (440, 64) if FULL else (96, 24)
ITERATIONS, CHUNK, ROUNDS = 100, 10, 7
# Penalties relative to the mean eigenvalue of HᵀH, and relaxations.
TUNED = tuple(itertools.product(np.geomspace(0.03, 30, 13), (1.0, 1.8)))


def test_seconds_to_equal_objective_against_numpy(capsys):
    rng = np.random.default_rng(0)
    matrix = rng.random((PIXELS**2, CELLS**2), dtype=np.float32)
    matrix **= 8  # in place, for the memory
    matrix /= CELLS
    scene = np.zeros((CELLS, CELLS), np.float32)
    scene[CELLS // 4 : CELLS // 2, CELLS // 3 : -4] = 1
    capture = matrix @ scene.ravel()
    noise = np.float32(0.03 * capture.std())
    capture += noise * rng.standard_normal(capture.shape, dtype=np.float32)

    once, system = timed(lambda: ReducedMatrix.of(matrix, scene.shape))
    projected = system.project(matrix, capture)
    recording = tc.Recording(projected, system, noise_variance=float(noise**2))
    problem = recording.problem(tau=1.0)
    tau = float(problem.absolute_tau) * float(noise) ** 2

    def ours(iterations):
        return tc.reconstruct(recording, tc.AdmmTV(1.0, iterations=iterations, tolerance=0.0))

    def course(solver):
        images = [solver.run(CHUNK).copy() for _ in range(ITERATIONS // CHUNK)]
        return [float(compiled_objective(problem, i.reshape(problem.image_shape))) for i in images]

    began = time.perf_counter()
    gram, pulled = matrix.T @ matrix, matrix.T @ capture
    summed = time.perf_counter() - began
    mean = np.trace(gram) / len(gram)
    courses = {
        setting: course(NumpyAdmm(gram, pulled, scene.shape, tau, mean * setting[0], setting[1]))
        for setting in TUNED
    }
    best = min(courses, key=lambda setting: courses[setting][-1])
    inverted, rival = timed(
        lambda: NumpyAdmm(gram, pulled, scene.shape, tau, mean * best[0], best[1])
    )
    found = [progress.objective for progress in ours(ITERATIONS).history[1:]]
    goal = 1.001 * max(found[-1], courses[best][-1])  # both get there
    needed, theirs = (
        CHUNK * (1 + int(np.argmax(np.less(c, goal)))) for c in (found, courses[best])
    )
    ours(needed)
    seconds = np.array(
        [
            (timed(lambda: ours(needed))[0], timed(lambda: rival.again(theirs))[0])
            for _ in range(ROUNDS)
        ]
    )
    low, middle, high = np.percentile(seconds[:, 1] / seconds[:, 0], (0, 50, 100))
    with capsys.disabled():
        print(
            f"\n{PIXELS**2} × {CELLS**2}: once, reduced in {once:.2f} s; NumPy's Gram matrix in ",
            end="",
        )
        print(f"{summed:.2f} s, inverse in {inverted:.2f} s; μ = {best[0]:.2g}, α = {best[1]}")
        print(
            f"  {needed} iterations in {np.median(seconds, 0)[0]:.3g} s, NumPy's {theirs} in ",
            end="",
        )
        print(
            f"{np.median(seconds, 0)[1]:.3g} s: {middle:.2f} times as long, {low:.2f} to {high:.2f}"
        )
        print("  iteration   objective     NumPy's")
        for number, pair in enumerate(zip(found, courses[best], strict=True), 1):
            print(f"  {CHUNK * number:9d} {pair[0]:11.6g} {pair[1]:11.6g}")
    assert found[-1] < (1.003 if FULL else 1.001) * courses[best][-1]


def timed(function):
    began = time.perf_counter()
    result = jax.block_until_ready(function())
    return time.perf_counter() - began, result


class NumpyAdmm:
    """Over-relaxed ADMM in single precision with a cached inverse, from zero."""

    def __init__(self, gram, pulled, shape, tau, penalty, relaxation):
        along = [np.diff(np.eye(n, dtype=np.float32), axis=0, append=0) for n in shape]
        for one in along:
            one[-1] = 0
        smooth = [one.T @ one for one in along]
        eyes = [np.eye(n, dtype=np.float32) for n in shape]
        whole = np.kron(smooth[0], eyes[1]) + np.kron(eyes[0], smooth[1])
        whole[np.diag_indices_from(whole)] += 1
        whole *= np.float32(penalty)
        whole += gram
        self.inverse = scipy.linalg.inv(whole, overwrite_a=True, check_finite=False)
        self.pulled, self.shape = self.inverse @ pulled, shape
        self.step, self.relaxation = np.float32(tau / penalty), np.float32(relaxation)
        self.penalty = np.float32(penalty)
        self.again(0)

    def again(self, iterations):
        """The image after so many iterations from zero."""
        # Consensus plus scaled dual, and what is subtracted from it.
        self.image, self.down, self.right = (np.zeros(self.shape, np.float32) for _ in range(3))
        return self.run(iterations)

    def run(self, iterations):
        """The image after so many more iterations."""
        for _ in range(iterations):
            kept = np.hypot(self.down, self.right)
            kept = np.maximum(1 - self.step / np.maximum(kept, 1e-30), 0)
            down, right, image = kept * self.down, kept * self.right, np.maximum(self.image, 0)
            below, beside = 2 * down - self.down, 2 * right - self.right
            total = 2 * image - self.image - below - beside
            total[1:] += below[:-1]
            total[:, 1:] += beside[:, :-1]
            flat = self.pulled + self.inverse @ (self.penalty * total).ravel()
            found = flat.reshape(self.shape)
            self.image += self.relaxation * (found - image)
            self.down[:-1] += self.relaxation * (np.diff(found, axis=0) - down[:-1])
            self.right[:, :-1] += self.relaxation * (np.diff(found, axis=1) - right[:, :-1])
        return np.maximum(self.image, 0)
