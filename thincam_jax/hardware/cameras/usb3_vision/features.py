"""A camera's features by their names in the SFNC, as its own XML describes them.

The XML comes from the device and is not trusted: its size is bounded, zipped or not, and it must
not declare a document type, so that no entities are expanded.
"""

import io
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from genicam import genapi

from thincam_jax._core.text import shortened
from thincam_jax.hardware.cameras.features import Number, Value
from thincam_jax.hardware.cameras.usb3_vision import gencp
from thincam_jax.hardware.cameras.usb3_vision.gencp import Abrm
from thincam_jax.hardware.cameras.usb3_vision.link import LARGEST_READ, CameraMemory, UsbLink

LARGEST_XML = LARGEST_READ  # bytes; those of cameras have up to 2 MiB
MOST_ENTRIES = 64

# Elements whose names denote a choice or a variable of a formula, not a node.
NO_NODES = ("EnumEntry", "pVariable", "Constant", "Expression")

# Of GenApi: references that lead on from each node, summed, for 0.1 kB each; of "pSelected" the
# time grows with the third power of a chain's length.
MOST_REFERENCES = {"p": 500_000, "pSelected": 20_000}


def fetch_xml(link: UsbLink, control: CameraMemory) -> str:
    """Read and check the XML that the camera's manifest table names."""
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
    """The only file of a zip archive; `ValueError` for another archive or one above the limit."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            files = archive.infolist()
            # Other compressions may allocate what their header says.
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
    """Decode the XML; `ValueError` where it is not well-formed UTF-8 or declares entities."""
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
    """Refuse what crashes GenApi, or takes it more time or memory than any camera needs.

    References between ports and features; long chains of references; registers longer than a read.
    """
    kinds = {n.attrib["Name"]: _kind(n) for n in root.iter() if "Name" in n.attrib
             and _kind(n) not in NO_NODES}  # fmt: skip
    owners, references = {root: ""}, []
    for parent in root.iter():
        own = _kind(parent) not in NO_NODES and parent.attrib.get("Name")
        owners[parent] = owner = own or owners[parent]
        owners |= dict.fromkeys(parent, owner)
        reference, name = _kind(parent), (parent.text or "").strip()
        if reference == "Length" and not (name.isascii() and len(name) < 20 and
                int(name, 16 if name[:2] == "0x" else 10) <= LARGEST_READ):  # fmt: skip
            raise ValueError(f"a register of {shortened(name)} bytes, allowed: {LARGEST_READ}")
        if reference == "pLength" and kinds.get(owner) == "StringReg":
            raise ValueError(f"the length of the text {owner} is another feature")
        if reference[:1] == "p" and reference[1:2].isupper() and name in kinds:
            if (kinds[name] == "Port") != (reference == "pPort"):
                raise ValueError(f"a {reference} names {name}, which is a {kinds[name]}")
            references.append((reference, owner, name))
    for kind, left in MOST_REFERENCES.items():
        graph: dict[str, list[str]] = {}
        for reference, owner, name in references:
            if reference.startswith(kind):
                graph.setdefault(owner, []).append(name)
        for start in graph:
            seen, waiting = {start}, [start]
            while waiting:
                following = graph.get(waiting.pop(), ())
                left -= len(following)
                if left < 0:
                    raise ValueError("its features refer to too many others, one by another")
                waiting += set(following) - seen
                seen.update(following)


def _kind(node: Any) -> str:
    return node.tag.rpartition("}")[2]


class _Port(genapi.AbstractPort):
    """Access of the feature tree to the camera's registers."""

    def __init__(self, control: CameraMemory):
        super().__init__()
        self._control = control

    def get_access_mode(self) -> int:
        return genapi.EAccessMode.RW

    def read(self, address: int, buffer: int) -> bytes:
        return self._control.read(address, buffer)

    def write(self, address: int, buffer: bytes) -> None:
        self._control.write(address, bytes(buffer))


class GenApiFeatures:
    """`GenApiFeatures` of `cameras.features`, by GenApi."""

    def __init__(self, link: UsbLink, control: CameraMemory, xml: str):
        self._link = link
        self._nodes, self._port = genapi.NodeMap(), _Port(control)
        with self.evaluating("read the XML"):
            self._nodes.load_xml_from_string(xml)
            self._nodes._connect(self._port, "Device")

    @contextmanager
    def evaluating(self, operation: str) -> Iterator[None]:
        """Turn errors of GenApi, and of features of unexpected types, into those of a device."""
        try:
            yield
        except (genapi.GenericException, AttributeError, TypeError, ValueError) as error:
            cause = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise self._link.broken(operation, cause) from error

    def has(self, name: str) -> bool:
        try:
            return genapi.is_available(self._nodes.get_node(name).node.get_access_mode())
        except genapi.GenericException:
            return False

    def get(self, name: str) -> Value:
        with self.evaluating(f"read {name}"):
            value = self._nodes.get_node(name).value
            if not isinstance(value, int | float | str):
                raise TypeError(f"it is a {type(value).__name__}, neither a number nor a text")
            return value

    def set(self, name: str, value: Value) -> None:
        with self.evaluating(f"set {name}"):
            self._nodes.get_node(name).value = value

    def limits(self, name: str) -> tuple[Number, Number, Number]:
        with self.evaluating(f"read {name}"):
            node = self._nodes.get_node(name)
            return node.min, node.max, node.inc if isinstance(node, genapi.IInteger) else 0

    def choices(self, name: str) -> tuple[str, ...]:
        with self.evaluating(f"read {name}"):
            return tuple(self._nodes.get_node(name).symbolics)

    def execute(self, name: str) -> None:
        with self.evaluating(f"execute {name}"):
            self._nodes.get_node(name).execute()
