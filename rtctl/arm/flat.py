"""Values as flat arrays, for the border between Python and compiled code: an array crosses in the time of one number.

    parameters  the model of the last evaluation and the task space that goes with it; changes at the model rate
    table       what changes of K obstacle slots in every tick: p, R, margin, age, rho, goal_rho
    shapes      what an edit alone changes of them: kind, active, moving, group, v, w, dims, room

Inside, they are the named tuples again, whose arrays are views.
"""

import numpy as np

from rtctl.arm.field import Field
from rtctl.arm.model import Model
from rtctl.arm.osc import MotionParams, OperationalSpace, _operational_space
from rtctl.arm.task import selection
from rtctl.control.firas import ROOM
from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64
from rtctl.world.primitives import Obstacles

TABLE = 16  # numbers of a slot in the table: p 3, R 9, margin, age, rho, goal_rho
SHAPES = 19  # and in the shapes: kind, active, moving, group, v 3, w 3, dims 5, room 4; then creep, stale of them all
BODIES = tuple[F64, tuple[F64, F64, F64, F64]]  # mesh and clouds of `Obstacles`


@kernel
def _put(out: F64, at: int, values: F64) -> int:
    """Write the values of an array of any shape to out from `at` on; return where they end."""
    flat = values.reshape(-1)
    for i in range(flat.shape[0]):
        out[at + i] = flat[i]
    return at + flat.shape[0]


@kernel
def parameters_of(model: Model, task: int, axis: F64, motion: MotionParams) -> F64:
    """Return the parameters: the model, and the operational space of a task with this axis (3,) of the tool."""
    n, m, pairs = model.q.shape[0], model.P.shape[0], model.own_rho.shape[0]
    S = selection(task, axis, model.R)
    Lambda, Jbar, NT, sigma_min, damped = _operational_space(
        model.J, model.A_inv, model.Lambda_inv, S, motion.epsilon, motion.length
    )
    out = np.empty(92 + 16 * n + 3 * n * n + 12 * m + 3 * m * n + pairs * (1 + n))
    out[0], out[1] = sigma_min, 1.0 if damped else 0.0
    at = 2
    for v in (model.q, model.qd, model.h, model.g, model.x, model.Jdqd, model.own_rho):
        at = _put(out, at, v)
    for M in (model.A, model.A_inv, model.R, model.J, model.P, model.Lambda_inv, model.own_row, Lambda, Jbar, NT):
        at = _put(out, at, M)
    for T in (model.Jp, model.B):
        at = _put(out, at, T)
    return out[:at].copy()


@kernel
def model_in(p: F64, n: int, m: int) -> tuple[Model, OperationalSpace]:
    """Return the model and the space in the parameters p of n joints and m points."""
    pairs = (p.shape[0] - (92 + 16 * n + 3 * n * n + 12 * m + 3 * m * n)) // (1 + n)
    a = 2 + 4 * n
    rho = a + 9
    A = rho + pairs
    A_inv = A + n * n
    R = A_inv + n * n
    J = R + 9
    P = J + 6 * n
    Lambda_inv = P + 3 * m
    row = Lambda_inv + 36
    Lambda = row + pairs * n
    Jbar = Lambda + 36
    NT = Jbar + 6 * n
    Jp = NT + n * n
    B = Jp + 3 * m * n
    model = Model(
        p[2 : 2 + n],
        p[2 + n : 2 + 2 * n],
        p[A:A_inv].reshape(n, n),
        p[A_inv:R].reshape(n, n),
        p[2 + 2 * n : 2 + 3 * n],
        p[2 + 3 * n : a],
        p[a : a + 3],
        p[R:J].reshape(3, 3),
        p[J:P].reshape(6, n),
        p[a + 3 : rho],
        p[P:Lambda_inv].reshape(m, 3),
        p[Jp:B].reshape(m, 3, n),
        p[B : B + 9 * m].reshape(m, 3, 3),
        p[Lambda_inv:row].reshape(6, 6),
        p[rho:A],
        p[row:Lambda].reshape(pairs, n),
    )
    space = OperationalSpace(
        p[Lambda:Jbar].reshape(6, 6), p[Jbar:NT].reshape(n, 6), p[NT:Jp].reshape(n, n), p[0], p[1] != 0.0
    )
    return model, space


@kernel
def shapes_of(obstacles: Obstacles, moving: B1, creep: float, stale: float) -> F64:
    """Return the shapes of the obstacles; moving (K,), creep [m/s], stale [s]: of `obstacle_table.World`."""
    slots = moving.shape[0]
    out = np.empty(SHAPES * slots + 2)
    for k in range(slots):
        out[k], out[slots + k] = obstacles.kind[k], 1.0 if obstacles.active[k] else 0.0
        out[2 * slots + k], out[3 * slots + k] = 1.0 if moving[k] else 0.0, obstacles.group[k]
    at = _put(out, 4 * slots, obstacles.v)
    at = _put(out, at, obstacles.w)
    at = _put(out, at, obstacles.dims)
    at = _put(out, at, obstacles.room)
    out[at], out[at + 1] = creep, stale
    return out


@kernel
def table_of(obstacles: Obstacles, age: F64, rho: F64, goal_rho: F64) -> F64:
    """Return the table of the obstacles, observed age (K,) [s] ago, rho [m] from the arm and goal_rho from the goal."""
    out = np.empty(TABLE * age.shape[0])
    at = _put(out, 0, obstacles.p)
    at = _put(out, at, obstacles.R)
    for values in (obstacles.margin, age, rho, goal_rho):
        at = _put(out, at, values)
    return out


@kernel
def obstacles_in(t: F64, shapes: F64, bodies: BODIES) -> tuple[Obstacles, B1]:
    """Return the obstacles in a table and their shapes, and which of them move (K,)."""
    slots = t.shape[0] // TABLE
    kind, group = np.empty(slots, np.int64), np.empty(slots, np.int64)
    active, moving = np.empty(slots, np.bool_), np.empty(slots, np.bool_)
    for k in range(slots):
        kind[k], group[k] = int(shapes[k]), int(shapes[3 * slots + k])
        active[k], moving[k] = shapes[slots + k] != 0.0, shapes[2 * slots + k] != 0.0
    v, w, dims = shapes[4 * slots : 7 * slots], shapes[7 * slots : 10 * slots], shapes[10 * slots : 15 * slots]
    return Obstacles(
        kind,
        active,
        t[3 * slots : 12 * slots].reshape(slots, 3, 3),
        t[: 3 * slots].reshape(slots, 3),
        v.reshape(slots, 3),
        w.reshape(slots, 3),
        dims.reshape(slots, 5),
        group,
        t[12 * slots : 13 * slots],
        shapes[15 * slots : 19 * slots].reshape(slots, 4),
        bodies[0],
        bodies[1],
    ), moving


@kernel
def row_of(t: F64, row: int) -> F64:
    """Return a row (K,) of the table: 12 margin, 13 age, 14 rho, 15 goal_rho."""
    slots = t.shape[0] // TABLE
    return t[row * slots : (row + 1) * slots]


MARGIN, AGE, RHO, GOAL_RHO = 12, 13, 14, 15


@kernel
def field_in(reals: F64, wholes: I64, n: int, m: int, slots: int) -> Field:
    """Return the work arrays of the field at the head of two flat ones; see `field_sizes`."""
    a = n + 4 * slots
    b = a + 6 * slots * m
    c = b + 15 * m
    d = c + slots * (n + 1)
    return Field(
        reals[:n],
        reals[n : n + slots],
        wholes[:slots],
        reals[n + slots : a].reshape(slots, 3),
        reals[a:b].reshape(slots, 6, m),
        reals[b:c].reshape(15, m),
        reals[c:d].reshape(slots, n + 1),
        reals[d : d + ROOM * slots].reshape(slots, ROOM),
        wholes[slots : 2 * slots],
        wholes[3 * slots : (3 + m) * slots].reshape(slots, m),
        wholes[2 * slots : 3 * slots],
    )


def field_sizes(slots: int, m: int, n: int) -> tuple[int, int]:
    """Return how many real and whole numbers the work arrays of K = `slots` obstacles, m points, n joints are."""
    return n + slots * (5 + n + ROOM + 6 * m) + 15 * m, slots * (3 + m)
