"""What pushes the joints beside what the drives give and the model knows: payload, friction, contact.

    r = K (p - integral of (tau + C^T qd - g + r) dt),   p = A qd

is the generalized-momentum observer (De Luca and Mattone 2003; De Luca, Albu-Schaeffer, Haddadin and Hirzinger 2006):
r follows the external torque as a first-order lag of bandwidth K does, and needs no acceleration. Between two
evaluations of the model A is held, C^T qd is then that of h, and a step of the observer is

    r += (1 - exp(-K dt)) (A (qd - qd_before)/dt + h + g - tau - r)

Its slow part is what lasts: payload and friction. The law carries that as gravity, within a bound by joint. What
remains is fast: contact. The prediction of the next state takes all of r, so that a constant force is no surprise to
the filters.

The drives round speed and torque, so r is never zero. It counts as nothing until it is more than rounding can make of
it: an arm that is as its model is moves to the bit as it would without an observer.
"""

import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.types import F64

GRAVITY = 9.81  # [m/s2]
BANDWIDTH = 120.0  # [1/s] of the observer: 8 ms
LASTING = 60.0  # [1/s] of what is taken to last: a twentieth of a second for a payload that is picked up
PAYLOAD_REACH = 0.1  # [m] from the tip, within which the centre of an unknown payload lies
FOLLOWING = 30.0  # [1/s] of what is expected of a joint that moves
STICKING = 2.0  # [1/s] with which what holds a joint that stands still is believed: an encoder may be stuck
RESTING = 0.05  # [rad/s] below it joints may stick
SETTLED, UNSETTLED = 0.35, 0.7  # of the tolerance: at rest, nearer than the first, what is carried stays as it is


@kernel
def observed(r: F64, A: F64, qd: F64, qd_before: F64, load: F64, tau: F64, dt: float) -> F64:
    """Return the external torque (n,) [Nm] a step dt [s] later.

    A (n, n) [kg m2], load (n,) [Nm] = h + g + known friction, tau (n,) [Nm] that the drives gave meanwhile, qd and
    qd_before (n,) [rad/s] at the end and at the start.
    """
    n = r.shape[0]
    gain = 1.0 - math.exp(-BANDWIDTH * dt)
    out = np.empty(n)
    for i in range(n):
        s = load[i] - tau[i]
        for k in range(n):
            s += A[i, k] * (qd[k] - qd_before[k]) / dt
        out[i] = r[i] + gain * (s - r[i])
    return out


@kernel
def slow_part(d: F64, r: F64, bound: F64, dt: float) -> F64:
    """Return the part (n,) [Nm] of an external torque r that lasts, within +-bound (n,) [Nm]."""
    gain = 1.0 - math.exp(-LASTING * dt)
    out = np.empty(d.shape[0])
    for i in range(d.shape[0]):
        out[i] = min(max(d[i] + gain * (r[i] - d[i]), -bound[i]), bound[i])
    return out


@kernel
def carried(J: F64, payload: float, friction: F64) -> F64:
    """Return the bound (n,) [Nm] of what is carried untold: weight of a payload [kg] at the tip, friction (n,) [Nm].

    J (6, n) of the tip. Gravity acts along the world's -z; the payload's centre is within PAYLOAD_REACH of the tip.
    """
    out = np.empty(J.shape[1])
    for i in range(J.shape[1]):
        turn = PAYLOAD_REACH * math.sqrt(J[3, i] * J[3, i] + J[4, i] * J[4, i])
        out[i] = GRAVITY * payload * (abs(J[2, i]) + turn) + friction[i]
    return out


@kernel
def settled(before: bool, resting: bool, error: float) -> bool:
    """Return whether the arm has come to rest where it shall be; error: of the goal, in tolerances.

    On a joint that sticks the slow part integrates until it breaks away. That takes an arm to its goal, and would take
    it past it again and again: so at rest near the goal what is carried stays as it is.
    """
    return error < UNSETTLED if before else resting and error < SETTLED


@kernel
def rounding(A: F64, qd_noise: F64, least: F64) -> F64:
    """Return the slow part (n,) [Nm] that the rounding of speeds can make of nothing: LASTING A (steps of qd).

    A (n, n) [kg m2]; qd_noise (n,) [rad/s] standard deviation, that of a step is step/sqrt(12); least (n,) [Nm]: what
    torques and the age of the model make of nothing.
    """
    out = spread(A, qd_noise, LASTING)
    for i in range(out.shape[0]):
        out[i] = least[i] + out[i]
    return out


@kernel
def spread(A: F64, qd_noise: F64, bandwidth: float) -> F64:
    """Return the torque (n,) [Nm] that one step of speed at all joints is, seen at a bandwidth [1/s]; as `rounding`."""
    out = np.empty(qd_noise.shape[0])
    for i in range(out.shape[0]):
        s = 0.0
        for k in range(out.shape[0]):
            s += 12.0 * (A[i, k] * qd_noise[k]) ** 2
        out[i] = bandwidth * math.sqrt(s)
    return out


@kernel
def within(torque: F64, bound: F64) -> F64:
    """Return a torque (n,) [Nm] cut to +-bound (n,) [Nm]."""
    out = np.empty(bound.shape[0])
    for i in range(bound.shape[0]):
        out[i] = min(max(torque[i], -bound[i]), bound[i])
    return out


@kernel
def beyond(torque: F64, bound: F64) -> bool:
    """Return whether any of a torque (n,) [Nm] is beyond its bound (n,) [Nm]."""
    for i in range(bound.shape[0]):
        if abs(torque[i]) > bound[i]:
            return True
    return False
