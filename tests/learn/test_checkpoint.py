"""Files of arrays: what was written comes back; what is hostile or damaged is told, unread."""

import hashlib
import io
import json
import pickle
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.learn import checkpoint
from thincam_jax.learn.checkpoint import (
    CheckpointError,
    difference,
    read_arrays,
    read_description,
    read_weights,
    write_arrays,
)

TREE = {"scale": jnp.asarray(2.5), "weight": jnp.arange(6.0).reshape(2, 3)}
KNOWN = {"camera": {"beta": 13.0, "shape": [4, 6]}, "score": None}


@pytest.fixture
def file(tmp_path):
    return write_arrays(tmp_path / "net.thincam", TREE, KNOWN)


def test_what_was_written_comes_back(file):
    assert read_description(file) == KNOWN
    found = read_arrays(file, TREE)
    assert eqx.tree_equal(found, {name: np.asarray(leaf) for name, leaf in TREE.items()})
    # In the precision of what it is for.
    single = {name: leaf.astype(jnp.float32) for name, leaf in TREE.items()}
    assert read_arrays(file, single)["weight"].dtype == np.float32


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_weights_that_are_not_finite_are_told(wrong, tmp_path):
    """Of every network; the state of a training may hold them."""
    tree = {**TREE, "weight": TREE["weight"].at[1, 2].set(wrong)}
    file = write_arrays(tmp_path / "net.thincam", tree, KNOWN)
    assert read_arrays(file, TREE)["weight"].shape == (2, 3)
    with pytest.raises(CheckpointError, match="holds weights that are not finite; give an earli"):
        read_weights(file, TREE)


def test_every_flipped_byte_is_told(file):
    """Of the line, of the headers and of the numbers."""
    whole = file.read_bytes()
    for place in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[place] ^= 0x11
        file.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=r"damaged or cut off|no file of a network|form"):
            read_arrays(file, TREE)


def test_a_file_that_is_cut_off_is_told(file):
    whole = file.read_bytes()
    for count in (0, 1, 40, whole.index(b"\n"), whole.index(b"\n") + 1, len(whole) - 1):
        file.write_bytes(whole[:count])
        with pytest.raises(CheckpointError, match=r"damaged or cut off|no file of a network"):
            read_arrays(file, TREE)
    file.write_bytes(whole + b"more")
    with pytest.raises(CheckpointError, match="damaged or cut off"):
        read_arrays(file, TREE)


def forged(file, change=lambda header: None, contents=None):
    """A file with right sums over what an attacker put in."""
    line, _, rest = file.read_bytes().partition(b"\n")
    header = json.loads(line)
    if contents is not None:
        names = [name for name, _, _ in header["arrays"]]
        sums = [hashlib.sha256(data).hexdigest() for data in contents]
        header["arrays"] = [list(row) for row in zip(names, map(len, contents), sums, strict=True)]
        rest = b"".join(contents)
    del header["sha256"]
    change(header)
    header["sha256"] = hashlib.sha256(checkpoint._line(header)).hexdigest()
    file.write_bytes(checkpoint._line(header) + b"\n" + rest)
    return file


def npy(array, **how):
    content = io.BytesIO()
    np.save(content, array, **how)
    return content.getvalue()


def header_of(shape, descr="<f8"):
    """An NPY array that announces a shape, and holds eight bytes."""
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(8)


class Trap:
    """Unpickled, it would be called."""

    called = False

    def __reduce__(self):
        return (setattr, (Trap, "called", True))


SCALAR = npy(np.asarray(2.5))
HOSTILE = {
    "pickle inside npy": npy(np.asarray([Trap()], dtype=object), allow_pickle=True),
    "nothing but a pickle": pickle.dumps(Trap()),
    "another shape": npy(np.zeros((3, 2))),
    "another kind": npy(np.zeros((2, 3), int)),
    "a field": npy(np.zeros((2, 3), [("a", float)])),
    "a huge array": header_of((10**9, 10**9)),
    "too few numbers": header_of((2, 3)),
    "a negative side": header_of((-2, -3)),
    "code in the header": header_of("__import__('os').system('false')"),
    "a header without end": b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535,
    "brackets without end": header_of("(" * 400),
    "deep brackets": header_of("(" * 400 + ")" * 400),
    "another version": b"\x93NUMPY\x09\x00" + SCALAR[8:],
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_array_is_refused_before_anything_is_made_of_it(what, file):
    forged(file, contents=[SCALAR, HOSTILE[what]])
    with pytest.raises(CheckpointError, match=r"\['weight'\] ") as told:
        read_arrays(file, TREE)
    assert "\n" not in str(told.value)
    assert not Trap.called


FORGED = {
    "a huge count": lambda header: header["arrays"][1].__setitem__(1, 10**30),
    "a negative count": lambda header: header["arrays"][1].__setitem__(1, -5),
    "no numbers": lambda header: header.update(arrays=[["a", "b", "c"]]),
    "no list": lambda header: header.update(arrays=7),
    "no description": lambda header: header.update(description=[]),
}


@pytest.mark.parametrize("what", FORGED)
def test_counts_are_checked_before_anything_is_read(what, file):
    with pytest.raises(CheckpointError, match="damaged or cut off"):
        read_description(forged(file, FORGED[what]))


@pytest.mark.parametrize("text", ["", "[" * 100_000, '{"format": "other"}', "null", "7", "\xff"])
def test_what_is_no_such_file_is_told(text, tmp_path):
    (tmp_path / "other").write_bytes(text.encode("latin-1") + b"\n")
    with pytest.raises(CheckpointError, match="is no file of a network"):
        read_description(tmp_path / "other")


def test_the_first_difference_of_two_descriptions_is_named():
    here = {**KNOWN, "camera": {"beta": 20.0, "shape": [4, 6]}}
    assert difference(KNOWN, KNOWN) is None
    assert difference(KNOWN, here) == "whose camera.beta was 13.0 and is 20.0 here"
    here["camera"] = {"beta": 13.0 * (1 + 1e-8), "shape": [4, 7]}
    assert difference(KNOWN, here) == "whose camera.shape.1 was 6 and is 7 here"


def test_a_newer_format_says_so(file):
    forged(file, lambda header: header.update(version=checkpoint.VERSION + 1))
    with pytest.raises(CheckpointError, match=r"has format 2 .* reads 1; update thincam_jax"):
        read_description(file)


def test_arrays_of_another_model_are_told(file):
    with pytest.raises(CheckpointError, match=r"other arrays \(2\) than are wanted here \(1\)"):
        read_arrays(file, {"weight": TREE["weight"]})
    other = {**TREE, "weight": jnp.zeros((2, 4))}
    with pytest.raises(CheckpointError, match=re.escape("['weight'] is float64[2, 3] and the")):
        read_arrays(file, other)
