"""With `jax_numpy_rank_promotion="raise"`, which strict users set for their own arrays."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import ROOT
from thincam_jax._core.arguments import any_rank, checked
from thincam_jax._core.module import Module
from thincam_jax.units import nm, um


@pytest.fixture
def strict():
    with jax.numpy_rank_promotion("raise"):
        yield
        with pytest.raises(ValueError, match="rank_promotion"):  # still, for others
            jnp.ones((2, 3)) + jnp.ones(3)


def promoted(size: int):
    return jnp.ones((2, size)) + jnp.ones(size)


class Promoting(Module):
    def __call__(self):
        return promoted(3)

    def twice(self):
        return 2 * promoted(3)


def test_functions_and_methods(strict):
    with pytest.raises(ValueError, match="rank_promotion"):
        promoted(3)
    for function in (lambda: checked(promoted)(3), lambda: any_rank(promoted)(3)):
        assert function().shape == (2, 3)
    assert Promoting()().shape == (2, 3)
    assert eqx.filter_jit(Promoting().twice)().sum() == 24


def camera(beta):
    mask = tc.FresnelZoneAperture(beta=beta, phase=0.0, width=2.0)
    return tc.LenslessCamera(mask, tc.Sensor((12, 16), 150 * um), distance=6.5)


def light(beta):
    return tc.psf(
        camera(beta), wavelength=500 * nm, object_distance=250.0, pixel_integration=False
    ).sum()


def test_psfs_and_their_gradients(strict):
    assert np.isfinite(jax.jit(jax.grad(light))(25.0))


@pytest.mark.thorough
def test_examples_of_all_public_names():
    """Each docstring's, in a process of its own with the variable of the environment."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["tests/test_docstrings.py", "-m", "thorough or not thorough"]
    env = {**os.environ, "JAX_NUMPY_RANK_PROMOTION": "raise"}
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-2000:]
