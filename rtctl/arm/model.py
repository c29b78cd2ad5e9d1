"""The model: every term of the law at one state, made of Pinocchio's results by one compiled kernel.

Fresh arrays, no BLAS, equal bits for equal inputs.
"""

from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64


class Model(NamedTuple):
    """What the law needs to know of the arm at one configuration; world frame, tip = the configured frame.

    m PSPs; L pairs of links that are watched for self-collision.
    """

    q: F64  # (n,) [rad or m] where it was evaluated
    qd: F64  # (n,)
    A: F64  # (n, n) joint-space kinetic energy matrix, armature included
    A_inv: F64  # (n, n)
    h: F64  # (n,) [Nm] Coriolis and centrifugal torque, gravity excluded
    g: F64  # (n,) [Nm] gravity torque
    x: F64  # (3,) [m] tip position
    R: F64  # (3, 3) tip orientation
    J: F64  # (6, n) tip Jacobian, rows 0-2 linear, 3-5 angular
    Jdqd: F64  # (6,) [m/s2, rad/s2] its velocity product: the tip's acceleration at zero qdd
    P: F64  # (m, 3) [m]
    Jp: F64  # (m, 3, n)
    B: F64  # (m, 3, 3) [1/kg] mobility of a PSP, Jp A^-1 Jp^T
    Lambda_inv: F64  # (6, 6) J A^-1 J^T
    own_rho: F64  # (L,) [m] between links, inf when far
    own_row: F64  # (L, n) d own_rho/d q


@kernel
def spd_inverse(A: F64) -> F64:
    """Return the inverse of a symmetric positive definite matrix by Cholesky, A = L L^T; NaN where A is not."""
    n = A.shape[0]
    L = np.zeros((n, n))  # strictly lower part of L
    X = np.zeros((n, n))  # L^-1
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= L[j, k] * L[j, k]
        pivot = np.sqrt(d) if d > 0.0 else np.nan
        X[j, j] = 1.0 / pivot
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / pivot
    for j in range(n):
        for i in range(j + 1, n):
            s = 0.0
            for k in range(j, i):
                s -= L[i, k] * X[k, j]
            X[i, j] = s * X[i, i]
    inverse = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for k in range(i, n):
                s += X[k, i] * X[k, j]
            inverse[i, j] = s
            inverse[j, i] = s
    return inverse


@kernel
def place_points(Rj: F64, tj: F64, link: I64, local: F64, P: F64) -> None:
    """Write the world positions of points fixed in links to P."""
    for i in range(link.shape[0]):
        k = link[i]
        for r in range(3):
            P[i, r] = tj[k, r] + Rj[k, r, 0] * local[i, 0] + Rj[k, r, 1] * local[i, 1] + Rj[k, r, 2] * local[i, 2]


@kernel
def _point_jacobians(Jw: F64, iv: I64, chain: B1, link: I64, P: F64, Jp: F64) -> None:
    """Write the Jacobians of points: column k is v_k + w_k x p of the joint's twist at the world origin."""
    for i in range(link.shape[0]):
        px, py, pz = P[i, 0], P[i, 1], P[i, 2]
        for k in range(iv.shape[0]):
            if chain[link[i], k]:
                c = iv[k]
                Jp[i, 0, k] = Jw[0, c] + Jw[4, c] * pz - Jw[5, c] * py
                Jp[i, 1, k] = Jw[1, c] + Jw[5, c] * px - Jw[3, c] * pz
                Jp[i, 2, k] = Jw[2, c] + Jw[3, c] * py - Jw[4, c] * px


@kernel
def _quadratic(J: F64, A_inv: F64, used: int, row: F64, out: F64) -> None:
    """Write J A^-1 J^T, symmetric to the bit, to out (d, d); columns of J (d, n) from `used` on are zero.

    row (n,): scratch.
    """
    d = J.shape[0]
    for r in range(d):
        for k in range(used):
            row[k] = 0.0
        for i in range(used):
            for k in range(used):
                row[k] += J[r, i] * A_inv[i, k]
        for s in range(r + 1):
            total = 0.0
            for k in range(used):
                total += row[k] * J[s, k]
            out[r, s] = total
            out[s, r] = total


@kernel
def _used(chain: B1, link: int) -> int:
    """Return 1 + the last joint that moves a link, 0 for the base."""
    for k in range(chain.shape[1] - 1, -1, -1):
        if chain[link, k]:
            return k + 1
    return 0


@kernel
def _tip(Jw: F64, dJw: F64, iv: I64, chain: B1, tip: int, x: F64, qd: F64) -> tuple[F64, F64]:
    """Return the tip's Jacobian and velocity product from twists and spatial accelerations at the world origin.

    The point's acceleration is a + alpha x p + omega x v: the spatial one lacks the last term.
    """
    n = iv.shape[0]
    J = np.zeros((6, n))
    v = np.zeros(6)
    a = np.zeros(6)
    for k in range(n):
        if chain[tip, k]:
            c = iv[k]
            J[0, k] = Jw[0, c] + Jw[4, c] * x[2] - Jw[5, c] * x[1]
            J[1, k] = Jw[1, c] + Jw[5, c] * x[0] - Jw[3, c] * x[2]
            J[2, k] = Jw[2, c] + Jw[3, c] * x[1] - Jw[4, c] * x[0]
            for r in range(3, 6):
                J[r, k] = Jw[r, c]
            for r in range(6):
                v[r] += J[r, k] * qd[k]
                a[r] += dJw[r, c] * qd[k]
    Jdqd = a.copy()
    Jdqd[0] += a[4] * x[2] - a[5] * x[1] + v[4] * v[2] - v[5] * v[1]
    Jdqd[1] += a[5] * x[0] - a[3] * x[2] + v[5] * v[0] - v[3] * v[2]
    Jdqd[2] += a[3] * x[1] - a[4] * x[0] + v[3] * v[1] - v[4] * v[0]
    return J, Jdqd


class Terms(NamedTuple):
    """Pinocchio's results, as views of its own memory: what it computes next stands in them."""

    M: F64  # (nv, nv) joint-space inertia
    nle: F64  # (nv,) Coriolis, centrifugal and gravity torque
    g: F64  # (nv,) gravity torque
    J: F64  # (6, nv) joint twists at the world origin
    dJ: F64  # (6, nv) their time derivative
    R: F64  # (joints, 3, 3) placements
    t: F64  # (joints, 3) [m]


class Skeleton(NamedTuple):
    """How the configured joints and links lie in Pinocchio's arrays; link 0 is the base, i what joint i-1 carries."""

    iv: I64  # (n,) index of each joint's velocity
    joint: I64  # (n + 1,) Pinocchio's joint that carries each link
    chain: B1  # (n + 1, n) [link, joint]: the joint moves the link
    tip: int  # link of the tip
    tip_R: F64  # (3, 3) the tip's frame in that link
    tip_t: F64  # (3,) [m]


@kernel
def placements_in(R: F64, t: F64, joint: I64) -> tuple[F64, F64]:
    """Return the links' placements (n + 1, 3, 3), (n + 1, 3) [m]."""
    Rj, tj = np.empty((joint.shape[0], 3, 3)), np.empty((joint.shape[0], 3))
    for k in range(joint.shape[0]):
        for i in range(3):
            tj[k, i] = t[joint[k], i]
            for j in range(3):
                Rj[k, i, j] = R[joint[k], i, j]
    return Rj, tj


@kernel
def assemble(
    terms: Terms, arm: Skeleton, qd: F64, link: I64, local: F64
) -> tuple[F64, F64, F64, F64, F64, F64, F64, F64, F64, F64, F64, F64, F64, F64]:
    """Return every array of a `Model` after q and qd and up to the pairs, in order; then the links' placements."""
    iv, chain, tip = arm.iv, arm.chain, arm.tip
    n, m = iv.shape[0], link.shape[0]
    A = np.empty((n, n))
    h = np.empty(n)
    g = np.empty(n)
    for i in range(n):
        g[i] = terms.g[iv[i]]
        h[i] = terms.nle[iv[i]] - g[i]
        for j in range(n):
            A[i, j] = terms.M[iv[i], iv[j]]
    A_inv = spd_inverse(A)
    Rj, tj = placements_in(terms.R, terms.t, arm.joint)
    x = np.empty(3)
    R = np.empty((3, 3))
    for i in range(3):
        x[i] = tj[tip, i] + Rj[tip, i, 0] * arm.tip_t[0] + Rj[tip, i, 1] * arm.tip_t[1] + Rj[tip, i, 2] * arm.tip_t[2]
        for j in range(3):
            R[i, j] = (
                Rj[tip, i, 0] * arm.tip_R[0, j] + Rj[tip, i, 1] * arm.tip_R[1, j] + Rj[tip, i, 2] * arm.tip_R[2, j]
            )
    J, Jdqd = _tip(terms.J, terms.dJ, iv, chain, tip, x, qd)
    Lambda_inv = np.empty((6, 6))
    row = np.empty(n)
    _quadratic(J, A_inv, n, row, Lambda_inv)
    P = np.empty((m, 3))
    place_points(Rj, tj, link, local, P)
    Jp = np.zeros((m, 3, n))
    _point_jacobians(terms.J, iv, chain, link, P, Jp)
    B = np.empty((m, 3, 3))
    for i in range(m):
        _quadratic(Jp[i], A_inv, _used(chain, link[i]), row, B[i])
    return A, A_inv, h, g, x, R, J, Jdqd, P, Jp, B, Lambda_inv, Rj, tj


@kernel
def acceleration(A_inv: F64, tau: F64, h: F64, g: F64, viscous: F64, qd: F64) -> F64:
    """Return qdd (n,) = A^-1 (tau - h - g - B qd), what a torque tau [Nm] makes of a state; NaN where a state is none.

    h, g: (n,) [Nm]; viscous: (n,) [Nms/rad] friction B of the joints; qd: (n,) [rad/s].
    """
    out = np.zeros(tau.shape[0])
    for j in range(tau.shape[0]):
        net = tau[j] - h[j] - g[j] - viscous[j] * qd[j]
        for i in range(tau.shape[0]):
            out[i] += A_inv[i, j] * net
    return out
