"""A way between postures through narrow places: RRT-Connect, compiled whole.

After J. J. Kuffner and S. M. LaValle (*RRT-Connect: An Efficient Approach to Single-Query Path Planning*, ICRA 2000):
two trees, one of the start and one of all the ends; each grows towards samples in turn and the other then towards what
was added. An edge goes as far as it is free, so that trees follow walls into what is narrow, instead of being
given up whole. The samples are drawn by the caller: equal ones give equal ways.
"""

import numpy as np

from rtctl.arm.freedom import Body, Room, first_blocked
from rtctl.kernel import kernel
from rtctl.types import F64, I64
from rtctl.world.primitives import Obstacles


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
