"""Guards on the law's torque: nothing is driven to where it could not be held any more.

They bound accelerations, qdd = A^-1 tau with tau all torque but gravity, Coriolis and viscous friction: of every joint,
by its speed and by what still stops it before its limit; of the tip, by v_max; and of every link near an obstacle or
another link, by what still stops its own approach before they touch (`bounds`, `nearby`).

Where a bound is passed, the accelerations that come nearest in A's norm and keep all of them take the place of those
wanted (Gauss: as if mechanical stops held the arm there; `least_change`). Cutting a joint's own acceleration alone
would not do: what is left of a push away from an obstacle may then be a push towards it. The search goes on until no
bound is passed, so its answer is that of all rows, though few are made.
"""

import math
from typing import NamedTuple

from rtctl.arm import least_change
from rtctl.arm.bounds import Bounds, approach_bound, jerk_along
from rtctl.arm.field import NORMAL, RHO
from rtctl.arm.least_change import COUNT, ROWS_MAX, STEPS, STEPS_MAX, Rows, add_row, dot, mobility
from rtctl.arm.nearby import CHEAP, EXACT, KEPT, MADE, Nearby, accelerate, towards
from rtctl.arm.scaling import scale_to_limits
from rtctl.kernel import leaf_kernel
from rtctl.types import F64, I64


class Inertia(NamedTuple):
    """The joint-space kinetic energy matrix."""

    A: F64  # (n, n) [kg m2 or kg]
    A_inv: F64  # (n, n)


class Motors(NamedTuple):
    """What the motors can give."""

    load: F64  # (n,) [Nm] that carries the arm
    tau_max: F64  # (n,) [Nm] that may be sent


@leaf_kernel
def passed(x: F64, bounds: Bounds, near: Nearby) -> bool:
    """Return whether accelerations x (n,) pass any bound, the cheap ones of candidates included."""
    for i in range(x.shape[0]):
        if x[i] > bounds.high[i] or x[i] < bounds.low[i]:
            return True
    for r in range(bounds.most.shape[0]):
        if bounds.most[r] < math.inf and dot(bounds.rows, r, x) > bounds.most[r]:
            return True
    if near.size > 0:
        accelerate(x, near)
    for c in range(near.size):
        if towards(c, near) > near.found.most[c]:
            return True
    return False


@leaf_kernel
def _make_candidate(s: Rows, c: int, near: Nearby, A_inv: F64) -> None:
    """Write the row of a candidate, -n^T Jp, behind the last one and make its bound exact; count the row if passed.

    Passed by the accelerations that `accelerate` left.
    """
    n, r, found = A_inv.shape[0], s.numbers[COUNT], near.found
    k, j = found.place[0, c], found.place[1, c]
    for i in range(n):
        t = 0.0
        for d in range(3):
            t -= near.seen.pairs[k, NORMAL + d, j] * near.points.Jp[j, d, i]
        s.C[r, i] = t
    along = mobility(A_inv, s.C, r)
    if found.place[2, c] == CHEAP:
        jerk, speed = jerk_along(s.C, r, along, near.tau_rate), dot(s.C, r, near.qd)
        room = near.seen.pairs[k, RHO, j] - near.seen.rooms[k, KEPT]
        found.most[c] = approach_bound(room, speed, math.inf, near.braking, jerk)
        found.place[2, c] = EXACT
    if towards(c, near) > found.most[c]:
        add_row(s, found.most[c], along)
        found.place[2, c] = MADE


@leaf_kernel
def _collect(s: Rows, side: int, bounds: Bounds, made: I64, near: Nearby, A_inv: F64) -> None:
    """Add the rows that x of that side passes and that are not at hand; made (2n + r,): 1 for those that are."""
    x, n = s.x[side], A_inv.shape[0]
    for i in range(2 * n):
        over = x[i] - bounds.high[i] if i < n else bounds.low[i - n] - x[i - n]
        if over > 0.0 and made[i] == 0 and s.numbers[COUNT] < ROWS_MAX:
            for k in range(n):
                s.C[s.numbers[COUNT], k] = 0.0
            s.C[s.numbers[COUNT], i % n] = 1.0 if i < n else -1.0
            add_row(s, bounds.high[i] if i < n else -bounds.low[i - n], A_inv[i % n, i % n])
            made[i] = 1
    for r in range(bounds.most.shape[0]):
        if bounds.most[r] == math.inf or made[2 * n + r] != 0 or s.numbers[COUNT] == ROWS_MAX:
            continue
        if dot(bounds.rows, r, x) > bounds.most[r]:
            for k in range(n):
                s.C[s.numbers[COUNT], k] = bounds.rows[r, k]
            add_row(s, bounds.most[r], mobility(A_inv, bounds.rows, r))
            made[2 * n + r] = 1
    if near.size > 0:
        accelerate(x, near)
    for c in range(near.size):
        if near.found.place[2, c] != MADE and towards(c, near) > near.found.most[c] and s.numbers[COUNT] < ROWS_MAX:
            _make_candidate(s, c, near, A_inv)


@leaf_kernel
def nearest_kept(s: Rows, inertia: Inertia, wanted: F64, bounds: Bounds, made: I64, near: Nearby) -> None:
    """Move x[0] (n,), anything, to what is nearest to `wanted` (n,) in A's norm and keeps all bounds."""
    s.numbers[STEPS] = 0
    least_change.measure(s, 0)
    _collect(s, 0, bounds, made, near, inertia.A_inv)
    while s.numbers[STEPS] < STEPS_MAX:
        s.numbers[STEPS] += 1
        least_change.newton_step(s, inertia.A, wanted)
        least_change.measure(s, 1)
        _collect(s, 1, bounds, made, near, inertia.A_inv)
        if least_change.settled(s):
            for i in range(wanted.shape[0]):
                s.x[0, i] = s.x[1, i]
            break
        least_change.take_step(s, inertia.A, wanted)
    for i in range(wanted.shape[0]):
        s.x[0, i] = min(max(s.x[0, i], bounds.low[i]), bounds.high[i])


@leaf_kernel
def _product(M: F64, v: F64, out: F64) -> None:
    for i in range(v.shape[0]):
        out[i] = dot(M, i, v)


@leaf_kernel
def let_pass(inertia: Inertia, motors: Motors, tau: F64, bounds: Bounds, near: Nearby, work: F64) -> bool:
    """Return whether tau (n,) [Nm], all torque but the load, passes no bound; then work[0] is what may be sent of it.

    work (2, n). What the motors lack is taken from all alike; less of it must pass no bound either.
    """
    _product(inertia.A_inv, tau, work[0])
    if passed(work[0], bounds, near):
        return False
    share = scale_to_limits(tau, motors.load, motors.tau_max)
    for i in range(tau.shape[0]):
        work[1, i] = share * tau[i]
    if share < 1.0:
        _product(inertia.A_inv, work[1], work[0])
        if passed(work[0], bounds, near):
            return False
        share = scale_to_limits(work[1], motors.load, motors.tau_max)
    for i in range(tau.shape[0]):
        work[0, i] = share * work[1, i]
    return True


@leaf_kernel
def hold_back(
    s: Rows, inertia: Inertia, motors: Motors, tau: F64, bounds: Bounds, near: Nearby, made: I64, work: F64
) -> bool:
    """Write what of tau (n,) [Nm] may be sent into work[0] (2, n), and return whether any guard acted.

    Least change in A's norm: min (qdd - A^-1 tau)^T A (qdd - A^-1 tau) with low <= qdd <= high, rows qdd <= most, and
    the same for every point near an obstacle. Where not all can be kept the joints' bounds are.
    What the motors lack is taken from what was wanted first, so that braking keeps its strength.
    The search begins at s.x[0] (n,) [rad/s2], accelerations near the answer as those of the tick before are: what they
    pass it will pass. made (2n + r,): work.
    """
    n, acts, sent, wanted, share = tau.shape[0], False, s.sent, s.wanted, 1.0
    s.numbers[COUNT] = 0
    for r in range(made.shape[0]):
        made[r] = 0
    for i in range(n):
        if not math.isfinite(s.x[0, i]):  # of a tick that was not a number; the next may be one again
            s.x[0, i] = 0.0
    for attempt in range(2):
        for i in range(n):
            sent[i] = share * tau[i]
        _product(inertia.A_inv, sent, wanted)
        nearest_kept(s, inertia, wanted, bounds, made, near)
        for i in range(n):
            acts |= s.x[0, i] != wanted[i]
            wanted[i] = s.x[0, i] - wanted[i]
        _product(inertia.A, wanted, work[0])
        for i in range(n):
            work[0, i] = sent[i] + work[0, i]
        share = scale_to_limits(work[0], motors.load, motors.tau_max)
        if attempt == 1 or share == 1.0:
            break
    for i in range(n):
        work[0, i] *= share
    return acts
