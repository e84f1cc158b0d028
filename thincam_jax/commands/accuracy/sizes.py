"""The same camera with fewer and larger pixels."""

import dataclasses

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import SensorConfig
from thincam_jax.commands.study.study import Study

DEFAULT_SIZES = (128, 256, 512)  # pixels along the longer side
DEFAULT_CAPTURE_SIZE = 256


def own_size(sensor: SensorConfig) -> int:
    """Pixels along the longer side of the study's own sensor."""
    return max(sensor.shape)


def sizes_of(sensor: SensorConfig, asked: tuple[int, ...]) -> tuple[int, ...]:
    """The sizes asked for, or the default ones and the study's own; each once, smallest first.

    **Errors**: ConfigError for a size that is not positive or above the study's own.
    """
    for size in asked:
        _check("--size", size, own_size(sensor))
    own = own_size(sensor)
    wanted = asked or (*(s for s in DEFAULT_SIZES if s < own), own)
    return tuple(sorted(set(wanted)))


def capture_size_of(sensor: SensorConfig, asked: int | None) -> int:
    """The size for captures and reconstructions; errors as for `sizes_of`."""
    if asked is None:
        return min(DEFAULT_CAPTURE_SIZE, own_size(sensor))
    _check("--capture-size", asked, own_size(sensor))
    return asked


def binned(study: Study, size: int) -> Study:
    """The study with its pixels binned so that the sensor's longer side has `size` of them.

    The pitch grows by the same ratio, so that the sensor keeps its area: along the longer side
    exactly, along the shorter one to half a pixel. The mask stays as it is.
    """
    ratio = own_size(study.sensor) / size
    rows, columns = (max(1, round(n / ratio)) for n in study.sensor.shape)
    sensor = study.sensor.model_copy(
        update={"shape": (rows, columns), "pitch": study.sensor.pitch * ratio}
    )
    return dataclasses.replace(study, sensor=sensor, reconstructors={})


def _check(option: str, size: int, own: int) -> None:
    if size < 1:
        raise ConfigError(f"{option} {size}: give a number of pixels above zero")
    if size > own:
        raise ConfigError(
            f"{option} {size}: the study's own sensor has {own} pixels; give at most {own}"
        )
