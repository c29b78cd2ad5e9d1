"""Level of competence: what holds an arm that rests short of its goal, each named and each true.

An arm at rest is in balance: the torque that drives it to the goal equals what opposes it. With tau_m = J^T Lambda F
and the metric A^-1 of Gauss's principle, every opposing torque t has the share -t^T A^-1 tau_m / tau_m^T A^-1 tau_m,
and the shares add up to one: who balances the drive, and by how much.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.field import ACCELERATION, FORCE, NORMAL, SUM, TASK, Field, FieldParams, own_field
from rtctl.arm.hot import record_of
from rtctl.arm.memory import Memory
from rtctl.arm.point_inertia import times_inertia
from rtctl.arm.robot import Robot
from rtctl.arm.target import leads
from rtctl.arm.task import error_of, selected, task_error
from rtctl.kernel import kernel
from rtctl.kernel.linalg import matvec, symmetric_eigen, tmatvec
from rtctl.kernel.reductions import norm
from rtctl.types import F64, I64, Status
from rtctl.world.rooms import OWN_INFLUENCE

MASK = 64  # bits of a record's mask
HOLDS = 0.1  # share from which something is said to hold the arm
LOST = 0.4  # fraction of the wanted acceleration that the tip can have, below which the direction is lost
EDGE = 0.05  # [m] curvature of the tip's height along a direction that still counts as none: the reach ends there
AT_BOUND = 1.0 - 1e-6  # of tau_max
UNKNOWN = "something unknown"  # holds the arm


class Balance(NamedTuple):
    """Shares of what opposes the drive of an arm at rest, and what else can hold it."""

    obstacles: F64  # (K,)
    limits: F64  # (n,) of each joint's limit, 0 for joints outside the zones
    own: float  # of links near each other
    granted: float  # share of the wanted tip acceleration that the drive gives: 1, and 0 for a lost direction
    full: F64  # (n,) |wanted torque| / tau_max
    goal_rho: F64  # (K,) [m] from the goal to each obstacle
    rho0: F64  # (K,) [m] influence of each obstacle
    edge: bool  # the tip is as far in the goal's direction as the links are long


class GoalDrive(NamedTuple):
    """What drives the tip to its goal, tau_m = J^T Lambda F, or joints that are led, tau_m = A k_v qd_ref."""

    F: F64  # (6,) [m/s2, rad/s2] that the goal asks for
    J: F64  # (6, n)
    A_inv: F64  # (n, n)
    tau: F64  # (n,) [Nm]


class OpposingTorques(NamedTuple):
    """The torques that oppose it, each (n,) [Nm]."""

    own: F64  # of links near each other, as the field alone gives it
    obstacles: F64  # of them and of obstacles, as it was sent
    limits: F64  # of joint limits


class LimitGaps(NamedTuple):
    """How far the joints are from their limits, each (n,) [rad or m]."""

    above: F64
    below: F64
    zone: F64  # of the limit's potential


class Blockers(NamedTuple):
    """What holds the arm."""

    status: Status
    mask: int  # bits of the first 64 obstacle slots, or of joints for LIMITED and SATURATED
    main: int  # the strongest of them, -1 for none


def blockers(b: Balance) -> Blockers:
    """Return what holds an arm with this balance.

    The causes are tried from the one that hides the others: torque that ran out; then whatever opposes the drive,
    joint limits or obstacles, the stronger first; then a drive that cannot move the tip.
    """
    full = np.flatnonzero(b.full >= AT_BOUND)
    if len(full):
        return Blockers(Status.SATURATED, _mask(full), int(b.full.argmax()))
    walls, joints = np.flatnonzero(b.obstacles >= HOLDS), np.flatnonzero(b.limits >= HOLDS)
    lost = b.granted < LOST
    if len(joints) and b.limits.sum() >= b.obstacles.sum() and (not lost or b.limits.sum() > 0.5):
        return Blockers(Status.LIMITED, _mask(joints), int(b.limits.argmax()))
    if len(walls) and not lost:
        shadowed = bool((b.goal_rho[walls] < b.rho0[walls]).all())
        status = Status.SHADOWED if shadowed else Status.LOCAL_MINIMUM
        return Blockers(status, _mask(walls), int(b.obstacles.argmax()))
    if lost:
        return Blockers(Status.UNREACHABLE if b.edge else Status.SINGULAR, 0, -1)
    return Blockers(Status.LOCAL_MINIMUM, 0, -1)


def balance(robot: Robot, m: Memory, tau_limits: F64, tau_wanted: F64) -> Balance:
    """Return the balance of the tick that ends with m, for the field's work arrays are read.

    tau_limits (n,) [Nm] of its law; tau_wanted (n,) [Nm] its sum.
    """
    assert m.goal is not None
    e, _ = task_error(int(m.goal.task), m.goal.axis, m.goal.position, m.goal.wxyz, m.tip.x, m.tip.R)
    led = leads(record_of(m.hot)[0])
    tau_own, _, _ = own_field(
        m.model.own_rho,
        m.model.own_row,
        m.joints.q - m.model.q,
        m.joints.qd,
        m.model.A_inv,
        robot.self_avoid,
        m.ends[3 * len(robot.points.radius) :] if m.goal.posture is not None else np.zeros(0),
    )
    F = _drive(robot, m)
    tau_m = robot.motion.k_v * matvec(m.model.A, m.lead) if led else tmatvec(m.model.J, matvec(m.space.Lambda, F))
    obstacles, limits, own, granted = _shares(
        GoalDrive(F, m.model.J, m.model.A_inv, tau_m),
        OpposingTorques(tau_own, m.tau_obstacles, tau_limits),
        robot.scratch,
        robot.avoid,
        m.model.Jp,
        robot.points.link,
        LimitGaps(robot.q_max - m.joints.q, m.joints.q - robot.q_min, robot.limit.rho0),
    )
    return Balance(
        obstacles,
        limits,
        own,
        1.0 if led else granted,
        np.abs(tau_wanted) / robot.tau_max,
        m.goal_rho,
        influences(robot, m),
        not led and norm(e) > m.goal.tolerance and at_edge(m.model.J, e),
    )


def influences(robot: Robot, m: Memory) -> F64:
    """Return the influence (K,) [m] of each obstacle: its own, or the config's."""
    own: F64 = m.world.obstacles.room[:, OWN_INFLUENCE]
    return np.where(own > 0.0, own, robot.avoid.rho0)


def _drive(robot: Robot, m: Memory) -> F64:
    """Return the tip's acceleration (6,) that the goal asks for, zero along what it leaves free."""
    assert m.goal is not None
    v, w = selected(int(m.goal.task), m.goal.axis, m.tip.R, m.v_ref, m.w_ref)
    return robot.motion.k_v * np.concatenate((v, w))


@kernel
def _shares(
    drive: GoalDrive,
    opposed: OpposingTorques,
    field: Field,
    params: FieldParams,
    Jp: F64,
    link: I64,
    gaps: LimitGaps,
) -> tuple[F64, F64, float, float]:
    """Return the fields of `Balance` from `obstacles` to `granted`; Jp (m, 3, n) and link (m,) of the points."""
    F, J, A_inv, tau_m = drive
    tau_own, tau_obstacles, tau_limits = opposed
    n, slots = tau_own.shape[0], field.leader.shape[0]
    qdd = matvec(A_inv, tau_m)
    has = matvec(J, qdd)
    total, wanted, given, scale = 1e-12, 1e-12, 0.0, 1.0
    for i in range(n):
        total += tau_m[i] * qdd[i]
    for i in range(6):  # F is zero along what the goal leaves free
        wanted += F[i] * F[i]
        given += F[i] * has[i]
    raw = norm(field.tau + tau_own)
    if raw > 0.0:  # a field that asks for more than the motors have was scaled
        scale = norm(tau_obstacles) / raw
    obstacles, limits, own = np.zeros(slots), np.zeros(n), 0.0
    plain, whole, pairs = int(params.forms) & SUM != 0, int(params.forms) & TASK != 0, field.pairs
    along = np.empty(3)
    for k in range(slots):
        if field.leader[k] < 0:
            continue
        for j in range(link.shape[0]):
            f = pairs[k, FORCE, j]
            if f != 0.0:
                f *= scale if plain else scale * pairs[k, ACCELERATION, j] / field.share[field.leader[k], link[j]]
                for c in range(3):
                    along[c] = pairs[k, NORMAL + c, j]
                if whole:
                    x, y, z = times_inertia(field.points, j, along[0], along[1], along[2], 1.0 / params.m_max)
                    along[0], along[1], along[2] = x, y, z
                for c in range(3):
                    for i in range(n):
                        obstacles[k] -= f * along[c] * Jp[j, c, i] * qdd[i] / total
    for i in range(n):
        own -= scale * tau_own[i] * qdd[i] / total
        gap = gaps.above[i] if qdd[i] > 0.0 else gaps.below[i]
        if gap < gaps.zone[i] and tau_limits[i] * qdd[i] < 0.0:
            limits[i] = -tau_limits[i] * qdd[i] / total
    return obstacles, limits, own, given / wanted


@kernel
def at_edge(J: F64, e: F64) -> bool:
    """Return whether no small motion of any joints takes the tip further along e (3,).

    To the second order: d2 (u.x)/dq_i dq_j = u . (z_i x J_j), i <= j, has no positive eigenvalue. J (6, n).
    """
    n = J.shape[1]
    u = e / max(norm(e), 1e-12)
    H = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            x = J[4, i] * J[2, j] - J[5, i] * J[1, j]
            y = J[5, i] * J[0, j] - J[3, i] * J[2, j]
            z = J[3, i] * J[1, j] - J[4, i] * J[0, j]
            H[i, j] = u[0] * x + u[1] * y + u[2] * z
            H[j, i] = H[i, j]
    values, _ = symmetric_eigen(H)
    largest = values[0]
    for i in range(n):
        largest = max(largest, values[i])
    return bool(largest <= EDGE)


def names(robot: Robot, m: Memory, found: Blockers) -> tuple[str, ...]:
    """Return what holds the arm in words, the strongest first."""
    bits = {i for i in range(MASK) if found.mask >> i & 1} | ({found.main} if found.main >= MASK else set())
    order = sorted(bits, key=lambda i: (i != found.main, i))
    match found.status:
        case Status.LIMITED:
            return tuple(f"{robot.joints[i]} at its {_end(robot, m.joints.q, i)} limit" for i in order)
        case Status.SATURATED:
            return tuple(robot.joints[i] for i in order)
        case Status.SINGULAR | Status.UNREACHABLE:
            return (_lost(robot, m, found.status),)
        case Status.LOCAL_MINIMUM if not order:
            pair = int(m.model.own_rho.argmin()) if len(m.model.own_rho) else -1
            if pair >= 0 and m.model.own_rho[pair] < robot.self_avoid.rho0:
                return (" and ".join(robot.own.names[pair]),)
            k = int(m.rho.argmin())  # what no field holds is held by a guard of what is near
            near = m.rho[k] < influences(robot, m)[k]
            return (f"{m.world.names[k]} at {_nearest(robot, k)}",) if near else (UNKNOWN,)
        case _:
            return tuple(f"{m.world.names[k]} at {_link(robot, k)}" for k in order)


def _link(robot: Robot, k: int) -> str:
    """Return the link that obstacle k pushes most."""
    return robot.points.names[int(robot.scratch.pairs[k, 5].argmax())]


def _nearest(robot: Robot, k: int) -> str:
    """Return the link that is nearest to obstacle k."""
    return robot.points.names[int(robot.scratch.pairs[k, 0].argmin())]


def _lost(robot: Robot, m: Memory, status: Status) -> str:
    """Return the direction that the joints do not give the tip: the wanted acceleration less what it gets."""
    assert m.goal is not None
    F = _drive(robot, m)
    miss = F - matvec(m.model.J, matvec(m.model.A_inv, tmatvec(m.model.J, matvec(m.space.Lambda, F))))
    v, w = selected(int(m.goal.task), m.goal.axis, m.tip.R, miss[:3], miss[3:])
    linear = status == Status.UNREACHABLE or norm(v) > robot.motion.length * norm(w)
    part, word = (v, "move along") if linear else (w, "turn about")
    u = part / max(norm(part), 1e-12)
    error, _ = error_of(m.goal, m.tip.x, m.tip.R)
    far = f", {error:.3f} m too far" if status == Status.UNREACHABLE else ""
    return f"cannot {word} {u[0]:+.2f} {u[1]:+.2f} {u[2]:+.2f}{far}"


def _end(robot: Robot, q: F64, i: int) -> str:
    return "lower" if q[i] - robot.q_min[i] < robot.q_max[i] - q[i] else "upper"


def _mask(bits: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> int:
    return sum(1 << int(i) for i in bits if i < MASK)
