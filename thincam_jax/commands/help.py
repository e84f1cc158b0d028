"""How help is laid out: commands by importance, options by what they are about, examples.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from typing import Any

from typer.core import TyperCommand, TyperGroup

ORDER = (
    *("init", "explain", "run", "capture", "reconstruct", "calibrate", "sweep", "design", "train"),
    *("bench", "schema", "doctor"),
)
# Of `thincam reconstruct`; what is in none stands first.
GROUPS = {
    "Calibration": (
        *("background", "psf_background", "dead", "bits", "psf_bits", "saturation", "noise"),
    ),
    "Preparation": (
        *("downsample", "bayer", "demosaic", "noise_threshold", "psf_channels", "psf_scale"),
        "corner",
    ),
    "Reconstruction": ("method", "tau", "ridge", "iterations", "coupling"),
    "Image": ("field", "flip", "linear", "gamma", "white_balance"),
}


def examples_text(*lines: str) -> str:
    """The end of a help text, its lines kept as they are."""
    return "\n".join(["\b", "Examples:", *(f"  thincam {line}" for line in lines)])


class InOrder(TyperGroup):
    """Commands in the order in which a user needs them; one that is not listed comes last."""

    def list_commands(self, ctx: Any) -> list[str]:
        known = {name: place for place, name in enumerate(ORDER)}
        return sorted(super().list_commands(ctx), key=lambda name: known.get(name, len(known)))


class Grouped(TyperCommand):
    """Options in groups."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        group_of = {name: group for group, names in GROUPS.items() for name in names}
        rows: dict[str, list] = {"Options": [], **{group: [] for group in GROUPS}}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                rows[group_of.get(parameter.name or "", "Options")].append(record)
        for group, records in rows.items():
            with formatter.section(group):
                formatter.write_dl(records)
