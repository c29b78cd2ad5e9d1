"""Position and velocity of the base from reports of any age: a Kalman filter per axis on a unit mass.

State (x, v), process noise = acceleration not reported; measurements are positions with their velocities, carried on
from when they were made to now. Between reports the state is predicted. filterpy is its oracle in the tests.
"""

from typing import NamedTuple

import numpy as np

from rtctl.rover.robot import Noise
from rtctl.types import F64


class Estimate(NamedTuple):
    """The base on the plane."""

    x: F64  # (2,) [m]
    v: F64  # (2,) [m/s]
    P: F64  # (2, 2) covariance of (x, v), the same on both axes
    yaw: float  # [rad]
    yaw_rate: float  # [rad/s]


def start(x: F64, yaw: float, noise: Noise) -> Estimate:
    """Return the estimate at rest at x (2,) [m], yaw [rad]."""
    P = np.diag([noise.position**2, noise.velocity**2])
    return Estimate(x.astype(np.float64), np.zeros(2), P, yaw, 0.0)


def predicted(e: Estimate, elapsed: float, noise: Noise) -> Estimate:
    """Return the estimate `elapsed` [s] later: x += v t; P = F P F' + Q of a random acceleration."""
    t = elapsed
    F = np.array([[1.0, t], [0.0, 1.0]])
    g = np.array([0.5 * t * t, t])
    P = F @ e.P @ F.T + noise.acceleration**2 * np.outer(g, g)
    return e._replace(x=e.x + t * e.v, P=P, yaw=wrapped(e.yaw + t * e.yaw_rate))


def measured(e: Estimate, x: F64, v: F64, age: float, noise: Noise) -> tuple[Estimate, float]:
    """Return the estimate after a report x, v (2,) made `age` [s] ago, and the innovation of its position [m].

    The report is carried on by its own velocity; what may have happened meanwhile adds to its noise.
    """
    drift = 0.5 * noise.acceleration * age * age
    R = np.diag([noise.position**2 + drift**2, noise.velocity**2 + (noise.acceleration * age) ** 2])
    S = e.P + R
    K = e.P @ np.linalg.inv(S)
    dx, dv = x + age * v - e.x, v - e.v
    new_x = e.x + K[0, 0] * dx + K[0, 1] * dv
    new_v = e.v + K[1, 0] * dx + K[1, 1] * dv
    keep = np.eye(2) - K
    P = keep @ e.P @ keep.T + K @ R @ K.T  # Joseph: stays symmetric
    return e._replace(x=new_x, v=new_v, P=P), float(np.hypot(dx[0], dx[1]))


def wrapped(angle: float) -> float:
    """Return the angle in [-pi, pi)."""
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
