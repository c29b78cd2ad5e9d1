"""What goes in and out of a tick of the base: values of the link, ENU and SI. NED ends in the link."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from rtctl.rover.robot import SECTORS
from rtctl.types import F64


class Ask(IntEnum):
    """What a command asks of the autopilot."""

    SILENCE = 0  # heartbeats alone: nothing is ours to command
    ENGAGE = 1  # zero set-points, our mode, arming
    DRIVE = 2  # set-points
    HOLD = 3  # zero set-points, then the autopilot's own hold mode
    DISARM = 4  # no set-points; disarm


class Word(IntEnum):
    """The autopilot's last word on what was asked; negative: none yet, or none in time."""

    NO_ANSWER = -2
    PENDING = -1
    ACCEPTED = 0
    BUSY = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class BaseFeedback(NamedTuple):
    """What the link knows of the vehicle at one slot; the last good value where nothing came."""

    slot: int
    missed: int
    position: F64  # (2,) [m] east, north of the autopilot's origin
    velocity: F64  # (2,) [m/s] east, north
    yaw: float  # [rad] counter-clockwise from east
    yaw_rate: float  # [rad/s]
    position_age: float  # [s] of the newest position at this slot
    attitude_age: float  # [s]
    fresh: int  # positions that came in this cycle
    reset: int  # the estimator's reset counter, where the autopilot has one
    scan: F64  # (SECTORS,) [m] infinite: nothing there; negative: unknown
    scan_start: float  # [rad] of sector 0 in the body's frame, counter-clockwise
    scan_step: float  # [rad] to the next sector; negative: clockwise
    scan_reach: float  # [m] that infinite stands for
    scan_age: float  # [s]
    scans: int  # 1: a scan came in this cycle, of the sensor `sensor`
    sensor: int  # that the scan is of, by its place in the config
    scan_offset: F64  # (2,) [m] of that sensor, ahead and to the left of the origin
    scan_wrong: bool  # a sensor's frame contradicts the vehicle's motion
    known_age: float  # [s] of the newest scan or beam that knew anything
    beams: F64  # (8,) [m] of single sensors at 45 deg steps clockwise from front; negative: unknown or stale
    beam_reach: float  # [m] that infinite stands for
    heartbeat_age: float  # [s]
    uplink_age: float  # [s] since we sent the newest thing that the vehicle has answered
    fix_lost: bool  # its GPS had a fix and has none
    quality: float  # [0, 1] of its estimator, by its own variances; 1 calm
    ours: bool  # the mode is the one we command in
    mode: int  # custom_mode as it came
    armed: bool
    reboots: int  # since the start, by time_boot_ms
    healthy: bool  # the autopilot's own estimator says its position can be used
    word: int  # Word
    lost: int  # messages missing in this cycle, by their sequence
    refused: int  # frames dropped in this cycle: unsigned, forged, replayed, unknown, of others
    link: int  # types.Link
    lateness: float  # [s] of the previous wake-up; logged, never used by the law
    compute: float  # [s] of the previous tick; logged, never used by the law


class BaseCommand(NamedTuple):
    """What goes to the autopilot."""

    ask: Ask
    v: float  # [m/s] forward
    w: float  # [rad/s] counter-clockwise
    velocity: F64  # (2,) [m/s] east, north


def at_rest(position: F64, yaw: float) -> BaseFeedback:
    """Return the feedback of a vehicle that rests, all of it fresh: where a handshake leaves it."""
    return BaseFeedback(
        slot=-1,
        missed=0,
        position=np.asarray(position, np.float64),
        velocity=np.zeros(2),
        yaw=yaw,
        yaw_rate=0.0,
        position_age=0.0,
        attitude_age=0.0,
        fresh=0,
        reset=0,
        scan=np.full(SECTORS, -1.0),
        scan_start=0.0,
        scan_step=-2.0 * np.pi / SECTORS,
        scan_reach=0.0,
        scan_age=np.inf,
        scans=0,
        sensor=0,
        scan_offset=np.zeros(2),
        scan_wrong=False,
        known_age=np.inf,
        beams=np.full(8, -1.0),
        beam_reach=0.0,
        heartbeat_age=0.0,
        uplink_age=0.0,
        fix_lost=False,
        quality=1.0,
        ours=False,
        mode=0,
        armed=False,
        reboots=0,
        healthy=True,
        word=int(Word.PENDING),
        lost=0,
        refused=0,
        link=0,
        lateness=0.0,
        compute=0.0,
    )
