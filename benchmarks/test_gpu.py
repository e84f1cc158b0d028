"""A GPU against the same machine's processor: the public calls, in single precision, in one run.

`make bench-gpu` prints a group for each task; in brackets, how many times the faster device's time.
Both devices get the same arrays, and their results have to agree: a GPU that rounded factors of
matrix products to 10 bits (TF32, JAX's default there) would fail. Compilation and the first call
are apart. Frames begin and end as NumPy arrays, so copies to and from the device count.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.data

import thincam_jax as tc
from benchmarks import test_public
from thincam_jax.learn.denoiser.network import Denoiser
from thincam_jax.learn.denoiser.reconstructions import Crops
from thincam_jax.learn.denoiser.train import loss
from thincam_jax.units import nm, um

SHAPE = (512, 512)
CPU = jax.devices("cpu")[0]
try:
    GPU = jax.devices("gpu")[0]
except RuntimeError:
    GPU = None
pytestmark = pytest.mark.skipif(GPU is None, reason="JAX finds no GPU: pip install 'jax[cuda13]'")


def cameras(phases):
    masks = [tc.FresnelZoneAperture(20.0, phase, width=2.8) for phase in phases]
    sensor = tc.Sensor(SHAPE, 5.5 * um)
    many = [tc.LenslessCamera(mask, sensor, 6.5) for mask in masks]
    return tc.Cameras(many, wavelength=500 * nm, object_distance=250.0, field_shape=SHAPE)


def recording(phases=(0.0,), copies=1):
    """Captures of a photograph with a thousandth of noise, and their cameras."""
    optics = cameras(phases)
    photo = skimage.data.camera().astype(np.float32) / 255
    scene = tc.Scene(tc.ImagePlane(photo, 250.0, 90.0), 500 * nm)
    seen = np.stack([np.asarray(tc.capture(camera, scene)) for camera in optics.cameras])
    noise = np.random.default_rng(0).normal(size=(len(seen), copies, *SHAPE))
    seen = seen[:, None] + 1e-3 * seen.max() * noise
    seen = np.squeeze(seen, 1) if copies == 1 else seen
    return tc.Recording(list(seen.astype(np.float32)), optics, noise_variance=1e-6)


def gradient():
    """Of the PSF's weighted sum in β and d, 1024²."""
    given = test_public.camera()
    y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in given.sensor.shape)
    weight = np.cos(60 * y)[:, None] * np.cos(40 * x + 0.3)

    @jax.jit
    @jax.grad
    def slopes(numbers):
        where = lambda c: (c.mask.beta, c.distance)  # noqa: E731
        camera = eqx.tree_at(where, given, numbers)
        return jnp.sum(
            weight
            * tc.psf(camera, wavelength=500 * nm, object_distance=250.0, pixel_integration=False)
        )

    numbers = jnp.float32(25.0), jnp.float32(6.5)
    return lambda: jnp.stack(slopes(numbers))


def many_psfs():
    """64 zone plates, 512²."""
    betas = jnp.linspace(15.0, 25.0, 64, dtype=jnp.float32)
    sensor = tc.Sensor(SHAPE, 5.5 * um)

    @jax.jit
    @jax.vmap
    def psfs(beta):
        camera = tc.LenslessCamera(tc.FresnelZoneAperture(beta, width=2.8), sensor, 6.5)
        return tc.psf(camera, wavelength=500 * nm, object_distance=250.0, pixel_integration=False)

    return lambda: psfs(betas)


def sampled_psf():
    """Angular spectrum of any mask, 1024², 3 × 3 samples a pixel."""
    given, model = test_public.camera(), tc.PsfMethod("angular_spectrum", oversampling=3)
    return lambda: tc.psf(
        given, wavelength=500 * nm, object_distance=250.0, model=model, pixel_integration=False
    )


def wiener():
    """A filter of two phases, 512², a frame from and to NumPy."""
    given = recording((0.0, np.pi / 2))
    inverse = tc.Wiener().prepare(given.imaging_model)
    frames = np.stack([np.asarray(capture) for capture in given.captures])
    return lambda: np.asarray(inverse(frames, 1e-6).image)


def total_variation():
    """ADMM-TV, 512², 50 iterations."""
    given, solver = recording(), tc.AdmmTV(1.0, iterations=50, tolerance=0.0)
    return lambda: tc.reconstruct(given, solver).image


def many_images():
    """ADMM-TV of 8 captures at once, 512², 50 iterations."""
    given, solver = recording(copies=8), tc.AdmmTV(1.0, iterations=50, tolerance=0.0)
    return lambda: tc.reconstruct(given, solver).image


def stream():
    """ADMM-TV of a video, 512², 4 iterations a frame, from and to NumPy."""
    given = recording()
    video = tc.Stream(given, tc.AdmmTV(1.0, iterations=50), steps=4)
    frame = np.asarray(given.captures[0])
    return lambda: np.asarray(video.next(frame)[1])


def plug_and_play():
    """The shipped denoiser, 512²."""
    given, solver = recording(), tc.PlugAndPlay()
    return lambda: tc.reconstruct(given, solver).image


def training_step():
    """Loss of the shipped denoiser and its gradient, 16 crops of 64²."""
    network, random = Denoiser.load("shipped").network, np.random.default_rng(0)
    clean = jnp.asarray(random.uniform(size=(16, 64, 64)), jnp.float32)
    sigma = jnp.full(16, 0.1, jnp.float32)
    noisy = clean + 0.1 * jnp.asarray(random.normal(size=clean.shape), jnp.float32)
    crops = Crops(clean, noisy, sigma, jnp.mean(noisy, axis=(1, 2)))
    step = eqx.filter_jit(eqx.filter_value_and_grad(lambda n: loss(n, crops)[0]))
    network = jax.tree.map(jnp.asarray, network)
    return lambda: step(network)[0]


def psf():
    """Separable, 1024²."""
    return test_public.psf()[0]


def capture():
    """A photograph of 256², a sensor of 1024²."""
    return test_public.capture()[0]


def flatcam():
    """`Ridge` of a FlatCam's colour capture."""
    return test_public.flatcam()[0]


# How far results may lie apart, relative L2: rounding, and what iterations make of it.
TASKS = {
    psf: 1e-4,
    gradient: 1e-2,
    many_psfs: 1e-4,
    sampled_psf: 1e-4,
    capture: 1e-4,
    wiener: 1e-4,
    total_variation: 1e-3,
    many_images: 1e-3,
    stream: 1e-3,
    plug_and_play: 1e-3,
    flatcam: 1e-4,
    training_step: 1e-3,
}
RESULTS = {}


@pytest.mark.parametrize("device", [CPU, GPU], ids=["cpu", "gpu"])
@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.__name__)
def test_gpu(benchmark, task, device):
    benchmark.group = f"{task.__name__}: {task.__doc__}"
    with jax.enable_x64(False), jax.default_device(device):
        call = task()
        result = np.asarray(jax.block_until_ready(call()))
        rounds = 2 if device == CPU else 20
        run = lambda: jax.block_until_ready(call())  # noqa: E731
        benchmark.pedantic(run, rounds=rounds, warmup_rounds=1, iterations=1)
    other = RESULTS.setdefault(task, result)
    apart = float(np.linalg.norm(result - other) / np.linalg.norm(other))
    benchmark.extra_info["apart"] = apart
    print(f"{task.__name__} on {device}: {apart:.1e} from the first device")
    assert apart < TASKS[task]
