"""Where the public functions take a random key, they take its seed too."""

import importlib
import inspect

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

import thincam_jax as tc
from thincam_jax.design import contour_target
from thincam_jax.units import um

FACES = (
    *("design", "learn", "lensless", "measured", "reconstruction", "studies", "waveguide"),
    *("imaging.operators", "imaging.targets", "measured.calibration", "reconstruction.depth"),
)
# Called by the package with keys that it draws, or inside jit.
WITHIN = {"linear_objective", "match_objective", "restored_objective", "drawn_error"}
WITHIN |= {"FrontSearch", "Suggester", "Training", "TrainingDescents", "adjoint_error"}


def test_seeds_are_taken():
    faces = [tc, *(importlib.import_module(f"thincam_jax.{name}") for name in FACES)]
    public = {name: getattr(face, name) for face in faces for name in dir(face) if name[0] != "_"}
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
