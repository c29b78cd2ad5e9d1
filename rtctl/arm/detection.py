"""What a tick's feedback shows of all that the fault table and the supervisor ask of it."""

from typing import NamedTuple

import numpy as np

from rtctl.arm.encoders import EncoderBounds, ExpectedMotion, PreviousPositions, monitor_encoders
from rtctl.kernel import kernel
from rtctl.types import B1, F64, Feedback

# what is found, at some joint or of some obstacle
(
    UNHEARD,  # a drive that never answered
    FAULT,  # a drive's fault code
    DISABLED,  # a drive that is off
    TORQUE,  # an echo that answers to none of the last commands
    OUTSIDE,  # a position beyond its limit by more than the tolerance
    FAST,  # a speed beyond its limit by more than the tolerance
    NOT_FINITE,  # a number that is none
    STUCK,  # an encoder repeats itself; see `monitor_encoders`
    DISAGREE,  # positions and speed of a joint disagree
    BEYOND,  # a position beyond its limit at all
    STIRS,  # a joint is not at rest
    CONTACT,  # an obstacle within a point of the arm
    GOAL_INSIDE,  # an obstacle around the goal's position
    TOUCHED,  # an external torque that nothing told explains
    STRUCK,  # the same, and large
    UNEXPLAINED,  # the same, and small, while an encoder repeats itself
    GOAL_OLD,  # no other goal came within the time-out of this one
) = (1 << i for i in range(17))


class Clearances(NamedTuple):
    """How near the K obstacles are, and how sure that is."""

    rho: F64  # (K,) [m] from the arm
    goal_rho: F64  # (K,) [m] from the goal
    age: F64  # (K,) [s] since each was observed
    moving: B1  # (K,) whether that matters


class JointBounds(NamedTuple):
    """Where the joints may be and how fast, each (n,)."""

    q_min: F64  # [rad]
    q_max: F64  # [rad]
    qd_max: F64  # [rad/s]


class Tolerances(NamedTuple):
    """How far feedback may be off before it is a fault; those of SafetyParams."""

    torque: F64  # (n,) [Nm] of sent against echoed torque
    limit: float  # [rad] beyond a joint limit
    speed: float  # fraction of qd_max
    rest: float  # [rad/s] a joint slower than this rests


class Findings(NamedTuple):
    """What the feedback of a tick shows."""

    flags: int  # the flags above
    age: float  # [s] greatest of a reply
    feed_age: float  # [s] greatest since a moving obstacle was observed


@kernel
def _drive_flags(f: Feedback, sent: F64, tolerance: F64) -> int:
    """Return the flags that drives raise; sent (4, n) [Nm] the last commands, tolerance (n,) [Nm] of an echo."""
    flags = 0
    for i in range(f.drive.shape[0]):
        low, high = sent[0, i], sent[0, i]
        for r in range(1, sent.shape[0]):
            low, high = min(low, sent[r, i]), max(high, sent[r, i])
        if f.drive[i] < 0:
            flags |= UNHEARD
        if f.drive[i] > 1:
            flags |= FAULT
        if f.drive[i] == 0:
            flags |= DISABLED
        if f.tau[i] < low - tolerance[i] or f.tau[i] > high + tolerance[i]:
            flags |= TORQUE
    return flags


@kernel
def _joint_flags(f: Feedback, bounds: JointBounds, tolerances: Tolerances) -> int:
    """Return the flags that positions and speeds raise."""
    flags = 0
    for i in range(f.q.shape[0]):
        q, speed, q_min, q_max = f.q[i], abs(f.qd[i]), bounds.q_min[i], bounds.q_max[i]
        if q < q_min - tolerances.limit or q > q_max + tolerances.limit:
            flags |= OUTSIDE
        if q < q_min or q > q_max:
            flags |= BEYOND
        if speed > tolerances.speed * bounds.qd_max[i]:
            flags |= FAST
        if speed > tolerances.rest:
            flags |= STIRS
        if not (np.isfinite(q) and np.isfinite(f.qd[i]) and np.isfinite(f.tau[i])):
            flags |= NOT_FINITE
    return flags


@kernel
def examine_feedback(f: Feedback, sent: F64, near: Clearances, bounds: JointBounds, tolerances: Tolerances) -> Findings:
    """Return what the feedback shows by itself; sent (4, n) [Nm] the last commands, newest first.

    A NaN is NOT_FINITE and fails every other comparison.
    """
    flags, age, feed_age = _drive_flags(f, sent, tolerances.torque) | _joint_flags(f, bounds, tolerances), 0.0, 0.0
    for i in range(f.age.shape[0]):
        age = f.age[i] if f.age[i] > age else age
    for k in range(near.rho.shape[0]):
        if near.rho[k] < 0.0:
            flags |= CONTACT
        if near.goal_rho[k] < 0.0:
            flags |= GOAL_INSIDE
        if near.moving[k] and near.age[k] > feed_age:
            feed_age = near.age[k]
    return Findings(flags, age, feed_age)


@kernel
def encoder_flags(
    before: F64, f: Feedback, previous: PreviousPositions, expected: ExpectedMotion, bounds: EncoderBounds, dt: float
) -> tuple[F64, int]:
    """Return the monitors (6, n) of the encoders after a tick, and the flags STUCK and DISAGREE.

    before (6, n): the monitors of the last tick; dt [s] servo period.
    """
    after, stuck, disagree = monitor_encoders(before, f, previous, expected, bounds, dt)
    return after, STUCK * stuck | DISAGREE * disagree
