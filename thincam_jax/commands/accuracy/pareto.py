"""Which entries of a table of errors and times are worth choosing."""

from collections.abc import Sequence

_GAIN = 0.05  # a smaller error by less than this part is no gain


def worth_choosing(errors: Sequence[float], seconds: Sequence[float]) -> list[bool]:
    """True where no other entry is as fast and as accurate: the Pareto front.

    Errors within 5 % of each other count as equal, so that the last digits of a model's error do
    not make its slower precision worth choosing. Of entries that are equal in both the first is.
    """
    flags = [False] * len(errors)
    best = float("inf")
    for index in sorted(range(len(errors)), key=lambda i: (seconds[i], errors[i])):
        if errors[index] < (1 - _GAIN) * best:
            best, flags[index] = errors[index], True
    return flags
