"""Memory that an evaluation needs, estimated before it starts."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Cost:
    """The cost of one evaluation.

    - `flops`: real operations, transcendental functions counted as the operations they take.
    - `bytes`: peak memory, result included.
    """

    flops: float
    bytes: int

    def times(self, count: int) -> "Cost":
        """Cost of `count` evaluations, one after another."""
        return Cost(self.flops * count, self.bytes)


def available_bytes() -> int | None:
    """Free memory of the default device (of the machine, on a CPU); None where that is unknown."""
    import jax  # slow, and not needed to read a small file

    device = jax.devices()[0]
    if device.platform == "cpu":
        try:
            # Linux: what the cache of files holds is free, too, but not among the free pages.
            for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines():
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
        except OSError:
            pass
        try:
            return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (ValueError, OSError, AttributeError):
            return None
    statistics = device.memory_stats() or {}
    if "bytes_limit" not in statistics:
        return None
    return statistics["bytes_limit"] - statistics.get("bytes_in_use", 0)


def peak_memory() -> float | None:
    """Largest memory that this process held, GB to 10 MB; None where the system does not say."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1 if sys.platform == "darwin" else 1024) / 1e9, 2)


def refuse_if_too_large(what: str, needed: int, advice: str) -> None:
    """MemoryError, one line with the estimate, where `needed` bytes cannot be had."""
    available = available_bytes()
    if available is not None and needed > available:
        raise MemoryError(
            f"{what} needs about {readable(needed)}, {readable(available)} are free; {advice}"
        )


def readable(count: int) -> str:
    value = float(count)
    for unit in ("bytes", "KiB", "MiB", "GiB", "TiB", "PiB"):
        if value < 1024 or unit == "PiB":
            return f"{value:.0f} {unit}" if unit == "bytes" else f"{value:.1f} {unit}"
        value /= 1024
    raise AssertionError
