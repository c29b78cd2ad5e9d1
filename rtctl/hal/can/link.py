"""The link to the joint drives: commands out, exactly one reply of each joint back in every cycle.

A reply has no time stamp that can be trusted, so its age is counted in slots of the grid: the drive took its sample
when the command that it answers arrived, which is one slot ago on a healthy bus.
"""

import time
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rtctl.protocol import batch, e2e, frame, mit
from rtctl.protocol.mounting import STRAIGHT, Mounting, Wiring, drive_angle, fields_of, joint_reply
from rtctl.types import F64, I64, Command, Drive, Feedback, Frames, Hold, Link, Transport

MIT, MIT_E2E = "mit", "mit+e2e"
_SPECIAL = {Drive.DISABLE: mit.DISABLE, Drive.ENABLE: mit.ENABLE, Drive.CLEAR: mit.CLEAR}
_DUPLICATE, _DISORDER, _DOWN = int(Link.DUPLICATE), int(Link.DISORDER), int(Link.DOWN)  # a flag's & is slow
_DERATED, _LESS = int(Link.DERATED), int(e2e.Report.CLAMPED | e2e.Report.DERATED)
_REOPEN_S = 1.0  # [s] between attempts to open a bus that went away


class JointSpec(NamedTuple):
    """What the link needs to know of a joint; q_min and q_max [rad] are checked at the start only."""

    name: str
    can_id: int
    scale: mit.Scale
    q_min: float
    q_max: float
    reply: int | None = None  # identifier of its replies; None: can_id + mit.REPLY_OFFSET
    mounting: Mounting = STRAIGHT  # its turns are what the handshake finds
    wraps: bool = False  # its encoder may come back whole turns off when it is switched on

    @property
    def reply_id(self) -> int:
        """Identifier of the replies."""
        return self.can_id + mit.REPLY_OFFSET if self.reply is None else self.reply


class LinkSpec(NamedTuple):
    """What the link needs to know of the robot."""

    place: str  # how the bus is named in errors, `can0`
    joints: tuple[JointSpec, ...]
    protocol: str  # MIT | MIT_E2E
    fd: bool  # frames are CAN FD with bit-rate switch; MIT_E2E needs it
    period: float  # [s] of the servo loop
    watchdog: float  # [s] W: a drive that hears nothing for longer stops by itself
    grippers: int = 0  # the last of `joints` that are none of the arm's, but grippers


def identifiers(joints: Iterable[JointSpec]) -> tuple[int, ...]:
    """Return the identifiers a link listens to: the replies, and the commands that nobody else may send."""
    known = list(joints)
    return (*(joint.reply_id for joint in known), *(joint.can_id for joint in known), mit.REGISTER_ID)


class CanLink:
    """Owns a transport; knows the last good value of each joint."""

    def __init__(self, spec: LinkSpec, transport: Transport) -> None:
        n = len(spec.joints)
        self.spec, self.transport = spec, transport
        self.n = n - spec.grippers  # joints of the arm
        self._grip: F64 = np.zeros((5, spec.grippers))  # the last command of grippers: kept up without one
        self.protected = spec.protocol == MIT_E2E
        self.received: Sequence[bytes] = []  # raw frames of the last read
        self.corrupt = self.ignored = self.foreign = 0  # frames so far
        self.bus_state = Link.NONE  # BUS_OFF or ERROR_PASSIVE while it lasts
        self.pending: list[bytes] = []  # received ahead of the next read
        self.receivers = e2e.Receivers(n)
        self.restarted = True  # the next read comes right after a handshake
        self._counters: I64 = np.zeros(n, np.int64)
        self._length = e2e.LENGTH if self.protected else mit.LENGTH
        self._size = frame.CANFD_MTU if spec.fd else frame.CAN_MTU
        self._padding = bytes(self._size - 8 - self._length)
        self._joint_of = {_word(joint.reply_id): j for j, joint in enumerate(spec.joints)}
        self._ours = frozenset(_word(joint.can_id) for joint in spec.joints)
        self._motors = frozenset(joint.can_id.to_bytes(2, "little") for joint in spec.joints)
        self.turns: tuple[int, ...] = (0,) * n
        self.turn((0,) * n)
        batch.warm(self._cycle)
        self._state: F64 = np.zeros((4, n))  # of the newest reply, as batch.Replies has it
        self._codes: I64 = np.zeros((6, n), np.int64)
        self._codes[0] = -1
        self._sampled: I64 = np.full(n, -1)
        self._slot = -1
        self._reopen_at = 0
        self._flags = self._report = 0  # Link flags of this read; e2e.Report bits of the newest replies

    @property
    def status(self) -> list[int]:
        """e2e.Report of each joint's newest reply."""
        return [int(each) for each in self._codes[4]]

    @property
    def temperature(self) -> list[tuple[int, int]]:
        """Temperature [degC] of each joint's driver and coil."""
        return [(int(mos), int(coil)) for mos, coil in self._codes[1:3].T]

    def turn(self, turns: tuple[int, ...]) -> None:
        """From now on take each joint's encoder to be that many whole turns off: the handshake finds how many."""
        joints, self.turns = self.spec.joints, turns
        mountings = [joint.mounting._replace(turns=k) for joint, k in zip(joints, turns, strict=True)]
        drives = [Wiring(j.can_id, j.reply_id, j.scale, m) for j, m in zip(joints, mountings, strict=True)]
        self._mountings = mountings
        self._fields = [fields_of(drive.scale, drive.mounting) for drive in drives]
        self._cycle = batch.cycle_of(self.protected, self.spec.fd, drives)
        self._commands = (
            batch.cycle_of(self.protected, self.spec.fd, drives[: self.n]) if self.spec.grippers else self._cycle
        )

    # ---- out

    def encode(self, joint: int, payload: bytes, wanted: e2e.Wanted = e2e.Wanted.NONE, can_id: int = -1) -> bytes:
        """Return the raw frame that carries 8 payload bytes to a joint, under its own identifier if none is given."""
        can_id = self.spec.joints[joint].can_id if can_id < 0 else can_id
        if self.protected:
            counter = self._counters[joint] = (int(self._counters[joint]) + 1) & 0xFF
            payload = e2e.protect(payload, counter, wanted, can_id)
        return frame.HEAD.pack(can_id, self._length, frame.FD_FDF | frame.FD_BRS if self.spec.fd else 0) + (
            b"\0\0" + payload + self._padding
        )

    @property
    def counters(self) -> tuple[int, ...]:
        """Return the counter of each joint's newest protected frame."""
        return tuple(self._counters.tolist())

    def set_counter(self, joint: int, counter: int) -> None:
        """Go on counting a joint's protected frames behind `counter`: a replay takes up a log's count."""
        self._counters[joint] = counter & 0xFF

    def write(self, command: Command) -> Sequence[bytes]:
        """Send one frame to each gripper and each joint, or drop it; return the raw frames that went out."""
        special = _SPECIAL.get(command.drive)
        if special is not None:
            order = (*range(self.n, len(self.spec.joints)), *range(self.n))
            return self.transport.send_all(Frames(b"".join([self.encode(j, special) for j in order]), self._size))
        if command.hold is not None:
            frames = Frames(self._held(command.tau, command.hold), self._size)
        else:
            frames = batch.encode(self._commands, command.tau, self._counters)
        if self.spec.grippers:  # first: who closes a period with the arm's last frame has heard them
            frames = Frames(self._gripped(command.grippers) + frames.data, self._size)
        return self.transport.send_all(frames)

    def _gripped(self, commands: F64) -> bytes:
        """Return a frame for each gripper; commands (5, g), as it was where there are none."""
        self._grip = commands if commands.shape[1] else self._grip
        rows = zip(self.spec.joints[self.n :], self._grip.T.tolist(), strict=True)
        data = [mit.encode_command(p, v, kp, kd, t, joint.scale) for joint, (p, v, kp, kd, t) in rows]
        return b"".join([self.encode(self.n + k, each) for k, each in enumerate(data)])

    def _held(self, tau: F64, hold: Hold) -> bytes:
        """Return a frame for each joint that has its drive hold it by its own loop, or a disable frame."""
        frames = []
        for j, joint in enumerate(self.spec.joints[: self.n]):
            if hold.off[j]:
                frames.append(self.encode(j, mit.DISABLE))
                continue
            mounting, d = self._mountings[j], self._mountings[j].direction
            p = drive_angle(float(hold.p[j]), mounting)
            rest = d * float(hold.v[j]), float(hold.kp[j]), float(hold.kd[j]), d * float(tau[j])
            frames.append(self.encode(j, mit.encode_command(p, *rest, joint.scale), e2e.Wanted.TORQUE))
        return b"".join(frames)

    # ---- in

    def read(self, slot: int, missed: int, lateness: float, compute: float) -> Feedback:
        """Drain the bus and return what is known at `slot`; `lateness` and `compute` [s] are passed on for the log."""
        self._flags = 0
        asked = slot - 1 if self.restarted else self._slot  # the slot of the commands that are answered now
        self._slot, self.restarted = slot, False
        received = self.transport.receive()
        if self.pending:
            received, self.pending = [*self.pending, *received], []
        self.received = received
        if not self._take_whole(slot, asked):
            self._take_each(slot, asked)
        self._flags |= self.transport.flags() | int(self.bus_state)
        if self._report & _LESS:
            self._flags |= _DERATED
        if self._flags & _DOWN:
            self._reopen(slot)
        state, codes, n = self._state, self._codes, self.n
        link = int(self._flags)
        if not self.spec.grippers:
            q, qd, tau, age = state
            return Feedback(slot, missed, q, qd, tau, age, codes[5], codes[0], link, lateness, compute)
        q, qd, tau, age = state[:, :n]
        grippers = np.vstack((state[:, n:], codes[0, n:].astype(np.float64)))
        return Feedback(slot, missed, q, qd, tau, age, codes[5, :n], codes[0, :n], link, lateness, compute, grippers)

    def joint_of(self, raw: bytes) -> int | None:
        """Return the joint that a raw frame is a reply of, or None."""
        return self._joint_of.get(raw[:4])

    def payload(self, joint: int, raw: bytes) -> bytes | None:
        """Return the data of a joint's reply, or None if its kind, length or CRC is wrong."""
        if len(raw) != self._size or raw[4] != self._length:
            return None
        data = raw[8 : 8 + self._length]
        if self.protected and not e2e.intact(data, self.spec.joints[joint].reply_id):
            return None
        return data

    def decode(self, joint: int, data: bytes) -> mit.Reply | None:
        """Return what the data of a joint's reply say, in joint coordinates."""
        return joint_reply(data[: mit.LENGTH], self.spec.joints[joint].scale, self._fields[joint])

    def is_ours(self, raw: bytes) -> bool:
        """True if a frame is one that only this program may send: to one of our motors.

        A frame on the identifier of registers says in its first two bytes whom it is for; there are other motors.
        """
        return raw[:4] in self._ours or (raw[:4] == _REGISTERS and raw[8:10] in self._motors and raw[4] > 1)

    def _take_whole(self, slot: int, asked: int) -> bool:
        """Take a cycle in which all is as it should be; return False, with nothing taken, if anything is not."""
        frames = Frames.of(self.received)
        if frames is None:
            return False
        got = batch.decode(self._cycle, frames, self.receivers, (slot - asked) * self.spec.period)
        if got is None:
            return False
        self._state, self._codes, self._report = got
        self._sampled.fill(asked)
        return True

    def _take_each(self, slot: int, asked: int) -> None:
        """Take what came, frame by frame."""
        self._state, self._codes = self._state.copy(), self._codes.copy()  # the feedback before this has the old ones
        self._codes[5] = 0
        for raw in self.received:
            self._take(raw, asked)
        if self._codes[5, : self.n].max() > 1:
            self._flags |= _DUPLICATE
        if self.receivers.disorder.max() == e2e.DISORDER_LIMIT:
            self._flags |= _DISORDER
        self._state[3] = np.multiply(slot - self._sampled, self.spec.period, dtype=np.float64)
        self._report = int(np.bitwise_or.reduce(self._codes[4]))

    def _take(self, raw: bytes, asked: int) -> None:
        joint = self._joint_of.get(raw[:4])
        if joint is None:
            self.take_stranger(raw)
            return
        data = self.payload(joint, raw)
        reply = None if data is None else self.decode(joint, data)
        if data is None or reply is None or reply.id != self.spec.joints[joint].can_id & 0xF:
            self.corrupt += 1
            self._flags |= Link.CORRUPT
            return
        if self.protected and not self._in_sequence(joint, data):
            return
        self._state[:3, joint] = reply.p, reply.v, reply.t
        self._codes[:3, joint] = reply.err, reply.t_mos, reply.t_rotor
        self._sampled[joint] = asked
        self._codes[5, joint] += 1

    def _in_sequence(self, joint: int, data: bytes) -> bool:
        received = self.receivers.judge(joint, data[8])
        if received.check is e2e.Check.REPEATED:
            self._flags |= Link.DUPLICATE
        elif received.check is e2e.Check.WRONGSEQUENCE:
            self._flags |= Link.SEQUENCE
        if received.fresh:
            self._codes[3:5, joint] = data[8], data[9]
        return received.fresh

    def take_stranger(self, raw: bytes) -> None:
        """Account for a frame that is no reply: an error report, a second master, or nothing to us."""
        try:
            one = frame.unpack(raw)
        except ValueError:
            if raw[:4] in self._ours or len(raw) < frame.CAN_MTU:  # else it was never for us
                self.corrupt += 1
                self._flags |= Link.CORRUPT
            else:
                self.ignored += 1
            return
        if one.error:
            self._note_error(one)
        elif self.is_ours(raw):
            self.foreign += 1
            self._flags |= Link.FOREIGN_COMMAND
        else:
            self.ignored += 1

    def _note_error(self, error: frame.Frame) -> None:
        if error.can_id & frame.ERR_BUSOFF:
            self.bus_state = Link.BUS_OFF
        if error.can_id & frame.ERR_RESTARTED:
            self.bus_state = Link.NONE
        if error.can_id & frame.ERR_CRTL and len(error.data) > 1:
            detail = error.data[1]
            if detail & frame.CRTL_OVERFLOW:
                self._flags |= Link.OVERFLOW
            if detail & frame.CRTL_STATES and self.bus_state is not Link.BUS_OFF:
                self.bus_state = Link.ERROR_PASSIVE if detail & frame.CRTL_PASSIVE else Link.NONE

    def wait_replies(self, timeout: float) -> bool:
        """Wait until each joint has replied to the last write, for lockstep; False after `timeout` [s] of silence.

        A bus that is gone answers at once that nothing came: then a period is waited, so that the slots pass as they do
        in real time, and what is tried again each second is.
        """
        missing, deadline = set(range(len(self.spec.joints))), time.monotonic() + timeout
        remaining = timeout
        while remaining > 0.0:
            frames = self.transport.collect(len(missing), timeout)
            self.pending += frames
            missing.difference_update(self._joint_of.get(raw[:4], -1) for raw in frames)
            if not missing:
                return True
            if not frames:
                left = deadline - time.monotonic()
                time.sleep(min(max(left, 0.0), self.spec.period))
                return False
            remaining = deadline - time.monotonic()
        return False

    def _reopen(self, slot: int) -> None:
        if slot >= self._reopen_at:
            self._reopen_at = slot + round(_REOPEN_S / self.spec.period)
            if self.transport.reopen():
                self.bus_state = Link.NONE

    def close(self) -> None:
        """Close the transport."""
        self.transport.close()


def _word(can_id: int) -> bytes:
    """Return the first four bytes of a data frame with an 11-bit identifier."""
    return frame.HEAD.pack(can_id, 0, 0)[:4]


_REGISTERS = _word(mit.REGISTER_ID)
