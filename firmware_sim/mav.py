"""MAVLink 2 frames as the vehicle sees them: cutting, checking and signing them with code of its own.

pymavlink's dialect only lays out fields; what is accepted and what is refused is decided here.
"""

import hashlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import ardupilotmega as dialect

from firmware_sim.settings import SettingsError

SINCE_2015 = 1420070400


def frames(data: bytes) -> Iterator[bytes]:
    """Yield the MAVLink 2 frames in a datagram."""
    at = 0
    while at + 12 <= len(data):
        if data[at] != 0xFD:
            at += 1
            continue
        size = 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        if at + size > len(data):
            return
        yield data[at : at + size]
        at += size


class Endpoint:
    """One end of a link: a system and component id, a sequence, and a key that signs and is demanded."""

    def __init__(self, system: int, component: int, key: bytes | None) -> None:
        self.codec: Any = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.key = key
        self.stamp = 0  # [10 us] newest of ours
        self.heard: dict[tuple[int, int, int], int] = {}
        self.refused = 0

    def pack(self, message: Any, unix: float) -> bytes:
        """Return a message as bytes, signed when there is a key."""
        raw = bytes(message.pack(self.codec))
        if self.key is None:
            return raw
        self.stamp = max(self.stamp + 1, int((unix - SINCE_2015) * 1e5))
        head = raw[:2] + bytes((raw[2] | 1,)) + raw[3:-2]
        head += _checksum(head[1:], message.crc_extra)
        head += bytes((1,)) + struct.pack("<Q", self.stamp)[:6]
        return head + hashlib.sha256(self.key + head).digest()[:6]

    def unpack(self, raw: bytes) -> Any | None:
        """Return the message of a frame, None for one that is not accepted."""
        if self.key is not None and not self._genuine(raw):
            self.refused += 1
            return None
        try:
            return self.codec.decode(bytearray(raw))
        except (dialect.MAVError, struct.error, ValueError):
            self.refused += 1
            return None

    def _genuine(self, raw: bytes) -> bool:
        assert self.key is not None
        if not raw[2] & 1 or hashlib.sha256(self.key + raw[:-6]).digest()[:6] != raw[-6:]:
            return False
        stream = (raw[5], raw[6], raw[-13])
        stamp = int.from_bytes(raw[-12:-6], "little")
        if stamp <= self.heard.get(stream, 0):
            return False
        self.heard[stream] = stamp
        return True


def _checksum(data: bytes, extra: int) -> bytes:
    crc = 0xFFFF
    for byte in (*data, extra):
        t = byte ^ (crc & 0xFF)
        t ^= (t << 4) & 0xFF
        crc = (crc >> 8) ^ (t << 8) ^ (t << 3) ^ (t >> 4)
        crc &= 0xFFFF
    return struct.pack("<H", crc)


def key_of(link: dict[str, Any], folder: Path) -> bytes | None:
    """Return the key that a robot file names, None when signing is off."""
    if link.get("signing") != "required":
        return None
    path = Path(link["key_file"])
    try:
        data = (path if path.is_absolute() else folder / path).read_bytes()
    except OSError as error:
        raise SettingsError(f"link.key_file: {error}") from error
    return data if len(data) == 32 else bytes.fromhex(data.decode("ascii").strip())
