"""What the tip is to do in a tick: the goal, the pose that is held, or the way around what blocks it; and how it goes.

The target is chosen once a tick, here. m, c: as in `sensing`.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.arm.constants import motion_params
from rtctl.arm.escape import Escape, Phase, advance, push_along, way
from rtctl.arm.faults import BRAKES
from rtctl.arm.field import APART
from rtctl.arm.model import Model
from rtctl.arm.osc import MotionParams
from rtctl.arm.progress import GAIN, STILL_SPEED, Progress, arrived, at_rest, stall_timer, take_drift, time_left
from rtctl.arm.stream import aim, has_velocity, stale
from rtctl.arm.task import point_along, selected, task_error
from rtctl.kernel import kernel
from rtctl.kernel.reductions import greater, norm
from rtctl.kernel.rotations import quat_of
from rtctl.types import F64, TOOL_Z, RecordRow, State, Status

START_SPEED_SCALE = 0.1  # fraction of qd_max that joints may have while ARMED, and beyond their limits
START_TIME = 0.5  # [s] about, in which they are given the rest
THINNEST = 0.2  # of the clearance from joint limits: no zone of theirs is thinner
LED = 0.02  # [rad/s] of joints that are led: what is slower is where it is led to
SLOW_REFERENCE = 1e-3  # [m/s, rad/s] below it braking is over

# what the timers ask for
SAME, DIAGNOSE, WORDS = 0, 4, 8  # nothing; a diagnosis; other words, for what blocks the arm is not the same any more

# numbers of the enumerations, as compiled code reads them
_ARMED, _RUN, _STOPPING, _SAFE_STOP = (int(s) for s in (State.ARMED, State.RUN, State.STOPPING, State.SAFE_STOP))
_NONE, _CHOOSING, _FIRST, _OTHER = (int(p) for p in (Phase.NONE, Phase.CHOOSING, Phase.FIRST, Phase.OTHER))
_NO_GOAL, _MOVING, _ARRIVED, _LOCAL_MINIMUM, _ESCAPING, _FLOATING = (
    int(s)
    for s in (
        Status.NO_GOAL,
        Status.MOVING,
        Status.ARRIVED,
        Status.LOCAL_MINIMUM,
        Status.ESCAPING,
        Status.FLOATING,
    )
)


class Target(NamedTuple):
    """What the tip is to reach in this tick: the goal, or the pose that is held."""

    task: int
    position: F64  # (3,) [m]
    wxyz: F64  # (4,)
    axis: F64  # (3,)
    tolerance: float  # [m]
    tolerance_rot: float  # [rad]


@kernel
def target_of(m: RecordRow, goal: bool) -> Target:
    """Return the goal of the memory, or what it holds."""
    if goal:
        return Target(
            m.goal_task, m.goal.copy(), m.goal_wxyz.copy(), m.goal_axis.copy(), m.goal_tolerance, m.goal_tolerance_rot
        )
    return Target(
        m.hold_task, m.hold.copy(), m.hold_wxyz.copy(), m.hold_axis.copy(), m.hold_tolerance, m.hold_tolerance_rot
    )


@kernel
def _braking(m: RecordRow) -> bool:
    return bool(m.state == _STOPPING or m.state == _SAFE_STOP or m.in_force & BRAKES != 0)


@kernel
def pursues(m: RecordRow) -> bool:
    """Return whether the tip is on its way to the goal."""
    return bool(m.has_goal != 0 and m.state == _RUN and m.driven == 0 and not _braking(m))


@kernel
def leads(m: RecordRow) -> bool:
    """Return whether the joints head for the posture of the goal, instead of the tip for the goal."""
    return bool(m.has_posture != 0 and m.tick < m.lead_until and pursues(m))


@kernel
def limit_zones(c: RecordRow, m: RecordRow, n: int) -> F64:
    """Return the zones (n,) [rad] in which joint limits push: no wider than what the goal's posture keeps free of them.

    As for obstacles, see `field.field_to`.
    """
    zone: F64 = c.limit_rho0[:n].copy()
    if m.has_posture != 0 and pursues(m):
        for i in range(n):
            q, goal = m.q[i], m.goal_posture[i]
            low, high = c.q_min[i], c.q_max[i]
            margin = (goal - low if q - low < high - q else high - goal) + APART * abs(q - goal)
            zone[i] = min(zone[i], max(margin, THINNEST * c.limit_rho_min[i]))
    return zone


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
def _hold_here(c: RecordRow, m: RecordRow) -> None:
    n_q = m.q.shape[0]
    m.hold[:], m.hold_wxyz[:] = m.x, quat_of(m.R)
    m.hold_task, m.hold_tolerance, m.hold_tolerance_rot = int(c.axes), 0.0, 0.0
    m.hold_axis[:] = TOOL_Z
    for i in range(n_q):
        m.q_rest[i] = m.q[i]


@kernel
def _escape_of(m: RecordRow) -> Escape:
    return Escape(
        m.escape_phase,
        m.escape_hit,
        m.escape_n.copy(),
        m.escape_b.copy(),
        m.escape_costs.copy(),
        m.escape_ticks,
        m.escape_slow,
    )


@kernel
def _circulates(m: RecordRow) -> bool:
    return bool(m.escape_phase == _FIRST or m.escape_phase == _OTHER)


@kernel
def _escape(c: RecordRow, m: RecordRow, model: Model, chosen: bool, e: F64) -> F64:
    """Advance an escape by a tick, unless its side was `chosen` in it; return the error (3,) [m] of the tip to follow.

    e (3,) [m]: what it is without an escape that circulates.
    """
    axis, tau = m.goal_axis.copy(), m.tau_obstacles[: model.q.shape[0]].copy()
    push = push_along(model, tau, m.goal_task, axis)
    if not chosen:
        to = point_along(m.goal_task, m.goal.copy(), m.x)
        v, _ = selected(m.goal_task, axis, m.R.copy(), m.xd.copy(), m.omega.copy())
        s = advance(_escape_of(m), to - m.x, push, norm(v) < STILL_SPEED, c.dt)
        m.escape_phase, m.escape_ticks, m.escape_slow = s.phase, s.ticks, s.slow
        m.escape_n[:], m.escape_b[:] = s.n, s.b
    if not _circulates(m):
        return e
    return way(m.escape_n.copy(), m.escape_b.copy(), push, motion_params(c))


@kernel
def _ahead(m: RecordRow, p: MotionParams, e: F64, e_rot: F64) -> tuple[F64, F64]:
    """Return the ways e (3,) [m] and e_rot (3,) [rad] ahead of a goal that moves, so that the tip goes with it."""
    R, axis, k = m.R.copy(), m.goal_axis.copy(), p.k_p / p.k_v
    v, w = selected(m.goal_task, axis, R, m.goal_lead.copy(), m.goal_turn.copy())
    if m.goal_task != m.task:
        v, w = selected(m.task, m.axis.copy(), R, v, w)
    return aim(e, v, k, p.v_max, p.a_max), aim(e_rot, w, k, p.w_max, p.alpha_max)


@kernel
def wanted(c: RecordRow, m: RecordRow, model: Model, chosen: bool) -> tuple[F64, F64, F64]:
    """Choose the target; return the errors e (3,) [m] and e_rot (3,) [rad] of the tip, and the posture (n,) [rad].

    Writes the share of their speed that joints may have: an arm that wakes inside a field leaves it slowly.
    """
    n = model.q.shape[0]
    braking, pursuing = _braking(m), pursues(m)
    m.speed_scale = (
        START_SPEED_SCALE if m.state == _ARMED or m.recovering != 0 else min(1.0, m.speed_scale + c.dt / START_TIME)
    )
    slow = braking and greater(_largest_size(m.v_ref), _largest_size(m.w_ref)) < SLOW_REFERENCE
    m.floating = 0 if braking or m.state != _RUN else m.floating
    m.driven = 0 if braking or m.state != _RUN or m.parking != 0 or m.outside != 0 else m.driven
    guided = m.floating != 0 or m.driven != 0
    if guided:
        m.v_ref[:], m.w_ref[:] = m.xd, m.omega  # what follows begins with the speed that the hand or other law gave
    if (braking and not slow) or guided:
        _hold_here(c, m)  # the hold begins where the braking ends
    target, R = target_of(m, pursuing), m.R.copy()
    e, e_rot = np.zeros(3), np.zeros(3)
    if not braking or slow:  # while braking the references only fall to zero
        e, e_rot = task_error(target.task, target.axis, target.position, target.wxyz, m.x.copy(), R)
        if target.task != m.task:  # a goal of this tick: the task space is still that of the one before
            e, e_rot = selected(m.task, m.axis.copy(), R, e, e_rot)
    if not pursuing:
        return e, e_rot, m.q_rest[:n].copy()
    if leads(m):
        return np.zeros(3), np.zeros(3), m.goal_posture[:n].copy()
    if m.escape_phase != _NONE:
        e = _escape(c, m, model, chosen, e)
    elif has_velocity(m):
        e, e_rot = _ahead(m, motion_params(c), e, e_rot)
    return e, e_rot, m.goal_posture[:n].copy() if m.has_posture != 0 else c.q_rest[:n].copy()


@kernel
def _forget_goal(m: RecordRow) -> None:
    m.has_goal, m.goal_task, m.goal_tolerance, m.goal_tolerance_rot, m.has_posture = 0, 0, 0.0, 0.0, 0
    m.parking = 0
    m.goal[:], m.goal_wxyz[:], m.goal_axis[:], m.goal_posture[:], m.lead_until = 0.0, 0.0, 0.0, 0.0, 0
    m.goal_v[:], m.goal_w[:], m.goal_a[:], m.goal_alpha[:] = 0.0, 0.0, 0.0, 0.0
    m.goal_lead[:], m.goal_turn[:] = 0.0, 0.0
    m.goal_age, m.goal_gap, m.goal_timeout = 0.0, 0.0, 0.0
    m.status, m.still, m.nearest, m.stall_timer = _NO_GOAL, 0, np.inf, 0.0
    m.blocker, m.blockers = -1, np.uint64(0)
    _no_escape(m)


@kernel
def _no_escape(m: RecordRow) -> None:
    m.escape_phase, m.escape_hit, m.escape_ticks, m.escape_slow = _NONE, np.inf, 0, 0
    m.escape_n[:], m.escape_b[:], m.escape_costs[:] = 0.0, 0.0, 0.0


@kernel
def _take_status(m: RecordRow, status: int) -> int:
    if m.status == status:
        return SAME
    m.status, m.blocker, m.blockers = status, -1, np.uint64(0)
    return WORDS


@kernel
def _waited(c: RecordRow, m: RecordRow) -> bool:
    """Return whether the arm has been at rest, or got no nearer to its goal, for long enough to ask what holds it."""
    return bool(max(m.still * c.dt, m.stall_timer) >= c.stop_stall - 0.5 * c.dt)


@kernel
def parking_progress(m: RecordRow, n: int) -> Progress:
    """Return how far the joints are from where they are parked, the furthest as an angle [rad], and how fast."""
    away = speed = 0.0
    for i in range(n):
        away, speed = max(away, abs(m.goal_posture[i] - m.q[i])), max(speed, abs(m.qd[i]))
    return Progress(0.0, away, 0.0, speed)


@kernel
def _drags(m: RecordRow) -> bool:
    """Return whether joints that are led do not follow: they have less than GAIN of the speed that is wanted."""
    wanted = along = 0.0
    for i in range(m.lead.shape[0]):
        wanted += m.lead[i] * m.lead[i]
        along += m.lead[i] * m.qd[i]
    return bool(wanted > LED * LED and along < GAIN * wanted)


@kernel
def progress_timers(c: RecordRow, m: RecordRow, target: Target, p: Progress) -> int:
    """Advance the timers of the way to the goal; return DIAGNOSE when it is time to ask what holds the arm."""
    take_drift(m.drift, m.xd, c.dt)
    if m.has_goal == 0 or m.state != _RUN:
        status = _FLOATING if m.floating != 0 else _NO_GOAL
        if m.status == status:
            return SAME
        _forget_goal(m)
        m.status = status
        return WORDS
    if stale(c, m) or has_velocity(m):  # it is held, or follows: where the goal is now is nowhere to come to
        m.still, m.nearest, m.stall_timer = 0, np.inf, 0.0
        _no_escape(m)
        return _take_status(m, _NO_GOAL if stale(c, m) else _MOVING)
    if arrived(p, target.tolerance, target.tolerance_rot):
        m.goal_timeout = 0.0  # its stream has come to its end
        changed = _take_status(m, _ARRIVED)
        _no_escape(m)
        m.still = m.still + 1
        return changed
    if m.driven != 0:  # what holds the arm is then no matter of this law
        m.still, m.nearest, m.stall_timer = 0, np.inf, 0.0
        _no_escape(m)
        return _take_status(m, _MOVING)
    if leads(m):
        before = _waited(c, m)
        m.still, m.nearest, m.stall_timer = 0, np.inf, max(0.0, m.stall_timer + (c.dt if _drags(m) else -2.0 * c.dt))
        if not _waited(c, m):
            return _take_status(m, _MOVING)
        return SAME if before and m.tick % int(c.review_ticks) else DIAGNOSE
    if _circulates(m) or m.escape_phase == _CHOOSING:
        m.status, m.still = _ESCAPING, 0  # held by what it circulates
        return SAME
    if m.parking != 0:
        m.still = m.still + 1 if at_rest(p) else 0
        return _take_status(m, _LOCAL_MINIMUM if m.still * c.dt >= c.stop_stall else _MOVING)
    before = _waited(c, m)
    left = time_left(p, c.motion_v_max, c.motion_w_max)
    going = Progress(p.error, p.error_rot, min(p.speed, norm(m.drift)), p.rate)
    m.stall_timer = stall_timer(m.stall_timer, going, left, m.nearest, c.dt, c.stop_stall)
    m.nearest = min(left, m.nearest)
    m.still = m.still + 1 if at_rest(p) else 0
    if c.escape != 0.0 and m.escape_phase == _NONE and m.still == int(c.escape_ticks):
        return DIAGNOSE
    if not _waited(c, m):
        return _take_status(m, _MOVING)
    return SAME if before and m.tick % int(c.review_ticks) else DIAGNOSE
