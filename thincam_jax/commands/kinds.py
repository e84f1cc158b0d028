"""The kinds of experiment files that `thincam run` takes."""

from pathlib import Path

from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.config_file import ConfigError, read_raw
from thincam_jax.commands.masks.config import MasksConfig
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.screen.config import ScreenConfig
from thincam_jax.commands.study.config import StudyConfig, load_config

Experiment = StudyConfig | RefocusConfig | ScreenConfig | MasksConfig


def load_experiment(path: str | Path, overrides: tuple[str, ...] = ()) -> Experiment:
    """Read and check an experiment file of any kind; errors as of `load_as`."""
    kind = read_raw(Path(path))[0].get("kind")
    if kind is None:
        return load_config(path, overrides)
    if kind in ("design", "screen_design"):
        raise ConfigError(f"{path}: kind: is a design; give it to 'thincam design'")
    if kind == "capture":
        raise ConfigError(f"{path}: kind: is a capture; give it to 'thincam capture'")
    if kind == "learned":
        raise ConfigError(f"{path}: kind: is a network; give it to 'thincam train'")
    if kind == "refocus":
        return load_as(RefocusConfig, path, overrides, "objects")
    if kind == "screen":
        return load_as(ScreenConfig, path, overrides)
    if kind == "masks":
        return load_as(MasksConfig, path, overrides, "scenes")
    raise ConfigError(
        f"{path}: kind: {kind!r} is unknown; write 'kind: refocus', 'kind: screen' or 'kind: "
        "masks', or leave it out for a study"
    )
