"""The drive's own reading of the wire: MIT-mode fields, register frames and the end-to-end trailer.

Written from the protocol's text, not from the controller's codec, so that a mistake made in one of them shows.
"""

import math
import struct
from typing import NamedTuple

ENABLE, DISABLE, ZERO, CLEAR = 0xFC, 0xFD, 0xFE, 0xFB
SPECIAL_HEAD = b"\xff" * 7
REGISTER_ID = 0x7FF  # broadcast id of register frames
READ, WRITE, SAVE, REFRESH = 0x33, 0x55, 0xAA, 0xCC
KP_MAX, KD_MAX = 500.0, 5.0  # fixed by the protocol for every drive

# registers: number -> (name, is a float)
MST_ID, ESC_ID, TIMEOUT, CTRL_MODE, PMAX, VMAX, TMAX, BAUD = 7, 8, 9, 10, 21, 22, 23, 35
FLOAT_REGISTERS = frozenset((PMAX, VMAX, TMAX))
TIMEOUT_NS = 50_000  # one count of register TIMEOUT
BAUD_CODES = {125_000: 0, 200_000: 1, 250_000: 2, 500_000: 3, 1_000_000: 4, 2_000_000: 5, 2_500_000: 6, 3_200_000: 7}
BAUD_CODES |= {4_000_000: 8, 5_000_000: 9, 8_000_000: 10}

TORQUE_WANTED = 0x01  # command status byte
WATCHDOG, CLAMPED, SLEWED, DERATED, BRAKE = 0x01, 0x02, 0x04, 0x08, 0x10  # reply status byte


class Scale(NamedTuple):
    """Full scale of the drive's fields: +-p [rad], +-v [rad/s], +-t [Nm]."""

    p: float
    v: float
    t: float


class Command(NamedTuple):
    """A decoded MIT command, tau = kp (p - q) + kd (v - qd) + t; or a special frame when `special` is not 0."""

    special: int
    p: float
    v: float
    kp: float
    kd: float
    t: float


class Register(NamedTuple):
    """A decoded register frame; `raw` holds the four value bytes as they came."""

    motor: int
    operation: int
    number: int
    raw: bytes


def quantise(x: float, bound: float, bits: int) -> int:
    """Return u = round((x + bound)(2^bits - 1) / (2 bound)), saturated; a value that is not finite is sent as 0."""
    top = (1 << bits) - 1
    if not math.isfinite(x):
        x = 0.0
    x = min(max(x, -bound), bound)
    return math.floor((x + bound) * top / (2.0 * bound) + 0.5)


def restore(u: int, bound: float, bits: int) -> float:
    """Return x = u 2 bound / (2^bits - 1) - bound."""
    return u * (2.0 * bound) / ((1 << bits) - 1) - bound


def decode_command(data: bytes, scale: Scale) -> Command:
    """Read the 8 bytes p16 | v12 | kp12 | kd12 | t12; every bit pattern decodes to finite values within full scale."""
    if data[:7] == SPECIAL_HEAD and CLEAR <= data[7] <= ZERO:
        return Command(data[7], 0.0, 0.0, 0.0, 0.0, 0.0)
    word = int.from_bytes(data[:8], "big")
    return Command(
        0,
        restore(word >> 48, scale.p, 16),
        restore(word >> 36 & 0xFFF, scale.v, 12),
        (word >> 24 & 0xFFF) * KP_MAX / 4095.0,
        (word >> 12 & 0xFFF) * KD_MAX / 4095.0,
        restore(word & 0xFFF, scale.t, 12),
    )


def encode_state(motor: int, err: int, q: float, qd: float, tau: float, temps: tuple[int, int], scale: Scale) -> bytes:
    """Return the 8 bytes [err<<4 | id] p16 | v12 | t12 | T_mos | T_rotor; temperatures in [degC], saturated to u8."""
    p, v, t = quantise(q, scale.p, 16), quantise(qd, scale.v, 12), quantise(tau, scale.t, 12)
    mos, rotor = (min(max(x, 0), 255) for x in temps)
    return bytes((err << 4 | motor & 0xF, p >> 8, p & 0xFF, v >> 4, (v & 0xF) << 4 | t >> 8, t & 0xFF, mos, rotor))


def decode_register(data: bytes) -> Register:
    """Read [id_lo id_hi][operation][number][4 bytes]."""
    return Register(data[0] | data[1] << 8, data[2], data[3], bytes(data[4:8]))


def encode_register(motor: int, operation: int, number: int, raw: bytes) -> bytes:
    """Return the 8 bytes of a register reply."""
    return struct.pack("<HBB", motor, operation, number) + raw


def register_bytes(number: int, value: float) -> bytes:
    """Return a register's value as its 4 wire bytes: float32 for the scales, u32 for the rest, little-endian."""
    return struct.pack("<f", value) if number in FLOAT_REGISTERS else struct.pack("<I", int(value))


def register_value(number: int, raw: bytes) -> float:
    """Read a register's 4 wire bytes."""
    value: float = struct.unpack("<f" if number in FLOAT_REGISTERS else "<I", raw)[0]
    return value


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return table


CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE: polynomial 0x1021, initial 0xFFFF, no reflection, no final xor."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ CRC_TABLE[crc >> 8 ^ byte]
    return crc


def protect(data: bytes, counter: int, status: int, can_id: int) -> bytes:
    """Return 12 bytes: data(8), counter, status, CRC over those ten and the id, big-endian."""
    body = data + bytes((counter & 0xFF, status))
    return body + crc16(body + can_id.to_bytes(2, "big")).to_bytes(2, "big")


def intact(data: bytes, can_id: int) -> bool:
    """Tell whether a 12-byte frame carries the right CRC for its contents and its id."""
    return crc16(data[:10] + can_id.to_bytes(2, "big")) == data[10] << 8 | data[11]
