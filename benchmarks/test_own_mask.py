"""An own mask of 400 × 400 cells on a sensor of 512 × 512 pixels, with the defaults: CPU seconds.

Each call in a process of its own, compiled by a first call; processor time of all threads, the
least of three, and the largest memory of the process. At most 3 s and 2 GB each. `reconstruct` is
`AdmmTV` of 100 iterations, whatever the mask: its time stands beside that of its four transforms an
iteration alone, which take 3.5 s on two slow cores.
"""

import json
import subprocess
import sys

import pytest

SETTING = """
import json, resource, time, warnings
import jax, matplotlib, numpy as np
import thincam_jax as tc
from PIL import Image
from thincam_jax.imaging.targets import sample_image
from thincam_jax.units import nm, um

warnings.simplefilter("ignore")
matplotlib.use("agg")
from matplotlib import pyplot
cells = np.random.default_rng(0).random((400, 400)) < 0.5
Image.fromarray((255 * cells).astype(np.uint8)).save("{folder}/mask.png")
mask = tc.read_mask("{folder}/mask.png", 12 * um)
camera = tc.LenslessCamera(mask, tc.Sensor((512, 512), 12 * um), 2.0)
light = {{"wavelength": 550 * nm, "object_distance": 250.0}}
scene = tc.Scene(tc.ImagePlane(sample_image("camera", linear=True), 250.0, width=180.0), 550 * nm)
noise = tc.GaussianNoise(snr_db=40.0)


def transforms():
    for _ in range(200):
        jax.block_until_ready(back(forth(window)))


def taken(call):
    call()
    seconds = []
    for _ in range(3):
        began = time.process_time()
        jax.block_until_ready(jax.tree.leaves(call()))
        seconds.append(time.process_time() - began)
    return min(seconds)


{name} = lambda: {call}
if "{name}" == "reconstruct":
    capture = tc.capture(camera, scene, key=0, noise=noise)
    recording = tc.Recording([capture], tc.Cameras([camera], **light))
    window = jax.numpy.zeros((1024, 1024), "float32")
    forth, back = jax.jit(jax.numpy.fft.rfft2), jax.jit(jax.numpy.fft.irfft2)
    floor = taken(transforms)
else:
    floor = 0.0
gigabytes = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
print(json.dumps([taken({name}), floor, gigabytes()]))
"""
CALLS = {
    "psf": "tc.psf(camera, **light)",
    "averaged": "tc.psf(camera, **light, pixel_integration=True)",
    "plot": "pyplot.close(tc.plot.psf(camera, **light))",
    "capture": "tc.capture(camera, scene, key=0, noise=noise)",
    "choose_model": "tc.choose_model(camera, tolerance=0.01, **light).method",
    "reconstruct": "tc.reconstruct(recording).image",
}


@pytest.mark.parametrize("name", CALLS)
def test_processor_time_and_memory(name, tmp_path, capsys):
    code = SETTING.format(folder=tmp_path, name=name, call=CALLS[name])
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    seconds, floor, gigabytes = json.loads(ended.stdout.splitlines()[-1])
    with capsys.disabled():
        beside = f", its transforms alone {floor:.2f} s" if floor else ""
        print(f"\n{name:13s} {seconds:5.2f} s of CPU{beside}, {gigabytes:.2f} GB")
    assert gigabytes < 2
    assert seconds < (3.5 * floor if floor else 3)
