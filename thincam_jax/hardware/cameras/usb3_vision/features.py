"""A camera's features by their names in the SFNC, as its own XML describes them.

The XML comes from the device and is not to be trusted: its size is bounded, zipped or not, and it
must not declare a document type, so that there are no entities to expand.
"""

import io
import zipfile
import zlib
from typing import Any
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from genicam import genapi

from thincam_jax.hardware.cameras.usb3_vision import gencp
from thincam_jax.hardware.cameras.usb3_vision.gencp import Abrm
from thincam_jax.hardware.cameras.usb3_vision.link import Control, UsbLink
from thincam_jax.hardware.errors import OutOfRange, ProtocolError

LARGEST_XML = 16 << 20  # bytes; those of cameras have up to 2 MiB
MOST_ENTRIES = 64


def fetch_xml(link: UsbLink, control: Control) -> str:
    """The XML that the camera's manifest table names, checked."""
    table = control.read_number(Abrm.MANIFEST, 8)
    entries = control.read_number(table, 8)
    if not 0 < entries <= MOST_ENTRIES:
        raise link.broken("read the XML", f"a manifest of {entries} entries")
    entry = control.read(table + 8, gencp.MANIFEST_ENTRY.size)
    _, schema, address, size = gencp.MANIFEST_ENTRY.unpack(entry)
    if not 0 < size <= LARGEST_XML:
        raise link.broken("read the XML", f"it has {size} bytes, allowed: {LARGEST_XML}")
    data = control.read(address, size)
    try:
        return check_xml(unzip(data) if schema >> 10 & 0x3F == gencp.ZIPPED else data)
    except ValueError as error:
        raise link.broken("read the XML", str(error)) from error


def unzip(data: bytes) -> bytes:
    """The one file of a zip archive; `ValueError` where it is none or grows beyond the limit."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            files = archive.infolist()
            # Other ways to compress may allocate what their header says.
            if len(files) != 1 or files[0].compress_type not in (0, zipfile.ZIP_DEFLATED):
                raise ValueError(f"a zip of {len(files)} files, allowed: one, deflated")
            with archive.open(files[0]) as file:
                content = file.read(LARGEST_XML + 1)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"the zip cannot be read: {error}") from error
    if len(content) > LARGEST_XML:
        raise ValueError(f"the zipped XML has more than {LARGEST_XML} bytes")
    return content


def check_xml(data: bytes) -> str:
    """The XML as text; `ValueError` where it is not well formed UTF-8 or declares entities."""
    data = data.rstrip(b"\0")  # registers come in multiples of four
    try:
        fromstring(data, forbid_dtd=True)
        return data.decode("utf-8-sig")
    except DefusedXmlException as error:
        raise ValueError(f"it declares a document type or entities ({error})") from error
    except (ParseError, UnicodeDecodeError, LookupError) as error:
        raise ValueError(f"it is not well formed: {error}") from error


class _Port(genapi.AbstractPort):
    """Through which the feature tree reads and writes the camera's registers."""

    def __init__(self, control: Control):
        super().__init__()
        self._control = control

    def get_access_mode(self) -> int:
        return genapi.EAccessMode.RW

    def read(self, address: int, buffer: int) -> bytes:
        return self._control.read(address, buffer)

    def write(self, address: int, buffer: bytes) -> None:
        self._control.write(address, bytes(buffer))


class Features:
    """The features of a camera; a value is a number, a text or a choice by its name."""

    def __init__(self, link: UsbLink, control: Control, xml: str):
        self._link = link
        self._nodes, self._port = genapi.NodeMap(), _Port(control)
        try:
            self._nodes.load_xml_from_string(xml)
            self._nodes._connect(self._port, "Device")
        except genapi.GenericException as error:
            raise link.broken("read the XML", _first_line(error)) from error

    def _node(self, name: str) -> Any:
        try:
            return self._nodes.get_node(name)
        except genapi.GenericException as error:
            raise self._failed("find", name, error) from error

    def has(self, name: str) -> bool:
        """Whether the camera has this feature, and it may be used now."""
        try:
            return genapi.is_available(self._nodes.get_node(name).node.get_access_mode())
        except genapi.GenericException:
            return False

    def read(self, name: str) -> Any:
        """The feature's value."""
        try:
            return self._node(name).value
        except genapi.GenericException as error:
            raise self._failed("read", name, error) from error

    def write(self, name: str, value: Any) -> None:
        """Sets the feature; `OutOfRange` where it does not take this value."""
        node = self._node(name)
        try:
            node.value = value
        except (genapi.OutOfRangeException, genapi.InvalidArgumentException) as error:
            allowed = _allowed(node)
            raise OutOfRange(self._link.name, f"set {name}", f"{value} is not allowed",
                             f"allowed: {allowed}") from error  # fmt: skip
        except genapi.GenericException as error:
            raise self._failed("set", name, error) from error

    def write_if_there(self, name: str, value: Any) -> None:
        """Sets a feature that not every camera has."""
        if self.has(name):
            self.write(name, value)

    def write_nearest(self, name: str, value: float | int, unit: str = "") -> None:
        """Sets a number to the nearest step of the feature; `OutOfRange` beyond its limits."""
        node = self._node(name)
        try:
            low, high = node.min, node.max
            step = node.inc if isinstance(node, genapi.IInteger) else None
        except genapi.GenericException as error:
            raise self._failed("read the limits of", name, error) from error
        rounding = 1e-9 * abs(value)  # a limit that was read may come back through other units
        if not low - rounding <= value <= high + rounding:
            raise OutOfRange(self._link.name, f"set {name}", f"{value:g} {unit}".rstrip(),
                             f"allowed: {low:g} to {high:g} {unit}".rstrip())  # fmt: skip
        value = min(max(value, low), high)
        if step:
            value = low + min(round((value - low) / step), (high - low) // step) * step
        self.write(name, value)

    def choices(self, name: str) -> tuple[str, ...]:
        """What an enumeration may be set to now."""
        try:
            return tuple(self._node(name).symbolics)
        except genapi.GenericException as error:
            raise self._failed("read", name, error) from error

    def execute(self, name: str) -> None:
        """Has the camera do what the command says."""
        try:
            self._node(name).execute()
        except genapi.GenericException as error:
            raise self._failed("execute", name, error) from error

    def _failed(self, verb: str, name: str, error: Exception) -> ProtocolError:
        return self._link.broken(f"{verb} {name}", _first_line(error))


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def _allowed(node: Any) -> str:
    choices = getattr(node, "symbolics", None)
    return ", ".join(choices) if choices else f"{node.min} to {node.max}"
