"""`rtctl run`: the servo process. One thread, one absolute grid; all that is slow happens elsewhere."""

import json
import signal
import time
import traceback
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from types import FrameType
from typing import Generic, NamedTuple, Protocol

import numpy as np

from rtctl.app.choose import refuse_law, vehicle_of
from rtctl.app.own_law import AnyLaw, load_law
from rtctl.app.queue import GoalQueue
from rtctl.app.servo import Servo
from rtctl.app.vehicle import LOCKSTEP_SILENT, LOCKSTEP_WAIT, Advising, C, F, Loop, M, R, Say, Setup, Vehicle
from rtctl.errors import EXIT_FAILED, EXIT_OK, UsageError
from rtctl.hal import clock
from rtctl.hal.client import default_path
from rtctl.hal.clock import Slot
from rtctl.hal.console import Console
from rtctl.hal.lobby import Lobby
from rtctl.hal.say import say
from rtctl.hal.service import InstanceLock, Service
from rtctl.log.header import Header
from rtctl.log.record.recorder import Recorder, Stats
from rtctl.plain import Json
from rtctl.spec.robot import LogTable
from rtctl.types import Link, State, Verb
from rtctl.world.primitives import MESH

REVIEW = 0.5  # [s] between looks at the recorder
REST = 0.1  # [s] at rest before a status says so


class Signals:
    """SIGTERM and SIGINT: the first asks for rest, the second for torque off."""

    def __init__(self) -> None:
        self.count = 0
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1

    def take(self) -> bool:
        """Return whether a signal waits, and take it."""
        waits = self.count > 0
        self.count -= waits
        return waits


def run(
    config_path: str | Path,
    lockstep: bool = False,
    dry: bool = False,
    timeout: float | None = None,
    passing: Collection[int] = (),
    lobby: Lobby | None = None,
    law: str = "",
) -> int:
    """Run the daemon of a config file until SIGTERM; return the exit code. Raises RtctlError for a refusal.

    lockstep: each slot waits for the replies instead of for its time (simulated drives that keep step).
    dry: everything is computed and logged, but only stop frames are sent.
    timeout: [s] that the vehicle is waited for, in place of what the config says.
    passing: user ids whose hold on the bus does not count, see `InstanceLock`.
    lobby: who answers at the control socket already; by default that begins here.
    law: FILE.py:NAME of a law of one's own for an arm, see `sim.simulate`; when it raises, the arm is stopped, and no
    law but this program's is asked from then on.
    """
    path = Path(config_path)
    vehicle = vehicle_of(path)
    if law:
        refuse_law(vehicle, path)
    if lockstep and not vehicle.keeps_step:
        raise UsageError("--lockstep is for drives on a bus; `rtctl sim` plays a base in lockstep")
    return _run(
        vehicle, vehicle.load(path, timeout), How(path, lockstep, dry, passing, lobby, load_law(law) if law else None)
    )


class How(NamedTuple):
    """How a daemon was asked to run: the arguments of `run`."""

    path: Path  # of the robot's file
    lockstep: bool
    dry: bool
    passing: Collection[int]
    lobby: Lobby | None
    law: AnyLaw | None


def _run(vehicle: Vehicle[R, M, F, C], setup: Setup[R, M, F, C], how: How) -> int:
    signals, lockstep, dry = Signals(), how.lockstep, how.dry
    with ExitStack() as stack:
        stack.enter_context(InstanceLock(*setup.resource, ignore=how.passing))
        place = setup.console.socket or default_path(setup.name)
        lobby = how.lobby
        if lobby is None or lobby.path != place:
            lobby = stack.enter_context(Lobby(place, setup.name))
        lobby.tell("building the robot and loading what is compiled")
        robot = setup.build()
        vehicle.warm(robot)
        link = stack.enter_context(closing(setup.open()))
        say(f"rtctl: {robot.name} on {setup.place}, console {place}")
        lobby.tell("greeting the drives" if vehicle.keeps_step else "waiting for the autopilot")
        start = link.greet(lockstep, _teller(lobby), lambda: signals.count > 0)
        header = setup.header(robot, start, link)
        told = {**header.extra, **surroundings(setup.loop.realtime, link.counters, dry)}
        door = lobby.hand_over()  # before the recorder: it is a process of its own
        console = stack.enter_context(closing(Console(place, robot.dt, vehicle.bounds(robot, link), door=door)))
        adviser = stack.enter_context(closing(vehicle.adviser(robot, lockstep)))  # a fork: the thread has ended
        recorder = _recorder(setup.log, header._replace(extra=told), how.path)
        servo = Servo(vehicle, robot, link, recorder, start, dry)
        if how.law is not None:
            servo.drive_by(how.law)
        queue = GoalQueue()
        console.publish(
            lambda: {**status(servo, recorder), **queue.status()},
            lambda: world(servo),
            lambda edit: vehicle.misplaced(robot, servo.memory, edit),
        )
        if not lockstep:
            _scheduled(setup.loop, stack.enter_context(clock.light_sleep()))
        service = stack.enter_context(closing(Service(robot.dt)))
        service.ready(f"{robot.name}: IDLE")
        say(f"rtctl: ready, log {recorder.stats().path}")
        link.settle()
        process = Process(servo, console, service, recorder, signals, queue, adviser, lockstep)
        code, failure = EXIT_FAILED, None
        slots = clock.lockstep() if lockstep else clock.grid(robot.dt)
        try:
            code = _loop(process, slots)
        except Exception as error:
            failure = error  # told when the drives are safe: to tell it reads files
            vehicle.fallback(robot, servo.memory, link, recorder, slots, lockstep)
        finally:
            vehicle.farewell(robot, servo.memory, link, recorder)
            stats = recorder.close("stopped" if code == EXIT_OK else "failed")
    if failure is not None:
        say("".join(traceback.format_exception(failure)).rstrip(), to=2)
    say(_summary(servo, stats.path, stats.dropped))
    return code


def _teller(lobby: Lobby) -> Say:
    def told(text: str) -> None:
        say(f"rtctl: {text}")
        lobby.tell(text)

    return told


def _scheduled(loop: Loop, sleeps: str) -> None:
    """Take the real-time rights that the config asks for; say what was refused. Raises RtctlError if required.

    sleeps: why the cores sleep deeply, "" if they do not. It makes turns late, not wrong: never a reason to refuse.
    """
    granted = clock.realtime(loop.realtime, -1 if loop.cpu is None else loop.cpu, loop.priority)
    for refusal in (*granted.refused, *([sleeps] if sleeps else [])):
        say(f"rtctl: best effort: {refusal}")


def surroundings(realtime: str, counters: tuple[int, ...], dry: bool) -> dict[str, str]:
    """Return what a log should tell of the machine; counters: of the link after its handshake."""
    clocksource = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    kernel = Path("/sys/kernel/realtime")
    return {
        "dry": str(int(dry)),
        "realtime": realtime,
        "kernel_realtime": kernel.read_text().strip() if kernel.exists() else "no",
        "clocksource": clocksource.read_text().strip() if clocksource.exists() else "unknown",
        "counters": json.dumps(counters),
    }


def _recorder(log: LogTable, header: Header, path: Path) -> Recorder:
    return Recorder.start(
        log.directory,
        header,
        capacity=1 << (round(log.ring_MB * 1e6) - 1).bit_length(),
        segment_s=log.segment_s,
        segment_bytes=round(log.segment_MB * 1e6),
        floor_bytes=round(log.disk_floor_MB * 1e6),
        config=path,
    )


class Process(NamedTuple, Generic[R, M, F, C]):
    """What the servo process has open."""

    servo: Servo[R, M, F, C]
    console: Console
    service: Service
    recorder: Recorder
    signals: Signals
    queue: GoalQueue
    adviser: Advising[M]
    lockstep: bool


def _loop(process: Process[R, M, F, C], slots: Iterator[Slot]) -> int:
    """Turn until the supervisor says that the daemon may leave; return the exit code."""
    servo, console, service, recorder, signals, queue, adviser, lockstep = process
    every = max(1, round(REVIEW / servo.robot.dt))
    told, heard = 0, True
    for slot in slots:
        request = console.poll(slot.slot)
        if signals.take():
            request = request._replace(verb=Verb.TERM)
            service.stopping()
        request, put_aside = queue.passed(request, servo.memory.state)
        if request.verb == Verb.NONE and request.goal is None:  # else next time: it stays in the socket
            advice = adviser.advise(servo.memory)
            request = request if advice is None else request._replace(advice=advice)
            servo.notes += adviser.events
            adviser.events.clear()
        servo.turn(slot, request)
        if request.goal is not None and not servo.memory.refusal:
            adviser.begin()
        queue.judged(servo.memory.refusal)
        console.answer(not servo.memory.refusal, servo.memory.refusal or put_aside)
        recorder.beat(time.monotonic_ns())
        service.kick(slot.slot)
        for now, name, detail in servo.events[told:]:
            say(f"{now:10.3f} s  {name}{': ' if detail else ''}{detail}")
        told = len(servo.events)
        if slot.slot % every == 0:
            _review(servo, recorder)
        if servo.memory.done:
            return EXIT_OK
        if lockstep:
            heard = servo.link.wait_replies(LOCKSTEP_WAIT if heard else LOCKSTEP_SILENT)
    raise AssertionError("the grid has no end")


def _review(servo: Servo[R, M, F, C], recorder: Recorder) -> None:
    """Tell the tick whether the log can be written; bring a dead recorder back while the arm is not driven."""
    degraded = recorder.stats().degraded
    servo.flags = int(Link.LOG_DEGRADED) if degraded else 0
    if degraded and servo.memory.state == State.IDLE:
        recorder.spawn()


def _summary(servo: Servo[R, M, F, C], log: Path, dropped: int) -> str:
    m, seen = servo.memory, ", ".join(servo.vehicle.names(servo.faults_seen)) or "none"
    late = "" if log.exists() else "; the recorder is still writing it"
    return (
        f"rtctl: {m.state.name} after {m.tick + 1} ticks, {servo.missed} slots missed, faults: {seen}, "
        f"log {log} ({dropped} entries dropped){late}"
    )


class Recording(Protocol):
    """What knows how the log is."""

    def stats(self) -> Stats: ...


def status(servo: Servo[R, M, F, C], recorder: Recording) -> Json:
    """Return what `rtctl status` shows."""
    m, robot, stats = servo.memory, servo.robot, recorder.stats()
    return {
        "robot": robot.name,
        "state": m.state.name,
        "status": m.status.name.lower(),
        "tick": m.tick,
        "time_s": servo.now,
        **servo.vehicle.status(robot, m, servo.link, servo.events),
        "at_rest": m.rest * robot.dt >= REST,
        "missed": servo.missed,
        "lateness_s": servo.lateness,
        "compute_s": servo.compute,
        "faults": list(servo.vehicle.names(m.in_force)),
        "log": {"path": str(stats.path), "dropped": stats.dropped, "degraded": stats.degraded},
    }


def world(servo: Servo[R, M, F, C]) -> Json:
    """Return the obstacles as the controller has them now: the active slots of `primitives.Obstacles`.

    A mesh is told by its name, the points of a cloud not at all: they would not fit an answer.
    """
    known = servo.memory.world
    slots = np.flatnonzero(known.obstacles.active)
    rows = {key: getattr(known.obstacles, key)[slots] for key in ("kind", "R", "p", "v", "w", "dims", "margin", "room")}
    starts = dict(zip(known.known.starts, known.known.names, strict=True))
    meshes = [starts[int(d[3])] if kind == MESH else "" for kind, d in zip(rows["kind"], rows["dims"], strict=True)]
    return {"names": [known.names[k] for k in slots], "slots": slots, "meshes": meshes, "obstacles": rows}
