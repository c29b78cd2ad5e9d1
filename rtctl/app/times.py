"""How long ways to a goal take, reckoned beside the servo: the tip's, the law's past what rests, that of the joints."""

import numpy as np

from rtctl.app.plan import speeds_of
from rtctl.app.postures import STEP, Ending, Site, inertia_of, previewed
from rtctl.arm.kinematics import clearance_of
from rtctl.arm.search import lasts
from rtctl.arm.task import error_of
from rtctl.types import F64, Goal

LATER, LATEST = 1.25, 0.75  # of the time that another way takes, and [s] more, after which the law is late
DULL = 0.1  # of the largest inertia, that every joint has beside its own where it is pushed aside


def late(takes: float) -> float:
    """Return the time [s] after which an arm is late that could take so long [s]."""
    return LATER * takes + LATEST


def missed(site: Site, goal: Goal) -> tuple[float, float]:
    """Return how far [m], and by what angle [rad], the tip is from the goal where the arm starts."""
    tip = site.robot.body.evaluate(site.start, np.zeros(site.robot.n), site.robot.points)
    return error_of(goal, tip.x, tip.R)


def tip_takes(site: Site, goal: Goal) -> float:
    """Return the time [s] of the tip straight to the goal."""
    far, turned = missed(site, goal)
    return max(far / site.robot.motion.v_max, turned / site.robot.motion.w_max)


def joints_take(site: Site, path: F64) -> float:
    """Return the time [s] of joints that are led along a path (k, n) [rad]."""
    return lasts(site.chain, path, speeds_of(site.robot))


def law_takes(site: Site, goal: Goal, given: Ending | None) -> float:
    """Return the time [s] in which the law gets there past what rests, infinite where that holds it.

    given: the posture that the null space heads for, None for the posture of rest.
    """
    keep, rest = site.robot.avoid.rho_min, site.robot.q_rest
    if given is not None:
        keep, rest = min(keep, given.rho), given.q
    Q, there = previewed(site, goal, rest, dulled(site), keep)
    return STEP * len(Q) if there else np.inf


def dulled(site: Site) -> F64:
    """Return an inertia (n, n) [kg m2] of which light joints have more: pushed aside, they are damped as well."""
    A = inertia_of(site)
    out: F64 = A + DULL * A.diagonal().max() * np.eye(site.robot.n)
    return out


def is_met(site: Site, Q: F64) -> bool:
    """Return whether something that rests is in the way Q (k, n)."""
    o, keep = site.obstacles, site.robot.avoid.rho_min
    rests = o._replace(active=o.active & ~(o.v.any(axis=1) | o.w.any(axis=1)))
    rho = clearance_of(site.chain, site.robot.points, Q, rests, site.robot.avoid.rho0)
    return bool(rho.min() < min(keep, 0.9 * min(rho[0], rho[-1])))
