"""The paper's inertia of a point, whole: Lambda = B^-1 of its mobility B = J A^-1 J^T (3, 3), bounded (Khatib 1986).

    Lambda = sum over k of v_k v_k^T f(s_k),    B v_k = s_k v_k,    f(s) = 1/s for s >= b0, else s/b0^2,   b0 = 1/m_max

A point near the base, or one of a stretched arm, does not move in every direction: there s_k is nothing and 1/s_k no
number. So the spectrum has the floor that the scalar mass along a normal has. f has no step, is m_max at most, and goes
to zero with s: a direction in which a point cannot move gets no force. Then, along any unit vector n,

    |Lambda n| <= m_max,    0 <= n^T B Lambda n <= 1:

the point's own acceleration is along n wherever it moves freely, and never against it.
"""

import math

from rtctl.kernel import leaf_kernel
from rtctl.types import F64

SWEEPS = 8  # of rotations: convergence is quadratic, four do for numbers of 16 digits
_B = 6  # first of the rows xx yy zz xy xz yz of Field.points


@leaf_kernel
def bounded_mass(s: float, floor: float) -> float:
    """Return f(s) [kg] of a mobility s [1/kg], bounded below `floor` [1/kg]."""
    if s >= floor:
        return 1.0 / s
    return max(s, 0.0) / (floor * floor)


@leaf_kernel
def _turn(pp: float, qq: float, pq: float) -> tuple[float, float, float]:
    """Return (cosine, sine, tangent) of the rotation in the plane of p and q that leaves no pq."""
    if pq == 0.0:
        return 1.0, 0.0, 0.0
    theta = 0.5 * (qq - pp) / pq
    if abs(theta) > 1e150:  # its square would be no number
        t = 0.5 / theta
    else:
        t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(1.0 + theta * theta))
    c = 1.0 / math.sqrt(1.0 + t * t)
    return c, t * c, t


@leaf_kernel
def times_inertia(X: F64, j: int, x: float, y: float, z: float, floor: float) -> tuple[float, float, float]:
    """Return Lambda (x, y, z) [kg] of point j, whose mobility is in six rows of X (`Field.points`); floor b0 [1/kg].

    Cyclic Jacobi in numbers alone: kernels of a tick make no arrays.
    """
    a, b, c = X[_B, j], X[_B + 1, j], X[_B + 2, j]
    d, e, f = X[_B + 3, j], X[_B + 4, j], X[_B + 5, j]  # xy xz yz
    ax, ay, az, bx, by, bz, cx, cy, cz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0  # eigenvectors
    for _ in range(SWEEPS):
        if d == 0.0 and e == 0.0 and f == 0.0:
            break
        co, si, t = _turn(a, b, d)
        a, b, d, e, f = a - t * d, b + t * d, 0.0, co * e - si * f, si * e + co * f
        ax, bx = co * ax - si * bx, si * ax + co * bx
        ay, by = co * ay - si * by, si * ay + co * by
        az, bz = co * az - si * bz, si * az + co * bz
        co, si, t = _turn(a, c, e)
        a, c, e, d, f = a - t * e, c + t * e, 0.0, co * d - si * f, si * d + co * f
        ax, cx = co * ax - si * cx, si * ax + co * cx
        ay, cy = co * ay - si * cy, si * ay + co * cy
        az, cz = co * az - si * cz, si * az + co * cz
        co, si, t = _turn(b, c, f)
        b, c, f, d, e = b - t * f, c + t * f, 0.0, co * d - si * e, si * d + co * e
        bx, cx = co * bx - si * cx, si * bx + co * cx
        by, cy = co * by - si * cy, si * by + co * cy
        bz, cz = co * bz - si * cz, si * bz + co * cz
    u = (ax * x + ay * y + az * z) * bounded_mass(a, floor)
    v = (bx * x + by * y + bz * z) * bounded_mass(b, floor)
    w = (cx * x + cy * y + cz * z) * bounded_mass(c, floor)
    return ax * u + bx * v + cx * w, ay * u + by * v + cy * w, az * u + bz * v + cz * w
