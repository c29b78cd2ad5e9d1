"""What a stop did by the plant's truth, and the bounds it is held to; the controller's belief has no part in it."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rtctl.arm.faults import BRAKES
from rtctl.arm.robot import Robot
from rtctl.types import B1, F64, Drive, State, Truth

# kinds of faults of which a joint without brake falls: its drive gives nothing, or its encoder lies to it
UNDRIVEN = ("drive_fault", "overheat", "watchdog", "corrupt_command", "reboot", "foreign", "bus_off")
FALLS = frozenset((*UNDRIVEN, "stuck_encoder", "dead_encoder", "false_velocity"))
SILENCE = 0xD  # what a drive says that has heard nothing for too long
ASTRAY = 0.05  # [m] of the tip of an arm that goes on, from where it is at that time without the fault
KNOCK = 5e-3  # [s] after the brakes close, in which one that holds a heavy joint throws the lighter ones
FASTER = 0.3  # [rad/s] above the speed at the detection
WAY = {"ideal": 0.05, "slipping": 0.10, "none": math.inf}  # [m] of the tip from the detection on; none: lowered
SOON = 0.7  # [s] in which joints without brakes come to rest
LANDS = 0.6  # [rad] of a joint that falls, after which it may come to its end and shake the others
LOWERED = 0.15  # [m/s] of the tip of an arm that is lowered
FREE = 1.1, 0.03  # times, and [rad] more, than a joint falls by itself


class Run(NamedTuple):
    """What came of a run."""

    brakes: str
    kind: str
    joint: int
    at: float  # [s]
    noticed: float | None  # [s] from the fault until the arm left RUN, None: it did not; then, below, see `astray`
    faster: float = 0.0  # [rad/s] of any joint above its speed then, but for the knock of the brakes
    way: float = 0.0  # [m] of the tip from then on
    beyond: float = 0.0  # [rad] past a joint limit
    contacts: int = 0  # that the run without the fault had not
    held: float = 0.0  # [rad/s] without brakes: of joints that can be held, above their speed at the detection
    sinks: float = 0.0  # [m/s] of the tip where all of them are held
    falls: float = 0.0  # way of one that is not, over what it may fall

    @property
    def broken(self) -> tuple[str, ...]:
        """The bounds that it breaks."""
        way, faster = WAY[self.brakes], FASTER if self.brakes != "none" else math.inf
        if self.noticed is None:
            way, faster = ASTRAY, 0.0
        bounds = (
            ("past a limit", self.beyond, 0.0),
            ("contacts", self.contacts, 0.0),
            ("held", self.held, FASTER),
            ("lowered", self.sinks, LOWERED),
            ("of a free fall", self.falls, 1.0),
            ("faster", self.faster, faster),
            ("way", self.way, way),
        )
        return tuple(f"{name} {value:.3g}" for name, value, bound in bounds if not value <= bound)


class Course:
    """Watches a run: what is true in each period from the fault, and from its detection on."""

    def __init__(self, fault: float) -> None:
        """fault [s]: before it nothing is looked at."""
        self.fault, self.closed, self.tripped = fault, math.inf, math.inf
        self.going: list[Truth] = []  # until the detection
        self.rows: list[Truth] = []
        self.contacts = 0
        self.halted: int | None = None  # number of the period since which a fault holds an arm that may go on by itself

    def __call__(self, servo: Any, truth: Truth, turn: Any) -> None:
        """Take a period into account."""
        self.contacts = truth.contacts
        if truth.time < self.fault:
            return
        copied = truth._replace(**{name: getattr(truth, name).copy() for name in ("q", "qd", "tip")})
        if not self.rows and servo.memory.state == State.RUN:
            self.going.append(copied)
            halted = servo.memory.in_force & BRAKES != 0
            self.halted = len(self.going) - 1 if halted and self.halted is None else self.halted if halted else None
            return
        self.rows.append(copied)
        if turn.command.drive == Drive.DISABLE:
            self.closed = min(self.closed, truth.time)

    def whole(self, drives: Sequence[Any]) -> None:
        """Note, at the end, when the first drive of all tripped of silence: it is no fault of the stop.

        An arm that is held at the end by a fault that clears by itself was noticed when that came.
        """
        if not self.rows and self.halted is not None:
            self.going, self.rows = self.going[: self.halted], self.going[self.halted :]
        for drive in drives:
            for trip in drive.trips:
                if trip.code == SILENCE and self.rows and trip.at * 1e-9 > self.rows[0].time:
                    self.tripped = min(self.tripped, trip.at * 1e-9)

    def contacts_until(self, time: float) -> int:
        """Return the contact events before a time [s]."""
        return max((row.contacts for row in self.rows if row.time <= time), default=0)


def judged(robot: Robot, course: Course, alone: Course | None, fault: tuple[str, int, float], brakes: str) -> Run:
    """Return what came of a run; fault: kind, joint, time [s].

    alone: the course of the same without the fault, wanted where anything was touched or the arm went on.
    """
    kind, joint, at = fault
    if not course.rows:
        if alone is None:
            raise ValueError("an arm that goes on is compared with the run without the fault: got none")
        return astray(robot, course, alone, Run(brakes, kind, joint, at, None))
    t, q, qd, tip = (np.array([getattr(row, name) for row in course.rows]) for name in ("time", "q", "qd", "tip"))
    lost = np.array([brakes == "none" and kind in FALLS and joint in (-1, j) for j in range(robot.n)])
    lands = _lands(robot, q, lost)
    if brakes == "none" and not lost.any():
        lands = max(1, min(lands, int(np.searchsorted(t, course.tripped))))
    knock = (t >= course.closed) & (t < course.closed + KNOCK)
    faster = (np.abs(qd) - np.abs(qd[0])).max(axis=1)[~knock]
    beyond = np.maximum(robot.q_min - q, q - robot.q_max)[:lands, ~lost]
    run = Run(
        brakes,
        kind,
        joint,
        at,
        t[0] - at,
        float(faster.max()),
        float(np.linalg.norm(tip - tip[0], axis=1).max()),
        max(0.0, float(beyond.max())) if beyond.size else 0.0,
        max(0, course.contacts_until(t[lands - 1]) - (alone.contacts if alone is not None else 0)),
    )
    if brakes != "none":
        return run
    t = t - t[0]
    speed = np.linalg.norm(np.diff(tip, axis=0), axis=1) / np.diff(t)
    late = (t[1:] > SOON) & (np.arange(1, len(t)) < lands)
    return run._replace(
        held=_held(t[:lands], qd[:lands, ~lost]),
        sinks=float(speed[late].max()) if not lost.any() and late.any() else 0.0,
        falls=_falls(robot, t[:lands], q[:lands], qd, int(lost.argmax())) if lost.sum() == 1 else 0.0,
    )


def astray(robot: Robot, course: Course, alone: Course, run: Run) -> Run:
    """Return the run of an arm that went on with a fault.

    It is under control, so its joints may be as fast as they may ever be; the tip is where the same arm without the
    fault is at that time.
    """
    rows = min(len(course.going), len(alone.going))
    q, qd, tip = (np.array([getattr(row, name) for row in course.going[:rows]]) for name in ("q", "qd", "tip"))
    tip_alone = np.array([row.tip for row in alone.going[:rows]])
    beyond = np.maximum(robot.q_min - q, q - robot.q_max)
    return run._replace(
        faster=max(0.0, float((np.abs(qd) - robot.qd_max).max())),
        way=float(np.linalg.norm(tip - tip_alone, axis=1).max()),
        beyond=max(0.0, float(beyond.max())),
        contacts=max(0, course.contacts - alone.contacts),
    )


def _lands(robot: Robot, q: F64, lost: B1) -> int:
    """Return the number of rows of q (T, n) until a joint that falls may have come to its end."""
    far = (np.abs(q - q[0]) > LANDS) | (q < robot.q_min) | (q > robot.q_max)
    there = np.flatnonzero(far[:, lost].any(axis=1))
    return max(1, int(there[0])) if len(there) else len(q)


def _held(t: F64, qd: F64) -> float:
    """Return the speed [rad/s] of joints (T, k): above that at the detection, and what is left when they shall rest."""
    if not qd.size:
        return 0.0
    above = float((np.abs(qd) - np.abs(qd[0])).max())
    late = np.abs(qd[t > SOON])
    return max(0.0, above, float(late.max()) if late.size else 0.0)


def _falls(robot: Robot, t: F64, q: F64, qd: F64, joint: int) -> float:
    """Return how far a joint goes over how far it may: by itself while all others are locked, or do what they did."""
    way = np.abs(q[:, joint] - q[0, joint])
    locked = falling(robot, t, np.tile(q[0], (len(t), 1)), np.zeros_like(qd), qd[0, joint], joint)
    carried = falling(robot, t, q, qd, qd[0, joint], joint)
    return float((way / (FREE[0] * np.maximum(locked, carried) + FREE[1])).max())


def falling(robot: Robot, t: F64, q: F64, qd: F64, speed: float, joint: int) -> F64:
    """Return how far (T,) [rad] a joint i falls that nothing drives, from its place in q and a speed [rad/s] on.

    A_ii qdd_i = -(g + h)_i - sum over the other joints of A_ij qdd_j; q, qd (T, n): what those do.
    """
    way, others = np.zeros(len(t)), np.arange(robot.n) != joint
    at, start = q[0, joint], q[0, joint]
    for k in range(1, len(t)):
        dt = t[k] - t[k - 1]
        posture, speeds = q[k - 1].copy(), qd[k - 1].copy()
        posture[joint], speeds[joint] = at, speed
        m = robot.body.evaluate(posture, speeds, robot.points, robot.own)
        follows = m.A[joint, others] @ ((qd[k, others] - qd[k - 1, others]) / dt)
        speed += dt * -(m.g[joint] + m.h[joint] + follows) / m.A[joint, joint]
        at += dt * speed
        way[k] = max(way[k - 1], abs(at - start))
    return way
