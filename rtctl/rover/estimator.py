"""Position and velocity of the base from reports of any age: a Kalman filter per axis on a unit mass.

State (x, v, b) on each axis: position, velocity and the bias of the reported velocity, which an autopilot's own filter
shows at rest. Process noise = acceleration not reported and the walk of the bias. A report is of `age` ago:

    z = (x - age v, v + b)

Between reports the state is predicted. filterpy is its oracle in the tests.
"""

from typing import NamedTuple

import numpy as np

from rtctl.rover.robot import Noise
from rtctl.types import F64

BIAS = 0.15  # [m/s] of a reported velocity at rest, as autopilots show
BIAS_WALK = 0.01  # [m/s/sqrt(s)]


class Estimate(NamedTuple):
    """The base on the plane."""

    x: F64  # (2,) [m]
    v: F64  # (2,) [m/s]
    b: F64  # (2,) [m/s] that reported velocities are too large by
    P: F64  # (3, 3) covariance of (x, v, b), the same on both axes
    yaw: float  # [rad]
    yaw_rate: float  # [rad/s]


def start(x: F64, yaw: float, noise: Noise) -> Estimate:
    """Return the estimate at rest at x (2,) [m], yaw [rad]."""
    P = np.diag([noise.position**2, noise.velocity**2, BIAS**2])
    return Estimate(x.astype(np.float64), np.zeros(2), np.zeros(2), P, yaw, 0.0)


def placed(e: Estimate, x: F64, v: F64, noise: Noise) -> Estimate:
    """Return the estimate begun anew at x (2,) [m] with the reported v (2,) [m/s]; the bias stays what it was."""
    P = np.diag([noise.position**2, noise.velocity**2 + e.P[2, 2], e.P[2, 2]])
    return e._replace(x=x.astype(np.float64), v=v - e.b, P=P)


def predicted(e: Estimate, elapsed: float, noise: Noise) -> Estimate:
    """Return the estimate `elapsed` [s] later: x += v t; P = F P F' + Q of a random acceleration and a walking bias."""
    t = elapsed
    F = np.array([[1.0, t, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    g = np.array([0.5 * t * t, t, 0.0])
    P = F @ e.P @ F.T + noise.acceleration**2 * np.outer(g, g)
    P[2, 2] += BIAS_WALK**2 * t
    return e._replace(x=e.x + t * e.v, P=P, yaw=wrapped(e.yaw + t * e.yaw_rate))


def measured(e: Estimate, x: F64, v: F64, age: float, noise: Noise) -> tuple[Estimate, float]:
    """Return the estimate after a report x, v (2,) made `age` [s] ago, and the innovation of its position [m].

    What may have happened since the report adds to its noise.
    """
    drift = 0.5 * noise.acceleration * age * age
    H = np.array([[1.0, -age, 0.0], [0.0, 1.0, 1.0]])
    R = np.diag([noise.position**2 + drift**2, noise.velocity**2 + (noise.acceleration * age) ** 2])
    K = e.P @ H.T @ np.linalg.inv(H @ e.P @ H.T + R)
    dx, dv = x - (e.x - age * e.v), v - (e.v + e.b)
    keep = np.eye(3) - K @ H
    P = keep @ e.P @ keep.T + K @ R @ K.T  # Joseph: stays symmetric
    new = e._replace(
        x=e.x + K[0, 0] * dx + K[0, 1] * dv,
        v=e.v + K[1, 0] * dx + K[1, 1] * dv,
        b=e.b + K[2, 0] * dx + K[2, 1] * dv,
        P=P,
    )
    return new, float(np.hypot(dx[0], dx[1]))


def wrapped(angle: float) -> float:
    """Return the angle in [-pi, pi)."""
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
