"""The kinds of experiment files that `thincam run` takes."""

from pathlib import Path

from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.config_file import COMMANDS, ConfigError, read_raw
from thincam_jax.commands.masks.config import MasksConfig
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.screen.config import ScreenConfig
from thincam_jax.commands.study.config import StudyConfig

Experiment = StudyConfig | RefocusConfig | ScreenConfig | MasksConfig


def load_experiment(path: str | Path, overrides: tuple[str, ...] = ()) -> Experiment:
    """Read and check an experiment file of any kind; errors as of `load_as`."""
    kind = read_raw(Path(path))[0].get("kind")
    if str(kind) in COMMANDS:
        command, what = COMMANDS[str(kind)]
        raise ConfigError(f"{path}: kind: is {what}; give it to 'thincam {command}'")
    models = {None: StudyConfig, "refocus": RefocusConfig, "screen": ScreenConfig}
    models |= {"masks": MasksConfig}
    if isinstance(kind, str | None) and kind in models:
        return load_as(models[kind], path, overrides)
    raise ConfigError(
        f"{path}: kind: {kind!r} is unknown; write 'kind: refocus', 'kind: screen' or 'kind: "
        "masks', or leave it out for a study"
    )
