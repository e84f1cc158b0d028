"""Eager checks of arguments: one line that says what was given, what is allowed and what to do.

Traced values cannot be looked at and pass; they were checked when the object was built.
"""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Real

from thincam_jax._core.text import meant, shortened

# What users give: checked below, which tells a wrong value in one line, and not by its type.
if TYPE_CHECKING:
    Number = Real[ArrayLike, ""]
    Numbers = Real[ArrayLike, "..."]
    Position = Numbers | Sequence[Number]
    Shape = Sequence[int]
    Checked = Array
else:
    Number = Numbers = Position = Shape = Any
    Checked = Any  # of NumPy `on_host`


# mm: a longer wavelength was meant in nanometres or micrometres; light in metres has such numbers.
LONGEST_LIGHT, _IN_METRES = 0.1, (1.5e-7, 2.5e-6)
# mm: pixels of sensors are smaller, and larger; 5.5e-6 was meant in metres.
_LARGEST_PITCH, _SMALLEST_PITCH = 1.0, 1e-4
# Of what has a unit.
_LEAST, _MOST = 1e-12, 1e12
# Of XLA's indices; of the pixels along a side, and of the cells.
_LARGEST_COUNT, _LARGEST_SIDE, _MOST_CELLS = 2**31 - 1, 10**12, 10**7
# Of the largest value of an image.
_LEAST_SCALE = 1e-15
# Units of plain ratios, which nobody writes.
_RATIOS = ("parts of one", "a ratio", "")
MOST_BITS = 1000  # of a whole number that a float holds
_ON_HOST = ContextVar("on_host", default=False)


def is_traced(value: Any) -> bool:
    """Whether the value is not known yet: an argument of a function under jit, grad or vmap."""
    return isinstance(value, Tracer)


def holds_traced(*values: Any) -> bool:
    """Whether a leaf of the values, pytrees, is not known yet."""
    return not holds_itself(values) and any(map(is_traced, jax.tree.leaves(values)))


def staying_known(function: Callable[..., Any], *values: Any) -> Any:
    """A function's result, which under jit is known, too, where the values are."""
    if holds_traced(values):
        return function(*values)
    with jax.ensure_compile_time_eval():
        return function(*values)


def holds_itself(value: Any) -> bool:
    """Whether a list is inside itself."""
    try:
        jax.tree.structure(value)
    except (RecursionError, SystemError):
        return True
    return False


def _known(value: Any) -> np.ndarray | None:
    """The value as a NumPy array, or None while it is traced; of type object for what is none."""
    try:
        return None if is_traced(value) else native(value)
    except (ValueError, TypeError, RecursionError):  # lists of different lengths, random keys
        return np.asarray(None)


def native(value: Any) -> np.ndarray:
    """A NumPy array in the machine's byte order, of single or double precision; NaN where masked.

    Takes arrays of other libraries: those with `__array__`, and by DLPack.
    """
    known, masked = without_mask(value)
    wider = {"g": "d", "G": "D", "e": "f"}.get(known.dtype.char)
    known = known.astype(wider or known.dtype.newbyteorder("="), copy=False)
    if masked is not None:
        known = np.where(masked, np.nan, known)
    return known


def without_mask(value: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """An array of any library, and where a masked array is masked, if it is anywhere."""
    if is_foreign(value):
        value = value.detach().cpu() if hasattr(value, "detach") else value  # of PyTorch
        value = getattr(value, "values", value) if hasattr(value, "dims") else value  # of xarray
        value = value if hasattr(value, "__array__") else np.from_dlpack(value)
    masked = np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) else None
    known = np.asarray(value)
    if known.dtype.name == "bfloat16":
        known = known.astype(np.float32)
    return known, masked if masked is not None and masked.any() else None


def is_foreign(value: Any) -> bool:
    """Whether it is an array of another library than NumPy and JAX."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return False
    return any(hasattr(type(value), name) for name in ("__array__", "__dlpack__"))


@contextlib.contextmanager
def on_host() -> Iterator[None]:
    """Numbers are checked by NumPy alone: JAX would start its devices and take their memory."""
    token = _ON_HOST.set(True)
    try:
        yield
    finally:
        _ON_HOST.reset(token)


def shown(value: Any) -> str:
    """A value in a message: short, and in one line."""
    if isinstance(value, int) and value.bit_length() > MOST_BITS:  # Python makes no text of more
        return f"a whole number of {value.bit_length()} bits"
    if isinstance(value, np.ndarray | jax.Array) and np.size(value) > 4:
        return f"an array of {value.dtype} of shape {value.shape}"
    text = str(value) if isinstance(value, np.ndarray | np.generic | jax.Array) else repr(value)
    return shortened(" ".join(text.split()))


def shape_of(value: Any) -> tuple[int, ...]:
    known = _known(value)
    return value.shape if known is None else known.shape


def real(name: str, value: Any, unit: str, *, shape: tuple[int, ...] = ()) -> Checked:
    """A floating array of that shape, or TypeError/ValueError naming the argument."""
    known = _known(value)
    if known is not None:
        if known.dtype.kind not in "fiu":
            raise TypeError(f"{name} = {shown(value)} is not a real number; give it in {unit}")
        if np.isnan(known).any():
            raise ValueError(f"{name} is NaN; give a number in {unit}")
    array: Checked
    if known is None:
        array = as_array(value, floating=True)
    elif _ON_HOST.get():
        array = cast(Any, known)
    else:
        # A plain number stays known inside jit, so that sizes can depend on it.
        with jax.ensure_compile_time_eval():
            array = as_array(value, floating=True)
    if array.shape != shape:
        wanted = "one number" if shape == () else f"an array of shape {shape}"
        raise ValueError(f"{name} has shape {array.shape}; give {wanted} in {unit}")
    return array


def as_array(value: Any, *, floating: bool = False) -> Array:
    """A value for JAX in its own precision; `floating`: whole numbers become floating ones.

    Half precision becomes single, as FFTs and complex numbers have no less.

    `jnp.asarray` would compile a program for each shape of a NumPy array, and give a plain number a
    weak type, for which programs are compiled once more.
    """
    is_half = isinstance(value, jax.Array) and value.dtype in (jnp.float16, jnp.bfloat16)
    if isinstance(value, jax.Array) and (not is_half or is_traced(value)):
        if not is_half and not value.weak_type and not (floating and value.dtype.kind in "iub"):
            return value
    elif not holds_traced(value):
        known = native(value)
        if floating and known.dtype.kind in "iub":
            known = known.astype(float)
        return jax.device_put(known, may_alias=False)
    array = jnp.asarray(value, jnp.float32 if is_half else None)
    if floating and array.dtype.kind in "iub":
        array = array.astype(float)
    return jax.lax.convert_element_type(array, array.dtype)


def at_hand(value: Any, dtype: Any = None) -> Any:
    """NumPy's array of known numbers, of which parts and shapes need no program; else JAX's."""
    return (jnp if holds_traced(value) else np).asarray(value, dtype)


def each(array: Any, axis: int = 0) -> list[Any]:
    """Parts of an array along an axis."""
    return list(at_hand(array).swapaxes(0, axis))


def stacked(parts: Sequence[Any]) -> Array:
    """A stack of arrays of one shape; of known ones in NumPy, where nothing is compiled."""
    if holds_traced(parts):
        return jnp.stack(parts)
    return as_array(np.stack([np.asarray(part) for part in parts]))


def _require(array: Checked, holds: Callable[[np.ndarray], Any], message: str) -> Checked:
    """The array, or ValueError with its value in the message; a traced one passes."""
    known = _known(array)
    if known is not None and not np.all(holds(known)):
        raise ValueError(message.format(shown(known)))
    return array


def numbers(name: str, value: Any, *, allow_complex: bool = False) -> np.ndarray:
    """An array of known numbers, floating or whole; NaN and infinity pass."""
    known = np.asarray(_known(value))
    _require_numbers(name, value, known.dtype, allow_complex)
    return known


def array(name: str, value: Any, *, allow_complex: bool = False) -> Array:
    """`numbers` for JAX, of traced ones, too."""
    if isinstance(value, jax.Array) or holds_traced(value):
        known = jnp.asarray(value)
        _require_numbers(name, value, known.dtype, allow_complex)
        return known
    return as_array(numbers(name, value, allow_complex=allow_complex))


def _require_numbers(name: str, value: Any, dtype: np.dtype, allow_complex: bool) -> None:
    if getattr(dtype, "kind", "O") not in ("fiubc" if allow_complex else "fiub"):
        kind = "numbers" if allow_complex else "real numbers"
        raise TypeError(f"{name} is {shown(value)}; give an array of {kind}")


def points(name: str, value: Any) -> Array:
    """Pairs as the last axis of an array."""
    array = finite(name, value, "mm", shape=shape_of(value))
    if array.shape[-1:] != (2,) or 0 in array.shape:
        raise ValueError(f"{name} has shape {array.shape}; give points (y, x) in mm, (…, 2)")
    return array


def scaled(name: str, largest: Any) -> None:
    """Refuses an array by its largest absolute value: its squares must be held by float32."""
    if not is_traced(largest) and largest > 0 and not _LEAST_SCALE < largest < 1 / _LEAST_SCALE:
        raise ValueError(
            f"{name} has values up to {float(largest):.3g}; scale them to about 1, such as by "
            "their largest"
        )


def finite(name: str, value: Any, unit: str, *, shape: tuple[int, ...] = ()) -> Checked:
    array = real(name, value, unit, shape=shape)
    message = f"{name} = {{}}{_after(unit)} is not finite; give a finite number{_within(unit)}"
    return _require(array, np.isfinite, message)


def positive(
    name: str, value: Any, unit: str, *, allow_infinity: bool = False, most: float = math.inf
) -> Checked:
    array = real(name, value, unit)
    message = f"{name} = {{}}{_after(unit)} is not positive; give {name} > 0{_within(unit)}"
    _require(array, lambda known: known > 0, message)
    if math.isfinite(most):
        message = f"{name} = {{}}{_after(unit)} is out of range; give 0 < {name} <= {most:g}"
        return _require(array, lambda known: known <= most, message)
    message = f"{name} is infinite; give a finite number{_within(unit)}"
    _require(array, lambda known: allow_infinity or np.isfinite(known), message)
    if unit not in ("mm", "rad/mm^2"):
        return array
    # Beyond, products of a few of them leave the range of single precision.
    message = f"{name} = {{}} {unit} is out of range; give {_LEAST:g} to {_MOST:g} {unit}"
    most = math.inf if allow_infinity else _MOST
    return _require(array, lambda known: (known >= _LEAST) & (known <= most), message)


def relative_tolerance(tolerance: float) -> float:
    """A relative error, at most 1."""
    tolerance = float(positive("tolerance", tolerance, "parts of one"))
    if tolerance > 1:
        raise ValueError(f"tolerance = {tolerance:g} is relative: give at most 1 (0.01 is 1 %)")
    return tolerance


def non_negative(name: str, value: Any, unit: str) -> Checked:
    message = f"{name} = {{}}{_after(unit)} is negative; give {name} >= 0{_within(unit)}"
    return _require(finite(name, value, unit), lambda known: known >= 0, message)


def positive_all(name: str, value: Any, unit: str) -> Checked:
    """An array of any shape with finite positive entries."""
    array = finite(name, value, unit, shape=shape_of(value))
    least = _LEAST if unit == "mm" else 0
    message = f"{name} = {{}} {unit} must be positive; give {name} > {least:g} in {unit}"
    return _require(array, lambda known: known > least, message)


def _after(unit: str) -> str:
    return "" if unit in _RATIOS else f" {unit}"


def _within(unit: str) -> str:
    return "" if unit in _RATIOS else f" in {unit}"


def wavelength(name: str, value: Any) -> Checked:
    """One wavelength of light, mm; what must be nm, µm or m is refused."""
    return _light(name, positive(name, value, "mm"))


def wavelengths(name: str, value: Any) -> Checked:
    """Several wavelengths of light, mm, checked as one is."""
    return _light(name, positive_all(name, value, "mm"))


def _light(name: str, array: Checked) -> Checked:
    known = _known(array)
    if known is not None and np.any(known > LONGEST_LIGHT):
        raise ValueError(
            f"{name} = {known.max():g} mm is no light: give it in mm, such as 500 * nm"
        )
    low, high = _IN_METRES
    if known is not None and np.any((known > low) & (known < high)):
        raise ValueError(
            f"{name} = {known.min():g} mm is no light: give it in mm, not in m, such as 500 * nm"
        )
    return array


def pixel_pitch(name: str, value: Any) -> Checked:
    """A sensor's pixel pitch, mm; what must be µm is refused."""
    message = f"{name} = {{}} mm is no pixel: give it in mm, such as 5.5 * um"
    array = positive(name, value, "mm")
    return _require(array, lambda p: (p >= _SMALLEST_PITCH) & (p <= _LARGEST_PITCH), message)


def colours_last(shape: tuple[int, ...]) -> bool:
    """Whether images are (…, y, x, 3) as in files, or (…, y, x, 4) with alpha."""
    return len(shape) >= 3 and shape[-1] in (3, 4) and min(shape[-3:-1]) > 4


def channels_first(name: str, shape: tuple[int, ...]) -> None:
    """Refuses (…, y, x, channel), whose columns would be taken for images."""
    if colours_last(shape):
        raise ValueError(
            f"{name} has shape {shape}, the colours last; give (…, channel, y, x), such as "
            "numpy.moveaxis(image, -1, -3)"
        )


def between(name: str, value: Any, unit: str, least: float, most: float) -> Checked:
    """A number within limits, which are allowed."""
    after = _after(unit)
    message = f"{name} = {{}}{after} is out of range; give {least:g} to {most:g}{after}"
    array = finite(name, value, unit)
    return _require(array, lambda known: (least <= known) & (known <= most), message)


def decibels(name: str, value: Any) -> Checked:
    """A signal-to-noise ratio, dB."""
    return between(name, value, "dB", -60.0, 200.0)


def fraction(name: str, value: Any) -> Checked:
    """A number above 0 and at most 1."""
    message = f"{name} = {{}} is out of range; give 0 < {name} <= 1"
    return _require(real(name, value, "parts of one"), lambda known: 0 < known <= 1, message)


def transmittances(name: str, values: Any) -> Checked:
    """A one-dimensional code of numbers from 0 to 1."""
    array = finite(name, values, "parts of one", shape=shape_of(values))
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}; give a code: one row of transmittances")
    known = _known(array)
    if known is not None and (known.min() < 0 or known.max() > 1):
        raise ValueError(
            f"{name} runs from {known.min():g} to {known.max():g}; give transmittances of 0 to 1, "
            "such as (s + 1)/2 of a code s of ±1"
        )
    return array


def choice(name: str, value: Any, options: Iterable[str]) -> str:
    options = tuple(options)
    if not isinstance(value, str) or value not in options:
        listed = ", ".join(repr(o) for o in options)
        able = f"choose one of {listed}{meant(value, options)}"
        raise ValueError(f"{name} = {shown(value)} is unknown; {able}")
    return value


def whole(name: str, value: Any, least: int, most: int | None = None) -> int:
    """A whole number within limits."""
    try:
        number = least - 1 if isinstance(value, bool) or np.ndim(value) else int(value)
    except (TypeError, ValueError, OverflowError):
        number = least - 1
    top = _LARGEST_COUNT if most is None else most
    if number < least or number != value or number > top:
        small = most is None and number <= _LARGEST_COUNT
        limits = f"of at least {least}" if small else f"from {least} to {top}"
        raise ValueError(f"{name} = {shown(value)}: give a whole number {limits}")
    return number


def at_least_one(counts: dict[str, int]) -> None:
    """Refuses the first of the named counts that is below 1."""
    for name, number in counts.items():
        if not isinstance(number, int | np.integer) or number < 1:
            raise ValueError(f"{name} = {shown(number)}; give at least 1")


def whole_cells(name: str, side: Any, cell_name: str, cell: Any) -> int:
    """Number of cells that make up a side, both in mm; ValueError names the sides next to it."""
    side = float(positive(name, side, "mm"))
    cell = float(positive(cell_name, cell, "mm"))
    cells = round(side / cell)
    if cells > _MOST_CELLS:
        raise ValueError(
            f"{name} = {side:g} mm has {cells} cells of {cell_name} = {cell:g} mm; give at most "
            f"{_MOST_CELLS}"
        )
    rounding = 1e-4 * cell + 2.5e-7 * side  # both were rounded to single precision, it may be
    if cells < 1 or abs(cells * cell - side) > rounding:
        low, high = max(1, int(side / cell)) * cell, (int(side / cell) + 1) * cell
        nearest = f"{low:g} mm" if low == high else f"{low:g} or {high:g} mm"
        raise ValueError(
            f"{name} = {side:g} mm is not a whole number of cells of {cell_name} = {cell:g} mm; "
            f"give {name} = {nearest}"
        )
    return cells


def shape2d(name: str, value: Any) -> tuple[int, int]:
    """A pair (y, x) of pixel counts, each at least 1."""
    try:
        rows, columns = (int(v) for v in value)
        whole = all(int(v) == v for v in value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"{name} = {shown(value)} is not a pair (rows, columns) of pixels"
        ) from None
    if not whole or min(rows, columns) < 1 or max(rows, columns) > _LARGEST_SIDE:
        raise ValueError(
            f"{name} = {shown(value)}: give two whole numbers (rows, columns) of at least 1, and "
            f"at most {_LARGEST_SIDE}"
        )
    return rows, columns


def instance(name: str, kind: type, wanted: str, given: Any) -> Any:
    """An object of a class; `wanted` is the advice of the TypeError for any other."""
    if not isinstance(given, kind):
        raise TypeError(f"{name} is a {type(given).__name__}; give {wanted}")
    return given
