"""One turn of the servo loop, the same for every vehicle, for daemon and simulation: link, tick, link, log."""

import hashlib
import time
from collections.abc import Callable, Sequence
from typing import Generic, TypeAlias

from rtctl.app.own_law import private, raised
from rtctl.app.vehicle import C, Event, F, Link, M, R, Said, Sink, Turn, Vehicle
from rtctl.hal.clock import Slot
from rtctl.log.entry import Kind
from rtctl.log.record import checkpoint
from rtctl.log.record.health import Repeats
from rtctl.log.record.requests import encode_event, encode_request
from rtctl.types import F64, Frames, Record, Request, State, Verb

TICK, EVENT, REQUEST, CHECKPOINT = int(Kind.TICK), int(Kind.EVENT), int(Kind.REQUEST), int(Kind.CHECKPOINT)
QUIET = Request()
ENDS = (Verb.STOP, Verb.DISARM, Verb.DROP, Verb.TERM)  # verbs that end a motion by themselves
Law: TypeAlias = Callable[[R, M, F], Sequence[float] | F64 | None]  # a law of one's own; see `sim.simulate`


class Servo(Generic[R, M, F, C]):
    """The memory between turns, the digest of what was sent, and the events that people read."""

    def __init__(
        self,
        vehicle: Vehicle[R, M, F, C],
        robot: R,
        link: Link[F, C],
        sink: Sink | None,
        start: F,
        dry: bool = False,
        stamp: Callable[[float], int] | None = None,
    ) -> None:
        """`start` is the feedback of the handshake; `dry` computes and logs but sends only what is harmless.

        `stamp` turns robot time [s] into the log's [ns]; by default it is the monotonic clock.
        """
        self.vehicle, self.robot, self.link, self.sink, self.dry = vehicle, robot, link, sink, dry
        self.stamp = stamp if stamp is not None else lambda now: time.monotonic_ns()
        self.memory: M = vehicle.initial(robot, start)
        self.digest = hashlib.sha256()
        self.missed = 0
        self.now = 0.0  # [s] robot time of the last slot
        self.faults_seen = 0
        self.compute = 0.0  # [s] of the previous turn
        self.repeats = Repeats()
        self.notes: list[Event] = []  # of others in this process, for the next turn to tell
        self.events: list[Said] = []  # newest last; (time [s], name, detail)
        self.lateness = 0.0  # [s] of this wake-up
        self.flags = 0  # types.Link bits that only the daemon knows
        self.law: Law[R, M, F] | None = None  # drives the arm in place of this program's own
        self._shown = robot  # to that law
        self.failure: BaseException | None = None  # that it raised

    def drive_by(self, law: Law[R, M, F]) -> None:
        """Have somebody's own law drive the arm from the next turn on."""
        self.law, self._shown = law, private(self.robot)

    def turn(self, slot: Slot, request: Request) -> Turn[F, C]:
        """Read, decide, write, record."""
        begin = time.perf_counter()
        vehicle, robot, link, before = self.vehicle, self.robot, self.link, self.memory
        feedback = link.read(slot.slot, slot.missed, slot.lateness, self.compute)
        if self.flags:
            feedback = vehicle.flagged(feedback, self.flags)
        if self.law is not None:
            request = self._driven(self.law, feedback, request)
        self.memory, command, record = vehicle.tick(robot, before, feedback, request)
        frames = link.write(vehicle.harmless(command) if self.dry else command)
        self.digest.update(frames.data if type(frames) is Frames else b"".join(frames))
        self.missed += slot.missed
        self.lateness = slot.lateness
        self.faults_seen |= self.memory.in_force
        self.now = now = slot.slot * robot.dt
        events = vehicle.events(robot, before, self.memory, feedback)
        if link.said:
            events += [("vehicle", text) for text in link.said]
            link.said.clear()
        if self.notes:
            events += self.notes
            self.notes.clear()
        events = self.repeats.passed(now, events)
        self.events += [(now, name, detail) for name, detail in events]
        self._log(record, frames, request, events)
        self.compute = time.perf_counter() - begin
        return Turn(feedback, command, record, frames)

    def _driven(self, law: Law[R, M, F], feedback: F, request: Request) -> Request:
        """Return the request with the torque of another law; one that raised is never asked again: the arm stops."""
        try:
            tau = law(self._shown, private(self.memory), private(feedback))
            return request if tau is None else request._replace(drive=tuple(map(float, tau)))
        except (Exception, SystemExit) as error:
            self.law, self.failure = None, error
            self.notes.append(("law", raised(error)))
            moves = self.memory.state == State.RUN and request.verb not in ENDS
            return request._replace(verb=Verb.STOP) if moves else request

    def _log(self, record: Record, frames: Sequence[bytes], request: Request, events: list[Event]) -> None:
        if self.sink is None:
            return
        m, stamp, put = self.memory, self.stamp(self.now), self.sink.put_many
        if request is not QUIET and request != QUIET:
            put(REQUEST, [encode_request(m.tick, request)], stamp)
        put(self.vehicle.rx, self.link.received, stamp)
        put(TICK, [record.tobytes()], stamp)
        put(self.vehicle.tx, frames, stamp)
        kept = self.vehicle.checkpoints
        if kept is not None and checkpoint.due(m.tick, self.robot.dt):
            text = kept.encode(m, self.link.counters)
            if text is not None:
                put(CHECKPOINT, [text], stamp)
        if events:
            put(EVENT, [encode_event(m.tick, self.now, *each) for each in events], stamp)
