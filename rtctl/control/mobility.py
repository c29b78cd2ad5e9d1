"""Where an arm can never go, whatever its joints do: an arm in a plane moves along two axes and turns about one.

A goal out of that plane is no goal. It is told from the tip's Jacobians at sampled postures: what all of them lack is
lost for good, what one of them lacks is a singularity.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rtctl.control import task
from rtctl.control.points import Points
from rtctl.control.so3 import error_to
from rtctl.types import F64, Goal, Task

if TYPE_CHECKING:
    from rtctl.control.model import RigidBody

POSTURES = 24  # sampled within the joint limits
LOST = 1e-7  # singular value over the largest one below which a direction counts as lost


class Mobility(NamedTuple):
    """What the tip can do in some posture, in world axes."""

    still: F64  # (a, 3) directions in which the tip never moves
    unturned: F64  # (b, 3) axes about which it never turns
    x: F64  # (3,) [m] the tip at home
    R: F64  # (3, 3) its orientation there


def mobility(body: "RigidBody", q_min: F64, q_max: F64, q_home: F64) -> Mobility:
    """Return what the tip can do within the joint limits q_min, q_max (n,) [rad]."""
    none = Points(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0), ())
    samples = np.random.default_rng(0).uniform(q_min, q_max, (POSTURES, body.n))
    home = body.evaluate(q_home, np.zeros(body.n), none)
    J = np.array([home.J, *(body.evaluate(q, np.zeros(body.n), none).J for q in samples)])
    return Mobility(_lost(J[:, :3]), _lost(J[:, 3:]), home.x, home.R)


def _lost(J: F64) -> F64:
    """Return the directions (k, 3) that no J (s, 3, n) of all the samples moves in."""
    U, values, _ = np.linalg.svd(np.concatenate(list(J), axis=1))
    found: F64 = np.round(U.T[values <= LOST * values[0]], 12)
    return found


def refusal(goal: Goal, m: Mobility) -> str:
    """Return why no posture can bring the tip to a goal, '' where only its reach and its joints could tell."""
    away = m.still @ (task.point_of(goal, m.x) - m.x)
    if len(away) and float(np.abs(away).max()) > goal.tolerance:
        k = int(np.abs(away).argmax())
        return f"goal: got {away[k]:.3g} m along {_axis(m.still[k])}, in which this arm never moves"
    if goal.task & Task.POSE == Task.POSE and len(m.unturned) >= 2:  # it turns about one axis at most, so turns commute
        turned = m.unturned @ error_to(m.R, goal.wxyz)
        if float(np.abs(turned).max()) > goal.tolerance_rot:
            k = int(np.abs(turned).argmax())
            return f"goal: got a turn of {turned[k]:.3g} rad about {_axis(m.unturned[k])}, which this arm never makes"
    return ""


def _axis(v: F64) -> str:
    return "(" + " ".join(f"{float(c):.3g}" for c in v + 0.0) + ")"
