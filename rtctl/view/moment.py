"""What a page shows of one moment: numbers of a record, and the words that people read. Knows nothing of a browser."""

import json
import tomllib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtctl.control.faults import Fault
from rtctl.log.header import SCENE_FILE, Header
from rtctl.log.read.fields import called
from rtctl.log.record.surroundings import BOUND
from rtctl.plain import Json
from rtctl.types import F64, RecordRow, State, Status

FORCE_SEEN = 2.0  # [N] smaller forces are not drawn
OLD = 0.5  # [s] an older scan is not drawn
NEAR = 1e3  # [m] beyond it a distance is none

STATES = {
    "BOOT": "Starting.",
    "PREFLIGHT": "Checking the drives.",
    "IDLE": "Drives are off. Arm to move.",
    "ARMED": "Drives are being enabled. The robot holds.",
    "RUN": "Drives are on.",
    "STOPPING": "Braking to rest.",
    "SAFE_STOP": "Stopped by a fault. Find the cause, then reset.",
    "FAULT": "Torque is off. Find the cause, then reset.",
}
STATUSES = {
    "no_goal": "No goal: it holds where it is.",
    "moving": "Moving to the goal.",
    "arrived": "At the goal.",
    "shadowed": "The goal is too near an obstacle.",
    "local_minimum": "Obstacles block the way: their forces cancel the goal's.",
    "saturated": "A joint has no more torque.",
    "singular": "The arm cannot move in that direction from here.",
    "limited": "A joint is at its limit.",
    "unreachable": "The goal is out of reach.",
    "escaping": "Going round what blocks the way.",
    "floating": "A hand may move the arm.",
    "blind": "It waits: the way has not been seen.",
}


class Moment(NamedTuple):
    """One moment of an arm or a base."""

    time: float  # [s] of the robot
    state: str
    status: str
    says: str  # what that means
    faults: tuple[tuple[str, str], ...]  # name and meaning
    place: F64  # (3,) [m] of tip or base
    heading: float  # [rad] of a base
    goal: F64 | None  # (3,) [m]
    error: float  # [m]
    speed: float  # [m/s]
    clearances: tuple[tuple[str, float], ...]  # [m] by the name of an obstacle, the nearest first
    torques: tuple[tuple[str, float], ...]  # share of the rated torque by joint
    forces: tuple[tuple[int, F64, int], ...]  # obstacle slot, force (3,) [N], index of the protected point
    way: F64  # (k, 3) [m] what lies ahead
    scan: F64  # (k, 3) [m] what a base's sensor sees
    q: F64  # (n,) [rad or m]


class Reader:
    """Makes moments of a header's records."""

    def __init__(self, header: Header) -> None:
        self.header, self.is_base = header, header.extra.get("kind") == "base"
        self.faults = faults_of(header)
        about = scene_of(header)
        self.points = [p for p in about.get("points", ()) if isinstance(p, list)]
        self.base: Json = about["base"] if isinstance(about.get("base"), dict) else {}
        config = config_of(header)
        avoid, motion = config.get("avoid", {}), config.get("motion", {})
        self.influence = float(avoid.get("influence_m", 0.1))
        self.clearance = float(avoid.get("clearance_m", 0.0))
        self.v_max = float(motion.get("v_max_m_s", 1.0))
        joints = config.get("robot", {}).get("joints", ())
        self.tau = np.array([float(j.get("tau_max_Nm", np.inf)) for j in joints]) if not self.is_base else np.zeros(0)

    def is_sound(self, record: RecordRow) -> bool:
        """Return whether a record's numbers can be drawn: a log takes whatever bits a tick had."""
        fields = ("time", "x", "goal") if self.is_base else ("time", "q", "x", "goal")
        return all(bool((np.abs(record[name]) < BOUND).all()) for name in fields)

    def moment(self, record: RecordRow, names: Sequence[str]) -> Moment:
        """Return what a sound record says; names: of the obstacles by slot."""
        state, status = called(State, int(record["state"])), called(Status, int(record["status"])).lower()
        bits = int(record["faults"])
        faults = tuple((f.name, f.text) for i, f in enumerate(self.faults) if bits >> i & 1)
        rho = [(names[k] or f"obstacle {k}", float(d)) for k, d in enumerate(record["rho"]) if d < NEAR]
        if self.is_base and record["rho_seen"] < NEAR:
            rho.append(("seen by scan", float(record["rho_seen"])))
        aimed = status != "no_goal" and state in ("ARMED", "RUN")
        goal = np.array(record["goal"], np.float64) if aimed else None
        place = np.array(record["x"], np.float64)
        heading = float(record["heading"]) if self.is_base else 0.0
        return Moment(
            time=float(record["time"]),
            state=state,
            status=status,
            says=says(state, status, bool(faults)),
            faults=faults,
            place=place,
            heading=heading,
            goal=goal,
            error=float(record["error"]) if aimed else 0.0,
            speed=float(np.linalg.norm(record["xd"])),
            clearances=tuple(sorted(rho, key=lambda each: each[1])),
            torques=self._torques(record),
            forces=() if self.is_base else _forces(record),
            way=self._way(record, place, goal),
            scan=scan_of(record, heading) if self.is_base else np.zeros((0, 3)),
            q=np.zeros(0) if self.is_base else np.array(record["q"], np.float64),
        )

    def _torques(self, record: RecordRow) -> tuple[tuple[str, float], ...]:
        if self.is_base or len(self.tau) != len(self.header.joints):
            return ()
        return tuple(zip(self.header.joints, (np.abs(record["tau_sent"]) / self.tau).tolist(), strict=True))

    def _way(self, record: RecordRow, place: F64, goal: F64 | None) -> F64:
        """Return what lies ahead: a base's path, an arm's straight line to its goal."""
        if goal is None:
            return np.zeros((0, 3))
        if not self.is_base:
            return np.array([place, goal])
        count = min(max(0, int(record["corners"])), len(record["way"]))
        way = np.zeros((1 + count, 3))
        way[0], way[1:, :2] = place, record["way"][:count]
        return way


def length(metres: float) -> str:
    """Return a length in the unit that people would say it in."""
    if abs(metres) >= 1.0:
        return f"{metres:.2f} m"
    return f"{1e3 * metres:.{1 if abs(metres) < 0.01 else 0}f} mm"


def says(state: str, status: str, by_fault: bool) -> str:
    """Return in words what the robot does; by_fault: whether a fault is in force."""
    if state == "SAFE_STOP" and not by_fault:
        return "Stopped. Reset, then arm to go on."
    if state == "RUN":
        return STATUSES.get(status, status.replace("_", " "))
    return STATES.get(state, state)


def faults_of(header: Header) -> tuple[Fault, ...]:
    """Return the rows of the fault table that a header's records mean, by bit."""
    if header.extra.get("kind") == "base":
        from rtctl.rover.faults import FAULTS as BASE_FAULTS

        return BASE_FAULTS
    from rtctl.arm.faults import FAULTS

    return FAULTS


def config_of(header: Header) -> Json:
    """Return the config as it stands in the header, {} for one that is none."""
    try:
        return tomllib.loads(header.config)
    except tomllib.TOMLDecodeError:
        return {}


def scene_of(header: Header) -> Json:
    """Return what the header says about base pose, points and fixed obstacles, {} where it says nothing."""
    text = header.files.get(SCENE_FILE, "")
    try:
        found = json.loads(text or "{}")
    except (ValueError, RecursionError):
        found = {}
    return found if isinstance(found, dict) else {}


def _forces(record: RecordRow) -> tuple[tuple[int, F64, int], ...]:
    force = np.array(record["force"], np.float64)
    size = np.linalg.norm(force, axis=1)
    seen = np.flatnonzero(np.isfinite(size) & (size > FORCE_SEEN)).tolist()
    return tuple((k, force[k], int(record["point"][k])) for k in seen)


def scan_of(record: RecordRow, heading: float) -> F64:
    """Return where (k, 3) [m] the scan met something, from where the base was then; heading [rad] of now."""
    age = float(record["scan_age"])
    if not 0.0 <= age < OLD:
        return np.zeros((0, 3))
    ranges = np.array(record["scan"], np.float64)
    met = np.flatnonzero(np.isfinite(ranges) & (ranges > 0.0))
    then = heading - age * float(record["yaw_rate"])
    angle = then + float(record["scan_start"]) + met * float(record["scan_step"])
    c, s = np.cos(then), np.sin(then)
    ahead, left = (float(v) for v in record["scan_offset"])
    origin = (record["x"] - age * record["xd"])[:2] + np.array([c * ahead - s * left, s * ahead + c * left])
    flat = origin + ranges[met, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([flat, np.full(len(flat), 0.1)])
