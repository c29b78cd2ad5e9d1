"""A way between postures, and a quicker one beside it: RRT-Connect and its shortcuts, compiled whole.

After J. J. Kuffner and S. M. LaValle (*RRT-Connect: An Efficient Approach to Single-Query Path Planning*, ICRA 2000):
two trees, one of the start and one of all the ends; each grows towards samples in turn and the other then towards what
was added. An edge goes as far as it is free, so that trees follow walls into what is narrow, instead of being
given up whole. What is found is made quicker: by straight pieces (shortcuts, R. Geraerts and M. H. Overmars, *Creating
High-quality Paths for Motion Planning*, IJRR 26(8), 2007) and by bent ones, since a tip's way is seldom the shortest
where that of the joints is. All that is random is drawn by the caller: equal draws give equal ways.
"""

from typing import NamedTuple

import numpy as np

from rtctl.arm.freedom import Body, Room, first_blocked
from rtctl.arm.kinematics import Chain, placements
from rtctl.kernel import kernel
from rtctl.types import F64, I64
from rtctl.world.primitives import Obstacles

PIECE = 0.12  # [rad] of a joint between two postures at which a way is timed
CORNER = 0.5  # of the time that a change of speed takes, which it costs: half of that way is made all the same
ROWS = 48  # postures that a way may have for the sake of being quicker
GAIN = 1e-3  # [s] by which a piece must be quicker


class Speeds(NamedTuple):
    """How fast an arm that is led along a way may be."""

    qd: F64  # (n,) [rad/s]
    v: float  # [m/s] of the tip
    w: float  # [rad/s] of the tip
    rate: float  # [1/s] of full speed, at which joints change theirs


class Bounds(NamedTuple):
    """Where joints may be."""

    low: F64  # (n,) [rad]
    high: F64  # (n,) [rad]


@kernel
def nearest(Q: F64, count: int, q: F64) -> int:
    """Return which of the first `count` postures Q (k, n) is nearest to q (n,)."""
    best, least = 0, np.inf
    for k in range(count):
        away = 0.0
        for i in range(q.shape[0]):
            away += (Q[k, i] - q[i]) * (Q[k, i] - q[i])
        if away < least:
            best, least = k, away
    return best


@kernel
def ahead(a: F64, b: F64, step: float, most: int) -> F64:
    """Return postures (k, n) from a towards b (n,), a joint's step [rad] apart at most, b the last; `most` at most."""
    away = 0.0
    for i in range(a.shape[0]):
        away = max(away, abs(b[i] - a[i]))
    count = max(1, int(np.ceil(away / step)))
    out = np.empty((min(count, most), a.shape[0]))
    for k in range(out.shape[0]):
        for i in range(a.shape[0]):
            out[k, i] = a[i] + (b[i] - a[i]) * ((k + 1) / count)
    return out


@kernel
def connected(
    body: Body, roots: F64, samples: F64, obstacles: Obstacles, room: Room, step: float, stretch: int, checks: I64
) -> F64:
    """Return a way (k, n) [rad] from the first of the roots (r, n) to one of the others, (0, n) where none is found.

    step: [rad] between two looks at an edge; stretch: steps of an edge towards a sample (s, n); checks: (2,) how many
    postures were looked at, added to, and how many may be.
    """
    n, most = roots.shape[1], samples.shape[0] * 2 + roots.shape[0]
    Q, parent, count = np.empty((2, most, n)), np.full((2, most), -1), np.zeros(2, np.int64)
    for r in range(roots.shape[0]):
        t = 0 if r == 0 else 1
        Q[t, count[t]] = roots[r]
        count[t] += 1
    one = np.empty((1, n))
    for s in range(samples.shape[0]):
        if checks[0] >= checks[1]:
            break
        grown = s % 2
        aim = samples[s]
        for turn in range(2):
            t = grown if turn == 0 else 1 - grown
            k = nearest(Q[t], count[t], aim)
            edge = ahead(Q[t, k], aim, step, stretch if turn == 0 else 1_000_000)
            free = 0
            while free < edge.shape[0]:
                checks[0] += 1
                one[0] = edge[free]
                if first_blocked(body, one, obstacles, room, 1.0) >= 0:
                    break
                free += 1
            if free == 0:
                break
            Q[t, count[t]], parent[t, count[t]] = edge[free - 1], k
            count[t] += 1
            aim = edge[free - 1]
            if turn == 1 and free == edge.shape[0]:
                return _joined(Q, parent, count)
    return np.empty((0, n))


@kernel
def _joined(Q: F64, parent: I64, count: I64) -> F64:
    """Return the way from the root of the first tree over the last of both, which are one, to that of the second."""
    n, lengths = Q.shape[2], np.zeros(2, np.int64)
    for t in range(2):
        k = count[t] - 1
        while k >= 0:
            lengths[t] += 1
            k = parent[t, k]
    out = np.empty((lengths[0] + lengths[1] - 1, n))
    k, at = count[0] - 1, lengths[0] - 1
    while k >= 0:
        out[at] = Q[0, k]
        k, at = parent[0, k], at - 1
    k, at = parent[1, count[1] - 1], lengths[0]
    while k >= 0:
        out[at] = Q[1, k]
        k, at = parent[1, k], at + 1
    return out


@kernel
def _tip(chain: Chain, q: F64, R: F64, t: F64, out: F64) -> None:
    """Write position and orientation of the tip at q (n,) to out (4, 3), in metres and as rows of a matrix."""
    placements(chain, q, R, t)
    k = chain.tip
    for i in range(3):
        out[0, i] = t[k, i]
        for j in range(3):
            out[0, i] += R[k, i, j] * chain.tip_t[j]
            out[1 + i, j] = 0.0
            for l in range(3):
                out[1 + i, j] += R[k, i, l] * chain.tip_R[l, j]


class Work(NamedTuple):
    """Where pieces of a way are timed."""

    R: F64  # (n + 1, 3, 3) placements of the links
    t: F64  # (n + 1, 3) [m]
    here: F64  # (4, 3) of the tip
    there: F64  # (4, 3)
    q: F64  # (n,) [rad]


@kernel
def _work(n: int) -> Work:
    return Work(np.empty((n + 1, 3, 3)), np.empty((n + 1, 3)), np.empty((4, 3)), np.empty((4, 3)), np.empty(n))


@kernel
def _piece(chain: Chain, a: F64, b: F64, speeds: Speeds, work: Work, first: F64, last: F64) -> float:
    """Return the time [s] from a to b (n,) at full speed, the slowest of joints and tip; 0 where they are one.

    Write to first and last (n,) which share of their full speed joints have there. The tip in `work` is moved on.
    """
    n, away, slow, total = a.shape[0], 0.0, 0.0, 0.0
    for i in range(n):
        away = max(away, abs(b[i] - a[i]))
        slow = max(slow, abs(b[i] - a[i]) / speeds.qd[i])
    if away < 1e-9:
        return 0.0
    count = int(np.ceil(away / PIECE))
    for s in range(count):
        for i in range(n):
            work.q[i] = a[i] + (b[i] - a[i]) * ((s + 1) / count)
        _tip(chain, work.q, work.R, work.t, work.there)
        moved = turned = 0.0
        for j in range(3):
            moved += (work.there[0, j] - work.here[0, j]) ** 2
            for i in range(1, 4):
                turned += (work.there[i, j] - work.here[i, j]) ** 2
        work.here[:] = work.there
        takes = max(slow / count, np.sqrt(moved) / speeds.v, np.sqrt(0.5 * turned) / speeds.w)
        total += takes
        if s == 0 or s == count - 1:
            for i in range(n):
                last[i] = (b[i] - a[i]) / (count * takes * speeds.qd[i])
        if s == 0:
            first[:] = last
    return total


@kernel
def _corner(before: F64, after: F64, speeds: Speeds) -> float:
    """Return the time [s] that joints lose from one of these shares (n,) of full speed to the other."""
    change = 0.0
    for i in range(before.shape[0]):
        change += (after[i] - before[i]) * (after[i] - before[i])
    lost: float = CORNER * np.sqrt(change) / speeds.rate
    return lost


@kernel
def _timed(chain: Chain, Q: F64, speeds: Speeds, most: float, takes: F64, first: F64, last: F64) -> float:
    """Return the time [s] along postures Q (k, n), more than `most` where it is more; see `lasts`.

    Write those of the pieces to takes (>= k - 1,), and to first and last (>= k - 1, n), as `_piece` does.
    """
    work, total, before = _work(Q.shape[1]), 0.0, -1
    _tip(chain, Q[0], work.R, work.t, work.here)
    for k in range(Q.shape[0] - 1):
        takes[k] = _piece(chain, Q[k], Q[k + 1], speeds, work, first[k], last[k])
        if takes[k] > 0.0:
            total += takes[k]
            if before >= 0:
                total += _corner(last[before], first[k], speeds)
            before = k
        if total > most:
            break
    return total


@kernel
def lasts(chain: Chain, Q: F64, speeds: Speeds) -> float:
    """Return the time [s] along the postures Q (k, n), at full speed all along; what changes it at corners counts.

    Of every piece the slowest of joints and tip. From rest and to rest it takes 1 / rate more.
    """
    return _timed(chain, Q, speeds, np.inf, np.empty(Q.shape[0]), np.empty_like(Q), np.empty_like(Q))


@kernel
def _at(Q: F64, length: F64, count: int, s: float, out: F64) -> int:
    """Write to out (n,) the posture s [rad] along the first `count` of Q; return which of them is before it."""
    k = 0
    while k < count - 2 and length[k + 1] < s:
        k += 1
    size = length[k + 1] - length[k]
    share = min(1.0, max(0.0, (s - length[k]) / size)) if size > 0.0 else 0.0
    for i in range(Q.shape[1]):
        out[i] = Q[k, i] + share * (Q[k + 1, i] - Q[k, i])
    return k


@kernel
def _all_free(body: Body, piece: F64, obstacles: Obstacles, room: Room, step: float, checks: I64) -> bool:
    """Return whether a piece of a way (k, n) is free between its postures; checks are added to, as in `connected`."""
    for k in range(piece.shape[0] - 1):
        edge = ahead(piece[k], piece[k + 1], step, 1_000_000)
        checks[0] += edge.shape[0]
        if first_blocked(body, edge, obstacles, room, 1.0) >= 0:
            return False
    return True


@kernel
def quicker(
    body: Body,
    path: F64,
    draws: F64,
    obstacles: Obstacles,
    room: Room,
    bounds: Bounds,
    speeds: Speeds,
    step: float,
    checks: I64,
) -> F64:
    """Return a way (k, n) [rad] that is free as `path` is, with the same ends, and takes no longer.

    A piece of it gives way to one that is straight, or bent in one posture, where that is quicker and free. Each of the
    draws (d, 3 + n) is one attempt: two within [0, 1) for the piece, one within [0, 1) for how far the bend is at
    most, and the way to it. step [rad] between two looks, checks (2,) how many, added to, and how many there may be.
    """
    n = path.shape[1]
    rows = max(ROWS, path.shape[0])
    Q, length, count = np.empty((rows, n)), np.zeros(rows), path.shape[0]
    Q[:count] = path
    takes, first, last = np.empty(rows), np.empty((rows, n)), np.empty((rows, n))
    _timed(body.chain, path, speeds, np.inf, takes, first, last)
    piece, takes5, first5, last5 = np.empty((5, n)), np.empty(5), np.empty((5, n)), np.empty((5, n))
    for d in range(draws.shape[0]):
        if checks[0] >= checks[1] or count < 2:
            break
        for k in range(1, count):
            away = 0.0
            for i in range(n):
                away = max(away, abs(Q[k, i] - Q[k - 1, i]))
            length[k] = length[k - 1] + away
        total, kind = length[count - 1], d % 3
        if kind == 0:
            start, end = min(draws[d, 0], draws[d, 1]) * total, max(draws[d, 0], draws[d, 1]) * total
        else:
            half = 0.5 * total * draws[d, 1] * draws[d, 1]
            start, end = max(0.0, draws[d, 0] * total - half), min(total, draws[d, 0] * total + half)
        a, b = _at(Q, length, count, start, piece[1]), _at(Q, length, count, end, piece[3])
        piece[0], piece[4] = Q[a], Q[b + 1]
        if kind == 0:
            if a == b:
                continue
            new = np.concatenate((piece[:2], piece[3:]))
        else:
            if kind == 1:
                _at(Q, length, count, 0.5 * (start + end), piece[2])
            else:
                piece[2] = 0.5 * (piece[1] + piece[3])
            far = draws[d, 2] * draws[d, 2] * (end - start)
            for i in range(n):
                piece[2, i] = min(max(piece[2, i] + far * draws[d, 3 + i], bounds.low[i]), bounds.high[i])
            new = piece.copy()
        more = count - (b - a) + new.shape[0] - 2
        if more > rows:
            continue
        least, before = -GAIN, -1
        for k in range(a, b + 1):
            if takes[k] > 0.0:
                least += takes[k] + (_corner(last[before], first[k], speeds) if before >= 0 else 0.0)
                before = k
        if _timed(body.chain, new, speeds, least, takes5, first5, last5) > least:
            continue
        if not _all_free(body, new[1:-1], obstacles, room, step, checks):
            continue
        size = new.shape[0] - 1  # pieces, in the place of b + 1 - a
        rest, rest_takes = Q[b + 1 : count].copy(), takes[b + 1 : count - 1].copy()
        rest_first, rest_last = first[b + 1 : count - 1].copy(), last[b + 1 : count - 1].copy()
        Q[a : a + size], takes[a : a + size] = new[:-1], takes5[:size]
        first[a : a + size], last[a : a + size] = first5[:size], last5[:size]
        Q[a + size : more], takes[a + size : more - 1] = rest, rest_takes
        first[a + size : more - 1], last[a + size : more - 1] = rest_first, rest_last
        count = more
    return Q[:count].copy()
