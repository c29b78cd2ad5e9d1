"""One turn of the servo loop, the same for the daemon, the simulation and replay's source: link, tick, link, log."""

import hashlib
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from rtctl.arm import faults, task
from rtctl.arm.memory import Memory
from rtctl.arm.pipe import initial, tick
from rtctl.arm.robot import Robot
from rtctl.hal.can.link import CanLink
from rtctl.hal.clock import Slot
from rtctl.log.record import checkpoint
from rtctl.log.record.health import Repeats
from rtctl.log.record.requests import encode_event, encode_request
from rtctl.types import Command, Drive, Feedback, Frames, Record, Request, Status, Task

TICK, CAN_TX, CAN_RX, EVENT, REQUEST, CHECKPOINT = 1, 2, 3, 4, 5, 9  # kinds of the log's messages
QUIET = Request()


class Sink(Protocol):
    """Where messages go: the recorder's ring, or a file."""

    def put_many(self, kind: int, payloads: Sequence[bytes], time_ns: int) -> bool: ...


class Machine(NamedTuple):
    """The functions in which an arm and a mobile base differ for the loop around the tick; the config chooses."""

    initial: Callable[[Any, Any], Any]  # (robot, feedback) -> memory
    tick: Callable[[Any, Any, Any, Request], tuple[Any, Any, Record]]
    news: Callable[[Any, Any, Any, Any], list[tuple[str, str]]]  # (robot, before, after, feedback)
    harmless: Callable[[Any], Any]  # what a command becomes in a dry run
    rx: int  # kind of the log's messages
    tx: int
    kept: Callable[[Any, Any], bytes | None] | None = None  # (memory, counters) -> checkpoint; None: there are none


class Turn(NamedTuple):
    """What one turn did."""

    feedback: Feedback
    command: Command
    record: Record
    frames: Sequence[bytes]  # sent


def first_feedback(q: np.ndarray) -> Feedback:
    """Return the feedback of a handshake: positions (n,) [rad], everything else at rest."""
    n = len(q)
    zero = np.zeros(n)
    return Feedback(
        -1, 0, q.astype(np.float64), zero, zero, zero, np.ones(n, np.int64), np.zeros(n, np.int64), 0, 0.0, 0.0
    )


class Servo:
    """The memory between turns, the digest of what was sent, and the events that people read."""

    def __init__(
        self,
        robot: Robot,
        link: CanLink,
        sink: Sink | None,
        q: np.ndarray,
        dry: bool = False,
        stamp: Callable[[float], int] | None = None,
        machine: Machine | None = None,
        start: Any = None,
    ) -> None:
        """`q` (n,) [rad] as the handshake found it; `dry` computes and logs but sends only stop frames.

        `stamp` turns robot time [s] into the log's [ns]; by default it is the monotonic clock. `machine` and `start`,
        the first feedback, are an arm's unless others are given.
        """
        self.machine = ARM if machine is None else machine
        self.robot, self.link, self.sink, self.dry = robot, link, sink, dry
        self.stamp = stamp if stamp is not None else lambda now: time.monotonic_ns()
        self.memory: Memory = self.machine.initial(robot, first_feedback(q) if start is None else start)
        self.digest = hashlib.sha256()
        self.missed = 0
        self.now = 0.0  # [s] robot time of the last slot
        self.faults_seen = 0
        self.compute = 0.0  # [s] of the previous turn
        self.repeats = Repeats()
        self.events: list[tuple[float, str, str]] = []  # newest last; (time [s], name, detail)
        self.lateness = 0.0  # [s] of this wake-up
        self.flags = 0  # types.Link bits that only the daemon knows

    def turn(self, slot: Slot, request: Request) -> Turn:
        """Read, decide, write, record."""
        begin = time.perf_counter()
        feedback = self.link.read(slot.slot, slot.missed, slot.lateness, self.compute)
        if self.flags:
            feedback = feedback._replace(link=feedback.link | self.flags)
        before = self.memory
        self.memory, command, record = self.machine.tick(self.robot, before, feedback, request)
        sent = self.machine.harmless(command) if self.dry else command
        frames = self.link.write(sent)
        self.digest.update(frames.data if type(frames) is Frames else b"".join(frames))
        self.missed += slot.missed
        self.lateness = slot.lateness
        self.faults_seen |= self.memory.in_force
        self.now = now = slot.slot * self.robot.dt
        news = self.repeats.passed(now, self.machine.news(self.robot, before, self.memory, feedback))
        self.events += [(now, name, detail) for name, detail in news]
        self._log(feedback, record, frames, request, now, news)
        self.compute = time.perf_counter() - begin
        return Turn(feedback, command, record, frames)

    def errors(self) -> tuple[float | None, float | None]:
        """Return the distance [m] and the angle [rad] to the goal, None for what it leaves free."""
        m = self.memory
        if m.goal is None:
            return None, None
        error, error_rot = task.error_of(m.goal, m.tip.x, m.tip.R)
        return error if m.goal.task & Task.POSITION else None, error_rot if task.turns(m.goal.task) else None

    def _log(
        self,
        feedback: Feedback,
        record: Record,
        frames: Sequence[bytes],
        request: Request,
        now: float,
        news: list[tuple[str, str]],
    ) -> None:
        if self.sink is None:
            return
        stamp = self.stamp(now)
        if request is not QUIET and request != QUIET:
            self.sink.put_many(REQUEST, [encode_request(self.memory.tick, request)], stamp)
        self.sink.put_many(self.machine.rx, self.link.received, stamp)
        self.sink.put_many(TICK, [record.tobytes()], stamp)
        self.sink.put_many(self.machine.tx, frames, stamp)
        kept = self.machine.kept
        if kept is not None and checkpoint.due(self.memory.tick, self.robot.dt):
            text = kept(self.memory, self.link.counters)
            if text is not None:
                self.sink.put_many(CHECKPOINT, [text], stamp)
        if news:
            self.sink.put_many(EVENT, [encode_event(self.memory.tick, now, *each) for each in news], stamp)


def _news(robot: Robot, before: Memory, after: Memory, feedback: Feedback) -> list[tuple[str, str]]:
    """Return what changed in this tick, as (name, detail): states, faults, statuses, refusals."""
    news = []
    if after.verdict:
        news.append(("rejected", after.verdict))
    fresh = after.in_force & ~before.in_force
    if fresh:
        news.append(("fault", faults.describe(fresh, feedback, robot.joints, after.state)))
    if after.state != before.state:
        news.append(("state", after.state.name))
    if (after.status, after.holders) != (before.status, before.holders) and after.status != Status.NO_GOAL:
        news.append((after.status.name.lower(), "; ".join(after.held)))
    return news


ARM = Machine(
    initial=initial,
    tick=lambda *given: tick(*given),  # looked up when called
    news=_news,
    harmless=lambda command: command._replace(drive=Drive.DISABLE),
    rx=CAN_RX,
    tx=CAN_TX,
    kept=checkpoint.encode_checkpoint,
)
