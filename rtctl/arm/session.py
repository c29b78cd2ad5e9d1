"""The supervisor's work of one tick: faults in, events out, the state of the session moved by the table."""

import numpy as np

from rtctl.arm import faults, task
from rtctl.arm.escape import Escape
from rtctl.arm.faults import BIT
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.arm.servo_level import ENABLE_TIMEOUT, REST_HOLD, SETTLE, STOP_TIME
from rtctl.control import goals, supervisor
from rtctl.control.supervisor import EVENT_FOR, EVENT_OF, Event
from rtctl.kernel import reductions
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, Feedback, Goal, Request, Severity, State, Status, Task, Verb
from rtctl.world import obstacle_table

CLEAR_TIME = 0.1  # [s] for which latched drive faults are cleared after a reset


def supervised(robot: Robot, m: Memory, feedback: Feedback, request: Request, present: int) -> Memory:
    """Return the memory after the supervisor's table took this tick's events."""
    worst = faults.stops(m.in_force)
    if m.state == State.RUN and request.verb == Verb.NONE and worst < Severity.SS2:
        return m  # what RUN is left for is asked, or a fault
    m, events = _asked(robot, m, request, present)
    worst = faults.stops(m.in_force)
    if worst >= Severity.SS2:
        events.add(EVENT_FOR[worst])
    events |= _timed(robot, m, reductions.all_equal(feedback.drive, 1))
    state, event = supervisor.next_state(m.state, events)
    if state in (State.SAFE_STOP, State.FAULT):
        m = m._replace(reaction=max(m.reaction, worst, Severity.SS2 if event == Event.STOP else Severity.NONE))
    if state != m.state:
        m = _entered(robot, m, state)
    if event == Event.ARM:
        m = m._replace(recovering=m.outside)
    at_rest = m.state in (State.IDLE, State.FAULT) or (m.state == State.SAFE_STOP and m.off)
    return m._replace(done=m.leaving and at_rest)


def _asked(robot: Robot, m: Memory, request: Request, present: int) -> tuple[Memory, set[Event]]:
    """Return the event of the operator's verb, or the memory with the reason why there is none."""
    verb = request.verb
    if verb == Verb.NONE:
        return m, set()
    if verb == Verb.TERM:  # the second one does not wait for rest
        return m._replace(leaving=True), {Event.STO if m.leaving else Event.TERM}
    verdict = ""
    if (m.state, EVENT_OF[verb]) not in supervisor.TABLE:
        verdict = f"not possible in state {m.state.name}"
    elif verb in (Verb.ARM, Verb.RECOVER):
        verdict = _held_by(m.in_force & faults.REFUSES_ARMING)
        if not verdict and m.outside and verb == Verb.ARM:
            verdict = "a joint is beyond its limits: move it back by hand, or use recover"
    elif verb == Verb.RESET:
        m = m._replace(in_force=faults.cleared(m.in_force, present))
        verdict = _held_by(m.in_force & ~_automatic())
        if present & BIT["drive_fault"]:
            m = m._replace(clear_until=m.tick + round(CLEAR_TIME / robot.dt))
            verdict = "drive faults are being cleared now: reset again"
    if verdict:
        return m._replace(verdict=f"{verb.name.lower()}: {verdict}"), set()
    return m, {EVENT_OF[verb]}


def _automatic() -> int:
    return sum(1 << i for i, fault in enumerate(faults.FAULTS) if fault.clear == "A")


def _held_by(bits: int) -> str:
    """Return what the faults in `bits` say, '' for none."""
    return "; ".join(f"{name} ({faults.FAULTS[faults.INDEX[name]].text})" for name in faults.names(bits))


def _timed(robot: Robot, m: Memory, enabled: bool) -> set[Event]:
    """Return the events that come of waiting."""
    elapsed = (m.tick - m.since) * robot.dt
    if m.state == State.ARMED:
        if enabled and elapsed >= SETTLE:
            return {Event.SETTLED}
        return {Event.TIMEOUT} if not enabled and elapsed >= ENABLE_TIMEOUT else set()
    if m.state == State.STOPPING:
        at_rest = m.rest * robot.dt >= REST_HOLD and elapsed >= REST_HOLD
        return {Event.RESTED} if at_rest or not enabled or elapsed >= STOP_TIME else set()
    return set()


def _entered(robot: Robot, m: Memory, state: State) -> Memory:
    """Return the memory on entering a state: every motion begins from what is measured now."""
    m = free_of_goals(m)._replace(state=state, since=m.tick, off=False)
    if state in (State.ARMED, State.RUN):
        m = m._replace(v_ref=np.zeros(3), w_ref=np.zeros(3))
    if state not in (State.SAFE_STOP, State.FAULT):
        m = m._replace(reaction=Severity.NONE)
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
