"""The system matrix at full size: 4096 patterns on 440×440 pixels, from a Zarr store.

The captures are those of the see-through screen of ERRATA's defaults in counts of a camera of 12
bits, with noise: a store of 1.6 GB. The matrix, 3.2 GB, is recovered in a process of its own, whose
peak memory is measured (of the process, the cache of files apart), and compared with the true one.
Beside it, in one run, the transform of 440 pixels by butterflies in NumPy.
"""

import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.operators.masked import Scaled
from thincam_jax.measured.calibration import HadamardCaptures, HadamardSeries, simulate_captures
from thincam_jax.measured.calibration.hadamard import walsh_hadamard
from thincam_jax.units import deg, nm, um

CELLS, SHAPE, NOISE = (64, 64), (440, 440), 8.0

RECOVER = """
import resource, sys, time
import numpy as np
start = time.perf_counter()
from thincam_jax.measured.calibration import HadamardCaptures, recover_matrix
matrix = recover_matrix(HadamardCaptures.load(sys.argv[1])).matrix.block_until_ready()
seconds = time.perf_counter() - start
print(seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
np.save(sys.argv[2], np.asarray(matrix[::997]))
"""


def true_operator():
    hologram = wg.VolumeHologram.record(
        532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    camera = wg.SeeThroughCamera(
        wg.Screen(hologram, 5.0, 1.5), tc.Sensor(SHAPE, 4.8 * um), 6.0, 10.0
    )
    plane = wg.ObjectPlane(CELLS, 550.0, 150.0, (27.0, 0.0))
    camera, plane = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (camera, plane))
    system = wg.system_operator(camera, plane)
    brightest = jnp.max(system(jnp.ones(CELLS, jnp.float32)))
    return Scaled(system, 3000 / brightest)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("full") / "captures.zarr"
    series = HadamardSeries(CELLS, display="binary", dark_frames=16)
    writer = HadamardCaptures.create(path, series, SHAPE, bits=12)
    return simulate_captures(
        writer, true_operator(), jax.random.key(0), noise_std=NOISE, offset=100.0
    )


@pytest.mark.benchmark(group="calibration")
def test_recovery(benchmark, store, tmp_path, capsys):
    benchmark.pedantic(lambda: HadamardCaptures.load(store.path))
    done = subprocess.run(
        [sys.executable, "-c", RECOVER, store.path, tmp_path / "some.npy"],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    seconds, memory = (float(word) for word in done.stdout.split())
    some = np.load(tmp_path / "some.npy")
    operator, errors = true_operator(), []
    for row, found in zip(range(0, SHAPE[0] * SHAPE[1], 997), some, strict=True):
        unit = jnp.zeros(SHAPE, jnp.float32).at[divmod(row, SHAPE[1])].set(1)
        errors.append(found - np.asarray(operator.adjoint(unit)).ravel())
    error = np.sqrt(np.mean(np.square(errors)))
    start = time.perf_counter()
    values = np.random.default_rng(0).normal(size=(4096, 440)).astype(np.float32)
    fast = butterflies(values)
    slow = time.perf_counter() - start
    start = time.perf_counter()
    ours = walsh_hadamard(values)
    quick = time.perf_counter() - start
    np.testing.assert_allclose(ours.T, fast, atol=1e-3)
    benchmark.extra_info.update(seconds=seconds, gigabytes=memory, error=float(error))
    with capsys.disabled():
        print(f"\n{CELLS} cells, {SHAPE} pixels: {seconds:.1f} s, {memory:.2f} GiB at the peak")
        print(f"error {error:.3f} counts, 2σ/√N = {2 * NOISE / 64:.3f}")
        print(f"440 pixels: {quick * 1e3:.0f} ms; butterflies {slow / quick:.1f} times as long")
    assert seconds < 60 and memory < 6 and slow > 3 * quick
    assert error < 1.2 * 2 * NOISE / 64


def butterflies(values):
    """The textbook transform: additions and subtractions at a growing stride."""
    shape, stride = values.shape, 1
    while stride < shape[0]:
        pairs = values.reshape(-1, 2, stride, shape[1])
        first, second = pairs[:, 0], pairs[:, 1]
        values = np.stack([first + second, first - second], axis=1).reshape(shape)
        stride *= 2
    return values
