"""CAN frames as the kernel's structs: `struct can_frame` (16 bytes) and `struct canfd_frame` (72 bytes).

Every link of the program carries these bytes, whatever moves them, so a log reads the same for all of them.
"""

import struct
from typing import NamedTuple

CAN_MTU = 16
CANFD_MTU = 72

EFF_FLAG = 0x80000000  # 29-bit identifier
RTR_FLAG = 0x40000000
ERR_FLAG = 0x20000000  # an error report of the controller, not a frame of the bus
SFF_MASK = 0x7FF
EFF_MASK = 0x1FFFFFFF

FD_BRS = 0x01
FD_FDF = 0x04

ERR_CRTL = 0x04  # data[1] tells more
ERR_BUSOFF = 0x40
ERR_RESTARTED = 0x100
CRTL_OVERFLOW = 0x03  # receive or transmit buffer of the controller
CRTL_PASSIVE = 0x30  # receive or transmit error counter above 127
CRTL_STATES = 0x7C  # any of the bits that report an error state: warning, passive, active again

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)

HEAD = struct.Struct("=IBB")  # identifier with flags, length, FD flags; host endianness as the kernel's
_CLASSIC = struct.Struct("=IB3x8s")
_FD = struct.Struct("=IBB2x64s")


class Frame(NamedTuple):
    """One CAN frame; `can_id` without flag bits."""

    can_id: int
    data: bytes
    fd: bool = False
    brs: bool = False
    extended: bool = False
    rtr: bool = False
    error: bool = False


def pack(
    can_id: int,
    data: bytes,
    fd: bool = False,
    brs: bool = False,
    extended: bool = False,
    rtr: bool = False,
    error: bool = False,
) -> bytes:
    """Return the kernel's bytes of one frame; ValueError for an identifier or a length the bus cannot carry."""
    if not 0 <= can_id <= (EFF_MASK if extended or error else SFF_MASK):
        raise ValueError(f"identifier {can_id:#x} does not fit")
    word = can_id | (EFF_FLAG if extended else 0) | (RTR_FLAG if rtr else 0) | (ERR_FLAG if error else 0)
    if not fd:
        if len(data) > 8 or brs:
            raise ValueError(f"a classic frame of {len(data)} bytes{' with bit-rate switch' if brs else ''}")
        return _CLASSIC.pack(word, len(data), data)
    if len(data) not in FD_LENGTHS or rtr:
        raise ValueError(f"an FD {'remote ' if rtr else ''}frame of {len(data)} bytes")
    return _FD.pack(word, len(data), FD_FDF | (FD_BRS if brs else 0), data)


def unpack(raw: bytes) -> Frame:
    """Return the frame in the kernel's bytes; ValueError if they are not one whole frame."""
    fd = len(raw) == CANFD_MTU
    if not fd and len(raw) != CAN_MTU:
        raise ValueError(f"{len(raw)} bytes are no CAN frame")
    word, length, flags = HEAD.unpack_from(raw)
    if length > (64 if fd else 8):
        raise ValueError(f"a length of {length} in a {len(raw)}-byte frame")
    extended = bool(word & EFF_FLAG)
    error = bool(word & ERR_FLAG)
    return Frame(
        can_id=word & (EFF_MASK if extended or error else SFF_MASK),
        data=bytes(raw[8 : 8 + length]),
        fd=fd,
        brs=fd and bool(flags & FD_BRS),
        extended=extended,
        rtr=bool(word & RTR_FLAG),
        error=error,
    )
