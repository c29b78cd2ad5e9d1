"""The bank of drives against the drives one by one: every bit of their state and of what they say, whatever happens."""

import math
import struct
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from firmware_sim import codec
from firmware_sim.bank import ATTRIBUTES, Bank
from firmware_sim.bank_kernels import AGAIN, ALL_READ, EVERYBODY
from firmware_sim.batch import Batch
from firmware_sim.drive import Drive, Rating
from firmware_sim.inject import Injector
from firmware_sim.wire import Wire
from rtctl.protocol import frame

HALF_MS = 500_000
IDS = (3, 4, 0x109)
BROADCAST = 0x7FF


def ratings(e2e: bool) -> list[Rating]:
    """Return three drives: strong and slow, weak and quick to trip, one without watchdog or brake to wait for."""
    return [
        Rating(3, codec.Scale(12.5, 45.0, 54.0), 40.0, 1000.0, 16.0, 1_000_000, 400, 4, e2e),
        Rating(4, codec.Scale(12.5, 30.0, 10.0), 7.0, 300.0, 2.0, 2_000_000, 40, 4, e2e, 1_000_000),
        Rating(0x109, codec.Scale(6.25, 8.0, 28.0), 90.0, 5000.0, 5.0, 250_000, 0, 4, e2e, 0),
    ]


class Said(NamedTuple):
    """A frame to be: what it says, and what happens to it."""

    can_id: int
    data: bytes  # (8,)
    ahead: int  # of the newest counter that the drive knows, where the link is protected
    wanted: int  # status byte
    harm: str
    bit: int


torque = st.integers(0, 4095).map(lambda t: (0x8000 << 48 | 0x800 << 36 | t).to_bytes(8, "big"))
servo = st.builds(  # gains that leave the torque within its bounds, at small angles
    lambda p, v, kp, kd, t: (p << 48 | v << 36 | kp << 24 | kd << 12 | t).to_bytes(8, "big"),
    st.integers(0x7F00, 0x80FF),
    st.integers(0x700, 0x8FF),
    st.integers(0, 100),
    st.integers(0, 4095),
    st.integers(0x780, 0x880),
)
special = st.integers(0xFA, 0xFF).map(lambda code: b"\xff" * 7 + bytes((code,)))
likely = st.sampled_from([codec.SPECIAL_HEAD + bytes((code,)) for code in (codec.ENABLE, codec.CLEAR, codec.DISABLE)])
number = st.sampled_from((7, 8, 9, 10, 21, 22, 23, 35, 99))
value = st.one_of(
    st.integers(0, 1000).map(lambda x: struct.pack("<I", x)),
    st.floats(0.05, 100.0).map(lambda x: struct.pack("<f", x)),
    st.binary(min_size=4, max_size=4),
)
operation = st.sampled_from((codec.READ, codec.WRITE, codec.WRITE, codec.SAVE, codec.REFRESH, 0x12))
register = st.builds(
    lambda i, o, n, v: struct.pack("<HBB", i, o, n) + v, st.sampled_from((*IDS, 77)), operation, number, value
)
harm = st.sampled_from(
    ("none",) * 20 + ("flip", "short", "empty", "other size", "rtr", "extended", "error", "length", "junk")
)
ahead = st.sampled_from((1,) * 12 + (0, 2, -1, 100, 127, 128, 200))
commands = st.one_of(torque, torque, servo, servo, likely, special, st.binary(min_size=8, max_size=8))
told = st.builds(Said, st.sampled_from((*IDS, 5)), commands, ahead, st.sampled_from((1, 1, 1, 0)), harm, st.integers(0))
asked = st.builds(Said, st.just(BROADCAST), register, ahead, st.just(0), harm, st.integers(0))
traffic = st.lists(st.one_of(told, told, told, told, asked), max_size=12)
ordinary = commands.map(lambda data: [Said(i, data, 1, 1, "none", 0) for i in IDS])  # a cycle as a controller sends it
motion = st.one_of(
    st.floats(-0.1, 0.1),
    st.floats(-3.0, 3.0),
    st.floats(-40.0, 40.0),
    st.sampled_from((0.0, -0.0, math.nan, math.inf, -1e300, 5e-324)),
)


def exact(x: Any) -> Any:
    """Return what is equal only to a value of the same bits."""
    if isinstance(x, float):
        return struct.pack("<d", x)
    return tuple(map(exact, x)) if isinstance(x, tuple) else (type(x), x)


class Twins(RuleBasedStateMachine):
    """Three drives in a bank, and the same three by themselves."""

    @initialize(e2e=st.booleans(), fd=st.booleans())
    def power_on(self, e2e: bool, fd: bool) -> None:
        self.e2e, self.fd = e2e and fd, fd
        self.bank = Bank(ratings(self.e2e), fd)
        self.wire = Wire(self.bank, Injector([]), fd)
        self.drives = [Drive(r) for r in ratings(self.e2e)]
        self.commanded: set[int] = set()
        self.counters = dict.fromkeys((*IDS, 5, BROADCAST), 0)
        self.largest = [0.0] * 3

    # ---- what the wire carries

    def raw(self, said: Said) -> bytes:
        """Return the frame's bytes as they come over the bus."""
        data = said.data
        if self.e2e:
            self.counters[said.can_id] = self.counters[said.can_id] + said.ahead & 0xFF
            data = codec.protect(data, self.counters[said.can_id], said.wanted, said.can_id)
        if said.harm == "flip":
            bit = said.bit % (8 * len(data))
            data = (int.from_bytes(data, "big") ^ 1 << bit).to_bytes(len(data), "big")
        if said.harm in ("short", "empty"):
            data = data[: 6 if said.harm == "short" else 0]
        if said.harm == "junk":
            return data
        fd = self.fd != (said.harm == "other size")
        raw = frame.pack(said.can_id, data[: 64 if fd else 8], fd=fd, brs=fd)
        flags = {"rtr": frame.RTR_FLAG, "extended": frame.EFF_FLAG, "error": frame.ERR_FLAG}.get(said.harm, 0)
        head = (int.from_bytes(raw[:4], "little") | flags).to_bytes(4, "little")
        length = bytes((200,)) if said.harm == "length" else raw[4:5]
        return head + length + raw[5:]

    def reply(self, raw: bytes) -> list[bytes]:
        """Answer one frame by the drives one by one, as the bus routes it."""
        try:
            f = frame.unpack(raw)
        except ValueError:
            return []
        if f.error or f.rtr or f.extended or f.fd != self.fd:
            return []
        if f.can_id == BROADCAST:
            motor = f.data[0] | f.data[1] << 8 if len(f.data) >= 8 else -1
            found = [d for d in self.drives if d.rating.motor == motor]
            answers = [d.register(f.data) for d in found]
        else:
            found = [d for d in self.drives if d.rating.motor == f.can_id]
            self.commanded |= {d.rating.motor for d in found}
            answers = [d.receive(f.data) for d in found]
        return [
            frame.pack(d.rating.motor + 0x10, a, fd=self.fd, brs=self.fd)
            for d, a in zip(found, answers, strict=True)
            if a is not None
        ]

    def hear(self, raws: list[bytes], clocked: bool) -> None:
        """Let both take the same frames; with a clock, both stop at the same ones and go on."""
        came, at = Batch(), 0
        came.extend(raws)
        while at < len(raws):
            replies, wanted, start = Batch(128), [], at
            next_frame, why = self.wire.answer(0, came, replies, at, clocked)
            stopped = ALL_READ
            while at < len(raws) and stopped == ALL_READ:
                motor = int.from_bytes(raws[at][:2], "little") & BROADCAST
                if clocked and motor in self.commanded and self._plain(raws[at]):
                    stopped = AGAIN
                    break
                wanted += self.reply(raws[at])
                at += 1
                if clocked and self.commanded == set(IDS):
                    stopped = EVERYBODY
            assert (next_frame, why) == (at, stopped), (start, raws)
            assert replies.frames() == wanted
            if why != ALL_READ:
                self.close()

    @staticmethod
    def _plain(raw: bytes) -> bool:
        try:
            f = frame.unpack(raw)
        except ValueError:
            return False
        return not (f.error or f.rtr or f.extended)

    @rule(frames=traffic, clocked=st.booleans())
    def talk(self, frames: list[Said], clocked: bool) -> None:
        self.hear([self.raw(said) for said in frames], clocked)

    @rule(frames=ordinary)
    def cycle(self, frames: list[Said]) -> None:
        self.hear([self.raw(said) for said in frames], False)

    @rule(frames=ordinary, periods=st.integers(1, 30), q=motion, qd=st.floats(-3.0, 3.0))
    def drive_on(self, frames: list[Said], periods: int, q: float, qd: float) -> None:
        for _ in range(periods):
            self.hear([self.raw(said) for said in frames], False)
            self.sense([q] * 3, [qd] * 3)
            self.act(HALF_MS)
            self.act(HALF_MS)

    @rule()
    def close(self) -> None:
        self.bank.close_period()
        self.commanded.clear()
        self.largest = [max(m, abs(d.torque)) for m, d in zip(self.largest, self.drives, strict=True)]

    # ---- time and motion

    def act(self, dt: int) -> None:
        enabled = self.bank.actuate(dt)
        wanted = [d.actuate(dt) for d in self.drives]
        assert enabled == any(d.state == 1 for d in self.drives)
        got = zip(self.bank.torque.tolist(), self.bank.drag.tolist(), strict=True)
        assert [exact(a) for a in got] == [exact(tuple(w)) for w in wanted]

    def sense(self, q: list[float], qd: list[float]) -> None:
        self.bank.sense(q, qd)
        for drive, a, b in zip(self.drives, q, qd, strict=True):
            drive.sense(a, b)

    @rule(dt=st.sampled_from((125_000, HALF_MS, 100_000_000)), steps=st.integers(1, 40))
    def pass_time(self, dt: int, steps: int) -> None:
        for _ in range(steps):
            self.act(dt)

    @rule(q=st.tuples(motion, motion, motion), qd=st.tuples(motion, motion, motion))
    def move(self, q: tuple[float, ...], qd: tuple[float, ...]) -> None:
        self.sense(list(q), list(qd))

    # ---- what is injected

    @rule(k=st.integers(0, 2), code=st.sampled_from((0x8, 0xA, 0xE)))
    def trip(self, k: int, code: int) -> None:
        for drive in (self.bank.drives[k], self.drives[k]):
            drive.trip(code)

    @rule(k=st.integers(0, 2), temperature=st.sampled_from((25.0, 99.0, 100.0, 110.0, 119.9, 125.0)))
    def heat(self, k: int, temperature: float) -> None:
        for drive in (self.bank.drives[k], self.drives[k]):
            drive.temperature = temperature

    @rule(k=st.integers(0, 2), strength=st.sampled_from((0.5, 1.0)))
    def weaken(self, k: int, strength: float) -> None:
        for drive in (self.bank.drives[k], self.drives[k]):
            drive.strength = strength

    @rule(k=st.integers(0, 2), qd=st.sampled_from((0.05, 0.15, 1.0)), steps=st.integers(1, 12))
    def fall(self, k: int, qd: float, steps: int) -> None:
        """A drive lets its brake go, trips, and its joint goes on to move, up to the time when the brake closes."""
        for special in (codec.CLEAR, codec.ENABLE):
            self.hear([self.raw(Said(IDS[k], b"\xff" * 7 + bytes((special,)), 1, 0, "none", 0))], False)
        self.hear(
            [self.raw(Said(IDS[k], (0x8000 << 48 | 0x800 << 36 | 0x800).to_bytes(8, "big"), 1, 1, "none", 0))], False
        )
        self.sense([0.0] * 3, [qd] * 3)
        self.act(HALF_MS)
        self.pass_time(100_000_000, 1)
        self.trip(k, 0xA)
        self.pass_time(100_000_000, steps)

    @rule(k=st.integers(0, 2))
    def reboot(self, k: int) -> None:
        for drive in (self.bank.drives[k], self.drives[k]):
            drive.boot()

    @rule(k=st.integers(0, 2), q=motion, qd=motion, dt=st.sampled_from((125_000, HALF_MS)))
    def step_one_by_itself(self, k: int, q: float, qd: float, dt: int) -> None:
        """A drive of the bank can be used as one, and the bank goes on from there."""
        a, b = self.bank.drives[k], self.drives[k]
        a.sense(q, qd)
        b.sense(q, qd)
        assert exact(tuple(a.actuate(dt))) == exact(tuple(b.actuate(dt)))

    # ---- and they are the same

    @invariant()
    def same(self) -> None:
        if not hasattr(self, "bank"):
            return
        for a, b in zip(self.bank.drives, self.drives, strict=True):
            for name in (*ATTRIBUTES, "registers", "flash", "flash_writes", "trips"):
                assert exact(getattr(a, name)) == exact(getattr(b, name)), name


TestTwins = Twins.TestCase
TestTwins.settings = settings(
    max_examples=100, stateful_step_count=40, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)


@pytest.mark.parametrize("e2e", [False, True])
def test_more_frames_than_a_batch_holds_are_left_out(e2e: bool) -> None:
    batch = Batch(4)
    frames = [frame.pack(k, bytes(12 if e2e else 8), fd=e2e) for k in range(6)]
    batch.extend(frames)
    assert batch.frames() == frames[:4]
    assert [batch.frame(k) for k in range(4)] == frames[:4]


def test_an_oversize_packet_keeps_its_length_and_stays_in_its_row() -> None:
    batch = Batch()
    batch.extend([bytes(200), b"\x01" * 16])
    assert batch.lengths[:2].tolist() == [200, 16]
    assert batch.frame(1) == b"\x01" * 16
    bank = Bank(ratings(False), fd=False)
    assert Wire(bank, Injector([]), False).answer(0, batch, Batch(), 0, False) == (2, ALL_READ)
