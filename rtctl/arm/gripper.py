"""A gripper on the arm's bus: it goes to an opening at a bounded speed and presses with a bounded force.

Its drive closes an impedance about a reference p (Hogan 1985), tau = kp (p - q) + kd (v - qd), on its own encoder. p
goes to its target at `speed`, and never further from the finger than tau_max / kp: what is in the way gets tau_max
and no more. A force between the jaws stands for a torque by virtual work, F dx = tau dq: F = tau / lever.

It is asked with the arm's drives: disabled with them, and held where it is from the moment they are enabled. In every
stop that does not disable the drives it keeps what it holds.
"""

from typing import Final, NamedTuple

import numpy as np

from rtctl.types import F64, Command, Drive, Grip

Q, QD, TAU, AGE, STATUS = range(5)  # rows of Feedback.grippers
TARGET, TORQUE, P, STILL, ASKED = range(5)  # rows of Memory.grippers: [rad]; [Nm]; [rad]; [s] at rest; 1 or 0
SEEN = 5  # the rows from here on: what was seen last
NEVER: Final = 1e3  # [s] age of what was never heard
ENABLED: Final = 1  # drive status
LATE: Final = 0.1  # [s] without a reply, after which it is silent
NEAR: Final = 0.02  # of its way: there
SLOW: Final = 0.02  # of its way a second: at rest
REST: Final = 0.2  # [s] at rest short of its target: it holds something
DRIVEN = (Drive.TORQUE, Drive.HOLD)


class Gripper(NamedTuple):
    """A gripper, as its file describes it."""

    name: str
    open: float  # [rad] of its drive
    closed: float  # [rad]
    lever: float  # [m/rad] by which its opening changes with its drive's angle
    torque: float  # [Nm] at most
    speed: float  # [rad/s]
    kp: float  # [Nm/rad]
    kd: float  # [Nms/rad]

    def angle(self, closed: float) -> float:
        """Return the drive's angle [rad] at a share from 0, open, to 1, closed."""
        return self.open + closed * (self.closed - self.open)

    def share(self, angle: float) -> float:
        """Return how far it is closed, 0 to 1, at a drive's angle [rad]."""
        return (angle - self.open) / (self.closed - self.open)


def unasked(count: int) -> F64:
    """Return what grippers remember before anybody asked them for anything, (10, count)."""
    return np.zeros((SEEN + 5, count))


def silent(count: int) -> F64:
    """Return what is seen of grippers that have never been heard, (5, count)."""
    seen: F64 = np.zeros((5, count))
    seen[AGE] = NEVER
    return seen


def refused(grippers: tuple[Gripper, ...], asked: Grip, driven: bool) -> str:
    """Return why a request cannot be followed, '' where it can."""
    if not grippers:
        return "grip: this robot has no gripper; [[gripper]] describes one"
    if asked.name and asked.name not in [g.name for g in grippers]:
        return f"grip: got {asked.name}, wanted one of {', '.join(g.name for g in grippers)}"
    if not driven:
        return "grip: got it while the drives are off, wanted an arm that is armed"
    for g in grippers:
        if asked.name in ("", g.name) and asked.force > g.torque / g.lever * (1.0 + 1e-9):
            return f"grip: {g.name}: got {asked.force:g} N, wanted at most {g.torque / g.lever:.4g}"
    return ""


def gripped(
    grippers: tuple[Gripper, ...], memory: F64, seen: F64, asked: Grip | None, command: Command, dt: float
) -> tuple[F64, Command]:
    """Return what grippers remember (10, g), and the command with theirs in it, a slot of dt [s] later.

    memory: (10, g), see TARGET. seen: (5, g), see Q. asked: a request that is not refused.
    """
    m, out = np.vstack((memory[:SEEN], seen)), np.zeros((5, len(grippers)))
    driven = command.drive in DRIVEN
    for k, g in enumerate(grippers):
        q = float(seen[Q, k])
        if not driven:
            m[:SEEN, k] = q, g.torque, q, 0.0, 0.0
            continue
        if asked is not None and asked.name in ("", g.name):
            m[TARGET, k], m[STILL, k], m[ASKED, k] = g.angle(asked.closed), 0.0, 1.0
            m[TORQUE, k] = asked.force * g.lever if asked.force > 0.0 else g.torque
        before = float(m[P, k])
        p = before + min(max(float(m[TARGET, k]) - before, -g.speed * dt), g.speed * dt)
        away = m[TORQUE, k] / g.kp
        held = min(max(p, q - away), q + away)
        m[P, k] = held
        still = abs(seen[QD, k]) < SLOW * abs(g.closed - g.open)
        m[STILL, k] = m[STILL, k] + dt if still else 0.0
        out[:, k] = held, 0.0, g.kp, g.kd, 0.0
    return m, command._replace(grippers=out)


def state_of(gripper: Gripper, memory: F64) -> str:
    """Return in a word how a gripper is; memory (10,)."""
    seen = memory[SEEN:]
    if seen[AGE] > LATE:
        return "silent"
    if seen[STATUS] > ENABLED:
        return "fault"
    if seen[STATUS] != ENABLED:
        return "off"
    if not memory[ASKED]:
        return "holding"
    if abs(gripper.share(float(seen[Q])) - gripper.share(float(memory[TARGET]))) < NEAR:
        return "there"
    return "gripping" if memory[STILL] > REST else "moving"
