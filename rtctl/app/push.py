"""One drive of an arm driven by a small torque, all others disabled: which way does its joint go."""

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import numpy as np

from rtctl.errors import LinkError
from rtctl.hal.can.link import CanLink
from rtctl.protocol import e2e, mit
from rtctl.protocol.mounting import Mounting
from rtctl.types import F64

MOVED = 0.02  # [rad] that is enough to tell a direction: 50 steps of a drive's reading
SPEED = 0.5  # [rad/s] at which the drive's own damping takes the whole torque; and beyond which the push ends
TAKE_S = 0.05  # from nothing to gravity's torque: sooner than a brake opens
HOLD_S = 0.3  # gravity's torque alone, while a brake opens
RAMP_S = 2.0  # from nothing to the whole torque
BRAKE_S = 0.2  # damped, before the drive is disabled
ENABLE_TRIES = 100  # cycles until a drive must have said that it is enabled
WAIT_S = 0.05  # for replies
STOPS = 10  # stop frames at the end, so that one surely comes
LOST = 20  # cycles without a reply of a joint: it is not there


class Push(Enum):
    """How a push ended."""

    RIGHT = 0
    WRONG = 1
    STUCK = 2  # not moved by the whole torque
    FELL = 3  # moved by gravity's torque alone
    SILENT = 4  # the drive did not stay enabled


class Pushed(NamedTuple):
    """How it ended, for people."""

    verdict: Push
    moved: float  # [rad] of the joint
    told: str

    @property
    def contradicts(self) -> bool:
        """True if torque and reading of the drive contradict each other."""
        return self.verdict == Push.WRONG


class Bench:
    """The drives of an arm, in their own coordinates; owns nothing but the count of cycles."""

    share = 0.1  # of a joint's largest torque, beside gravity's

    def __init__(self, link: CanLink, period: float, pause: Callable[[], None]) -> None:
        """link: greeted, of a spec without mountings; period [s] of its cycles, for which `pause` waits."""
        self.link, self.period, self.pause = link, period, pause
        self.slot, self.silent = 0, 0

    def readings(self) -> F64:
        """Return what each drive reads (n,) [rad], all of them disabled."""
        for _ in range(2):  # the first reply is of the state before
            q, _, _ = self._cycle(-1, mit.DISABLE)
        return q.copy()

    def off(self) -> None:
        """Send stop frames and expect nothing."""
        for _ in range(STOPS):
            self.link.transport.send_all([self.link.encode(j, mit.DISABLE) for j in range(len(self.link.spec.joints))])

    def push(self, joint: int, mounting: Mounting, gravity: float, most: float) -> Pushed:
        """Drive a joint by gravity's torque and slowly more, up to `most` [Nm], until it has moved; then brake it."""
        start = float(self.readings()[joint])
        fault = self._enable(joint)
        if fault:
            return Pushed(Push.SILENT, 0.0, fault)
        d, scale = mounting.direction, self.link.spec.joints[joint].scale
        kd = min(most / SPEED, mit.KD_MAX)
        hold, ramp = round(HOLD_S / self.period), round(RAMP_S / self.period)
        moved, more, err, k = 0.0, 0.0, mit.ENABLED, 0
        for k in range(hold + ramp + 1):
            more = most * max(k - hold, 0) / ramp
            share = min(1.0, k * self.period / TAKE_S)
            q, qd, err = self._cycle(
                joint, mit.encode_command(0.0, 0.0, 0.0, kd, d * (share * gravity + more), scale), torque=True
            )
            moved = d * (q[joint] - start)
            if abs(moved) >= MOVED or abs(qd[joint]) > SPEED or err != mit.ENABLED:
                break
        for _ in range(round(BRAKE_S / self.period)):
            self._cycle(joint, mit.encode_command(0.0, 0.0, 0.0, kd, d * gravity, scale), torque=True)
        self.readings()
        return _judged(float(moved), more, k <= hold, err)

    def _enable(self, joint: int) -> str:
        """Enable one drive; return why that did not work, '' if it did."""
        err = mit.DISABLED
        for _ in range(ENABLE_TRIES):
            err = self._cycle(joint, mit.ENABLE)[2]
            if err == mit.ENABLED:
                return ""
            if err != mit.DISABLED:
                self._cycle(joint, mit.CLEAR)
        return f"its drive says {mit.STATUS.get(err, hex(err))} and cannot be enabled"

    def _cycle(self, joint: int, payload: bytes, torque: bool = False) -> tuple[F64, F64, int]:
        """Send a payload to one joint and stop frames to all others; return positions, speeds and its drive's status.

        Raises LinkError for a drive that is silent.
        """
        link, wanted = self.link, e2e.Wanted.TORQUE if torque else e2e.Wanted.NONE
        n = len(link.spec.joints)
        frames = [link.encode(j, payload, wanted) if j == joint else link.encode(j, mit.DISABLE) for j in range(n)]
        self.slot += 1
        link.transport.send_all(frames)
        link.wait_replies(WAIT_S)
        feedback = link.read(self.slot, 0, 0.0, 0.0)
        self.pause()
        self.silent = 0 if bool((feedback.replies > 0).all()) else self.silent + 1
        if self.silent > LOST:
            absent = link.spec.joints[int(np.argmin(feedback.replies))]
            raise LinkError(f"{link.spec.place}: joint {absent.name} (id {absent.can_id}) has fallen silent")
        return feedback.q, feedback.qd, int(feedback.drive[joint])


def _judged(moved: float, more: float, early: bool, err: int) -> Pushed:
    if err != mit.ENABLED:
        told = f"its drive said {mit.STATUS.get(err, hex(err))} meanwhile: not judged"
        return Pushed(Push.SILENT, moved, told)
    if early:
        told = (
            f"moved by {moved:+.3f} rad under gravity's torque alone: is there a payload, or does its torque "
            "contradict its reading?"
        )
        return Pushed(Push.FELL, moved, told)
    if abs(moved) < 0.5 * MOVED:
        return Pushed(Push.STUCK, moved, f"did not move under {more:.3g} Nm: a brake, a stand, or much friction")
    if moved > 0.0:
        return Pushed(Push.RIGHT, moved, f"moved by {moved:+.3f} rad under {more:.3g} Nm: right")
    told = f"moved by {moved:+.3f} rad under {more:.3g} Nm: its torque contradicts its reading"
    return Pushed(Push.WRONG, moved, told)
