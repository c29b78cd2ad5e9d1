"""What one tick leaves to the next: all of the controller's state, as one value.

What the servo level needs is one flat record, `hot.HOT`. Beside it stands what changes seldom: the model, the
obstacles, words.
"""

from typing import Any

import msgspec

from rtctl.arm.escape import Escape, Phase
from rtctl.arm.estimator import JointEstimate, TipEstimate
from rtctl.arm.faults import FAULTS, Counters
from rtctl.arm.flat import AGE, GOAL_RHO, MARGIN, RHO, model_in, row_of, shapes_of, table_of
from rtctl.arm.hot import READERS, record_of, write
from rtctl.arm.model import Model
from rtctl.arm.osc import OperationalSpace
from rtctl.types import F64, I64, Goal, Task
from rtctl.world.obstacle_table import World

_COLD = ("hot", "n", "refusal", "blocked_by", "model", "parameters", "placed", "table", "shapes", "ends", "grippers")


class Memory(msgspec.Struct, frozen=True):
    """Everything a tick knows of the past: a value as the named tuples are. The fields of `hot` are properties."""

    hot: F64  # what the servo level knows; see `record_of`
    n: int  # joints
    refusal: str  # why this tick's request was refused, '' when it was not
    blocked_by: tuple[str, ...]  # what holds the arm, in words
    model: Model
    parameters: F64  # the model and the task space; see `flat`
    placed: World  # the obstacles when they were last edited
    table: F64  # where they are now, and how far from arm and goal; see `flat`
    shapes: F64  # what does not change of them between edits
    ends: F64  # (3 m + L,) [m] the points in the goal's posture, where there is one, and how far its links are apart
    grippers: F64  # (10, g) what its grippers remember; see `gripper`

    def __getattr__(self, name: str) -> Any:
        """Return a field of the hot record, as the type that it stands for."""
        read = READERS.get(name)
        if read is None:
            raise AttributeError(name)
        return read(self.hot, self.n)

    @property
    def good(self) -> I64:
        """Return the ticks (faults,) since each fault was present."""
        return record_of(self.hot)["good"][0, : len(FAULTS)]

    @property
    def counters(self) -> Counters:
        """Return the counters of the detectors."""
        return Counters(*record_of(self.hot)["counters"][0].tolist())

    @property
    def space(self) -> OperationalSpace:
        """Return the operational space of `task`."""
        return model_in(self.parameters, self.n, len(self.model.P))[1]

    @property
    def world(self) -> World:
        """Return the obstacles as they are now."""
        t, slots = self.table, len(self.placed.names)
        p, R = t[: 3 * slots].reshape(slots, 3), t[3 * slots : 12 * slots].reshape(slots, 3, 3)
        obstacles = self.placed.obstacles._replace(p=p, R=R, margin=row_of(t, MARGIN))
        return self.placed._replace(obstacles=obstacles, age=row_of(t, AGE))

    @property
    def rho(self) -> F64:
        """Return the distances (K,) [m] from the arm to each obstacle."""
        return row_of(self.table, RHO)

    @property
    def goal_rho(self) -> F64:
        """Return the distances (K,) [m] from the goal to each obstacle."""
        return row_of(self.table, GOAL_RHO)

    @property
    def joints(self) -> JointEstimate:
        """Return the state of the joints."""
        h, n = record_of(self.hot)[0], self.n
        return JointEstimate(h["q"][:n], h["qd"][:n], h["P"][:n])

    @property
    def tip(self) -> TipEstimate:
        """Return the state of the tip."""
        h = record_of(self.hot)[0]
        return TipEstimate(h["x"], h["xd"], h["P_tip"], h["R"], h["omega"], h["P_rot"])

    @property
    def goal(self) -> Goal | None:
        """Return the goal, if there is one."""
        h = record_of(self.hot)[0]
        if not h["has_goal"]:
            return None
        return Goal(
            h["goal"],
            h["goal_wxyz"],
            Task(int(h["goal_task"])),
            float(h["goal_tolerance"]),
            float(h["goal_tolerance_rot"]),
            h["goal_axis"],
            h["goal_posture"][: self.n] if h["has_posture"] else None,
            h["goal_v"] if h["goal_v"].any() else None,
            h["goal_w"] if h["goal_w"].any() else None,
            float(h["goal_timeout"]) or None,
        )

    @property
    def hold(self) -> Goal:
        """Return where the tip stays without a goal."""
        h = record_of(self.hot)[0]
        return Goal(
            h["hold"],
            h["hold_wxyz"],
            Task(int(h["hold_task"])),
            float(h["hold_tolerance"]),
            float(h["hold_tolerance_rot"]),
            h["hold_axis"],
        )

    @property
    def escape(self) -> Escape:
        """Return the escape."""
        h = record_of(self.hot)[0]
        return Escape(
            Phase(int(h["escape_phase"])),
            float(h["escape_hit"]),
            h["escape_n"],
            h["escape_b"],
            h["escape_costs"],
            int(h["escape_ticks"]),
            int(h["escape_slow"]),
        )

    def _replace(self, **changes: Any) -> "Memory":
        """Return a memory with other values in the fields named, as a named tuple's `_replace` does."""
        cold = {name: changes.pop(name) for name in _COLD if name in changes}
        around = {name: changes.pop(name) for name in ("world", "rho", "goal_rho") if name in changes}
        if around:
            world = around.get("world", self.world)
            cold["placed"], cold["shapes"] = world, shapes_of(world.obstacles, world.moving, world.creep, world.stale)
            rho, goal_rho = (around.get(name, getattr(self, name)) for name in ("rho", "goal_rho"))
            cold["table"] = table_of(world.obstacles, world.age, rho, goal_rho)
        if changes:
            hot = cold.get("hot", self.hot).copy()
            write(hot, changes)
            cold["hot"] = hot
        return msgspec.structs.replace(self, **cold)
