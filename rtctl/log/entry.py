"""What a producer hands to the log: kinds of entries, and batches of them on their way to the file."""

from enum import IntEnum
from typing import NamedTuple, TypeAlias

Payload: TypeAlias = bytes | bytearray | memoryview  # of single bytes, so that its len() is its size


class Kind(IntEnum):
    """The kinds of `put`; for CAN_TX and CAN_RX add `bus << 8` for the bus of that index in `Header.buses`."""

    TICK = 1  # bytes of one record of `Header.dtype`
    CAN_TX = 2  # raw struct can_frame (16 bytes) or canfd_frame (72 bytes)
    CAN_RX = 3
    EVENT = 4  # a JSON object, UTF-8
    REQUEST = 5  # JSON of `replay.encode_request`
    SENTINEL = 6  # JSON: why the producer closes the log
    MAV_TX = 7  # one MAVLink packet; add `link << 8` for the link of that index in `Header.links`
    MAV_RX = 8
    CHECKPOINT = 9  # JSON of `checkpoint.encode_checkpoint`


_RX = int(Kind.CAN_RX)  # comparing with the enum's member takes longer than a put should


def stream(kind: int) -> int:
    """Return the sequence-number stream of a kind: both directions of a bus share one."""
    return kind - 1 if kind & 0xFF == _RX else kind


class Batch(NamedTuple):
    """Entries in the order in which they were put; equal-length columns."""

    kind: list[int]
    number: list[int]  # 1, 2, 3 ... over all kinds; a hole is an entry that was dropped
    time: list[int]  # [ns] monotonic
    sequence: list[int]  # 1, 2, 3 ... within the entry's stream; a hole is an entry that was dropped
    payload: list[Payload]


def empty() -> Batch:
    """Return a batch to be filled."""
    return Batch([], [], [], [], [])
