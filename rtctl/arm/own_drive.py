"""How much of somebody else's law drives the arm: no more than the guards can take back.

Every guard counts on accelerations that are as bounded as those of this program's own motion, and that do not change
at once. A torque tau [Nm] is measured by the accelerations that it asks for,

    |tau| = max(|J_v qdd| / a_max, |J_w qdd| / alpha_max, max_i |qdd_i| / braking_i),    qdd = A^-1 tau

and is given the less the more that is above 1; within RISE it may go from nothing to that.
"""

import math

from rtctl.arm.model import Model
from rtctl.kernel import kernel
from rtctl.kernel.linalg import matvec
from rtctl.types import F64, RecordRow

RISE = 0.02  # [s] what the torque's rate lets a heavy joint have, too


@kernel
def measured(c: RecordRow, model: Model, tau: F64) -> float:
    """Return the size of a torque (n,) [Nm], 1 for the most that is given; c: as in `sensing`."""
    most, v, w = 0.0, 0.0, 0.0
    qdd = matvec(model.A_inv, tau)
    for i in range(tau.shape[0]):
        most = max(most, abs(qdd[i]) / c.braking[i])
    a = matvec(model.J, qdd)
    for i in range(3):
        v, w = v + a[i] * a[i], w + a[3 + i] * a[3 + i]
    size: float = max(most, math.sqrt(v) / c.motion_a_max, math.sqrt(w) / c.motion_alpha_max)
    return size


@kernel
def let_drive(c: RecordRow, model: Model, before: F64, asked: F64) -> F64:
    """Return what is given (n,) [Nm] of the torque that a law asks for, after `before` in the last tick."""
    step = asked / max(1.0, measured(c, model, asked)) - before
    given: F64 = before + step * min(1.0, c.dt / (RISE * max(measured(c, model, step), 1e-9)))
    return given
