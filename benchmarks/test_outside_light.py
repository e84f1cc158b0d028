"""Fields of the scene, the sensor and all that it sees: PSNR, CPU seconds, and what is said."""

import time
from typing import Any

import jax
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.reconstruction.outside_light import outside_light, with_field
from thincam_jax.units import nm, um

SENSOR, DISTANCE, FAR = tc.Sensor((128, 160), 24 * um), 3.0, 250.0
LIGHT = {"wavelength": 550 * nm, "object_distance": FAR}
ACROSS = 160 * 24 * um * FAR / DISTANCE  # of the sensor's field, mm


def camera(name, width):
    cells = np.random.default_rng(0).random((40, 40))
    masks = {
        "zones": lambda: tc.FresnelZoneAperture(25.0 if width < 2 else 12.0, width=width),
        "MURA": lambda: tc.ModifiedUniformlyRedundantArray(31, width / 31),
        "random": lambda: tc.SampledMask((cells < 0.5).astype(float), pitch=width / 40),
        "sparse": lambda: tc.SampledMask((cells < 0.1).astype(float), pitch=width / 40),
    }
    return tc.LenslessCamera(masks[name](), SENSOR, DISTANCE)


def recorded(one, picture, size, snr, **field) -> tuple[tc.ImagePlane, Any]:
    plane = tc.ImagePlane(picture, FAR, size * ACROSS)
    noise = tc.GaussianNoise(snr_db=snr)
    capture = tc.capture(one, tc.Scene(plane, 550 * nm), key=0, noise=noise)
    return plane, tc.Recording([capture], tc.Cameras([one], **LIGHT, **field))


def decibels(result, plane, shape):
    """PSNR over the middle of a shape, after the best gain and offset."""
    image = np.asarray(result.image)
    truth = np.asarray(plane.sample(tc.Grid(image.shape, result.pitch), magnification=1.0))
    corner = [(n - m) // 2 for n, m in zip(image.shape, shape, strict=True)]
    window = tuple(slice(c, c + m) for c, m in zip(corner, shape, strict=True))
    image, truth = image[window].ravel(), truth[window].ravel()
    gain, offset = np.polyfit(image, truth, 1)
    return -10 * np.log10(np.mean((gain * image + offset - truth) ** 2) / truth.max() ** 2)


def timed(call, *given):
    call(*given)  # compiles
    began = time.process_time()
    found = call(*given)
    jax.block_until_ready(found)
    return found, time.process_time() - began


@pytest.mark.parametrize(("name", "width"), [("zones", 1.2), ("MURA", 3.6), ("random", 3.6)])
def test_fields(name, width):
    """The scene's own field, the sensor's, all that the sensor sees, and the one found."""
    one, picture = camera(name, width), resize(sample_image("camera"), (256, 320))
    for size in (0.5, 0.95, 1.3):
        own: Any = tuple(int(np.ceil(n * size)) for n in SENSOR.shape)
        middle = tuple(min(n, m) for n, m in zip(own, SENSOR.shape, strict=True))
        plane, recording = recorded(one, picture, size, 30.0)
        whole, line = recording.imaging_model.seen_field, f"{name} {width} mm, scene {size}:"
        for label, field in (("own", own), ("sensor", SENSOR.shape), ("seen", whole)):
            given = with_field(recording, field)
            result, seconds = timed(tc.reconstruct, given, tc.AdmmTV())
            line += f" {label} {decibels(result, plane, middle):.1f} dB {seconds:.2f} s;"
        result, seconds = timed(tc.reconstruct, recording, tc.AdmmTV())
        problem, image = recording.problem(), recording.oriented(result.image)[None, None]
        fits = image.shape[-2:] == problem.field_shape
        line += f" default {decibels(result, plane, middle):.1f} dB {seconds:.2f} s"
        if fits:  # else the field has been found
            _, check = timed(outside_light, recording, problem, image, None)
            line += f", of it the check {check:.3f} s"
        print(line, result.image.shape, result.reason)


def test_clean_captures():
    """Scenes inside the field, or of its size, at 15 to 40 dB: nothing is said."""
    random, said = np.random.default_rng(5), 0
    pictures = [resize(sample_image(n), (128, 160)) for n in ("camera", "coins", "text", "moon")]
    for number in range(40):
        one = camera(
            ("zones", "MURA", "random", "sparse")[number // 10], (1.2, 2.4)[number // 5 % 2]
        )
        size = 0.8 if number % 2 else random.uniform(0.3, 0.97)
        side = {"field_width": size * ACROSS, "field_height": 0.8 * size * ACROSS}
        picture, snr = pictures[number % 4], float(random.choice([15, 20, 30, 40]))
        _, recording = recorded(one, picture, size, snr, **(side if number % 2 else {}))
        said += "from outside" in tc.reconstruct(recording, tc.AdmmTV()).reason
    print(f"{said} of 40 clean captures are said to have light from outside")
    assert said <= 1
