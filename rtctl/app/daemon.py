"""`rtctl run`: the servo process. One thread, one absolute grid; all that is slow happens elsewhere."""

import json
import os
import select
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from rtctl import design as cfg
from rtctl.app.arm import header_of, link_spec
from rtctl.app.servo import ARM, CAN_RX, CAN_TX, Machine, Servo, first_feedback
from rtctl.arm import faults, task
from rtctl.arm.limits import permit, slew_reference
from rtctl.arm.pipe import warm
from rtctl.arm.robot import Robot
from rtctl.design import Config
from rtctl.errors import EXIT_FAILED, EXIT_OK, UsageError
from rtctl.hal import clock
from rtctl.hal.can.handshake import handshake
from rtctl.hal.can.link import CanLink, identifiers
from rtctl.hal.can.transport import open_transport
from rtctl.hal.client import default_path
from rtctl.hal.clock import Slot
from rtctl.hal.console import Console
from rtctl.hal.messages import Bounds
from rtctl.hal.service import InstanceLock, Service, bus_resource
from rtctl.kernel.rotations import quat_of
from rtctl.log.header import Header
from rtctl.log.record.recorder import Recorder
from rtctl.spec.base import is_base
from rtctl.types import Command, Drive, Feedback, Link, State, Verb
from rtctl.world.primitives import MESH

LOCKSTEP_WAIT = 2.0  # [s] for replies before a lockstep slot goes on without them: no simulated time passes meanwhile
LOCKSTEP_SILENT = 0.05  # [s] the same once a slot went without: a drive that fell silent need not be waited for
REVIEW = 0.5  # [s] between looks at the recorder


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


def say(text: str, to: int = 1) -> None:
    """Print a line if that does not block: a terminal that is stopped must not stop the arm."""
    line = (text + "\n").encode()
    if select.select([], [to], [], 0.0)[1]:
        with suppress(OSError):
            os.write(to, line[-4096:])  # PIPE_BUF: what a writable pipe is sure to take


class Family(NamedTuple):
    """What an arm and a base do each in their own way; chosen by the config's `robot.kind`."""

    load: Callable[[Path], Any]
    build: Callable[[Any, Path], Any]
    warm: Callable[[Any], None]
    lock: Callable[[Any], tuple[str, str]]  # the resource, and the key that names it
    place: Callable[[Any], str]  # the link, as people read it
    open: Callable[[Any, Path], Any]  # the link
    bounds: Callable[[Any, Any], Bounds]  # (robot, link)
    greet: Callable[[Any, Any, bool, Signals], Any]  # (config, link, lockstep, signals): the first feedback
    settle: Callable[[Any], None]  # (link): what came since then is taken, just before the loop
    machine: Callable[[Any], Machine]  # (link)
    header: Callable[[Any, Path, Any, Any], Header]  # (config, path, robot, first feedback)
    status: Callable[[Servo, Recorder], dict[str, Any]]
    fallback: Callable[[Servo, Recorder, Iterator[Slot], bool], None]
    farewell: Callable[[Servo, Recorder], None]
    names: Callable[[int], tuple[str, ...]]  # of faults


def run(config_path: str | Path, lockstep: bool = False, dry: bool = False, timeout: float | None = None) -> int:
    """Run the daemon of a config file until SIGTERM; return the exit code. Raises RtctlError for a refusal.

    lockstep: each slot waits for the replies instead of for its time (simulated drives that keep step).
    dry: everything is computed and logged, but only stop frames are sent.
    timeout: [s] that a base's vehicle is waited for, in place of what the config says.
    """
    path = Path(config_path)
    family = _family(path, lockstep)
    config = family.load(path)
    if timeout is not None:
        config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, handshake_s=timeout))
    signals = Signals()
    with ExitStack() as stack:
        resource, label = family.lock(config)
        stack.enter_context(InstanceLock(resource, label))
        robot = family.build(config, path)
        family.warm(robot)
        link = stack.enter_context(closing(family.open(config, path)))
        bounds = family.bounds(robot, link)
        console = stack.enter_context(
            closing(Console(config.console.socket or default_path(robot.name), robot.dt, bounds))
        )
        say(f"rtctl: {robot.name} on {family.place(config)}, console {console.path}")
        start = family.greet(config, link, lockstep, signals)
        header = family.header(config, path, robot, start)
        recorder = _recorder(config, header._replace(extra={**header.extra, **surroundings(config, link, dry)}))
        servo = Servo(robot, link, recorder, np.zeros(0), dry, machine=family.machine(link), start=start)
        console.publish(lambda: family.status(servo, recorder), lambda: world(servo))
        if not lockstep:
            granted = clock.realtime(
                config.loop.realtime, -1 if config.loop.cpu is None else config.loop.cpu, config.loop.priority
            )
            for refusal in granted.refused:
                say(f"rtctl: best effort: {refusal}")
        service = stack.enter_context(closing(Service(robot.dt)))
        service.ready(f"{robot.name}: IDLE")
        say(f"rtctl: ready, log {recorder.stats().path}")
        family.settle(link)
        code, failure = EXIT_FAILED, None
        slots = clock.lockstep() if lockstep else clock.grid(robot.dt)
        try:
            code = _loop(servo, console, service, recorder, signals, slots, lockstep)
        except Exception as error:
            failure = error  # told when the drives are safe: to tell it reads files
            family.fallback(servo, recorder, slots, lockstep)
        finally:
            family.farewell(servo, recorder)
            stats = recorder.close("stopped" if code == EXIT_OK else "failed")
    if failure is not None:
        say("".join(traceback.format_exception(failure)).rstrip(), to=2)
    say(_summary(servo, family.names(servo.faults_seen), stats.path, stats.dropped))
    return code


def _family(path: Path, lockstep: bool) -> Family:
    """Return the functions of the robot that a file describes. Raises RtctlError."""
    if not is_base(path):
        return ARM_FAMILY
    if lockstep:
        raise UsageError("--lockstep is for drives on a bus; `rtctl sim` plays a base in lockstep")
    from rtctl.app import rover  # pymavlink is not needed for an arm
    from rtctl.design.rover import build
    from rtctl.rover import faults as base_faults
    from rtctl.rover.pipe import warm as base_warm
    from rtctl.spec.base import load

    return Family(
        load=load,
        build=build,
        warm=base_warm,
        lock=lambda config: (bus_resource("mavlink", config.link.url), "link.url"),
        place=lambda config: config.link.url,
        open=rover.open_link,
        bounds=rover.bounds_of,
        greet=lambda config, link, lockstep, signals: link.handshake(
            lambda text: say(f"rtctl: {text}"), lambda: signals.count > 0
        ),
        settle=lambda link: link.settle(),
        machine=rover.machine_of,
        header=rover.header_of,
        status=lambda servo, recorder: rover.status(servo, _log_status(recorder)),
        fallback=lambda servo, recorder, slots, lockstep: rover.fallback(servo, recorder, slots),
        farewell=lambda servo, recorder: rover.farewell(servo, recorder),
        names=base_faults.names,
    )


def _opened(config: Config, path: Path) -> CanLink:
    spec = link_spec(config)
    transport = open_transport(
        config.link.interface,
        config.link.channel,
        bitrate=config.link.bitrate,
        fd=config.link.fd,
        data_bitrate=config.link.data_bitrate or config.link.bitrate,
        listen=identifiers(spec.joints),
        timeout=config.link.handshake_s,
    )
    return CanLink(spec, transport)


def surroundings(config: Any, link: Any, dry: bool) -> dict[str, str]:
    """Return what a log should tell of the machine, and of the link after its handshake."""
    clocksource = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    kernel = Path("/sys/kernel/realtime")
    return {
        "dry": str(int(dry)),
        "realtime": config.loop.realtime,
        "kernel_realtime": kernel.read_text().strip() if kernel.exists() else "no",
        "clocksource": clocksource.read_text().strip() if clocksource.exists() else "unknown",
        "counters": json.dumps(getattr(link, "counters", ())),
    }


def _greeted(config: Config, link: CanLink, lockstep: bool, signals: Signals) -> Feedback:
    if lockstep:  # a busy machine may take its time: none passes for the drives
        return first_feedback(handshake(link, listen=0.0, recover=True, timeout=LOCKSTEP_WAIT).q)
    return first_feedback(handshake(link, listen=1e-3 * config.link.listen_ms, recover=True).q)


def _recorder(config: Any, header: Header) -> Recorder:
    log = config.log
    return Recorder.start(
        log.directory,
        header,
        capacity=1 << (round(log.ring_MB * 1e6) - 1).bit_length(),
        segment_s=log.segment_s,
        segment_bytes=round(log.segment_MB * 1e6),
        floor_bytes=round(log.disk_floor_MB * 1e6),
    )


def _loop(
    servo: Servo,
    console: Console,
    service: Service,
    recorder: Recorder,
    signals: Signals,
    slots: Iterator[Slot],
    lockstep: bool,
) -> int:
    """Turn until the supervisor says that the daemon may leave; return the exit code."""
    every = max(1, round(REVIEW / servo.robot.dt))
    told, heard = 0, True
    for slot in slots:
        request = console.poll(slot.slot)
        if signals.take():
            request = request._replace(verb=Verb.TERM)
            service.stopping()
        servo.turn(slot, request)
        console.answer(not servo.memory.verdict, servo.memory.verdict)
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


def _review(servo: Servo, recorder: Recorder) -> None:
    """Tell the tick whether the log can be written; bring a dead recorder back while the arm is not driven."""
    degraded = recorder.stats().degraded
    servo.flags = int(Link.LOG_DEGRADED) if degraded else 0
    if degraded and servo.memory.state == State.IDLE:
        recorder.spawn()


def _fallback(servo: Servo, recorder: Recorder, slots: Iterator[Slot], lockstep: bool) -> None:
    """A turn raised: damp with the last gravity torque until the arm rests, then leave the drives disabled.

    -D qd + g through the permitter, from the feedback alone: nothing of the tick that failed is used.
    """
    robot, m = servo.robot, servo.memory
    g, sent, rest, driven, heard = m.model.g, m.sent[0], 0, True, True
    for k, turn in enumerate(slots):
        feedback = servo.link.read(turn.slot, turn.missed, turn.lateness, 0.0)
        recorder.put_many(CAN_RX, servo.link.received, time.monotonic_ns())
        driven = bool((feedback.drive == 1).all()) if k == 0 else driven
        rest = rest + 1 if bool((np.abs(feedback.qd) < 0.03).all()) else 0
        if not driven or rest * robot.dt > 0.1 or k * robot.dt > robot.stop.time:
            return
        keep = g - robot.stop.damping * feedback.qd
        reference = slew_reference(sent, feedback.tau, robot.tau_rate, robot.tau_lsb, robot.dt, 1)
        sent = permit(
            np.zeros(robot.n), keep, feedback.qd, reference, robot.tau_max, robot.tau_rate, robot.stop.damping, robot.dt
        ).tau
        _send(servo.link, recorder, Command(Drive.TORQUE, sent))
        if lockstep:
            heard = servo.link.wait_replies(LOCKSTEP_WAIT if heard else LOCKSTEP_SILENT)


def _stop_frames(link: CanLink, robot: Robot, recorder: Recorder) -> None:
    """Send disable frames until the drives have surely heard one."""
    for _ in range(robot.stop.frames):
        _send(link, recorder, Command(Drive.DISABLE, np.zeros(robot.n)))
        time.sleep(robot.dt)
        recorder.put_many(CAN_RX, link.transport.receive(), time.monotonic_ns())


def _send(link: CanLink, recorder: Recorder, command: Command) -> None:
    """Send and log what no tick decided."""
    recorder.put_many(CAN_TX, link.write(command), time.monotonic_ns())


def _summary(servo: Servo, faults_seen: tuple[str, ...], log: Path, dropped: int) -> str:
    m = servo.memory
    seen = ", ".join(faults_seen) or "none"
    return (
        f"rtctl: {m.state.name} after {m.tick + 1} ticks, {servo.missed} slots missed, faults: {seen}, "
        f"log {log} ({dropped} entries dropped)"
    )


def status(servo: Servo, recorder: Recorder) -> dict[str, Any]:
    """Return what `rtctl status` shows."""
    m, robot = servo.memory, servo.robot
    goal = m.goal
    error, error_rot = servo.errors()
    return {
        "robot": robot.name,
        "state": m.state.name,
        "status": m.status.name.lower(),
        "detail": "; ".join(m.held),
        "tick": m.tick,
        "time_s": servo.now,
        "q_rad": m.joints.q,
        "x_m": m.tip.x,
        "wxyz": quat_of(m.tip.R),
        "speed_m_s": float(np.linalg.norm(m.tip.xd)),
        "goal_m": None if goal is None else goal.position,
        "task": None if goal is None else task.names(goal.task),
        "error_m": error,
        "error_rad": error_rot,
        "clearance_m": {
            name: float(d) for name, d in zip(m.world.names, m.rho, strict=True) if name and np.isfinite(d)
        },
        "torque_ratio": float((np.abs(m.sent[0]) / robot.tau_rated).max()),
        "missed": servo.missed,
        "lateness_s": servo.lateness,
        "compute_s": servo.compute,
        "faults": list(faults.names(m.in_force)),
        "log": _log_status(recorder),
    }


def world(servo: Servo) -> dict[str, Any]:
    """Return the obstacles as the controller has them now: the active slots of `primitives.Obstacles`.

    A mesh is told by its name, the points of a cloud not at all: they would not fit an answer.
    """
    known = servo.memory.world
    slots = np.flatnonzero(known.obstacles.active)
    rows = {key: getattr(known.obstacles, key)[slots] for key in ("kind", "R", "p", "v", "w", "dims", "margin")}
    starts = dict(zip(known.known.starts, known.known.names, strict=True))
    meshes = [starts[int(d[3])] if kind == MESH else "" for kind, d in zip(rows["kind"], rows["dims"], strict=True)]
    return {"names": [known.names[k] for k in slots], "meshes": meshes, "obstacles": rows}


def _log_status(recorder: Recorder) -> dict[str, Any]:
    stats = recorder.stats()
    return {"path": str(stats.path), "dropped": stats.dropped, "degraded": stats.degraded}


ARM_FAMILY = Family(
    load=cfg.load,
    build=cfg.build,
    warm=warm,
    lock=lambda config: (bus_resource(config.link.interface, config.link.channel), "link.channel"),
    place=lambda config: f"{config.link.interface}:{config.link.channel}",
    open=_opened,
    bounds=lambda robot, link: Bounds(
        tuple(robot.base.tolist()), robot.reach, robot.tolerance, robot.tolerance_rot, robot.axes
    ),
    greet=_greeted,
    settle=lambda link: None,
    machine=lambda link: ARM,
    header=lambda config, path, robot, start: header_of(config, path, robot, start.q),
    status=status,
    fallback=_fallback,
    farewell=lambda servo, recorder: _stop_frames(servo.link, servo.robot, recorder),
    names=faults.names,
)
