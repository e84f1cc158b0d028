"""Pictures of a run, as PNG files in its folder."""

import io

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.commands.config_file import slug
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.imaging.display import png_bytes
from thincam_jax.plot import studies as plot
from thincam_jax.plot.cameras import draw_psf
from thincam_jax.plot.studies import drawing as drawing
from thincam_jax.plot.studies import line_style as line_style
from thincam_jax.plot.studies import sheet as sheet
from thincam_jax.studies.evaluate import Evaluation
from thincam_jax.studies.study import Study, Target


def as_png(figure: Figure) -> bytes:
    """The file's content."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def save_figure(folder: RunFolder, name: str, figure: Figure) -> None:
    """A figure as figures/NAME.png."""
    folder.write(f"figures/{name}.png", as_png(figure))


def save_image(folder: RunFolder, name: str, image: np.ndarray) -> None:
    """An image of values 0…1 as an 8-bit PNG."""
    pixels = np.round(np.clip(image, 0.0, 1.0) * 255).astype(np.uint8)
    folder.write(f"images/{name}.png", png_bytes(pixels))


def save_images(folder: RunFolder, target: Target, evaluations: dict[str, Evaluation]) -> None:
    """A target's scene and all reconstructions of it."""
    save_image(folder, f"{slug(target.name)}--scene", plot.truth_of(evaluations))
    for name, evaluation in evaluations.items():
        save_image(folder, f"{slug(target.name)}--{slug(name)}", evaluation.image)


def save_psf(folder: RunFolder, study: Study) -> None:
    """The first exposure's PSF: the image, and a line through its middle."""
    exposure = study.exposures[0]
    h = np.asarray(study.psf(exposure))
    grid = study.camera(exposure).sensor.grid
    figure = Figure(figsize=(8.5, 3.4), layout="constrained")
    draw_psf(figure, h, grid, f"{study.mask_of(exposure)}, d = {exposure.distance:g} mm")
    save_figure(folder, "psf", figure)
