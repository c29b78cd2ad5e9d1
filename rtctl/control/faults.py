"""What a fault table is, whatever the vehicle: rows, reactions, and how long a fault stays in force."""

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from rtctl.kernel import kernel
from rtctl.types import I64, Severity, State

GOOD_TICKS = 50  # an automatic fault clears after this many ticks without it

NO_DETAILS: Mapping[str, str] = MappingProxyType({})


class Fault(NamedTuple):
    """One row of the table."""

    name: str
    row: int  # of the catalogue
    severity: Severity
    clear: str  # A = by itself after GOOD_TICKS, R = operator's reset, L = restart of the daemon
    text: str
    untrue: tuple[str, ...] = ()  # what of position, speed, torque, link may no longer be believed


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


class FaultTable(NamedTuple):
    """The faults of one kind of vehicle, and what follows from their rows. Bit i of a word of faults is row i."""

    faults: tuple[Fault, ...]
    by_name: dict[str, Fault]
    bit: dict[str, int]
    automatic: int  # bits of the faults that clear by themselves
    lasting: int  # bits of those that only a restart clears

    @classmethod
    def of(cls, faults: Sequence[Fault]) -> "FaultTable":
        """Return the table of rows, at most 64 of them."""
        bit = {fault.name: 1 << i for i, fault in enumerate(faults)}
        by_rule = {rule: sum(bit[f.name] for f in faults if f.clear == rule) for rule in "AL"}
        return cls(tuple(faults), {f.name: f for f in faults}, bit, by_rule["A"], by_rule["L"])

    def latch(self, present: int, latched: int, good: I64) -> tuple[int, I64]:
        """Return the faults in force and how many ticks each has been absent, (faults,).

        A fault with clear rule A stays in force until it was absent for GOOD_TICKS; R and L stay until `cleared`.
        """
        return latch_with(present, latched, good, self.automatic)

    def cleared(self, in_force: int, present: int) -> int:
        """Return what is left in force after an operator's reset: what is present, and what needs a restart."""
        return in_force & (present | self.lasting)

    def severity(self, bits: int) -> Severity:
        """Return the worst reaction that the faults in `bits` ask for."""
        worst = Severity.NONE
        for fault in self._rows(bits):
            if fault.severity > worst:
                worst = fault.severity
        return worst

    def stops(self, bits: int) -> Severity:
        """Return the worst reaction among the faults that an operator must reset: these leave RUN for good."""
        return self.severity(bits & ~self.automatic)

    def names(self, bits: int) -> tuple[str, ...]:
        """Return the names of the faults in `bits`, in table order."""
        return tuple(fault.name for fault in self._rows(bits))

    def reasons(self, bits: int) -> str:
        """Return the faults in `bits` as the reason of a refusal, '' for none."""
        return "; ".join(f"{fault.name} ({fault.text})" for fault in self._rows(bits))

    def describe(self, bits: int, state: State, details: Mapping[str, str] = NO_DETAILS) -> str:
        """Return one line that names each fault in `bits`; details: what is added to the text of some, by name."""
        parts = [f"{fault.name}: {fault.text}{details.get(fault.name, '')}" for fault in self._rows(bits)]
        return f"{state.name}: " + "; ".join(parts) if parts else state.name

    def _rows(self, bits: int) -> Iterator[Fault]:
        return (fault for i, fault in enumerate(self.faults if bits else ()) if bits >> i & 1)
