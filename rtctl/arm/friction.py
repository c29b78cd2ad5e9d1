"""Friction of the joints that the file tells: what rubs as they move, and what is given for it beforehand.

    f(qd) = c s(qd) + b qd,    s(qd) = qd / sqrt(qd^2 + w^2)

Coulomb's c sign(qd), smooth within w = SLIDING, and viscous friction (Armstrong-Helouvry, Dupont and Canudas de Wit,
Automatica 30(7), 1994, sections 2 and 4). It is fed forward at the speeds that the motion asks for, not at those that
are measured: near rest these are rounding alone, their sign changes from tick to tick, and so would the torque
(chatter). The reference is slewed and falls to nothing at the goal; there s is steep, so that a joint that sticks short
of it is given c all the same.
"""

import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64

SLIDING = 0.02  # [rad/s] a few steps of a drive's speed
GUIDED = 0.7  # of Coulomb's friction is given to a joint that a hand moves: with all of it one would drift on


@kernel
def sliding(qd: float) -> float:
    """Return s(qd), qd [rad/s]."""
    return qd / math.sqrt(qd * qd + SLIDING * SLIDING)


@kernel
def rubbing(coulomb: F64, viscous: F64, qd: F64) -> F64:
    """Return the friction (n,) [Nm] of joints at qd (n,) [rad/s]; coulomb (n,) [Nm], viscous (n,) [Nms/rad]."""
    out = np.empty(qd.shape[0])
    for i in range(qd.shape[0]):
        out[i] = coulomb[i] * sliding(qd[i]) + viscous[i] * qd[i]
    return out


@kernel
def speeds_of(Jbar: F64, v: F64, w: F64) -> F64:
    """Return the joint speeds (n,) [rad/s] that move the tip at v (3,) [m/s] and w (3,) [rad/s]; Jbar (n, 6)."""
    out = np.zeros(Jbar.shape[0])
    for i in range(Jbar.shape[0]):
        for k in range(3):
            out[i] += Jbar[i, k] * v[k] + Jbar[i, 3 + k] * w[k]
    return out
