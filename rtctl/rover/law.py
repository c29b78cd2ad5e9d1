"""The law on the plane: the arm's goal and FIRAS on a unit mass, integrated to a velocity, turned into wheels' terms.

    xdd* = -k_v (v_ref - nu xd_d) + sum_i n_i (a_i + d_i)        Khatib 1986, on the plane
    v_ref' = xdd*, under a_max and V_max

A base has no torque to be pushed with: what the arm's inertia does, v_ref does here. For wheels that cannot go
sideways a control point at a distance l ahead of the axle turns it into v = v_ref . e_x, w = (v_ref . e_y)/l. A
governor then keeps the speed below what the brakes can spend before the nearest thing ahead.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.control.firas import FieldParams, firas
from rtctl.kernel import kernel
from rtctl.rover import outline
from rtctl.rover.occupancy import CELL, Chart, seen_ahead
from rtctl.rover.robot import Base
from rtctl.types import F64
from rtctl.world.primitives import Obstacles, distances_into

RESERVE = 0.45  # of the lag, for a vehicle that answers later than its config says
HORIZON = 30.0  # [m] that the governor looks ahead
CREEP = 0.3  # [m/s] at which a car that cannot turn on the spot comes round


class Push(NamedTuple):
    """The field on the base."""

    sensed: F64  # (2,) [m/s2] of the returns of the scan and of the chart, one union
    known: F64  # (K, 2) [m/s2] of each known obstacle
    rho_sensed: float  # [m] to the nearest return of the newest scan, infinite without one
    rho: F64  # (K,) [m] to each known obstacle, infinite where there is none
    closing: F64  # (K,) [m/s] of each known obstacle towards the base by its own motion
    normal: F64  # (K, 2)


class Footprint(NamedTuple):
    """The points that stand for the base's outline."""

    points: F64  # (m, 2) [m] in the world
    radius: F64  # (m,) [m]


class Twist(NamedTuple):
    """What the wheels are asked for."""

    v: float  # [m/s] forward
    w: float  # [rad/s]
    velocity: F64  # (2,) [m/s] in the world


REST = Twist(0.0, 0.0, np.zeros(2))


def history(base: Base) -> int:
    """Return how many twists are on their way to the wheels at most."""
    return max(1, math.ceil(max(base.margins.lag, base.margins.turn_lag) / base.dt))


def ahead_of(base: Base, x: F64, yaw: float, sent: F64) -> tuple[F64, float]:
    """Return pose (x (2,) [m], yaw [rad]) that a twist sent now will meet: after those still on their way.

    A vehicle answers late by a dead time and a lag of its own. Steered by where it is it weaves; steered by where
    what was sent will have brought it, it does not (Smith's predictor).
    """
    return _ahead_of(x, yaw, sent, base.margins.lag / base.dt, base.margins.turn_lag / base.dt, base.dt)


@kernel
def _ahead_of(x: F64, yaw: float, sent: F64, lag: float, turn_lag: float, dt: float) -> tuple[F64, float]:
    px, py = x[0], x[1]
    for k in range(sent.shape[0] - 1, -1, -1):  # the oldest first
        share_v, share_w = min(max(lag - k, 0.0), 1.0), min(max(turn_lag - k, 0.0), 1.0)
        yaw += dt * share_w * sent[k, 1]
        px += dt * share_v * sent[k, 0] * math.cos(yaw)
        py += dt * share_v * sent[k, 0] * math.sin(yaw)
    return np.array([px, py]), yaw


def field(base: Base, x: F64, yaw: float, v: F64, seen: F64, now: int, obstacles: Obstacles) -> Push:
    """Return the field at x (2,) [m], yaw [rad], moving at v (2,) [m/s].

    seen (m, 2) [m] are returns, the first `now` of them of the newest scan: the others are known to a cell alone, good
    to be pushed by, too coarse to say how near something is.
    """
    footprint = Footprint(outline.placed(base.points, x, yaw), base.point_radius)
    sensed, rho_sensed = _sensed(footprint, v, seen, now, base.field)
    known, rho, closing, normal = _known(footprint, v, obstacles, base.margins.height, base.field)
    return Push(sensed, known, rho_sensed, rho, closing, normal)


@kernel
def _sensed(footprint: Footprint, v: F64, seen: F64, now: int, p: FieldParams) -> tuple[F64, float]:
    """Return (push (2,), rho) of a union of returns.

    A surface comes as many returns: their sum would grow with the sensor's resolution. The union's magnitude is that
    of the nearest, its direction the mean of all, weighed by what each would push.
    """
    points, radius = footprint
    bx, by, weight, strongest, nearest = 0.0, 0.0, 0.0, 0.0, math.inf
    for i in range(seen.shape[0]):
        rho, nx, ny = math.inf, 1.0, 0.0
        for j in range(points.shape[0]):
            dx, dy = points[j, 0] - seen[i, 0], points[j, 1] - seen[i, 1]
            d = math.sqrt(dx * dx + dy * dy)
            if d - radius[j] < rho:
                rho = d - radius[j]
                if d > 1e-9:
                    nx, ny = dx / d, dy / d
        if i < now:
            nearest = min(nearest, rho)
        if rho >= p.rho0:
            continue
        a, d = firas(rho, nx * v[0] + ny * v[1], p.rho0, p.rho_min, p.rho_num, p.eta, p.k_d)
        bx, by, weight = bx + (a + d) * nx, by + (a + d) * ny, weight + a + d
        strongest = max(strongest, a + d)
    out = np.zeros(2)
    if weight > 0.0:
        out[0], out[1] = strongest * bx / weight, strongest * by / weight
    return out, nearest


@kernel
def _known(
    footprint: Footprint, v: F64, obstacles: Obstacles, height: float, p: FieldParams
) -> tuple[F64, F64, F64, F64]:
    """Return (push (K, 2), rho (K,), closing (K,), normal (K, 2)); the nearest point of the footprint is pushed."""
    points, radius = footprint
    slots, m = obstacles.active.shape[0], points.shape[0]
    P, out = np.empty((3, m)), np.zeros((slots, 4, m))
    for j in range(m):
        P[0, j], P[1, j], P[2, j] = points[j, 0], points[j, 1], height
    distances_into(P, radius, obstacles, math.inf, out)
    push, rhos, closing, normal = np.zeros((slots, 2)), np.full(slots, math.inf), np.zeros(slots), np.zeros((slots, 2))
    for k in range(slots):
        if not obstacles.active[k]:
            continue
        near = 0
        for j in range(m):
            if out[k, 0, j] < out[k, 0, near]:
                near = j
        rho, nx, ny = out[k, 0, near], out[k, 1, near], out[k, 2, near]
        flat = math.sqrt(nx * nx + ny * ny)
        nx, ny = (nx / flat, ny / flat) if flat > 1e-6 else (1.0, 0.0)
        towards = nx * obstacles.v[k, 0] + ny * obstacles.v[k, 1]
        rhos[k], closing[k], normal[k, 0], normal[k, 1] = rho, max(towards, 0.0), nx, ny
        wide = p.rho0 + max(towards, 0.0) * p.look_ahead
        if rho < wide:
            a, d = firas(rho, nx * v[0] + ny * v[1] - towards, wide, p.rho_min, p.rho_num, p.eta, p.k_d)
            push[k, 0], push[k, 1] = (a + d) * nx, (a + d) * ny
    return push, rhos, closing, normal


def desired(base: Base, x: F64, via: F64, length: float) -> F64:
    """Return xd_d under V_max (2,) [m/s]: towards via (2,) [m], as fast as `length` [m] of way leaves to brake in."""
    e = via - x
    d = float(np.hypot(e[0], e[1]))
    if d < 1e-9:
        return np.zeros(2)
    k = base.k_p / base.k_v
    speed = min(base.limits.v_max, k * length, math.sqrt(base.limits.a_max * length))
    return e * (speed / d)


def integrated(base: Base, v_ref: F64, xd_d: F64, push: F64, elapsed: float) -> F64:
    """Return the next v_ref (2,) [m/s], `elapsed` [s] on: k_v (xd_d - v_ref) + push (2,) under a_max, then V_max.

    The push may have a_max by itself and a half more: the goal must not be able to press the base into a field.
    """
    gain = min(base.k_v, 1.0 / elapsed)
    motion = _bounded(gain * (xd_d - v_ref), base.limits.a_max)
    total = _bounded(motion + _bounded(push, 1.5 * base.limits.a_max), 1.5 * base.limits.a_max)
    return _bounded(v_ref + elapsed * total, base.limits.v_max)


def _bounded(a: F64, most: float) -> F64:
    size = float(np.hypot(a[0], a[1]))
    return a if size <= most else a * (most / size)


def unicycle(base: Base, v_ref: F64, yaw: float) -> tuple[float, float]:
    """Return (v [m/s], w [rad/s]) that move a control point ahead of the axle at v_ref (2,) [m/s]."""
    c, s = math.cos(yaw), math.sin(yaw)
    ahead, aside = c * v_ref[0] + s * v_ref[1], c * v_ref[1] - s * v_ref[0]
    lim = base.limits
    speed = math.hypot(ahead, aside)
    if speed < 1e-6:
        return 0.0, 0.0
    w = aside / base.ahead
    if ahead < 0.0 and not lim.reverse:  # behind: turn towards it on the spot, as though it were abreast
        w, ahead = math.copysign(speed, aside) / base.ahead, 0.0
    if lim.radius > 0.0:  # a car turns only while it rolls
        if abs(ahead) < CREEP and abs(w) * lim.radius > abs(ahead):
            ahead = math.copysign(min(CREEP, speed), ahead)
        bound = abs(ahead) / lim.radius
        w = min(max(w, -bound), bound)
    return ahead, min(max(w, -lim.w_max), lim.w_max)


class Course(NamedTuple):
    """Where the base is and which way it moves."""

    pose: F64  # (3,) [m, m, rad]
    direction: F64  # (2,) unit
    coming: float  # [m] the way that what was sent will still take
    legs: bool  # it keeps to a leg: its outline counts, not the circle about it


def allowed_speed(base: Base, course: Course, seen: F64, obstacles: Obstacles, push: Push) -> float:
    """Return the speed [m/s] that can be braked to rest before anything ahead; at most V_max.

    Straight on, a circle of the hull's radius must not come nearer than `stop` to a return or a known obstacle; one
    that moves is met with its own speed taken off what may be spent. An outline that is no circle counts itself on a
    leg, and for what is within that circle already.
    """
    m = base.margins
    x, direction, coming = course.pose[:2], course.direction, course.coming
    if len(base.cover):
        gap = _gap_outline(base, course, seen, obstacles)
    else:
        r = m.hull + m.stop
        gap = _gap_sensed(x, direction, r, seen)
        gap = min(gap, _gap_known(x[None], direction, np.array([r]), m.height, obstacles, HORIZON))
    coming = max(coming, 0.0)
    v = min(base.limits.v_max, spend(gap - coming, m.brake, RESERVE * m.lag))
    for k in np.flatnonzero(push.closing > 0.0):
        towards = -float(push.normal[k] @ direction)
        if towards > 0.05:
            left = spend(float(push.rho[k]) - m.stop - towards * coming, m.brake, m.lag) - float(push.closing[k])
            v = min(v, max(left, 0.0) / towards)
    return v


def _gap_outline(base: Base, course: Course, seen: F64, obstacles: Obstacles) -> float:
    """Return how far [m] an outline that is no circle can move along its course."""
    m, x, direction = base.margins, course.pose[:2], course.direction
    points, keeps = outline.placed(base.points, x, course.pose[2]), base.point_radius + m.stop
    wide = m.hull + m.stop
    gap = outline.gap_past(points, keeps, x, direction, 0.0 if course.legs else wide, seen)
    by_circle = (
        math.inf if course.legs else _gap_known(x[None], direction, np.array([wide]), m.height, obstacles, HORIZON)
    )
    if course.legs or by_circle == 0.0:
        by_circle = _gap_known(points, direction, keeps, m.height, obstacles, HORIZON)
    return min(gap, by_circle)


def way_of_turn(base: Base) -> float:
    """Return the angle [rad] from w_max to rest: lag first, then at alpha_max."""
    lim = base.limits
    return lim.w_max * base.margins.turn_lag + lim.w_max**2 / (2.0 * lim.alpha_max) + outline.FINE


def held_turn(base: Base, w: float, free: float, coming: float) -> float:
    """Return the yaw rate [rad/s] towards w, at most that, from which a turn ends within `free` [rad].

    coming [rad]: what was sent will still turn that way.
    """
    most = spend(free - max(coming, 0.0), base.limits.alpha_max, RESERVE * base.margins.turn_lag)
    return math.copysign(min(abs(w), most), w)


def seen_speed(base: Base, chart: Chart, course: Course, tick: int) -> float:
    """Return the speed [m/s] that can be braked to rest within what was seen free ahead of the hull; at most V_max.

    Space that was seen some time ago counts, for less: from
    half of `seen` [s] on the speed falls with its age, so that the base rests by when it counts no more.
    """
    m, most = base.margins, base.limits.v_max
    coming = course.coming
    reach = way_to_rest(base) + max(coming, 0.0)
    oldest = tick - round(base.safety.seen / base.dt)
    if course.legs:
        gap, first = outline.strip_seen(base, chart, course.pose, course.direction, reach, oldest)
    else:
        gap, first = seen_ahead(chart, course.pose[:2], course.direction, m.hull, reach, oldest)
    age = max(tick - first, 0) * base.dt / base.safety.seen
    fades = most * min(2.0 - 2.0 * age, 1.0)
    return min(max(fades, 0.0), spend(gap - 0.5 * CELL - max(coming, 0.0), m.brake, RESERVE * m.lag))


def way_to_rest(base: Base) -> float:
    """Return the way [m] from V_max to rest: lag first, then the brakes."""
    return base.limits.v_max * base.margins.lag + base.limits.v_max**2 / (2.0 * base.margins.brake)


def spend(gap: float, brake: float, lag: float) -> float:
    """Return the speed [m/s] from which `lag` [s] of it and braking at `brake` [m/s2] take `gap` [m]."""
    if gap <= 0.0:
        return 0.0
    if math.isinf(gap):
        return math.inf
    return -brake * lag + math.sqrt((brake * lag) ** 2 + 2.0 * brake * gap)


@kernel
def _gap_sensed(x: F64, e: F64, r: float, seen: F64) -> float:
    """Return how far [m] a circle of radius r about x can move along e until a return touches it."""
    gap = math.inf
    for i in range(seen.shape[0]):
        dx, dy = seen[i, 0] - x[0], seen[i, 1] - x[1]
        along, aside = dx * e[0] + dy * e[1], dy * e[0] - dx * e[1]
        if along <= 0.0 or abs(aside) >= r:
            continue
        gap = min(gap, max(along - math.sqrt(r * r - aside * aside), 0.0))
    return gap


@kernel
def _gap_known(x: F64, e: F64, r: F64, height: float, obstacles: Obstacles, horizon: float) -> float:
    """Return the same of circles of radii r (m,) about x (m, 2) for known obstacles.

    Steps as long as the free distance never jump over one.
    """
    slots, m = obstacles.active.shape[0], x.shape[0]
    P, none, out = np.empty((3, m)), np.zeros(m), np.zeros((slots, 4, m))
    s = 0.0
    for turn in range(60):
        for j in range(m):
            P[0, j], P[1, j], P[2, j] = x[j, 0] + s * e[0], x[j, 1] + s * e[1], height
        distances_into(P, none, obstacles, math.inf, out)
        rest = math.inf
        for k in range(slots):
            if not obstacles.active[k]:
                continue
            for j in range(m):
                d = out[k, 0, j] - r[j]
                if turn == 0 and d <= 0.0:  # already nearer than that: it may leave, not come closer
                    if out[k, 1, j] * e[0] + out[k, 2, j] * e[1] < 0.0:
                        return 0.0
                    continue
                rest = min(rest, d)
        if rest < 0.01:
            return s
        s += rest
        if s > horizon:
            return math.inf
    return s
