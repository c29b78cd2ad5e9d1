"""Between drive and joint: a drive may turn the other way round, from a zero of its own, and whole turns further.

    p = direction q + zero + 2 pi turns        v = direction qd        t = direction tau

p, v, t are what the drive reads and gives, q, qd, tau the joint's. Everything above the wire is in joint coordinates.
"""

import math
from typing import Final, NamedTuple

from rtctl.protocol.mit import Reply, Scale, decode_reply

TURN: Final = 2.0 * math.pi


class Mounting(NamedTuple):
    """How a drive sits on its joint."""

    direction: int = 1  # or -1
    zero: float = 0.0  # [rad] that the drive reads where the joint is at 0
    turns: int = 0  # whole turns that its encoder is off, since it was switched on


STRAIGHT: Final = Mounting()


class Fields(NamedTuple):
    """What the codes of a reply are worth to the joint: value = code step + low."""

    p_step: float  # [rad]
    p_low: float
    v_step: float  # [rad/s]
    v_low: float
    t_step: float  # [Nm]
    t_low: float


class Wiring(NamedTuple):
    """A drive on the bus and on its joint."""

    can_id: int  # of its commands
    reply_id: int  # of its replies
    scale: Scale
    mounting: Mounting = STRAIGHT


def fields_of(scale: Scale, mounting: Mounting = STRAIGHT) -> Fields:
    """Return the worth of codes; of a drive mounted straight to the bit what `mit.decode_reply` makes of them."""
    (p_max, v_max, t_max), d = scale, float(mounting.direction)
    return Fields(
        d * (2.0 * p_max / 65535.0),
        d * (-p_max - offset_of(mounting)),
        d * (2.0 * v_max / 4095.0),
        d * -v_max,
        d * (2.0 * t_max / 4095.0),
        d * -t_max,
    )


def offset_of(mounting: Mounting) -> float:
    """Return what the drive reads [rad] where the joint is at 0."""
    return mounting.zero + TURN * mounting.turns


def joint_reply(data: bytes, scale: Scale, fields: Fields) -> Reply | None:
    """Return the reply in 8 bytes in joint coordinates, or None if there are not 8 of them."""
    reply = decode_reply(data, scale)
    if reply is None:
        return None
    word = int.from_bytes(data, "big")
    return reply._replace(
        p=(word >> 40 & 0xFFFF) * fields.p_step + fields.p_low,
        v=(word >> 28 & 0xFFF) * fields.v_step + fields.v_low,
        t=(word >> 16 & 0xFFF) * fields.t_step + fields.t_low,
    )


def joint_angle(p: float, mounting: Mounting) -> float:
    """Return the joint angle [rad] of a drive's reading p [rad]."""
    return mounting.direction * (p - offset_of(mounting))


def drive_angle(q: float, mounting: Mounting) -> float:
    """Return what the drive reads [rad] at a joint angle q [rad]."""
    return mounting.direction * q + offset_of(mounting)
