"""The servo level: from the feedback to the command and its record, in one compiled call over flat records.

    sensing -> (supervisor, when something happened) -> target -> law -> limiter -> progress -> record

What is rare is left to Python: where it is wanted, the call ends with a flag, and `pipe` goes on with the next stage.
The memory (`hot.HOT`) is copied once and written as the tick goes on; nobody but the caller sees the copy.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.escape import Phase
from rtctl.arm.faults import ASTRAY, DISTRUST, STOPS
from rtctl.arm.field import APART, APART_LED, Ends
from rtctl.arm.flat import AGE, BODIES, GOAL_RHO, RHO, field_in, model_in, obstacles_in, row_of
from rtctl.arm.hot import HOT, MEASURED_POSTURE
from rtctl.arm.joint_field import LEAST_REACH
from rtctl.arm.law import law
from rtctl.arm.limits import TorqueBounds, TorqueParts, command_torque
from rtctl.arm.loads import known_friction, loaded, observe, pushed
from rtctl.arm.model import Model, acceleration
from rtctl.arm.osc import OperationalSpace, Twist
from rtctl.arm.own_drive import let_drive
from rtctl.arm.own_loop import given, holds_itself, own_loop
from rtctl.arm.progress import progress_of
from rtctl.arm.record import Outcome, pack
from rtctl.arm.robot import Arm
from rtctl.arm.sensing import Surroundings, correct, detect_faults, drives_torque, plausible_feedback, predict
from rtctl.arm.stream import go_on, has_velocity
from rtctl.arm.target import leads, limit_zones, parking_progress, progress_timers, pursues, target_of, wanted
from rtctl.arm.task import point_along
from rtctl.arm.terms import DRIVE, KEEP, LOAD, OBSTACLES, Ahead, Cover, Motion, WorkMemory, outputs
from rtctl.kernel import kernel
from rtctl.kernel.reductions import all_equal, any_set
from rtctl.types import F64, U32, Drive, Feedback, RecordRow, Severity, State, Status, Task
from rtctl.world.obstacle_table import distances_from, margins
from rtctl.world.primitives import Obstacles, advanced_pose, distances_into
from rtctl.world.rooms import widest

# where a call begins
START, MEASURED, DECIDED = 0, 1, 2
# what it asks for: nothing, a model, or the supervisor or the side of an escape; besides what `target` asks for
DONE, MODEL, ATTENTION = 0, 1, 2
MOVED = 16  # the obstacles are elsewhere than they were
# what is asked of it
REQUEST = 1  # an operator's verb or a goal waits
WORLD = 2  # the obstacles are other ones, or elsewhere
CHOSEN = 4  # Python looked for the side of an escape

MISSED_MAX = 10  # slots that estimates coast through; more is a fault
REST_HOLD = 0.1  # [s] at rest before the drives are disabled
SETTLE = 0.2  # [s] of holding torque before RUN: brakes open and the torque builds up at its rate limit
ENABLE_TIMEOUT = 1.0  # [s] for every drive to report enabled
FADE = 0.004  # [s] in which the torque of a stop without true measurements goes: a deaf drive gives its last on
FASTER = 0.2  # [rad/s] above its speed at the onset of a stop: the joint is driven, not damped; brakes take their time
THINNEST = 1e-3  # [m] no influence is less
BESIDE = 0.03  # [m] from where points are in such a posture, within which no influence is wider than there
STOP_TIME = 3.0  # [s] STOPPING gives up waiting for rest: something keeps pushing, brakes do the rest

# numbers of the enumerations, as compiled code reads them
_IDLE, _ARMED, _RUN, _STOPPING, _SAFE_STOP, _FAULT = (
    int(s) for s in (State.IDLE, State.ARMED, State.RUN, State.STOPPING, State.SAFE_STOP, State.FAULT)
)
_DISABLE, _ENABLE, _TORQUE, _CLEAR, _HOLD = (
    int(d) for d in (Drive.DISABLE, Drive.ENABLE, Drive.TORQUE, Drive.CLEAR, Drive.HOLD)
)
_SS1, _POSITION, _CHOOSING = int(Severity.SS1), int(Task.POSITION), int(Phase.CHOOSING)
_MOVING = int(Status.MOVING)


class Asked(NamedTuple):
    """What is asked of a call; it crosses as one number, see `asking`."""

    stage: int  # where it begins: START, MEASURED, DECIDED
    bits: int  # REQUEST | WORLD | CHOSEN
    verb: int  # types.Verb, for the record


def asking(stage: int, bits: int, verb: int) -> int:
    """Return the number that stands for an Asked."""
    return stage | bits << 2 | verb << 8


@kernel
def _uneventful(c: RecordRow, m: RecordRow, enabled: bool) -> bool:
    """Return whether nothing moves the supervisor: no fault that stops, and nothing whose time has come."""
    if m.in_force & STOPS or (m.in_force != 0 and (m.state == _SAFE_STOP or m.state == _FAULT)):
        return False
    if m.state == _RUN and m.parking != 0 and m.status != _MOVING:
        return False
    elapsed = (m.tick - m.since) * c.dt
    if m.state == _ARMED:
        return bool(elapsed < SETTLE if enabled else elapsed < ENABLE_TIMEOUT)
    if m.state == _STOPPING and m.sinks != 0:
        return bool(m.off == 0)
    if m.state == _STOPPING:
        rested = m.rest * c.dt >= REST_HOLD and elapsed >= REST_HOLD
        return bool(not rested and enabled and elapsed < STOP_TIME)
    return True


@kernel
def _torque_asked(c: RecordRow, m: RecordRow, f: Feedback) -> int:
    """Return what is asked of the drives, types.Drive."""
    if drives_torque(m):
        return _TORQUE if m.state != _ARMED or all_equal(f.drive, 1) else _ENABLE
    if m.tick < m.clear_until:
        for i in range(f.drive.shape[0]):
            if f.drive[i] > 1:
                return _CLEAR
    return _DISABLE


@kernel
def _astray(c: RecordRow, m: RecordRow, n: int) -> bool:
    """Return whether an arm that is stopping is faster than when it began to, or something new went wrong with it."""
    if m.present & ASTRAY & ~m.onset_faults:
        return True
    for i in range(n):
        if abs(m.qd[i]) > abs(m.onset[i]) + FASTER:
            return True
    return False


@kernel
def _stop_torque(c: RecordRow, m: RecordRow, f: Feedback, A: F64, g: F64) -> F64:
    """Return the torque (n,) [Nm] of a stop, and note when it is over.

    Where the measurements are true it is damped: -(D + decay A) qd + g. By A every motion decays at that rate at least,
    in any posture: D alone damps the joints one by one, and those of a stretched arm go on together for several times
    as long. By D motions with little inertia are braked, too: A alone leaves them to what is not known of the load.
    Where a measurement lies, either and the g of the next posture drive the arm away: then g fades within FADE, and the
    brakes have it.
    """
    since = (m.tick - m.since) * c.dt
    distrust = m.in_force & DISTRUST != 0
    if since >= (FADE if distrust else c.stop_time) or m.rest * c.dt >= REST_HOLD or _astray(c, m, g.shape[0]):
        m.off = 1
    keep = g.copy()
    if distrust:
        keep *= max(1.0 - since / FADE, 0.0)
        return keep
    for k in range(g.shape[0]):
        if f.age[k] <= c.safety_lost_periods * c.dt:  # a velocity that old damps nothing
            keep[k] -= c.stop_damping[k] * m.qd[k]
            for i in range(g.shape[0]):
                keep[i] -= c.stop_decay * A[i, k] * m.qd[k]
    return keep


@kernel
def _move(around: Surroundings, dt: float) -> None:
    """Move the obstacles of the table on by dt [s], their observations grow older."""
    o = around.obstacles
    o.p[:], o.R[:] = advanced_pose(o.active, o.p, o.R, o.v, o.w, dt)
    for k in range(around.age.shape[0]):
        if around.moving[k]:
            around.age[k] += dt
    o.margin[:] = margins(o.margin, around.age, around.moving, around.creep, around.stale, dt)


@kernel
def _sense(c: RecordRow, m: RecordRow, f: Feedback, model: Model, Jbar: F64, around: Surroundings, asked: Asked) -> int:
    """Run the first half of a tick; return what Python must do before the other, and whether the obstacles moved."""
    plausible, implausible = plausible_feedback(c, m, f)
    moved, elapsed = DONE, c.dt * (1 + min(f.missed, MISSED_MAX))
    if asked.stage == START:
        m.tick = m.tick + 1
        if asked.bits & WORLD == 0 and any_set(around.moving):
            _move(around, elapsed)
            moved = MOVED
        go_on(c, m, elapsed)
        if predict(c, m, plausible, model, elapsed):
            return MODEL | moved
    correct(c, m, model)
    observe(c, m, plausible, model, Jbar, elapsed)
    free = m.goal_task & _POSITION != _POSITION
    if m.has_goal != 0 and (moved or asked.bits & WORLD or free or has_velocity(m)):
        around.goal_rho[:] = distances_from(around.obstacles, point_along(m.goal_task, m.goal.copy(), m.x))
    detect_faults(c, m, plausible, model, around, implausible)
    if asked.bits & REQUEST or not _uneventful(c, m, all_equal(f.drive, 1)):
        return ATTENTION | moved
    if m.state == _IDLE or m.state == _FAULT or (m.state == _SAFE_STOP and m.off != 0):
        m.done = m.leaving
    elif m.state != _RUN:
        m.done = 0
    return ATTENTION | moved if pursues(m) and m.escape_phase == _CHOOSING else moved


@kernel
def held(c: RecordRow, m: RecordRow, f: Feedback, model: Model, Jbar: F64, around: Surroundings) -> tuple[int, F64]:
    """Have the drives hold or lower the arm by their own loops; return types.Drive and the torque (n,) they give."""
    n, noticed = f.q.shape[0], m.noticed != 0
    own_loop(c, m, f, model, around, model.g - m.lasting[:n] if noticed else model.g)
    tau = given(c, m, n) if m.off == 0 else np.zeros(n)
    m.sent[1:, :n], m.sent[0, :n] = m.sent[:3, :n].copy(), tau
    m.qdd[:n], m.slew_follows_echo = 0.0, 0
    if m.off != 0:
        return _DISABLE, tau
    g = model.g - m.external[:n] if noticed else model.g
    g = g + known_friction(c, m, model, Jbar)
    m.qdd[:n] = acceleration(model.A_inv, tau, model.h, g, c.viscous[:n].copy(), m.qd[:n].copy())
    return _HOLD, tau


@kernel
def limited(c: RecordRow, m: RecordRow, f: Feedback, model: Model, Jbar: F64, torques: F64) -> tuple[int, F64]:
    """Turn the torques of the law into what the drives are asked for; return types.Drive and what was wanted (n,)."""
    n, noticed = f.q.shape[0], m.noticed != 0
    drive, keep = torques[DRIVE].copy(), torques[KEEP].copy()
    if m.state == _SAFE_STOP and m.reaction >= _SS1:  # damp or fade, then torque off
        drive, keep = np.zeros(n), _stop_torque(c, m, f, model.A, model.g - m.lasting[:n] if noticed else model.g)
    command, qd = _torque_asked(c, m, f), m.qd[:n].copy()
    bounds = TorqueBounds(c.tau_max[:n].copy(), c.tau_rate[:n].copy(), c.tau_lsb[:n].copy(), c.stop_damping[:n].copy())
    within, follows = command_torque(TorqueParts(drive, keep), qd, m.sent[:, :n].copy(), f, bounds, c.dt)
    tau = within.tau if command == _TORQUE else np.zeros(n)
    m.sent[1:, :n], m.sent[0, :n] = m.sent[:3, :n].copy(), tau
    m.qdd[:n] = 0.0
    if command == _TORQUE and m.state != _ARMED:  # in ARMED brakes may still hold the arm
        viscous, g = c.viscous[:n].copy(), model.g - m.external[:n] if noticed else model.g
        m.qdd[:n] = acceleration(model.A_inv, tau, model.h, g + known_friction(c, m, model, Jbar), viscous, qd)
    m.limit_flags, m.slew_follows_echo = within.flags | m.limit_flags, 1 if follows else 0
    return command, within.tau_wanted


@kernel
def _ahead(arm: Arm, m: RecordRow, obstacles: Obstacles, ends: F64, n: int) -> Ahead:
    """Return what is known of the posture that the goal is pursued in; ends: of the memory."""
    c, rho0 = arm.constants[0], arm.constants[0].avoid_rho0
    placed = 3 * arm.radius.shape[0]
    points = ends[:placed].reshape(arm.radius.shape[0], 3)
    if m.has_posture == 0 or not pursues(m):
        nowhere = Ends(points[:0], np.empty((0, 0)), 0.0, APART, 0.0, ends[:0])
        return Ahead(nowhere, c.limit_rho0[:n].copy(), False, np.zeros(n))
    found = np.empty((obstacles.active.shape[0], 4, points.shape[0]))
    distances_into(points.T.copy(), arm.radius, obstacles, widest(obstacles.room, obstacles.active, rho0), found)
    # the points stand out of the links: where the links themselves are known to keep the clearance, points need not
    measured = m.has_posture == MEASURED_POSTURE
    least, beside = (THINNEST, BESIDE) if measured else (LEAST_REACH * c.avoid_rho_min, 0.0)
    led = leads(m)
    there = Ends(points, found[:, 0].copy(), least, APART_LED if led else APART, beside, ends[placed:])
    return Ahead(there, limit_zones(c, m, n), led, m.lead[:n].copy())


@kernel
def act(
    arm: Arm,
    m: RecordRow,
    model: Model,
    space: OperationalSpace,
    around: Surroundings,
    f: Feedback,
    asked: Asked,
    ends: F64,
) -> tuple[U32, int]:
    """Run the second half of a tick; return its record in words, and what `progress_timers` asks for."""
    c, n = arm.constants[0], f.q.shape[0]
    e, e_rot, q_rest = wanted(c, m, model, asked.bits & CHOSEN != 0)
    q, qd, x, R, xd, omega = m.q[:n].copy(), m.qd[:n].copy(), m.x.copy(), m.R.copy(), m.xd.copy(), m.omega.copy()
    carried, hand = pushed(c, m, model, space.Jbar)
    m.drive_given[:n] = (
        let_drive(c, model, m.drive_given[:n].copy(), m.drive[:n].copy()) if m.driven != 0 else np.zeros(n)
    )
    hand += m.drive_given[:n]
    at = loaded(model, carried, q if c.carry == 0.0 else model.q)  # without carrying, points have not moved either
    slots = around.rho.shape[0]
    field, out = field_in(arm.reals, arm.wholes, n, arm.radius.shape[0], slots), outputs(n, slots)
    ahead = _ahead(arm, m, around.obstacles, ends, n)
    moves = m.state == _RUN or m.state == _STOPPING
    sent = m.sent[0, :n].copy() if moves else np.zeros(0)
    qdd = m.qdd[:n].copy()
    if m.state == _ARMED:  # what the arm will do when brakes that hold it open
        qdd = acceleration(at.A_inv, m.sent[0, :n].copy(), at.h, at.g, np.zeros(n), qd)
    _, m.limit_flags = law(
        arm.constants,
        Cover(arm.radius, arm.link),
        field,
        at,
        space,
        around.obstacles,
        Motion(
            q,
            qd,
            Twist(xd, omega),
            Twist(e, e_rot),
            Twist(m.v_ref.copy(), m.w_ref.copy()),
            q_rest,
            m.speed_scale,
            qdd,
            m.floating != 0 or m.driven != 0,
            hand,
            ahead,
            sent,
        ),
        WorkMemory(arm.reals, arm.wholes),
        out,
    )
    task, torques, seen, nearest = out
    # where it is, not where it might be: no contact by growing old
    around.rho[:] = seen[: nearest.shape[0]] + around.obstacles.margin
    m.v_ref[:], m.w_ref[:], m.tau_obstacles[:n] = task[6:9], task[9:], torques[OBSTACLES]
    if ahead.leads:  # and when it ends the tip goes on as it is
        m.v_ref[:], m.w_ref[:], m.lead[:n] = xd, omega, ahead.reference
    if holds_itself(c, m):
        command, tau_wanted = held(c, m, f, model, space.Jbar, around)
    else:
        command, tau_wanted = limited(c, m, f, model, space.Jbar, torques)
    pursued = target_of(m, m.has_goal != 0 and m.state == _RUN)
    p = progress_of(pursued.task, pursued.axis, pursued.position, pursued.wxyz, x, R, xd, omega)
    if m.parking != 0 and m.state == _RUN:
        p = parking_progress(m, n)
    flags = progress_timers(c, m, pursued, p)
    shown = target_of(m, m.has_goal != 0)
    raw = pack(
        m,
        f,
        Outcome(asked.verb, command, shown.position, shown.wxyz, shown.axis, shown.task, tau_wanted),
        (p.error, p.error_rot, space.sigma_min),
        task[:6],
        torques[: LOAD + 1],
        seen,
        nearest,
        c.dt,
    )
    m.driven = 0  # the other law is asked in each tick
    return raw, flags


@kernel
def surroundings(table: F64, shapes: F64, bodies: BODIES) -> Surroundings:
    """Return the obstacles of a table and its shapes, see `flat`."""
    obstacles, moving = obstacles_in(table, shapes, bodies)
    return Surroundings(
        obstacles, moving, row_of(table, AGE), row_of(table, RHO), row_of(table, GOAL_RHO), shapes[-2], shapes[-1]
    )


@kernel
def servo(
    arm: Arm,
    before: F64,
    parameters: F64,
    table_before: F64,
    shapes: F64,
    bodies: BODIES,
    ends: F64,
    feedback: Feedback,
    asked: int,
) -> tuple[F64, F64, U32, int]:
    """Run the servo level of one tick from a stage on, or until Python is needed.

    before: the memory, see `hot.record_of`. parameters, table_before, shapes, bodies: see `flat`. asked: `asking`.
    ends: of the memory.
    Returns the memory, the table, the words of the tick's record, and flags: DONE | WORDS when it is over; MODEL:
    evaluate the model at the joints of the memory where its `evaluated` says so, and the task space, then go on at
    MEASURED; ATTENTION: supervise, then go on at DECIDED; DIAGNOSE: the tick is over but for what holds the arm. MOVED:
    the obstacles are elsewhere than they were.
    """
    memory, table, wish = before.copy(), table_before.copy(), Asked(asked & 3, asked >> 2 & 63, asked >> 8)
    m = memory.view(HOT)[0]
    model, space = model_in(parameters, feedback.q.shape[0], arm.radius.shape[0])
    around = surroundings(table, shapes, bodies)
    flags = _sense(arm.constants[0], m, feedback, model, space.Jbar, around, wish) if wish.stage != DECIDED else DONE
    if flags & (MODEL | ATTENTION):
        return memory, table, np.empty(0, np.uint32), flags
    raw, more = act(arm, m, model, space, around, feedback, wish, ends)
    return memory, table, raw, flags | more
