"""Guards on the law's torque: nothing is driven to where it could not be held any more.

They bound accelerations, qdd = A^-1 tau with tau all torque but gravity and Coriolis, as velocity dampers do
(Faverjon): a speed v may not pass its bound v_b within SPEED_HORIZON, so vd <= (v_b - v)/T. Torque is slewed on its way
out, so an acceleration can be taken back at a bounded jerk j only: while v < v_b also vd <= sqrt(2 j (v_b - v)).
Bounded are every joint, by its speed and by what still stops it before its limit; the tip, by v_max; and every link
near an obstacle or another link, by what still stops its own approach before they touch.

Where a bound is passed, the accelerations that come nearest in A's norm and keep all of them take the place of those
wanted (Gauss: as if mechanical stops held the arm there). Cutting a joint's own acceleration alone would not do: what
is left of a push away from an obstacle may then be a push towards it.
"""

import numpy as np

from rtctl.kernel import kernel
from rtctl.kernel.linalg import matvec
from rtctl.types import F64, I64

SPEED_BAND = 0.9  # fraction of qd_max that the guard lets joints have
LEAST_SHARE = 0.2  # of tau_max that the law may use however heavy the arm
SPEED_HORIZON = 0.02  # [s] within which it wants a bound kept: ten times what two periods of delay at 1 kHz bear
JERK_SHARE = 0.5  # of the torque rate counted on: the joints slew as one, the others want their part
TIP_SLOW = 0.1  # of v_max, below which the tip needs no guard
NEAR = 0.5  # of the influence, within which a link's approach is guarded; farther out v_max can be given up
ABREAST = 0.02  # [m]
OWN_FREE = 0.15  # of v_max, at which a link may come near another of the same arm
STEPS = 60  # of the search for the least change at most
SOFT = 1e-4  # by which a bound yields, of the motion its own multiplier makes
ENOUGH = 1e-6  # [sqrt(W)] that a bound may be passed by, as acceleration times the root of the mass along it
PAIRS = 64  # links near obstacles or links that are guarded at a time


@kernel
def may(bound: float, speed: float, jerk: float) -> float:
    """Return the largest acceleration with which `speed` can still be kept below `bound`."""
    gap = bound - speed
    accel: float = gap / SPEED_HORIZON
    if gap > 0.0:
        accel = min(accel, np.sqrt(2.0 * jerk * gap))
    return accel


@kernel
def may_towards(room: float, speed: float, top: float, braking: float, jerk: float) -> float:
    """Return the largest acceleration towards a limit `room` ahead, at `speed` towards it.

    The bound is min(top, sqrt(2 braking room')), which a joint that brakes follows down to rest; its own slope,
    -braking speed/bound, is fed forward. room' ends where a damper of SPEED_HORIZON still stops short of the limit.
    """
    left = max(0.0, room - 2.0 * SPEED_HORIZON * SPEED_HORIZON * braking)
    curve = np.sqrt(2.0 * braking * left)
    if curve >= top:
        return may(top, speed, jerk)
    slope = braking * min(1.0, max(0.0, speed) / max(curve, SPEED_HORIZON * braking))
    accel: float = may(curve, speed, jerk) - slope
    return accel


@kernel
def joint_bounds(
    A: F64, q: F64, qd: F64, q_min: F64, q_max: F64, qd_max: F64, braking: F64, tau_rate: F64
) -> tuple[F64, F64]:
    """Return the least and largest accelerations (n,) with which every joint can still stop before its limit.

    braking (n,) [rad/s2]; the jerk of joint i is what the torque rates allow it alone, min over k of rate_k/|A_ki|.
    """
    n = qd.shape[0]
    low, high = np.empty(n), np.empty(n)
    for i in range(n):
        jerk = np.inf
        for k in range(n):
            if abs(A[k, i]) * jerk > JERK_SHARE * tau_rate[k]:
                jerk = JERK_SHARE * tau_rate[k] / abs(A[k, i])
        top = SPEED_BAND * qd_max[i]
        high[i] = may_towards(q_max[i] - q[i], qd[i], top, braking[i], jerk)
        low[i] = -may_towards(q[i] - q_min[i], -qd[i], top, braking[i], jerk)
        if low[i] > 0.0:  # it must brake, and is not asked to do so gently
            high[i] = max(high[i], low[i])
        elif high[i] < 0.0:
            low[i] = min(low[i], high[i])
    return low, high


@kernel
def jerk_along(row: F64, mobility: float, tau_rate: F64) -> float:
    """Return the jerk along a row (n,) that a force of the torque rates gives, mobility = row A^-1 row^T [1/kg]."""
    slowest = 1e-9
    for i in range(row.shape[0]):
        slowest = max(slowest, abs(row[i]) / tau_rate[i])
    return JERK_SHARE * mobility / slowest


@kernel
def tip_row(J: F64, Jdqd: F64, A_inv: F64, xd: F64, v_max: float, tau_rate: F64) -> tuple[F64, float]:
    """Return the row (n,) along the tip's velocity xd (3,) and the bound of row qdd that keeps |xd| below v_max [m/s].

    The motion task never asks for more than v_max; a field that shoves the arm may. inf while the tip is slow.
    """
    speed = np.sqrt(xd[0] * xd[0] + xd[1] * xd[1] + xd[2] * xd[2])
    if speed < TIP_SLOW * v_max:
        return np.zeros(J.shape[1]), np.inf
    row = (J[0] * xd[0] + J[1] * xd[1] + J[2] * xd[2]) / speed
    drift = (Jdqd[0] * xd[0] + Jdqd[1] * xd[1] + Jdqd[2] * xd[2]) / speed
    jerk = jerk_along(row, _dot(row, matvec(A_inv, row)), tau_rate)
    return row, may(v_max, speed, jerk) - drift


@kernel
def approach_rows(
    near: I64, link: I64, distances: F64, Jp: F64, own_rho: F64, own_row: F64, dq: F64, A_inv: F64, qd: F64,
    rho0: float, own_stop: float, v_max: float, braking: float, tau_rate: F64,
) -> tuple[F64, F64]:  # fmt: skip
    """Return rows (r, n) along which links come nearer to what they must not touch, and bounds (r,) of row qdd.

    near (K,): slots at hand are >= 0; link (m,); distances (K, >= 4, m): rho [m] and normal of every point, of which
    the nearest of a link count and those within ABREAST of it: a link also turns; Jp (>= m, 3, n). own_rho (L,),
    own_row (L, n), dq: as in `own_field`; every pair that is measured counts, and is slowed before own_stop [m] to what
    its field turns easily, OWN_FREE of v_max [m/s]: that field is thin and steep, and torque that is slewed comes too
    late for a link that enters it fast. Slower than that only touching is prevented: a guard as steep as the field
    would set a folded arm swinging between two pairs. It is the arm's own approach -row qd alone that is bounded, as if
    with braking [m/s2]; what comes towards it is for the field to flee.
    """
    n = qd.shape[0]
    rows, rooms = np.empty((PAIRS, n)), np.empty(PAIRS)
    count = 0
    for k in range(near.shape[0]):
        if near[k] < 0:
            continue
        for l in range(n + 1):
            least = NEAR * rho0 - ABREAST
            for i in range(link.shape[0]):
                if link[i] == l and distances[k, 0, i] < least:
                    least = distances[k, 0, i]
            for j in range(link.shape[0]):
                if link[j] != l or distances[k, 0, j] >= least + ABREAST or count == PAIRS:
                    continue
                for i in range(n):
                    rows[count, i] = 0.0
                    for c in range(3):
                        rows[count, i] -= distances[k, 1 + c, j] * Jp[j, c, i]
                rooms[count] = distances[k, 0, j]
                count += 1
    obstacles = count
    for s in range(own_rho.shape[0]):
        if own_rho[s] < np.inf and count < PAIRS:
            rows[count], rooms[count] = -own_row[s], own_rho[s] + _dot(own_row[s], dq)
            count += 1
    bounds = np.empty(count)
    for r in range(count):
        speed, jerk = _dot(rows[r], qd), jerk_along(rows[r], _dot(rows[r], matvec(A_inv, rows[r])), tau_rate)
        if r < obstacles:
            bounds[r] = may_towards(rooms[r], speed, np.inf, braking, jerk)
        else:
            fast = may_towards(rooms[r] - own_stop, speed, np.inf, braking, jerk)
            bounds[r] = max(fast, may_towards(rooms[r], speed, OWN_FREE * v_max, braking, jerk))
    return rows[:count], bounds


@kernel
def _dot(a: F64, b: F64) -> float:
    s = 0.0
    for i in range(a.shape[0]):
        s += a[i] * b[i]
    return s


@kernel
def guard(A: F64, A_inv: F64, tau: F64, low: F64, high: F64, rows: F64, bounds: F64) -> tuple[F64, bool]:
    """Return the torque (n,) [Nm] whose addition keeps low <= qdd <= high and rows qdd <= bounds, and whether any acts.

    Least change in A's norm: min (qdd - A^-1 tau)^T A (qdd - A^-1 tau). Where not all of them can be kept the joints'
    bounds are, and the rows that came last are not.
    """
    n = low.shape[0]
    wanted = matvec(A_inv, tau)
    acts = False
    for i in range(n):
        acts |= wanted[i] > high[i] or wanted[i] < low[i]
    for r in range(rows.shape[0]):
        acts |= _dot(rows[r], wanted) > bounds[r]
    if not acts:
        return np.zeros(n), False
    C, b = np.zeros((2 * n + rows.shape[0], n)), np.empty(2 * n + rows.shape[0])
    for i in range(n):
        C[i, i], b[i], C[n + i, i], b[n + i] = 1.0, high[i], -1.0, -low[i]
    C[2 * n :], b[2 * n :] = rows, bounds
    qdd = least_change(A_inv, wanted, C, b)
    for i in range(n):
        qdd[i] = min(max(qdd[i], low[i]), high[i])
    return matvec(A, qdd - wanted), True


@kernel
def least_change(A_inv: F64, wanted: F64, C: F64, b: F64) -> F64:
    """Return the x (n,) nearest to `wanted` in the norm of A with C x <= b (Goldfarb and Idnani, dual active set).

    From the unbounded best, the bound that is passed most becomes active; a multiplier that would turn negative on the
    way gives its bound up. Every bound yields by SOFT of what its multiplier moves along it: bounds that contradict
    each other, as obstacles from two sides may, find a compromise then, and those that say the same no singular matrix.
    """
    n, count = wanted.shape[0], b.shape[0]
    x = wanted.copy()
    M, size = np.empty((count, n)), np.empty(count)
    for c in range(count):
        M[c] = matvec(A_inv, C[c])
        size[c] = np.sqrt(max(_dot(C[c], M[c]), 1e-12))
    active, held, force = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count)
    k, fresh, pull = 0, -1, 0.0  # active bounds; the one being added and its multiplier
    for _ in range(STEPS):
        if fresh < 0:
            worst = ENOUGH
            for c in range(count):
                if held[c] == 0 and (_dot(C[c], x) - b[c]) / size[c] > worst:
                    worst, fresh, pull = (_dot(C[c], x) - b[c]) / size[c], c, 0.0
            if fresh < 0:
                break
        share = _shares(C, M, size, active, k, fresh)
        z = M[fresh].copy()
        for a in range(k):
            z -= share[a] * M[active[a]]
        give = SOFT * size[fresh] * size[fresh]
        step, drop = (_dot(C[fresh], x) - b[fresh] - give * pull) / (_dot(C[fresh], z) + give), -1
        for a in range(k):
            if force[a] < step * share[a]:
                step, drop = force[a] / share[a], a
        x -= step * z
        pull += step
        for a in range(k):
            force[a] -= step * share[a]
        if drop < 0:
            active[k], force[k], held[fresh] = fresh, pull, 1
            k, fresh = k + 1, -1
        else:
            held[active[drop]] = 0
            for a in range(drop, k - 1):
                active[a], force[a] = active[a + 1], force[a + 1]
            k -= 1
    return x


@kernel
def _shares(C: F64, M: F64, size: F64, active: I64, k: int, fresh: int) -> F64:
    """Return the solution (k,) of (N A^-1 N^T + soft) r = N A^-1 c, N the k active rows, c the fresh one (Cholesky)."""
    L, r = np.empty((k, k)), np.empty(k)
    for i in range(k):
        for j in range(i + 1):
            s = _dot(C[active[i]], M[active[j]])
            if i == j:
                s += SOFT * size[active[i]] * size[active[i]]
            for l in range(j):
                s -= L[i, l] * L[j, l]
            L[i, j] = np.sqrt(s) if i == j else s / L[j, j]
        s = _dot(C[active[i]], M[fresh])
        for l in range(i):
            s -= L[i, l] * r[l]
        r[i] = s / L[i, i]
    for i in range(k - 1, -1, -1):
        s = r[i]
        for l in range(i + 1, k):
            s -= L[l, i] * r[l]
        r[i] = s / L[i, i]
    return r


@kernel
def guarded(
    A: F64, A_inv: F64, tau: F64, load: F64, tau_max: F64, low: F64, high: F64, rows: F64, bounds: F64
) -> tuple[F64, bool]:
    """Return tau (n,) [Nm], all torque but the load (n,), as it may be sent, and whether any guard acted.

    What the motors lack is taken from what was wanted first, so that braking keeps its strength.
    """
    added, acts = guard(A, A_inv, tau, low, high, rows, bounds)
    share = fitting(tau + added, load, tau_max)
    if share < 1.0:
        tau = share * tau
        added, more = guard(A, A_inv, tau, low, high, rows, bounds)
        acts = acts or more
    out = tau + added
    return fitting(out, load, tau_max) * out, acts


@kernel
def fitting(tau: F64, load: F64, tau_max: F64) -> float:
    """Return the share in (0, 1] of tau (n,) [Nm] that every joint has room for beside its load, at least LEAST_SHARE.

    A torque that asks for more than the motors have must lose strength, not direction: clamped joint by joint it would
    push somewhere else.
    """
    share = 1.0
    for i in range(tau.shape[0]):
        spare = tau_max[i] - load[i] if tau[i] > 0.0 else tau_max[i] + load[i]
        room = max(min(spare, tau_max[i]), LEAST_SHARE * tau_max[i])
        if abs(tau[i]) * share > room:
            share = room / abs(tau[i])
    return share


@kernel
def yielding(drive: F64, keep: F64, tau_max: F64) -> float:
    """Return the largest share in [0, 1] of drive (n,) [Nm] with which |keep + share drive| <= tau_max at every joint.

    keep (n,) [Nm], load included; a joint that keep alone takes beyond its bound leaves nothing that goes further.
    """
    share = 1.0
    for i in range(drive.shape[0]):
        if drive[i] != 0.0 and abs(keep[i] + share * drive[i]) > tau_max[i]:
            room = tau_max[i] - keep[i] if drive[i] > 0.0 else -tau_max[i] - keep[i]
            share = min(share, max(0.0, room / drive[i]))
    return share
