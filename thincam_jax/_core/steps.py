"""Long computations as lists of steps that report their progress."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from thincam_jax._core.arguments import any_rank

# Called as a step begins, with its text and with the number of all steps.
Progress = Callable[[str, int], object]


@dataclass(frozen=True)
class Step:
    """A part of a computation: the text that is reported as it begins, and what does it."""

    text: str
    do: Callable[[], object]


@any_rank
def carry_out(work: Sequence[Step], progress: Progress | None = None) -> None:
    """Do the steps in their order."""
    for step in work:
        if progress is not None:
            progress(step.text, len(work))
        step.do()
