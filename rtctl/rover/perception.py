"""What the base knows of its surroundings: what it was told, and what its sensors draw into the chart."""

import math

import numpy as np

from rtctl.rover import occupancy, outline
from rtctl.rover.memory import BaseMemory
from rtctl.rover.robot import Base
from rtctl.rover.signals import BaseFeedback
from rtctl.rover.supervision import goal_distance
from rtctl.types import F64, Request
from rtctl.world import obstacle_table

NEAR = 6.0  # [m] that returns are looked at around the base
BEAM_TICKS = 5  # between two looks of the single sensors


def perceived(base: Base, m: BaseMemory, f: BaseFeedback, request: Request, elapsed: float) -> BaseMemory:
    """Told obstacles moved on and edited, a new scan drawn into the chart from where it was taken."""
    table, refusal = obstacle_table.advanced(m.world, elapsed), m.refusal
    if request.obstacles:
        table, refusal = obstacle_table.edited(table, request.obstacles)
    seen, scans, due = occupancy.moved(m.chart, m.here.x), m.scans, m.due
    if f.scans and f.scan_age < base.safety.scan_stale:
        scan = _placed_scan(base, m, f)
        seen = occupancy.integrate_scan(seen, scan, m.tick - round(f.scan_age / base.dt))
        k = min(f.sensor, len(scans) - 1)
        scans, due = (*scans[:k], _returns(scan), *scans[k + 1 :]), min(due, m.tick)
    if m.tick % BEAM_TICKS == 0 and (f.beams >= 0.0).any():
        scan = occupancy.PlacedScan(m.here.x, m.here.yaw, -0.25 * math.pi, f.beams, min(f.beam_reach, base.sense))
        seen = occupancy.integrate_scan(seen, scan, m.tick)
    if len(base.cover):
        seen = outline.stood(seen, base.cover, m.here.x, m.here.yaw, m.tick)
    else:
        seen = occupancy.stood(seen, m.here.x, base.margins.hull, m.tick)
    rho = m.goal_rho if m.goal is None else goal_distance(base, table, m.goal)
    return m._replace(world=table, refusal=refusal, chart=seen, scans=scans, due=due, goal_rho=rho)


def _placed_scan(base: Base, m: BaseMemory, f: BaseFeedback) -> occupancy.PlacedScan:
    """Return the feedback's scan from where its sensor was when it was taken."""
    x, yaw = m.here.x - f.scan_age * m.here.v, m.here.yaw - f.scan_age * m.here.yaw_rate
    c, s = math.cos(yaw), math.sin(yaw)
    at = x + np.array([c * f.scan_offset[0] - s * f.scan_offset[1], s * f.scan_offset[0] + c * f.scan_offset[1]])
    return occupancy.PlacedScan(at, yaw + f.scan_start, f.scan_step, f.scan, min(f.scan_reach, base.sense))


def _returns(scan: occupancy.PlacedScan) -> F64:
    """Return the points (m, 2) [m] that a scan touched."""
    hit = (scan.ranges >= 0.0) & (scan.ranges <= scan.reach)
    angle = scan.angle + scan.step * np.flatnonzero(hit)
    points: F64 = scan.x + scan.ranges[hit, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return points


def surroundings(m: BaseMemory, f: BaseFeedback) -> tuple[F64, int]:
    """Return every return (m, 2) [m] near the base, and how many are of the newest scans and single sensors: first."""
    x, yaw = m.here.x, m.here.yaw
    parts = [*m.scans]
    hit = (f.beams >= 0.0) & np.isfinite(f.beams)
    if hit.any():
        angle = yaw - 0.25 * np.pi * np.flatnonzero(hit)
        parts.append(x + f.beams[hit, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    now = sum(map(len, parts))
    return np.concatenate([*parts, occupancy.returns_near(m.chart, x, NEAR)]), now
