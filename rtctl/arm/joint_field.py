"""The field of the arm on itself: links against links, and the joint limits (Khatib 1986)."""

import math

import numpy as np

from rtctl.control.firas import CAPPED, CONTACT, FieldParams, LimitParams, firas
from rtctl.kernel import kernel, leaf_kernel
from rtctl.types import F64

LEAST_REACH = 1.05  # of the clearance, or of what takes its place: influence is never less


@kernel
def own_field(
    rho: F64, row: F64, dq: F64, qd: F64, A_inv: F64, params: FieldParams, ends: F64
) -> tuple[F64, float, int]:
    """Return (tau (n,) [Nm], least rho [m], flags) of `self_collision`, which it calls."""
    tau = np.empty(qd.shape[0])
    least, flags = self_collision(rho, row, dq, qd, A_inv, params, ends, tau)
    return tau, least, flags


@leaf_kernel
def self_collision(
    rho: F64, row: F64, dq: F64, qd: F64, A_inv: F64, params: FieldParams, ends: F64, tau: F64
) -> tuple[float, int]:
    """Repulsion between links of the arm, equal and opposite; writes tau (n,) [Nm]; returns least distance, flags.

    tau = sum over pairs of lambda (a + d) row^T, lambda = 1/(row A^-1 row^T), on rho + row dq: a motion that both links
    share costs nothing. rho (L,) [m] and row = d rho/d q (L, n) of the last evaluation; dq (n,) [rad] since it;
    qd (n,); A_inv (n, n). ends (L,) [m]: what the pairs have in the goal's posture, empty without one: influence is no
    wider, as for obstacles. Returns the least rho [m] (inf of none), flags CAPPED | CONTACT.
    """
    n = qd.shape[0]
    least, flags = math.inf, 0
    for i in range(n):
        tau[i] = 0.0
    for s in range(rho.shape[0]):
        if rho[s] == math.inf:
            continue
        r, rho_dot = rho[s], 0.0
        for i in range(n):
            r += row[s, i] * dq[i]
            rho_dot += row[s, i] * qd[i]
        least = min(least, r)
        p, reach = params, params.rho0
        if ends.shape[0] > 0:
            reach = min(reach, max(ends[s], LEAST_REACH * p.rho_min))
        a, d = firas(r, rho_dot, reach, p.rho_min, p.rho_num, p.eta, p.k_d)
        if a == 0.0:
            continue
        if r <= params.rho_num:
            flags |= CAPPED if r > 0.0 else CAPPED | CONTACT
        mobility = 0.0
        for i in range(n):
            for k in range(n):
                mobility += row[s, i] * A_inv[i, k] * row[s, k]
        f = (a + d) / max(mobility, 1.0 / params.m_max)
        for i in range(n):
            tau[i] += f * row[s, i]
    return least, flags


@leaf_kernel
def joint_limit_field(q: F64, qd: F64, q_min: F64, q_max: F64, A_diag: F64, params: LimitParams, tau: F64) -> int:
    """Repulsion from both limits of every joint; writes tau = A_ii ((a + d) at q_min - (a + d) at q_max).

    The same law both ways, on rho = q - q_min and q_max - q; past a limit the push is inward, at the cap. In a zone
    that is thinner than the clearance everything is thinner in proportion, and eta so that it is as steep as before.
    q, qd, q_min, q_max: (n,) [rad or m]; an infinite limit never pushes. A_diag: (n,) [kg m2 or kg]; tau: (n,) out.
    Returns flags CAPPED | CONTACT (past or on a limit).
    """
    flags = 0
    for i in range(q.shape[0]):
        rho0, rho_min, rho_num = params.rho0[i], params.rho_min[i], params.rho_num[i]
        eta, k_d = params.eta[i], params.k_d[i]
        thin = min(rho0 / (LEAST_REACH * rho_min), 1.0)
        rho_min, rho_num, eta = thin * rho_min, thin * rho_num, thin * thin * thin * thin * eta
        low, high = q[i] - q_min[i], q_max[i] - q[i]
        a, d = firas(low, qd[i], rho0, rho_min, rho_num, eta, k_d)
        b, e = firas(high, -qd[i], rho0, rho_min, rho_num, eta, k_d)
        tau[i] = A_diag[i] * ((a + d) - (b + e))
        least = low if low <= high else high
        if least <= rho_num:
            flags |= CAPPED if least > 0.0 else CAPPED | CONTACT
    return flags
