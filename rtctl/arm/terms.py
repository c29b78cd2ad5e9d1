"""What the law takes and what it gives: motion, what is known ahead, memory to work in, the torques by their origin."""

from typing import NamedTuple

import numpy as np

from rtctl.arm.field import APART, Ends
from rtctl.arm.osc import Twist
from rtctl.arm.robot import Robot
from rtctl.kernel import kernel
from rtctl.types import F64, I32, I64

# rows of Law.torques, (7, n) [Nm]; the first five as the record has them
MOTION = 0
OBSTACLES = 1  # self-collision included
LIMITS = 2  # of joint position and speed
POSTURE = 3
LOAD = 4  # h + g
DRIVE = 5  # pursues the goal or the posture
KEEP = 6  # dissipates, repels, carries


class Law(NamedTuple):
    """The torques [Nm], and what the field saw."""

    task: F64  # (12,) F, v_ref, w_ref below
    torques: F64  # (7, n) [Nm] the rows above
    seen: F64  # (4 K,) rho, then force, below
    nearest: I32  # (K,) PSP
    rho_self: float  # [m]
    flags: int  # LimitFlag.FIELD_CAP, LimitFlag.SPEED, LimitFlag.SINGULAR, LimitFlag.MOTION_SCALED

    def row(self, i: int) -> F64:
        """Return a row (n,) [Nm] of the torques."""
        row: F64 = self.torques[i]
        return row

    @property
    def F(self) -> F64:
        """F*_m (6,) [m/s2, rad/s2]."""
        return self.task[:6]

    @property
    def v_ref(self) -> F64:
        """(3,) [m/s] of this tick."""
        return self.task[6:9]

    @property
    def w_ref(self) -> F64:
        """(3,) [rad/s] of this tick."""
        return self.task[9:]

    @property
    def rho(self) -> F64:
        """(K,) [m] smallest distance of any PSP, inf where there is no obstacle."""
        return self.seen[: self.nearest.shape[0]]

    @property
    def force(self) -> F64:
        """(K, 3) [N] on the arm."""
        return self.seen[self.nearest.shape[0] :].reshape(-1, 3)

    @property
    def tau_motion(self) -> F64:
        """(n,) [Nm], as are the rows that follow."""
        return self.row(MOTION)

    @property
    def tau_posture(self) -> F64:
        """Row POSTURE."""
        return self.row(POSTURE)

    @property
    def tau_obstacles(self) -> F64:
        """Row OBSTACLES."""
        return self.row(OBSTACLES)

    @property
    def tau_limits(self) -> F64:
        """Row LIMITS."""
        return self.row(LIMITS)

    @property
    def drive(self) -> F64:
        """Row DRIVE."""
        return self.row(DRIVE)

    @property
    def keep(self) -> F64:
        """Row KEEP."""
        return self.row(KEEP)


class Ahead(NamedTuple):
    """What is known of a posture that has the goal."""

    ends: Ends
    zone: F64  # (n,) [rad or m] in which joint limits push
    leads: bool  # the joints head for it, not the tip for the goal
    reference: F64  # (n,) [rad/s] of that; written


class Motion(NamedTuple):
    """Where the joints are and what the tip is to do."""

    q: F64  # (n,) [rad] now
    qd: F64  # (n,)
    actual: Twist  # the tip's velocity [m/s, rad/s]
    error: Twist  # the way to go [m, rad]
    previous: Twist  # velocity references of the last tick
    q_rest: F64  # (n,) [rad] the posture
    speed_scale: float  # fraction of qd_max that joints may have
    qdd: F64  # (n,) [rad/s2] of the torque sent last; there the guards begin to search
    floats: bool  # a hand or another law moves the arm: no motion, no posture
    hand: F64  # (n,) [Nm] then
    ahead: Ahead
    sent: F64  # (n,) [Nm] torque under way, from which what is sent is slewed; (0,): nothing moves yet


def nothing_ahead(robot: Robot) -> Ahead:
    """Return what is known without a posture of the goal."""
    nowhere = Ends(np.zeros((0, 3)), np.zeros((0, 0)), 0.0, APART, 0.0, np.zeros(0))
    return Ahead(nowhere, robot.limit.rho0.copy(), False, np.zeros(robot.n))


class Cover(NamedTuple):
    """The spheres that stand for the links."""

    radius: F64  # (m,) [m]
    link: I64  # (m,)


class WorkMemory(NamedTuple):
    """Two flat arrays, first the field's (`flat.field_in`), then the law's; what a tick leaves there no other reads."""

    reals: F64
    wholes: I64


class Outputs(NamedTuple):
    """Where the law writes what `Law` names alike."""

    task: F64  # (12,)
    torques: F64  # (7, n)
    seen: F64  # (4 K,)
    nearest: I32  # (K,)


@kernel
def outputs(n: int, slots: int) -> Outputs:
    """Return the arrays of n joints and K = `slots` obstacles."""
    return Outputs(np.empty(12), np.empty((7, n)), np.empty(4 * slots), np.empty(slots, np.int32))
