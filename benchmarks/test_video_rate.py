"""Video rate: from frames of a camera to images of 8 bits, and what a moving scene costs.

A thread triggers a virtual camera 60 times a second, 12 bits, a scene that moves by
four pixels a frame before a zone aperture. A loop takes the newest frame, or the last four of
four phases, and makes an image; frames that come meanwhile are dropped. Compilation and the first
images are apart. Parts are timed alone, and transforms are the floor of all. Besides seconds the
time of the processor is printed, which other programs disturb less. `pytest -s` shows the tables.
"""

import runpy
import threading
import time
from collections import deque
from itertools import cycle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.data

import thincam_jax as tc
from helpers import ROOT
from thincam_jax.hardware import CameraSettings
from thincam_jax.hardware.virtual.devices import VirtualCamera
from thincam_jax.units import nm, um

RATE, SECONDS, WARM_UP, FULL = 60.0, 6.0, 3, 4095
PITCH, DISTANCE, FAR = 5.5 * um, 6.5, 250.0


@pytest.fixture(autouse=True)
def _single_precision():
    with jax.enable_x64(False):
        yield


def optics(count, phases=1):
    """A zone aperture as wide as the sensor, at phases π/2 apart."""
    sensor, beta = tc.Sensor((count, count), PITCH), 100.0 * 256 / count
    masks = [
        tc.FresnelZoneAperture(beta, k * np.pi / 2, width=count * PITCH) for k in range(phases)
    ]
    cameras = [tc.LenslessCamera(mask, sensor, DISTANCE) for mask in masks]
    size = {"field_shape": (count, count), "object_distance": FAR}
    return tc.Cameras(cameras, wavelength=500 * nm, **size)


def frames(cameras):
    """Eight frames, whose phase goes on with each, and the variance of their noise."""
    count, random = cameras.field_shape[0], np.random.default_rng(0)
    photograph = np.roll(skimage.data.camera(), 100, axis=1)[:count, :count].astype(np.float32)
    moved = np.stack([np.roll(photograph, 4 * k, axis=1) for k in range(8)]) / 255
    clean, phases = np.empty_like(moved), len(cameras.cameras)
    for k, camera in enumerate(cameras.cameras):
        plane = tc.ImagePlane(moved[k::phases], FAR, count * PITCH * FAR / DISTANCE)
        clean[k::phases] = tc.capture(camera, tc.Scene(plane, 500 * nm))
    clean *= 0.8 * FULL / clean.max()
    deviation = float(np.sqrt(np.mean(clean**2))) * 10 ** (-30 / 20)
    noisy = clean + deviation * random.standard_normal(clean.shape)
    return np.clip(np.round(noisy), 0, FULL).astype(np.uint16), deviation**2


def shown(image):
    """8 bits, on the host, of an image whose brightest is that of the scene."""
    image = np.asarray(image)
    return np.clip(image * (255 / max(image.max(), 1e-30)), 0, 255).astype(np.uint8)


def loop(supply, depth, image_of):
    """Print images a second, latency and dropped frames; returns the last picture."""
    ready, stop, newest, times = threading.Condition(), threading.Event(), deque(maxlen=depth), []
    given = cycle(supply)

    def expose():
        with VirtualCamera(lambda _: next(given), supply.shape[1:]) as camera:
            camera.configure(CameraSettings(1e-3, pixel_format="Mono12"))
            began, number = time.perf_counter(), 0
            while not stop.is_set():
                time.sleep(max(0.0, began + number / RATE - time.perf_counter()))
                exposed = time.perf_counter()
                pixels = camera.trigger_and_grab(5.0).pixels
                with ready:
                    newest.append((number, exposed, pixels))
                    ready.notify()
                number += 1

    thread = threading.Thread(target=expose)
    thread.start()
    try:
        last, end = -1, np.inf
        while time.perf_counter() < end:
            with ready:
                ready.wait_for(lambda n=last: len(newest) == depth and newest[-1][0] > n)
                taken = list(newest)
            last, exposed, _ = taken[-1]
            by_phase = sorted(taken, key=lambda one: one[0] % depth)
            picture = shown(image_of(np.stack([p for *_, p in by_phase]).astype(np.float32)))
            now = time.perf_counter()
            times.append((last, now, now - exposed, time.process_time()))
            if len(times) == WARM_UP:
                end = now + SECONDS
    finally:
        stop.set()
        thread.join()
    numbers, ends, latency, busy = np.array(times[WARM_UP - 1 :]).T
    made, passed = len(ends) - 1, ends[-1] - ends[0]
    seen = numbers[-1] - numbers[0]
    middle, most = 1000 * np.percentile(latency[1:], (50, 95))
    print(
        f"  {made / passed:.1f} images/s of {seen / passed:.1f} frames/s; {seen - made:.0f} of "
        f"{seen:.0f} frames dropped; latency {middle:.0f} ms, 95 % below {most:.0f} ms; "
        f"{1000 * (busy[-1] - busy[0]) / made:.1f} ms of a core an image, the camera's included"
    )
    return picture


def parts(**calls):
    """Print median times of parts, interleaved, ms; each is a call, and how many an image takes."""
    found = {name: [] for name in calls}
    for number in range(22):
        for name, (call, _) in calls.items():
            began, busy = time.perf_counter(), time.process_time()
            jax.block_until_ready(call())
            if number > 1:
                found[name].append((time.perf_counter() - began, time.process_time() - busy))
    for name, (_, times) in calls.items():
        wall, busy = 1000 * times * np.median(found[name], axis=0)
        print(f"  {name.replace('_', ' ')}: {wall:.1f} ms, {busy:.1f} ms of a core")


def transforms(window):
    """Both transforms of a window, each a program."""
    forward = jax.jit(jnp.fft.rfft2)
    backward = jax.jit(lambda half: jnp.fft.irfft2(half, s=window))
    real = jnp.ones(window, jnp.float32)
    half = forward(real)
    return lambda: forward(real), lambda: backward(half)


@pytest.mark.parametrize("phases", [1, 4])
def test_wiener_512(phases):
    cameras = optics(512, phases)
    supply, variance = frames(cameras)
    synthesis = None if phases == 1 else [[1, 0, -1, 0], [0, 1, 0, -1]]
    solve = tc.Wiener(synthesis=synthesis).prepare(cameras)
    print(f"\nWiener, 512², frames of {phases} phases")
    picture = loop(supply, phases, lambda given: solve(given, variance).image)
    assert picture.std() > 5
    given = supply[:phases].astype(np.float32)
    there, image = jnp.asarray(given), solve(given, variance).image
    forward, backward = transforms(solve.padded)
    parts(
        whole=(lambda: shown(solve(given, variance).image), 1),
        forward_transforms=(forward, len(solve.weights)),
        inverse_transform=(backward, 1),
        filter_with_its_transforms=(lambda: solve(there, variance).image, 1),
        copy_to_device=(lambda: jnp.asarray(supply[:phases].astype(np.float32)), 1),
        copy_and_8_bits=(lambda: shown(image), 1),
    )


def test_stream_256(steps=4):
    cameras = optics(256)
    supply, variance = frames(cameras)
    floats = supply.astype(np.float32)
    recording = tc.Recording(floats[:1], cameras, noise_variance=variance)
    began = time.perf_counter()
    stream = tc.Stream(recording, tc.AdmmTV(2.0, iterations=60), steps=steps)
    jax.block_until_ready(stream.state)
    print(f"\nTV stream, 256², {steps} steps; the first frame {time.perf_counter() - began:.1f} s")

    def image_of(given, kept=[stream]):  # noqa: B006
        kept[0], image = kept[0].next(given)
        return image

    assert loop(supply, 1, image_of).std() > 5
    splitting, state, image = stream.method.arguments, stream.state, image_of(floats[:1])
    forward, backward = transforms(splitting.operators[0].window)
    reflected = eqx.filter_jit(lambda s, q: s.reflected(q))
    nearest = eqx.filter_jit(lambda s, q: s.nearest(q))
    shrink = eqx.filter_jit(lambda s, q: s.variation.shrink(q.slopes, s.tau))
    parts(
        whole=(lambda: shown(image_of(floats[:1])), 1),
        forward_transforms=(forward, 2 * steps),
        inverse_transforms=(backward, 2 * steps),
        joint_equation_with_its_transforms=(lambda: nearest(splitting, state), steps),
        all_proximal_maps=(lambda: reflected(splitting, state), steps),
        of_these_total_variation=(lambda: shrink(splitting, state), steps),
        copy_and_8_bits=(lambda: shown(image), 1),
    )


def test_plug_and_play_256():
    """One image from the one before; its loop would drop nearly all frames."""
    cameras = optics(256)
    supply, variance = frames(cameras)
    solver, image, times = tc.PlugAndPlay(iterations=2), None, []
    for frame in supply[:2].astype(np.float32):
        recording = tc.Recording(frame[None], cameras, noise_variance=variance)
        if image is None:
            image = tc.reconstruct(recording, tc.Wiener()).image
        times, busy = [time.perf_counter()], time.process_time()
        noted = lambda _, t=times: t.append(time.perf_counter())  # noqa: E731
        picture = shown(tc.reconstruct(recording, solver, start=image, callback=noted).image)
        times.append(time.perf_counter())
    spent, busy = np.diff(times), time.process_time() - busy
    print(
        f"\nplug and play, 256², warm: {times[-1] - times[0]:.1f} s an image, {busy:.1f} s of a "
        f"core; set-up, first data step and noise {spent[0]:.1f} s, each later iteration "
        f"{np.mean(spent[1:-1]):.2f} s"
    )
    assert picture.std() > 5


def test_moving_scene(monkeypatch, tmp_path):
    """PSNR against speed: the stream, Wiener filters and converged total variation."""
    monkeypatch.setenv("THINCAM_FIGURES", str(tmp_path))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    print()
    runpy.run_path(str(ROOT / "experiments/video.py"))
