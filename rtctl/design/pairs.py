"""Which links of an arm can meet: hulls of the collision geometry, and the pairs worth measuring at run time."""

import coal
import numpy as np

from rtctl.arm.model import RigidBody
from rtctl.arm.self_collision import Hull, Own
from rtctl.design.solids import solids_of
from rtctl.types import F64

POSTURES = 2000  # sampled within the joint limits to see which links can meet
CROOK = 0.1  # [m] links two joints apart and nearer than this at home are not watched: see `watched`
SAFE = 0.15  # [m] links that stay farther apart than this in all of them are not watched: samples miss what is rare,
SAFE_NEAR = 0.03  # [m] but not of links two joints apart: how these are to each other is soon seen


def hulls_of(body: RigidBody) -> list[Hull]:
    """Return one hull per URDF link that has collision geometry, the base's included."""
    corners: dict[str, list[F64]] = {}
    link: dict[str, int] = {}
    for solid in solids_of(body):
        corners.setdefault(solid.name, []).append(solid.corners)
        link[solid.name] = solid.link
    return [_hull(link[name], name, np.concatenate(parts)) for name, parts in corners.items()]


def _hull(link: int, name: str, corners: F64) -> Hull:
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(0, len(corners))
    mesh.addVertices(np.ascontiguousarray(corners))
    mesh.endModel()
    mesh.buildConvexHull(True, "Qt")
    centre = 0.5 * (corners.min(0) + corners.max(0))
    radius = float(np.sqrt(((corners - centre) ** 2).sum(1)).max())
    return Hull(link, name, mesh.convex, corners, centre, radius)


def watched(body: RigidBody, q_min: F64, q_max: F64, q_home: F64, clearance: float, reach: float) -> Own:
    """Return the pairs of links that can meet within the joint limits and are clear of each other at home.

    q_min, q_max, q_home (n,) [rad]; clearance [m]: hulls that are nearer than this at home are no image of links that
    rest beside each other. A pair whose field is felt at home pushes an arm that rests there, and is watched all the
    same: whether `check` says so.
    Left out besides: links with one link between them that are near at home. Their hulls fill the crook of the joints
    between and overlap where the links do not; the maker's joint limits keep those apart.
    """
    hulls = hulls_of(body)
    pairs = [
        (i, j)
        for j, near in enumerate(hulls)
        for i, far in enumerate(hulls)
        if far.link > near.link and body.parent[far.link] != near.link
    ]
    every = Own(hulls, np.array(pairs, np.int64).reshape(-1, 2), SAFE)
    home = Own(hulls, every.pairs, CROOK)
    samples = np.random.default_rng(0).uniform(q_min, q_max, (POSTURES, body.n))
    meets = np.zeros(len(pairs), np.bool_)
    elbow = np.array([body.parent[body.parent[hulls[i].link]] == hulls[j].link for i, j in pairs], np.bool_)
    near = Own(hulls, every.pairs[elbow], SAFE_NEAR)
    meets_near = np.zeros(int(elbow.sum()), np.bool_)
    for q in samples:
        every.meet(*body.placements(q), meets)
        near.meet(*body.placements(q), meets_near)
    meets[elbow] = meets_near
    at_home = body.own_distances(q_home, home)
    keep = meets & ~(at_home < clearance) & ~(elbow & (at_home < CROOK))
    return Own(hulls, np.ascontiguousarray(every.pairs[keep]), reach)
