"""What every public function keeps: keys may be seeds, and results are records."""

import dataclasses
import importlib
import inspect
import re
from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

import thincam_jax as tc
from thincam_jax.design.phase_retrieval import contour_target
from thincam_jax.units import um

FACES = (
    *("design", "hardware", "learn", "lensless", "measured", "plot", "reconstruction", "studies"),
    *("imaging.operators", "imaging.targets", "lensless.masks", "waveguide"),
    *("measured.calibration", "reconstruction.depth"),
)
# Modules of which scripts and tests call functions by their path.
MODULES = (
    *("design.end_to_end", "design.fronts", "design.match"),
    *("design.objectives", "design.phase_mask", "design.phase_retrieval"),
    *("waveguide.design.plate", "design.ranking", "design.sensitivity"),
    *("design.training", "learn.refocusing.network", "learn.refocusing.train"),
    "lensless.masks.phase",
    *("waveguide.measured.screen_fit", "measured.exposures", "measured.sensor"),
    *("reconstruction.depth.find", "reconstruction.problem"),
    *("studies.evaluate", "studies.prepared", "hardware.studies.images", "waveguide.distance"),
    *("studies.result", "studies.study", "waveguide.colours"),
    *("waveguide.rays", "waveguide.screen_to_sensor"),
)
# Called by the package with keys that it draws, or inside jit.
WITHIN = {"draw_batch", "linear_objective", "match_objective", "restored_objective"}
WITHIN |= {"FrontSearch", "Training", "TrainingDescents", "adjoint_error"}


def faces() -> dict[str, object]:
    modules = [tc, *(importlib.import_module(f"thincam_jax.{name}") for name in FACES)]
    found = {name: getattr(face, name) for face in modules for name in dir(face) if name[0] != "_"}
    for module in (importlib.import_module(f"thincam_jax.{name}") for name in MODULES):
        own = {n: one for n, one in vars(module).items() if n[0] != "_"}
        found |= {n: o for n, o in own.items() if getattr(o, "__module__", "") == module.__name__}
    return found


def results(one: object) -> Iterator[tuple[str, object]]:
    """What a function returns; a class's fields, and what its methods and properties return."""
    if inspect.isfunction(unwrapped := inspect.unwrap(one)):
        yield "", unwrapped.__annotations__.get("return")
    if inspect.isclass(one) and one.__module__.startswith("thincam_jax"):
        if dataclasses.is_dataclass(one):
            yield from ((field.name, field.type) for field in dataclasses.fields(one))
        for name, part in vars(one).items():
            part = getattr(part, "__func__", getattr(part, "fget", None) or part)
            part = getattr(part, "func", part)  # of a cached property
            if name[0] != "_" and inspect.isfunction(part):
                yield name, inspect.unwrap(part).__annotations__.get("return")


def test_results_are_records():
    """Dictionaries of whatever would have to be looked up in the source."""
    found = [
        (name, part, str(kind))
        for name, one in faces().items()
        for part, kind in results(one)
        if kind is not None
    ]
    assert len(found) > 1000
    assert not [one for one in found if re.search(r"(dict|Mapping)\[str, (typing\.)?Any\]", one[2])]


def test_seeds_are_taken():
    public = faces()
    keys = {
        name: inspect.signature(one).parameters["key"].annotation
        for name, one in public.items()
        if inspect.isfunction(inspect.unwrap(one)) and "key" in inspect.signature(one).parameters
    }
    assert len(keys) > 12
    assert not {n for n, kind in keys.items() if kind == PRNGKeyArray} - WITHIN


def test_a_seed_is_the_key_of_it():
    drawn = [
        contour_target(key, tc.Grid((24, 20), 4 * um), feature=40 * um, line_width=8 * um)
        for key in (3, jax.random.key(3), 4)
    ]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
