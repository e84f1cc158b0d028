"""The design file of an own sensor."""

import re

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.design.own_sensor import beta_bounds
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.units import parse_quantity


def with_sensor(text: str, shape: str, pitch: str) -> str:
    """The file for a sensor, "1500x2000" and "3.45 um", masks as wide as its shorter side.

    **Errors**: ConfigError for anything else.
    """
    sides = re.fullmatch(r"\s*(\d+)\s*[x×]\s*(\d+)\s*", shape)
    if sides is None:
        raise ConfigError(f"--sensor {shape!r}: give rows and columns, as --sensor 1500x2000")
    try:
        length = parse_quantity(pitch, "length")
        sensor = Sensor((int(sides[1]), int(sides[2])), length)
    except ValueError as error:
        raise ConfigError(f"--sensor {shape} --pitch {pitch!r}: {error}") from None
    width = min(sensor.shape) * length
    low, high = beta_bounds(length, width)
    for found, given in (
        (r"(?<=\n  shape: ).*", str(list(sensor.shape))),
        (r"(?<=\n  pitch: ).*", pitch),
        (r"(?<=\n  width: )[\d.]+ mm", f"{width:.6g} mm"),  # of the mask, the first
        (r"(?<=variable: beta, bounds: )\[.*?\]", f"[{low:.4g} rad/mm^2, {high:.4g} rad/mm^2]"),
    ):
        text = re.sub(found, given, text, count=1)
    return text
