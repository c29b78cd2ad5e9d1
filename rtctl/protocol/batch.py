"""A cycle's frames at once, in one compiled pass: to the bit what `mounting` and `e2e` make of them one by one.

Only a whole and healthy cycle is taken here; anything else is for the patient code to judge, frame by frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.protocol import e2e, frame, mit
from rtctl.protocol.mounting import Wiring, fields_of
from rtctl.types import F64, I64, U8, Frames

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
    worth: F64  # (n, 8) of a reply's codes: `mounting.Fields`; of a command's: t_max [Nm], direction
    ids: I64  # (n, 2) of commands and of replies
    words: U8  # (n, 4) the first bytes of each reply
    block: U8  # (n, size) the commands: `encode` writes torque and protection, the rest stays


class Replies(NamedTuple):
    """A cycle's replies by joint; fresh arrays, nobody writes them any more."""

    state: F64  # (4, n) position [rad], velocity [rad/s], torque [Nm], age [s]
    codes: I64  # (6, n) drive status, temperatures [degC] of driver and coil, counter, report, number of replies: 1
    report: int  # all e2e.Report bits that some joint says


def cycle_of(protected: bool, fd: bool, drives: Sequence[Wiring]) -> Cycle:
    """Return what the frames of these joints have in common."""
    length, size = (e2e.LENGTH if protected else mit.LENGTH), (frame.CANFD_MTU if fd else frame.CAN_MTU)
    flags = frame.FD_FDF | frame.FD_BRS if fd else 0
    heads = [frame.HEAD.pack(d.can_id, length, flags) + b"\0\0" + _FILL for d in drives]
    words = [frame.HEAD.pack(d.reply_id, 0, 0)[:4] for d in drives]
    worth = [(*fields_of(d.scale, d.mounting), d.scale.t_max, d.mounting.direction) for d in drives]
    return Cycle(
        protected,
        np.array(worth, np.float64).reshape(-1, 8),
        np.array([(d.can_id, d.reply_id) for d in drives], np.int64).reshape(-1, 2),
        np.frombuffer(b"".join(words), np.uint8).reshape(-1, 4).copy(),
        np.frombuffer(b"".join(head.ljust(size, b"\0") for head in heads), np.uint8).reshape(-1, size).copy(),
    )


def decode(cycle: Cycle, frames: Frames, receivers: e2e.Receivers, age: float) -> Replies | None:
    """Return the replies in raw frames of any order, and count on in `receivers`; `age` [s] is passed on.

    None, and nothing taken, unless there is one intact reply of each joint, each the next of a stream in order.
    """
    n, size = cycle.block.shape
    if frames.size != size or len(frames.data) != n * size:
        return None
    raw, last, disorder = np.frombuffer(frames.data, np.uint8), receivers.last, receivers.disorder
    state, codes, report = _decode(raw, cycle.protected, cycle.worth, cycle.ids, cycle.words, last, disorder, age)
    return None if report < 0 else Replies(state, codes, report)


def encode(cycle: Cycle, tau: F64, counters: I64) -> Frames:
    """Return a raw frame of the torque [Nm] of each joint; counts on in `counters` (n,) where frames are protected."""
    block = cycle.block
    _encode(block, cycle.protected, cycle.worth, cycle.ids, tau, counters)
    return Frames(block.tobytes(), block.shape[1])


@kernel
def _crc(raw: U8, at: int, can_id: int) -> int:
    crc: int = 0xFFFF
    for i in range(at, at + e2e.COVERED):
        crc = (crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ raw[i]]
    crc = (crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ (can_id >> 8)]
    return int((crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ (can_id & 0xFF)])


@kernel
def _decode(
    raw: U8, protected: bool, worth: F64, ids: I64, words: U8, last: I64, disorder: I64, age: float
) -> tuple[F64, I64, int]:
    """Return the fields of `Replies` and count on in `last`; report -1, and `last` as it was, unless all is whole."""
    n, report = len(ids), 0
    size = len(raw) // n
    state, codes = np.empty((4, n)), np.zeros((6, n), np.int64)
    for i in range(n):
        head, at = i * size, i * size + _DATA
        j = 0
        while j < n and not (
            raw[head] == words[j, 0]
            and raw[head + 1] == words[j, 1]
            and raw[head + 2] == words[j, 2]
            and raw[head + 3] == words[j, 3]
        ):
            j += 1
        if j == n or codes[5, j] != 0 or raw[head + _AT_LENGTH] != (e2e.LENGTH if protected else mit.LENGTH):
            return state, codes, -1
        codes[5, j] = 1
        if raw[at] & 0xF != ids[j, 0] & 0xF:
            return state, codes, -1
        if protected:
            sent = np.int64(raw[at + e2e.COVERED]) << 8 | np.int64(raw[at + e2e.COVERED + 1])
            counter = np.int64(raw[at + 8])
            if _crc(raw, at, ids[j, 1]) != sent or disorder[j] != 0:
                return state, codes, -1
            if counter != (last[j] + 1) & 0xFF:
                return state, codes, -1
            codes[3, j], codes[4, j] = counter, raw[at + 9]
            report |= codes[4, j]
        b1, b2, b3 = np.int64(raw[at + 1]), np.int64(raw[at + 2]), np.int64(raw[at + 3])
        b4, b5 = np.int64(raw[at + 4]), np.int64(raw[at + 5])
        state[0, j] = (b1 << 8 | b2) * worth[j, 0] + worth[j, 1]
        state[1, j] = (b3 << 4 | b4 >> 4) * worth[j, 2] + worth[j, 3]
        state[2, j] = ((b4 & 0xF) << 8 | b5) * worth[j, 4] + worth[j, 5]
        state[3, j] = age
        codes[0, j], codes[1, j], codes[2, j] = raw[at] >> 4, raw[at + 6], raw[at + 7]
    if protected:
        for j in range(n):
            last[j] = codes[3, j]
    return state, codes, report


@kernel
def _encode(out: U8, protected: bool, worth: F64, ids: I64, tau: F64, counters: I64) -> None:
    for j in range(out.shape[0]):
        t_max = worth[j, 6]
        t = worth[j, 7] * tau[j] if np.isfinite(tau[j]) else 0.0
        code = np.int64(min(max((t + t_max) * 4095 / (t_max + t_max), 0.0), 4095) + 0.5)
        data = out[j]
        data[_DATA + 6], data[_DATA + 7] = code >> 8, code & 0xFF
        if protected:
            counters[j] = (counters[j] + 1) & 0xFF
            data[_DATA + 8], data[_DATA + 9] = counters[j], _WANTED
            crc = _crc(data, _DATA, ids[j, 0])
            data[_DATA + 10], data[_DATA + 11] = crc >> 8, crc & 0xFF


def warm(cycle: Cycle) -> None:
    """Compile or load both kernels; no frame is needed."""
    n, size = cycle.block.shape
    encode(cycle, np.zeros(n), np.zeros(n, np.int64))
    decode(cycle, Frames(bytes(n * size), size), e2e.Receivers(n), 0.0)
