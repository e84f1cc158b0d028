"""What an import brings with it: a fresh process pays for what it uses, and for nothing more."""

import os
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
import tifffile
from commands.study import tiny

import thincam_jax as tc
from helpers import ROOT

SLOW = ("jax", "matplotlib", "numpy", "rich", "scipy", "skimage", "yaml")


def imported_by(code: str) -> set[str]:
    """The modules of a new process after `code`, by full name."""
    return imported_in_turn(code)[0]


def imported_in_turn(*codes: str) -> list[set[str]]:
    """The modules of one new process after each of `codes`."""
    told = "\nimport sys; print('MODULES', *sys.modules)\n"
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-c", "".join(code + told for code in codes)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        timeout=120,
        check=True,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("MODULES ")]
    return [set(line.split()) for line in lines]


def test_names_wait_for_no_library_and_reconstructions_for_no_learned_part():
    """SciPy itself is there, of its parts only those that JAX's sparse matrices import."""
    alone, units, modules, of_command = imported_in_turn(
        "import thincam_jax as tc",
        "from thincam_jax.units import nm",
        "tc.psf, tc.capture, tc.plan_capture, tc.choose_model, tc.reconstruct",
        "import thincam_jax.commands.reconstruct.run",
    )
    assert alone.isdisjoint(SLOW) and units.isdisjoint(SLOW)
    assert "jax" in modules
    assert modules.isdisjoint(("matplotlib", "skimage", "jaxopt", "pydantic"))
    parts = ("fft", "ndimage", "optimize", "signal", "stats")
    assert modules.isdisjoint(f"scipy.{part}" for part in parts)
    assert "thincam_jax.commands.reconstruct.run" in of_command
    assert of_command.isdisjoint(("thincam_jax.learn", "thincam_jax.design"))


HELP = [
    *("--help", "--version", "run --help", "calibrate check --help"),
    *(
        f"{command} --help"
        for command in ("reconstruct", "sweep", "design", "doctor", "init", "capture", "train")
    ),
]


def test_imports_leave_the_accelerator_to_others():
    """A rig's process waits for hours beside those that compute.

    Documented paths are there without an import of their own.
    """
    paths = "imaging.operators.Matrix", "lensless.masks.phase.diffuser", "design.phase_mask"
    code = "import thincam_jax as tc\n" + "".join(f"tc.{path}\n" for path in paths)
    code += "from jax._src import xla_bridge\n"
    for name in ("hardware.virtual", "measured.calibration", "learn", "design", "studies"):
        code += f"import thincam_jax.{name}\n"
    imported_by(code + "assert not xla_bridge.backends_are_initialized()")


def test_help_of_a_command_waits_for_nothing():
    """One process answers them all, and has imported nothing slow after any."""
    after = imported_in_turn(*(as_command(typed) for typed in HELP))
    for typed, modules in zip(HELP, after, strict=True):
        assert "thincam_jax.commands.cli" in modules
        assert modules.isdisjoint(SLOW), typed


def as_command(typed: str) -> str:
    return f"""
import sys
sys.argv = ["thincam", *{typed.split()}]
from thincam_jax.commands.start import main
try:
    main()
except SystemExit as end:
    assert not end.code"""


def test_every_name_of_the_package_is_there():
    assert "LenslessCamera" in dir(tc)
    for name in dir(tc):
        assert getattr(tc, name) is not None


@pytest.mark.thorough
def test_the_core_runs_without_any_extra(tmp_path):
    """A study from a file to its report, a TIFF, and the line that names the extra for another."""
    extras = (
        "anywidget",
        "dask",
        "distributed",
        "gdstk",
        "h5py",
        "imagecodecs",
        "pyarrow",
        "rawpy",
        "serial",
    )
    extras += ("starlette", "uvicorn", "zarr", "deepinv", "torch", "scico")
    file, tiff = tiny.write(tmp_path), tmp_path / "a.tif"
    tifffile.imwrite(tiff, np.ones((6, 8), np.uint8), compression="lzw")
    modules = imported_by(
        f"import sys; sys.modules |= dict.fromkeys({extras})\n"
        + as_command(f"run {file} --out {tmp_path / 'out'}")
        + f"""
from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.measured import read_image
try:
    read_image({str(tiff)!r})
except CaptureFileError as error:
    assert "pip install 'thincam_jax[codecs]'" in str(error), error
else:
    raise AssertionError("LZW was read")
"""
    )
    assert (tmp_path / "out/report.html").exists() and "scipy" in modules


def test_a_name_that_is_not_there():
    with pytest.raises(AttributeError, match="no_such_camera"):
        _ = tc.no_such_camera  # pyright: ignore
    with pytest.raises(AttributeError, match="did you mean reconstruct?"):
        _ = tc.reconstuct  # pyright: ignore
    with pytest.raises(AttributeError, match="did you mean find_designs?"):
        _ = tc.design.find_design  # pyright: ignore


@pytest.mark.parametrize(
    ("package", "name", "nearest"),
    [
        (tc, "select_model", "choose_model"),
        (tc, "plan", "plan_capture"),
        (tc.measured, "read_mask", "read_pixel_map"),
        (tc.lensless, "Path", "LightPath"),
        (tc.waveguide, "plan", "plan_screen"),
        (tc.hardware, "read_acquisition", "Acquisition"),
    ],
)
def test_a_former_name_leads_to_the_one_of_today(package, name, nearest):
    with pytest.raises(AttributeError, match=rf"did you mean .*\b{nearest}\b"):
        getattr(package, name)


def test_the_version_is_that_of_the_installation():
    assert tc.__version__ == version("thincam_jax")
