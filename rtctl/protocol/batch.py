"""A cycle's frames at once, in one compiled pass: to the bit what `mit` and `e2e` make of them one by one.

Only a whole and healthy cycle is taken here; anything else is for the patient code to judge, frame by frame.
"""

from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.protocol import e2e, frame, mit
from rtctl.types import F64, I64, U8

_DATA = 8  # where the data begin in a raw frame
_AT_LENGTH = 4
_FILL = mit.encode_torque(0.0, 1.0)[:6]  # p, v, kp and kd of a command of torque alone
_WANTED = int(e2e.Wanted.TORQUE)


def _crc_table() -> I64:
    table = np.zeros(256, np.int64)
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        table[byte] = crc
    return table


_TABLE = _crc_table()


class Cycle(NamedTuple):
    """What never changes about the frames of n joints."""

    protected: bool  # mit+e2e
    scale: F64  # (n, 3) p_max [rad], v_max [rad/s], t_max [Nm]
    can_id: I64  # (n,) of commands; replies come under mit.REPLY_OFFSET more
    words: U8  # (n, 4) the first bytes of each reply
    template: U8  # (n, size) commands of 0 Nm, unprotected


class Replies(NamedTuple):
    """A cycle's replies by joint."""

    whole: bool  # one intact reply of each, each the next in its sequence; otherwise the rest means nothing
    state: F64  # (3, n) position [rad], velocity [rad/s], torque [Nm]
    codes: I64  # (5, n) drive status, temperatures [degC] of driver and coil, counter, report


def cycle_of(protected: bool, fd: bool, can_ids: tuple[int, ...], scales: tuple[mit.Scale, ...]) -> Cycle:
    """Return what the frames of these joints have in common."""
    length, size = (e2e.LENGTH if protected else mit.LENGTH), (frame.CANFD_MTU if fd else frame.CAN_MTU)
    flags = frame.FD_FDF | frame.FD_BRS if fd else 0
    heads = [frame.HEAD.pack(i, length, flags) + b"\0\0" + _FILL for i in can_ids]
    words = [frame.HEAD.pack(i + mit.REPLY_OFFSET, 0, 0)[:4] for i in can_ids]
    return Cycle(
        protected,
        np.array(scales, np.float64).reshape(-1, 3),
        np.array(can_ids, np.int64),
        np.frombuffer(b"".join(words), np.uint8).reshape(-1, 4).copy(),
        np.frombuffer(b"".join(head.ljust(size, b"\0") for head in heads), np.uint8).reshape(-1, size).copy(),
    )


def decode(cycle: Cycle, raw: list[bytes], last: list[int]) -> Replies | None:
    """Return the replies in raw frames of any order, None unless they are of the right number and size.

    last: counter of the newest reply of each joint, for protected frames.
    """
    n, size = cycle.template.shape
    if len(raw) != n or set(map(len, raw)) != {size}:
        return None
    frames = np.frombuffer(b"".join(raw), np.uint8).reshape(n, size)
    return Replies(*_decode(frames, cycle.protected, cycle.scale, cycle.can_id, cycle.words, np.array(last)))


def encode(cycle: Cycle, tau: F64, counters: I64) -> list[bytes]:
    """Return a raw frame of torque [Nm] for each joint; counts on in `counters` (n,) where frames are protected."""
    out = cycle.template.copy()
    _encode(out, cycle.protected, cycle.scale, cycle.can_id, tau, counters)
    raw, size = out.tobytes(), out.shape[1]
    return [raw[at : at + size] for at in range(0, len(raw), size)]


@kernel
def _crc(data: U8, can_id: int) -> int:
    crc: int = 0xFFFF
    for i in range(e2e.COVERED):
        crc = (crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ data[i]]
    crc = (crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ (can_id >> 8)]
    return int((crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ (can_id & 0xFF)])


@kernel
def _decode(frames: U8, protected: bool, scale: F64, can_id: I64, words: U8, last: I64) -> tuple[bool, F64, I64]:
    n = frames.shape[0]
    state, codes, seen = np.empty((3, n)), np.zeros((5, n), np.int64), np.zeros(n, np.bool_)
    for i in range(n):
        j = 0
        while j < n and not (
            frames[i, 0] == words[j, 0]
            and frames[i, 1] == words[j, 1]
            and frames[i, 2] == words[j, 2]
            and frames[i, 3] == words[j, 3]
        ):
            j += 1
        if j == n or seen[j] or frames[i, _AT_LENGTH] != (e2e.LENGTH if protected else mit.LENGTH):
            return False, state, codes
        seen[j] = True
        data = frames[i, _DATA:]
        if data[0] & 0xF != can_id[j] & 0xF:
            return False, state, codes
        if protected:
            sent = np.int64(data[e2e.COVERED]) << 8 | np.int64(data[e2e.COVERED + 1])
            if _crc(data, can_id[j] + mit.REPLY_OFFSET) != sent or data[8] != (last[j] + 1) & 0xFF:
                return False, state, codes
            codes[3, j], codes[4, j] = data[8], data[9]
        b = data[:8].astype(np.int64)
        p_max, v_max, t_max = scale[j, 0], scale[j, 1], scale[j, 2]
        state[0, j] = (b[1] << 8 | b[2]) * (2.0 * p_max / 65535.0) - p_max
        state[1, j] = (b[3] << 4 | b[4] >> 4) * (2.0 * v_max / 4095.0) - v_max
        state[2, j] = ((b[4] & 0xF) << 8 | b[5]) * (2.0 * t_max / 4095.0) - t_max
        codes[0, j], codes[1, j], codes[2, j] = b[0] >> 4, b[6], b[7]
    return True, state, codes


@kernel
def _encode(out: U8, protected: bool, scale: F64, can_id: I64, tau: F64, counters: I64) -> None:
    for j in range(out.shape[0]):
        t_max = scale[j, 2]
        t = tau[j] if np.isfinite(tau[j]) else 0.0
        code = np.int64(min(max((t + t_max) * 4095 / (t_max + t_max), 0.0), 4095) + 0.5)
        data = out[j, _DATA:]
        data[6], data[7] = code >> 8, code & 0xFF
        if protected:
            counters[j] = (counters[j] + 1) & 0xFF
            data[8], data[9] = counters[j], _WANTED
            crc = _crc(data, can_id[j])
            data[10], data[11] = crc >> 8, crc & 0xFF


def warm(cycle: Cycle) -> None:
    """Compile or load both kernels; no frame is needed."""
    n = len(cycle.can_id)
    _encode(cycle.template.copy(), cycle.protected, cycle.scale, cycle.can_id, np.zeros(n), np.zeros(n, np.int64))
    decode(cycle, [bytes(cycle.template.shape[1])] * n, [0] * n)
