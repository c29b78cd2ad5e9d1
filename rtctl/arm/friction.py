"""Friction of the joints that the file tells: what rubs as they move, and what is given for it beforehand.

    f(qd) = c s(qd) + b qd,    s(qd) = qd / sqrt(qd^2 + w^2),    w = max(SLIDING, c dt A^-1_ii)

Coulomb's c sign(qd), smooth within w, and viscous friction (Armstrong-Helouvry, Dupont and Canudas de Wit,
Automatica 30(7), 1994, sections 2 and 4). It is fed forward at the speeds that the motion asks for, not at those that
are measured: near rest these are rounding alone, their sign changes from tick to tick, and so would the torque
(chatter). The reference is slewed and falls to nothing at the goal; there s is steep, so that a joint that sticks short
of it is given c all the same.

In a servo period dt, c changes the speed of joint i by c dt A^-1_ii. Dry friction brings a joint to rest and never
turns it round, so of a joint that is slower than this less counts. All of it would throw a light joint to and fro about
its goal, at a slow rate, where the file tells of more than there is, and would predict the same of one that sticks.
"""

import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64

SLIDING = 0.02  # [rad/s] a few steps of a drive's speed
GUIDED = 0.7  # of Coulomb's friction is given to a joint that a hand moves: with all of it one would drift on


@kernel
def sliding(qd: float, within: float) -> float:
    """Return s(qd), qd and within [rad/s]."""
    return qd / math.sqrt(qd * qd + within * within)


@kernel
def smoothing(coulomb: F64, A_inv: F64, dt: float) -> F64:
    """Return the speeds w (n,) [rad/s] within which less counts; coulomb (n,) [Nm], A_inv (n, n), dt [s] a period."""
    out = np.empty(coulomb.shape[0])
    for i in range(coulomb.shape[0]):
        out[i] = max(SLIDING, coulomb[i] * dt * A_inv[i, i])
    return out


@kernel
def rubbing(coulomb: F64, viscous: F64, qd: F64, within: F64) -> F64:
    """Return the friction (n,) [Nm] of joints at qd (n,) [rad/s]; coulomb (n,) [Nm], viscous (n,) [Nms/rad].

    within (n,) [rad/s]: see `smoothing`.
    """
    out = np.empty(qd.shape[0])
    for i in range(qd.shape[0]):
        out[i] = coulomb[i] * sliding(qd[i], within[i]) + viscous[i] * qd[i]
    return out


@kernel
def speeds_of(Jbar: F64, v: F64, w: F64) -> F64:
    """Return the joint speeds (n,) [rad/s] that move the tip at v (3,) [m/s] and w (3,) [rad/s]; Jbar (n, 6)."""
    out = np.zeros(Jbar.shape[0])
    for i in range(Jbar.shape[0]):
        for k in range(3):
            out[i] += Jbar[i, k] * v[k] + Jbar[i, 3 + k] * w[k]
    return out
