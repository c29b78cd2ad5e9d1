"""Following a plan: which sub-goal comes next, and when to plan anew. The same for a daemon and for a simulation.

A sub-goal is passed, not arrived at: the next one is given when the tip comes near, before it begins to brake.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtctl.errors import PlanError
from rtctl.types import F64, Goal

PASS = 0.07  # [m] from a sub-goal, at which the next one is given
PASS_POSTURE = 0.5  # [rad] that a joint may still be away from the sub-goal's posture then
REPLANS = 4  # new plans after the first
HELD = frozenset(("local_minimum", "escaping", "limited", "shadowed", "singular", "unreachable", "saturated"))

Plan = Callable[[F64, int], list[Goal]]


class ArmStatus(NamedTuple):
    """What the controller says of itself."""

    status: str  # of types.Status, in small letters
    detail: str
    x: F64  # (3,) [m] tip
    q: F64  # (n,) [rad]


class GoalStream:
    """The sub-goals of one far goal, given one by one."""

    def __init__(self, plan: Plan, q: F64, seed: int = 0) -> None:
        """`plan` makes sub-goals from a posture and a seed; the first ones from q. Raises PlanError."""
        self._plan, self._seed = plan, seed
        self.goals = plan(q, seed)
        self.at = -1  # the sub-goal given last
        self.replans = 0
        self.events: list[str] = [f"{len(self.goals)} sub-goals"]
        self.over = ""  # how it ended: "arrived", or what held the arm

    def next(self, seen: ArmStatus) -> Goal | None:
        """Return the sub-goal to give now, None to let the arm go on."""
        if self.over:
            return None
        if self.at < 0:
            return self._given(0)
        last = self.at == len(self.goals) - 1
        if last and seen.status == "arrived":
            self.over = "arrived"
            return None
        if not last and self._passed(seen):
            return self._given(self.at + 1)
        if seen.status in HELD and not (last and seen.status == "shadowed"):
            return self._replanned(seen)
        if seen.status == "shadowed":
            self.over = f"shadowed: {seen.detail}"
        return None

    def _passed(self, seen: ArmStatus) -> bool:
        goal = self.goals[self.at]
        if float(np.linalg.norm(seen.x - goal.position)) > PASS:
            return False
        away = 0.0 if goal.posture is None else float(np.abs(seen.q - goal.posture).max())
        return away <= PASS_POSTURE or seen.status == "arrived"

    def _given(self, at: int) -> Goal:
        self.at = at
        return self.goals[at]

    def _replanned(self, seen: ArmStatus) -> Goal | None:
        why = f"{seen.status}: {seen.detail}" if seen.detail else seen.status
        if self.replans == REPLANS:
            self.over = why
            return None
        self.replans += 1
        try:
            self.goals = self._plan(seen.q, self._seed + self.replans)
        except PlanError as error:
            self.over = f"{why}; {error}"
            return None
        self.events.append(f"planned anew after {why}: {len(self.goals)} sub-goals")
        return self._given(0)
