"""Pictures that an aligned monitor showed, and their captures, as a data set in two folders."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Float

from thincam_jax._core.files import write_whole
from thincam_jax._core.grids import Grid, same_parity
from thincam_jax._core.text import slug
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.studies.images import square_field
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.measured import write_image
from thincam_jax.measured.layouts import CARD, TRUTHS
from thincam_jax.studies.evaluate import sample
from thincam_jax.studies.study import Study, Target

_TEXT = """
{count} pictures on a monitor before a lensless camera, and the mean of the frames of each, without
the dark ones. `psf.tif` is that of the camera's model. Truths are light, on the pixels of the
capture that the front matter names; captures are turned by 180°.
"""


def write_pairs(
    folder: Path, study: Study, taken: Acquisition, width: float, licence: str, held_out: int = 0
) -> dict[str, int | list[int]]:
    """Write captures/, truths/, psf.tif and a card, which `open_pairs` reads; returns their sizes.

    - `study`: cameras of the frames; its targets are the pictures, in the order of their frames.
    - `width`: width of the object that the pictures cover, mm.
    - `held_out`: number of the last pictures, which are in test/, the others in train/; 0: none.
    """
    rows, columns = taken.sensor_shape
    field = same_parity(square_field(study, width), taken.sensor_shape)
    grid = object_grid(study, field)
    trained_on = len(study.targets) - held_out
    for number, (target, (_, mean)) in enumerate(zip(study.targets, taken.means(), strict=True)):
        split = folder / ("train" if number < trained_on else "test") if held_out else folder
        for name, image in (("captures", mean), ("truths", truth(target, grid))):
            (split / name).mkdir(parents=True, exist_ok=True)
            write_image(split / name / f"{slug(target.name)}.tif", image[None])
    # The middle of a measured PSF is its pixel n // 2: an odd number has it on the axis.
    wide = Sensor((rows + 1 - rows % 2, columns + 1 - columns % 2), study.pitch)
    psf = np.asarray(replace(study, sensor=wide).psf(study.methods[0].exposures[0]), np.float32)
    write_image(folder / "psf.tif", psf[None, :rows, :columns])
    spans = [[(n - m) // 2, (n + m) // 2] for n, m in zip((rows, columns), field, strict=True)]
    stated = {TRUTHS: {"rows": spans[0], "columns": spans[1], "turned": True}}
    head = yaml.safe_dump({"license": licence, **stated}, sort_keys=False)
    text = _TEXT.format(count=len(study.targets))
    write_whole(folder / CARD, f"---\n{head}---\n{text}")
    return {"pairs": len(study.targets), "capture": [rows, columns], "truth": list(field)}


def object_grid(study: Study, field: tuple[int, int]) -> Grid:
    """Pixels of the sensor on the object."""
    ratio = study.object_distance / study.methods[0].distance
    return Grid(field, jnp.asarray(study.pitch * ratio))


def truth(target: Target, grid: Grid) -> Float[np.ndarray, "y x"]:
    """Light of a picture on pixels of the object."""
    return np.asarray(sample(target.plane, grid), np.float32)[0]
