"""The virtual rover: autopilot, vehicle, range sensor and world, in lockstep with whoever calls `exchange`.

A call of `exchange` is one period: the packets are heard in their order, then autopilot and vehicle move on, and what
they say is returned. Faults by name and time, as on the arm.
"""

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_sim import plane
from firmware_sim.autopilot import MANUAL, PX4_MANUAL, Autopilot
from firmware_sim.inject import FOREVER, Fault, fault_at
from firmware_sim.lidar import BODY, COMPONENT, GLOBAL, Lidar
from firmware_sim.mav import Endpoint, frames, key_of
from firmware_sim.settings import SettingsError
from firmware_sim.vehicle import Traits, Vehicle

F64 = NDArray[np.float64]
NS = 1_000_000_000
BIAS = 0.1  # [m/s] of the speed that a healthy estimator reports
COLD = 60.0  # [s] until a cold estimator has a position
OUTLINE = 0.05  # [m] between the points that clearance is measured from
KINDS = {
    "rc_mode": "a person takes the stick: manual mode",
    "reboot": "the autopilot starts anew",
    "ekf_reset": "its position jumps by 3 m",
    "ekf_bad": "its estimator loses the position",
    "mute": "its heartbeats stop",
    "silent": "nothing of it arrives any more",
    "deaf": "nothing reaches it any more",
    "blind": "the range sensor stops",
    "disarm": "somebody disarms it",
    "refuse_arming": "its pre-arm checks fail",
    "scan_unknown": "every sector of the range sensor is sent as unknown",
    "scan_blind": "the sectors from from_deg to to_deg, clockwise from the front, are sent as unknown",
    "scan_zero": "spurious zeros come among the sectors from from_deg to to_deg",
    "scan_frame": "numbers and `frame` of the scan disagree: 0 (body under north), 1 (north under body), 2 (mirrored)",
    "scan_component": "the sensor goes on as component `value`",
    "speed_bias": "the reported speed is off by `value` [m/s]",
    "position_drift": "the reported position walks away at `value` [m/s]",
    "position_frozen": "no position is sent",
    "weak_yaw": "the ground gives `value` of the yaw rate",
    "weak_drive": "the ground gives `value` of the speed",
    "gps_loss": "the GPS has no fix: 8 s of dead reckoning that nobody tells of",
    "cold_start": "no position until `duration` [s] (60) after power-up",
    "rates_denied": "no stream may be asked for; some come at 4 Hz",
    "home_relative": "firmware 4.0: the local position is relative to home, which moves while disarmed",
}
SIZES = {  # of kinds that have one, where none is given
    "scan_frame": 0.0,
    "scan_component": 196.0,
    "speed_bias": 0.2,
    "position_drift": 0.05,
    "weak_yaw": 0.16,
    "weak_drive": 0.2,
}


class Truth(NamedTuple):
    """The simulator's own account after a period."""

    time: float  # [s] of the scenario
    x: float  # [m] east
    y: float  # [m] north
    yaw: float  # [rad]
    v: float  # [m/s]
    w: float  # [rad/s]
    clearance: dict[str, float]  # obstacle -> distance of the outline [m]
    contacts: int


class Rover:
    """A rover on a plane among solids."""

    def __init__(
        self,
        config: dict[str, Any],
        folder: Path,
        pose: Sequence[float] = (0.0, 0.0, 0.0),
        obstacles: Sequence[dict[str, Any]] = (),
        faults: Sequence[Fault] = (),
        wait: bool = False,
        seed: int = 0,
    ) -> None:
        """`wait`: the scenario's clock stands at 0 until the vehicle is armed; `seed` of its sensors' errors."""
        base, link, motion = config["base"], config["link"], config["motion"]
        self.period = 1.0 / float(config["loop"]["servo_hz"])
        self.url = str(link["url"])
        traits = Traits(
            base["wheels"],
            1.05 * motion["v_max_m_s"],
            1.05 * motion["w_max_rad_s"],
            2.0,
            radius=float(base.get("turn_radius_m", 0.0)),
        )
        self.vehicle = Vehicle(traits, *map(float, pose))
        system, key = int(link.get("vehicle_id") or 1), key_of(link, folder)
        gcs = int(link.get("system_id", 245))
        self.autopilot = Autopilot(link["autopilot"], self.vehicle, Endpoint(system, 1, key), gcs, seed)
        self.lidar = Lidar(Endpoint(system, COMPONENT, key), seed)
        self.outline, self.radius = _outline(base)
        self.tables = [*config.get("obstacle", ()), *obstacles]
        still = [
            not (t.get("waypoints") or any(t.get("velocity_m_s", ())) or "appears_s" in t or "vanishes_s" in t)
            for t in self.tables
        ]
        self._still = plane.solids_at([t for t, rests in zip(self.tables, still, strict=True) if rests], 0.0)
        self._moving = [t for t, rests in zip(self.tables, still, strict=True) if not rests]
        plane.solids_at(self._moving, 0.0)  # complains now, not later
        self.faults, self.done = list(faults), set[int]()
        self.started = not wait
        self.time = 0.0  # [s] of the scenario
        self.contacts = 0
        self._touching: set[str] = set()
        self._truth: Truth | None = None

    def exchange(self, packets: list[bytes]) -> list[bytes]:
        """Hear the packets of one period, let it pass, return what the vehicle says."""
        self.hear(packets)
        return self.advance()

    def hear(self, packets: Sequence[bytes]) -> None:
        """Take packets in their order."""
        if self._active("deaf"):
            return
        for packet in packets:
            for raw in frames(packet):
                message = self.autopilot.end.unpack(raw)
                if message is not None:
                    self.autopilot.hear(message)

    def advance(self) -> list[bytes]:
        """Let one period pass."""
        pilot = self.autopilot
        self.started = self.started or pilot.armed
        if self.started:
            self.time += self.period
        self._inject()
        said = pilot.step(self.period)
        v = self.vehicle
        seen = self.lidar.step(pilot.time, pilot.epoch, (v.x, v.y, v.yaw), self.solids())
        self._truth = None
        self.truth()
        return said if pilot.silent else said + seen

    def solids(self) -> list[plane.Solid]:
        """Return what stands in the world now."""
        return [*self._still, *plane.solids_at(self._moving, self.time)]

    def _active(self, kind: str) -> bool:
        return bool(self._present(kind))

    def _present(self, kind: str) -> list[Fault]:
        now = round(self.time * NS)
        return [f for f in self.faults if f.kind == kind and f.start <= now < f.end]

    def _size(self, kind: str, without: float) -> float:
        """Return how much of a fault there is now."""
        found = self._present(kind)
        if not found:
            return without
        return SIZES[kind] if math.isnan(found[-1].value) else found[-1].value

    def _inject(self) -> None:
        pilot, lidar, now = self.autopilot, self.lidar, round(self.time * NS)
        pilot.mute, pilot.silent = self._active("mute"), self._active("silent")
        pilot.estimator_bad, pilot.arming_refused = self._active("ekf_bad"), self._active("refuse_arming")
        pilot.proximity_dead = lidar.blind = self._active("blind")
        pilot.frozen, pilot.rates_denied = self._active("position_frozen"), self._active("rates_denied")
        pilot.home_relative = self._active("home_relative")
        pilot.bias, pilot.drift = self._size("speed_bias", BIAS), self._size("position_drift", 0.0)
        self.vehicle.turn_grip, self.vehicle.grip = self._size("weak_yaw", 1.0), self._size("weak_drive", 1.0)
        lidar.unknown = self._active("scan_unknown")
        lidar.hidden = [(f.low, f.high) for f in self._present("scan_blind")]
        lidar.zeroes = [(f.low, f.high) for f in self._present("scan_zero")]
        lidar.end.codec.srcComponent = round(self._size("scan_component", COMPONENT))
        wrong = self._size("scan_frame", -1.0)
        lidar.frame, lidar.turned, lidar.mirrored = GLOBAL if wrong == 0.0 else BODY, wrong == 1.0, wrong == 2.0
        lost = self._active("gps_loss")
        if lost != (pilot.gps_lost_at is not None):
            pilot.gps_lost_at = pilot.time if lost else None
            pilot.offset = pilot.offset if lost else (0.0, 0.0)
        for k, fault in enumerate(self.faults):
            if k in self.done or not fault.start <= now:
                continue
            self.done.add(k)
            if fault.kind == "cold_start":
                pilot.cold = COLD if fault.end >= FOREVER else (fault.end - fault.start) / NS
            if fault.kind == "rc_mode":
                pilot.stick = (0.4, 0.3)
                pilot._switch(MANUAL if pilot.kind == "ardupilot" else PX4_MANUAL)
            elif fault.kind == "reboot":
                pilot.boot()
            elif fault.kind == "ekf_reset":
                pilot.offset = (pilot.offset[0] + 3.0, pilot.offset[1])
                pilot.resets += 1
            elif fault.kind == "disarm":
                pilot.armed, pilot.heartbeat_due = False, pilot.time

    def _placed(self) -> F64:
        c, s = math.cos(self.vehicle.yaw), math.sin(self.vehicle.yaw)
        turned: F64 = self.outline @ np.array([[c, s], [-s, c]]) + (self.vehicle.x, self.vehicle.y)
        return turned

    def _clearances(self) -> dict[str, float]:
        outline = self._placed()
        return {s.name: plane.clearance(s, outline, self.radius) for s in self.solids()}

    def truth(self) -> Truth:
        """Return where the vehicle really is and what it is near to."""
        if self._truth is None:
            v, clearance = self.vehicle, self._clearances()
            touching = {name for name, d in clearance.items() if d <= 0.0}
            self.contacts += len(touching - self._touching)
            self._touching = touching
            self._truth = Truth(self.time, v.x, v.y, v.yaw, v.v, v.w, clearance, self.contacts)
        return self._truth

    def close(self) -> None:
        """Nothing to free."""


def _outline(base: dict[str, Any]) -> tuple[F64, float]:
    """Return points (m, 2) [m] and the radius of circles around them that together are the footprint."""
    if "radius_m" in base:
        return np.zeros((1, 2)), float(base["radius_m"])
    corners = np.array(base["footprint_m"], dtype=np.float64)
    points = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n = max(1, math.ceil(float(np.hypot(*(b - a))) / OUTLINE))
        points += [a + (b - a) * k / n for k in range(n)]
    return np.array(points), 0.0


def parsed(text: str) -> Fault:
    """Return the fault of `kind@seconds[:duration[:from:to]]` or `kind@seconds:duration:value`; ValueError."""
    kind, _, rest = text.partition("@")
    at, *numbers = rest.split(":")
    duration, *more = [float(number or 0.0) for number in numbers] or [0.0]
    angles = (more[0], more[1]) if len(more) == 2 else (-180.0, 180.0)
    return fault_at(kind, float(at), duration or None, KINDS, angles, more[0] if len(more) == 1 else math.nan)


def is_rover(config_path: str | Path) -> bool:
    """Tell whether a robot file describes a base."""
    try:
        with Path(config_path).open("rb") as file:
            return dict(tomllib.load(file).get("robot", {})).get("kind") == "base"
    except (OSError, ValueError, TypeError):
        return False


def open_rover(
    config_path: str | Path,
    scenario: dict[str, Any] | None = None,
    inject: Sequence[str] = (),
    wait: bool = False,
    seed: int = 0,
) -> Rover:
    """Open a virtual rover: the file's vehicle, a scenario's obstacles, faults and start. Raises SettingsError."""
    path, play = Path(config_path), scenario or {}
    try:
        with path.open("rb") as file:
            config = tomllib.load(file)
        faults = [
            fault_at(
                t["kind"],
                float(t["at_s"]),
                t.get("duration_s"),
                KINDS,
                (float(t.get("from_deg", -180.0)), float(t.get("to_deg", 180.0))),
                float(t.get("value", math.nan)),
            )
            for t in play.get("fault", ())
        ]
        faults += [parsed(text) for text in inject]
        start = play.get("start_pose") or (0.0, 0.0, 0.0)
        return Rover(config, path.parent, start, play.get("obstacle", ()), faults, wait, seed)
    except KeyError as error:
        raise SettingsError(f"{path}: {error.args[0]} is missing") from error
    except (OSError, TypeError, ValueError) as error:
        raise SettingsError(f"{path}: {error}") from error
