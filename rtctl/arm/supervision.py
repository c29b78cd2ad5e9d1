"""The supervisor's work of one tick: faults in, events out, the state of the session moved by the table."""

import numpy as np

from rtctl.arm import faults, stream, task
from rtctl.arm.escape import Escape
from rtctl.arm.faults import BIT
from rtctl.arm.hot import MEASURED_POSTURE
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.arm.servo_level import ENABLE_TIMEOUT, REST_HOLD, SETTLE, STOP_TIME
from rtctl.control import goals, supervisor
from rtctl.control.supervisor import Asked, Event, Rules, Session, supervisor_step
from rtctl.kernel import reductions
from rtctl.kernel.rotations import quat_of
from rtctl.plain import Json
from rtctl.types import F64, Feedback, Goal, Request, Severity, State, Status, Task, Verb
from rtctl.world import obstacle_table

LEAD_TIME = 0.5  # [s] for which the joints head for a posture unless they are told so again
CLEAR_TIME = 0.1  # [s] for which latched drive faults are cleared after a reset
CLEARING = "drive faults are being cleared now: reset again"
OUTSIDE = "a joint is beyond its limits: move it back by hand, or use recover"
FALLS = "the arm has no brakes and falls without torque: {} first, or disarm --drop lets it fall"
NO_PARK = "the config has no robot.park_rad: where the arm rests without torque"
PARK_TOLERANCE, PARKED = 0.03, 0.1  # [rad] where parking ends; within which the arm counts as parked
HELD = (State.SAFE_STOP, State.STOPPING)
INSIDE = "no joint is beyond its limits, there is nothing to recover from: use arm"
LEVER = 0.05  # [m] of all joints together, below which a weight at the tip cannot be felt
RULES = Rules(faults.TABLE, faults.REFUSES_ARMING, {})


def supervise(robot: Robot, m: Memory, feedback: Feedback, request: Request, present: int) -> Memory:
    """Return the memory after the supervisor's table took this tick's events."""
    parking = m.parking and m.status == Status.MOVING
    undisturbed = request.verb == Verb.NONE and faults.TABLE.stops(m.in_force) < Severity.SS2
    if m.state == State.RUN and undisturbed and (parking or not m.parking):
        return m  # what RUN is left for is asked, or a fault, or it is parked
    if request.verb in (Verb.FLOAT, Verb.HOLD):
        m, request = _guided(robot, m, request.verb), request._replace(verb=Verb.NONE)
    verb, before = request.verb, m.state
    parks = robot.park is not None and m.state == State.RUN and not m.outside
    if verb == Verb.TERM and robot.park_on_exit and parks and not m.leaving and not parked(robot, m):
        return to_park(robot, m)._replace(leaving=True)
    if verb == Verb.PARK and parks:
        m, verb = to_park(robot, m), Verb.NONE
    clearing = verb == Verb.RESET and supervisor.admits(before, verb) and bool(present & BIT["drive_fault"])
    if verb == Verb.ARM and m.outside:
        refusal = OUTSIDE
    elif verb == Verb.RECOVER and not m.outside:
        refusal = INSIDE
    elif verb == Verb.DISARM and robot.brakeless and not parked(robot, m):
        refusal = FALLS.format("give robot.park_rad and park it" if robot.park is None else "park it")
    elif verb == Verb.PARK:
        refusal = NO_PARK if robot.park is None else OUTSIDE if m.outside else f"not possible in state {before.name}"
    else:
        refusal = ""
    asked = Asked(
        m.tick,
        verb,
        present,
        _timed(robot, m, reductions.all_equal(feedback.drive, 1)),
        CLEARING if clearing else "",
        refusal,
        robot.brakeless and not (m.off or m.outside or m.no_position) and reductions.all_equal(feedback.drive, 1),
    )
    step = supervisor_step(RULES, Session(before, m.since, m.reaction, m.in_force, m.leaving), asked)
    m = m._replace(**step.session._asdict(), refusal=step.refusal or m.refusal)
    if clearing:
        m = m._replace(clear_until=m.tick + round(CLEAR_TIME / robot.dt))
    if m.state != before:
        m = _entered(robot, m, before, robot.brakeless and verb != Verb.DROP and not parked(robot, m))
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
    if m.state == State.RUN and m.parking and m.status != Status.MOVING:
        if m.status == Status.ARRIVED:
            return frozenset((Event.DISARM,))
        return frozenset((Event.TERM,) if m.leaving else ())
    if m.state == State.STOPPING and m.sinks:
        return frozenset((Event.RESTED,) if m.off else ())
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


def _entered(robot: Robot, m: Memory, before: State, falls: bool) -> Memory:
    """Return the memory on entering a state: every motion begins from what is measured now.

    falls: without torque the arm would fall, and nobody has said that it may.
    """
    sinks = falls and m.state == State.STOPPING and (before != State.SAFE_STOP or not m.off)
    m = free_of_goals(m)._replace(off=False, onset=m.joints.qd, onset_faults=m.present, sinks=sinks)
    if not (before in HELD and m.state in HELD):
        m = m._replace(own_phase=0, lost=0, no_position=0, no_speed=0)
    if m.state in (State.ARMED, State.RUN):
        m = m._replace(v_ref=np.zeros(3), w_ref=np.zeros(3))
    return held_here(robot, m)


def held_here(robot: Robot, m: Memory) -> Memory:
    """Return the memory with the pose and posture of now as those to hold."""
    return m._replace(hold=hold_at(m.tip.x, m.tip.R, robot.axes), q_rest=m.joints.q)


def hold_at(x: F64, R: F64, axes: Task) -> Goal:
    """Return the goal of staying at x (3,) [m] with orientation R (3, 3), along the axes that the arm can move."""
    return Goal(x.copy(), quat_of(R), axes, 0.0, 0.0)


def parked(robot: Robot, m: Memory) -> bool:
    """Return whether the arm is where it rests without torque."""
    return robot.park is not None and bool((np.abs(m.joints.q - robot.park) < PARKED).all())


def to_park(robot: Robot, m: Memory) -> Memory:
    """Return the memory with the goal of being parked: of the joints, the tip goes where they take it."""
    x, R, nothing = m.tip.x.copy(), quat_of(m.tip.R), Task(0)
    goal = Goal(x, R, nothing, 1.0, PARK_TOLERANCE, posture=robot.park)
    rho = obstacle_table.distance_from(m.world, x)
    m = free_of_goals(m)._replace(goal=goal, goal_rho=rho, status=Status.MOVING, parking=True, floating=False)
    return m._replace(ends=m.ends if robot.park is None else ends_of(robot, robot.park))


def ends_of(robot: Robot, q: F64) -> F64:
    """Return what `Memory.ends` holds of a posture q (n,)."""
    ends: F64 = np.concatenate([robot.body.placed(q, robot.points).ravel(), robot.body.own_distances(q, robot.own)])
    return ends


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
        ends = ends_of(robot, goal.posture)
    seen = _changing(robot, m, goal)
    return free_of_goals(m)._replace(goal=goal, **seen, goal_rho=rho, status=Status.MOVING, floating=False, ends=ends)


def _changing(robot: Robot, m: Memory, goal: Goal) -> Json:
    """Return what is seen of how a stream changes its velocities: fields of the memory, none for its first goal."""
    gap, before = float(m.goal_age), m.goal
    if before is None or before.task != goal.task or not 0.0 < gap <= m.goal_timeout:
        return {}
    seen: Json = {"goal_gap": gap, "goal_lead": m.goal_lead, "goal_turn": m.goal_turn}
    if before.velocity is not None and goal.velocity is not None:
        seen["goal_a"] = stream.changing(before.velocity, goal.velocity, m.goal_a, gap, robot.motion.a_max)
    if before.omega is not None and goal.omega is not None:
        seen["goal_alpha"] = stream.changing(before.omega, goal.omega, m.goal_alpha, gap, robot.motion.alpha_max)
    return seen


def with_advice(robot: Robot, m: Memory, request: Request) -> Memory:
    """Return the memory with the request's advice about the goal; without what cannot be followed: nobody asked for it.

    Progress is counted anew when it is another posture, not when the same one is told again.
    """
    advice, goal = request.advice, m.goal
    if advice is None or goal is None or m.parking or m.state != State.RUN or not _is_posture(robot, advice.posture):
        return m
    known = goal.posture is not None and np.array_equal(goal.posture, advice.posture)
    led = m.tick <= m.lead_until
    m = m._replace(goal=goal._replace(posture=advice.posture), ends=ends_of(robot, advice.posture))
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
        parking=False,
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
