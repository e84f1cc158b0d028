"""Stores that were damaged or made to harm: refused in a line, soon and in little memory."""

import json
import os
import resource
import shutil
import signal
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from hardware.memory_rig import World, by_rows, fiducial_plan

from thincam_jax._core.capture_store import CaptureStoreError
from thincam_jax.hardware import CameraSettings, open_rig
from thincam_jax.hardware.acquisition.acquire import acquire
from thincam_jax.hardware.acquisition.plan import WHITE, AcquisitionPlan, canonical_json
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.base import Region
from thincam_jax.hardware.plans import scene
from thincam_jax.hardware.virtual import VirtualRig
from thincam_jax.hardware.virtual.rig import Electronics
from thincam_jax.measured import Preparation, prepare
from thincam_jax.measured.calibration import HadamardCaptures

PLAN = by_rows(fiducial_plan(4, dark_every=2))
DEEP = "[" * 200_000 + "]" * 200_000
CHUNK, DIGESTS = "frames/c/0/0/0", "digests/c/0"


def fifo(name):
    def change(store):
        (store / name).unlink()
        os.mkfifo(store / name)

    return change


def text(name, content):
    return lambda store: (store / name).write_text(content, "utf-8")


def raw(name, content):
    return lambda store: (store / name).write_bytes(content)


def entry(name, value, *keys):
    """Set an entry of a JSON file; "DEEP" stands for lists in lists."""

    def change(store):
        whole = here = json.loads((store / name).read_text("utf-8"))
        for key in keys[:-1]:
            here = here[key]
        here[keys[-1]] = value
        (store / name).write_text(json.dumps(whole).replace('"DEEP"', DEEP), "utf-8")

    return change


def array(name, shape, chunks, dtype):
    def change(store):
        for value, *keys in (
            (shape, "shape"),
            (chunks, "chunk_grid", "configuration", "chunk_shape"),
            (dtype, "data_type"),
        ):
            entry(f"{name}/zarr.json", value, *keys)(store)
        if dtype in ("string", "complex64"):
            entry(f"{name}/zarr.json", "" if dtype == "string" else [0, 0], "fill_value")(store)
        if dtype == "string":
            entry(f"{name}/zarr.json", [{"name": "vlen-utf8"}], "codecs")(store)

    return change


def journal(*records):
    def change(store):
        crc = zlib.crc32(canonical_json(list(records)).encode())
        line = canonical_json({"crc32": crc, "records": list(records)}) + "\n"
        whole = (store / "journal.jsonl").read_text("utf-8")
        (store / "journal.jsonl").write_text(line + whole, "utf-8")

    return change


HUGE = 10**12
HARM = {
    "chunk is a FIFO": fifo(CHUNK),
    "digests are a FIFO": fifo(DIGESTS),
    "root is a FIFO": fifo("zarr.json"),
    "old root is a FIFO": lambda store: (
        fifo("zarr.json")(store),
        shutil.move(store / "zarr.json", store / ".zgroup"),
    ),
    "frames are a FIFO": fifo("frames/zarr.json"),
    "plan is a FIFO": fifo("plan.json"),
    "journal is a FIFO": fifo("journal.jsonl"),
    "digests too long": array("digests", [HUGE], [HUGE], "uint64"),
    "digests in huge chunks": array("digests", [6], [HUGE], "uint64"),
    "digests without end": array("digests", [HUGE], [6], "uint64"),
    "digests of texts": array("digests", [6], [6], "string"),
    "digests of numbers": array("digests", [6], [6], "float64"),
    "digests of two axes": array("digests", [6, 1], [6, 1], "uint64"),
    "digests damaged": raw(DIGESTS, b"\x28\xb5\x2f\xfd\xe0" + b"\xff" * 20),
    "digests cut": raw(DIGESTS, b"\x28\xb5"),
    "sensor too large": entry("zarr.json", [10**72, 9], "attributes", "sensor_shape"),
    "sensor is a text": entry("zarr.json", "ab", "attributes", "sensor_shape"),
    "frames too large": array("frames", [300, 10**7, 10**7], [16, 10**7, 10**7], "uint16"),
    "frames of many rows": array("frames", [6, 10**7, 9], [1, 1, 9], "uint16"),
    "frames of many columns": array("frames", [6, 6, 2**40], [16, 6, 2**40], "uint16"),
    "frames complex": array("frames", [6, 6, 9], [16, 6, 9], "complex64"),
    "frames flat": array("frames", [6], [6], "uint16"),
    "frames compressed": entry("frames/zarr.json", {"name": "zstd"}, "codecs", 1),
    "bits are a text": entry("zarr.json", "twelve", "attributes", "bits"),
    "attributes deep": entry("zarr.json", "DEEP", "attributes", "x"),
    "attributes are a list": entry("zarr.json", [], "attributes"),
    "acquisition is a number": entry("zarr.json", 3, "attributes", "acquisition"),
    "devices are a number": entry("zarr.json", 3, "attributes", "acquisition", "devices"),
    "exposure is a text": entry(
        "zarr.json", "a", "attributes", "acquisition", "settings", 0, "exposure"
    ),
    "root deep": text("zarr.json", DEEP),
    "plan deep": text("plan.json", DEEP),
    "plan is a number": text("plan.json", "3"),
    "journal deep": lambda store: raw(
        "journal.jsonl", DEEP.encode() + b"\n" + (store / "journal.jsonl").read_bytes()
    )(store),
    "record is a number": journal(3),
    "record without a digest": journal({"step": 1}),
    "record of a digest": journal({"step": 1, "digest": "edd3b0fb2533182g", "position": 0}),
    "record of no step": journal({"step": 10**30, "digest": "edd3b0fb25331822", "position": 0}),
    "record of a step below": journal({"step": -1, "digest": "edd3b0fb25331822", "position": 0}),
    "record of a list": journal({"step": [1], "digest": "edd3b0fb25331822", "position": 0}),
    "record of a place": journal({"step": 1, "digest": "edd3b0fb25331822", "position": "x"}),
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "a.zarr"
    with World().rig() as rig:
        acquire(PLAN, rig, path)
    for reader in READERS.values():
        reader(path)  # all is imported
    return path


@pytest.fixture
def little():
    """A gigabyte more than is taken, and an alarm where a reader waits for ever."""
    limit = resource.getrlimit(resource.RLIMIT_AS)
    taken = int(Path("/proc/self/statm").read_text("utf-8").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + 2**30, limit[1]))
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("it does not return"))
    signal.alarm(5)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
    resource.setrlimit(resource.RLIMIT_AS, limit)


def resumed(path):
    with World().rig() as rig:
        acquire(PLAN, rig, path)


READERS = {
    "read": lambda path: Acquisition.load(path).captures(),
    "open": lambda path: HadamardCaptures.load(path).rows(0, 6),
    "resume": resumed,
}


@pytest.mark.parametrize("harm", HARM)
def test_a_store_that_harms_is_refused(harm, store, tmp_path, little):
    """By a reader of what was changed; the others take what is left, or refuse it, too."""
    refused = []
    for name, reader in READERS.items():
        path = tmp_path / name
        shutil.copytree(store, path)
        HARM[harm](path)
        start = time.monotonic()
        try:
            reader(path)
            told = ""
        except CaptureStoreError as error:
            told = str(error)
        assert time.monotonic() - start < 1.0, name
        refused += [told] if told else []
        assert len(told.splitlines()) < 2 and len(told) < 1000, told
    assert refused


LINKS = ["frames", "frames/c", "frames/c/0", "frames/c/0/0", "frames/c/0/0/0", "frames/zarr.json"]
LINKS += ["digests", "zarr.json", "plan.json", "journal.jsonl"]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("link", LINKS)
def test_a_store_does_not_lead_out_of_its_folder(link, reader, store, tmp_path):
    """Each reader refuses it and writes nothing there; a copy of what it leads to is taken."""
    path, outside = tmp_path / "a.zarr", tmp_path / "outside"
    shutil.copytree(store, path)
    (path / link).rename(outside)
    (path / link).symlink_to(outside)
    with pytest.raises(CaptureStoreError, match="is a link, which is not followed; copy"):
        READERS[reader](path)
    shutil.copytree(path, tmp_path / "copy.zarr")
    READERS[reader](tmp_path / "copy.zarr")


class Coloured:
    """Even light in three colours on a sensor whose first pixels are red and green."""

    sensor_shape = (40, 56)
    colours = (6e4, 4e4, 1e4)  # electrons/s of red, green and blue

    def __call__(self, shown, position):
        light = np.zeros(self.sensor_shape, np.float32)
        for (row, column), colour in zip(np.ndindex(2, 2), (0, 1, 1, 2), strict=True):
            light[row::2, column::2] = self.colours[colour]
        return light * bool(shown.any())


@pytest.mark.parametrize(
    ("driver", "corner", "pixel_format", "pattern"),
    [
        ("aravis", (8, 4), "BayerRG8", "RGGB"),
        ("pylon", (8, 4), "BayerRG12", "RGGB"),
        ("pylon", (8, 5), "BayerRG12", "GRBG"),
        ("pylon", (7, 4), "BayerRG12", "GBRG"),
        ("pylon", (7, 5), "BayerRG12", "BGGR"),
    ],
)
def test_colours_are_those_of_the_scene_wherever_the_region_begins(
    tmp_path, driver, corner, pixel_format, pattern
):
    settings = CameraSettings(0.1, Region(*corner, 24, 32), pixel_format)
    virtual = VirtualRig(Coloured(), display_shape=(8, 8))
    drivers = {"camera": (driver, {}), "display": ("sdl", {})}
    plan = scene(WHITE, settings, frames=2, dark_frames=2)
    with open_rig(drivers, 1.0, virtual=virtual) as rig:
        assert acquire(plan, rig, tmp_path / "store").complete
    found = Acquisition.load(tmp_path / "store")
    assert found.settings[0].bayer == pattern
    raw, dark = found.raw(0), found.raw(2)
    options = Preparation(bayer=found.settings[0].bayer, capture_scale="none", corner=(1, 9))
    ready = prepare(raw, raw, background=dark, options=options)
    counts = raw.full_scale * ready.capture.mean(axis=(1, 2))
    electron = Electronics().scale(settings)[0]
    np.testing.assert_allclose(counts, 0.1 * electron * np.array(Coloured.colours), rtol=0.02)


def test_hashes_of_plans_stay_as_they_were(tmp_path):
    """Settings that came later are in a plan only where they are given: stores can be read."""
    plan = scene(WHITE, CameraSettings(0.1, Region(1, 2, 3, 4)))
    for later in ("black_level", "binning", "trigger"):
        assert f'"{later}"' not in plan.as_json()
    assert AcquisitionPlan.from_json(plan.as_json()) == plan
    assert plan.hash.startswith("d92cc4a7cc32bbd7")
    other = scene(WHITE, CameraSettings(0.1, black_level=64.0, binning=2, trigger="Line0"))
    assert AcquisitionPlan.from_json(other.as_json()).settings == other.settings
