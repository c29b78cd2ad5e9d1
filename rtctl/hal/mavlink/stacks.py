"""How autopilots want to be spoken to: modes, streams, set-points, and what a link must know of its vehicle."""

import math
from typing import NamedTuple

from rtctl.hal.mavlink.ranging import SensorSpec

PRESTREAM = 1.3  # [s] of set-points before PX4 may be asked for OFFBOARD: it wants more than one
AUTOPILOT1 = 1  # component id of an autopilot
ROVERS = (10, 11)  # MAV_TYPE: ground rover, surface boat


class Stack(NamedTuple):
    """How one autopilot wants to be spoken to."""

    autopilot: int  # MAV_AUTOPILOT
    ours: int  # custom_mode in which it takes our set-points
    enter: tuple[float, float]  # its main and sub mode, for DO_SET_MODE
    hold: tuple[float, float]
    world: bool  # takes a world velocity
    prestream: float  # [s] of set-points before the mode
    parameters: tuple[str, ...]  # reported at connect: what may fight or stop us


STACKS = {
    "ardupilot": Stack(
        3,
        15,
        (15.0, 0.0),
        (4.0, 0.0),
        False,
        0.0,
        ("AVOID_ENABLE", "OA_TYPE", "PRX1_TYPE", "FS_GCS_ENABLE", "MAV_GCS_SYSID", "SYSID_MYGCS"),
    ),
    "px4": Stack(12, 6 << 16, (6.0, 0.0), (4.0, 3.0), True, PRESTREAM, ("COM_OF_LOSS_T", "COM_OBL_RC_ACT")),
}
STREAMS = {  # name -> (message id, Hz)
    "LOCAL_POSITION_NED": (32, 50.0), "ATTITUDE": (30, 50.0), "ODOMETRY": (331, 50.0), "OBSTACLE_DISTANCE": (330, 10.0),
    "DISTANCE_SENSOR": (132, 10.0), "EKF_STATUS_REPORT": (193, 10.0), "ESTIMATOR_STATUS": (230, 10.0),
    "GPS_RAW_INT": (24, 5.0), "GLOBAL_POSITION_INT": (33, 2.0), "HOME_POSITION": (242, 1.0),
}  # fmt: skip
ONLY = {  # left out
    "ardupilot": ("ODOMETRY", "ESTIMATOR_STATUS", "OBSTACLE_DISTANCE"),
    "px4": ("EKF_STATUS_REPORT", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "HOME_POSITION"),
}


class MavSpec(NamedTuple):
    """What the link needs to know."""

    place: str  # named in refusals
    autopilot: str
    system: int
    component: int
    vehicle: int | None
    period: float  # [s]
    timeout: float  # [s] that the handshake waits for what is not there yet; infinite: for ever
    scan: bool  # a scan is required
    sensors: tuple[SensorSpec, ...]
    quick: float = math.inf  # [Hz] of position and attitude, where the line bears no more
    every: int = 1  # period in which a set-point goes out
