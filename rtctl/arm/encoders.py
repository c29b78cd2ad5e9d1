"""A watch on encoders: one that repeats itself while the joint must move, one whose speed is not that of its position.

The evidence is asked for conservatively. Friction, a payload or a wall may hold a joint against a torque that moves the
model, so only torque beyond what the drives themselves may be wrong by counts, only for a moment, and only while other
joints move: an arm that stands as a whole is held. What it pushes against is for the innovation to say.
"""

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64, I64

STUCK_TIME = 0.02  # [s] that a position must have been the same to the bit
STIRRED = 0.05  # [rad/s] of some joint whose position changes: the arm is not held as a whole
STUCK_TRAVEL = 5e-3  # [rad] that the joint should have come meanwhile
MEMORY = 0.1  # [s] for which a travel that did not happen counts
SHARE = 0.1  # of a new difference of speeds in the filtered one: 10 ticks
DISAGREE_TICKS = 10  # for which that must lie beyond its bound


# rows of what has been noticed of each joint, (5, n)
EQUAL = 0  # [s] for which the position has been the same to the bit
SPEED = 1  # [rad/s] that the joint should have
TRAVEL = 2  # [rad] that it should have come in that time
RESIDUAL = 3  # [rad/s] filtered: speed by the positions less the speed reported
ODD = 4  # ticks for which the residual has been beyond its bound


def fresh(n: int) -> F64:
    """Return the watch (5, n) that has noticed nothing."""
    return np.zeros((5, n))


@kernel
def watched(
    before: F64,
    q: F64,
    qd: F64,
    age: F64,
    replies: I64,
    q_previous: F64,
    age_previous: F64,
    qdd: F64,
    A: F64,
    friction: F64,
    bound: F64,
    elapsed: float,
    dt: float,
) -> tuple[F64, bool, bool]:
    """Return the watch after a tick, whether an encoder is stuck, and whether position and speed of one disagree.

    q [rad], qd [rad/s], age [s], replies (n,) of the feedback, q_previous [rad] and age_previous [s] of the one before,
    `elapsed` [s] ago; qdd (n,) [rad/s2] that the model predicts of the torque sent, A (n, n) its inertia; friction (n,)
    [Nm] that may hold a joint; bound (n,) [rad/s] of the residual; dt [s] servo period.
    """
    w = before.copy()
    stuck, disagree, stirred = False, False, False
    for i in range(q.shape[0]):
        stirred = stirred or (replies[i] > 0 and q[i] != q_previous[i] and abs(qd[i]) > STIRRED)
    for i in range(q.shape[0]):
        if replies[i] == 0:
            continue  # silence is a fault of its own
        moved = q[i] - q_previous[i]
        if moved != 0.0:
            w[EQUAL, i], w[TRAVEL, i], w[SPEED, i] = 0.0, 0.0, qd[i]
        else:
            w[EQUAL, i] += elapsed
            free = stirred and abs(A[i, i] * qdd[i]) > friction[i]
            w[SPEED, i] = w[SPEED, i] + qdd[i] * elapsed if free else qd[i]
            w[TRAVEL, i] += elapsed * (w[SPEED, i] - w[TRAVEL, i] / MEMORY)
            stuck = stuck or (w[EQUAL, i] >= STUCK_TIME and abs(w[TRAVEL, i]) > STUCK_TRAVEL)
        apart = max(elapsed + age_previous[i] - age[i], dt)
        w[RESIDUAL, i] += SHARE * (moved / apart - qd[i] - w[RESIDUAL, i])
        w[ODD, i] = w[ODD, i] + 1 if abs(w[RESIDUAL, i]) > bound[i] else 0
        disagree = disagree or w[ODD, i] >= DISAGREE_TICKS
    return w, stuck, disagree
