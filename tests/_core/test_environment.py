"""What a bug report needs to know: the truth about this installation."""

import platform
from importlib import metadata

import jax
import numpy as np
import pytest

from thincam_jax._core import environment as installation


def test_environment_is_that_of_this_process():
    found = installation.environment(12.345)
    assert found["python"] == platform.python_version()
    assert found["seconds"] == 12.3
    assert found["precision"] == "float64"
    assert found["devices"] == [str(device) for device in jax.devices()]
    assert found["versions"]["jax"] == jax.__version__
    assert found["versions"]["pydantic"] == metadata.version("pydantic")
    assert installation.environment()["seconds"] is None


def test_package_that_is_not_installed(monkeypatch):
    monkeypatch.setattr(installation, "PACKAGES", ("jax", "no-such-package-at-all"))
    assert installation.environment()["versions"]["no-such-package-at-all"] is None
    assert list(installation.installed(["pytest", "no-such-package-at-all"])) == ["pytest"]


def test_every_extra_for_users_is_told():
    """Those of pyproject.toml, but for the tools of developers."""
    extras = set(metadata.metadata("thincam_jax").get_all("Provides-Extra") or ())
    assert extras - {"test", "dev", "docs", "bench", "pylablib"} == set(installation.EXTRAS)


def test_precisions_with_and_without_float64():
    assert installation.dtype_support() == dict.fromkeys(
        ("float32", "complex64", "float64", "complex128"), "yes"
    )
    with jax.enable_x64(False):
        support = installation.dtype_support()
    assert support["float32"] == support["complex64"] == "yes"
    assert support["float64"] == support["complex128"] == "off; set JAX_ENABLE_X64=1"


def test_precision_that_the_device_refuses(monkeypatch):
    def refuse(_):
        raise RuntimeError("not on this device")

    monkeypatch.setattr(installation.jnp.fft, "fft", refuse)
    assert installation.dtype_support()["float32"] == "no (RuntimeError)"


def test_compiler_that_adds_up_wrong_is_told(monkeypatch):
    """As jaxlib 0.10.2 does."""
    assert installation.compiled_sums() == "right"
    mean = installation._of_channels

    def compiled_wrong(response, capture, noise):
        right = mean(response, capture, noise)
        return right if isinstance(response, np.ndarray) else 1.001 * right

    monkeypatch.setattr(installation, "_of_channels", compiled_wrong)
    assert installation.compiled_sums().startswith("WRONG; install another jaxlib")


@pytest.mark.parametrize("name", ["jax", "equinox", "numpy", "scikit-image", "thincam_jax"])
def test_versions_name_what_a_result_depends_on(name):
    assert name in installation.environment()["versions"]
