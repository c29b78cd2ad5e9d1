"""`firmware_sim.drive`, compiled: the same rules for all drives of an arm at once, over rows of numbers.

Each function mirrors the method of `Drive` that it names, to the bit; tests hold it to that. A row `f` holds one
drive's floats, `i` its integers, at the columns of `firmware_sim.cells`. Registers, and frames that are not of the
link's own form, are left to the drive in Python.
"""

import math

import numpy as np
from numpy.typing import NDArray

from firmware_sim import cells as c
from firmware_sim import codec
from firmware_sim import drive as d
from firmware_sim.kernel import kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

DISABLED, ENABLED, FAULT = int(d.State.DISABLED), int(d.State.ENABLED), int(d.State.FAULT)
SILENCE, HEAT, OVERLOAD = int(d.Fault.COMMUNICATION), int(d.Fault.COIL_HOT), int(d.Fault.OVERLOAD)
CRC = np.array(codec.CRC_TABLE, dtype=np.int64)
ERR, RTR, EFF = 0x20, 0x40, 0x80  # flags in the last byte of a raw frame's identifier, little-endian
AT_LENGTH, AT_FLAGS, AT_DATA = 4, 5, 8  # in a raw frame
ALL_READ, UNCOMMON, AGAIN, EVERYBODY = 0, 1, 2, 3  # why `answer` returned


@kernel
def _off(f: F64, i: I64, state: int) -> None:
    """Enter a state without torque, brake closed, old command forgotten."""
    i[c.STATE], i[c.BRAKE], f[c.TORQUE], i[c.FLAGS] = state, 1, 0.0, 0
    f[c.COMMAND_P] = f[c.COMMAND_V] = f[c.COMMAND_KP] = f[c.COMMAND_KD] = f[c.COMMAND_T] = 0.0
    f[c.SLEW_BUDGET] = f[c.SLEW_BOUND]
    i[c.RELEASE_NS] = -1


@kernel
def _trip(f: F64, i: I64, code: int) -> None:
    """Latch a fault; the first one stays until cleared."""
    if i[c.STATE] == FAULT:
        return
    braked = i[c.BRAKE]
    _off(f, i, FAULT)
    i[c.BRAKE] = braked
    i[c.FAULT], i[c.FAULT_AGE_NS] = code, 0
    i[c.TRIP_AT], i[c.TRIP_VALID] = i[c.UPTIME_NS], i[c.LAST_VALID_NS]
    i[c.RESTLESS] = 1
    i[c.EVENT] |= c.TRIPPED


@kernel
def _limited(f: F64, i: I64, dt: float) -> float:
    """Return the wanted torque, clamped to TMAX, rating and derating, then slewed by at most slew x time passed."""
    wanted = f[c.COMMAND_KP] * (f[c.COMMAND_P] - f[c.Q]) + f[c.COMMAND_KD] * (f[c.COMMAND_V] - f[c.QD]) + f[c.COMMAND_T]
    over = (f[c.TEMPERATURE] - d.DERATE_FROM) / (d.TRIP_AT - d.DERATE_FROM)
    derate = 1.0 - (1.0 - d.DERATE_TO) * min(max(over, 0.0), 1.0)
    limit = min(f[c.SCALE_T], f[c.RATED]) * derate
    i[c.FLAGS] = codec.DERATED if derate < 1.0 else 0
    if abs(wanted) > limit + f[c.SCALE_T] / 4095.0:
        i[c.FLAGS] |= codec.CLAMPED
    wanted = min(max(wanted, -limit), limit) * f[c.STRENGTH]
    f[c.SLEW_BUDGET] = min(f[c.SLEW_BUDGET] + f[c.SLEW] * dt, f[c.SLEW_BOUND])
    change = wanted - f[c.TORQUE]
    if abs(change) > f[c.SLEW_BUDGET]:
        i[c.FLAGS] |= codec.SLEWED
        change = math.copysign(f[c.SLEW_BUDGET], change)
    f[c.SLEW_BUDGET] -= abs(change)
    return float(f[c.TORQUE] + change)


@kernel
def _actuate(f: F64, i: I64, dt_ns: int) -> float:
    """Advance one drive by dt; return the drag [Nm]. The torque is driven where the drag is 0."""
    dt = dt_ns / d.NS
    if i[c.STATE] == ENABLED and i[c.TIMEOUT_NS] > 0 and i[c.TIMEOUT_NS] <= i[c.SILENCE_NS]:
        _trip(f, i, SILENCE)
        i[c.WATCHDOG_TRIPPED] = 1
    if abs(f[c.QD]) > f[c.OVER_SPEED]:
        _trip(f, i, OVERLOAD)
    if f[c.TEMPERATURE] >= d.TRIP_AT:
        _trip(f, i, HEAT)
    drag = 0.0
    if i[c.STATE] == ENABLED and i[c.RELEASE_NS] >= 0:
        if i[c.RELEASE_NS] >= i[c.RELEASE_AFTER_NS]:
            i[c.BRAKE] = 0
        f[c.TORQUE] = _limited(f, i, dt)
    elif i[c.STATE] == FAULT and i[c.BRAKE] == 0:
        if abs(f[c.QD]) < d.BRAKE_SPEED or i[c.FAULT_AGE_NS] >= d.BRAKE_LATEST_NS:
            i[c.BRAKE] = 1
        drag = min(f[c.RATED] * abs(f[c.QD]) / d.DRAG_SPEED, f[c.RATED])
        f[c.TORQUE] = -math.copysign(drag, f[c.QD])
    else:
        f[c.TORQUE] = 0.0
    if i[c.BRAKE]:
        drag = d.BRAKE_HOLD * f[c.RATED]
        if i[c.RELEASE_NS] < 0:
            f[c.TORQUE] = 0.0
    _clockwork(f, i, dt_ns, dt)
    return drag


@kernel
def _clockwork(f: F64, i: I64, dt_ns: int, dt: float) -> None:
    """Advance timers and the winding."""
    load = f[c.TORQUE] / (d.CONTINUOUS * f[c.RATED])
    f[c.TEMPERATURE] += dt / d.WINDING_S * (d.RISE_RATED * load * load - (f[c.TEMPERATURE] - d.AMBIENT))
    i[c.UPTIME_NS] += dt_ns
    i[c.SILENCE_NS] += dt_ns
    i[c.FAULT_AGE_NS] += dt_ns
    if i[c.RELEASE_NS] >= 0:
        i[c.RELEASE_NS] += dt_ns
    if i[c.RESTLESS] and abs(f[c.QD]) < d.REST_SPEED:
        i[c.RESTLESS] = 0
        i[c.EVENT] |= c.RESTED


@kernel
def actuate(F: F64, I: I64, dt_ns: int, torque: F64, drag: F64) -> tuple[bool, bool]:
    """Advance all drives by dt; write what each joint gets, torque and drag (n,) [Nm].

    Returns whether a drive has an event to be written down, and whether one is enabled.
    """
    event = enabled = False
    for k in range(len(F)):
        drag[k] = _actuate(F[k], I[k], dt_ns)
        torque[k] = 0.0 if drag[k] else F[k, c.TORQUE]
        event |= I[k, c.EVENT] != 0
        enabled |= I[k, c.STATE] == ENABLED
    return event, enabled


@kernel
def sense(F: F64, I: I64, motion: F64) -> bool:
    """Let all drives take the true positions [rad] and speeds [rad/s], (2, n); return whether one has an event."""
    event = False
    for k in range(len(F)):
        q, qd = motion[0, k], motion[1, k]
        if math.isfinite(q) and math.isfinite(qd):
            F[k, c.Q], F[k, c.QD] = q - F[k, c.ZERO], qd
        else:
            _trip(F[k], I[k], OVERLOAD)
        event |= I[k, c.EVENT] != 0
    return event


@kernel
def close_period(F: F64, I: I64) -> None:
    """Note the largest torques; forget who was commanded."""
    for k in range(len(F)):
        F[k, c.LARGEST] = max(F[k, c.LARGEST], abs(F[k, c.TORQUE]))
        I[k, c.COMMANDED] = 0


# ---- the wire


@kernel
def _crc16(data: U8, count: int, can_id: int) -> int:
    """Return `codec.crc16` over `count` bytes and the identifier."""
    crc = 0xFFFF
    for k in range(count):
        crc = (crc << 8 & 0xFFFF) ^ CRC[crc >> 8 ^ int(data[k])]
    crc = (crc << 8 & 0xFFFF) ^ CRC[crc >> 8 ^ can_id >> 8]
    return int((crc << 8 & 0xFFFF) ^ CRC[crc >> 8 ^ can_id & 0xFF])


@kernel
def _quantise(x: float, bound: float, bits: int) -> int:
    """Return `codec.quantise`."""
    top = (1 << bits) - 1
    if not math.isfinite(x):
        x = 0.0
    x = min(max(x, -bound), bound)
    return math.floor((x + bound) * top / (2.0 * bound) + 0.5)


@kernel
def _restore(u: int, bound: float, bits: int) -> float:
    """Return `codec.restore`."""
    return u * (2.0 * bound) / ((1 << bits) - 1) - bound


@kernel
def _reply(f: F64, i: I64, e2e: bool, out: U8) -> None:
    """Write the state reply into the data of a raw frame: `Drive.reply`."""
    err = i[c.FAULT] if i[c.STATE] == FAULT else i[c.STATE]
    p = _quantise(f[c.Q], f[c.SCALE_P], 16)
    v = _quantise(f[c.QD], f[c.SCALE_V], 12)
    t = _quantise(f[c.TORQUE], f[c.SCALE_T], 12)
    mos = d.AMBIENT + d.MOS_SHARE * (f[c.TEMPERATURE] - d.AMBIENT)
    out[0] = err << 4 & 0xFF | i[c.MOTOR] & 0xF
    out[1], out[2] = p >> 8, p & 0xFF
    out[3], out[4], out[5] = v >> 4, (v & 0xF) << 4 | t >> 8, t & 0xFF
    out[6], out[7] = min(max(int(mos), 0), 255), min(max(int(f[c.TEMPERATURE]), 0), 255)
    if e2e:
        status = (codec.WATCHDOG if i[c.WATCHDOG_TRIPPED] else 0) | i[c.FLAGS] | (codec.BRAKE if i[c.BRAKE] else 0)
        i[c.COUNTER_OUT] = i[c.COUNTER_OUT] + 1 & 0xFF
        out[8], out[9] = i[c.COUNTER_OUT], status
        crc = _crc16(out, 10, i[c.REPLY_ID])
        out[10], out[11] = crc >> 8, crc & 0xFF


@kernel
def _fresh(i: I64, data: U8) -> bool:
    """Tell whether a protected command is intact and new."""
    if _crc16(data, 10, i[c.MOTOR]) != int(data[10]) << 8 | int(data[11]):
        return False
    ahead = int(data[8]) - i[c.COUNTER_IN] & 0xFF
    if i[c.COUNTER_IN] >= 0 and (ahead == 0 or (ahead >= d.STALE_COUNTER and i[c.STATE] == ENABLED)):
        return False
    i[c.COUNTER_IN] = int(data[8])
    return True


@kernel
def _special(data: U8) -> int:
    """Return the code of a special frame, 0 of any other."""
    for k in range(7):
        if data[k] != 0xFF:
            return 0
    return int(data[7]) if codec.CLEAR <= data[7] <= codec.ZERO else 0


@kernel
def _take(f: F64, i: I64, data: U8, torque_wanted: bool) -> None:
    """Act on a valid command according to the state."""
    special = _special(data)
    if special:
        _act(f, i, special)
    elif i[c.STATE] == ENABLED:
        f[c.COMMAND_P] = f[c.COMMAND_V] = f[c.COMMAND_KP] = f[c.COMMAND_KD] = f[c.COMMAND_T] = 0.0
        if torque_wanted:
            f[c.COMMAND_P] = _restore(int(data[0]) << 8 | int(data[1]), f[c.SCALE_P], 16)
            f[c.COMMAND_V] = _restore(int(data[2]) << 4 | int(data[3]) >> 4, f[c.SCALE_V], 12)
            f[c.COMMAND_KP] = ((int(data[3]) & 0xF) << 8 | int(data[4])) * codec.KP_MAX / 4095.0
            f[c.COMMAND_KD] = (int(data[5]) << 4 | int(data[6]) >> 4) * codec.KD_MAX / 4095.0
            f[c.COMMAND_T] = _restore((int(data[6]) & 0xF) << 8 | int(data[7]), f[c.SCALE_T], 12)
            if i[c.RELEASE_NS] < 0:
                i[c.RELEASE_NS] = 0
        i[c.SILENCE_NS], i[c.LAST_VALID_NS] = 0, i[c.UPTIME_NS]


@kernel
def _act(f: F64, i: I64, special: int) -> None:
    """Act on a special frame."""
    if special == codec.DISABLE:
        if i[c.STATE] == ENABLED:
            _off(f, i, DISABLED)
    elif special == codec.CLEAR:
        if i[c.STATE] == FAULT and f[c.TEMPERATURE] < d.DERATE_FROM:
            i[c.FAULT], i[c.WATCHDOG_TRIPPED], i[c.FAULT_AGE_NS] = 0, 0, 0
            _off(f, i, DISABLED)
    elif special == codec.ENABLE:
        if i[c.STATE] == DISABLED:
            _off(f, i, ENABLED)
        if i[c.BRAKE]:
            i[c.SILENCE_NS], i[c.LAST_VALID_NS] = 0, i[c.UPTIME_NS]
    elif i[c.STATE] == DISABLED:  # ZERO
        f[c.ZERO] += f[c.Q]
        f[c.Q] = 0.0


@kernel
def answer(F: F64, I: I64, form: I64, raw: U8, lengths: I64, first: int, out: U8, replies: int) -> tuple[int, int, int]:
    """Let the drives take raw frames from `first` on and write their replies as raw frames, from `replies` on.

    raw: (m, w) a frame a row, `lengths` (m,) its bytes. out: a reply a row, as wide as a frame at least.
    form: of the link: size of a raw frame, whether FD, whether protected, and whether to stop for the clock: before a
    frame to a drive that has had one in this period, and after the one that completes the period.

    Returns the next frame, the next reply, and why it stopped: all is read, the next frame is uncommon (a register, or
    of another size: it is for Python), the next frame comes again to the same drive, or every drive has its command.
    """
    size, fd, e2e, clocked = form[0], form[1], form[2] != 0, form[3] != 0
    wanted = 12 if e2e else 8
    missing = 0
    for k in range(len(I)):
        missing += I[k, c.COMMANDED] == 0
    for m in range(first, len(lengths)):
        if clocked and missing == 0 and m > first:
            return m, replies, EVERYBODY
        if lengths[m] != size:
            return m, replies, UNCOMMON
        row = raw[m]
        can_id = int(row[0]) | (int(row[1]) & 0x7) << 8
        if row[AT_LENGTH] > (64 if fd else 8) or row[3] & (ERR | RTR | EFF):
            continue
        if can_id == codec.REGISTER_ID:
            return m, replies, UNCOMMON
        for k in range(len(I)):
            if I[k, c.MOTOR] != can_id:
                continue
            if clocked and I[k, c.COMMANDED]:
                return m, replies, AGAIN
            missing -= I[k, c.COMMANDED] == 0
            I[k, c.COMMANDED] = 1
            if row[AT_LENGTH] != wanted:
                I[k, c.REJECTED] += 1
                break
            _answer(F[k], I[k], row[AT_DATA:], fd != 0, e2e, out[replies])
            replies += 1
            break
    everybody = clocked and missing == 0 and first < len(lengths)
    return len(lengths), replies, EVERYBODY if everybody else ALL_READ


@kernel
def _answer(f: F64, i: I64, data: U8, fd: bool, e2e: bool, out: U8) -> None:
    """Reply to a frame of the right length, then take it: `Drive.receive`."""
    out[:] = 0
    out[0], out[1] = i[c.REPLY_ID] & 0xFF, i[c.REPLY_ID] >> 8
    out[AT_LENGTH] = 12 if e2e else 8
    out[AT_FLAGS] = 0x05 if fd else 0  # FDF and BRS
    _reply(f, i, e2e, out[AT_DATA:])
    if not e2e:
        _take(f, i, data, True)
    elif _fresh(i, data):
        _take(f, i, data, (data[9] & codec.TORQUE_WANTED) != 0)
    else:
        i[c.REJECTED] += 1
