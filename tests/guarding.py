"""Calls of the guards as the law makes them, and another solver of what they solve."""

import numpy as np
import quadprog

from rtctl.arm.bounds import Bounds
from rtctl.arm.field import Field, MovingPoints, field_buffers
from rtctl.arm.guards import Inertia, Motors, hold_back, let_pass
from rtctl.arm.least_change import rows_in, rows_sizes
from rtctl.arm.nearby import Nearby, look_near, nearby_in
from rtctl.types import F64

SOFTNESS = 1e-4  # of the motion along a row that its own multiplier makes, by which its bound yields


def bounds_of(low: F64, high: F64, rows: F64 | None = None, most: F64 | None = None) -> Bounds:
    rows = np.zeros((0, len(low))) if rows is None else rows
    return Bounds(low, high, rows, np.zeros(0) if most is None else most)


def nearby_of(points: MovingPoints, seen: Field, qd: F64, share: float, braking: float, rate: F64) -> Nearby:
    """Return the points within a share of the influence of obstacles, with their cheap bounds."""
    room, m, n = len(seen.leader) * len(points.radius), len(points.radius), len(qd)
    whole, real = np.zeros(3 * room + 1, np.int64), np.zeros(room + 4 * m + n + 1)
    views = getattr(nearby_in, "py_func", nearby_in)  # a leaf kernel gives arrays to leaf kernels alone
    whole[-1] = look_near(views(whole, real, points, seen, qd, braking, rate), share)
    near: Nearby = views(whole, real, points, seen, qd, braking, rate)
    return near


def nothing_near(n: int) -> Nearby:
    """Return what is near n joints that move no point."""
    points = MovingPoints(
        np.zeros((0, 3)), np.zeros((0, 3, n)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0, np.int64)
    )
    return nearby_of(points, field_buffers(0, 0, n), np.zeros(n), 0.5, 5.0, np.ones(n))


def sent_of(
    inertia: Inertia, motors: Motors, tau: F64, bounds: Bounds, near: Nearby, start: F64 | None = None
) -> tuple[F64, bool]:
    """Return what the guards let pass of tau (n,) [Nm], and whether any acts, as the law asks them."""
    n, work = len(tau), np.zeros((2, len(tau)))
    if let_pass(inertia, motors, tau, bounds, near, work):
        return work[0], False
    real, whole = rows_sizes(n)
    left = np.full(real, 3.0), np.full(whole, 7)  # as the tick before may have left it
    rows = getattr(rows_in, "py_func", rows_in)(*left, n)
    rows.x[0] = 0.0 if start is None else start
    acts = hold_back(rows, inertia, motors, tau, bounds, near, np.ones(2 * n + len(bounds.most), np.int64), work)
    return work[0], acts


def guard(
    A: F64, A_inv: F64, tau: F64, low: F64, high: F64, rows: F64, most: F64, start: F64 | None = None
) -> tuple[F64, bool]:
    """Return what the guards add (n,) [Nm] to a torque that the motors always have, and whether they act."""
    n = len(tau)
    motors, bounds = Motors(np.zeros(n), np.full(n, np.inf)), bounds_of(low, high, rows, most)
    out, acts = sent_of(Inertia(A, A_inv), motors, tau, bounds, nothing_near(n), start)
    return out - tau, acts


def nearest(A: F64, wanted: F64, C: F64, b: F64) -> F64:
    """Return argmin (x - w)^T A (x - w)/2 + sum s^2/(2 softness c A^-1 c^T) with C x - s <= b, by another solver."""
    n, r = C.shape[1], len(b)
    size = np.einsum("ci,ij,cj->c", C, np.linalg.inv(A), C)
    G = np.zeros((n + r, n + r))
    G[:n, :n], G[n:, n:] = A, np.diag(1.0 / (SOFTNESS * size))
    scale = 1.0 / np.sqrt(np.diag(G))  # or its own test for singular matrices refuses
    found = quadprog.solve_qp(
        G * scale * scale[:, None],
        scale * np.append(A @ wanted, np.zeros(r)),
        (np.hstack((-C, np.eye(r))) * scale).T,
        -b,
    )[0]
    x: F64 = scale[:n] * found[:n]
    return x
