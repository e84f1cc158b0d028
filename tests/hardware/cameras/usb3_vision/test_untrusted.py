"""What comes from the wire may be anything: no crash, no hang, no allocation beyond the limits."""

import io
import os
import resource
import struct
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

from helpers import ROOT
from thincam_jax.hardware.base import ProtocolError
from thincam_jax.hardware.cameras.usb3_vision import features, gencp, stream
from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera
from thincam_jax.hardware.virtual import usb3_vision
from thincam_jax.hardware.virtual.usb3_vision import SIRM

FUZZ = Path(__file__).with_name("fuzz.py")


@pytest.mark.parametrize(
    ("counts", "seconds"),
    [
        ({"parsers": 10_000, "client": 100, "xml": 40}, 120),
        pytest.param(
            *({"parsers": 1_000_000, "client": 5_000, "xml": 3_000}, 1500),
            marks=pytest.mark.thorough,
        ),
    ],
)
def test_anything_may_come_from_the_wire(counts, seconds):
    """Right or refused: no crash, no hang, bounded memory; see fuzz.py."""
    words = [str(word) for pair in counts.items() for word in pair]
    command = [sys.executable, str(FUZZ), *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=seconds
    )
    assert result.returncode == 0, result.stderr
    for count, line in zip(counts.values(), result.stdout.splitlines(), strict=True):
        taken, refused, grown = map(int, line.split())
        assert min(taken, refused) > 0.02 * count
        assert grown < 20 + (stream.LARGEST_PAYLOAD >> 20)


VIRTUAL_XML = Path(usb3_vision.__file__).with_suffix(".xml").read_bytes()
DECLARATION = b'<?xml version="1.0" encoding="utf-8"?>'
LAUGHS = DECLARATION + b'<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;&b;">]><a>&c;</a>'


@pytest.mark.parametrize(
    ("xml", "said"),
    [
        (LAUGHS, "document type or entities"),
        (DECLARATION + b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "document type"),
        (LAUGHS.decode().replace("utf-8", "utf-16").encode("utf-16"), "document type"),
        (DECLARATION + b"<a>", "not well formed"),
        (b'<?xml version="1.0" encoding="utf-16"?><a/>', "not well formed"),
        (b"\xff\xfe\x00", "not well formed"),
        (DECLARATION + b"<RegisterDescription/>", "."),
        (
            VIRTUAL_XML.replace(b"<pFeature>Gain</pFeature>", b"<pFeature>Device</pFeature>"),
            "a pFeature names Device, which is a Port",
        ),
    ],
    ids=["laughs", "file", "utf16", "open", "not_utf16", "no_text", "no_camera", "crash"],
)
def test_xml_that_is_not_to_be_trusted(xml, said, device):
    device._xml = xml
    device._power_on()
    with pytest.raises(ProtocolError, match=said):
        Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device))


def chain(count, link):
    """The virtual camera with a chain of features, each with a link to the next."""
    nodes = [f'<Integer Name="N{n}">{link.format(n + 1)}</Integer>' for n in range(count)]
    end = f'<Integer Name="N{count}"><Value>1</Value></Integer></RegisterDescription>'
    return VIRTUAL_XML.replace(b"</RegisterDescription>", ("".join(nodes) + end).encode())


@pytest.mark.parametrize(
    ("xml", "said"),
    [
        (chain(4_000, "<pValue>N{}</pValue>"), "refer to too many others"),
        (chain(20_000, "<pValue>N{}</pValue>"), "refer to too many others"),
        (chain(1_000, "<Value>1</Value><pSelected>N{}</pSelected>"), "refer to too many others"),
        (VIRTUAL_XML.replace(b"<Length>64<", b"<Length>1000000000<", 1), "register of 1000000000"),
        (VIRTUAL_XML.replace(b"<Length>64<", b"<Length>0x3B9ACA00<", 1), "register of 0x3B9ACA00"),
        (
            VIRTUAL_XML.replace(b"<Length>64</Length>", b"<pLength>SensorWidth</pLength>", 1),
            "the length of the text DeviceVendorName is another feature",
        ),
    ],
    ids=["chain", "long chain", "selectors", "decimal", "hexadecimal", "elsewhere"],
)
def test_xml_that_takes_time_or_memory_is_refused_before(xml, said):
    started, taken = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=said):
        features.check_xml(xml)
    assert time.process_time() - started < 5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - taken < 400_000  # kB


def zipped(content: bytes, **options) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", **options) as archive:
        archive.writestr("camera.xml", content)
    return file.getvalue()


def test_a_zipped_xml_is_read(device):
    xml = device._xml
    device._xml = zipped(xml, compression=zipfile.ZIP_DEFLATED)
    device._power_on()
    struct.pack_into("<I", device._memory, 0x1200 + 12, 1 << 10)
    with Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device)) as camera:
        assert camera.trigger_and_grab(1.0).pixels.shape == (48, 64)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"no zip", "cannot be read"),
        (zipped(bytes(features.LARGEST_XML + 1), compression=zipfile.ZIP_DEFLATED), "more than"),
        (zipped(b"<a/>", compression=zipfile.ZIP_LZMA), "allowed: one, deflated"),
    ],
    ids=["none", "bomb", "lzma"],
)
def test_a_zip_that_is_not_to_be_trusted(data, said):
    with pytest.raises(ValueError, match=said):
        features.unzip(data)


@pytest.mark.parametrize(
    ("address", "layout", "value", "said"),
    [
        (0x1200, "<Q", 0, "a manifest of 0 entries"),
        (0x1200 + 24, "<Q", 1 << 40, "allowed: 16777216"),
        (0x1000 + gencp.Sbrm.MAX_ACKNOWLEDGE, "<I", 8, "packets of 8 bytes"),
        (0x1000 + gencp.Sbrm.CAPABILITY, "<Q", 0, "it has no stream"),
        (SIRM + gencp.Sirm.INFO, "<I", 31 << 24, "multiples of 2\\^31"),
        (SIRM + gencp.Sirm.REQUIRED_LEADER, "<I", 1 << 30, "a leader of 1073741824"),
    ],
)
def test_sizes_are_checked_before_they_are_used(address, layout, value, said, device):
    struct.pack_into(layout, device._memory, address, value)
    with pytest.raises(ProtocolError, match=said):
        Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device))
