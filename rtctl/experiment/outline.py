"""What an arm's links look like from a direction, as polygons of a page."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from rtctl.arm.rigid_body import RigidBody
from rtctl.design.solids import solids_of
from rtctl.types import F64
from rtctl.world.outline import Projection, axis_view, outline, view

__all__ = ["Figurine", "Piece", "Projection", "axis_view", "outline", "view"]


class Piece(NamedTuple):
    """The outline of one solid of an arm."""

    polygon: F64  # (k, 2) [m]
    height: float  # [m] towards the beholder, of its middle
    link: int


class Figurine:
    """An arm to be drawn: its collision solids and its joints."""

    def __init__(self, body: RigidBody) -> None:
        """`body` is used for its kinematics alone."""
        self.body = body
        self.solids = solids_of(body)
        self.joint_of = {link: joint for joint, link in body.link_of.items()}

    def _placed(self, q: F64) -> dict[int, tuple[F64, F64]]:
        """Return orientation (3, 3) and position (3,) [m] of each link at q (n,)."""
        pin.forwardKinematics(self.body.model, self.body.data, self.body.configuration(q))
        oMi = self.body.data.oMi
        return {link: (np.array(oMi[j].rotation), np.array(oMi[j].translation)) for link, j in self.joint_of.items()}

    def joints(self, q: F64) -> F64:
        """Return the origins (n, 3) [m] of the joint frames, from the base to the tip."""
        placed = self._placed(q)
        return np.array([placed[link][1] for link in range(1, self.body.n + 1)])

    def pieces(self, q: F64, seen: Projection) -> list[Piece]:
        """Return the outlines of all solids at q (n,), the farthest from the beholder first."""
        placed, found = self._placed(q), []
        for solid in self.solids:
            R, t = placed[solid.link]
            corners = solid.corners @ R.T + t
            flat = seen.of(corners)
            ring = flat[ConvexHull(flat).vertices]
            found.append(Piece(ring, float(corners.mean(axis=0) @ seen.toward), solid.link))
        return sorted(found, key=lambda piece: piece.height)
