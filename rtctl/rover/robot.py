"""The base as the tick sees it: constants alone, SI, derived from one config file by `spec.base`."""

from enum import IntEnum
from typing import NamedTuple

from rtctl.control.firas import FieldParams
from rtctl.types import F64, Shape
from rtctl.world.meshes import Meshes

SECTORS = 72  # of a scan at most


class Wheels(IntEnum):
    """What the wheels can do."""

    HOLONOMIC = 0  # any direction at once
    SKID = 1  # turns on the spot
    ACKERMANN = 2  # turns on circles


class Limits(NamedTuple):
    """What the base may do."""

    v_max: float  # [m/s]
    a_max: float  # [m/s2]
    w_max: float  # [rad/s]
    alpha_max: float  # [rad/s2]
    radius: float  # [m] smallest of a turn; 0: on the spot
    reverse: bool


class Margins(NamedTuple):
    """Distances of the avoidance, from the footprint's circle."""

    hull: float  # [m] radius of the circle about the origin that holds the footprint
    room: float  # [m] free distance of a cell's centre that a way keeps to
    aside: float  # [m] the same of every point of an outline that is no circle
    stop: float  # [m] the speed governor brings the base to rest at this distance
    brake: float  # [m/s2] it relies on
    lag: float  # [s] from a set-point to the speed it asks for; the state is predicted by it
    turn_lag: float  # [s] the same of the yaw rate
    height: float  # [m] where known obstacles, which are solids, are cut


class SafetyParams(NamedTuple):
    """Bounds of the detectors."""

    heartbeat_hold: float  # [s] SS2 beyond it
    heartbeat_stop: float  # [s] SS1 beyond it
    position_hold: float  # [s] age of position or attitude: SS2
    position_stop: float  # [s] SS1
    scan_stale: float  # [s] SS2; the scan's own age
    scan: bool  # a scan is required
    feed_timeout: float  # [s] of a moving obstacle's observation
    jump: float  # [m] beyond what speed explains, a position jumped
    seen: float  # [s] for which a place that was seen free counts as free


class Noise(NamedTuple):
    """Standard deviations of the estimator."""

    acceleration: float  # [m/s2] not commanded
    position: float  # [m] of a reported position
    velocity: float  # [m/s] of a reported velocity


class Base(NamedTuple):
    """Everything `tick` may know of the base that does not change."""

    name: str
    wheels: Wheels
    world_velocity: bool  # the autopilot takes a velocity in the world, not a speed and a yaw rate
    slots: int  # obstacle slots K
    dt: float  # [s] servo period
    plan_dt: float  # [s] period in which the way is looked for anew, >= dt
    k_p: float  # [1/s2]
    k_v: float  # [1/s]
    ahead: float  # [m] control point ahead of the axle
    limits: Limits
    margins: Margins
    points: F64  # (m, 2) [m] PSPs of the footprint in the body's frame
    point_radius: F64  # (m,) [m]
    cover: F64  # (n, 2) [m] points all over an outline steered as it is; none: as the circle about it
    field: FieldParams
    noise: Noise
    safety: SafetyParams
    obstacles: tuple[Shape, ...]  # of the config, always there
    meshes: Meshes  # that obstacles may refer to
    reach: float  # [m] no goal further from where the autopilot's frame begins is taken
    tolerance: float  # [m] of a goal that gives none
    tolerance_rot: float  # [rad] of its heading
    stall: float  # [s] without progress short of the goal before it is diagnosed
    engage: float  # [s] for mode and arming, then the request is given up
    sense: float  # [m] that a scan is believed up to
    sensors: tuple[str, ...]  # range sensors by name
