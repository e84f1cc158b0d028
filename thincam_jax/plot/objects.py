"""Pictures that a notebook shows of objects: a scene, a camera, a recording."""

from typing import TYPE_CHECKING

import matplotlib.figure
import numpy as np

from thincam_jax._core.grids import Grid
from thincam_jax.imaging.encoding import eight_bit, pictures
from thincam_jax.plot.frame import drawing, show_image

if TYPE_CHECKING:
    from thincam_jax.imaging.scene import Scene
    from thincam_jax.lensless.camera import LenslessCamera
    from thincam_jax.reconstruction.recording import Recording

_MOST, _SAMPLES = 4, 256  # pictures beside each other; samples along the longer side of a mask
_LIGHT = 550e-6  # mm, in which a phase mask is shown


def draw_scene(scene: "Scene") -> matplotlib.figure.Figure:
    """The first planes of a scene on axes in mm, with one white, titled by their distances."""
    planes = scene.planes[:_MOST]
    figure, panels = drawing((3.4 * len(planes), 3.2), 1, len(planes), squeeze=False)
    for axes, plane in zip(panels[0], planes, strict=True):
        image = eight_bit(pictures(plane.image)[0])
        show_image(axes, image, float(plane.width) / image.shape[1], vmin=0, vmax=255)
        axes.set_title(f"at {float(plane.distance):g} mm", fontsize=9)
    return figure


def draw_camera(camera: "LenslessCamera") -> matplotlib.figure.Figure:
    """A camera's mask, and mask and sensor from the side, to one scale in mm."""
    figure, (left, right) = drawing((7.2, 3.2), 1, 2)
    height, width = (float(side) for side in camera.mask.extent)
    pitch = max(height, width) / _SAMPLES
    grid = Grid((max(1, round(height / pitch)), max(1, round(width / pitch))), pitch)
    amplitude = np.abs(np.asarray(camera.mask.sample(grid, _LIGHT)))
    show_image(left, amplitude, pitch, vmin=0, vmax=1)
    left.set_title("mask: amplitude transmittance", fontsize=9)
    distance, sensor = float(camera.distance), camera.sensor
    across, middle = sensor.shape[1] * float(sensor.pitch) / 2, float(camera.mask.centre[1])
    right.plot([0, 0], [middle - width / 2, middle + width / 2], "k:", linewidth=2, label="mask")
    right.plot([distance] * 2, [-across, across], "k-", linewidth=3, label="sensor")
    right.set(xlabel="z (mm), along the light", ylabel="x (mm)", aspect="equal")
    right.margins(x=0.3)
    right.legend(fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    rows, columns = sensor.shape
    right.set_title(f"{rows}×{columns} pixels of {1000 * float(sensor.pitch):.3g} µm", fontsize=9)
    return figure


def draw_recording(recording: "Recording") -> matplotlib.figure.Figure:
    """The first captures of a recording, and the PSF of the first, each to its own white."""
    shown, count = [], len(recording.captures)
    pitch, psf = recording.pixel_pitch_and_psf()
    for number, capture in enumerate(recording.captures[: _MOST - 1]):
        title = "capture" if count == 1 else f"capture {number + 1} of {count}"
        shown.append((title, capture))
    if psf is not None:
        shown.append(("PSF", psf))
    figure, panels = drawing((3.2 * len(shown), 3.2), 1, len(shown), squeeze=False)
    for axes, (title, image) in zip(panels[0], shown, strict=True):
        show_image(axes, eight_bit(pictures(image)[0]), pitch, vmin=0, vmax=255)
        axes.set_title(title, fontsize=9)
    return figure
