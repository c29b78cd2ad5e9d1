"""The servo level: from the feedback to the command and its record, in one compiled call over flat records.

    plausible feedback -> joint filter -> tip filter -> detection -> target -> law -> limiter -> progress -> record

What is rare is left to Python: where it is wanted, the call ends with a flag, and `pipe` goes on with the next stage.
The memory (`memory.HOT`) is copied once and written as the tick goes on; nobody but the caller sees the copy.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from rtctl.arm.detection import BEYOND, STIRS, notice
from rtctl.arm.escape import Escape, Phase, advance, push_along, way
from rtctl.arm.estimator import EstimatorParams, correct_by_pose, correct_by_twist, filter_joints, predict_tip
from rtctl.arm.faults import AUTOMATIC, BRAKES, FAULTS, STOPS, Bounds, Counters, Evidence, counted, detect, jumped
from rtctl.arm.flat import AGE, CLOUDS, GOAL_RHO, RHO, field_in, model_in, obstacles_in, row_of
from rtctl.arm.law import LOAD, _evaluate
from rtctl.arm.limits import command_torque
from rtctl.arm.model import Model
from rtctl.arm.osc import MotionParams
from rtctl.arm.progress import STILL_SPEED, Progress, arrived, at_rest, idle, progress_of, time_left
from rtctl.arm.record import Outcome, pack
from rtctl.arm.task import point_along, selected, task_error
from rtctl.control.faults import latch_with
from rtctl.kernel import kernel
from rtctl.kernel.reductions import all_equal, any_set, largest, norm
from rtctl.kernel.rotations import quat_of
from rtctl.types import B1, F64, I64, TOOL_Z, U8, Cut, Drive, Feedback, Record, Severity, State, Status, Task
from rtctl.world.obstacle_table import distances_from, margins
from rtctl.world.primitives import Obstacles, advanced_pose

# where a call begins
START, MEASURED, DECIDED = 0, 1, 2
# what it asks for: nothing, a model, the supervisor or the side of an escape, a diagnosis
DONE, MODEL, ATTENTION, DIAGNOSE = 0, 1, 2, 4
WORDS = 8  # what holds the arm is not the same any more
MOVED = 16  # the obstacles are elsewhere than they were
# what is asked of it
REQUEST = 1  # an operator's verb or a goal waits
WORLD = 2  # the obstacles are other ones, or elsewhere

START_PACE = 0.1  # fraction of qd_max that joints may have while ARMED, and beyond their limits
START_TIME = 0.5  # [s] about, in which they are given the rest
MISSED_MAX = 10  # slots that estimates coast through; more is a fault
REST_SPEED = 0.03  # [rad/s] a joint slower than this rests (encoders of MIT drives resolve 0.005)
REST_HOLD = 0.1  # [s] at rest before the drives are disabled
SETTLE = 0.2  # [s] of holding torque before RUN: brakes open and the torque builds up at its rate limit
ENABLE_TIMEOUT = 1.0  # [s] for every drive to report enabled
STOP_TIME = 3.0  # [s] STOPPING gives up waiting for rest: something keeps pushing, brakes do the rest
SLOW_REFERENCE = 1e-3  # [m/s, rad/s] below it braking is over

# numbers of the enumerations, as compiled code reads them
_IDLE, _ARMED, _RUN, _STOPPING, _SAFE_STOP, _FAULT = (
    int(s) for s in (State.IDLE, State.ARMED, State.RUN, State.STOPPING, State.SAFE_STOP, State.FAULT)
)
_NONE, _CHOOSING, _FIRST, _OTHER, _GIVEN_UP = (
    int(p) for p in (Phase.NONE, Phase.CHOOSING, Phase.FIRST, Phase.OTHER, Phase.GIVEN_UP)
)
_NO_GOAL, _MOVING, _ARRIVED, _ESCAPING = (
    int(s) for s in (Status.NO_GOAL, Status.MOVING, Status.ARRIVED, Status.ESCAPING)
)
_DISABLE, _ENABLE, _TORQUE, _CLEAR = (int(d) for d in (Drive.DISABLE, Drive.ENABLE, Drive.TORQUE, Drive.CLEAR))
_SS1, _NON_FINITE, _POSITION = int(Severity.SS1), int(Cut.NON_FINITE), int(Task.POSITION)
_FAULTS = len(FAULTS)


class Arm(NamedTuple):
    """What the servo level knows of the robot; see `law.prepared`."""

    constants: Record
    radius: F64  # (m,) [m] of the PSPs
    link: I64  # (m,)
    reals: F64  # work arrays; see `flat.field_in`
    wholes: I64
    mesh: F64  # bodies of the robot's meshes


class Surroundings(NamedTuple):
    """The obstacles as the servo level sees them."""

    obstacles: Obstacles
    moving: B1  # (K,) whether the age of its observation matters
    age: F64  # (K,) [s] since each was observed
    rho: F64  # (K,) [m] from the arm to each, of the previous tick
    goal_rho: F64  # (K,) [m] from the goal to each


class Asked(NamedTuple):
    """What is asked of a call."""

    stage: int  # where it begins: START, MEASURED, DECIDED
    bits: int  # REQUEST | WORLD
    verb: int  # types.Verb, for the record
    creep: float  # [m/s] speed that obstacles may have beside the one that is told
    stale: float  # [s] age at which an observation is too old


class Target(NamedTuple):
    """What the tip is to reach in this tick: the goal, or the pose that is held."""

    task: int
    position: F64  # (3,) [m]
    wxyz: F64  # (4,)
    axis: F64  # (3,)
    tolerance: float  # [m]
    tolerance_rot: float  # [rad]


@kernel
def drives_torque(m: Any) -> bool:
    """Return whether the state wants torque from the drives."""
    if m.state == _SAFE_STOP:
        return bool(m.off == 0)
    return bool(m.state == _ARMED or m.state == _RUN or m.state == _STOPPING)


@kernel
def plausible_feedback(c: Any, m: Any, f: Feedback) -> tuple[Feedback, bool]:
    """Return the feedback with silence in place of positions that no joint can have reached, and whether any is.

    A joint that goes on reporting such positions stays silent: the filter that damps it must not see the jump.
    """
    n = f.q.shape[0]
    q, age, replies, implausible = f.q.copy(), f.age.copy(), f.replies.copy(), False
    if drives_torque(m) and m.state != _ARMED:
        elapsed, before = c.dt * (1 + f.missed), m.age_previous[:n]
        odd = jumped(f.q, f.age, f.replies, m.q_previous[:n], before, c.qd_max[:n], elapsed, c.dt)
        for i in range(n):
            if odd[i]:
                implausible = True
                q[i], age[i], replies[i] = m.q_previous[i], min(before[i] + elapsed, c.safety_lost_periods * c.dt), 0
    return (
        Feedback(f.slot, f.missed, q, f.qd, f.tau, age, replies, f.drive, f.link, f.lateness, f.compute),
        implausible,
    )


@kernel
def _greater(a: float, b: float) -> float:
    """Return the greater; a NaN that comes first stays, so that it is seen."""
    return b if b > a else a


@kernel
def _target(m: Any, goal: bool) -> Target:
    """Return the goal of the memory, or what it holds."""
    if goal:
        return Target(
            m.goal_task, m.goal.copy(), m.goal_wxyz.copy(), m.goal_axis.copy(), m.goal_tolerance, m.goal_tolerance_rot
        )
    return Target(
        m.hold_task, m.hold.copy(), m.hold_wxyz.copy(), m.hold_axis.copy(), m.hold_tolerance, m.hold_tolerance_rot
    )


@kernel
def _estimator(c: Any) -> EstimatorParams:
    return EstimatorParams(
        c.estimator_sigma_a, c.estimator_sigma_alpha, c.estimator_r_v, c.estimator_r_omega, c.estimator_r_x,
        c.estimator_r_rot,
    )  # fmt: skip


@kernel
def _predict(c: Any, m: Any, f: Feedback, model: Model, elapsed: float) -> bool:
    """Advance joints and tip to this slot; return whether the model must be evaluated, or its task space."""
    n = f.q.shape[0]
    qdd = m.qdd[:n].copy()
    q, qd, P, surprise = filter_joints(
        m.q[:n].copy(), m.qd[:n].copy(), m.P[:n].copy(), qdd, f.q, f.qd, f.age, f.replies, elapsed,
        c.joint_sigma_qdd[:n].copy(), c.joint_r_q[:n].copy(), c.joint_r_qd[:n].copy(), c.joint_has_qd != 0.0,
    )  # fmt: skip
    m.q[:n], m.qd[:n], m.P[:n] = q, qd, P
    m.innovation = largest(surprise)
    if c.carry != 0.0:
        m.x[:], m.xd[:], m.P_tip[:], m.R[:], m.omega[:], m.P_rot[:] = predict_tip(
            m.x.copy(), m.xd.copy(), m.P_tip.copy(), m.R.copy(), m.omega.copy(), m.P_rot.copy(),
            model.J, model.Jdqd, qdd, elapsed, _estimator(c),
        )  # fmt: skip
    phase = m.phase + c.dt / c.model_dt
    m.evaluated = 1 if phase > 0.0 else 0
    m.phase = phase - 1.0 if phase > 0.0 else phase
    target = _target(m, m.has_goal != 0)
    changed = target.task != m.task
    for i in range(3):
        changed = changed or target.axis[i] != m.axis[i]
    m.task = target.task
    m.axis[:] = target.axis
    return bool(changed or m.evaluated != 0)


@kernel
def _correct(c: Any, m: Any, model: Model) -> None:
    """Correct the tip by the twist J qd and, where the model was evaluated, by its pose."""
    n = model.q.shape[0]
    twist = np.zeros(6)
    for i in range(6):
        for j in range(n):
            twist[i] += model.J[i, j] * m.qd[j]
    if c.carry == 0.0:
        if m.evaluated != 0:
            m.x[:], m.xd[:], m.R[:], m.omega[:] = model.x, twist[:3], model.R, twist[3:]
        return
    p = _estimator(c)
    x, xd, P, R, omega, P_rot, innovation = correct_by_twist(
        m.x.copy(), m.xd.copy(), m.P_tip.copy(), m.R.copy(), m.omega.copy(), m.P_rot.copy(), twist, p
    )
    innovation = _greater(innovation, m.innovation)
    if m.evaluated != 0:  # evaluated at the state of this slot: its age is zero
        x, xd, P, R, omega, P_rot, other = correct_by_pose(x, xd, P, R, omega, P_rot, model.x, model.R, p)
        innovation = _greater(innovation, other)
    m.x[:], m.xd[:], m.P_tip[:], m.R[:], m.omega[:], m.P_rot[:] = x, xd, P, R, omega, P_rot
    m.innovation = innovation


@kernel
def _detect(c: Any, m: Any, f: Feedback, A: F64, around: Surroundings, implausible: bool) -> None:
    """Write the faults that are present and in force, and what the detectors keep; f: plausible feedback."""
    n = f.q.shape[0]
    powered = drives_torque(m)
    active = powered and m.state != _ARMED
    watch, age, feed_age, seen = notice(
        m.watch[:, :n].copy(), active, f.q, f.qd, f.tau, f.age, f.replies, f.drive, m.sent[:, :n].copy(),
        m.q_previous[:n].copy(), m.age_previous[:n].copy(), m.qdd[:n].copy(), A, around.rho, around.goal_rho,
        around.age, around.moving, c.safety_torque_tolerance[:n].copy(), c.safety_friction[:n].copy(),
        c.safety_velocity_tolerance[:n].copy(), c.safety_limit_tolerance, c.safety_speed_tolerance, REST_SPEED,
        c.q_min[:n].copy(), c.q_max[:n].copy(), c.qd_max[:n].copy(), c.dt * (1 + f.missed), c.dt,
    )  # fmt: skip
    lost = m.cut & _NON_FINITE != 0 or not math.isfinite(m.innovation)
    evidence = Evidence(
        seen, age, feed_age, f.missed, active, powered, implausible, m.pulled != 0, m.recovering != 0, lost,
        m.has_goal != 0, m.innovation,
    )  # fmt: skip
    k = m.counters
    counters = counted(
        f.link, evidence, Counters(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7]), c.safety_innovation_max
    )
    bounds = Bounds(c.safety_stale_periods, c.safety_lost_periods, c.safety_feed_timeout)
    m.present = detect(f.link, evidence, counters, bounds, c.dt)
    for i in range(8):
        k[i] = counters[i]
    m.in_force, m.good[:_FAULTS] = latch_with(m.present, m.in_force, m.good[:_FAULTS].copy(), AUTOMATIC)
    m.q_previous[:n], m.age_previous[:n], m.watch[:, :n] = f.q, f.age, watch
    m.outside = 1 if seen & BEYOND else 0
    m.recovering = m.recovering & m.outside
    m.rest = 0 if seen & STIRS else m.rest + 1


@kernel
def _uneventful(c: Any, m: Any, enabled: bool) -> bool:
    """Return whether nothing moves the supervisor: no fault that stops, and nothing whose time has come."""
    if m.in_force & STOPS or (m.in_force != 0 and (m.state == _SAFE_STOP or m.state == _FAULT)):
        return False
    elapsed = (m.tick - m.since) * c.dt
    if m.state == _ARMED:
        return bool(elapsed < SETTLE if enabled else elapsed < ENABLE_TIMEOUT)
    if m.state == _STOPPING:
        rested = m.rest * c.dt >= REST_HOLD and elapsed >= REST_HOLD
        return bool(not rested and enabled and elapsed < STOP_TIME)
    return True


@kernel
def _braking(m: Any) -> bool:
    return bool(m.state == _STOPPING or m.state == _SAFE_STOP or m.in_force & BRAKES != 0)


@kernel
def pursues(m: Any) -> bool:
    """Return whether the tip is on its way to the goal."""
    return bool(m.has_goal != 0 and m.state == _RUN and not _braking(m))


@kernel
def _largest_size(v: F64) -> float:
    """Return the largest |v_i|; any NaN gives NaN."""
    out = 0.0
    for i in range(v.shape[0]):
        if not abs(v[i]) <= out:
            out = abs(v[i])
        if v[i] != v[i]:
            return math.nan
    return out


@kernel
def _hold_here(c: Any, m: Any) -> None:
    n_q = m.q.shape[0]
    m.hold[:], m.hold_wxyz[:] = m.x, quat_of(m.R)
    m.hold_task, m.hold_tolerance, m.hold_tolerance_rot = int(c.axes), 0.0, 0.0
    m.hold_axis[:] = TOOL_Z
    for i in range(n_q):
        m.q_rest[i] = m.q[i]


@kernel
def _escape_of(m: Any) -> Escape:
    return Escape(
        m.escape_phase, m.escape_hit, m.escape_n.copy(), m.escape_b.copy(), m.escape_costs.copy(), m.escape_ticks,
        m.escape_slow,
    )  # fmt: skip


@kernel
def _escape(c: Any, m: Any, model: Model, tau_obstacles: F64) -> F64:
    """Advance an escape by a tick and return the error (3,) [m] along which it sends the tip, if it does."""
    to = point_along(m.goal_task, m.goal.copy(), m.x)
    v, _ = selected(m.goal_task, m.goal_axis.copy(), m.R.copy(), m.xd.copy(), m.omega.copy())
    push = push_along(model, tau_obstacles, m.goal_task, m.goal_axis.copy())
    s = advance(_escape_of(m), to - m.x, push, norm(v) < STILL_SPEED, c.dt)
    m.escape_phase, m.escape_ticks, m.escape_slow = s.phase, s.ticks, s.slow
    m.escape_n[:], m.escape_b[:] = s.n, s.b
    motion = MotionParams(
        c.motion_k_p, c.motion_k_v, c.motion_v_max, c.motion_a_max, c.motion_w_max, c.motion_alpha_max, c.motion_k_q,
        c.motion_d_q, c.motion_qdd_posture, c.motion_epsilon, c.motion_length, c.motion_speed_margin,
    )  # fmt: skip
    return way(s.n, s.b, push, motion)


@kernel
def _torque_asked(c: Any, m: Any, f: Feedback) -> int:
    """Return what is asked of the drives, types.Drive."""
    if drives_torque(m):
        return _TORQUE if m.state != _ARMED or all_equal(f.drive, 1) else _ENABLE
    if m.tick < m.clear_until:
        for i in range(f.drive.shape[0]):
            if f.drive[i] > 1:
                return _CLEAR
    return _DISABLE


@kernel
def _damped_stop(c: Any, m: Any, f: Feedback, g: F64) -> F64:
    """Return the torque (n,) [Nm] of a damped stop, -D qd + g, and note when it is over."""
    over = (m.tick - m.since) * c.dt >= c.stop_time or m.rest * c.dt >= REST_HOLD
    if over:
        m.off = 1
    keep = np.empty(g.shape[0])
    for i in range(g.shape[0]):  # a velocity that old damps nothing
        fresh = 1.0 if f.age[i] <= c.safety_lost_periods * c.dt else 0.0
        keep[i] = g[i] - c.stop_damping[i] * m.qd[i] * fresh
    return keep


@kernel
def _forget_goal(m: Any) -> None:
    m.has_goal, m.goal_task, m.goal_tolerance, m.goal_tolerance_rot, m.has_posture = 0, 0, 0.0, 0.0, 0
    m.goal[:], m.goal_wxyz[:], m.goal_axis[:], m.goal_posture[:] = 0.0, 0.0, 0.0, 0.0
    m.status, m.still, m.nearest, m.idle = _NO_GOAL, 0, np.inf, 0.0
    m.blocker, m.holders = -1, np.uint64(0)
    _no_escape(m)


@kernel
def _no_escape(m: Any) -> None:
    m.escape_phase, m.escape_hit, m.escape_ticks, m.escape_slow = _NONE, np.inf, 0, 0
    m.escape_n[:], m.escape_b[:], m.escape_costs[:] = 0.0, 0.0, 0.0


@kernel
def _take_status(m: Any, status: int) -> int:
    if m.status == status:
        return DONE
    m.status, m.blocker, m.holders = status, -1, np.uint64(0)
    return WORDS


@kernel
def waited(c: Any, m: Any) -> bool:
    """Return whether the arm has been at rest, or got no nearer to its goal, for long enough to ask what holds it."""
    return bool(max(m.still * c.dt, m.idle) >= c.stop_stall - 0.5 * c.dt)


@kernel
def _competence(c: Any, m: Any, target: Target, p: Progress) -> int:
    """Advance the timers of the way to the goal; return DIAGNOSE when it is time to ask what holds the arm."""
    if m.has_goal == 0 or m.state != _RUN:
        if m.status == _NO_GOAL:
            return DONE
        _forget_goal(m)
        return WORDS
    if arrived(p, target.tolerance, target.tolerance_rot):
        changed = _take_status(m, _ARRIVED)
        _no_escape(m)
        m.still = m.still + 1
        return changed
    if m.escape_phase == _FIRST or m.escape_phase == _OTHER or m.escape_phase == _CHOOSING:
        m.status, m.still = _ESCAPING, 0  # held by what it circulates
        return DONE
    before = waited(c, m)
    left = time_left(p, c.motion_v_max, c.motion_w_max)
    m.idle = idle(m.idle, p, left, m.nearest, c.dt, c.stop_stall)
    m.nearest = min(left, m.nearest)
    m.still = m.still + 1 if at_rest(p) else 0
    if c.escape != 0.0 and m.escape_phase == _NONE and m.still == int(c.escape_ticks):
        return DIAGNOSE
    if not waited(c, m):
        return _take_status(m, _MOVING)
    return DONE if before and m.tick % int(c.review_ticks) else DIAGNOSE


@kernel
def _move(around: Surroundings, asked: Asked, dt: float) -> None:
    """Move the obstacles of the table on by dt [s], their observations grow older."""
    o = around.obstacles
    o.p[:], o.R[:] = advanced_pose(o.active, o.p, o.R, o.v, o.w, dt)
    for k in range(around.age.shape[0]):
        if around.moving[k]:
            around.age[k] += dt
    o.margin[:] = margins(o.margin, around.age, around.moving, asked.creep, asked.stale, dt)


@kernel
def servo(
    arm: Arm, before: Record, parameters: F64, table_before: F64, shapes: F64, clouds: CLOUDS, feedback: Feedback,
    asked: Asked,
) -> tuple[Record, F64, U8, int]:  # fmt: skip
    """Run the servo level of one tick from `asked.stage` on, or until Python is needed.

    parameters, table_before, shapes, clouds: see `flat`. Returns the memory, the table, the bytes of the tick's record,
    and flags: DONE | WORDS when it is over; MODEL: evaluate the model at the joints of the memory where its `evaluated`
    says so, and the task space, then go on at MEASURED; ATTENTION: supervise, then go on at DECIDED; DIAGNOSE: the tick
    is over but for what holds the arm. MOVED: the obstacles are elsewhere than they were.
    """
    memory, table, c, n = before.copy(), table_before.copy(), arm.constants[0], feedback.q.shape[0]
    m = memory[0]
    model, space = model_in(parameters, n, arm.radius.shape[0])
    obstacles, moving = obstacles_in(table, shapes, arm.mesh, clouds)
    around = Surroundings(obstacles, moving, row_of(table, AGE), row_of(table, RHO), row_of(table, GOAL_RHO))
    elapsed = c.dt * (1 + min(feedback.missed, MISSED_MAX))
    moved = 0
    if asked.stage != DECIDED:
        f, implausible = plausible_feedback(c, m, feedback)
        if asked.stage == START:
            m.tick = m.tick + 1
            if asked.bits & WORLD == 0 and any_set(moving):
                _move(around, asked, elapsed)
                moved = MOVED
            if _predict(c, m, f, model, elapsed):
                return memory, table, np.empty(0, np.uint8), MODEL | moved
        _correct(c, m, model)
        if m.has_goal != 0 and (moved or asked.bits & WORLD or m.goal_task & _POSITION != _POSITION):
            around.goal_rho[:] = distances_from(obstacles, point_along(m.goal_task, m.goal.copy(), m.x))
        _detect(c, m, f, model.A, around, implausible)
        if asked.bits & REQUEST or not _uneventful(c, m, all_equal(f.drive, 1)):
            return memory, table, np.empty(0, np.uint8), ATTENTION | moved
        if m.state == _IDLE or m.state == _FAULT or (m.state == _SAFE_STOP and m.off != 0):
            m.done = m.leaving
        elif m.state != _RUN:
            m.done = 0
        if pursues(m) and m.escape_phase == _CHOOSING:
            return memory, table, np.empty(0, np.uint8), ATTENTION | moved
    braking, pursuing = _braking(m), pursues(m)
    m.pace = START_PACE if m.state == _ARMED or m.recovering != 0 else min(1.0, m.pace + c.dt / START_TIME)
    slow = braking and _greater(_largest_size(m.v_ref), _largest_size(m.w_ref)) < SLOW_REFERENCE
    if braking and not slow:
        _hold_here(c, m)  # the hold begins where the braking ends
    x, R, xd, omega = m.x.copy(), m.R.copy(), m.xd.copy(), m.omega.copy()
    target = _target(m, pursuing)
    e, e_rot = np.zeros(3), np.zeros(3)
    if not braking or slow:  # while braking the references only fall to zero
        e, e_rot = task_error(target.task, target.axis, target.position, target.wxyz, x, R)
        if target.task != m.task:  # a goal of this tick: `space` is still that of the one before
            e, e_rot = selected(m.task, m.axis.copy(), R, e, e_rot)
    if pursuing and m.escape_phase != _NONE:
        along = _escape(c, m, model, m.tau_obstacles[:n].copy()) if asked.stage != DECIDED else _escape_on(c, m, model)
        if m.escape_phase == _FIRST or m.escape_phase == _OTHER:
            e = along
    q, qd = m.q[:n].copy(), m.qd[:n].copy()
    q_rest = m.q_rest[:n].copy()
    if pursuing:
        q_rest = m.goal_posture[:n].copy() if m.has_posture != 0 else c.q_rest[:n].copy()
    at = model
    if c.carry == 0.0:  # the points have not moved either
        at = Model(
            q, model.qd, model.A, model.A_inv, model.h, model.g, model.x, model.R, model.J, model.Jdqd, model.P,
            model.Jp, model.B, model.Lambda_inv, model.own_rho, model.own_row,
        )  # fmt: skip
    field = field_in(arm.reals, arm.wholes, n, arm.radius.shape[0])
    task, torques, seen, nearest, _, law_cut = _evaluate(
        arm.constants, arm.radius, arm.link, field, at, space, obstacles, q, qd, xd, omega, e, e_rot,
        m.v_ref.copy(), m.w_ref.copy(), q_rest, m.pace,
    )  # fmt: skip
    slots = nearest.shape[0]
    around.rho[:] = seen[:slots] + obstacles.margin  # where it is, not where it might be: no contact by growing old
    m.v_ref[:], m.w_ref[:], m.tau_obstacles[:n] = task[6:9], task[9:], torques[1]
    drive, keep = torques[5].copy(), torques[6].copy()
    if m.state == _SAFE_STOP and m.reaction >= _SS1:  # damp -D qd + g, then torque off
        drive, keep = np.zeros(n), _damped_stop(c, m, feedback, model.g)
    command = _torque_asked(c, m, feedback)
    rows, cut, _, pulled = command_torque(
        drive, keep, qd, m.sent[:, :n].copy(), feedback.tau, feedback.age, c.tau_max[:n].copy(), c.tau_rate[:n].copy(),
        c.tau_lsb[:n].copy(), c.stop_damping[:n].copy(), model.A_inv, model.h, model.g, c.viscous[:n].copy(), c.dt,
        command == _TORQUE, command == _TORQUE and m.state != _ARMED,
    )  # fmt: skip
    m.sent[:, :n], m.qdd[:n], m.cut, m.pulled = rows[1:5], rows[5], cut | law_cut, 1 if pulled else 0
    pursued = _target(m, m.has_goal != 0 and m.state == _RUN)
    p = progress_of(pursued.task, pursued.axis, pursued.position, pursued.wxyz, x, R, xd, omega)
    shown = _target(m, m.has_goal != 0)
    flags = _competence(c, m, shown, p)
    shown = _target(m, m.has_goal != 0)
    raw = pack(
        m, feedback, Outcome(asked.verb, command, shown.position, shown.wxyz, shown.axis, shown.task, rows[0]),
        (p.error, p.error_rot, space.sigma_min), task[:6], torques[: LOAD + 1], seen, nearest, c.dt,
    )  # fmt: skip
    return memory, table, raw, flags | moved


@kernel
def _escape_on(c: Any, m: Any, model: Model) -> F64:
    """Return the error (3,) [m] along which an escape that Python has advanced sends the tip."""
    n = model.q.shape[0]
    motion = MotionParams(
        c.motion_k_p, c.motion_k_v, c.motion_v_max, c.motion_a_max, c.motion_w_max, c.motion_alpha_max, c.motion_k_q,
        c.motion_d_q, c.motion_qdd_posture, c.motion_epsilon, c.motion_length, c.motion_speed_margin,
    )  # fmt: skip
    push = push_along(model, m.tau_obstacles[:n].copy(), m.goal_task, m.goal_axis.copy())
    return way(m.escape_n.copy(), m.escape_b.copy(), push, motion)
