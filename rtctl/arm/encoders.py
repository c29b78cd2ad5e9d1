"""Monitors of encoders: one that repeats itself while the joint must move, one whose speed is not that of its position.

The evidence is asked for conservatively. Friction, a payload or a wall may hold a joint against a torque that moves the
model, so only torque beyond what the drives themselves may be wrong by counts, only for a moment, and only while other
joints move: an arm that stands as a whole may be blocked. What it pushes against is for the innovation to say.

An encoder that dies in motion reads the same position from then on, and the speed that its drive makes of that is 0:
the joint seems to be stopped by a blow. That it halts tells nothing by itself, as friction stops a slow one, too; but
where there is a blow as well, its position is not to be trusted (`collision`, `own_loop`).
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64, Feedback

STUCK_TIME = 0.02  # [s] that a position must have been the same to the bit
STIRRED = 0.05  # [rad/s] of some joint whose position changes: the arm is not blocked as a whole
STUCK_TRAVEL = 5e-3  # [rad] that the joint should have come meanwhile
HALTING = 0.1  # [rad/s] that a joint had which seems to be stopped by a blow, and at least
HALT_STEPS, STILL_STEPS = 5.0, 1.5  # of its speed's resolution; so many of these it may have since
MEMORY = 0.1  # [s] for which a travel that did not happen counts
SHARE = 0.1  # of a new difference of speeds in the filtered one: 10 ticks
DISAGREE_TICKS = 10  # for which that must lie beyond its bound


# rows of the monitors of the joints, (6, n)
EQUAL = 0  # [s] for which the position has been the same to the bit
SPEED = 1  # [rad/s] that the joint should have
TRAVEL = 2  # [rad] that it should have come in that time
RESIDUAL = 3  # [rad/s] filtered: speed by the positions less the speed reported
BEYOND = 4  # ticks for which the residual has been beyond its bound
LAST = 5  # [rad/s] read when the position changed last
MONITORS = 6


class PreviousPositions(NamedTuple):
    """The positions of the last feedback."""

    q: F64  # (n,) [rad]
    age: F64  # (n,) [s] how old each was
    elapsed: float  # [s] since that feedback


class ExpectedMotion(NamedTuple):
    """What the model predicts of the torque sent."""

    qdd: F64  # (n,) [rad/s2]
    A: F64  # (n, n) inertia


class EncoderBounds(NamedTuple):
    """What may be wrong with a joint that is healthy."""

    friction: F64  # (n,) [Nm] that may hold it against the model
    residual: F64  # (n,) [rad/s]


def fresh(n: int) -> F64:
    """Return the monitors (6, n) at their start."""
    return np.zeros((MONITORS, n))


@kernel
def halted(equal: float, last: float, qd: float, qd_noise: float) -> bool:
    """Return whether a joint moved until its position became the same, and has not moved by its speed either since.

    equal [s], last [rad/s]: of its monitors; qd [rad/s] as read; qd_noise [rad/s] = step/sqrt(12), see `rounding`.
    """
    step = math.sqrt(12.0) * qd_noise
    return equal > 0.0 and abs(last) > max(HALTING, HALT_STEPS * step) and abs(qd) <= STILL_STEPS * step


@kernel
def _moves(f: Feedback, q_previous: F64, equal: F64) -> bool:
    """Return whether any joint moves by its position, within STUCK_TIME, and by its speed.

    equal (n,) [s] for which each position had been the same: a slow joint takes some periods for a step of its encoder.
    """
    for i in range(f.q.shape[0]):
        changes = f.q[i] != q_previous[i] or equal[i] < STUCK_TIME
        if f.replies[i] > 0 and changes and abs(f.qd[i]) > STIRRED:
            return True
    return False


@kernel
def monitor_encoders(
    before: F64, f: Feedback, previous: PreviousPositions, expected: ExpectedMotion, bounds: EncoderBounds, dt: float
) -> tuple[F64, bool, bool]:
    """Return the monitors after a tick, whether an encoder is stuck, and whether position and speed of one disagree.

    before (6, n): the monitors of the last tick; dt [s] servo period.
    """
    w, elapsed = before.copy(), previous.elapsed
    stuck, disagree, moves = False, False, _moves(f, previous.q, before[EQUAL])
    for i in range(f.q.shape[0]):
        if f.replies[i] == 0:
            continue  # silence is a fault of its own
        moved, qdd = f.q[i] - previous.q[i], expected.qdd[i]
        if moved != 0.0:
            w[EQUAL, i], w[TRAVEL, i], w[SPEED, i], w[LAST, i] = 0.0, 0.0, f.qd[i], f.qd[i]
        else:
            w[EQUAL, i] += elapsed
            free = moves and abs(expected.A[i, i] * qdd) > bounds.friction[i]
            w[SPEED, i] = w[SPEED, i] + qdd * elapsed if free else f.qd[i]
            w[TRAVEL, i] += elapsed * (w[SPEED, i] - w[TRAVEL, i] / MEMORY)
            stuck = stuck or (w[EQUAL, i] >= STUCK_TIME and abs(w[TRAVEL, i]) > STUCK_TRAVEL)
        apart = max(elapsed + previous.age[i] - f.age[i], dt)
        w[RESIDUAL, i] += SHARE * (moved / apart - f.qd[i] - w[RESIDUAL, i])
        w[BEYOND, i] = w[BEYOND, i] + 1 if abs(w[RESIDUAL, i]) > bounds.residual[i] else 0
        disagree = disagree or w[BEYOND, i] >= DISAGREE_TICKS
    return w, stuck, disagree
