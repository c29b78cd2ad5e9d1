"""What may not grow in a long run."""

from collections.abc import Sequence
from pathlib import Path

GROWTH = 1.5  # [MB] that a process may differ by between the second quarter and the last


def resident(pid: int | str = "self") -> float:
    """Return the memory [MB] that a process has."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


def quarters(values: Sequence[float]) -> tuple[float, float]:
    """Return the means of the second quarter and of the last: what a start needs is no growth."""
    quarter = max(1, len(values) // 4)
    before, after = values[quarter : 2 * quarter] or values, values[-quarter:]
    return sum(before) / len(before), sum(after) / len(after)
