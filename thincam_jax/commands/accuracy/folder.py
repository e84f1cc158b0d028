"""The folder of a benchmark: its two files, and nothing of anybody else."""

import json
from pathlib import Path
from typing import Any

from thincam_jax._core.files import write_whole
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.run_folder import to_json

BENCH = "accuracy"
_FILES = ("accuracy.json", "accuracy.png")


class BenchFolder:
    """`accuracy.json` and `accuracy.png`, each written whole or not at all."""

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def claim(self, config: str) -> None:
        """Make the folder; refuse one that holds other things than results of this configuration.

        `config` is the resolved configuration as YAML. An earlier result of it is replaced.

        **Errors**: ConfigError, also where nothing can be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            foreign = [p.name for p in self.path.iterdir() if p.name not in self._own()]
            trial = self.path / "accuracy.json.partial"
            if not foreign:
                trial.write_bytes(b"")
                trial.unlink()
        except OSError as error:
            raise ConfigError(
                f"--out {self.path}: cannot be written to as a folder ({error.strerror})"
            ) from None
        if foreign or not self._is_ours():
            raise ConfigError(
                f"--out {self.path}: is not empty and holds no accuracy benchmark; "
                "give a new folder"
            )
        held = self._held()
        if held is not None and held.get("config") != config:
            raise ConfigError(
                f"--out {self.path}: holds the benchmark of another configuration; "
                "give another folder or delete this one"
            )

    def finish(self, results: dict[str, Any], figure: bytes) -> None:
        """Write both files; the table last, because it marks the benchmark as complete."""
        write_whole(self.path / "accuracy.png", figure)
        write_whole(self.path / "accuracy.json", to_json(results))

    def _own(self) -> list[str]:
        return [name + end for name in _FILES for end in ("", ".partial")]

    def _is_ours(self) -> bool:
        held = self._held()
        if held is None:  # a figure alone is of somebody else
            return not any((self.path / name).exists() for name in _FILES)
        return held.get("bench") == BENCH

    def _held(self) -> dict[str, Any] | None:
        try:
            held = json.loads((self.path / "accuracy.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return held if isinstance(held, dict) else None
