"""Escape from a local minimum: circulation around what blocks the way, for as long as it makes progress.

The obstacles' torque accelerates the tip along n = a/|a|, a = J A^-1 tau_obstacles: along n nothing gives. The tip is
sent along t = b x n, across it, and a little against it, so that the field's own balance keeps it at the boundary;
b stays for a whole side, so that the tip does not turn back. As in the Bug planners the circulation ends where the goal
is nearer than where it began and the way there is no longer opposed; a side that stalls or takes too long is given up
for the other one, once. All of it is a direction for the motion task: speed limit, field and guards are untouched.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from rtctl.arm.model import Model
from rtctl.arm.osc import MotionParams
from rtctl.arm.task import selected
from rtctl.kernel import kernel
from rtctl.kernel.linalg import matvec
from rtctl.kernel.reductions import norm
from rtctl.types import F64, Goal
from rtctl.world.primitives import Obstacles, distances_into

STALL = 0.3  # [s] at rest before obstacles that hold the arm are circulated
SLOW = 0.5  # [s] at rest while circulating: this side is a dead end
SIDE_TIME = 5.0  # [s] for the first side; the other has twice that, for it begins with the way back
GAIN = 0.03  # [m] nearer to the goal than ever: progress
EXCURSION = 0.5  # [m] farther from the goal than where it began, and a side is given up
SPEED = 0.6  # of v_max
PRESS = 0.3  # inward part of the direction where the field pushes
WRAP = 1.2  # inward part where it does not: around an edge, back to the boundary
FELT = 0.3  # [m/s2] of a, below it the field does not count as pushing
OPPOSED = -0.2  # cosine between a and the way to the goal, below it the way is blocked
DIRECTIONS = 8  # tried for the first side, one a tick
LEAST = 0.7  # of a direction that must lie along the axes that the goal asks for
RADII = np.array([0.1, 0.2, 0.3, 0.45, 0.6, 0.8])  # [m] of the detours compared


class Phase(IntEnum):
    """Where an escape stands."""

    NONE = 0
    CHOOSING = 1  # which side to begin with
    FIRST = 2
    OTHER = 3
    GIVEN_UP = 4


_NONE, _FIRST, _OTHER, _GIVEN_UP = (int(p) for p in (Phase.NONE, Phase.FIRST, Phase.OTHER, Phase.GIVEN_UP))


class Escape(NamedTuple):
    """One escape; the values of an older one stay for the progress test."""

    phase: int = Phase.NONE  # a Phase; compiled code gives its number
    hit: float = np.inf  # [m] to the goal where it began: later ones must begin nearer
    n: F64 = np.zeros(3)  # the last direction of the push
    b: F64 = np.zeros(3)  # axis of the circulation
    costs: F64 = np.zeros(DIRECTIONS)  # [m] of the detours compared so far
    ticks: int = 0  # in this phase
    slow: int = 0  # ticks the tip has been at rest in it

    @property
    def active(self) -> bool:
        """Whether the tip circulates."""
        return self.phase in (Phase.FIRST, Phase.OTHER)


def begun(old: Escape, d: float, push: F64) -> Escape:
    """Return the escape from a stall at d [m] from the goal under the push (3,) [m/s2], or the giving up of it."""
    if d > old.hit - GAIN:
        return old._replace(phase=Phase.GIVEN_UP, ticks=0, slow=0)
    return Escape(Phase.CHOOSING, d, push / max(norm(push), 1e-12))


@kernel
def push_along(model: Model, tau_obstacles: F64, task: int, axis: F64) -> F64:
    """Return `push_of` a goal with this task and axis (3,) of the tool."""
    a = matvec(model.J, matvec(model.A_inv, tau_obstacles))
    return selected(task, axis, model.R, a[:3], a[3:])[0]


def push_of(model: Model, tau_obstacles: F64, goal: Goal) -> F64:
    """Return the acceleration (3,) [m/s2] that the obstacles' torque (n,) [Nm] gives the tip where the goal is asked.

    Along what the goal leaves free the tip is sent nowhere, so that an escape along it would be none.
    """
    return push_along(model, np.ascontiguousarray(tau_obstacles), int(goal.task), goal.axis)


@kernel
def advance(s: Escape, e: F64, push: F64, still: bool, dt: float) -> Escape:
    """Return the escape a tick later.

    s: with its phase as an integer. e (3,) [m] to the goal; push (3,) [m/s2] of the obstacles on the tip; still: the
    tip is at rest.
    """
    d, a = norm(e), norm(push)
    if s.phase == _GIVEN_UP:
        return Escape(_NONE if d < s.hit - GAIN else _GIVEN_UP, s.hit, s.n, s.b, s.costs, s.ticks, s.slow)
    if s.phase != _FIRST and s.phase != _OTHER:
        return s
    ticks, slow, n = s.ticks + 1, s.slow + 1 if still else 0, push / a if a > FELT else s.n
    if d < s.hit - GAIN and (a <= FELT or _dot(push, e) > OPPOSED * a * d):
        return Escape(_NONE, s.hit, n, s.b, s.costs, ticks, slow)
    bound = SIDE_TIME if s.phase == _FIRST else 2.0 * SIDE_TIME
    back = s.phase == _OTHER and ticks * dt < SIDE_TIME  # it begins where the first side ended
    if ticks * dt < bound and slow * dt < SLOW and (back or d < s.hit + EXCURSION):
        return Escape(s.phase, s.hit, n, s.b, s.costs, ticks, slow)
    if s.phase == _FIRST:
        return Escape(_OTHER, s.hit, n, -s.b, s.costs, 0, 0)
    return Escape(_GIVEN_UP, s.hit, n, s.b, s.costs, 0, 0)


@kernel
def way(n: F64, b: F64, push: F64, motion: MotionParams) -> F64:
    """Return the error (3,) [m] that sends the tip at SPEED v_max across the push and a little against it.

    n, b (3,): of the Escape; push (3,) [m/s2].
    """
    inward = PRESS if norm(push) > FELT else WRAP
    t = np.empty(3)
    t[0] = b[1] * n[2] - b[2] * n[1] - inward * n[0]
    t[1] = b[2] * n[0] - b[0] * n[2] - inward * n[1]
    t[2] = b[0] * n[1] - b[1] * n[0] - inward * n[2]
    v, k = SPEED * motion.v_max, motion.k_p / motion.k_v
    knee = motion.a_max / (k * k)
    length = v / k if v <= k * knee else 0.5 * (v * v / motion.a_max + knee)  # the inverse of osc.approach_speed
    out: F64 = t * (length / max(norm(t), 1e-12))
    return out


def chosen(
    s: Escape,
    model: Model,
    x: F64,
    goal: Goal,
    obstacles: Obstacles,
    base: F64,
    reach: float,
    rho0: float,
    epsilon: float,
) -> Escape:
    """Return the escape with one more detour compared; with the last one the first side is chosen.

    x, base (3,) [m]; goal: with the tip's own coordinates where it asks for none; reach, rho0 [m]; epsilon [1/kg]: a
    direction with less mobility is none.
    """
    t, ahead = _asked(_tangent(s.n, s.ticks), goal)
    costs = s.costs.copy()
    mobile = ahead and _dot(t, matvec(np.ascontiguousarray(model.Lambda_inv[:3, :3]), t)) > 2.0 * epsilon
    costs[s.ticks] = detour(x, t, goal.position, obstacles, base, reach, rho0) if mobile else np.inf
    s = s._replace(costs=costs, ticks=s.ticks + 1)
    if s.ticks < DIRECTIONS:
        return s
    if not np.isfinite(costs).any():
        return s._replace(phase=Phase.GIVEN_UP, ticks=0, slow=0)
    t, _ = _asked(_tangent(s.n, int(costs.argmin())), goal)
    return s._replace(phase=Phase.FIRST, b=np.cross(s.n, t), ticks=0, slow=0)


def _asked(t: F64, goal: Goal) -> tuple[F64, bool]:
    """Return the part of the unit vector t (3,) along the axes that the goal asks for, as such, and whether any is."""
    part = np.array([t[i] if int(goal.task) >> i & 1 else 0.0 for i in range(3)])
    size = norm(part)
    return (part / size, True) if size > LEAST else (part, False)


@kernel
def detour(x: F64, t: F64, goal: F64, obstacles: Obstacles, base: F64, reach: float, rho0: float) -> float:
    """Return the length [m] of the shortest free detour x -> x + r t -> goal over the RADII; long where none is free.

    A look at the surroundings of the tip alone, to choose a side by: the arm behind it may not pass.
    """
    out = np.empty((obstacles.active.shape[0], 4, 1))
    run = 0.0
    for r in RADII:
        p = x + r * t
        if norm(p - base) > reach or _clear(x + 0.5 * (run + r) * t, obstacles, out) < 0.2 * rho0:
            break
        if _clear(p, obstacles, out) < 0.2 * rho0:
            break
        run = r
        away = norm(goal - p)
        steps = int(away / (0.5 * rho0)) + 1
        free = True
        for k in range(1, steps):
            if _clear(p + (goal - p) * (k / steps), obstacles, out) < 0.5 * rho0:
                free = False
                break
        if free:
            return float(r + away)
    return 10.0 * reach - run


@kernel
def _clear(x: F64, obstacles: Obstacles, out: F64) -> float:
    distances_into(x.copy().reshape(3, 1), np.zeros(1), obstacles, np.inf, out)
    least = np.inf
    for k in range(out.shape[0]):
        least = min(least, out[k, 0, 0])
    return float(least)


@kernel
def _tangent(n: F64, k: int) -> F64:
    """Return the k-th of DIRECTIONS unit vectors across n (3,), evenly around it; the first is the most upward."""
    up = np.array([0.0, 0.0, 1.0])
    if abs(n[2]) > 0.9:
        up = np.array([1.0, 0.0, 0.0])
    first = up - (n[0] * up[0] + n[1] * up[1] + n[2] * up[2]) * n
    first = first / norm(first)
    other = np.array(
        [n[1] * first[2] - n[2] * first[1], n[2] * first[0] - n[0] * first[2], n[0] * first[1] - n[1] * first[0]]
    )
    angle = 2.0 * np.pi * k / DIRECTIONS
    out: F64 = np.cos(angle) * first + np.sin(angle) * other
    return out


@kernel
def _dot(a: F64, b: F64) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
