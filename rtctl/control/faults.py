"""What a fault table is, whatever the vehicle: rows, reactions, and how long a fault stays in force."""

from typing import NamedTuple

from rtctl.kernel import kernel
from rtctl.types import I64, Severity

GOOD_TICKS = 50  # an automatic fault clears after this many ticks without it


class Fault(NamedTuple):
    """One row of the table."""

    name: str
    row: int  # of the catalogue
    severity: Severity
    clear: str  # A = by itself after GOOD_TICKS, R = operator's reset, L = restart of the daemon
    text: str


@kernel
def latch_with(present: int, latched: int, good: I64, automatic: int) -> tuple[int, I64]:
    """Return what `latch` does, for a table whose faults in the bits `automatic` clear by themselves."""
    out = good + 1
    in_force = present
    for i in range(good.shape[0]):
        if present >> i & 1:
            out[i] = 0
        if latched >> i & 1 and (not automatic >> i & 1 or out[i] < GOOD_TICKS):
            in_force |= 1 << i
    return in_force, out
