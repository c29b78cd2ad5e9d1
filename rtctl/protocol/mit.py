"""The MIT-mode drive protocol: bytes <-> values.

    command   p16 | v12 | kp12 | kd12 | t12, big-endian; the drive applies kp (p - q) + kd (v - qd) + t
    reply     err4 id4 | p16 | v12 | t12 | T_mos | T_rotor
    register  id_lo id_hi | 33 read, 55 write | RID | 4 bytes little-endian, on identifier 0x7FF

A field holds u = round((x - min) (2^n - 1) / (max - min)), saturated, never wrapped. Rounding matters: codecs that
truncate send -1/2 LSB for 0 Nm. Faults of the wire are values here: nothing raises on what came from the bus.
"""

import struct
from math import isfinite
from typing import Final, NamedTuple

KP_MAX: Final = 500.0  # [Nm/rad]
KD_MAX: Final = 5.0  # [Nm s/rad]
REPLY_OFFSET: Final = 0x10  # MST_ID = motor id + 0x10
REGISTER_ID: Final = 0x7FF
LENGTH: Final = 8

ENABLE: Final = b"\xff" * 7 + b"\xfc"
DISABLE: Final = b"\xff" * 7 + b"\xfd"
ZERO: Final = b"\xff" * 7 + b"\xfe"
CLEAR: Final = b"\xff" * 7 + b"\xfb"

READ: Final = 0x33
WRITE: Final = 0x55

MST_ID: Final = 7
ESC_ID: Final = 8
TIMEOUT: Final = 9
CTRL_MODE: Final = 10
PMAX: Final = 21
VMAX: Final = 22
TMAX: Final = 23
BAUD: Final = 35

MODE_MIT: Final = 1
TIMEOUT_S: Final = 50e-6  # [s] of one count of register TIMEOUT; 0 counts switch the watchdog off
REGISTERS: Final = {
    MST_ID: "MST_ID",
    ESC_ID: "ESC_ID",
    TIMEOUT: "TIMEOUT",
    CTRL_MODE: "CTRL_MODE",
    PMAX: "PMAX",
    VMAX: "VMAX",
    TMAX: "TMAX",
    BAUD: "BAUD",
}
FLOATS: Final = frozenset((PMAX, VMAX, TMAX))  # the others are unsigned integers

DISABLED: Final = 0
ENABLED: Final = 1
STATUS: Final = {
    DISABLED: "disabled",
    ENABLED: "enabled",
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "driver too hot",
    0xC: "coil too hot",
    0xD: "communication lost",
    0xE: "overload",
}


# p and v at 0, kp and kd at 0: the six bytes before a torque; no special frame can begin so.
_TORQUE_ALONE: Final = bytes.fromhex("800080000000")


class Scale(NamedTuple):
    """What the fields of a drive type span: +-p_max [rad], +-v_max [rad/s], +-t_max [Nm]."""

    p_max: float
    v_max: float
    t_max: float


# Published tables disagree (DM4340 also with 10 rad/s), so these are what a config means, and the handshake refuses a
# drive whose own registers say otherwise.
DRIVES: Final = {
    "DM4310": Scale(12.5, 30.0, 10.0),
    "DM4310_48V": Scale(12.5, 50.0, 10.0),
    "DM4340": Scale(12.5, 8.0, 28.0),
    "DM4340_48V": Scale(12.5, 10.0, 28.0),
    "DM6006": Scale(12.5, 45.0, 20.0),
    "DM8006": Scale(12.5, 45.0, 40.0),
    "DM8009": Scale(12.5, 45.0, 54.0),
    "DM10010": Scale(12.5, 20.0, 200.0),
    "DM10010L": Scale(12.5, 25.0, 200.0),
}


class Reply(NamedTuple):
    """State reply of a drive."""

    id: int  # low nibble of the motor id
    err: int  # key of STATUS
    p: float  # [rad]
    v: float  # [rad/s]
    t: float  # [Nm]
    t_mos: int  # [degC]
    t_rotor: int  # [degC]


class Register(NamedTuple):
    """A register as it travels: the value is the 4 bytes, read as `number` or `real`."""

    motor_id: int
    write: bool
    rid: int
    value: bytes  # 4 bytes, little-endian

    @property
    def number(self) -> int:
        """The value as an unsigned integer."""
        return int.from_bytes(self.value, "little")

    @property
    def real(self) -> float:
        """The value as a float32."""
        return float(struct.unpack("<f", self.value)[0])


def code(x: float, low: float, high: float, bits: int) -> int:
    """Return the field of x in [low, high]: rounded, saturated; what is not finite counts as 0."""
    top = (1 << bits) - 1
    if not isfinite(x):
        x = 0.0
    return int(min(max((x - low) * top / (high - low), 0.0), top) + 0.5)


def encode_command(p: float, v: float, kp: float, kd: float, t: float, scale: Scale) -> bytes:
    """Return the 8 bytes of a command; p [rad], v [rad/s], kp [Nm/rad], kd [Nm s/rad], t [Nm].

    All fields at their top would be the bytes of a special frame (FF x 7 + FA..FF): then kd gives way by one step.
    """
    p_max, v_max, t_max = scale
    word = code(p, -p_max, p_max, 16) << 48 | code(v, -v_max, v_max, 12) << 36
    word |= code(kp, 0.0, KP_MAX, 12) << 24 | code(kd, 0.0, KD_MAX, 12) << 12 | code(t, -t_max, t_max, 12)
    if word >> 8 == (1 << 56) - 1:
        word -= 1 << 12
    return word.to_bytes(8, "big")


def encode_torque(t: float, t_max: float) -> bytes:
    """Return the 8 bytes of a command of torque t [Nm] alone: p, v, kp and kd are 0."""
    return _TORQUE_ALONE + code(t, -t_max, t_max, 12).to_bytes(2, "big")


def decode_reply(data: bytes, scale: Scale) -> Reply | None:
    """Return the reply in 8 bytes, or None if there are not 8 of them; every pattern of 8 bytes is a finite reply."""
    if len(data) != LENGTH:
        return None
    word = int.from_bytes(data, "big")
    p_max, v_max, t_max = scale
    # x = u (2 x_max) / (2^n - 1) - x_max, written out: seven joints, each cycle.
    return Reply(
        word >> 56 & 0xF,
        word >> 60,
        (word >> 40 & 0xFFFF) * (2.0 * p_max / 65535.0) - p_max,
        (word >> 28 & 0xFFF) * (2.0 * v_max / 4095.0) - v_max,
        (word >> 16 & 0xFFF) * (2.0 * t_max / 4095.0) - t_max,
        word >> 8 & 0xFF,
        word & 0xFF,
    )


def read_register(motor_id: int, rid: int) -> bytes:
    """Return the 8 bytes that ask a drive for a register; they go out on REGISTER_ID."""
    return struct.pack("<HBBI", motor_id, READ, rid, 0)


def write_register(motor_id: int, rid: int, x: float) -> bytes:
    """Return the 8 bytes that set a register, as float32 or unsigned integer as its kind wants."""
    field = struct.pack("<f", x) if rid in FLOATS else struct.pack("<I", int(x))
    return struct.pack("<HBB", motor_id, WRITE, rid) + field


def decode_register(data: bytes) -> Register | None:
    """Return the register in 8 bytes, or None if they carry none."""
    if len(data) != LENGTH or data[2] not in (READ, WRITE):
        return None
    return Register(data[0] | data[1] << 8, data[2] == WRITE, data[3], bytes(data[4:8]))
