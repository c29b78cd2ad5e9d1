"""Where the law would take an arm: its tip's way to a goal reckoned ahead, past what rests beside it or into it."""

from typing import NamedTuple

import numpy as np

from rtctl.arm.kinematics import Chain, Target, placements, tip_at
from rtctl.arm.model import spd_inverse
from rtctl.arm.task import selection, task_error
from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64
from rtctl.world.primitives import Obstacles, distances_into
from rtctl.world.rooms import count_rooms, farthest

ROLLOUT = 160  # steps of a rollout
NEAR_ENOUGH = 2e-3  # [m], and five times that [rad], where a rollout ends
APPROACH = 0.5  # of what a point has more than it keeps, that a step may take
SWEEPS = 8  # over what the points are held off, in a step
REACH = 0.1  # [m] beyond what they keep, that is looked at
STALLED, CREEPS = 12, 0.125  # steps, of full speed: an arm that gets nearer no faster for so long is held


class Pace(NamedTuple):
    """How fast the law goes to a goal."""

    v: float  # [m/s]
    w: float  # [rad/s]
    qd: F64  # (n,) [rad/s] at most
    drift: F64  # (n,) [rad/s] at most towards the posture
    gain: float  # [1/s] of that
    A: F64  # (n, n) [kg m2] inertia, whose kinetic energy the motion keeps least; the identity: the speeds' squares


class Around(NamedTuple):
    """What rests beside an arm, and how far its points keep off: no farther than they are at the start."""

    link: I64  # (m,) of the points
    local: F64  # (m, 3) [m]
    radius: F64  # (m,) [m]
    obstacles: Obstacles  # without a slot: the way through everything
    keep: float  # [m]


@kernel
def _easiest_step(J: F64, e: F64, A: F64, free: B1, damping: float) -> F64:
    """Return M J^T (J M J^T + damping I)^-1 e, M the inverse of A (n, n), over its largest element, of what is free."""
    k, n = J.shape
    among = A.copy()
    for i in range(n):
        if not free[i]:
            among[i, :], among[:, i] = 0.0, 0.0
            among[i, i] = A[i, i]
    M, JM, G, step = spd_inverse(among), np.zeros((k, n)), np.zeros((k, k)), np.zeros(n)
    largest = 0.0
    for i in range(n):
        if free[i]:
            largest = max(largest, M[i, i])
    for a in range(k):
        for i in range(n):
            if free[i]:
                for j in range(n):
                    if free[j]:
                        JM[a, i] += J[a, j] * (M[j, i] / largest)
        for b in range(k):
            for i in range(n):
                G[a, b] += JM[a, i] * J[b, i]
        G[a, a] += damping
    G_inv = spd_inverse(G)
    for a in range(k):
        y = 0.0
        for b in range(k):
            y += G_inv[a, b] * e[b]
        for i in range(n):
            step[i] += JM[a, i] * y
    return step


@kernel
def _rho(around: Around, R: F64, t: F64, far: float, P: F64, rho: F64) -> None:
    """Write the points (3, m) [m] and what `distances_into` tells of them, counted in the config's numbers."""
    for j in range(around.link.shape[0]):
        k = around.link[j]
        for i in range(3):
            P[i, j] = t[k, i]
            for l in range(3):
                P[i, j] += R[k, i, l] * around.local[j, l]
    distances_into(P, around.radius, around.obstacles, far, rho)
    count_rooms(around.obstacles.room, rho)


@kernel
def _hold_off(chain: Chain, around: Around, keeps: F64, R: F64, t: F64, P: F64, rho: F64, M: F64, step: F64) -> None:
    """Turn a step (n,) [rad] aside where points would come too near, for the least kinetic energy.

    Of each link the nearest point to each obstacle takes no more than APPROACH of what it has beyond `keeps` (K, m)
    [m]; a push along its normal n is M J^T n, as the field's is. P, rho: of `_rho`; M (n, n): the inertia's inverse.
    """
    n, slots, m = step.shape[0], rho.shape[0], rho.shape[2]
    rows, pushed, least = np.zeros((slots * (n + 1), n)), np.zeros((slots * (n + 1), n)), np.empty(slots * (n + 1))
    count, nearest, z = 0, np.empty(n + 1, np.int64), np.empty(3)
    for k in range(slots):
        nearest[:] = -1
        for j in range(m):
            has = rho[k, 0, j] - keeps[k, j]
            other = nearest[around.link[j]]
            if has < REACH and (other < 0 or has < rho[k, 0, other] - keeps[k, other]):
                nearest[around.link[j]] = j
        for link in range(1, n + 1):
            j = nearest[link]
            if j < 0:
                continue
            a, size = rows[count], 0.0
            a[:] = 0.0
            for d in range(n):
                if not chain.moves[link, d]:
                    continue
                for i in range(3):
                    z[i] = R[d + 1, i, 0] * chain.axis[d + 1, 0] + R[d + 1, i, 1] * chain.axis[d + 1, 1]
                    z[i] += R[d + 1, i, 2] * chain.axis[d + 1, 2]
                n0, n1, n2 = rho[k, 1, j], rho[k, 2, j], rho[k, 3, j]
                if chain.slides[d + 1]:
                    a[d] = n0 * z[0] + n1 * z[1] + n2 * z[2]
                    continue
                r0, r1, r2 = P[0, j] - t[d + 1, 0], P[1, j] - t[d + 1, 1], P[2, j] - t[d + 1, 2]
                a[d] = n0 * (z[1] * r2 - z[2] * r1) + n1 * (z[2] * r0 - z[0] * r2) + n2 * (z[0] * r1 - z[1] * r0)
            for i in range(n):
                pushed[count, i] = 0.0
                for d in range(n):
                    pushed[count, i] += M[i, d] * a[d]
                size += a[i] * pushed[count, i]
            if size < 1e-12:
                continue
            for i in range(n):
                pushed[count, i] /= size
            least[count] = -APPROACH * (rho[k, 0, j] - keeps[k, j])
            count += 1
    for _ in range(SWEEPS):
        turned = False
        for c in range(count):
            lacks = least[c]
            for i in range(n):
                lacks -= rows[c, i] * step[i]
            if lacks > 1e-9:
                turned = True
                for i in range(n):
                    step[i] += lacks * pushed[c, i]
        if not turned:
            break


@kernel
def rollout(
    chain: Chain, q0: F64, rest: F64, goal: Target, low: F64, high: F64, pace: Pace, around: Around, dt: float
) -> tuple[F64, bool]:
    """Return the postures (k, n), dt [s] apart, of a tip that goes straight to a goal and joints that drift to `rest`.

    And whether they have it in the end. The law, to see where it would end: within low and high (n,), and off what
    rests around; held by that, it ends where it is. Of all joint speeds that move the tip so it takes those of least
    kinetic energy, as the law does, for an inertia that stays as it is.
    """
    n, slots, m = q0.shape[0], around.obstacles.active.shape[0], around.radius.shape[0]
    out, q, R, t = np.empty((ROLLOUT + 1, n)), q0.copy(), np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    P, rho, keeps, M = np.empty((3, m)), np.empty((slots, 4, m)), np.empty((slots, m)), np.empty((n, n))
    far_off, lacks = 0.0, np.zeros(ROLLOUT + 1)
    if slots:
        M = spd_inverse(pace.A)
        far_off = farthest(around.obstacles.room, around.obstacles.active, around.keep + REACH)
        placements(chain, q, R, t)
        _rho(around, R, t, far_off, P, rho)
        for k in range(slots):
            for j in range(m):
                keeps[k, j] = min(around.keep, rho[k, 0, j])
    for b in range(ROLLOUT + 1):
        out[b] = q
        placements(chain, q, R, t)
        x, turn, J = tip_at(chain, R, t)
        e, e_rot = task_error(goal.task, goal.axis, goal.position, goal.wxyz, x, turn)
        far, turned = np.sqrt((e * e).sum()), np.sqrt((e_rot * e_rot).sum())
        if far < NEAR_ENOUGH and turned < 5.0 * NEAR_ENOUGH:
            return out[: b + 1].copy(), True
        lacks[b] = max(far / pace.v, turned / pace.w)
        if slots and b >= STALLED and lacks[b - STALLED] - lacks[b] < CREEPS * STALLED * dt:
            return out[: b + 1].copy(), False
        S = selection(goal.task, goal.axis, turn)
        k = S.shape[0]
        Js, es = np.zeros((k, n)), np.zeros(k)
        e *= min(1.0, pace.v * dt / max(far, 1e-12))
        e_rot *= min(1.0, pace.w * dt / max(turned, 1e-12))
        for a in range(k):
            for c in range(3):
                es[a] += S[a, c] * e[c] + S[a, 3 + c] * e_rot[c]
            for c in range(6):
                for i in range(n):
                    Js[a, i] += S[a, c] * J[c, i]
        free, step = np.ones(n, np.bool_), np.zeros(n)
        drift = np.minimum(np.maximum(pace.gain * (rest - q), -pace.drift), pace.drift) * dt
        for _again in range(3):
            wanted = es.copy()
            for a in range(k):
                for i in range(n):
                    if free[i]:
                        wanted[a] -= Js[a, i] * drift[i]
            step = _easiest_step(Js, wanted, pace.A, free, 1e-4)
            bound = False
            for i in range(n):
                step[i] = step[i] + drift[i] if free[i] else 0.0
            for i in range(n):
                if free[i] and ((q[i] >= high[i] and step[i] > 0.0) or (q[i] <= low[i] and step[i] < 0.0)):
                    free[i] = False
                    bound = True
            if not bound:
                break
        if slots:
            _rho(around, R, t, far_off, P, rho)
            _hold_off(chain, around, keeps, R, t, P, rho, M, step)
        share = 1.0
        for i in range(n):
            if abs(step[i]) * share > pace.qd[i] * dt:
                share = pace.qd[i] * dt / abs(step[i])
        for i in range(n):
            q[i] = min(max(q[i] + share * step[i], min(low[i], q[i])), max(high[i], q[i]))
    return out, False
