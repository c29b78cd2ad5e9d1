"""A way of postures that the joints are led along: what to head for now, and whether something comes across it."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rtctl.app.postures import Ending, Site, along, links_clear
from rtctl.arm.kinematics import clearance_of, clearances, each_clearance, travels
from rtctl.types import B1, F64, Advice

FINE = 0.03  # [rad] between two postures of a way
AHEAD, POINTS_AHEAD = 0.22, 0.35  # [s] of full speed of joints, and of points, that the posture to head for is ahead
NEXT = 40  # postures ahead among which progress is looked for, and back, to which it backs off
SURE = 0.6  # of the way's own clearance that the straight line to it keeps, and of a point's there, before it
STAYS = 0.98  # of a point's clearance, below which it is nearer than it was
HORIZON = 1.2  # [s] of what moves that is looked at
LATE = 1.3  # by which the arm may take longer than at full speed
FLOOR = 1.5  # of the clearance, below which something is in the way
NEARER = 0.9  # of the way's own clearance, below which something has come


class Way(NamedTuple):
    """A way of postures."""

    Q: F64  # (k, n) [rad] FINE apart
    each: F64  # (k, m) [m] of each point, in each of them
    rho: F64  # (k,) [m] the least of these
    clear: B1  # (k,) the links keep the clearance

    @property
    def end(self) -> Ending:
        """Return its last posture."""
        return Ending(self.Q[-1], float(self.rho[-1]), bool(self.clear[-1]), 0.0)


def way_of(site: Site, path: F64) -> Way:
    """Return the way along a path (k, n) [rad]."""
    Q = np.concatenate([path[:1], *(along(a, b, FINE) for a, b in pairwise(path))])
    each = each_clearance(site.chain, site.robot.points, Q, site.obstacles)
    rho = each.min(axis=1)
    return Way(Q, each, rho, links_clear(site, Q, rho))


def progress(way: Way, at: int, q: F64) -> int:
    """Return which posture an arm at q (n,) has come to: the nearest of those ahead of `at`."""
    return at + int(np.abs(way.Q[at : at + NEXT] - q).max(axis=1).argmin())


def heading(site: Site, way: Way, at: int, checked: bool) -> Advice:
    """Return the posture to head for from the start; checked: no farther than the straight line to it is free.

    As far ahead as joints and points come in a moment, and no farther than past what is narrow: on the way there the
    field of what rests reaches each point as far as that point is off in the posture.
    """
    robot, q, next_ones = site.robot, site.start, way.Q[at : at + NEXT]
    joints = (np.abs(next_ones - q) / _full_speed(site)).max(axis=1)
    points = travelled(site, next_ones) / robot.motion.v_max
    reach = np.flatnonzero((joints <= AHEAD) & (points <= POINTS_AHEAD))
    ahead = at + int(reach[-1]) if len(reach) else min(at + 1, len(way.Q) - 1)
    each = np.minimum(way.each[at : ahead + 1], robot.avoid.rho0)
    passed = np.minimum.accumulate(each, axis=0)  # from the start on
    narrows = ((passed < SURE * each) & (passed < STAYS * each[0])).any(axis=1)
    ahead = max(min(at + 1, ahead), at + int(np.flatnonzero(~narrows)[-1]))
    while checked and ahead > at + 1:
        rho = float(clearance_of(site.chain, robot.points, along(q, way.Q[ahead], 2.0 * FINE), site.obstacles).min())
        if rho >= SURE * float(way.rho[at : ahead + 1].min()):
            break
        ahead = at + (ahead - at) // 2
    return Advice(way.Q[ahead], True, bool(way.clear[ahead]))


def travelled(site: Site, Q: F64) -> F64:
    """Return how far (b,) [m] the point that goes farthest is from where it is at the start, at postures Q (b, n)."""
    p = site.robot.points
    return travels(site.chain, p.link, p.local, site.start, Q)


def moves(site: Site) -> bool:
    """Return whether anything moves."""
    return bool(site.obstacles.v.any() or site.obstacles.w.any())


def comes(site: Site, way: Way, at: int) -> bool:
    """Return whether something will be on the way ahead, when the arm is: nearer than planned, and too near."""
    steps = (np.abs(np.diff(way.Q[at:], axis=0)) / _full_speed(site)).max(axis=1)
    times = np.concatenate([[0.0], np.cumsum(steps)]) * LATE
    some = np.arange(0, int(np.searchsorted(times, HORIZON)), 3)
    if not len(some):
        return False
    rho, planned = _rho(site, way.Q[at + some], times[some]), way.rho[at + some]
    return bool((rho < np.minimum(FLOOR * site.robot.avoid.rho_min, NEARER * np.minimum(planned, rho[0]))).any())


def yielding(site: Site, way: Way, at: int) -> Advice:
    """Return what to head for while something comes: where it is, or back along the way where that is freer.

    Towards where it is means nothing but damping: the field is free to push.
    """
    times = np.array([0.0, 0.3, 0.6, 1.0])
    best, most = site.start.copy(), float(_rho(site, np.tile(site.start, (4, 1)), times).min())
    if most < site.robot.avoid.rho0:
        for back in range(at, max(-1, at - NEXT), -8):
            rho = float(_rho(site, np.tile(way.Q[back], (4, 1)), times).min())
            if rho > most + 0.01:
                best, most = way.Q[back], rho
    return Advice(best, leads=True)


def _full_speed(site: Site) -> F64:
    full: F64 = site.robot.motion.speed_margin * site.robot.qd_max
    return full


def _rho(site: Site, Q: F64, times: F64) -> F64:
    p = site.robot.points
    return clearances(site.chain, p.link, p.local, p.radius, Q, site.obstacles, times, site.robot.avoid.rho0)
