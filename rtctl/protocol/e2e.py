"""End-to-end protection of one frame: a counter, a status byte and a CRC over data and identifier.

    12 bytes = 8 MIT bytes | u8 counter | u8 status | u16 CRC big-endian

The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF) over the first ten bytes and then the 11-bit
identifier as two bytes, so that a frame whose identifier was changed on its way fails as well.
"""

from binascii import crc_hqx
from enum import IntEnum, IntFlag
from typing import NamedTuple

import numpy as np

from rtctl.types import I64

LENGTH = 12
PAYLOAD = 8
COVERED = 10  # payload, counter, status
DISORDER_LIMIT = 5  # wrong sequences, less right ones, until a link counts as disordered


class Check(IntEnum):
    """What the receiver makes of one cycle's frame."""

    OK = 0
    REPEATED = 1  # the same counter again: nothing new
    WRONGSEQUENCE = 2  # the counter jumped
    WRONGCRC = 3  # corrupted, of a wrong length or meant for another identifier
    NODATA = 4  # nothing came


class Wanted(IntFlag):
    """Status byte of a command."""

    NONE = 0
    TORQUE = 1


class Report(IntFlag):
    """Status byte of a reply: what the drive did about the last command."""

    NONE = 0
    WATCHDOG = 1  # tripped, latched
    CLAMPED = 2
    SLEW = 4
    DERATED = 8
    BRAKE = 16  # closed


class Received(NamedTuple):
    """The verdict on one frame; `lost` frames are missing before it, a negative number came before in its stead."""

    check: Check
    lost: int = 0

    @property
    def fresh(self) -> bool:
        """True if the frame is newer than all before it and so its data may be used."""
        return self.check is Check.OK or (self.check is Check.WRONGSEQUENCE and self.lost > 0)


def crc(data: bytes, can_id: int) -> int:
    """Return the CRC of ten covered bytes `data` sent under `can_id`."""
    return crc_hqx(can_id.to_bytes(2, "big"), crc_hqx(data, 0xFFFF))


def protect(payload: bytes, counter: int, status: int, can_id: int) -> bytes:
    """Return the 12 protected bytes; ValueError unless there are 8 payload bytes."""
    if len(payload) != PAYLOAD:
        raise ValueError(f"{len(payload)} payload bytes")
    covered = payload + bytes((counter & 0xFF, status & 0xFF))
    return covered + crc(covered, can_id).to_bytes(2, "big")


def intact(data: bytes, can_id: int) -> bool:
    """True if `data` is a protected frame whose CRC belongs to it and to `can_id`."""
    return len(data) == LENGTH and crc(data[:COVERED], can_id) == int.from_bytes(data[COVERED:], "big")


def sequence(last: int, counter: int) -> Received:
    """Judge a counter against the last one taken; `last` < 0 before the first frame, which is always taken.

    The shorter way round the circle of 256 decides whether the frame is newer or older.
    """
    if last < 0:
        return Received(Check.OK)
    step = (counter - last) & 0xFF
    if step == 1:
        return Received(Check.OK)
    if step == 0:
        return Received(Check.REPEATED)
    return Received(Check.WRONGSEQUENCE, step - 1 if step < 128 else step - 256)


class Receivers:
    """The receiving ends of n protected streams: the newest counter of each, and how disordered it is."""

    __slots__ = ("disorder", "last")

    def __init__(self, n: int) -> None:
        self.last: I64 = np.full(n, -1)  # counter of the newest frame taken
        self.disorder: I64 = np.zeros(n, np.int64)  # 0..5: wrong sequences up, right ones down

    def restart(self, stream: int, counter: int) -> None:
        """Take a frame as the first of a new stream."""
        self.last[stream], self.disorder[stream] = counter, 0

    def judge(self, stream: int, counter: int) -> Received:
        """Return the verdict on a frame whose CRC was right, and remember it.

        A stream that stays wrong (a drive that began to count anew) is taken up again once `disorder` is full: by
        then the fault is reported, and damping the arm needs its angles.
        """
        disorder = int(self.disorder[stream])
        received = sequence(int(self.last[stream]), counter)
        if received.check is Check.OK:
            self.disorder[stream] = max(disorder - 1, 0)
            self.last[stream] = counter
        elif received.check is Check.WRONGSEQUENCE:
            self.disorder[stream] = min(disorder + 1, DISORDER_LIMIT)
            if received.lost > 0 or disorder == DISORDER_LIMIT:
                self.last[stream] = counter
        return received
