"""The commands `thincam schema` and `thincam explain`: what a file may hold, and what one comes to.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from collections.abc import Iterator
from typing import Annotated, Any

import typer

from thincam_jax._core.text import spelled
from thincam_jax.commands.kinds import KINDS, kind_of, load_experiment
from thincam_jax.commands.terminal import ConfigFile, Overrides, reported, say, say_result


def schema(
    kind: Annotated[
        str, typer.Argument(help=f"One of {', '.join(KINDS)}.", autocompletion=lambda: list(KINDS))
    ],
) -> None:
    """Print the JSON Schema of a kind of experiment file, with which editors complete and check."""
    with reported(lambda: "interrupted"):
        import json

        from thincam_jax.commands.config_file import ConfigError

        if kind not in KINDS:
            raise ConfigError(f"kind: {kind!r} is unknown; choose one of {', '.join(KINDS)}")
        form = KINDS[kind].part(KINDS[kind].section).model_json_schema()
    say(json.dumps(form, indent=2))


def explain(config: ConfigFile, set_: Overrides = None) -> None:
    """Print every value of an experiment file with its unit and where it comes from.

    Also what a run computes: error, memory and operations of PSFs, rays of a screen, evaluations of
    a search, frames of a capture, steps of a training.
    """
    with reported(lambda: "interrupted"):
        asked = load_experiment(config, tuple(set_ or ()), command=None)
        rows = list(values(asked))
        width = max(len(f"{key}: {value}") for key, value, _ in rows if len(value) <= _LONGEST)
        lines = [f"{f'{key}: {value}':<{width}}  # {place}" for key, value, place in rows]
        costly = list(costs(asked))
        result = {"values": {key: value for key, value, _ in rows}, "costs": costly}
        say_result("experiment", result, "\n".join([*lines, *costly]))


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
        inside = value if isinstance(value, list) else ()
        if isinstance(value, dict) or any(isinstance(one, (dict, list)) for one in inside):
            yield from _entries(value, (*location, key))
        else:
            text = (
                f"[{', '.join(map(spelled, value))}]" if isinstance(value, list) else spelled(value)
            )
            yield (*location, key), text


def dry_run(asked: Any, writes: str, setup: Any = None) -> None:
    """Print what a command would compute and write, for its option `--dry-run`.

    The names of each list of the file, and the costs.
    """
    lines = []
    for key, entries in asked:
        if entries and isinstance(entries, tuple) and all(hasattr(e, "name") for e in entries):
            lines.append(f"{len(entries)} {key}: {'; '.join(entry.name for entry in entries)}")
    lines += [*costs(asked, setup), writes, "dry run: nothing was done"]
    say_result("dry_run", lines, "\n".join(lines))


def costs(asked: Any, setup: Any = None) -> Iterator[str]:
    """Work of a file's run, in numbers; `setup`: objects built of it, where they are."""
    kind = kind_of(asked)
    return kind.part(kind.costs)(asked, setup)


def psfs(asked: Any, setup: Any) -> Iterator[str]:
    """PSFs of a study."""
    from thincam_jax.commands.study.build import assemble

    study = assemble(asked) if setup is None else getattr(setup, "study", setup)
    cameras = [(study.camera(e), e, study.mask_of(e)) for e in study.exposures]
    return _psfs(asked, cameras, study.object_distance)


def _psfs(asked: Any, cameras: list[Any], object_distance: float) -> Iterator[str]:
    """A line for each PSF of (camera, exposure, words): model, predicted error, memory, work."""
    from thincam_jax._core.memory import readable
    from thincam_jax.lensless.accuracy.select import predict_cost

    how = {"model": asked.model, "pixel_integration": asked.pixel_integration}
    alike = {
        (e.beta, e.distance, e.wavelength, e.width): one for one in cameras[::-1] for e in one[1:2]
    }
    for camera, exposure, words in [*alike.values()][::-1]:
        seen = {"wavelength": exposure.wavelength, "object_distance": object_distance}
        cost, error = predict_cost(camera, **seen, **how)
        predicted = "" if error is None else f", predicted error {error:.1g}"
        yield (
            f"PSF at {exposure.distance:g} mm of {words}: {asked.model}{predicted}, "
            f"{readable(cost.bytes)}, {cost.flops / 1e9:.2g} billion operations"
        )


def rays(asked: Any, setup: Any) -> Iterator[str]:
    """Rays of a see-through camera, and entries of its matrix."""
    from thincam_jax._core.memory import readable
    from thincam_jax.commands.screen.run import build_cameras, build_plane
    from thincam_jax.waveguide.system import entries_of_a_ray

    (rows, columns), parts = asked.sensor.shape, asked.band_samples or 1
    if getattr(asked, "mask", None) is not None:
        size = rows * columns * asked.object.cells[0] * asked.object.cells[1]
        yield f"matrix of each model: {size / 1e6:.3g} million entries, {readable(4 * size)}"
        return
    cameras = build_cameras(asked) if setup is None else setup.cameras
    plane = build_plane(asked) if setup is None else setup.plane
    traced = rows * columns * asked.orders * parts * len(cameras)
    entries = traced * entries_of_a_ray(cameras[0], plane)
    yield (
        f"matrix of each model: {rows}×{columns} pixels, {asked.orders} orders, {parts} parts of "
        f"the band: {traced / 1e6:.3g} million rays, at most {entries / 1e6:.3g} million entries, "
        f"{readable(12 * entries)}"  # a number and two indices, four bytes each
    )


def search(asked: Any, setup: Any) -> Iterator[str]:
    """PSFs of the design to beat, and evaluations of a design's search."""
    asks, shots = asked.search, asked.reference.shots
    exposures = asked.design(asked.reference).exposures
    cameras = exposures.cameras(asked.sensor.build(), asked.mask.build(beta=1.0))
    words = (f"β {exposure.beta:g} rad/mm²" for exposure in exposures)
    found = list(zip(cameras, exposures, words, strict=True))
    yield from _psfs(asked, found, asked.object.distance)
    finely = asks.frequencies
    most = asks.samples + asks.starts * asks.steps
    yield (
        f"search: {asks.samples} samples, {asks.starts} descents of at most {asks.steps} "
        f"steps: at most {most} evaluations and their gradients at {finely.radii}×"
        f"{finely.directions} frequencies of {len(shots)} shots"
    )
    again = asked.validation
    yield (
        f"validation: {again.best} found designs, the design to beat and {len(asked.compare)} "
        f"others, on {len(asked.targets)} targets, noise of {again.seeds} seeds"
    )


def frames(asked: Any, setup: Any) -> Iterator[str]:
    """Frames of a capture, and the time that they are exposed."""
    from thincam_jax.commands.capture.command import build_plan

    plan = build_plan(asked) if setup is None else setup
    seconds = sum(plan.settings[step.settings].exposure for step in plan.steps)
    yield f"{len(plan.steps)} frames, exposed for {seconds:.3g} s in all"


def lessons(asked: Any, setup: Any) -> Iterator[str]:
    """Steps and checks of a training."""
    training = asked.training
    checks = training.steps // training.check_every
    yield (
        f"training: {training.steps} steps of {training.batch} examples, {checks} checks on "
        f"{training.judged} batches"
    )
