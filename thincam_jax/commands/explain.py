"""The commands `thincam schema` and `thincam explain`: what a file may hold, and what one comes to.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from collections.abc import Iterator
from typing import Annotated, Any

import typer

from thincam_jax.commands.kinds import KINDS, load_experiment
from thincam_jax.commands.terminal import ConfigFile, Overrides, told


def schema(
    kind: Annotated[
        str, typer.Argument(help=f"One of {', '.join(KINDS)}.", autocompletion=lambda: list(KINDS))
    ],
) -> None:
    """Print the JSON Schema of a kind of experiment file, with which editors complete and check."""
    with told(lambda: "interrupted"):
        import json

        from thincam_jax.commands.config_file import ConfigError

        if kind not in KINDS:
            raise ConfigError(f"kind: {kind!r} is unknown; choose one of {', '.join(KINDS)}")
        sections = KINDS[kind].part(KINDS[kind].section)
        text = json.dumps(sections.model_json_schema(), indent=2, ensure_ascii=False)
    print(text)


def explain(config: ConfigFile, set_: Overrides = None) -> None:
    """Print every value of an experiment file with its unit and where it comes from.

    Of lensless cameras also the error and the cost of their PSFs.
    """
    with told(lambda: "interrupted"):
        asked = load_experiment(config, tuple(set_ or ()), command=None)
        rows = list(values(asked))
        width = max(len(f"{key}: {value}") for key, value, _ in rows if len(value) <= _LONGEST)
        lines = [f"{f'{key}: {value}':<{width}}  # {place}" for key, value, place in rows]
        print("\n".join([*lines, *psf_costs(asked)]))


_LONGEST = 50  # characters of a value that places are lined up behind


def values(asked: Any) -> Iterator[tuple[str, str, str]]:
    """Key, value and place of every entry of a checked file; "default" where it has none."""
    data = asked.model_dump(mode="json", exclude_none=True, by_alias=True, exclude={"notes"})
    for location, value in _entries(data):
        key = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in location)
        place = asked.place_of(*location).removesuffix(": ") if asked.gives(*location) else ""
        yield key.removeprefix("."), value, place or "default"


def _entries(data: Any, location: tuple = ()) -> Iterator[tuple[tuple, str]]:
    """Values by location; a list of values is one."""
    inner = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in inner:
        deep = isinstance(value, dict) or (
            isinstance(value, list) and any(isinstance(one, (dict, list)) for one in value)
        )
        if deep:
            yield from _entries(value, (*location, key))
        elif isinstance(value, list):
            yield (*location, key), f"[{', '.join(map(str, value))}]"
        else:
            yield (*location, key), str(value)


def work_of(asked: Any) -> Iterator[str]:
    """Lines that say what a run computes: the names of each list of the file, and its PSFs."""
    for key in type(asked).model_fields:
        entries = getattr(asked, key)
        if isinstance(entries, tuple) and all(hasattr(entry, "name") for entry in entries):
            if entries:
                yield f"{len(entries)} {key}: {'; '.join(entry.name for entry in entries)}"
    yield from psf_costs(asked)


def psf_costs(asked: Any) -> Iterator[str]:
    """A line for the PSF of each exposure of a study: model, predicted error, memory, work."""
    from thincam_jax.commands.sections import CamerasConfig

    if not isinstance(asked, CamerasConfig):
        return
    from thincam_jax._core.memory import readable
    from thincam_jax.commands.study.build import assemble
    from thincam_jax.lensless.accuracy.select import predict_error
    from thincam_jax.lensless.cost import psf_cost
    from thincam_jax.lensless.method import has_few_terms, psf_method

    study = assemble(asked, ())
    alike = {(e.beta, e.distance, e.wavelength, e.width): e for e in reversed(study.exposures)}
    for exposure in reversed(alike.values()):
        camera, error = study.camera(exposure), ""
        how = {"model": study.model, "pixel_integration": study.pixel_integration}
        if has_few_terms(camera.mask):
            seen = {"wavelength": exposure.wavelength, "object_distance": study.object_distance}
            found = predict_error(camera, **seen, **how)
            cost, error = found.cost, f", predicted error {found.predicted_error:.1g}"
        else:
            grid = camera.sensor.grid
            cost = psf_cost(camera.mask, grid, psf_method(camera.mask, grid, **how))
        yield (
            f"PSF at {exposure.distance:g} mm of {study.mask_of(exposure)}: {study.model}{error}, "
            f"{readable(cost.bytes)}, {cost.flops / 1e9:.2g} billion operations"
        )
