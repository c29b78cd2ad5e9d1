"""The arm as a vehicle: what the loop around its tick, the daemon, the simulation and replay need of it."""

import time
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np

from rtctl import design as cfg
from rtctl.app import guide
from rtctl.app.adviser import Adviser, Inline
from rtctl.app.arm_link import ArmLink, link_spec, open_link
from rtctl.app.arm_log import decoded, header_of, rebuild
from rtctl.app.arm_scene import ArmPlay, scenario_robot
from rtctl.app.servo import Servo
from rtctl.app.simulator import open_simulator
from rtctl.app.vehicle import (
    LOCKSTEP_SILENT,
    LOCKSTEP_WAIT,
    Checkpoints,
    Event,
    Link,
    Said,
    Setup,
    Sink,
    Vehicle,
    clearances,
)
from rtctl.arm import faults, task
from rtctl.arm.gripper import ASKED, SEEN, TARGET, TAU, TORQUE, Gripper, Q, state_of
from rtctl.arm.hot import places_of
from rtctl.arm.limits import TorqueBounds, TorqueParts, limit_torque, slew_reference
from rtctl.arm.memory import Memory
from rtctl.arm.pipe import compile_part, initial, tick, warm
from rtctl.arm.robot import Robot
from rtctl.hal.can.transport import InProcess
from rtctl.hal.clock import Slot
from rtctl.hal.messages import Bounds
from rtctl.hal.service import bus_resource
from rtctl.kernel.rotations import quat_of
from rtctl.log.entry import Kind
from rtctl.log.record.checkpoint import encode_checkpoint
from rtctl.plain import Json
from rtctl.spec.scenario import Scenario
from rtctl.types import F64, Command, Drive, Feedback, Hold, ObstacleEdit, Status, Task
from rtctl.world import obstacle_table

ArmServo: TypeAlias = Servo[Robot, Memory, Feedback, Command]
Bus: TypeAlias = Link[Feedback, Command]
CAN_TX, CAN_RX = int(Kind.CAN_TX), int(Kind.CAN_RX)
SINK_RATE, SINK_TIME = 1.0, 8.0  # [1/s], [s] in which an arm without brakes sinks when the controller has failed
TOLD = places_of("in_force", "state", "own_phase", "lost", "no_position", "payload", "floating", "status", "blockers")
SLOW = 0.3  # [rad/s] of a joint that is held or lowered at most
REST_SPEED, REST_TIME = 0.03, 0.1  # [rad/s], [s] all joints below it: the arm rests


def load(path: Path, timeout: float | None = None) -> Setup[Robot, Memory, Feedback, Command]:
    """Return what an arm's file says; timeout [s] for its drives in place of the file's. Raises ConfigError."""
    config = cfg.load(path)
    if timeout is not None:
        config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, handshake_s=timeout))

    build = cache(lambda: cfg.build(config, path))  # takes seconds; a robot is constant

    def simulate(scenario: Scenario, source: Path) -> ArmPlay:
        robot = scenario_robot(build(), scenario, source)
        simulator = open_simulator(path, scenario, source)
        return ArmPlay(robot, scenario, simulator, ArmLink(link_spec(config), InProcess.of(simulator)))

    return Setup(
        name=config.robot.name,
        loop=config.loop,
        console=config.console,
        log=config.log,
        resource=(bus_resource(config.link.interface, config.link.channel), "link.channel"),
        place=f"{config.link.interface}:{config.link.channel}",
        build=build,
        open=lambda: open_link(config, path),
        header=lambda robot, start, link: header_of(config, path, robot, start.q, counters=link.counters),
        simulate=simulate,
    )


def events(robot: Robot, before: Memory, after: Memory, feedback: Feedback) -> list[Event]:
    """Return what changed in this tick, as (name, detail): states, faults, statuses, refusals."""
    if not (after.refusal or robot.grippers) and told_of(before.hot) == told_of(after.hot):
        return []  # nearly always
    found = []
    if after.refusal:
        found.append(("rejected", after.refusal))
    fresh = after.in_force & ~before.in_force
    if fresh:
        found.append(
            ("fault", faults.describe(fresh, feedback, robot.joints, after.state, robot.links[after.contact_link]))
        )
    if after.state != before.state:
        found.append(("state", after.state.name))
    if after.own_phase:
        found += unheld(robot, before, after, feedback)
    if (payload := after.payload.tolist()) != before.payload.tolist():
        mass, x, y, z = payload
        found.append(("payload", f"{mass:g} kg at {x:g} {y:g} {z:g} m of the tip" if mass > 0.0 else "none"))
    if before.floating and not after.floating:
        found.append(("hold", "no hand guides the arm any more"))
    if robot.grippers:
        found += gripper_events(robot, before, after)
    if (after.status, after.blockers) != (before.status, before.blockers) and after.status != Status.NO_GOAL:
        found.append((after.status.name.lower(), "; ".join(after.blocked_by)))
    return found


def told_of(hot: F64) -> bytes:
    """Return the bytes of a memory that events tell of: with them equal, and no refusal or gripper, there are none."""
    return hot[TOLD].tobytes()


def unheld(robot: Robot, before: Memory, after: Memory, feedback: Feedback) -> list[Event]:
    """Return which joints of an arm without brakes its drives can newly not hold, and why."""
    found = []
    for i, joint in enumerate(robot.joints):
        lost = after.lost & ~before.lost & 1 << i
        if lost and feedback.drive[i] != 1:
            found.append(("cannot_hold", f"{joint}: its drive gives no torque; the others are held"))
        elif lost:
            found.append(("cannot_hold", f"{joint}: its encoder is not to be trusted; the others are held"))
        elif after.no_position & ~before.no_position & 1 << i and not after.no_speed & 1 << i:
            most = robot.stop.kd[i] * SLOW
            found.append(("cannot_hold", f"{joint}: damped alone, which carries {most:.2g} Nm at {SLOW:g} rad/s"))
        elif not before.own_phase and not after.own_kd[i] > 0.0:
            found.append(("cannot_hold", f"{joint}: its encoder may be stuck; held as soon as it moves"))
        elif not before.own_phase and feedback.replies[i] == 0:
            found.append(("cannot_hold", f"{joint}: is silent; whether its drive holds it is not known"))
    return found


def errors(m: Memory) -> tuple[float | None, float | None]:
    """Return the distance [m] and the angle [rad] to the goal, None for what it leaves free."""
    if m.goal is None:
        return None, None
    error, error_rot = task.error_of(m.goal, m.tip.x, m.tip.R)
    return error if m.goal.task & Task.POSITION else None, error_rot if task.turns(m.goal.task) else None


def status(robot: Robot, m: Memory, link: Bus, said: Sequence[Said]) -> Json:
    """Return what `rtctl status` shows of an arm."""
    goal, (error, error_rot) = m.goal, errors(m)
    return {
        "detail": "; ".join(m.blocked_by),
        "q_rad": m.joints.q,
        "x_m": m.tip.x,
        "wxyz": quat_of(m.tip.R),
        "speed_m_s": float(np.linalg.norm(m.tip.xd)),
        "goal_m": None if goal is None else goal.position,
        "goal_velocity_m_s": None if goal is None else goal.velocity,
        "goal_velocity_rad_s": None if goal is None else goal.omega,
        "goal_timeout_ms": None if goal is None or goal.timeout is None else 1e3 * goal.timeout,
        "goal_age_ms": None if goal is None or goal.timeout is None else 1e3 * m.goal_age,
        "task": None if goal is None else task.names(goal.task),
        "error_m": error,
        "error_rad": error_rot,
        "clearance_m": clearances(m),
        "rooms_m": rooms(m),
        "payload": dict(zip(("mass_kg", "com_m"), (float(m.payload[0]), m.payload[1:]), strict=True)),
        "grippers": [grip_status(g, m.grippers[:, k]) for k, g in enumerate(robot.grippers)],
        "untold_Nm": m.lasting if m.noticed else np.zeros(robot.n),
        "torque_ratio": float((np.abs(m.sent[0]) / robot.tau_rated).max()),
    }


def rooms(m: Memory) -> Json:
    """Return influence and clearance [m] of the obstacles that have their own, by name."""
    own = m.world.obstacles.room
    return {m.world.names[k]: own[k, :2].tolist() for k in np.flatnonzero(m.world.obstacles.active & (own[:, 0] > 0.0))}


def grip_status(gripper: Gripper, memory: F64) -> Json:
    """Return what `rtctl status` shows of a gripper; memory (10,)."""
    seen = memory[SEEN:]
    return {
        "name": gripper.name,
        "state": state_of(gripper, memory),
        "closed": gripper.share(float(seen[Q])),
        "wanted": gripper.share(float(memory[TARGET])) if memory[ASKED] else None,
        "force_N": abs(float(seen[TAU])) / gripper.lever,
        "force_max_N": float(memory[TORQUE]) / gripper.lever,
    }


def gripper_events(robot: Robot, before: Memory, after: Memory) -> list[Event]:
    """Return which grippers are newly in another state, in words."""
    found = []
    for k, g in enumerate(robot.grippers):
        now = state_of(g, after.grippers[:, k])
        if now != state_of(g, before.grippers[:, k]):
            at = g.share(float(after.grippers[SEEN + Q, k]))
            found.append(("gripper", f"{g.name}: {now} at {min(max(at, 0.0), 1.0):.2f} of closed"))
    return found


def _warm(robot: Robot) -> None:
    warm(robot)
    guide.warm(robot)


def _compile_part(robot: Robot, part: int) -> None:
    compile_part(robot, part)
    if part == 0:
        guide.warm(robot)


def misplaced(robot: Robot, m: Memory, edit: ObstacleEdit) -> str:
    """Return why an obstacle cannot be where a person says, '' where it can: nothing that is real lies inside the arm.

    Taken as told it would be a contact, and the field would drive the arm out of it as fast as its joints may go.
    """
    depth, point = obstacle_table.nearest_of(m.world, edit, m.model.P, robot.points.radius)
    if depth >= 0.0:
        return ""
    return f"would lie {-depth:.3f} m inside {robot.points.names[point]}, wanted a place clear of the arm"


def fallback(robot: Robot, m: Memory, link: Bus, sink: Sink, slots: Iterator[Slot], lockstep: bool) -> None:
    """A turn raised: damp with the last gravity torque until the arm rests, then leave the drives disabled.

    -D qd + g through the limiter, from the feedback alone: nothing of the tick that failed is used. An arm without
    brakes then sinks, by the drives' own loops.
    """
    g, sent, rest, driven, heard = m.model.g, m.sent[0], 0, True, True
    bounds = TorqueBounds(robot.tau_max, robot.tau_rate, robot.tau_lsb, robot.stop.damping)
    for k, slot in enumerate(slots):
        feedback = link.read(slot.slot, slot.missed, slot.lateness, 0.0)
        sink.put_many(CAN_RX, link.received, time.monotonic_ns())
        driven = bool((feedback.drive == 1).all()) if k == 0 else driven
        rest = rest + 1 if bool((np.abs(feedback.qd) < REST_SPEED).all()) else 0
        if not driven:
            return
        if rest * robot.dt > REST_TIME or k * robot.dt > robot.stop.time:
            if robot.brakeless:
                _sink(robot, feedback.q, g, link, sink, slots, lockstep)
            return
        keep = g - robot.stop.damping * feedback.qd
        reference = slew_reference(sent, feedback.tau, robot.tau_rate, robot.tau_lsb, robot.dt, 1)
        sent = limit_torque(TorqueParts(np.zeros(robot.n), keep), feedback.qd, reference, bounds, robot.dt).tau
        sink.put_many(CAN_TX, link.write(Command(Drive.TORQUE, sent)), time.monotonic_ns())
        if lockstep:
            heard = link.wait_replies(LOCKSTEP_WAIT if heard else LOCKSTEP_SILENT)


def _sink(robot: Robot, q: F64, g: F64, link: Bus, sink: Sink, slots: Iterator[Slot], lockstep: bool) -> None:
    """Have the drives hold the arm at q (n,) [rad], with gravity g (n,) [Nm], ever more softly."""
    zero, nobody, heard = np.zeros(robot.n), np.zeros(robot.n, np.bool_), True
    for k, slot in enumerate(slots):
        if k * robot.dt > SINK_TIME:
            return
        link.read(slot.slot, slot.missed, slot.lateness, 0.0)
        sink.put_many(CAN_RX, link.received, time.monotonic_ns())
        left = float(np.exp(-SINK_RATE * k * robot.dt))
        hold = Hold(q, zero, left * robot.stop.kp, robot.stop.kd, nobody)
        sink.put_many(CAN_TX, link.write(Command(Drive.HOLD, left * g, hold)), time.monotonic_ns())
        if lockstep:
            heard = link.wait_replies(LOCKSTEP_WAIT if heard else LOCKSTEP_SILENT)


def farewell(robot: Robot, m: Memory, link: Bus, sink: Sink) -> None:
    """Send disable frames until the drives have surely heard one."""
    for _ in range(robot.stop.frames):
        sink.put_many(CAN_TX, link.write(Command(Drive.DISABLE, np.zeros(robot.n))), time.monotonic_ns())
        time.sleep(robot.dt)
        link.read(-1, 0, 0.0, 0.0)
        sink.put_many(CAN_RX, link.received, time.monotonic_ns())


ARM = Vehicle(
    rx=CAN_RX,
    tx=CAN_TX,
    load=load,
    warm=_warm,
    compile_part=_compile_part,
    bounds=lambda robot, link: Bounds(
        tuple(robot.base.tolist()), robot.reach, robot.tolerance, robot.tolerance_rot, robot.axes
    ),
    initial=initial,
    tick=lambda robot, memory, feedback, request: tick(robot, memory, feedback, request),  # looked up when called
    flagged=lambda feedback, flags: feedback._replace(link=feedback.link | flags),
    harmless=lambda command: command._replace(drive=Drive.DISABLE),
    events=events,
    names=faults.names,
    status=status,
    adviser=lambda robot, lockstep: Inline(robot) if lockstep else Adviser(robot),
    misplaced=misplaced,
    fallback=fallback,
    farewell=farewell,
    rebuild=rebuild,
    checkpoints=Checkpoints(encode_checkpoint, decoded),
    keeps_step=True,
    takes_law=True,
)
