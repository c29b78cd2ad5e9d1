"""What a tick's feedback shows, in one compiled pass over everything that the detectors and the supervisor ask of it.

Crossing into compiled code costs as much as such a question: twenty questions, one crossing.
"""

import numpy as np

from rtctl.arm.encoders import watched
from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64

# what is seen, at some joint or of some obstacle
(
    UNHEARD,  # a drive that never answered
    FAULT,  # a drive's fault code
    DISABLED,  # a drive that is off
    TORQUE,  # an echo that answers to none of the last commands
    OUTSIDE,  # a position beyond its limit by more than the tolerance
    FAST,  # a speed beyond its limit by more than the tolerance
    NOT_FINITE,  # a number that is none
    STUCK,  # an encoder repeats itself; see `watch`
    DISAGREE,  # positions and speed of a joint disagree
    BEYOND,  # a position beyond its limit at all
    STIRS,  # a joint is not at rest
    CONTACT,  # an obstacle within a point of the arm
    GOAL_INSIDE,  # an obstacle around the goal's position
) = (1 << i for i in range(13))


@kernel
def notice(
    noted: F64,
    active: bool,
    q: F64,
    qd: F64,
    tau: F64,
    age: F64,
    replies: I64,
    drive: I64,
    sent: F64,
    q_previous: F64,
    age_previous: F64,
    qdd: F64,
    A: F64,
    rho: F64,
    goal_rho: F64,
    seen_ago: F64,
    moving: B1,
    torque_tolerance: F64,
    friction: F64,
    velocity_tolerance: F64,
    limit_tolerance: float,
    speed_tolerance: float,
    rest_speed: float,
    q_min: F64,
    q_max: F64,
    qd_max: F64,
    elapsed: float,
    dt: float,
) -> tuple[F64, float, float, int]:
    """Return the watch (5, n) on the encoders, the greatest age [s] of a reply and of a moving obstacle, and the flags.

    noted, q to replies, q_previous to A, friction, velocity_tolerance, elapsed, dt: of `watch.watched`, which looks
    only while the arm is `active`. tau (n,) [Nm] echoed; drive (n,) status; sent (4, n) [Nm] the last commands. rho,
    goal_rho (K,) [m] from arm and goal to each obstacle; seen_ago (K,) [s] since each was observed, moving (K,) whether
    that matters. The tolerances are those of SafetyParams; rest_speed [rad/s]; q_min, q_max (n,) [rad],
    qd_max (n,) [rad/s]. A NaN is NOT_FINITE and fails every other comparison.
    """
    flags, oldest, feed_age = 0, 0.0, 0.0
    for i in range(q.shape[0]):
        oldest = age[i] if age[i] > oldest else oldest
        low, high = sent[0, i], sent[0, i]
        for r in range(1, sent.shape[0]):
            low, high = min(low, sent[r, i]), max(high, sent[r, i])
        if drive[i] < 0:
            flags |= UNHEARD
        if drive[i] > 1:
            flags |= FAULT
        if drive[i] == 0:
            flags |= DISABLED
        if tau[i] < low - torque_tolerance[i] or tau[i] > high + torque_tolerance[i]:
            flags |= TORQUE
        if q[i] < q_min[i] - limit_tolerance or q[i] > q_max[i] + limit_tolerance:
            flags |= OUTSIDE
        if q[i] < q_min[i] or q[i] > q_max[i]:
            flags |= BEYOND
        if abs(qd[i]) > speed_tolerance * qd_max[i]:
            flags |= FAST
        if abs(qd[i]) > rest_speed:
            flags |= STIRS
        if not (np.isfinite(q[i]) and np.isfinite(qd[i]) and np.isfinite(tau[i])):
            flags |= NOT_FINITE
    for k in range(rho.shape[0]):
        if rho[k] < 0.0:
            flags |= CONTACT
        if goal_rho[k] < 0.0:
            flags |= GOAL_INSIDE
        if moving[k] and seen_ago[k] > feed_age:
            feed_age = seen_ago[k]
    watch = np.zeros_like(noted)
    if active:
        watch, stuck, disagree = watched(
            noted, q, qd, age, replies, q_previous, age_previous, qdd, A, friction, velocity_tolerance, elapsed, dt
        )
        flags |= STUCK * stuck | DISAGREE * disagree
    return watch, oldest, feed_age, flags
