"""Arguments of another kind than annotated: one line with what was given and what to give."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Bool, Float, PRNGKeyArray

import thincam_jax as tc
from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import whole


@checked
def given(
    *,
    text: str = "",
    number: float | None = None,
    count: Annotated[int, whole(1, 9)] = 1,
    pair: tuple[float, float] = (0.0, 1.0),
    places: Sequence[int] = (),
    table: Mapping[str, Any] | None = None,
    function: Callable[[float], float] = abs,
    image: Float[Array, "y x"] | Float[np.ndarray, "y x"] | None = None,
    points: Float[Array, "*point 2"] | None = None,
    valid: Bool[np.ndarray, "y x"] | None = None,
    key: PRNGKeyArray | None = None,
    sensor: tc.Sensor | None = None,
    anything: Any = None,
) -> str:
    """What is given is as annotated."""
    return "taken"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"text": 1}, "text is 1; give a text"),
        ({"number": "5"}, "number is '5'; give a number or None"),
        ({"number": np.ones(2)}, r"number is \[1. 1.\]; give a number or None"),
        ({"count": 10}, "count = 10: give a whole number from 1 to 9"),
        ({"pair": (1.0,)}, r"pair is \(1.0,\); give 2 values, each a number"),
        ({"places": [1, 2.5]}, r"places is \[1, 2.5\]; give a sequence, each a whole number"),
        ({"table": [1]}, r"table is \[1\]; give a dictionary or None"),
        ({"function": 3}, "function is 3; give a function"),
        ({"image": np.full((2, 3), np.nan)}, "of shape .2, 3.; give an array .y, x. of finite"),
        ({"points": np.float64(1)}, r"give an array \(\*point, 2\) of finite numbers"),
        ({"key": 0}, r"key is 0; give jax.random.key\(seed\) or None"),
        ({"sensor": (3, 4)}, r"sensor is \(3, 4\); give Sensor\(shape, pitch, …\) or None"),
    ],
)
def test_another_kind_is_one_line(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message) as raised:
        given(**arguments)
    assert "\n" not in str(raised.value)


def test_classes_are_checked_as_they_are_made():
    @checked
    @dataclass(frozen=True)
    class Record:
        name: str
        size: float = 1.0

    assert Record("a", size=2).size == 2
    with pytest.raises(TypeError, match="size is 'b'; give a number"):
        Record("a", "b")


def test_traced_numbers_pass():
    @checked
    def twice(number: float, image: Float[Array, " x"]) -> Any:
        return 2 * number * image

    np.testing.assert_allclose(jax.jit(twice)(3.0, jnp.ones(2)), 6.0)
