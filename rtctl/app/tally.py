"""What a simulated run reports of its goals, the way and the clearances: the same for an arm and a base."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rtctl.control.goals import moves
from rtctl.plain import Json
from rtctl.types import F64, Goal


class Leg(NamedTuple):
    """One goal on its way: where the tip or the base was when it was given."""

    goal: Goal
    at: float  # [s]
    start: F64  # (3,) or (2,) [m]
    reached: float = -1.0  # [s] since when it has stayed within the tolerances, -1: not now
    deviation: float = 0.0  # [m] from the straight line
    error: float = np.inf  # [m]
    error_rot: float = np.inf  # [rad] of an arm

    def advanced(
        self, now: float, there: bool, along: F64, offset: F64, error: float, error_rot: float = np.inf
    ) -> "Leg":
        """Return the leg after a period: distance to the goal, to the line, and since when it has been there.

        along: [m] from the start to the goal; offset: [m] from the start to where it is now [s].
        """
        length = math.hypot(*along.tolist())
        if length > 1e-9:
            offset = offset - along * min(max(float(offset @ along) / length**2, 0.0), 1.0)
        reached = (self.reached if self.reached >= 0.0 else now) if there else -1.0
        deviation = max(self.deviation, math.hypot(*offset.tolist()))
        return self._replace(reached=reached, deviation=deviation, error=error, error_rot=error_rot)


def kept(legs: Sequence[Leg], to_come: int, now: float) -> float:
    """Return how long [s] the last of all goals has been kept, 0 while it is not or others are to come."""
    return 0.0 if to_come or not legs or legs[-1].reached < 0.0 else now - legs[-1].reached


def number(value: float) -> float | None:
    """Return a figure to nine digits; JSON has no infinity."""
    return float(f"{value:.9g}") if np.isfinite(value) else None


def of_way(
    legs: Sequence[Leg], path: float, speed: float, clearance: Mapping[str, float], contacts: int, turned: bool
) -> Json:
    """Return the figures that every run has under their published names; turned: with errors of orientation."""
    last, rests = legs[-1] if legs else None, [leg for leg in legs if not moves(leg.goal)]
    goals = [
        {
            "at_s": number(leg.at),
            "arrived": None if moves(leg.goal) else leg.reached >= 0.0,
            "time_to_goal_s": number(leg.reached - leg.at) if leg.reached >= 0.0 else None,
            "error_m": number(leg.error),
            **({"error_rad": number(leg.error_rot)} if turned else {}),
            "line_deviation_m": number(leg.deviation),
        }
        for leg in legs
    ]
    return {
        "arrived": bool(rests) and all(leg.reached >= 0.0 for leg in rests),
        "time_to_goal_s": goals[-1]["time_to_goal_s"] if goals else None,
        "final_error_m": number(last.error) if last else None,
        **({"final_error_rad": number(last.error_rot) if last else None} if turned else {}),
        "path_length_m": number(path),
        "line_deviation_m": number(max((leg.deviation for leg in legs), default=0.0)),
        "max_speed_m_s": number(speed),
        "min_clearance_m": {
            "all": number(min(clearance.values())) if clearance else None,
            **{name: number(d) for name, d in clearance.items()},
        },
        "contacts": contacts,
        "goals": goals,
    }
