"""Bounds of accelerations with which joints, the tip and links of the arm can still be stopped in time.

A speed v may not pass its bound v_b within SPEED_HORIZON, so vd <= (v_b - v)/T (velocity dampers, Faverjon and
Tournassoud 1987). Torque is slewed on its way out, so an acceleration can be taken back at a bounded jerk j only: while
v < v_b also vd <= sqrt(2 j (v_b - v)).
"""

import math
from typing import NamedTuple

from rtctl.arm.least_change import dot, mobility
from rtctl.kernel import leaf_kernel
from rtctl.types import F64

SPEED_BAND = 0.9  # fraction of qd_max that the guard lets joints have
SPEED_HORIZON = 0.02  # [s] within which it wants a bound kept: ten times what two periods of delay at 1 kHz bear
JERK_SHARE = 0.5  # of the torque rate counted on: the joints slew as one, the others want their part
TIP_SLOW = 0.1  # of v_max, below which the tip needs no guard
TIP_ROWS = 2  # of the tip: along its velocity, and along that which its acceleration leads to
ALIGNED = 0.999  # cosine of the angle between the two, from which one of them is enough
SELF_APPROACH_SHARE = 0.15  # of v_max, at which a link may come near another of the same arm: their field turns it


class MotionLimits(NamedTuple):
    """What bounds the motion of the joints now, each (n,)."""

    q_min: F64  # [rad or m]
    q_max: F64
    qd_max: F64  # [rad/s] that joints may have at present
    braking: F64  # [rad/s2] with which a joint is brought to rest before its limit
    tau_max: F64  # [Nm] that may be sent
    tau_rate: F64  # [Nm/s]


class ApproachParams(NamedTuple):
    """How near and how fast links may come."""

    rho0: float  # [m] influence of obstacles
    self_stop: float  # [m] before which the approach of two links of the arm is slowed
    v_max: float  # [m/s]
    braking: float  # [m/s2] with which an approach is counted to be stopped


class TipMotion(NamedTuple):
    """How the tip moves."""

    J: F64  # (6, n) Jacobian
    Jdqd: F64  # (6,) its velocity product
    xd: F64  # (3,) [m/s]
    qdd: F64  # (n,) [rad/s2] accelerations under way: of the torque sent last


class SelfPairs(NamedTuple):
    """Links of the arm near each other, as the last evaluation measured them."""

    rho: F64  # (L,) [m], inf when far
    row: F64  # (L, n) d rho/d q
    dq: F64  # (n,) [rad] since


class Bounds(NamedTuple):
    """Bounds of accelerations that are known before any is passed."""

    low: F64  # (n,) [rad/s2]
    high: F64  # (n,)
    rows: F64  # (r, n): of the tip, then of pairs of links
    most: F64  # (r,) of rows qdd; inf for none


@leaf_kernel
def acceleration_bound(bound: float, speed: float, jerk: float) -> float:
    """Return the largest acceleration with which `speed` can still be kept below `bound`."""
    gap = bound - speed
    accel = gap / SPEED_HORIZON
    if gap > 0.0:
        accel = min(accel, math.sqrt(2.0 * jerk * gap))
    return accel


@leaf_kernel
def approach_bound(room: float, speed: float, top: float, braking: float, jerk: float) -> float:
    """Return the largest acceleration towards a limit `room` ahead, at `speed` towards it.

    The bound is min(top, sqrt(2 braking room')), which a joint that brakes follows down to rest; its own slope,
    -braking speed/bound, is fed forward. room' ends where a damper of SPEED_HORIZON still stops short of the limit.
    """
    left = max(0.0, room - 2.0 * SPEED_HORIZON * SPEED_HORIZON * braking)
    curve = math.sqrt(2.0 * braking * left)
    if curve >= top:
        return acceleration_bound(top, speed, jerk)
    slope = braking * min(1.0, max(0.0, speed) / max(curve, SPEED_HORIZON * braking))
    return acceleration_bound(curve, speed, jerk) - slope


@leaf_kernel
def joint_bounds(A: F64, q: F64, qd: F64, limits: MotionLimits, low: F64, high: F64) -> None:
    """Write the least and largest accelerations (n,) with which every joint can still stop before its limit.

    The jerk of joint i is what the torque rates allow it alone, min over k of rate_k/|A_ki|.
    """
    for i in range(qd.shape[0]):
        jerk = math.inf
        for k in range(qd.shape[0]):
            if abs(A[k, i]) * jerk > JERK_SHARE * limits.tau_rate[k]:
                jerk = JERK_SHARE * limits.tau_rate[k] / abs(A[k, i])
        top, braking = SPEED_BAND * limits.qd_max[i], limits.braking[i]
        high[i] = approach_bound(limits.q_max[i] - q[i], qd[i], top, braking, jerk)
        low[i] = -approach_bound(q[i] - limits.q_min[i], -qd[i], top, braking, jerk)
        if low[i] > 0.0:  # it must brake, and is not asked to do so gently
            high[i] = max(high[i], low[i])
        elif high[i] < 0.0:
            low[i] = min(low[i], high[i])


@leaf_kernel
def jerk_along(rows: F64, r: int, along: float, tau_rate: F64) -> float:
    """Return the jerk along row r (n,) that a force of the torque rates gives, along = row A^-1 row^T [1/kg]."""
    slowest = 1e-9
    for i in range(tau_rate.shape[0]):
        slowest = max(slowest, abs(rows[r, i]) / tau_rate[i])
    return JERK_SHARE * along / slowest


@leaf_kernel
def _tip_along(tip: TipMotion, x: float, y: float, z: float, rows: F64, r: int) -> float:
    """Write row r (n,) of the tip along (x, y, z), and return the length of that."""
    size = math.sqrt(x * x + y * y + z * z)
    for i in range(tip.J.shape[1]):
        rows[r, i] = (tip.J[0, i] * x + tip.J[1, i] * y + tip.J[2, i] * z) / size
    return size


@leaf_kernel
def slew_time(A: F64, qdd: F64, tau_rate: F64) -> float:
    """Return how long [s] torque is slewed until accelerations qdd (n,) [rad/s2] are none, all joints as one."""
    longest = 0.0
    for i in range(qdd.shape[0]):
        longest = max(longest, abs(dot(A, i, qdd)) / tau_rate[i])
    return longest


@leaf_kernel
def tip_bounds(tip: TipMotion, A: F64, A_inv: F64, v_max: float, tau_rate: F64, rows: F64, most: F64) -> None:
    """Write the TIP_ROWS first rows and bounds of row qdd that keep the tip's speed below v_max [m/s].

    Along its velocity v, and along p = v + a T/2, what that comes to when its acceleration a is taken back from now on
    within T: at the jerk along its own way, or by joints that are slewed as one, whichever takes longer. An
    acceleration across a fast tip's way, or one that turns it round, makes it no faster now, and is too large to be
    taken back by the time it does. So is one of a tip at rest that brakes let go. The latter bound is no more than what
    comes to v_max while all joints are slewed, 2 (v_max - v)/T.

    The motion task never asks for more than v_max; a field that shoves the arm may. inf while the tip is slow
    and stays so.
    """
    v, J = tip.xd, tip.J
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    slow, slews = speed < TIP_SLOW * v_max, slew_time(A, tip.qdd, tau_rate)
    most[0], most[1] = math.inf, math.inf
    x, y, z = tip.Jdqd[0], tip.Jdqd[1], tip.Jdqd[2]
    for i in range(J.shape[1]):
        x, y, z = x + J[0, i] * tip.qdd[i], y + J[1, i] * tip.qdd[i], z + J[2, i] * tip.qdd[i]
    if x * x + y * y + z * z > 0.0:
        size = _tip_along(tip, x, y, z, rows, 1)
        back = size / max(jerk_along(rows, 1, mobility(A_inv, rows, 1), tau_rate), 1e-9)  # [s]
        back = 0.5 * max(back, slews)
        x, y, z = v[0] + back * x, v[1] + back * y, v[2] + back * z
        peak, along = math.sqrt(x * x + y * y + z * z), v[0] * x + v[1] * y + v[2] * z
        if peak >= TIP_SLOW * v_max and (slow or along < ALIGNED * peak * speed):
            _tip_along(tip, x, y, z, rows, 1)
            drift = (tip.Jdqd[0] * x + tip.Jdqd[1] * y + tip.Jdqd[2] * z) / peak
            jerk = jerk_along(rows, 1, mobility(A_inv, rows, 1), tau_rate)
            most[1], gap = acceleration_bound(v_max, along / peak, jerk), v_max - along / peak
            if gap > 0.0 and slews > 0.0:
                most[1] = min(most[1], 2.0 * gap / slews)
            most[1] -= drift
    if not slow:
        _tip_along(tip, v[0], v[1], v[2], rows, 0)
        drift = (tip.Jdqd[0] * v[0] + tip.Jdqd[1] * v[1] + tip.Jdqd[2] * v[2]) / speed
        jerk = jerk_along(rows, 0, mobility(A_inv, rows, 0), tau_rate)
        most[0] = acceleration_bound(v_max, speed, jerk) - drift


@leaf_kernel
def self_bounds(pairs: SelfPairs, A_inv: F64, qd: F64, p: ApproachParams, tau_rate: F64, out: Bounds) -> None:
    """Write rows and bounds, behind those of the tip, along which links of the arm come nearer to each other.

    Every pair that is measured counts, and is slowed before self_stop to what its field turns easily: that field is
    thin and steep, and torque that is slewed comes too late for a link that enters it fast. Slower than that only
    touching is prevented: a guard as steep as the field would set a folded arm swinging between two pairs.
    """
    for s in range(pairs.rho.shape[0]):
        r = TIP_ROWS + s
        out.most[r] = math.inf
        if pairs.rho[s] == math.inf:
            continue
        for i in range(qd.shape[0]):
            out.rows[r, i] = -pairs.row[s, i]
        room, speed = pairs.rho[s] + dot(pairs.row, s, pairs.dq), dot(out.rows, r, qd)
        jerk = jerk_along(out.rows, r, mobility(A_inv, out.rows, r), tau_rate)
        fast = approach_bound(room - p.self_stop, speed, math.inf, p.braking, jerk)
        free = approach_bound(room, speed, SELF_APPROACH_SHARE * p.v_max, p.braking, jerk)
        out.most[r] = max(fast, free)
