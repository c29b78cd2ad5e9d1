"""What one tick leaves to the next: all of the controller's state, as one value."""

from typing import Any

import msgspec

from rtctl.arm.escape import Escape
from rtctl.arm.estimator import JointEstimate, TipEstimate
from rtctl.arm.faults import Counters
from rtctl.arm.model import Model
from rtctl.arm.osc import OperationalSpace
from rtctl.types import F64, I64, Goal, Severity, State, Status, Task
from rtctl.world.obstacle_table import World


class Memory(msgspec.Struct, frozen=True):
    """Everything a tick knows of the past: a value as the named tuples are, copied eight times as fast."""

    tick: int
    # supervisor
    state: State
    since: int  # tick of entering the state
    reaction: Severity  # of SAFE_STOP and FAULT, NONE elsewhere
    off: bool  # SAFE_STOP has cut the torque and will not give it back
    in_force: int  # faults
    good: I64  # (faults,) ticks since each was present
    counters: Counters
    clear_until: int  # tick until which latched drive faults are being cleared
    recovering: bool  # armed outside the joint limits, on request
    outside: bool  # a joint is beyond its limits
    leaving: bool  # SIGTERM came
    done: bool  # nothing more to do: the daemon may leave
    verdict: str  # why this tick's request was refused, '' when it was not
    # estimates
    joints: JointEstimate
    tip: TipEstimate
    innovation: float  # normalised, largest of this tick
    model: Model
    space: OperationalSpace
    task: Task  # that `space` was evaluated for
    axis: F64  # (3,) of the tool that goes with it
    evaluated: bool  # the model, this tick
    phase: float  # model periods since the last evaluation was due, in (-1, 0]
    qdd: F64  # (n,) [rad/s2] predicted from the torque of the last command
    q_previous: F64  # (n,) [rad] of the last feedback
    age_previous: F64  # (n,) [s] how old it was
    watch: F64  # (5, n) on the encoders; see `watch`
    rest: int  # ticks all joints have been at rest
    # task
    goal: Goal | None
    hold: Goal  # where the tip stays without a goal
    q_rest: F64  # (n,) [rad] posture of the hold
    v_ref: F64  # (3,) [m/s]
    w_ref: F64  # (3,) [rad/s]
    goal_rho: F64  # (K,) [m] from the goal to each obstacle
    status: Status
    blocker: int  # obstacle slot or joint index that holds the arm most, -1 for none
    holders: int  # bits of all that hold it
    held: tuple[str, ...]  # the same in words
    escape: Escape
    still: int  # ticks the tip has been at rest
    nearest: float  # [s] at full speed: the least that the goal was away
    idle: float  # [s] for which it has not come nearer; see `goals.idle`
    # world and torque
    world: World
    rho: F64  # (K,) [m] from the arm to each obstacle
    tau_obstacles: F64  # (n,) [Nm] of the last tick
    sent: F64  # (4, n) [Nm] the last commands, newest first
    cut: int  # types.Cut of the last tick
    pulled: bool  # the last reference for the slew was taken from the echo: the drive does not give what it is sent
    pace: float  # fraction of qd_max that joints may have

    def _replace(self, **changes: Any) -> "Memory":
        """Return a memory with other values in the fields named, as a named tuple's `_replace` does."""
        return msgspec.structs.replace(self, **changes)
