"""A camera's features by their names in the SFNC, as its own XML describes them.

The XML comes from the device and is not to be trusted: its size is bounded, zipped or not, and it
must not declare a document type, so that there are no entities to expand.
"""

import io
import operator
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from genicam import genapi

from thincam_jax.hardware.cameras.usb3_vision import gencp
from thincam_jax.hardware.cameras.usb3_vision.gencp import Abrm
from thincam_jax.hardware.cameras.usb3_vision.link import LARGEST_READ, Control, UsbLink
from thincam_jax.hardware.errors import OutOfRange

LARGEST_XML = LARGEST_READ  # bytes; those of cameras have up to 2 MiB
MOST_ENTRIES = 64

# Names of these elements stand for a choice or a variable of a formula, not for a node.
NO_NODES = ("EnumEntry", "pVariable", "Constant", "Expression")


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
        root = fromstring(data, forbid_dtd=True)
        text = data.decode("utf-8-sig")
    except DefusedXmlException as error:
        raise ValueError(f"it declares a document type or entities ({error})") from error
    except (ParseError, UnicodeDecodeError, LookupError) as error:
        raise ValueError(f"it is not well formed: {error}") from error
    _check_references(root)
    return text


def _check_references(root: Any) -> None:
    """GenApi crashes, with the process, where a port stands for a feature or the reverse."""
    kinds = {n.attrib["Name"]: _kind(n) for n in root.iter() if "Name" in n.attrib
             and _kind(n) not in NO_NODES}  # fmt: skip
    for element in root.iter():
        reference, name = _kind(element), (element.text or "").strip()
        if reference[:1] == "p" and reference[1:2].isupper() and name in kinds:
            if (kinds[name] == "Port") != (reference == "pPort"):
                raise ValueError(f"a {reference} names {name}, which is a {kinds[name]}")


def _kind(node: Any) -> str:
    return node.tag.rpartition("}")[2]


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
        with self._evaluating("read the XML"):
            self._nodes.load_xml_from_string(xml)
            self._nodes._connect(self._port, "Device")

    @contextmanager
    def _evaluating(self, operation: str) -> Iterator[None]:
        """Names what GenApi raises, and what a feature of another kind than the SFNC's leads to."""
        try:
            yield
        except (genapi.GenericException, AttributeError, TypeError, ValueError) as error:
            cause = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise self._link.broken(operation, cause) from error

    def has(self, name: str) -> bool:
        """Whether the camera has this feature, and it may be used now."""
        try:
            return genapi.is_available(self._nodes.get_node(name).node.get_access_mode())
        except genapi.GenericException:
            return False

    def integer(self, name: str) -> int:
        """The value of a feature that is a whole number."""
        with self._evaluating(f"read {name}"):
            return operator.index(self._nodes.get_node(name).value)

    def number(self, name: str) -> float:
        """The value of a feature that is a number."""
        with self._evaluating(f"read {name}"):
            return float(self._nodes.get_node(name).value)

    def choice(self, name: str) -> str:
        """Which choice an enumeration is set to."""
        with self._evaluating(f"read {name}"):
            return str(self._nodes.get_node(name).value)

    def choices(self, name: str) -> tuple[str, ...]:
        """What an enumeration may be set to now."""
        with self._evaluating(f"read {name}"):
            return tuple(self._nodes.get_node(name).symbolics)

    def write(self, name: str, value: float | int | str) -> None:
        """Sets the feature."""
        with self._evaluating(f"set {name}"):
            self._nodes.get_node(name).value = value

    def write_if_there(self, name: str, value: float | int | str) -> None:
        """Sets a feature that not every camera has."""
        if self.has(name):
            self.write(name, value)

    def write_nearest(self, name: str, value: float | int, unit: str = "") -> None:
        """Sets a number to the nearest step of the feature; `OutOfRange` beyond its limits."""
        with self._evaluating(f"set {name}"):
            node = self._nodes.get_node(name)
            low, high = node.min, node.max
            step = node.inc if isinstance(node, genapi.IInteger) else None
            rounding = 1e-9 * abs(value)  # a limit that was read may come back through other units
            if not low - rounding <= value <= high + rounding:
                raise OutOfRange(self._link.name, f"set {name}", f"{value:g} {unit}".rstrip(),
                                 f"allowed: {low:g} to {high:g} {unit}".rstrip())  # fmt: skip
            value = min(max(value, low), high)
            if step:
                value = low + min(round((value - low) / step), (high - low) // step) * step
            if node.value != value:  # an offset that can only be 0 may be locked
                node.value = value

    def execute(self, name: str) -> None:
        """Has the camera do what the command says."""
        with self._evaluating(f"execute {name}"):
            self._nodes.get_node(name).execute()
