"""The field of still obstacles gives no energy away: kinetic plus potential, analytic, through the servo's own kernels.

Bound at the Panda's configured rate, one period of delay included: the damped field never adds more than CREATED of the
energy of a unit mass at v_max, whatever it meets, at any speed up to v_max, head-on or grazing; and nothing leaves
faster than it came. Undamped, sampling alone makes a mass leave at no more than UNDAMPED times the speed it came with.
"""

from itertools import product

import numpy as np
import pytest

from rtctl.arm.field import MovingPoints, field, field_buffers
from rtctl.control.firas import FieldParams
from rtctl.types import Shape
from rtctl.world.primitives import Obstacles, obstacles_empty, with_shape
from tests.lab import robot

CREATED = 0.02
UNDAMPED = 1.07
ZERO, UPRIGHT, EYE = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.eye(3)
SHAPES = {
    "sphere": (0.05, 0.0, 0.0, 0.0),
    "box": (0.05, 0.1, 0.1, 0.0),
    "ellipsoid": (0.05, 0.15, 0.1, 0.0),
    "cone": (0.08, 0.02, 0.1, 0.0),
    "n_cylinder": (0.06, 0.1, 0.1, 4.0),
}


def potential(rho: float, p: FieldParams) -> float:
    """Return U [m2/s2]: eta/2 (1/rho - 1/rho0)^2, and its tangent where the force is capped."""
    if rho >= p.rho0:
        return 0.0
    r = max(rho, p.rho_num)
    q = 1.0 / r - 1.0 / p.rho0
    return 0.5 * p.eta * q * q + p.eta * q / r**2 * (r - rho)


def flight(table: Obstacles, p: FieldParams, speed: float, offset: float, dt: float) -> tuple[float, float]:
    """Return by how much the energy of a unit mass rose at most, and its speed when it left, over that it came with."""
    out = field_buffers(table.active.shape[0], 1, 3)
    x, v, a = np.array([0.25, offset, 0.01]), np.array([-speed, 0.0, 0.0]), ZERO
    one, link = EYE.reshape(1, 3, 3), np.ones(1, np.int64)
    least = most = 0.5 * speed * speed
    for _ in range(round(1.2 / speed / dt)):
        field(MovingPoints(x.reshape(1, 3), one, one, np.zeros(1), link), ZERO, v, table, p, out, True)
        v, x = v + dt * a, x + dt * v + 0.5 * dt * dt * a
        a = out.tau.copy()  # acts a period after what it was computed from
        energy = 0.5 * float(v @ v) + potential(float(out.rho_min[0]), p)
        least, most = min(least, energy), max(most, energy)
    return most - 0.5 * speed * speed, float(np.linalg.norm(v)) / speed


def alone(kind: str) -> Obstacles:
    shape = Shape(kind, kind, np.array(SHAPES[kind]), ZERO, UPRIGHT, ZERO, ZERO)
    return with_shape(obstacles_empty(2), 0, shape)


@pytest.mark.parametrize("kind", SHAPES)
def test_a_mass_never_gains_energy_from_what_stands_still(kind: str):
    p, dt = robot().avoid, robot().dt
    for share, offset in product((0.1, 0.4, 1.0), (0.0, 0.03, 0.08)):
        gained, left = flight(alone(kind), p, share * robot().motion.v_max, offset, dt)
        assert gained <= CREATED * 0.5 * robot().motion.v_max ** 2
        assert left <= 1.001


@pytest.mark.parametrize("kind", SHAPES)
def test_without_damping_sampling_pumps_no_more_than_the_rate_allows(kind: str):
    p = robot().avoid._replace(k_d=0.0)
    left = [flight(alone(kind), p, robot().motion.v_max, offset, robot().dt)[1] for offset in (0.0, 0.03)]
    assert min(left) > 0.99
    assert max(left) <= UNDAMPED


def test_the_bound_is_one_of_the_rate():
    """At a tenth of the rate the same undamped field does pump: the test can fail."""
    p = robot().avoid._replace(k_d=0.0)
    assert flight(alone("sphere"), p, robot().motion.v_max, 0.0, 10.0 * robot().dt)[1] > 1.2
