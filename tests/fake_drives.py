"""Scripted drives for the link's tests: the other end of the wire, with its own packing, and open to mischief."""

import struct
from collections.abc import Callable
from typing import Any

from rtctl.hal.can.link import MIT, MIT_E2E, JointSpec, LinkSpec
from rtctl.protocol import frame, mit

SCALE = mit.Scale(12.5, 45.0, 54.0)
PERIOD = 0.002
WATCHDOG = 0.02
TIMEOUT_COUNTS = 400  # 20 ms of 50 us
Mischief = Callable[[int, bytes], list[bytes]]  # (joint, raw reply) -> what the bus carries instead


def spec_of(n: int = 3, protocol: str = MIT_E2E, fd: bool | None = None, watchdog: float = WATCHDOG) -> LinkSpec:
    """Return a link of n joints with ids 1.. on a bus called can0."""
    joints = tuple(JointSpec(f"joint{i + 1}", i + 1, SCALE, -3.0, 3.0) for i in range(n))
    return LinkSpec("can0", joints, protocol, protocol == MIT_E2E if fd is None else fd, PERIOD, watchdog)


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


class FakeDrives:
    """Drives that answer each frame with the state they were told to have."""

    def __init__(self, spec: LinkSpec) -> None:
        n = len(spec.joints)
        self.ids = [joint.can_id for joint in spec.joints]
        self.replies = [joint.reply_id for joint in spec.joints]
        self.protected, self.fd, self.brs = spec.protocol == MIT_E2E, spec.fd, spec.fd
        self.err = [0] * n
        self.codes = [(0x8000, 0x800, 0x800)] * n  # p, v, t
        self.status = [0] * n
        self.counters = [0] * n
        self.seen: list[frame.Frame] = []
        self.mischief: Mischief = lambda joint, raw: [raw]
        self.write_works = True
        self.registers: list[dict[int, Any]] = [
            {7: r, 8: i, 9: TIMEOUT_COUNTS, 10: 1, 21: SCALE.p_max, 22: SCALE.v_max, 23: SCALE.t_max}
            for i, r in zip(self.ids, self.replies, strict=True)
        ]
        self.written: list[tuple[int, int]] = []  # (joint, register)

    def exchange(self, frames: list[bytes]) -> list[bytes]:
        """Answer the frames in order."""
        return [reply for raw in frames for reply in self._answer(frame.unpack(raw))]

    def _answer(self, got: frame.Frame) -> list[bytes]:
        self.seen.append(got)
        if got.can_id == 0x7FF:
            joint = self.ids.index(got.data[0] | got.data[1] << 8)
            data = self._register(joint, got.data[2], got.data[3], got.data[4:8])
        elif got.can_id in self.ids:
            joint = self.ids.index(got.can_id)
            p, v, t = self.codes[joint]
            head = self.err[joint] << 4 | self.ids[joint] & 0xF
            data = struct.pack(">BH", head, p) + (v << 28 | t << 16 | 0x2021).to_bytes(5, "big")
        else:
            return []
        return self.mischief(joint, self.sealed(joint, data))

    def sealed(self, joint: int, data: bytes) -> bytes:
        """Return the raw frame of a reply, with the next counter where the link is protected."""
        can_id = self.replies[joint]
        if self.protected:
            self.counters[joint] = (self.counters[joint] + 1) % 256
            data += bytes((self.counters[joint], self.status[joint]))
            data += struct.pack(">H", crc16(data + struct.pack(">H", can_id)))
        return frame.pack(can_id, data, self.fd, self.brs)

    def _register(self, joint: int, operation: int, rid: int, value: bytes) -> bytes:
        kind = "<f" if rid in (21, 22, 23) else "<I"
        if operation == 0x55:
            self.written.append((joint, rid))
            if self.write_works:
                self.registers[joint][rid] = struct.unpack(kind, value)[0]
        answer = struct.pack(kind, self.registers[joint][rid])
        return struct.pack("<HBB", self.ids[joint], operation, rid) + answer


PROTOCOLS = (MIT, MIT_E2E)
