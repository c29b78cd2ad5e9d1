"""Where an arm can never go, whatever its joints do: an arm in a plane moves along two axes and turns about one.

A direction that no posture moves in is not a singularity, and a goal out of that plane is no goal. Both are told from
the tip's Jacobians at sampled postures: what all of them lack is lost for good, what one of them lacks is not.
"""

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rtctl.control.points import Points
from rtctl.control.so3 import error_to
from rtctl.types import F64, I64, Goal, Task

if TYPE_CHECKING:
    from rtctl.control.model import RigidBody

POSTURES = 24  # sampled within the joint limits
LOST = 1e-7  # singular value over the largest one below which a direction counts as lost
POSITION, POSE = 0b000111, 0b111111  # masks of task rows


class Mobility(NamedTuple):
    """What the tip can do in some posture; rows are [x y z, about x y z] of the world, row i is bit i of a mask."""

    rank: I64  # (64,) by mask of rows: the most of them that one posture moves independently
    still: F64  # (a, 3) directions in which the tip never moves
    unturned: F64  # (b, 3) axes about which it never turns
    x: F64  # (3,) [m] the tip at home
    R: F64  # (3, 3) its orientation there


def mobility(body: "RigidBody", q_min: F64, q_max: F64, q_home: F64, length: float) -> Mobility:
    """Return what the tip can do within the joint limits; length [m] makes angular rows comparable to linear ones."""
    none = Points(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0), ())
    samples = np.random.default_rng(0).uniform(q_min, q_max, (POSTURES, body.n))
    home = body.evaluate(q_home, np.zeros(body.n), none)
    scale = np.repeat([1.0, length], 3)[:, None]
    J = np.array([home.J, *(body.evaluate(q, np.zeros(body.n), none).J for q in samples)]) * scale
    size = float(np.linalg.norm(J, 2, axis=(1, 2)).max())
    rank = np.zeros(64, dtype=np.int64)
    for count in range(1, 7):
        for rows in combinations(range(6), count):
            values = np.linalg.svd(J[:, rows, :], compute_uv=False)
            rank[sum(1 << row for row in rows)] = int((values > LOST * size).sum(axis=1).max())
    return Mobility(rank, _lost(J[:, :3], size), _lost(J[:, 3:], size), home.x, home.R)


def _lost(J: F64, size: float) -> F64:
    """Return the directions (k, 3) that no J (s, 3, n) of all the samples moves in."""
    rows = np.concatenate(list(J), axis=1)
    U, values, _ = np.linalg.svd(rows, full_matrices=True)
    found: F64 = np.round(U.T[np.append(values, np.zeros(3 - len(values)))[:3] <= LOST * size], 12)
    return found


def refusal(goal: Goal, m: Mobility) -> str:
    """Return why no posture can bring the tip to a goal, '' where only its reach and its joints could tell."""
    away = m.still @ (goal.position - m.x)
    if len(away) and float(np.abs(away).max()) > goal.tolerance:
        k = int(np.abs(away).argmax())
        return f"goal: got {away[k]:.3g} m along {_axis(m.still[k])}, in which this arm never moves"
    if goal.task == Task.POSE and len(m.unturned) >= 2:  # it turns about one axis at most, so turns commute
        turned = m.unturned @ error_to(m.R, goal.wxyz)
        if float(np.abs(turned).max()) > goal.tolerance_rot:
            k = int(np.abs(turned).argmax())
            return f"goal: got a turn of {turned[k]:.3g} rad about {_axis(m.unturned[k])}, which this arm never makes"
    return ""


def _axis(v: F64) -> str:
    return "(" + " ".join(f"{float(c):.3g}" for c in v + 0.0) + ")"
