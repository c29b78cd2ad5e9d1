"""The task: which of the tip's six motions a goal constrains, and how far the tip is from it there.

Khatib 1987: the operational space has as many dimensions m as the task; whatever it leaves out is redundancy.
World axes, [linear; angular]. The selection S (k, 6) has orthonormal rows.
"""

import math

import numpy as np

from rtctl.kernel import kernel
from rtctl.kernel.reductions import norm
from rtctl.kernel.rotations import R_of, error_to
from rtctl.types import F64, Goal, Task

_POSITION, _ORIENTATION, _DIRECTION = int(Task.POSITION), int(Task.ORIENTATION), int(Task.DIRECTION)
_TURNS = _ORIENTATION | _DIRECTION
_SMALL = 1e-4  # series below, closed form above; see so3


@kernel
def _cross(a: F64, b: F64) -> F64:
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@kernel
def _across(a: F64) -> F64:
    """Return a unit vector perpendicular to the unit vector a (3,): across the axis that a is furthest from."""
    least = np.zeros(3)
    k = 0
    for i in range(1, 3):
        if abs(a[i]) < abs(a[k]):
            k = i
    least[k] = 1.0
    u = _cross(a, least)
    unit: F64 = u / norm(u)
    return unit


@kernel
def _turned(R: F64, v: F64) -> F64:
    """Return R v."""
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@kernel
def between(a: F64, b: F64) -> F64:
    """Return the rotation vector (3,) [rad] of the shortest turn of unit vector a to unit vector b.

    a x b times angle/sin(angle): smooth at 0; at pi, where every axis across a would do, one of them.
    """
    c = _cross(a, b)
    s, dot = norm(c), a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if s < _SMALL and dot > 0.0:
        small: F64 = c * (1.0 + s * s / 6.0)
        return small
    if s < 1e-12:
        back: F64 = _across(a) * math.pi
        return back
    full: F64 = c * (math.atan2(s, dot) / s)
    return full


@kernel
def selection(task: int, axis: F64, R: F64) -> F64:
    """Return S (k, 6): the unit rows of the task's axes; for a direction the two turns that move the tool's axis.

    task: the bits of types.Task; axis (3,) in the tip's frame and R (3, 3), the tip's orientation, for a direction.
    An arm that cannot turn freely has its own turns in the task, and points with those.
    """
    S = np.zeros((6, 6))
    k = 0
    for i in range(6):
        if task >> i & 1:
            S[k, i] = 1.0
            k += 1
    if task & _DIRECTION and not task & _ORIENTATION:
        a = _turned(R, axis)
        u = _across(a)
        w = _cross(a, u)
        for i in range(3):
            S[k, 3 + i], S[k + 1, 3 + i] = u[i], w[i]
        k += 2
    return S[:k].copy()


@kernel
def selected(task: int, axis: F64, R: F64, v: F64, w: F64) -> tuple[F64, F64]:
    """Return linear v and angular w, both (3,), without what the task leaves free: S^T S [v; w]."""
    out, turn = np.zeros(3), np.zeros(3)
    for i in range(3):
        if task >> i & 1:
            out[i] = v[i]
        if task >> (3 + i) & 1:
            turn[i] = w[i]
    if task & _DIRECTION and not task & _ORIENTATION:
        a = _turned(R, axis)
        roll = a[0] * w[0] + a[1] * w[1] + a[2] * w[2]
        for i in range(3):
            turn[i] = w[i] - roll * a[i]
    return out, turn


@kernel
def task_error(task: int, axis: F64, position: F64, wxyz: F64, x: F64, R: F64) -> tuple[F64, F64]:
    """Return the errors e (3,) [m] and e_rot (3,) [rad] of the tip at x, R against a goal, zero where it is free."""
    if task & _DIRECTION:
        w = between(_turned(R, axis), _turned(R_of(wxyz), axis))
    elif task & _ORIENTATION:
        w = error_to(R, wxyz)
    else:
        w = np.zeros(3)
    return selected(task, axis, R, position - x, w)


def error_of(goal: Goal, x: F64, R: F64) -> tuple[float, float]:
    """Return how far [m] and by what angle [rad] the tip at x (3,), R (3, 3) misses a goal; 0 where it is free."""
    e, e_rot = task_error(int(goal.task), goal.axis, goal.position, goal.wxyz, x, R)
    return norm(e), norm(e_rot)


def turns(task: Task) -> bool:
    """Return whether the task constrains a rotation."""
    return bool(int(task) & _TURNS)


def point_of(goal: Goal, free: F64) -> F64:
    """Return the goal's position (3,) [m] with the coordinates that its task leaves out taken from `free` (3,)."""
    bits = int(goal.task)
    if bits & _POSITION == _POSITION:
        return goal.position
    return np.array([goal.position[i] if bits >> i & 1 else free[i] for i in range(3)])


@kernel
def point_along(task: int, position: F64, free: F64) -> F64:
    """Return `point_of` a goal's position (3,) [m] under a task."""
    out = position.copy()
    for i in range(3):
        if not task >> i & 1:
            out[i] = free[i]
    return out


def within(task: Task, axes: Task) -> tuple[Task, str]:
    """Return what of a task an arm that moves along `axes` can do, or why it can do none of it.

    A coordinate that the arm cannot change is left out in silence; a rotation that it cannot make is refused.
    """
    bits, able = int(task), int(axes)
    turn = bits & _TURNS
    if turn and not able & _ORIENTATION:
        return task, f"goal: asks for an orientation, wanted none: this arm moves along {names(axes)}"
    left = bits & _POSITION & able
    if turn & _DIRECTION:
        left |= _DIRECTION | (0 if able & _ORIENTATION == _ORIENTATION else able & _ORIENTATION)
    else:
        left |= turn & able
    if not left:
        return task, f"goal: asks for {names(task)}, wanted something of {names(axes)}: this arm moves no other way"
    return Task(left), ""


def names(task: Task) -> str:
    """Return the task in words: pose, position, xy, direction, ..."""
    bits = int(task)
    if bits == int(Task.POSE):
        return "pose"
    linear = "".join(letter for i, letter in enumerate("xyz") if bits >> i & 1)
    parts = ["position" if linear == "xyz" else linear] if linear else []
    if bits & _DIRECTION:
        parts.append("direction")
    elif bits & _ORIENTATION == _ORIENTATION:
        parts.append("orientation")
    else:
        parts += [f"r{letter}" for i, letter in enumerate("xyz") if bits >> (3 + i) & 1]
    return " ".join(parts) or "nothing"
