"""The tests check annotations: classes, shapes that agree within a call, fields, results."""

from dataclasses import dataclass

import numpy as np
import pytest
from checked_types import checked
from jaxtyping import Float, TypeCheckError


@checked(typechecker=None)
def product(a: Float[np.ndarray, "rows n"], b: Float[np.ndarray, "n"]) -> Float[np.ndarray, "rows"]:
    return a @ b if len(b) != 5 else b


@checked(typechecker=None)
def total(values: list[int], by: str = "") -> int:
    return product(np.ones((2, 3)), np.ones(3)).size if by else sum(values)


@checked
@dataclass
class Pair:
    a: Float[np.ndarray, "n"]
    b: Float[np.ndarray, "n"]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: product(np.ones((2, 3)), np.ones(4)),
        lambda: product(np.ones((2, 5)), np.ones(5)),
        lambda: product(np.ones((2, 3)), np.ones(3, int)),
        lambda: total((1, 2)),
        lambda: Pair(np.ones(3), np.ones(4)),
    ],
)
def test_what_is_annotated_otherwise_is_refused(wrong):
    with pytest.raises(TypeCheckError):
        wrong()


def test_lengths_are_those_of_one_call():
    assert [product(np.ones((n, n)), np.ones(n)).size for n in (2, 3)] == [2, 3]
    assert total([2, 3]) == 5 and total([], by="a call within") == 2
    assert Pair(np.ones(3), np.ones(3)).b.size == 3
