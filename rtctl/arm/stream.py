"""Goals that move: a stream of them, each with its velocity, followed without a lag.

Between two goals of a stream the target goes on as the last one said,

    x_d(t) = x_goal + v_d (t - t_goal)

until its time-out. The law wants the tip at nu xd_d (Khatib 1986 eq. 8), the velocity that leads to x_d and is bounded
by v_max; here it gets the goal's own beside it: v_d + k_p/k_v (x_d - x), bounded as before. Its form stays: it is given
the way to a point ahead of x_d, at which it would want this velocity (`aim`). The tip follows that by 1/k_v late, so
v_d is that of 1/k_v from now. How velocities change is seen from goal to goal; what the next one tells beside what was
expected is taken up within EASE, not at once.

All ages are robot time, counted in servo periods. m, c: as in `sensing`.
"""

import math

import numpy as np

from rtctl.arm.osc import approach_speed
from rtctl.kernel import kernel
from rtctl.kernel.rotations import R_of, compose, exp3, quat_of
from rtctl.types import F64, RecordRow

SMOOTH = 0.05  # [s] in which an acceleration is believed: goals come a few milliseconds early or late
EASE = 0.015  # [s] in which another velocity is taken up


@kernel
def has_velocity(m: RecordRow) -> bool:
    """Return whether the goal moves."""
    size = 0.0
    for i in range(3):
        size += abs(m.goal_v[i]) + abs(m.goal_w[i])
    return bool(m.has_goal != 0 and size > 0.0)


@kernel
def stale(c: RecordRow, m: RecordRow) -> bool:
    """Return whether the goal's time-out has passed."""
    return bool(m.has_goal != 0 and m.goal_timeout > 0.0 and m.goal_age > m.goal_timeout + 0.5 * c.dt)


@kernel
def velocity_at(m: RecordRow, age: float) -> tuple[F64, F64]:
    """Return the goal's velocities [m/s], [rad/s], both (3,), at an age [s]; no longer changed than one goal lasts."""
    t = min(age, m.goal_gap)
    return m.goal_v + m.goal_a * t, m.goal_w + m.goal_alpha * t


@kernel
def go_on(c: RecordRow, m: RecordRow, elapsed: float) -> None:
    """Let the goal get older by `elapsed` [s] and go on until its time-out."""
    if m.has_goal == 0 or m.goal_timeout == 0.0:
        return
    age = m.goal_age
    m.goal_age = age + elapsed
    t = min(elapsed, m.goal_timeout - age)
    if t <= 0.0 or not has_velocity(m):
        return
    v, w = velocity_at(m, age)
    for i in range(3):
        m.goal[i] += v[i] * t
    if abs(w[0]) + abs(w[1]) + abs(w[2]) > 0.0:
        m.goal_wxyz[:] = quat_of(compose(exp3(w * t), R_of(m.goal_wxyz.copy())))
    late, share = EASE + 1.0 / c.motion_k_v, min(elapsed / EASE, 1.0)
    for i in range(3):
        m.goal_lead[i] += share * (v[i] + m.goal_a[i] * late - m.goal_lead[i])
        m.goal_turn[i] += share * (w[i] + m.goal_alpha[i] * late - m.goal_turn[i])


@kernel
def aim(e: F64, v: F64, k: float, v_max: float, a_max: float) -> F64:
    """Return the way (3,) whose `approach_speed` is that along e (3,) and v (3,) beside it, v_max at most."""
    d = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    wanted = v + e * (approach_speed(d, k, v_max, a_max) / d) if d > 1e-12 else v.copy()
    size = math.sqrt(wanted[0] * wanted[0] + wanted[1] * wanted[1] + wanted[2] * wanted[2])
    if size < 1e-12:
        return np.zeros(3)
    speed = min(size, v_max)
    away = speed / k if speed * k <= a_max else 0.5 * (a_max / (k * k) + speed * speed / a_max)
    out: F64 = wanted * (away / size)
    return out


def changing(before: F64, v: F64, a: F64, gap: float, most: float) -> F64:
    """Return how a velocity changes (3,) [m/s2, rad/s2], `most` at most: v (3,) now, `before` it `gap` [s] ago.

    a (3,): what was believed of it until now.
    """
    found: F64 = a + (v - before - a * gap) / (gap + SMOOTH)
    size = float(np.linalg.norm(found))
    return found if size <= most else found * (most / size)
