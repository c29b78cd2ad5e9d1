"""The supervisor's work of one tick: faults in, events out, the state of the session moved by the table."""

import numpy as np

from rtctl.arm import faults, task
from rtctl.arm.escape import Escape
from rtctl.arm.faults import BIT
from rtctl.arm.memory import MEASURED_POSTURE, Memory
from rtctl.arm.robot import Robot
from rtctl.arm.servo_level import ENABLE_TIMEOUT, REST_HOLD, SETTLE, STOP_TIME
from rtctl.control import goals, supervisor
from rtctl.control.supervisor import Asked, Event, Rules, Session, supervisor_step
from rtctl.kernel import reductions
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, Feedback, Goal, Request, Severity, State, Status, Task, Verb
from rtctl.world import obstacle_table

LEAD_TIME = 0.5  # [s] for which the joints head for a posture unless they are told so again
CLEAR_TIME = 0.1  # [s] for which latched drive faults are cleared after a reset
CLEARING = "drive faults are being cleared now: reset again"
OUTSIDE = "a joint is beyond its limits: move it back by hand, or use recover"
INSIDE = "no joint is beyond its limits, there is nothing to recover from: use arm"
LEVER = 0.05  # [m] of all joints together, below which a weight at the tip cannot be felt
RULES = Rules(faults.TABLE, faults.REFUSES_ARMING, {})


def supervise(robot: Robot, m: Memory, feedback: Feedback, request: Request, present: int) -> Memory:
    """Return the memory after the supervisor's table took this tick's events."""
    if m.state == State.RUN and request.verb == Verb.NONE and faults.TABLE.stops(m.in_force) < Severity.SS2:
        return m  # what RUN is left for is asked, or a fault
    if request.verb in (Verb.FLOAT, Verb.HOLD):
        m, request = _guided(robot, m, request.verb), request._replace(verb=Verb.NONE)
    verb, before = request.verb, m.state
    clearing = verb == Verb.RESET and supervisor.admits(before, verb) and bool(present & BIT["drive_fault"])
    if verb == Verb.ARM and m.outside:
        refusal = OUTSIDE
    elif verb == Verb.RECOVER and not m.outside:
        refusal = INSIDE
    else:
        refusal = ""
    asked = Asked(
        m.tick,
        verb,
        present,
        _timed(robot, m, reductions.all_equal(feedback.drive, 1)),
        CLEARING if clearing else "",
        refusal,
    )
    step = supervisor_step(RULES, Session(before, m.since, m.reaction, m.in_force, m.leaving), asked)
    m = m._replace(**step.session._asdict(), refusal=step.refusal or m.refusal)
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


def _guided(robot: Robot, m: Memory, verb: Verb) -> Memory:
    """Return the memory of an arm that a hand may move from now on, or that holds itself where it is."""
    refusal = f"not possible in state {m.state.name}" if m.state != State.RUN else ""
    if verb == Verb.FLOAT and not refusal and m.outside:
        refusal = "a joint is still beyond its limits"
    if refusal:
        return m._replace(refusal=f"{verb.name.lower()}: {refusal}")
    m = held_here(robot, free_of_goals(m))
    if verb == Verb.HOLD:
        return m._replace(floating=False)
    # of what lasts, the weight at the tip goes with it; without `noticed` the hand would surprise the filters
    up, lasting = m.model.J[2], m.lasting if m.noticed else np.zeros(robot.n)
    size = float(up @ up)
    weight = float(up @ lasting) / size if size > LEVER**2 else 0.0
    return m._replace(
        floating=True, noticed=True, lasting=lasting, float_weight=weight, float_rest=lasting - weight * up
    )


def _entered(robot: Robot, m: Memory) -> Memory:
    """Return the memory on entering a state: every motion begins from what is measured now."""
    m = free_of_goals(m)._replace(off=False, onset=m.joints.qd, onset_faults=m.present)
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
    refusal = ""
    if m.state != State.RUN:
        refusal = f"goal: not possible in state {m.state.name}"
    elif m.outside:
        refusal = "goal: a joint is still beyond its limits"
    ends = m.ends
    if goal.posture is not None and not _is_posture(robot, goal.posture):
        refusal = refusal or f"goal: got posture {goal.posture}, wanted {robot.n} angles within the joint limits"
    wanted, why = task.within(goal.task, robot.axes)
    goal = goal._replace(task=wanted)
    rho = obstacle_table.distance_from(m.world, task.point_of(goal, m.tip.x))
    near = goal._replace(position=task.point_of(goal, robot.base))  # what is free is no further than it need be
    refusal = refusal or why or goals.refusal(near, robot.base, robot.reach, rho, m.world.names)
    if refusal:
        return m._replace(refusal=refusal)
    if goal.posture is not None:
        ends = robot.body.placed(goal.posture, robot.points)
    return free_of_goals(m)._replace(goal=goal, goal_rho=rho, status=Status.MOVING, floating=False, ends=ends)


def with_advice(robot: Robot, m: Memory, request: Request) -> Memory:
    """Return the memory with the request's advice about the goal; without what cannot be followed: nobody asked for it.

    Progress is counted anew when it is another posture, not when the same one is told again.
    """
    advice, goal = request.advice, m.goal
    if advice is None or goal is None or m.state != State.RUN or not _is_posture(robot, advice.posture):
        return m
    known = goal.posture is not None and np.array_equal(goal.posture, advice.posture)
    led = m.tick <= m.lead_until
    m = m._replace(goal=goal._replace(posture=advice.posture), ends=robot.body.placed(advice.posture, robot.points))
    if advice.clear:
        m = m._replace(has_posture=MEASURED_POSTURE)
    if advice.leads:
        m = m._replace(lead_until=m.tick + round(LEAD_TIME / robot.dt), escape=Escape())
        return m if led else m._replace(lead=m.joints.qd)
    return m if known else m._replace(still=0, nearest=np.inf, stall_timer=0.0, escape=Escape())


def free_of_goals(m: Memory) -> Memory:
    """Return the memory without a goal and what was known of it."""
    return m._replace(
        goal=None,
        status=Status.NO_GOAL,
        blocker=-1,
        blockers=0,
        blocked_by=(),
        still=0,
        nearest=np.inf,
        stall_timer=0.0,
        escape=Escape(),
    )


def _is_posture(robot: Robot, q: np.ndarray) -> bool:
    return q.shape == (robot.n,) and bool(np.isfinite(q).all() and ((robot.q_min <= q) & (q <= robot.q_max)).all())
