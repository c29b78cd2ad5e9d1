"""The least change of accelerations that keeps bounds: a quadratic program in the norm of the kinetic energy.

    min over x of (x - w)^T A (x - w)   with   C x <= b

Gauss' principle of least constraint, w the accelerations without any bound. Every bound yields by SOFTNESS of what its
multiplier moves along it: bounds that contradict each other, as obstacles from two sides may, find a compromise then,
and those that say the same make nothing singular. With that the program is, exactly,

    min over x of (x - w)^T A (x - w) / 2 + sum over rows c of max(0, c x - b)^2 / (2 softness c A^-1 c^T),

convex and quadratic between the bounds: Newton's step from the rows that are passed, shortened by an exact line search,
ends at the solution after a few steps, however many rows hold there. A step solves n equations, not one for each row.
Rows need not be there at once: more may be added between two steps.
"""

import math
from typing import NamedTuple

from rtctl.kernel import leaf_kernel
from rtctl.types import F64, I64

ROWS_MAX = 512  # at a time; a crowd of 64 obstacles that press from all sides makes 150
STEPS_MAX = 30  # of one search: a bound on its time, three times what such a crowd takes
SOFTNESS = 1e-4  # of the motion that its own multiplier makes along a row, by which its bound yields
TURNED = 1e-10  # of the slope at the start of a step, below which its end is no farther than the lowest point
_MOBILITY_MIN = 1e-12  # [1/kg] of a row that nothing moves along
COUNT, STEPS = 0, 1  # places in Rows.numbers


class Rows(NamedTuple):
    """The rows at hand, R = ROWS_MAX at most, and work arrays."""

    C: F64  # (R, n)
    bound: F64  # (R,)
    stiffness: F64  # (R,) 1/(softness c A^-1 c^T)
    over: F64  # (2, R) c x - b at the last x, and after the step
    H: F64  # (n, n) second derivative, then its Cholesky factor
    x: F64  # (2, n) the last x, and after the step
    wanted: F64  # (n,) work of the caller, as is
    sent: F64  # (n,)
    numbers: I64  # (2,) rows, steps done


def rows_sizes(n: int) -> tuple[int, int]:
    """Return how many real and whole numbers the arrays of `rows_in` are, for n joints."""
    return ROWS_MAX * (n + 4) + n * n + 4 * n, 2


@leaf_kernel
def rows_in(real: F64, whole: I64, n: int) -> Rows:
    """Return room for ROWS_MAX rows of n joints in two flat arrays; see `rows_sizes`."""
    r = ROWS_MAX
    a = r * n
    b = a + 4 * r
    c = b + n * n
    return Rows(
        real[:a].reshape(r, n),
        real[a : a + r],
        real[a + r : a + 2 * r],
        real[a + 2 * r : b].reshape(2, r),
        real[b:c].reshape(n, n),
        real[c : c + 2 * n].reshape(2, n),
        real[c + 2 * n : c + 3 * n],
        real[c + 3 * n : c + 4 * n],
        whole[:2],
    )


@leaf_kernel
def dot(P: F64, i: int, v: F64) -> float:
    """Return row i of P (r, >= n) times v (n,)."""
    s = 0.0
    for k in range(v.shape[0]):
        s += P[i, k] * v[k]
    return s


@leaf_kernel
def mobility(A_inv: F64, rows: F64, r: int) -> float:
    """Return row r of `rows` (., n) times A^-1 times its transpose [1/kg]."""
    s = 0.0
    for i in range(A_inv.shape[0]):
        t = 0.0
        for k in range(A_inv.shape[0]):
            t += A_inv[i, k] * rows[r, k]
        s += rows[r, i] * t
    return s


@leaf_kernel
def add_row(s: Rows, bound: float, along: float) -> None:
    """Count the row that was written behind the last one; along [1/kg] is its mobility."""
    r = s.numbers[COUNT]
    s.bound[r], s.stiffness[r] = bound, 1.0 / (SOFTNESS * max(along, _MOBILITY_MIN))
    for side in range(2):
        s.over[side, r] = dot(s.C, r, s.x[side]) - bound
    s.numbers[COUNT] = r + 1


@leaf_kernel
def measure(s: Rows, side: int) -> None:
    """Measure by how much x passes the rows: the last one, side 0, or the one after the step, side 1."""
    for r in range(s.numbers[COUNT]):
        s.over[side, r] = dot(s.C, r, s.x[side]) - s.bound[r]


@leaf_kernel
def newton_step(s: Rows, A: F64, wanted: F64) -> None:
    """Write what is best for the rows that the last x passes, as if they were equations, into x[1].

    (A + C^T K C) (x - w) = C^T K (b - C w), K the stiffness of the rows passed; by Cholesky.
    """
    n = wanted.shape[0]
    for i in range(n):
        s.x[1, i] = 0.0
        for j in range(i + 1):
            s.H[i, j] = A[i, j]
    for r in range(s.numbers[COUNT]):
        if s.over[0, r] > 0.0:
            pull = s.stiffness[r] * (s.bound[r] - dot(s.C, r, wanted))
            for i in range(n):
                s.x[1, i] += pull * s.C[r, i]
                k = s.stiffness[r] * s.C[r, i]
                for j in range(i + 1):
                    s.H[i, j] += k * s.C[r, j]
    for i in range(n):
        for j in range(i):
            t = s.H[i, j]
            for l in range(j):
                t -= s.H[i, l] * s.H[j, l]
            s.H[i, j] = t * s.H[j, j]  # the diagonal holds reciprocals
        t = s.H[i, i]
        for l in range(i):
            t -= s.H[i, l] * s.H[i, l]
        s.H[i, i] = 1.0 / math.sqrt(t)
        t = s.x[1, i]
        for l in range(i):
            t -= s.H[i, l] * s.x[1, l]
        s.x[1, i] = t * s.H[i, i]
    for i in range(n - 1, -1, -1):
        t = s.x[1, i]
        for l in range(i + 1, n):
            t -= s.H[l, i] * s.x[1, l]
        s.x[1, i] = t * s.H[i, i]
    for i in range(n):
        s.x[1, i] += wanted[i]


@leaf_kernel
def settled(s: Rows) -> bool:
    """Return whether the rows that are passed after the step are those that were passed before it."""
    for r in range(s.numbers[COUNT]):
        if (s.over[0, r] > 0.0) != (s.over[1, r] > 0.0):
            return False
    return True


@leaf_kernel
def _slope(s: Rows, t: float, linear: float, quadratic: float) -> tuple[float, float]:
    """Return the first and second derivative along the step at t of it."""
    first, second = linear + t * quadratic, quadratic
    for r in range(s.numbers[COUNT]):
        change = s.over[1, r] - s.over[0, r]
        over = s.over[0, r] + t * change
        if over > 0.0:
            first += s.stiffness[r] * over * change
            second += s.stiffness[r] * change * change
    return first, second


@leaf_kernel
def take_step(s: Rows, A: F64, wanted: F64) -> None:
    """Move x[0] along the step to its lowest point: the slope grows and has corners, so Newton's root is bracketed."""
    n = wanted.shape[0]
    linear = quadratic = 0.0
    for i in range(n):
        a = b = 0.0
        for k in range(n):
            a += A[i, k] * (s.x[0, k] - wanted[k])
            b += A[i, k] * (s.x[1, k] - s.x[0, k])
        linear += (s.x[1, i] - s.x[0, i]) * a
        quadratic += (s.x[1, i] - s.x[0, i]) * b
    start, _ = _slope(s, 0.0, linear, quadratic)
    low, high, t = 0.0, 1.0, 1.0
    first, second = _slope(s, 1.0, linear, quadratic)
    if first > TURNED * abs(start):
        for _ in range(STEPS_MAX):
            if first > 0.0:
                high = t
            else:
                low = t
            t -= first / second
            if not low < t < high:
                t = 0.5 * (low + high)
            first, second = _slope(s, t, linear, quadratic)
            if abs(first) <= TURNED * abs(start):
                break
    for i in range(n):
        s.x[0, i] += t * (s.x[1, i] - s.x[0, i])
    measure(s, 0)
