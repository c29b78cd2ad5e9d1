"""The law: every torque of one tick, from the last parameter evaluation and the state now.

    tau = tau_motion + tau_obstacles + tau_limits + tau_posture + h + g

Sorted for the limiter into what drives towards the goal and what must be kept.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.bounds import (
    TIP_ROWS,
    Bounds,
    SelfPairs,
    TipMotion,
    joint_bounds,
    self_bounds,
    tip_bounds,
)
from rtctl.arm.constants import approach_params, constants_of, motion_limits, params_of
from rtctl.arm.field import (
    CAPPED,
    Field,
    LimitParams,
    MovingPoints,
    field_to,
    joint_limit_field,
    self_collision,
)
from rtctl.arm.flat import field_in, field_sizes
from rtctl.arm.guards import Inertia, Motors, hold_back, let_pass
from rtctl.arm.least_change import Rows, rows_in, rows_sizes
from rtctl.arm.model import Model
from rtctl.arm.nearby import APPROACH_ZONE, CANDIDATES_MAX, Nearby, look_near, nearby_in
from rtctl.arm.osc import (
    POSTURE_DAMPER,
    POSTURE_SPRING,
    TASK_BRAKE,
    TASK_DRIVE,
    OperationalSpace,
    TaskDynamics,
    Twist,
    joint_reference,
    joint_torque,
    motion_torque,
    velocity_reference,
)
from rtctl.arm.robot import Arm, Robot
from rtctl.arm.scaling import scale_drive_to_limits, scale_to_limits
from rtctl.arm.terms import (
    DRIVE,
    KEEP,
    LIMITS,
    LOAD,
    MOTION,
    OBSTACLES,
    POSTURE,
    Cover,
    Law,
    Motion,
    Outputs,
    WorkMemory,
    outputs,
)
from rtctl.control.firas import ROOM
from rtctl.kernel import leaf_kernel
from rtctl.types import F64, I32, I64, LimitFlag, Record, RecordRow
from rtctl.world.primitives import Obstacles

_CAP, _SPEED, _SINGULAR = (int(c) for c in (LimitFlag.FIELD_CAP, LimitFlag.SPEED, LimitFlag.SINGULAR))
_SCALED = int(LimitFlag.MOTION_SCALED)


def evaluate_law(robot: Robot, model: Model, space: OperationalSpace, obstacles: Obstacles, motion: Motion) -> Law:
    """Return the torques of `law` that take the tip where the motion wants it, and off whatever is near.

    An error of zero with references that are not brakes along the path.
    """
    out = outputs(robot.n, len(obstacles.active))
    cover, memory = Cover(robot.points.radius, robot.points.link), WorkMemory(robot.arm.reals, robot.arm.wholes)
    rho_self, cut = law(robot.constants, cover, robot.scratch, model, space, obstacles, motion, memory, out)
    return Law(out.task, out.torques, out.seen, out.nearest, rho_self, cut)


def prepared(robot: Robot) -> Robot:
    """Return the robot with the constants of the law as one record, and the memory that the law works in.

    Whoever replaces a gain or bound of a robot prepares it anew.
    """
    constants = constants_of(robot)
    m = len(robot.points.radius)
    reals, wholes = work_sizes(robot.slots, m, robot.n, len(robot.own.pairs))
    work = np.zeros(reals), np.zeros(wholes, np.int64)
    arm = Arm(constants, robot.points.radius, robot.points.link, *work)
    return robot._replace(constants=constants, arm=arm, scratch=field_in(*work, robot.n, m, robot.slots))


# rows of the work array of a tick, (rows, n): first the four of `osc.motion_torque`, last those of the bounds
_DQ, _QD_MAX, _SELF, _LIMITS, _REPEL, _LOAD, _DRAG, _DRIVE, _KEEP, _LOW, _HIGH, _DIAGONAL = range(4, 16)
_SUM, _SENT, _LESS, _AIM, _ROWS = range(16, 21)


class _Work(NamedTuple):
    """Arrays that a tick works in."""

    w: F64  # (rows, n) as above
    most: F64  # (r,) bounds of the rows from _ROWS on
    real: F64  # of the candidates; see `nearby.nearby_in`
    whole: I64
    made: I64  # (2n + r,) of the guards
    rows: Rows


def work_sizes(slots: int, m: int, n: int, pairs: int) -> tuple[int, int]:
    """Return the sizes of the WorkMemory of K = `slots` obstacles, m points, n joints, L = `pairs` pairs of links."""
    (a, b), (c, d) = field_sizes(slots, m, n), rows_sizes(n)
    candidates, known = min(slots * m, CANDIDATES_MAX), TIP_ROWS + pairs
    return a + (_ROWS + known) * n + known + candidates + 4 * m + n + 1 + c, b + 3 * candidates + 1 + 2 * n + known + d


@leaf_kernel
def _work_in(memory: WorkMemory, slots: int, m: int, n: int, pairs: int) -> _Work:
    """Return the law's arrays in the memory; see `work_sizes`."""
    c, known = min(slots * m, CANDIDATES_MAX), TIP_ROWS + pairs
    a, b = n + slots * (5 + n + ROOM + 6 * m) + 15 * m, slots * (3 + m)
    most = a + (_ROWS + known) * n
    real = most + known
    rows = real + c + 4 * m + n + 1
    made = b + 3 * c + 1
    end = made + 2 * n + known
    return _Work(
        memory.reals[a:most].reshape(_ROWS + known, n),
        memory.reals[most:real],
        memory.reals[real:rows],
        memory.wholes[b:made],
        memory.wholes[made:end],
        rows_in(memory.reals[rows:], memory.wholes[end:], n),
    )


@leaf_kernel
def _torques(
    constants: Record,
    cover: Cover,
    seen: Field,
    model: Model,
    space: OperationalSpace,
    obstacles: Obstacles,
    motion: Motion,
    task: F64,
    w: F64,
) -> tuple[float, int, float]:
    """Write the torques of the law without the guards into rows of w, and F, v_ref, w_ref into task (12,).

    Returns the least distance between links [m], the flags of the field, and the share of what drives.
    """
    q, qd, n = motion.q, motion.qd, motion.q.shape[0]
    p, limits = params_of(constants[0], n), motion_limits(constants[0], n, motion.speed_scale, w[_QD_MAX])
    reference = Twist(task[6:9], task[9:12])
    velocity_reference(
        motion.error, motion.previous, motion.actual, space.Jbar, qd, limits.qd_max, p.motion, p.dt, reference
    )
    at = TaskDynamics(model.J, model.Jdqd, model.A, space.Lambda, space.NT)
    motion_torque(at, motion.actual, reference, q, qd, motion.q_rest, p.motion, task[:6], w)
    ahead = motion.ahead
    if ahead.leads:
        for i in range(n):
            w[_DQ, i] = motion.q_rest[i] - q[i]
        joint_reference(model.J, w[_DQ], limits.qd_max, p.motion, p.dt, ahead.reference)
        joint_torque(model.A, qd, ahead.reference, p.motion.k_v, w)
    if motion.floats:
        for i in range(n):
            w[TASK_DRIVE, i], w[TASK_BRAKE, i] = motion.hand[i], 0.0
            w[POSTURE_SPRING, i], w[POSTURE_DAMPER, i] = 0.0, 0.0
    for i in range(n):
        w[_DQ, i], w[_DIAGONAL, i], w[_LOAD, i] = q[i] - model.q[i], model.A[i, i], model.g[i] + model.h[i]
    dq, load, tau_max = w[_DQ], w[_LOAD], limits.tau_max
    points = MovingPoints(model.P, model.Jp, model.B, cover.radius, cover.link)
    flags = field_to(points, dq, qd, obstacles, p.avoid, seen, True, ahead.ends)
    rho_self, more = self_collision(
        model.own_rho, model.own_row, dq, qd, model.A_inv, p.self_collision, ahead.ends.own, w[_SELF]
    )
    zones = LimitParams(ahead.zone, p.limit.rho_min, p.limit.rho_num, p.limit.eta, p.limit.k_d)
    joint_limit_field(q, qd, limits.q_min, limits.q_max, w[_DIAGONAL], zones, w[_LIMITS])
    for i in range(n):
        w[_REPEL, i] = seen.tau[i] + w[_SELF, i]
    repel, push = scale_to_limits(w[_REPEL], load, tau_max), scale_to_limits(w[_LIMITS], load, tau_max)
    for i in range(n):
        w[_REPEL, i] *= repel
        w[_LIMITS, i] *= push
        w[_DRIVE, i] = w[TASK_DRIVE, i] + w[POSTURE_SPRING, i]
        w[_KEEP, i] = w[TASK_BRAKE, i] + w[POSTURE_DAMPER, i] + w[_REPEL, i] + w[_LIMITS, i]
        w[_SELF, i] = load[i] + w[_KEEP, i]
    share = scale_drive_to_limits(w[_DRIVE], w[_SELF], tau_max)  # before the guards: they judge what will be sent
    for i in range(n):
        w[_DRIVE, i] *= share
        w[_SUM, i] = w[_DRIVE, i] + w[_KEEP, i]
    return rho_self, flags | more, share


@leaf_kernel
def _bounds(w: F64, most: F64) -> Bounds:
    return Bounds(w[_LOW], w[_HIGH], w[_ROWS:], most)


@leaf_kernel
def _bound(constants: Record, model: Model, motion: Motion, w: F64, most: F64) -> None:
    """Write the bounds of joints, tip and pairs of links; w is what `_torques` left."""
    n, bounds = motion.q.shape[0], _bounds(w, most)
    p, limits = params_of(constants[0], n), motion_limits(constants[0], n, motion.speed_scale, w[_QD_MAX])
    joint_bounds(model.A, motion.q, motion.qd, limits, bounds.low, bounds.high)
    tip = TipMotion(model.J, model.Jdqd, motion.actual.linear, motion.qdd)
    tip_bounds(tip, model.A, model.A_inv, p.motion.v_max, limits.tau_rate, bounds.rows, most)
    pairs = SelfPairs(model.own_rho, model.own_row, w[_DQ])
    self_bounds(pairs, model.A_inv, motion.qd, approach_params(constants[0]), limits.tau_rate, bounds)


@leaf_kernel
def _count_drag(c: RecordRow, qd: F64, w: F64) -> None:
    """Move the viscous friction that is not fed forward from what accelerates the arm to its load.

    The law leaves it to brake what moves. The guards count with accelerations: friction of one joint may well be what
    makes the tip faster, where that joint turned against the others.
    """
    for i in range(qd.shape[0]):
        w[_DRAG, i] = (c.viscous[i] - c.viscous_told[i]) * qd[i]
        w[_LOAD, i] += w[_DRAG, i]
        w[_SUM, i] -= w[_DRAG, i]


@leaf_kernel
def _near(constants: Record, cover: Cover, seen: Field, model: Model, motion: Motion, work: _Work) -> Nearby:
    c = constants[0]
    points = MovingPoints(model.P, model.Jp, model.B, cover.radius, cover.link)
    braking, tau_rate = approach_params(c).braking, c.tau_rate[: motion.q.shape[0]]
    return nearby_in(work.whole, work.real, points, seen, motion.qd, braking, tau_rate)


@leaf_kernel
def _let_pass(constants: Record, cover: Cover, seen: Field, model: Model, motion: Motion, work: _Work) -> bool:
    """Return whether no bound is passed; then row _SENT of the work is what may be sent."""
    c, w = constants[0], work.w
    near = _near(constants, cover, seen, model, motion, work)
    work.whole[-1] = look_near(near, APPROACH_ZONE)
    near = _near(constants, cover, seen, model, motion, work)
    inertia, motors = Inertia(model.A, model.A_inv), Motors(w[_LOAD], c.tau_max[: motion.q.shape[0]])
    return let_pass(inertia, motors, w[_SUM], _bounds(w, work.most), near, w[_SENT : _LESS + 1])


@leaf_kernel
def _hold_back(constants: Record, cover: Cover, seen: Field, model: Model, motion: Motion, work: _Work) -> bool:
    """Write what the guards let pass into row _SENT of the work, which `_let_pass` left; return whether any acts."""
    c, w = constants[0], work.w
    near = _near(constants, cover, seen, model, motion, work)
    inertia, motors = Inertia(model.A, model.A_inv), Motors(w[_LOAD], c.tau_max[: motion.q.shape[0]])
    for i in range(motion.q.shape[0]):
        work.rows.x[0, i] = motion.qdd[i]
    bounds = _bounds(w, work.most)
    return hold_back(work.rows, inertia, motors, w[_SUM], bounds, near, work.made, w[_SENT : _LESS + 1])


@leaf_kernel
def _slewed(c: RecordRow, sent: F64, w: F64) -> bool:
    """Return whether the limiter will slew row _SENT of the work; then row _SUM is what it leaves of it in this tick.

    It slows all joints down as one: where one is far from what it is asked for, the others get little of theirs.
    """
    share = 1.0
    for i in range(sent.shape[0]):
        step = abs(w[_SENT, i] + w[_LOAD, i] - sent[i])
        if step * share > c.tau_rate[i] * c.dt:
            share = c.tau_rate[i] * c.dt / step
    if share == 1.0:
        return False
    for i in range(sent.shape[0]):
        w[_AIM, i] = w[_SENT, i]
        w[_SUM, i] = sent[i] + share * (w[_SENT, i] + w[_LOAD, i] - sent[i]) - w[_LOAD, i]
    return True


@leaf_kernel
def _write(w: F64, share: float, torques: F64) -> None:
    """Write the rows of Law.torques."""
    for i in range(w.shape[1]):
        guard = w[_SENT, i] + w[_DRAG, i] - w[_DRIVE, i] - w[_KEEP, i]
        load = w[_LOAD, i] - w[_DRAG, i]
        torques[MOTION, i] = share * w[TASK_DRIVE, i] + w[TASK_BRAKE, i]
        torques[POSTURE, i] = share * w[POSTURE_SPRING, i] + w[POSTURE_DAMPER, i]
        torques[OBSTACLES, i], torques[LIMITS, i] = w[_REPEL, i], w[_LIMITS, i] + guard
        torques[LOAD, i], torques[DRIVE, i] = load, w[_DRIVE, i]
        torques[KEEP, i] = load + w[_KEEP, i] + guard


@leaf_kernel
def _copy_seen(seen: Field, rho_force: F64, nearest: I32) -> None:
    slots = nearest.shape[0]
    for k in range(slots):
        rho_force[k], nearest[k] = seen.rho_min[k], seen.nearest[k]
        for i in range(3):
            rho_force[slots + 3 * k + i] = seen.force[k, i]


@leaf_kernel
def law(
    constants: Record,
    cover: Cover,
    seen: Field,
    model: Model,
    space: OperationalSpace,
    obstacles: Obstacles,
    motion: Motion,
    memory: WorkMemory,
    out: Outputs,
) -> tuple[float, int]:
    """Write the torques of a tick into `out`; return the least distance between links [m], and Law.flags.

    The whole law is one kernel without an array of its own, so that nothing is counted or allocated on the way.
    """
    n = motion.q.shape[0]
    work = _work_in(memory, seen.leader.shape[0], cover.radius.shape[0], n, model.own_rho.shape[0])
    rho_self, flags, share = _torques(constants, cover, seen, model, space, obstacles, motion, out.task, work.w)
    _bound(constants, model, motion, work.w, work.most)
    _count_drag(constants[0], motion.qd, work.w)
    acts = False
    if not _let_pass(constants, cover, seen, model, motion, work):
        acts = _hold_back(constants, cover, seen, model, motion, work)
    if _slewed(constants[0], motion.sent, work.w):  # what is on its way there must keep the bounds, too
        if not _let_pass(constants, cover, seen, model, motion, work):
            acts = _hold_back(constants, cover, seen, model, motion, work) or acts
        else:
            for i in range(n):
                work.w[_SENT, i] = work.w[_AIM, i]
    _write(work.w, share, out.torques)
    _copy_seen(seen, out.seen, out.nearest)
    cut = _CAP if flags & CAPPED else 0
    cut |= _SPEED if acts else 0
    cut |= _SINGULAR if space.damped else 0
    cut |= _SCALED if share < 1.0 else 0
    return rho_self, cut
