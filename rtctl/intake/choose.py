"""Postures, goals and an obstacle for an arm that nobody has described: clear of limits, of itself, of a table."""

from collections.abc import Sequence
from typing import NamedTuple

import coal
import numpy as np

from rtctl.arm.points import no_points
from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.self_collision import Own
from rtctl.design.pairs import hulls_of
from rtctl.types import F64

SAMPLES = 400  # postures tried
KEPT = 60  # of them that are looked at closely
MARGIN = 0.03  # [m] between links at home, where there can be that much
APART = 0.15  # [m] of a table below what turns above it
STEPS = 24  # of a way between two goals


class Place(NamedTuple):
    """An arm and what is beside it, to choose postures in."""

    body: RigidBody
    own: Own  # pairs that can be clear of each other
    low: F64  # (n,) [rad] limits, less their zone
    high: F64
    reach: float  # [m]
    floor: float  # [m] of the table, -inf: none


class Way(NamedTuple):
    """A goal, and the postures on the way to it."""

    goal: F64  # (3,) [m]
    q: list[F64]
    clear: float  # [m] the least between the arm's own links


def place_of(body: RigidBody, low: F64, high: F64) -> Place:
    """Return the surroundings of an arm: its own pairs of links, its reach, without a table."""
    hulls = hulls_of(body)
    pairs = [
        (i, j)
        for j, near in enumerate(hulls)
        for i, far in enumerate(hulls)
        if far.link > near.link and body.parent[far.link] != near.link
    ]
    own = Own(hulls, np.array(pairs, np.int64).reshape(-1, 2), 0.1)
    rng = np.random.default_rng(1)
    postures = rng.uniform(low, high, (40, body.n))
    overlap = (
        np.array([body.own_distances(q, own) <= 0.0 for q in postures]).mean(axis=0) if len(pairs) else np.zeros(0)
    )
    own = Own(hulls, own.pairs[overlap < 0.4], 0.1)  # hulls that overlap most of the time fill crooks that links do not
    tips = np.array([body.evaluate(q, np.zeros(body.n), no_points()).x for q in postures])
    shoulder = _shoulder(body)
    return Place(body, own, low, high, float(np.linalg.norm(tips - shoulder, axis=1).max()), -np.inf)


def _shoulder(body: RigidBody) -> F64:
    _, t = body.placements(np.zeros(body.n))
    return np.asarray(t[min(2, body.n)])


def floor_of(place: Place, home: F64) -> float:
    """Return the height [m] of a table that the base stands on and that nothing that turns comes near at home."""
    heights = _heights(place, home)
    base = [h for link, h in heights if link == 0]
    moving = [h for link, h in heights if link > 0]
    return float(min([*base[:1], min(moving, default=0.0) - APART, 0.0 if not base else min(base)]))


def _heights(place: Place, q: F64) -> list[tuple[int, float]]:
    """Return the lowest point [m] of each hull, and the link that it is on."""
    R, t = place.body.placements(q)
    return [(h.link, float((h.corners @ R[h.link].T + t[h.link])[:, 2].min())) for h in place.own.hulls]


def clear(place: Place, q: F64) -> float:
    """Return the least distance [m] between links of an arm that can be apart, 0.1 at most, less below a table."""
    own = float(place.body.own_distances(q, place.own).min(initial=0.1))
    low = min((h for link, h in _heights(place, q) if link > 1), default=np.inf)
    return min(own, 0.1, low - place.floor - APART + MARGIN)


def home_of(place: Place, tau: F64) -> F64:
    """Return a posture (n,) [rad] to rest in: half stretched, tip in front and up, easily moved and carried."""
    rng, n = np.random.default_rng(2), place.body.n
    middle, half = 0.5 * (place.low + place.high), 0.5 * (place.high - place.low)
    near = np.clip(np.zeros(n), place.low, place.high)
    spread = np.minimum(half, 1.6)
    tries = np.clip(near + rng.uniform(-1.0, 1.0, (SAMPLES, n)) * spread, place.low, place.high)
    tries = np.concatenate([tries, np.clip(middle + rng.uniform(-0.5, 0.5, (40, n)) * half, place.low, place.high)])
    tries = np.round(tries, 3)
    ranked = sorted(((_ease(place, q, tau), k) for k, q in enumerate(tries)), reverse=True)
    best, most = tries[ranked[0][1]], -np.inf
    for score, k in ranked[:KEPT]:
        value = score + 2.0 * min(clear(place, tries[k]), 2.0 * MARGIN) / MARGIN
        if value > most:
            best, most = tries[k], value
    return np.asarray(best)


def _ease(place: Place, q: F64, tau: F64) -> float:
    """Return how good a posture is to start from, but for what it touches."""
    body = place.body
    m = body.evaluate(q, np.zeros(body.n), no_points())
    out = m.x - _shoulder(body)
    stretch = float(np.linalg.norm(out)) / place.reach
    mobile = float(np.linalg.svd(m.J[:3])[1][-1]) / (0.3 * place.reach)
    load = float((np.abs(m.g) / tau).max())
    margin = float(np.minimum((q - place.low), (place.high - q)).min())
    front = float(out[0]) / max(float(np.linalg.norm(out[:2])), 1e-6)
    bent = float(np.abs(q).max())
    score = 2.0 * min(mobile, 1.0) - 3.0 * abs(stretch - 0.6) + 0.5 * front + min(margin, 0.3)
    return (
        score
        - 4.0 * max(load - 0.6, 0.0)
        - (2.0 if m.x[2] < 0.1 * place.reach + max(place.floor, -1.0) else 0.0)
        - 0.2 * bent
    )


def way(place: Place, q: F64, goal: F64, home: F64) -> Way | None:
    """Return how the arm's tip goes straight to a goal, None where limits or stretched links forbid it."""
    body, postures = place.body, [q]
    begin = body.evaluate(q, np.zeros(body.n), no_points()).x.copy()
    least = np.inf
    for k in range(1, STEPS + 1):
        wanted = begin + (goal - begin) * k / STEPS
        for _ in range(4):
            m = body.evaluate(q, np.zeros(body.n), no_points())
            J = m.J[:3]
            inverse = J.T @ np.linalg.inv(J @ J.T + 1e-6 * np.eye(3))
            q = q + inverse @ (wanted - m.x) + 0.1 * (np.eye(body.n) - inverse @ J) @ (home - q)
        if np.linalg.norm(wanted - m.x) > 0.01 or (q < place.low).any() or (q > place.high).any():
            return None
        if np.linalg.svd(J)[1][-1] < 0.08 * place.reach:
            return None
        postures.append(q)
        if k % 4 == 0:
            least = min(least, clear(place, q))
    return Way(goal, postures, least)


def ways(place: Place, home: F64, tolerance: float) -> list[Way]:
    """Return the ways home to a first goal and on to a second, [] where no two are found."""
    rng, body = np.random.default_rng(3), place.body
    begin = body.evaluate(home, np.zeros(body.n), no_points()).x.copy()
    for size, least in ((0.45, MARGIN), (0.35, MARGIN), (0.3, 0.0), (0.2, 0.0)):
        found: list[Way] = []
        for _ in range(60):
            d = rng.normal(size=3) * np.array([0.5, 1.0, 0.5])
            step = size * place.reach * d / np.linalg.norm(d)
            at = begin if not found else found[0].goal
            goal = np.round((begin + 0.5 * step) if not found else at - step * (1.0 + 0.0 * tolerance), 3)
            q = home if not found else found[0].q[-1]
            one = way(place, q, goal, home)
            if one is not None and one.clear >= min(least, clear(place, home)):
                found.append(one)
            if len(found) == 2:
                return found
    return []


def beside(place: Place, ways_: Sequence[Way], radius: float, gap: float, free: float) -> F64 | None:
    """Return where (3,) [m] a ball stands nearest to the second way: `gap` [m] from the arm on it, `free` at its ends.

    None where there is no such place.
    """
    a, b = ways_[0].goal, ways_[1].goal
    along = (b - a) / np.linalg.norm(b - a)
    up = np.array([0.0, 0.0, 1.0]) if abs(along[2]) < 0.8 else np.array([1.0, 0.0, 0.0])
    side = np.cross(along, up)
    side /= np.linalg.norm(side)
    up = np.cross(side, along)
    first, second = ways_[0].q[::4], ways_[1].q
    for spare in (1.0, 0.6, 0.3):
        best: F64 | None = None
        nearest = np.inf
        for turn in np.arange(12) * np.pi / 6.0:
            direction = np.cos(turn) * up + np.sin(turn) * side
            for offset in np.arange(radius + gap, radius + gap + 0.35 * place.reach, 0.03):
                centre: F64 = np.round(0.5 * (a + b) + offset * direction, 3)
                if centre[2] - radius < place.floor or offset >= nearest:
                    break
                if min(_away(place, q, centre) for q in second[::3]) - radius < gap:
                    continue
                if min(_away(place, q, centre) for q in (*first, second[0], second[-1])) - radius >= spare * free:
                    best, nearest = centre, float(offset)
                    break
        if best is not None:
            return best
    return None


def _away(place: Place, q: F64, centre: F64) -> float:
    """Return the distance [m] of a point to the moving links at a posture."""
    R, t = place.body.placements(q)
    ball, at = coal.Sphere(1e-4), coal.Transform3s(np.eye(3), centre)
    least = np.inf
    for h in place.own.hulls:
        if h.link == 0:
            continue
        lower = np.linalg.norm(R[h.link] @ h.centre + t[h.link] - centre) - h.radius
        if lower < least:
            found = coal.distance(
                h.shape, coal.Transform3s(R[h.link], t[h.link]), ball, at, coal.DistanceRequest(), coal.DistanceResult()
            )
            least = min(least, found)
    return float(least)
