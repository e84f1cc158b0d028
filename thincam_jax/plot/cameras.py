"""Figures of a camera: its PSF, its transfer function and its mask."""

import math
import textwrap

import matplotlib.figure
import numpy as np
import wadler_lindig as wl

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, whole
from thincam_jax._core.grids import Grid
from thincam_jax.lensless import psf as psfs
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.method import Model, PsfMethod
from thincam_jax.plot.frame import Figure, new_figure, show_image


def psf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Figure:
    """A camera's PSF, as an image and along a line through its middle; arguments as of `tc.psf`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(beta=25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((96, 128), 15 * um), distance=3.0)
    figure = tc.plot.psf(camera, wavelength=500 * nm)
    ```
    """
    light = {"wavelength": wavelength, "object_distance": object_distance, "model": model}
    image = psfs.psf(camera, **light, pixel_integration=pixel_integration)
    figure = new_figure(8.5, 3.4)
    draw_psf(figure, np.asarray(image), camera.sensor.grid, _title(camera.mask))
    return figure


def draw_psf(figure: matplotlib.figure.Figure, image: np.ndarray, grid: Grid, title: str) -> None:
    """Draw a PSF (y, x) on a grid, and its values along a line through its middle."""
    whole, line = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.6)})
    shown = show_image(whole, image, float(grid.pitch))
    figure.colorbar(shown, ax=whole, label="irradiance / open aperture")
    rows, columns = image.shape
    x = float(grid.pitch) * (np.arange(columns) - (columns - 1) / 2)
    line.plot(x, image[rows // 2], color="black", linewidth=0.7)
    line.set(xlabel="x (mm), through the middle", ylabel="irradiance / open aperture")
    line.yaxis.set(label_position="right", ticks_position="right")  # away from the other scale
    line.set_title(title, fontsize=9)


def otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Figure:
    """Magnitude of a camera's OTF, relative to zero frequency, and the same along v = 0.

    Arguments as of `tc.otf`.
    """
    light = {"wavelength": wavelength, "object_distance": object_distance, "model": model}
    response = np.asarray(psfs.otf(camera, **light, pixel_integration=pixel_integration))
    grid = camera.sensor.grid
    u, v = np.asarray(grid.u), np.asarray(grid.v)
    rows, columns = response.shape
    relative = response / np.abs(response[rows // 2, columns // 2])
    figure = new_figure(8.5, 3.4)
    whole, line = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.6)})
    decibels = 20 * np.log10(np.maximum(np.abs(relative), 1e-6))
    du, dv = (u[1] - u[0]) / 2, (v[1] - v[0]) / 2
    extent = (u[0] - du, u[-1] + du, v[-1] + dv, v[0] - dv)
    shown = whole.imshow(decibels, cmap="gray", vmin=-60, vmax=0, extent=extent, aspect="auto")
    figure.colorbar(shown, ax=whole, label="|H| / |H(0)| (dB)")
    whole.set(xlabel="u (cycles/mm)", ylabel="v (cycles/mm)")
    positive = slice(columns // 2, None)
    line.plot(u[positive], decibels[rows // 2, positive], color="black", linewidth=0.8)
    line.set(xlabel="u (cycles/mm), v = 0", ylabel="|H| / |H(0)| (dB)", ylim=(-60, 3))
    line.set_title(_title(camera.mask), fontsize=9)
    return figure


@checked
def mask(mask: AbstractMask, *, wavelength: Number | None = None, samples: int = 512) -> Figure:
    """A mask's amplitude transmittance, and its phase where it delays the light.

    - `wavelength`: mm, of the light; a phase mask needs it.
    - `samples`: along the longer side of the mask.
    """
    height, width = (float(side) for side in mask.extent)
    pitch = max(height, width) / whole("samples", samples, 1)
    grid = Grid((max(1, round(height / pitch)), max(1, round(width / pitch))), pitch)
    field = np.asarray(mask.sample(grid, wavelength))
    phase = np.angle(field) if np.iscomplexobj(field) else np.zeros(field.shape)
    delays = bool(np.any((np.abs(field) > 1e-3) & (np.abs(phase) > 1e-6)))
    amplitude = "amplitude transmittance", np.abs(field), {"vmin": 0, "vmax": 1}
    delay = "phase (rad)", phase, {"vmin": -np.pi, "vmax": np.pi}
    drawn = [amplitude, delay] if delays else [amplitude]
    figure = new_figure(4.3 * len(drawn), 3.6)
    panels = figure.subplots(1, len(drawn), squeeze=False)[0]
    for axes, (label, values, limits) in zip(panels, drawn, strict=True):
        figure.colorbar(show_image(axes, values, pitch, **limits), ax=axes, label=label)
    figure.suptitle(_title(mask), fontsize=9)
    return figure


def _title(mask: AbstractMask) -> str:
    """The mask's numbers in at most three lines."""
    return textwrap.fill(wl.pformat(mask, width=10_000), 56, max_lines=3)
