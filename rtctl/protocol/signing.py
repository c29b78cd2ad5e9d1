"""MAVLink 2 framing and message signing, pure: every frame is judged here before a parser sees a byte of it.

    signature = first 6 bytes of SHA-256(key | header | payload | checksum | link id | timestamp)

timestamp: 48 bit, units of 10 us since 2015-01-01. The hash is verified first, state changes after: one forged frame
with a maximal stamp must not lock the genuine stream out. A stream is (system, component, link id); its newest stamp is
kept over restarts, so that what was recorded then is no news now.
"""

import hashlib
import hmac
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

MAGIC_1, MAGIC_2 = 0xFE, 0xFD
HEADER = 10  # bytes of MAVLink 2 up to the payload
CHECKSUM = 2
SIGNATURE = 13  # link id, 6 of timestamp, 6 of hash
SIGNED = 0x01  # the only incompatibility flag there is
KEY = 32  # bytes
LONGEST = HEADER + 255 + CHECKSUM + SIGNATURE
UNIT = 10_000  # [ns] of a timestamp
EPOCH = 1_420_070_400  # [s] 2015-01-01 in Unix time
NEW_STREAM = 60 * 100_000  # [units] that a stream never heard may be behind: one minute
STREAMS = 16  # a receiver keeps at most; autopilots keep no more either
Stream = tuple[int, int, int]  # system, component, link id


class Verdict(IntEnum):
    """What became of a frame."""

    GOOD = 0
    UNSIGNED = 1
    OLD_PROTOCOL = 2  # MAVLink 1 cannot be signed
    FORGED = 3
    REPLAYED = 4
    STALE = 5  # a stream never heard, more than a minute behind
    CROWDED = 6  # more streams than are kept
    MALFORMED = 7  # flags nobody knows
    UNKNOWN = 8  # a message id that no dialect of ours has: it cannot be checked, so it is not parsed


class Frame(NamedTuple):
    """One MAVLink frame as it is on the wire."""

    raw: bytes
    version: int  # 1 or 2
    flags: int  # incompatibility flags, 0 for version 1
    sequence: int
    system: int
    component: int
    message: int  # id

    @property
    def signed(self) -> bool:
        """Return whether the frame says that it carries a signature."""
        return bool(self.flags & SIGNED)


class State(NamedTuple):
    """The newest timestamp of each stream, and of what we signed ourselves."""

    streams: Mapping[Stream, int]
    sent: int


NOTHING = State({}, 0)


def split(data: bytes) -> tuple[list[Frame], bytes, int]:
    """Return (frames, rest, junk): whole frames in order, bytes that may begin another, and bytes that are none.

    A magic byte inside a damaged frame cannot be told from a real one here: the checksum or hash that fails does that,
    and at worst a frame behind it is lost with it.
    """
    frames, at, junk, end = [], 0, 0, len(data)
    while at < end:
        magic = data[at]
        if magic not in (MAGIC_1, MAGIC_2):
            at, junk = at + 1, junk + 1
            continue
        if end - at < 3:
            break
        length = 8 + data[at + 1] if magic == MAGIC_1 else HEADER + data[at + 1] + CHECKSUM
        if magic == MAGIC_2 and data[at + 2] & SIGNED:
            length += SIGNATURE
        if end - at < length:
            break
        frames.append(_frame(bytes(data[at : at + length])))
        at += length
    return frames, bytes(data[at:]), junk


def _frame(raw: bytes) -> Frame:
    if raw[0] == MAGIC_1:
        return Frame(raw, 1, 0, raw[2], raw[3], raw[4], raw[5])
    return Frame(raw, 2, raw[2], raw[4], raw[5], raw[6], int.from_bytes(raw[7:10], "little"))


def timestamp(unix_ns: int) -> int:
    """Return the signing timestamp of a Unix time [ns]."""
    return max(0, (unix_ns - EPOCH * 1_000_000_000) // UNIT)


def digest(key: bytes, signed_part: bytes) -> bytes:
    """Return the 6 bytes of hash over everything of a frame before them, magic byte included."""
    return hashlib.sha256(key + signed_part).digest()[:6]


def sign(raw: bytes, key: bytes, link: int, state: State, now: int, checksum_extra: int) -> tuple[bytes, State]:
    """Return a MAVLink 2 frame signed, its checksum made anew, and the state after it.

    raw: as packed, unsigned. now: timestamp; one that does not rise is raised, so that no two frames share one.
    checksum_extra: CRC_EXTRA of the message.
    """
    if raw[0] != MAGIC_2 or raw[2] & SIGNED:
        raise ValueError("wanted an unsigned MAVLink 2 frame")
    stamp = max(now, state.sent + 1)
    body = bytes((raw[0], raw[1], raw[2] | SIGNED)) + raw[3:-CHECKSUM]
    body += crc(body[1:] + bytes((checksum_extra,))).to_bytes(2, "little")
    tail = bytes((link,)) + stamp.to_bytes(6, "little")
    return body + tail + digest(key, body + tail), state._replace(sent=stamp)


def verify(frame: Frame, key: bytes, state: State, now: int) -> tuple[Verdict, State]:
    """Return what a frame is worth under a key, and the state after it; anything but GOOD leaves the state as it was.

    now: timestamp of the receiver's own clock, for streams never heard before.
    """
    if frame.version == 1:
        return Verdict.OLD_PROTOCOL, state
    if frame.flags & ~SIGNED:
        return Verdict.MALFORMED, state
    if not frame.signed:
        return Verdict.UNSIGNED, state
    body, hashed = frame.raw[:-6], frame.raw[-6:]
    if not hmac.compare_digest(digest(key, body), hashed):
        return Verdict.FORGED, state
    stamp = int.from_bytes(body[-6:], "little")
    stream = (frame.system, frame.component, body[-7])
    newest = state.streams.get(stream)
    if newest is None:
        if stamp < now - NEW_STREAM:
            return Verdict.STALE, state
        if len(state.streams) >= STREAMS:
            return Verdict.CROWDED, state
    elif stamp <= newest:
        return Verdict.REPLAYED, state
    return Verdict.GOOD, state._replace(streams={**state.streams, stream: stamp})


def crc(data: bytes) -> int:
    """Return the CRC-16/MCRF4XX of MAVLink."""
    value = 0xFFFF
    for byte in data:
        byte ^= value & 0xFF
        byte = (byte ^ byte << 4) & 0xFF
        value = value >> 8 ^ byte << 8 ^ byte << 3 ^ byte >> 4
    return value & 0xFFFF


def to_text(state: State) -> str:
    """Return the state as lines `system component link timestamp`, ours first as `sent timestamp`."""
    rows = [f"sent {state.sent}"] + [f"{s} {c} {k} {t}" for (s, c, k), t in sorted(state.streams.items())]
    return "\n".join(rows) + "\n"


def from_text(text: str) -> State:
    """Return the state that `to_text` wrote. Raises ValueError on anything else."""
    head, *rows = text.splitlines() or [""]
    word, _, sent = head.partition(" ")
    if word != "sent":
        raise ValueError(f"got {head[:40]!r}, wanted `sent TIMESTAMP`")
    streams = {}
    for row in rows:
        system, component, link, stamp = (int(part) for part in row.split(" "))
        if not (0 <= system < 256 and 0 <= component < 256 and 0 <= link < 256 and 0 <= stamp < 1 << 48):
            raise ValueError(f"got {row[:60]!r}, wanted SYSTEM COMPONENT LINK TIMESTAMP")
        streams[system, component, link] = stamp
    if len(streams) > STREAMS or not 0 <= int(sent) < 1 << 48:
        raise ValueError("got more streams than are kept, or a timestamp beyond 48 bits")
    return State(streams, int(sent))
