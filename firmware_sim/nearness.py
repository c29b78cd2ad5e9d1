"""Which distances must be measured: those that could be the least of now, by how far things can have moved since.

A point of a link is moved by a change dq of the joints by at most sum_j reach_j |dq_j|, with reach_j [m] at least its
distance from joint j's axis in any posture. So a distance d, measured once, is later at least d less what the link and
the obstacle have moved by since. Pairs come in groups (a group's least distance is wanted): the nearest by their bound
are measured first, and those whose bound is beyond the least one found need not be.
"""

import math

import numpy as np
from numpy.typing import NDArray

from firmware_sim.kernel import kernel

F64 = NDArray[np.float64]
GUARD = 1e-3  # [m] between a bound and what is measured: pybullet's distances are good to a tenth of that
KEY, DONE, PAIRED = 0, 1, 2  # of pairs: bound on the distance plus the ways gone by then [m]; 1 once measured in a look
# of groups, all [m]: what a distance must be below to matter, the least measured in this look, the least measured in
# any, what is told, and the horizon
LEVEL, LEAST, EVER, TOLD, HORIZON, FIGURES = 0, 1, 2, 3, 4, 5


@kernel
def choose(pairs: F64, groups: F64, travel: F64, moved: F64, at: int, distance: float) -> int:
    """Take the distance [m] of pair `at`, if that is one; return the pair to be measured next, -1 if none can matter.

    pairs: (PAIRED, G, L), groups: (FIGURES, G). travel: (L,), moved: (G,) [m] ways gone so far. A pair matters if its
    bound is below the group's level, or if it may touch; the one with the least bound is next.
    """
    width = pairs.shape[2]
    if at >= 0:
        g, k = at // width, at % width
        pairs[KEY, g, k] = distance + travel[k] + moved[g]
        pairs[DONE, g, k] = 1.0
        for row in (LEVEL, LEAST, EVER):
            groups[row, g] = min(groups[row, g], distance)
    found, nearest = -1, math.inf
    for g in range(pairs.shape[1]):
        matters = max(groups[LEVEL, g], 0.0) + GUARD
        told = min(groups[LEAST, g], groups[HORIZON, g])
        for k in range(width):
            if pairs[DONE, g, k] != 0.0:
                continue
            bound = pairs[KEY, g, k] - travel[k] - moved[g]
            told = min(told, bound)
            if bound <= matters and bound < nearest:
                found, nearest = g * width + k, bound
        groups[TOLD, g] = told
    return found


@kernel
def begin(reach: F64, q: F64, seen: F64, pairs: F64, groups: F64, travel: F64, moved: F64, exact: bool) -> int:
    """Begin a look at posture q (n,); return the first pair to be measured, -1 if none can matter.

    Adds to `travel` what a link can have moved by while the joints went from `seen` (n,) to q; q is then seen.
    """
    for k in range(len(travel)):
        for j in range(len(q)):
            travel[k] += reach[k, j] * abs(q[j] - seen[j])
    for j in range(len(q)):
        seen[j] = q[j]
    for g in range(groups.shape[1]):
        groups[LEAST, g] = math.inf
        groups[LEVEL, g] = groups[HORIZON, g] if exact else min(groups[EVER, g], groups[HORIZON, g])
        for k in range(len(travel)):
            pairs[DONE, g, k] = 0.0
    return choose(pairs, groups, travel, moved, -1, 0.0)


class Nearness:
    """Bounds on the distances of L links, or pairs of them, in each of G groups."""

    def __init__(self, reach: F64, moved: F64, horizon: float) -> None:
        """reach: (L, n) [m]. moved: (G,) [m] ways of the groups' obstacles so far, kept up by their owner.

        horizon: [m] what is farther is not told apart from it.
        """
        self.reach, self.moved = reach, moved
        self.travel: F64 = np.zeros(len(reach))
        self.pairs: F64 = np.zeros((PAIRED, len(moved), len(reach)))
        self.pairs[KEY] = np.inf  # of groups that are not there: never measured
        self.groups: F64 = np.full((FIGURES, len(moved)), np.inf)
        self.groups[HORIZON] = horizon
        self._seen: F64 = np.zeros(reach.shape[1])
        self._q: F64 = np.zeros(reach.shape[1])
        self.begin(self._q.tolist(), True)  # once without effect: everything is compiled now, or loaded
        self.learn(-1, 0.0)

    def unknown(self, group: int, present: bool) -> None:
        """Forget a group's distances: all must be measured, or none where it is not there."""
        self.pairs[KEY, group] = -np.inf if present else np.inf

    def begin(self, q: list[float], exact: bool) -> int:
        """Begin a look at posture q [rad]; return the first pair to be measured, g L + k, or -1 if none need be.

        exact: the least distance of each group is wanted as it is; else it may be a bound where it is above the least
        ever.
        """
        self._q[:] = q
        pair: int = begin(self.reach, self._q, self._seen, self.pairs, self.groups, self.travel, self.moved, exact)
        return pair

    def learn(self, pair: int, distance: float) -> int:
        """Take a pair's distance [m], or how far was looked in vain; return the next to be measured, -1 if none."""
        following: int = choose(self.pairs, self.groups, self.travel, self.moved, pair, distance)
        return following

    def told(self) -> list[float]:
        """Return the least distance of each group [m] once nothing is to be measured any more.

        Where it was not wanted exactly, a group whose distances are all above the least ever measured may have a lower
        bound of its least distance instead, which is above the least ever as well.
        """
        told: list[float] = self.groups[TOLD].tolist()
        return told
