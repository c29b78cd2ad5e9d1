"""Where an arm can never go, whatever its joints do: an arm in a plane moves along two axes and turns about one.

It is told from the tip's Jacobians at sampled postures: what all of them lack is lost for good, what one of them lacks
is a singularity.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.points import Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.types import F64

POSTURES = 24  # sampled within the joint limits
LOST = 1e-7  # singular value over the largest one below which a direction counts as lost


class Mobility(NamedTuple):
    """What the tip cannot do in any posture, in world axes."""

    still: F64  # (a, 3) directions in which it never moves
    unturned: F64  # (b, 3) axes about which it never turns


def mobility(body: RigidBody, q_min: F64, q_max: F64) -> Mobility:
    """Return what the tip cannot do within the joint limits q_min, q_max (n,) [rad]."""
    none = Points(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0), ())
    samples = np.random.default_rng(0).uniform(q_min, q_max, (POSTURES, body.n))
    J = np.array([body.evaluate(q, np.zeros(body.n), none).J for q in samples])
    return Mobility(_lost(J[:, :3]), _lost(J[:, 3:]))


def _lost(J: F64) -> F64:
    """Return the directions (k, 3) that no J (s, 3, n) of all the samples moves in."""
    U, values, _ = np.linalg.svd(np.concatenate(list(J), axis=1))
    found: F64 = np.round(U.T[values <= LOST * values[0]], 12)
    return found
