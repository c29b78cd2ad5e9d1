"""Time on the wire of CAN frames at worst-case stuffing, and the load of one servo cycle.

Classic frame (11-bit id, n data bytes): 44 + 8n bits + 3 of interframe space; the first 34 + 8n may carry a stuff bit
after every fourth. CAN FD (ISO 11898-1:2015): stuffing runs from SOF to the last data bit; the CRC field has fixed
stuff bits instead; from BRS to the CRC delimiter bits last 1/data_bitrate.
"""

from typing import NamedTuple

LOAD_MAX = 0.8  # of the cycle; beyond it one error frame and its repetition no longer fit

FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


class FdBits(NamedTuple):
    """Worst-case bits of an FD frame with bit-rate switch."""

    arbitration: int  # at the nominal rate, interframe space included
    data: int  # at the data rate


class Load(NamedTuple):
    """What one servo cycle takes on the bus."""

    command: float  # [s] one command frame
    reply: float  # [s] one reply frame
    cycle: float  # [s] all commands and replies
    ratio: float  # of the servo period


def classic_bits(data: int) -> int:
    """Return the bits of a classic frame of `data` bytes, interframe space included."""
    stuffed = 34 + 8 * data  # SOF, id, RTR, IDE, r0, DLC, data, CRC-15
    return stuffed + (stuffed - 1) // 4 + 13  # CRC delimiter, ACK 2, EOF 7, interframe 3


def fd_bits(data: int) -> FdBits:
    """Return the bits of an FD frame whose payload fits `data` bytes; raises ValueError beyond 64."""
    size = next((n for n in FD_LENGTHS if n >= data), None)
    if size is None:
        raise ValueError(f"{data} bytes do not fit a CAN FD frame")
    head = 17  # SOF, id 11, RRS, IDE, FDF, res, BRS
    head_stuff = (head - 1) // 4
    body = 1 + 4 + 8 * size  # ESI, DLC, data
    stuff = (head + body - 1) // 4 - head_stuff
    crc = 4 + (17 if size <= 16 else 21)  # stuff count with parity, CRC
    fixed = 1 + crc // 4  # a fixed stuff bit before the stuff count, then after every fourth bit
    tail = 1 + 2 + 7 + 3  # CRC delimiter, ACK, EOF, interframe
    return FdBits(head + head_stuff + tail, body + stuff + crc + fixed)


def frame_time(data: int, bitrate: float, data_bitrate: float | None) -> float:
    """Return the longest time [s] of a frame; data_bitrate None is a classic frame. Rates in bit/s."""
    if data_bitrate is None:
        return classic_bits(data) / bitrate
    bits = fd_bits(data)
    return bits.arbitration / bitrate + bits.data / data_bitrate


def cycle_load(joints: int, payload: int, bitrate: float, data_bitrate: float | None, period: float) -> Load:
    """Return the load of one command and one reply of `payload` bytes per joint in each period [s]."""
    one = frame_time(payload, bitrate, data_bitrate)
    cycle = 2 * joints * one
    return Load(one, one, cycle, cycle / period)
