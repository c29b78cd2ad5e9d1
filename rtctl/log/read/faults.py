"""The faults that a log's bits mean: an arm and a base have tables of their own."""

from rtctl.log.header import Header


def fault_table(header: Header) -> list[str]:
    """Return the names of faults by bit."""
    if header.extra.get("kind") == "base":
        from rtctl.rover.faults import FAULTS as BASE_FAULTS

        return [fault.name for fault in BASE_FAULTS]
    from rtctl.arm.faults import FAULTS

    return [fault.name for fault in FAULTS]


def fault_names(header: Header, bits: int) -> list[str]:
    """Return the names of the faults in `bits`."""
    return [name for i, name in enumerate(fault_table(header)) if bits >> i & 1]
