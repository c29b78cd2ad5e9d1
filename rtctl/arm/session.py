"""The supervisor's work of one tick: faults in, events out, the state of the session moved by the table."""

import math

import numpy as np

from rtctl.arm import detection, faults, task
from rtctl.arm.escape import Escape
from rtctl.arm.faults import BIT, Evidence
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.control import goals, supervisor
from rtctl.control.supervisor import Asked, Event, Rules, Session, supervisor_step
from rtctl.kernel import reductions
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, Cut, Feedback, Goal, Request, Severity, State, Status, Task, Verb
from rtctl.world import obstacle_table

SETTLE = 0.2  # [s] of holding torque before RUN: brakes open and the torque builds up at its rate limit
ENABLE_TIMEOUT = 1.0  # [s] for every drive to report enabled
CLEAR_TIME = 0.1  # [s] for which latched drive faults are cleared after a reset
REST_SPEED = 0.03  # [rad/s] a joint slower than this rests (encoders of MIT drives resolve 0.005)
REST_HOLD = 0.1  # [s] at rest before the drives are disabled
STOP_TIME = 3.0  # [s] STOPPING gives up waiting for rest: something keeps pushing, brakes do the rest
CLEARING = "drive faults are being cleared now: reset again"
OUTSIDE = "a joint is beyond its limits: move it back by hand, or use recover"
RULES = Rules(faults.TABLE, faults.REFUSES_ARMING, {})
NON_FINITE = int(Cut.NON_FINITE)  # a plain integer: a flag's & is slow


def drives_torque(m: Memory) -> bool:
    """Return whether the state wants torque from the drives."""
    if m.state == State.SAFE_STOP:
        return not m.off
    return m.state in (State.ARMED, State.RUN, State.STOPPING)


def believed(robot: Robot, m: Memory, feedback: Feedback) -> tuple[Feedback, bool]:
    """Return the feedback with silence in place of positions that no joint can have reached, and whether any is.

    A joint that goes on reporting such positions stays silent: the filter that damps it must not see the jump.
    """
    if not drives_torque(m) or m.state == State.ARMED:
        return feedback, False
    elapsed = robot.dt * (1 + feedback.missed)
    args = (feedback.q, feedback.age, feedback.replies, m.q_previous, m.age_previous, robot.qd_max, elapsed, robot.dt)
    if not faults.any_jumped(*args):
        return feedback, False
    odd = faults.jumped(*args)
    silent = np.minimum(m.age_previous + elapsed, robot.safety.lost_periods * robot.dt)
    return feedback._replace(
        q=np.where(odd, m.q_previous, feedback.q),
        age=np.where(odd, silent, feedback.age),
        replies=np.where(odd, 0, feedback.replies),
    ), True


def detected(robot: Robot, m: Memory, feedback: Feedback, jumped: bool) -> tuple[Memory, int]:
    """Return the memory with the faults in force, and the bits of those present now; what jumped is in no feedback."""
    f, safety = feedback, robot.safety
    powered = drives_torque(m)
    active = powered and m.state != State.ARMED
    watch, age, feed_age, seen = detection.notice(
        m.watch, active, f.q, f.qd, f.tau, f.age, f.replies, f.drive, m.sent, m.q_previous, m.age_previous, m.qdd,
        m.model.A, m.rho, m.goal_rho, m.world.age, m.world.moving, safety.torque_tolerance, safety.friction,
        safety.velocity_tolerance, safety.limit_tolerance, safety.speed_tolerance, REST_SPEED, robot.q_min, robot.q_max,
        robot.qd_max, robot.dt * (1 + f.missed), robot.dt,
    )  # fmt: skip
    lost = bool(m.cut & NON_FINITE) or not math.isfinite(m.innovation)
    evidence = Evidence(
        seen, age, feed_age, f.missed, active, powered, jumped, m.pulled, m.recovering, lost, m.goal is not None,
        m.innovation,
    )  # fmt: skip
    present, counters = faults.detect(f.link, evidence, m.counters, safety, robot.dt)
    in_force, good = faults.TABLE.latch(present, m.in_force, m.good)
    outside = bool(seen & detection.BEYOND)
    m = m._replace(
        counters=counters,
        in_force=in_force,
        good=good,
        q_previous=feedback.q,
        age_previous=feedback.age,
        outside=outside,
        recovering=m.recovering and outside,
        watch=watch,
        rest=0 if seen & detection.STIRS else m.rest + 1,
    )
    return m, present


def supervised(robot: Robot, m: Memory, feedback: Feedback, request: Request, present: int) -> Memory:
    """Return the memory after the supervisor's table took this tick's events."""
    if m.state == State.RUN and request.verb == Verb.NONE and faults.TABLE.stops(m.in_force) < Severity.SS2:
        return m  # what RUN is left for is asked, or a fault
    verb, before = request.verb, m.state
    clearing = verb == Verb.RESET and supervisor.admits(before, verb) and bool(present & BIT["drive_fault"])
    outside = verb == Verb.ARM and m.outside
    asked = Asked(
        m.tick, verb, present, _timed(robot, m, reductions.all_equal(feedback.drive, 1)),
        CLEARING if clearing else "", OUTSIDE if outside else "",
    )  # fmt: skip
    step = supervisor_step(RULES, Session(before, m.since, m.reaction, m.in_force, m.leaving), asked)
    m = m._replace(**step.session._asdict(), verdict=step.refusal or m.verdict)
    if clearing:
        m = m._replace(clear_until=m.tick + round(CLEAR_TIME / robot.dt))
    if m.state != before:
        m = _entered(robot, m)
    if step.event == Event.ARM:
        m = m._replace(recovering=m.outside)
    at_rest = m.state in (State.IDLE, State.FAULT) or (m.state == State.SAFE_STOP and m.off)
    return m._replace(done=m.leaving and at_rest)


def _timed(robot: Robot, m: Memory, enabled: bool) -> frozenset[Event]:
    """Return the events that come of waiting."""
    elapsed = (m.tick - m.since) * robot.dt
    if m.state == State.ARMED:
        if enabled and elapsed >= SETTLE:
            return frozenset((Event.SETTLED,))
        return frozenset((Event.TIMEOUT,) if not enabled and elapsed >= ENABLE_TIMEOUT else ())
    if m.state == State.STOPPING:
        at_rest = m.rest * robot.dt >= REST_HOLD and elapsed >= REST_HOLD
        return frozenset((Event.RESTED,) if at_rest or not enabled or elapsed >= STOP_TIME else ())
    return frozenset()


def _entered(robot: Robot, m: Memory) -> Memory:
    """Return the memory on entering a state: every motion begins from what is measured now."""
    m = free_of_goals(m)._replace(off=False)
    if m.state in (State.ARMED, State.RUN):
        m = m._replace(v_ref=np.zeros(3), w_ref=np.zeros(3))
    return held_here(robot, m)


def held_here(robot: Robot, m: Memory) -> Memory:
    """Return the memory with the pose and posture of now as those to hold."""
    return m._replace(hold=hold_at(m.tip.x, m.tip.R, robot.axes), q_rest=m.joints.q)


def hold_at(x: F64, R: F64, axes: Task) -> Goal:
    """Return the goal of staying at x (3,) [m] with orientation R (3, 3), along the axes that the arm can move."""
    return Goal(x.copy(), quat_of(R), axes, 0.0, 0.0)


def with_goal(robot: Robot, m: Memory, request: Request) -> Memory:
    """Return the memory with the request's goal, or with the reason why it was refused."""
    goal = request.goal
    if goal is None:
        return m
    verdict = ""
    if m.state != State.RUN:
        verdict = f"goal: not possible in state {m.state.name}"
    elif m.outside:
        verdict = "goal: a joint is still beyond its limits"
    if goal.posture is not None and not _is_posture(robot, goal.posture):
        verdict = verdict or f"goal: got posture {goal.posture}, wanted {robot.n} angles within the joint limits"
    wanted, why = task.within(goal.task, robot.axes)
    goal = goal._replace(task=wanted)
    rho = obstacle_table.distance_from(m.world, task.point_of(goal, m.tip.x))
    near = goal._replace(position=task.point_of(goal, robot.base))  # what is free is no further than it need be
    verdict = verdict or why or goals.refusal(near, robot.base, robot.reach, rho, m.world.names)
    if verdict:
        return m._replace(verdict=verdict)
    return free_of_goals(m)._replace(goal=goal, goal_rho=rho, status=Status.MOVING)


def free_of_goals(m: Memory) -> Memory:
    """Return the memory without a goal and what was known of it."""
    return m._replace(
        goal=None, status=Status.NO_GOAL, blocker=-1, holders=0, held=(), still=0, nearest=np.inf, idle=0.0,
        escape=Escape(),
    )  # fmt: skip


def _is_posture(robot: Robot, q: np.ndarray) -> bool:
    return q.shape == (robot.n,) and bool(np.isfinite(q).all() and ((robot.q_min <= q) & (q <= robot.q_max)).all())
