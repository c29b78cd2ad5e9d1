"""What must be true of a bus before any drive is enabled; it refuses rather than warns.

Only stop frames and register frames go out here. Every exchange is a command and its replies, so it works in lockstep
with a simulator as it does on a bus.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtctl.errors import HandshakeError
from rtctl.hal.can.link import CanLink
from rtctl.hal.can.transport import PythonCan, SocketCan
from rtctl.hal.can.turns import position
from rtctl.protocol import frame, mit
from rtctl.types import F64, Link

WATCHDOG_MAX_S = 0.1
WATCHDOG_MIN_PERIODS = 3
QUEUE_MIN = 64  # frames; the default of a CAN interface, 10, is less than one cycle of two seven-joint arms
LINGER_S = 0.005  # after all have answered: a second motor with the same identifier answers just behind the first
PRINTED = 5e-6  # of a scale: what is lost where a float32 was printed with six digits
_IFF_UP = 1
_NET = Path("/sys/class/net")


class Greeting(NamedTuple):
    """What the handshake found, and the raw frames it moved, for the log."""

    q: F64  # (n,) [rad]
    watchdogs_written: tuple[str, ...]  # joints whose TIMEOUT register had to be changed
    told: tuple[str, ...]  # what people should know: encoders that came back whole turns off
    sent: list[bytes]
    received: list[bytes]


def handshake(
    link: CanLink, listen: float = 0.5, recover: bool = False, timeout: float = 0.1, attempts: int = 3
) -> Greeting:
    """Check the whole bus and every drive on it; HandshakeError names the first thing that is wrong.

    `listen` [s] for a second master (0 where none can be), `timeout` [s] and `attempts` of one exchange. With `recover`
    the arm may stand outside its joint limits. Afterwards the first read finds a reply of each joint.
    """
    _check_watchdog(link)
    if isinstance(link.transport, SocketCan):
        check_interface(link.transport.channel, link.spec.fd)
    talk = _Talk(link, timeout, attempts)
    talk.listen(listen)
    talk.stop_frames()
    for rid, wanted in _identity(link):
        for j, register in enumerate(talk.read(rid)):
            _compare(talk.place(j), register, wanted[j])
    written = _arm_watchdogs(talk)
    q, told = _positions(talk, recover)
    link.restarted, link.bus_state = True, Link.NONE
    return Greeting(q, written, told, talk.sent, talk.received)


def check_interface(channel: str, fd: bool, net: Path = _NET) -> None:
    """Refuse a SocketCAN interface that is down, too short for FD frames, or queues less than a few cycles."""
    at = net / channel
    if not at.exists():
        raise HandshakeError(channel, "no such interface", f"a CAN interface: ip link show {channel}")
    if not int((at / "flags").read_text(), 16) & _IFF_UP:
        raise HandshakeError(channel, "interface down", f"up: ip link set {channel} up")
    mtu = int((at / "mtu").read_text())
    if fd and mtu < frame.CANFD_MTU:
        raise HandshakeError(f"{channel}: mtu", mtu, f"{frame.CANFD_MTU}, or link.fd = false")
    queue = int((at / "tx_queue_len").read_text())
    if queue < QUEUE_MIN:
        wanted = f"at least {QUEUE_MIN}: ip link set {channel} txqueuelen {QUEUE_MIN}"
        raise HandshakeError(f"{channel}: txqueuelen", queue, wanted)


def _check_watchdog(link: CanLink) -> None:
    shortest = WATCHDOG_MIN_PERIODS * link.spec.period
    if not shortest < link.spec.watchdog <= WATCHDOG_MAX_S:
        wanted = f"more than 3 periods ({shortest * 1e3:g} ms) and at most {WATCHDOG_MAX_S * 1e3:g} ms"
        raise HandshakeError(f"{link.spec.place}: watchdog", f"{link.spec.watchdog * 1e3:g} ms", wanted)


def _identity(link: CanLink) -> list[tuple[int, list[float]]]:
    """Return the registers that must agree with the config, with the value of each joint."""
    joints = link.spec.joints
    return [
        (mit.ESC_ID, [joint.can_id for joint in joints]),
        (mit.MST_ID, [joint.reply_id for joint in joints]),
        (mit.CTRL_MODE, [mit.MODE_MIT for _ in joints]),
        (mit.PMAX, [joint.scale.p_max for joint in joints]),
        (mit.VMAX, [joint.scale.v_max for joint in joints]),
        (mit.TMAX, [joint.scale.t_max for joint in joints]),
    ]


def _compare(place: str, register: mit.Register, wanted: float) -> None:
    """Refuse a register that differs; a float by more than is lost where a float32 was printed."""
    place = f"{place}: register {register.rid} {mit.REGISTERS[register.rid]}"
    if register.rid not in mit.FLOATS:
        if register.number != wanted:
            raise HandshakeError(place, f"{register.number:g}", f"{wanted:g}")
        return
    off = register.real - wanted
    if not abs(off) <= PRINTED * wanted:  # also one that is not finite
        share = f" ({off:+.4g}, {100.0 * off / wanted:+.3g} %)" if np.isfinite(off) else ""
        raise HandshakeError(place, f"{register.real:.7g}{share}", f"{wanted:.7g}")


def _arm_watchdogs(talk: "_Talk") -> tuple[str, ...]:
    """Set TIMEOUT where it differs, because writing wears the flash, and read back what was written."""
    counts = round(talk.link.spec.watchdog / mit.TIMEOUT_S)
    wrong = [j for j, register in enumerate(talk.read(mit.TIMEOUT)) if register.number != counts]
    if not wrong:
        return ()
    joints = talk.link.spec.joints
    payloads = {j: mit.write_register(joints[j].can_id, mit.TIMEOUT, counts) for j in wrong}
    talk.registers(payloads, mit.TIMEOUT, write=True)
    for j, register in enumerate(talk.read(mit.TIMEOUT)):
        _compare(talk.place(j), register, counts)
    return tuple(joints[j].name for j in wrong)


def _positions(talk: "_Talk", recover: bool) -> tuple[F64, tuple[str, ...]]:
    """Return the joint angles (n,) [rad] and what is told of them, and let the link know of whole turns.

    Outside its limits an arm is refused unless recovering it was asked for.
    """
    link, replies = talk.link, talk.stop_frames()
    link.pending = [raw for raw, _ in replies]
    found = []
    for j, (_, data) in enumerate(replies):
        spec = link.spec.joints[j]
        reply = mit.decode_reply(data[: mit.LENGTH], spec.scale)
        if reply is None or reply.id != spec.can_id & 0xF:
            raise HandshakeError(f"{talk.place(j)}: reply", data.hex(), f"the id {spec.can_id & 0xF} in its first byte")
        found.append(position(spec, reply.p, f"{talk.place(j)}: position", recover))
        if link.protected:
            link.receivers.restart(j, data[8] - 1 & 0xFF)  # the first read judges this reply again
    link.turn(tuple(each.turns for each in found))
    decoded = [link.decode(j, data) for j, (_, data) in enumerate(replies)]
    q = np.array([reply.p for reply in decoded if reply is not None])
    return q, tuple(f"{link.spec.joints[j].name}: {each.told}" for j, each in enumerate(found) if each.told)


class _Talk:
    """One conversation: sends to all joints at once, collects one answer of each, keeps every raw frame."""

    def __init__(self, link: CanLink, timeout: float, attempts: int) -> None:
        self.link, self.timeout, self.attempts = link, timeout, attempts
        self.sent: list[bytes] = []
        self.received: list[bytes] = []

    def place(self, j: int) -> str:
        joint = self.link.spec.joints[j]
        return f"{self.link.spec.place}: joint {joint.name} (id {joint.can_id})"

    def listen(self, seconds: float) -> None:
        """Refuse a bus on which somebody else sends our identifiers; drop what else was on its way."""
        transport, deadline = self.link.transport, time.monotonic() + seconds
        while True:
            for raw in transport.receive():
                self._account(raw)
            remaining = deadline - time.monotonic()
            if remaining <= 0.0 or not transport.wait(remaining):
                break
        self.link.pending = []

    def _account(self, raw: bytes) -> int | None:
        """Return the joint that a frame comes from; refuse a second master."""
        self.received.append(raw)
        joint = self.link.joint_of(raw)
        if joint is None:
            self.link.take_stranger(raw)
            if self.link.is_ours(raw):
                one = frame.unpack(raw)
                to = f" to motor {one.data[0] | one.data[1] << 8}" if one.can_id == mit.REGISTER_ID else ""
                got = f"somebody else's frame on id {one.can_id:#x}{to}"
                raise HandshakeError(self.link.spec.place, got, "one master")
        return joint

    def stop_frames(self) -> list[tuple[bytes, bytes]]:
        """Send the stop frame to all joints; return each one's reply, raw and as data.

        Raises HandshakeError for a joint that is silent, and for an identifier under which two motors answer.
        """
        replies: dict[int, tuple[bytes, bytes]] = {}
        twice: set[int] | None = None
        for _ in range(self.attempts):
            # All joints each time, so that a drive in lockstep gets whole cycles.
            self._send([self.link.encode(j, mit.DISABLE) for j in self._everyone()])
            answers = self._gather(set(self._everyone()), None)
            many = {j for j, raws in answers.items() if len(raws) > 1}
            twice = many if twice is None else twice & many
            replies |= {j: (raws[-1], self._data(j, raws[-1])) for j, raws in answers.items()}
            if len(replies) == len(self.link.spec.joints) and not many:  # else it may be an answer that was late
                return [replies[j] for j in self._everyone()]
        absent = set(self._everyone()) - set(replies)
        if absent:
            wanted = f"a reply on id {self.link.spec.joints[min(absent)].reply_id:#x}"
            raise HandshakeError(self.place(min(absent)), f"no answer{self._trouble()}{self._overheard()}", wanted)
        if twice:
            angles = " and ".join(self._angle(min(twice), raw) for raw in answers[min(twice)][:2])
            raise HandshakeError(
                self.place(min(twice)), f"two answers to one command, {angles}", "one motor of this id"
            )
        return [replies[j] for j in self._everyone()]

    def _angle(self, joint: int, raw: bytes) -> str:
        reply = mit.decode_reply(self._data(joint, raw)[: mit.LENGTH], self.link.spec.joints[joint].scale)
        return f"{0.0 if reply is None else reply.p:.4f} rad"

    def _overheard(self) -> str:
        """Return in words which frames came, those of others included: for an answer that is missing."""
        transport = self.link.transport
        if isinstance(transport, SocketCan | PythonCan):  # the kernel kept them from us so far
            transport.hear_all()
            self._send([self.link.encode(j, mit.DISABLE) for j in self._everyone()])
            self.received += transport.collect(2 * len(self.link.spec.joints), self.timeout)
        names = {joint.reply_id: joint.name for joint in self.link.spec.joints}
        counts: dict[int, int] = {}
        for raw in self.received:
            can_id = int.from_bytes(raw[:4], "little")
            counts[can_id] = counts.get(can_id, 0) + (can_id <= frame.SFF_MASK)
        came = [f"{i:#x} {names.get(i, f'({n} frames)')}" for i, n in sorted(counts.items()) if n]
        more = f" and {len(came) - 16} more" if len(came) > 16 else ""
        return f"; what came: {', '.join(came[:16])}{more}" if came else ""

    def read(self, rid: int) -> list[mit.Register]:
        """Return one register of every joint."""
        payloads = {j: mit.read_register(joint.can_id, rid) for j, joint in enumerate(self.link.spec.joints)}
        answers = self.registers(payloads, rid, write=False)
        return [answers[j] for j in self._everyone()]

    def registers(self, payloads: dict[int, bytes], rid: int, write: bool) -> dict[int, mit.Register]:
        """Send register frames to some joints; return their answers."""
        answers: dict[int, mit.Register] = {}
        for _ in range(self.attempts):
            missing = {j for j in payloads if j not in answers}
            self._send([self.link.encode(j, payloads[j], can_id=mit.REGISTER_ID) for j in sorted(missing)])
            for j, raws in self._gather(missing, (rid, write)).items():
                register = mit.decode_register(self._data(j, raws[-1])[: mit.LENGTH])
                if register is not None:
                    answers[j] = register
            if len(answers) == len(payloads):
                return answers
        absent = min(set(payloads) - set(answers))
        place = f"{self.place(absent)}: register {rid} {mit.REGISTERS[rid]}"
        raise HandshakeError(place, f"no answer{self._trouble()}", f"an answer to a {'write' if write else 'read'}")

    def _everyone(self) -> range:
        return range(len(self.link.spec.joints))

    def _send(self, frames: list[bytes]) -> None:
        self.sent += self.link.transport.send_all(frames)

    def _gather(self, missing: set[int], register: tuple[int, bool] | None) -> dict[int, list[bytes]]:
        """Return the answers of each joint, those that came in time; `register` names the one awaited, if any."""
        answers: dict[int, list[bytes]] = {}
        transport, deadline = self.link.transport, time.monotonic() + self.timeout
        while missing - set(answers):
            frames = transport.collect(len(missing) - len(answers), self.timeout)
            self._sort(frames, register, answers)
            if not frames or time.monotonic() > deadline:
                break
        while register is None and transport.wait(LINGER_S) and time.monotonic() < deadline:
            self._sort(transport.receive(), register, answers)
        return answers

    def _sort(
        self, frames: Sequence[bytes], register: tuple[int, bool] | None, answers: dict[int, list[bytes]]
    ) -> None:
        for raw in frames:
            joint = self._account(raw)
            if joint is not None and self._register_of(joint, raw) == register:
                answers.setdefault(joint, []).append(raw)

    def _register_of(self, joint: int, raw: bytes) -> tuple[int, bool] | None:
        """Return which register a reply tells, or None for a state; late answers of either kind come to nothing.

        A state with the bytes of a register would stand at the far end of the encoder, where no joint's limits are.
        """
        register = mit.decode_register(self._data(joint, raw)[: mit.LENGTH])
        if register is None or register.motor_id != self.link.spec.joints[joint].can_id:
            return None
        return register.rid, register.write

    def _data(self, joint: int, raw: bytes) -> bytes:
        """Return the data of a reply; refuse a kind of frame that the config does not name."""
        data = self.link.payload(joint, raw)
        if data is None:
            raise HandshakeError(f"{self.place(joint)}: reply", _described(raw), self._kind())
        if self.link.spec.fd and not frame.unpack(raw).brs:
            raise HandshakeError(f"{self.place(joint)}: reply", "CAN FD without bit-rate switch", self._kind())
        if self.link.protected:
            self.link.receivers.restart(joint, data[8])
        return data

    def _kind(self) -> str:
        kind = "CAN FD frame with bit-rate switch" if self.link.spec.fd else "classic CAN frame"
        return f"a {kind} of {'12 bytes, CRC right' if self.link.protected else '8 bytes'}"

    def _trouble(self) -> str:
        return f" ({self.link.bus_state.name})" if self.link.bus_state else ""


def _described(raw: bytes) -> str:
    try:
        one = frame.unpack(raw)
    except ValueError as error:
        return str(error)
    return f"a {'CAN FD' if one.fd else 'classic'} frame of {len(one.data)} bytes, {one.data.hex()}"
