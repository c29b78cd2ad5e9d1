"""A free unit mass under the product's own kernels: the paper's point in the artificial potential field.

The plant is exact: a force held for a period moves the mass by v dt + a dt^2/2.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.field import MovingPoints, field
from rtctl.arm.osc import TASK_BRAKE, TASK_DRIVE, MotionParams, TaskDynamics, Twist, motion_torque, velocity_reference
from rtctl.control.firas import FieldParams, field_buffers
from rtctl.types import F64, Shape
from rtctl.world.primitives import Obstacles, distances, obstacles_empty, with_shape

EYE = np.eye(3)
J6 = np.vstack([EYE, np.zeros((3, 3))])
LAMBDA = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
ONE = np.ones(1, np.int64)
ZERO3, ZERO6 = np.zeros(3), np.zeros(6)
FAST = np.full(3, 1e3)  # [m/s] the mass has no joints that could be too slow


class Flight(NamedTuple):
    """A path of the mass, a row a period, the start included."""

    t: F64  # (T,) [s]
    x: F64  # (T, 3) [m]
    v: F64  # (T, 3) [m/s]
    rho: F64  # (T,) [m] exact distance to the nearest obstacle

    @property
    def least(self) -> float:
        """Return the smallest distance [m]."""
        return float(self.rho.min())


def obstacles_of(*shapes: Shape) -> Obstacles:
    """Return a table of obstacles."""
    table = obstacles_empty(len(shapes))
    for slot, shape in enumerate(shapes):
        table = with_shape(table, slot, shape)
    return table


def motion_params(v_max: float, a_max: float, k_p: float) -> MotionParams:
    """Return the gains of a critically damped unit mass: speed [m/s], acceleration [m/s2], k_p [1/s2]."""
    k_v = 2.0 * float(np.sqrt(k_p))
    return MotionParams(k_p, k_v, v_max, a_max, 1.0, 1.0, 0.0, 1.0, np.ones(3), 0.0, 1.0, 1.0)


class Mass:
    """A unit mass in a field, moved period by period."""

    def __init__(self, obstacles: Obstacles, params: FieldParams, dt: float) -> None:
        """`params` of the field, `dt` [s] the servo period."""
        self.obstacles, self.params, self.dt = obstacles, params, dt
        self.out = field_buffers(obstacles.active.shape[0], 1, 3)
        self.radius = np.zeros(1)
        self.Jp, self.B = EYE[None].copy(), EYE[None].copy()

    def push(self, x: F64, v: F64) -> F64:
        """Return the field's force (3,) [N] on the mass."""
        point = MovingPoints(x[None], self.Jp, self.B, self.radius, ONE)
        field(point, ZERO3, v, self.obstacles, self.params, self.out, True)
        return self.out.tau.copy()

    def fly(
        self, x: F64, v: F64, duration: float, goal: F64 | None = None, motion: MotionParams | None = None
    ) -> Flight:
        """Return the path from x (3,) [m] at v (3,) [m/s]; with a goal (3,) the straight-line motion pulls as well."""
        steps = round(duration / self.dt)
        X, V = np.empty((steps + 1, 3)), np.empty((steps + 1, 3))
        X[0], V[0] = x, v
        v_ref, w_ref = v.copy(), np.zeros(3)
        for k in range(steps):
            a = self.push(X[k], V[k])
            if goal is not None and motion is not None:
                v_ref, w_ref, pull = self._pull(X[k], V[k], goal, motion, v_ref, w_ref)
                a += pull
            X[k + 1] = X[k] + self.dt * V[k] + 0.5 * self.dt**2 * a
            V[k + 1] = V[k] + self.dt * a
        rho = distances(X, np.zeros(len(X)), self.obstacles)[0].min(axis=0)
        return Flight(np.arange(steps + 1, dtype=np.float64) * self.dt, X, V, rho)

    def _pull(self, x: F64, v: F64, goal: F64, p: MotionParams, v_ref: F64, w_ref: F64) -> tuple[F64, F64, F64]:
        """Return the slewed references and the force (3,) of the motion task: tau = J^T Lambda F*."""
        at, actual, reference = (
            TaskDynamics(J6, ZERO6, EYE, LAMBDA, np.zeros((3, 3))),
            Twist(v, ZERO3),
            Twist(*np.empty((2, 3))),
        )
        velocity_reference(
            Twist(goal - x, ZERO3), Twist(v_ref, w_ref), actual, J6.T.copy(), v, FAST, p, self.dt, reference
        )
        F, parts = np.empty(6), np.empty((4, 3))
        motion_torque(at, actual, reference, x, v, x, p, F, parts)
        return reference.linear, reference.angular, parts[TASK_DRIVE] + parts[TASK_BRAKE]


def potential(rho: F64, params: FieldParams) -> F64:
    """Return U = eta/2 (1/rho - 1/rho0)^2 [m2/s2] of a unit mass, infinite in contact (eq. 17)."""
    with np.errstate(divide="ignore"):
        s = np.where(rho > 0.0, 1.0 / np.maximum(rho, 1e-300) - 1.0 / params.rho0, np.inf)
    return 0.5 * params.eta * np.maximum(s, 0.0) ** 2


def turning_distance(speed: float, params: FieldParams) -> float:
    """Return where a unit mass that comes straight at a surface turns [m]: v^2/2 = U(rho), without damping."""
    return 1.0 / (1.0 / params.rho0 + speed / float(np.sqrt(params.eta)))
