"""Points subjected to the potential (PSPs): spheres that cover the links.

A ball about an interior point c at depth d(c) below the surface, of radius d(c) + delta, stays within delta of the
piece. Placement is a greedy set cover of the surface by such balls: a flat triangle lies in a ball exactly when its
corners do, so the cover is complete by proof and not by sampling.
"""

from collections.abc import Sequence

import numpy as np

from rtctl.arm.points import Coverage, Points
from rtctl.arm.rigid_body import RigidBody
from rtctl.design import kept
from rtctl.design.solids import EDGE, STEP, Solid, areas, depth, solids_of, surface
from rtctl.errors import ConfigError
from rtctl.kernel import kernel
from rtctl.types import B1, F64, I64

_GRID = 0.012  # [m] between candidate centres, at most half the overhang
_MIN_RADIUS = 0.005  # [m]


def place(body: RigidBody, overhang: float = 0.025) -> tuple[Points, Coverage]:
    """Return spheres that cover the collision geometry of every moving link, and the proof of it.

    overhang: delta [m], how far a sphere may reach beyond the geometry; larger gives fewer spheres.
    Raises ConfigError when no moving link has collision geometry.
    """
    solids = [s for s in solids_of(body) if s.link > 0]
    if not solids:
        raise ConfigError("avoid.points", "no collision geometry in the URDF", "a list of points")
    said = f"{overhang!r} {[(s.link, s.name) for s in solids]}"
    numbers = [part for s in solids for part in (s.corners, s.faces, s.planes)]
    path = kept.place_of("points", said, numbers, __name__, __file__)
    before = kept.read(path)
    if before is not None:
        return before
    points = _placed(solids, overhang)
    found = coverage(points, body, min(EDGE, 0.6 * overhang))
    kept.write(path, points, found)
    return points, found


def _placed(solids: list[Solid], overhang: float) -> Points:
    """Return the spheres that cover the solids, link by link."""
    links: list[int] = []
    centres: list[F64] = []
    radii: list[float] = []
    names: list[str] = []
    for link in sorted({s.link for s in solids}):
        pieces = [s for s in solids if s.link == link]
        c, r = _cover(pieces, overhang)
        depths = np.array([depth(s, c) for s in pieces])
        links += [link] * len(r)
        centres += list(c)
        radii += list(r)
        names += [pieces[k].name for k in np.argmax(depths, axis=0)]
    return Points(np.array(links, dtype=np.int64), np.array(centres), np.array(radii), tuple(names))


def given(body: RigidBody, entries: Sequence[tuple[str, F64, float]]) -> tuple[Points, Coverage]:
    """Return the spheres that a user lists as (URDF link, position [m] in that link's frame, radius [m]).

    Raises ConfigError for a link that does not exist or does not move.
    """
    frames = {frame.name: frame for frame in body.model.frames}
    moving = [name for name, frame in frames.items() if body.link_of[frame.parentJoint] > 0]
    links, centres = [], []
    for k, (name, position, _) in enumerate(entries):
        if name not in moving:
            raise ConfigError(f"avoid.points[{k}].link", name, f"one of {', '.join(moving)}")
        frame = frames[name]
        links.append(body.link_of[frame.parentJoint])
        centres.append(frame.placement.rotation @ np.asarray(position, dtype=np.float64) + frame.placement.translation)
    points = Points(
        np.array(links, dtype=np.int64),
        np.array(centres, dtype=np.float64).reshape(-1, 3),
        np.array([radius for _, _, radius in entries], dtype=np.float64),
        tuple(name for name, _, _ in entries),
    )
    return points, coverage(points, body)


def coverage(points: Points, body: RigidBody, edge: float = EDGE) -> Coverage:
    """Return how well spheres cover the collision geometry of the moving links, judged by triangles up to edge [m]."""
    from scipy.spatial import cKDTree  # see rtctl.world.meshes

    solids = [s for s in solids_of(body) if s.link > 0]
    covered, area, protrusion, overhang = 0.0, 0.0, 0.0, 0.0
    bare: list[str] = []
    for link in sorted({s.link for s in solids}):
        pieces = [s for s in solids if s.link == link]
        mine = points.link == link
        centres, radii = points.local[mine], points.radius[mine]
        if not len(radii):  # as though one sphere of no size sat in the middle
            centres, radii = np.concatenate([s.corners for s in pieces]).mean(axis=0, keepdims=True), np.zeros(1)
        surfaces = [surface(s, edge) for s in pieces]
        for s, (samples, triangles) in zip(pieces, surfaces, strict=True):
            area_of = areas(samples, triangles)
            beyond = (np.sqrt(_need2(centres, samples, triangles)) - radii[:, None]).min(axis=0)
            area += float(area_of.sum())
            covered += float(area_of[beyond <= 0.0].sum())
            protrusion = max(protrusion, float(beyond.max()))
            if (beyond > 0.0).any():
                bare.append(s.name)
        below = np.max([depth(s, centres) for s in pieces], axis=0)
        outside = cKDTree(np.concatenate([samples for samples, _ in surfaces])).query(centres)[0]
        # outside is a bound: the distance to a sample is never below the true one
        overhang = max(overhang, float(np.max(radii - np.where(below >= 0.0, below, -outside))))
    return Coverage(covered / area if area else 0.0, protrusion, overhang, tuple(dict.fromkeys(bare)))


@kernel
def _need2(centres: F64, samples: F64, triangles: I64) -> F64:
    """Return the squared radius (k, t) of the ball about each centre that just holds each triangle's corners."""
    need = np.empty((centres.shape[0], triangles.shape[0]))
    d2 = np.empty(samples.shape[0])
    for k in range(centres.shape[0]):
        for s in range(samples.shape[0]):
            x, y, z = samples[s, 0] - centres[k, 0], samples[s, 1] - centres[k, 1], samples[s, 2] - centres[k, 2]
            d2[s] = x * x + y * y + z * z
        for t in range(triangles.shape[0]):
            need[k, t] = max(d2[triangles[t, 0]], d2[triangles[t, 1]], d2[triangles[t, 2]])
    return need


@kernel
def _holds(centres: F64, radii: F64, samples: F64, triangles: I64) -> B1:
    """Return whether (k, t) the ball about each centre holds each triangle's corners; radii (k,) [m]."""
    holds = np.empty((centres.shape[0], triangles.shape[0]), np.bool_)
    d2 = np.empty(samples.shape[0])
    for k in range(centres.shape[0]):
        for s in range(samples.shape[0]):
            x, y, z = samples[s, 0] - centres[k, 0], samples[s, 1] - centres[k, 1], samples[s, 2] - centres[k, 2]
            d2[s] = x * x + y * y + z * z
        most = radii[k] * radii[k]
        for t in range(triangles.shape[0]):
            holds[k, t] = max(d2[triangles[t, 0]], d2[triangles[t, 1]], d2[triangles[t, 2]]) <= most
    return holds


@kernel
def _greedy(covers: B1, weight: I64, open_: B1) -> I64:
    """Return the rows that cover what is open, the largest weight first; what no row covers stays open.

    A row's gain is an upper bound of what it gains later, when less is open: only rows that may be the best are summed
    anew. Of equal gains the first row is taken.
    """
    chosen: list[int] = []
    gains = np.zeros(covers.shape[0], np.int64)
    for k in range(covers.shape[0]):
        for t in range(covers.shape[1]):
            if covers[k, t] and open_[t]:
                gains[k] += weight[t]
    while True:
        best, best_gain = -1, 0
        for k in range(covers.shape[0]):
            if gains[k] > best_gain:
                gain = 0
                for t in range(covers.shape[1]):
                    if covers[k, t] and open_[t]:
                        gain += weight[t]
                gains[k] = gain
                if gain > best_gain:
                    best, best_gain = k, gain
        if best < 0:
            return np.array(chosen, dtype=np.int64)
        chosen.append(best)
        for t in range(covers.shape[1]):
            if covers[best, t]:
                open_[t] = False


def _cover(pieces: list[Solid], overhang: float) -> tuple[F64, F64]:
    """Return centres (k, 3) and radii (k,) of balls that cover the pieces of one link (greedy set cover)."""
    grid = _candidates(pieces, min(_GRID, 0.5 * overhang))
    reach = np.max([depth(s, grid) for s in pieces], axis=0) + overhang
    samples, triangles = _outer_surface(pieces, min(EDGE, 0.6 * overhang))
    weight = np.ceil(areas(samples, triangles) * 1e9).astype(np.int64)  # integers: sums do not depend on order
    covers = _holds(grid, reach - STEP, samples, triangles)
    open_: B1 = np.ones(len(triangles), dtype=np.bool_)
    chosen = _greedy(covers, weight, open_)
    chosen = _needed(covers, chosen, ~open_)
    # Sharp edges between grid points are left: a ball about a triangle always holds it.
    rest = np.round(samples[triangles[open_]].mean(axis=1) / STEP) * STEP
    covers = _holds(rest, np.full(len(rest), overhang - STEP), samples, triangles)
    rest = rest[_greedy(covers, weight, open_)]
    centres = np.concatenate([grid[chosen], rest])
    return centres, _shrunk(centres, np.append(reach[chosen], np.full(len(rest), overhang)), samples, triangles)


def _needed(covers: B1, chosen: I64, wanted: B1) -> I64:
    """Return the chosen rows less those that the others make superfluous, the latest and smallest tried first."""
    kept = chosen
    for k in reversed(chosen):
        others = kept[kept != k]
        held: B1 = np.any(covers[others], axis=0)
        if bool(held[wanted].all()):
            kept = others
    return kept


def _candidates(pieces: list[Solid], spacing: float) -> F64:
    """Return a grid of points inside the pieces, and the middle of each."""
    low = np.min([s.corners.min(axis=0) for s in pieces], axis=0)
    high = np.max([s.corners.max(axis=0) for s in pieces], axis=0)
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [np.linspace(low[k], high[k], counts[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = np.concatenate([grid, *[s.corners.mean(axis=0, keepdims=True) for s in pieces]])
    grid = np.round(grid / STEP) * STEP
    inside: F64 = grid[np.max([depth(s, grid) for s in pieces], axis=0) >= 0.0]
    return inside


def _outer_surface(pieces: list[Solid], edge: float) -> tuple[F64, I64]:
    """Return the surface of several pieces, less the triangles that lie inside another piece."""
    samples, triangles, offset = [], [], 0
    for s in pieces:
        p, t = surface(s, edge)
        hidden: B1 = np.zeros(len(t), dtype=np.bool_)
        for other in pieces:
            if other is not s:
                deep: B1 = np.greater(depth(other, p), STEP)
                hidden |= deep[t].all(axis=1)
        samples.append(p)
        triangles.append(t[~hidden] + offset)
        offset += len(p)
    return np.concatenate(samples), np.concatenate(triangles)


def _shrunk(centres: F64, reach: F64, samples: F64, triangles: I64) -> F64:
    """Return the smallest radii with which each ball still holds the triangles that fit it best."""
    need = np.sqrt(_need2(centres, samples, triangles))
    owner = np.argmin(np.round((need - reach[:, None]) / STEP), axis=0)
    radii = np.full(len(centres), _MIN_RADIUS)
    for k in range(len(centres)):
        if (owner == k).any():
            radii[k] = max(_MIN_RADIUS, float(need[k, owner == k].max()))
    return np.asarray(np.ceil(radii / STEP + 0.5) * STEP)
