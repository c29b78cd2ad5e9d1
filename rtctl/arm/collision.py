"""Contact that nobody expected: the part of the external torque that comes faster than what may explain it.

    |r_i - track(r)_i|  >  b_i + rounding_i + payload_i + friction_i,    for CONFIRMED ticks at some joint i

(residuals of the momentum observer against bounds that know the motion; Haddadin, De Luca and Albu-Schaeffer, IEEE
T-RO 33(6), 2017). What is told of nobody may change fast for three reasons: speeds are rounded; the tip is accelerated,
and with it a payload up to the declared one; a joint turns round, and friction up to the declared one changes sign.
While a joint is slow enough to stick, its track follows at once and its bound is twice that friction.

A joint whose encoder is stuck may be driven off, too slowly for its own torque to tell, while friction might as well
hold it. It shakes the others: what they feel is taken for a lie at a part of the bound already, where some encoder
repeats itself while another joint slides. And an encoder that dies in motion is like a blow that stops its joint at
once: a contact in which one halts is taken for a lie. A contact that is taken for it is no worse for a stop that trusts
nothing; a stop that holds by what such encoders say drives the arm away.

A force on a link turns no joint beyond it: the last joint that feels it carries the link that was touched (De Luca,
Albu-Schaeffer, Haddadin and Hirzinger 2006). m, c: as in `sensing`.
"""

import math

import numpy as np

from rtctl.arm.disturbance import BANDWIDTH, GRAVITY, LASTING, PAYLOAD_REACH, spread
from rtctl.arm.encoders import EQUAL, LAST, STUCK_TIME, halted
from rtctl.arm.model import Model
from rtctl.kernel import kernel
from rtctl.kernel.reductions import norm
from rtctl.types import F64, RecordRow, State

TRACKING = 10.0  # [1/s] of what is no contact: postures change, and friction with speed
MOVING = 0.05  # [rad/s] faster than this a joint slides in one direction
STEADY = 0.06  # [s] since it does: the observer has seen its friction
FADING = 0.06  # [s] in which the law's own acceleration has come and gone
TAKING = 2.0  # [s] in which a payload that was told is taken up or put down
BEGIN = 0.5  # [s] of RUN in which the arm is found as it is
CONFIRMED, SPARE = 3, 2  # ticks of a contact; and before, in which its first torque was below the bound
LEVER = 0.1  # [m] of all joints together, below which a weight at the tip is not felt
HIDDEN, SLIGHT = 1.5, 3.0  # times the weight that is felt, and [N] beside it
FELT = 0.5  # of its bound: so much of the torque counts as felt by a joint
SUSPECT = 0.25  # of the level of a contact, while an encoder may be stuck
NO, TOUCHED, STRUCK, UNEXPLAINED = 0, 1, 2, 3  # what a tick shows
_RUN = int(State.RUN)


@kernel
def inertial(J: F64, a: F64, alpha: F64, mass: float) -> F64:
    """Return the torque (n,) [Nm] of a mass [kg] within PAYLOAD_REACH of a tip that accelerates; J (6, n)."""
    along, turning = norm(a), norm(alpha)
    out = np.empty(J.shape[1])
    for i in range(J.shape[1]):
        push = abs(J[0, i] * a[0] + J[1, i] * a[1] + J[2, i] * a[2])
        lever = math.sqrt(J[0, i] ** 2 + J[1, i] ** 2 + J[2, i] ** 2)
        turn = math.sqrt(J[3, i] ** 2 + J[4, i] ** 2 + J[5, i] ** 2)
        out[i] = mass * (push + PAYLOAD_REACH * (lever * turning + turn * along))
    return out


@kernel
def swaying(J: F64, xd: F64, omega: F64, mass: float) -> F64:
    """Return the torque (n,) [Nm] by which a mass [kg] within PAYLOAD_REACH of the tip is ahead of its track.

    J (6, n); xd (3,) [m/s], omega (3,) [rad/s] of the tip. Its lever changes as it is carried and turned about, and it
    pulls outward: m g (|xd| + r |omega|) / TRACKING + m r^2 omega^2 about each axis that turns it.
    """
    speed, turning = norm(xd), norm(omega)
    lever = GRAVITY * (speed + PAYLOAD_REACH * turning) / TRACKING + (PAYLOAD_REACH * turning) ** 2
    out = np.empty(J.shape[1])
    for i in range(J.shape[1]):
        out[i] = mass * lever * math.sqrt(J[3, i] ** 2 + J[4, i] ** 2 + J[5, i] ** 2)
    return out


@kernel
def believable(J: F64, track: F64, payload_max: float) -> float:
    """Return the largest payload [kg] at the tip that can be behind a lasting torque (n,) [Nm]; J (6, n).

    All of the torque is taken to be its weight, and half as much again where friction hides some; where no joint feels
    a weight, it is the one that was declared.
    """
    up, felt = 0.0, 0.0
    for i in range(track.shape[0]):
        up += J[2, i] * J[2, i]
        felt += abs(J[2, i] * track[i])
    if up < LEVER * LEVER:
        return payload_max
    return min(payload_max, (HIDDEN * felt / up + SLIGHT) / GRAVITY)


@kernel
def _asked(m: RecordRow, model: Model, elapsed: float) -> tuple[F64, F64]:
    """Return the tip's acceleration that motion and field asked for, [m/s2] and [rad/s2]; note the references."""
    n = model.q.shape[0]
    a, alpha = (m.v_ref - m.v_before) / elapsed, (m.w_ref - m.w_before) / elapsed
    m.v_before[:], m.w_before[:] = m.v_ref, m.w_ref
    for i in range(n):
        pushed = 0.0
        for k in range(n):
            pushed += model.A_inv[i, k] * m.tau_obstacles[k]
        for k in range(3):
            a[k] += model.J[k, i] * pushed
            alpha[k] += model.J[3 + k, i] * pushed
    return a, alpha


@kernel
def _bounds(c: RecordRow, m: RecordRow, model: Model, elapsed: float) -> F64:
    """Return what the fast part of each joint (n,) [Nm] may be without a contact, beside the levels."""
    n = model.q.shape[0]
    a, alpha = _asked(m, model, elapsed)
    mass = believable(model.J, m.track[:n].copy(), c.payload_max)
    may, sways = inertial(model.J, a, alpha, mass), swaying(model.J, m.xd.copy(), m.omega.copy(), mass)
    out = spread(model.A, c.joint_r_qd[:n].copy(), BANDWIDTH)
    fade, take = math.exp(-elapsed / FADING), math.exp(-elapsed / TAKING)
    for i in range(n):
        m.unsure[i] = max(may[i], m.unsure[i] * fade)
        m.expected[i] *= take
        out[i] += m.unsure[i] + sways[i] + m.expected[i] + (2.0 * c.friction_max[i] if m.steady[i] < STEADY else 0.0)
    return out


@kernel
def _repeats(m: RecordRow, n: int) -> bool:
    """Return whether the encoder of some joint may be stuck: it repeats itself while another joint slides."""
    repeats, slides = False, False
    for i in range(n):
        repeats = repeats or m.encoder_monitors[EQUAL, i] >= STUCK_TIME
        slides = slides or m.steady[i] >= STEADY
    return repeats and slides


@kernel
def _halts(c: RecordRow, m: RecordRow, qd: F64) -> bool:
    """Return whether some joint that moved stood still at once when the contact began; qd (n,) [rad/s]."""
    begun = (CONFIRMED + SPARE) * c.dt
    for i in range(qd.shape[0]):
        equal = m.encoder_monitors[EQUAL, i]
        if equal <= begun and halted(equal, m.encoder_monitors[LAST, i], qd[i], c.joint_r_qd[i]):
            return True
    return False


@kernel
def watch_contact(c: RecordRow, m: RecordRow, qd: F64, model: Model, elapsed: float) -> None:
    """Look for a contact in the external torque of this tick; qd (n,) [rad/s] as measured."""
    n = qd.shape[0]
    begins = m.state == _RUN and (m.tick - m.since) * c.dt < BEGIN
    fast, bound = np.empty(n), _bounds(c, m, model, elapsed)
    touched, struck, suspect = False, False, False
    for i in range(n):
        m.steady[i] = m.steady[i] + elapsed if abs(qd[i]) > MOVING else 0.0
        rate = LASTING if begins or m.steady[i] < STEADY else TRACKING
        fast[i] = m.external[i] - m.track[i]
        m.track[i] += (1.0 - math.exp(-rate * elapsed)) * fast[i]
        touched = touched or abs(fast[i]) > c.collision[i] + bound[i]
        struck = struck or abs(fast[i]) > c.collision_hard[i] + bound[i]
        suspect = suspect or abs(fast[i]) > SUSPECT * c.collision[i] + bound[i]
    touched, suspect = touched and m.state == _RUN, suspect and m.state == _RUN and _repeats(m, n)
    if begins or m.floating != 0 or not (touched or struck or suspect):  # a hand is expected
        m.touches, m.contact_level = 0, NO
        return
    if not (touched or struck):
        m.touches = min(m.touches, 0) - 1  # counted downwards
        m.contact_level = UNEXPLAINED if m.touches <= -CONFIRMED else NO
        return
    m.touches = max(m.touches, 0) + 1
    if m.touches < CONFIRMED:
        return
    m.contact_level = STRUCK if struck else TOUCHED
    if m.touches == CONFIRMED:
        m.contact_level = UNEXPLAINED if _halts(c, m, qd) else m.contact_level
        m.contact_link = 1
        for i in range(n):
            if abs(fast[i]) > FELT * (c.collision[i] + bound[i]):
                m.contact_link = i + 1
