"""Which links of an arm can meet: hulls of the collision geometry, and the pairs worth measuring at run time."""

from importlib.metadata import version

import coal
import numpy as np

from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.self_collision import Hull, Own
from rtctl.design import kept
from rtctl.design.solids import solids_of
from rtctl.types import B1, F64, I64

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
    indices = np.array(pairs, np.int64).reshape(-1, 2)
    samples = np.random.default_rng(0).uniform(q_min, q_max, (POSTURES, body.n))
    links = np.array([h.link for h in hulls], np.int64)
    told: list[F64 | I64] = [q_home, samples, indices, links, body.parent, *(h.corners for h in hulls)]
    told += [part for q in (q_home, *samples[:3]) for part in body.placements(q)]  # the chain, by what it does
    path = kept.place_of("pairs", f"coal {version('coal')} {clearance!r}", told, __name__, __file__)
    said = (kept.known(path) or {}).get("watched")
    if not isinstance(said, list) or len(said) != len(pairs):
        said = _meet(body, hulls, indices, samples, q_home, clearance).tolist()
        kept.note(path, {"watched": said})
    return Own(hulls, np.ascontiguousarray(indices[np.array(said, np.bool_)]), reach)


def _meet(body: RigidBody, hulls: list[Hull], pairs: I64, samples: F64, q_home: F64, clearance: float) -> B1:
    """Return which pairs (L, 2) meet in one of the samples (b, n) [rad], and are to be watched."""
    every, home = Own(hulls, pairs, SAFE), Own(hulls, pairs, CROOK)
    meets = np.zeros(len(pairs), np.bool_)
    elbow = np.array([body.parent[body.parent[hulls[i].link]] == hulls[j].link for i, j in pairs], np.bool_)
    near = Own(hulls, pairs[elbow], SAFE_NEAR)
    meets_near = np.zeros(int(elbow.sum()), np.bool_)
    for q in samples:
        placements = body.placements(q)
        every.meet(*placements, meets)
        near.meet(*placements, meets_near)
    meets[elbow] = meets_near
    at_home = body.own_distances(q_home, home)
    keep: B1 = meets & ~(at_home < clearance) & ~(elbow & (at_home < CROOK))
    return keep
