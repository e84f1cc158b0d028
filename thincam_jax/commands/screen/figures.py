"""The pictures of a screen run, as PNG files in its folder."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm

from thincam_jax import waveguide as wg
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.screen.build import Setup
from thincam_jax.commands.study.figures import drawing, line_style, save_figure, save_image
from thincam_jax.units import nm

# Centres, widths below and above (nm) and heights of lobes whose sums are the CIE 1931 matching
# functions x, y, z to about 1 % (Wyman, Sloan and Shirley, JCGT 2(2), 2013).
_LOBES = (
    ((599.8, 37.9, 31.0, 1.056), (442.0, 16.0, 26.7, 0.362), (501.1, 20.4, 26.2, -0.065)),
    ((568.8, 46.9, 40.5, 0.821), (530.9, 16.3, 31.1, 0.286)),
    ((437.0, 11.8, 36.0, 1.217), (459.0, 26.0, 13.8, 0.681)),
)
_TO_SRGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


def srgb(wavelength: np.ndarray) -> np.ndarray:
    """Linear sRGB (…, 3) of spectral light, mm, within the gamut, its brightest part 1."""
    light = np.asarray(wavelength)[..., None] / nm
    tristimulus = []
    for lobes in _LOBES:
        peak, low, high, height = np.array(lobes).T
        width = np.where(light < peak, low, high)
        tristimulus.append(np.sum(height * np.exp(-(((light - peak) / width) ** 2) / 2), axis=-1))
    linear = np.clip(np.stack(tristimulus, axis=-1) @ np.array(_TO_SRGB).T, 0, None)
    return linear / np.maximum(linear.max(axis=-1, keepdims=True), 1e-9)


def in_colour(capture: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    """A capture as an eye would see it on the sensor, turned upright: sRGB with its gamma.

    Of channels (channel, y, x), each in its own light, the sum.
    """
    level = np.clip(capture / np.percentile(capture, 99.8), 0, 1)[..., None]
    linear = level * srgb(wavelength)
    linear = np.clip(linear.sum(axis=0), 0, 1) if linear.ndim == 4 else linear
    encoded = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return encoded[::-1, ::-1]


def save_rays(folder: RunFolder, setup: Setup) -> None:
    """Side view: rays of three pixels from the sensor through the plate to its front."""
    camera, screen = setup.camera, setup.camera.screen
    half = 0.43 * camera.sensor.shape[0] * float(camera.sensor.pitch)
    pixels = np.array([[0.0, -half], [0.0, 0.0], [0.0, half]])
    rays = wg.trace(camera, jnp.asarray(pixels), setup.plane.distance, setup.config.orders)
    d0, d1 = float(camera.focal_distance), float(camera.lens_distance)
    width, start = float(screen.glass_thickness), d0 + d1
    slopes = -pixels[:, 1] / d0
    sines = slopes / np.hypot(1, slopes)
    index = np.asarray(screen.glass_index(rays.wavelength))
    crossing = width * sines / np.sqrt(index**2 - sines**2)
    along = np.asarray(rays.guided)
    bounce = width * along[:, 1] / np.sqrt(index**2 - np.sum(along**2, axis=-1))
    figure, ax = drawing((9.5, 4.6))
    ahead = 5 * width
    for n, (pixel, light) in enumerate(zip(pixels[:, 1], rays.wavelength, strict=True)):
        style = line_style(n + 1)
        del style["marker"]
        top = d1 * slopes[n] + crossing[n]
        path = [(0, pixel), (d0, 0), (start, d1 * slopes[n]), (start + width, top)]
        count = 2 * setup.config.orders - 1
        path += [(start + width * (m % 2), top + (m + 1) * bounce[n]) for m in range(count)]
        name = f"pixel at y = {pixel:.2g} mm: {float(light) / nm:.0f} nm"
        ax.plot(*zip(*path, strict=True), label=name, **style)
        for order in range(setup.config.orders):
            bottom = top + (2 * order + 1) * bounce[n]
            out = bottom + crossing[n]
            line = [(start, bottom), (start + width, out)]
            line.append((start + width + ahead, out + ahead * slopes[n]))
            ax.plot(*zip(*line, strict=True), linewidth=0.8, **style)
    ax.axvspan(start, start + width, color="0.9")
    ax.axvline(d0, color="0.6", linewidth=4, label="lens")
    ax.set(xlabel="z from the sensor (mm)", ylabel="y, down the screen (mm)")
    ax.set_xlim(0, start + width + ahead)
    ax.invert_yaxis()
    ax.legend(loc="lower left", fontsize=9)
    save_figure(folder, "rays", figure)


def save_field(folder: RunFolder, setup: Setup, rays: wg.Rays) -> None:
    """Colour and ghost shift of every pixel, in false grey with contours, and as an eye sees it."""
    rows, columns = setup.camera.sensor.shape
    pitch = float(setup.camera.sensor.pitch)
    x, y = columns * pitch / 2, rows * pitch / 2
    light = np.asarray(rays.wavelength)
    maps = [(light / nm, "Bragg wavelength (nm)")]
    if setup.config.orders > 1:
        shift = np.asarray(rays.points[1] - rays.points[0])
        maps.append((shift[..., 1], "first ghost: seen further down (mm)"))
        maps.append((shift[..., 0], "first ghost: seen further right (mm)"))
    figure, axes = drawing((3.1 * (len(maps) + 1), 3.9), 1, len(maps) + 1)
    for ax, (values, label) in zip(axes, maps, strict=False):
        drawn = ax.imshow(values, cmap="gray", extent=(-x, x, y, -y))
        lines = ax.contour(values, levels=6, colors="#d08020", extent=(-x, x, -y, y))
        ax.clabel(lines, fontsize=8)
        figure.colorbar(drawn, ax=ax, label=label, location="bottom")
    encoded = in_colour(np.ones_like(light), light)[::-1, ::-1]
    axes[-1].imshow(encoded, extent=(-x, x, y, -y))
    axes[-1].set_title("a white object's colours", fontsize=10)
    for ax in axes:
        ax.set_xlabel("x on the sensor (mm)", fontsize=9)
    axes[0].set_ylabel("y on the sensor (mm)", fontsize=9)
    save_figure(folder, "field", figure)


def save_images(
    folder: RunFolder,
    setup: Setup,
    captures: np.ndarray,
    wavelength: np.ndarray,
    found: dict[tuple[str, str], np.ndarray],
    scores: dict[tuple[str, str], list[float]],
) -> None:
    """Targets, captures and what comes back: with the first model by all methods, and by the last
    method with all models; `found` and `scores` are by model and method."""
    config = setup.config
    first, last = config.models[0].name, config.methods[-1].name
    right = [(method.name, (first, method.name)) for method in config.methods]
    wrong = [(model, (model, method)) for model, method in found if method == last]
    for name, panels in (("images", right), ("models", wrong)):
        shown = 2 if name == "images" else 1
        size = (1.75 * (len(panels) + shown), 1.95 * len(setup.targets))
        figure, rows = drawing(size, len(setup.targets), len(panels) + shown, squeeze=False)
        for number, (target, axes) in enumerate(zip(setup.targets, rows, strict=True)):
            _panel(axes[0], setup.targets[target], target, "" if number else "target")
            if shown == 2:
                colour = in_colour(captures[number], wavelength)
                _panel(axes[1], colour, "", "" if number else "capture, turned")
            for ax, (title, key) in zip(axes[shown:], panels, strict=True):
                label = f"{scores[key][number]:.1f} dB"
                _panel(ax, found[key][number], label, "" if number else title)
        save_figure(folder, name, figure)
    for number, target in enumerate(setup.targets):
        for title, key in right:
            save_image(folder, f"{slug(target)}--{slug(title)}", found[key][number])


def _panel(ax: Axes, image: np.ndarray, label: str, title: str) -> None:
    ax.imshow(np.clip(image, 0, 1), cmap="gray", vmin=0, vmax=1)
    ax.set(xticks=[], yticks=[])
    ax.set_xlabel(label, fontsize=9)
    ax.set_title(title, fontsize=9)


def save_errors(
    folder: RunFolder, setup: Setup, scores: dict[tuple[str, str], list[float]]
) -> None:
    """PSNR of every target by the last method with each model."""
    figure, ax = drawing((9, 3.8))
    last = [key for key in scores if key[1] == setup.config.methods[-1].name]
    for index, key in enumerate(last):
        ax.plot(list(setup.targets), scores[key], label=key[0], **line_style(index))
    ax.set(ylabel="PSNR (dB)", xlabel="target")
    ax.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=9)
    save_figure(folder, "errors", figure)


def save_columns(
    folder: RunFolder,
    pitch: float,
    cells: list[tuple[int, int]],
    images: Mapping[str, np.ndarray],
) -> None:
    """What the sensor sees of some cells (row, column) alone, in counts; images (cell, y, x).

    The grey goes as the square root, so that ghosts are seen beside the image.
    """
    y, x = (n * pitch / 2 for n in next(iter(images.values())).shape[1:])
    most = max(stack.max() for stack in images.values())
    size, count = (3.0 * len(cells) + 1, 3.0 * len(images)), (len(images), len(cells))
    figure, grid = drawing(size, *count, sharex=True, sharey=True, squeeze=False)
    for line, (name, stack) in zip(grid, images.items(), strict=True):
        for (row, column), ax, image in zip(cells, line, stack, strict=True):
            norm = PowerNorm(0.5, 0, most)
            ax.imshow(image, cmap="gray_r", norm=norm, extent=(-x, x, y, -y))
            ax.set_title(f"cell ({row}, {column}), {name}", fontsize=10)
        line[0].set_ylabel("y on the sensor (mm)")
    for ax in grid[-1]:
        ax.set_xlabel("x on the sensor (mm)")
    figure.colorbar(grid[0, 0].images[0], ax=grid, label="counts for a white cell")
    save_figure(folder, "columns", figure)


def save_distances(
    folder: RunFolder,
    setup: Setup,
    images: dict[str, dict[str, np.ndarray]],
    scores: dict[str, dict[str, dict]],
) -> None:
    """One target at other distances, by each matrix, in grey with its PSNR."""
    asked = setup.config.targets
    number = next((n for n, target in enumerate(asked) if not target.binary), 0)
    target = asked[number].name
    ways = list(next(iter(images.values())))
    rows, columns = len(images), len(ways) + 1
    figure, grid = drawing((2.1 * columns, 2.4 * rows), rows, columns, squeeze=False)
    for row, ((distance, found), line) in enumerate(zip(images.items(), grid, strict=True)):
        _panel(line[0], setup.targets[target], target, "" if row else "target")
        line[0].set_ylabel(f"object at {distance}")
        for name, ax in zip(ways, line[1:], strict=True):
            score = scores[distance][name]["targets"][target]
            label = "" if score is None else f"{score:.1f} dB"
            _panel(ax, found[name][number], label, "" if row else name)
    save_figure(folder, "distances", figure)
