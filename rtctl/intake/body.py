"""The part of a described robot that is controlled: a chain of revolute joints, everything else locked to it."""

import fnmatch
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from rtctl.errors import UsageError
from rtctl.intake.sources import IntakeError, Source, urdf_text, with_meshes
from rtctl.spell import nearest
from rtctl.types import F64

JOINTS_MAX = 7  # of a chain that is found: what comes before is a torso
HAND = re.compile(
    r"finger|gripper|jaw|thumb|claw|knuckle|pinky|index_|middle_|ring_|little_|hand_|palm|moving_jaw", re.I
)
OTHER = re.compile(r"leg|ankle|knee|hip_|wheel|caster|head|neck|laser|foot|_hx_|_hy_|_kn_|wing|rotor|prop", re.I)
TIPS = (
    "tcp",
    "tool0",
    "tool",
    "ee_link",
    "end_effector",
    "eef",
    "grasp",
    "ee",
    "attachment",
    "gripper",
    "flange",
    "hand",
)
HAIR = 1e-6  # share by which a largest moment of inertia stays below the sum of the others
TURN = 6.28  # [rad] each way of a joint without limits
RANGE = 3.1  # [rad] each way of a joint whose description has no range


class Asked(NamedTuple):
    """What the caller says of the arm."""

    tip: str = ""
    side: str = ""  # left, right
    joints: str = ""  # pattern of names
    lock: Mapping[str, float] = {}
    exclude: Sequence[str] = ()  # links left out, with all that they carry
    scale: float = 1.0  # of all lengths: 0.001 for a description in millimetres


class Described(NamedTuple):
    """A whole robot as its description has it."""

    model: pin.Model
    collision: pin.GeometryModel
    visual: pin.GeometryModel
    mimic: frozenset[str]
    effort: Mapping[str, float]  # [Nm] by joint, where the file states them apart
    told: list[str]


class Joint(NamedTuple):
    """A joint of the arm: nan where the description states nothing usable."""

    name: str
    low: float  # [rad]
    high: float
    speed: float  # [rad/s]
    effort: float  # [Nm]
    armature: float  # [kg m2]


class Arm(NamedTuple):
    """The arm alone: a model of its joints, in their order, and the geometry that they carry."""

    model: pin.Model
    collision: pin.GeometryModel
    visual: pin.GeometryModel
    joints: tuple[Joint, ...]
    tip: str
    locked: dict[str, float]
    told: list[str]


def describe(source: Source, exclude: Sequence[str] = ()) -> Described:
    """Return the robot of a source. Raises IntakeError."""
    told: list[str] = []
    try:
        if source.mjcf:
            return _from_mjcf(source, exclude, told)
        root, lost = with_meshes(urdf_text(source.path), source.path)
        if lost:
            told.append(f"{len(lost)} meshes are not there and left out: {', '.join(sorted(set(lost))[:3])}")
        _exclude(root, exclude)
        _told_apart(root)
        mimic = frozenset(j.get("name", "") for j in root.iter("joint") if j.find("mimic") is not None)
        for joint in root.iter("joint"):
            for tag in joint.findall("mimic"):
                joint.remove(tag)
        text = ET.tostring(root, encoding="unicode")
        model = pin.buildModelFromXML(text)
        collision, visual = (pin.buildGeomFromUrdfString(model, text, kind) for kind in _KINDS)
    except (ValueError, RuntimeError, IndexError) as error:
        raise IntakeError(f"{source.path.name}: cannot be read: {' '.join(str(error).split())[:200]}") from None
    return Described(model, collision, visual, mimic, {}, told)


_KINDS = (pin.GeometryType.COLLISION, pin.GeometryType.VISUAL)


def _from_mjcf(source: Source, exclude: Sequence[str], told: list[str]) -> Described:
    if exclude:
        raise UsageError(f"--exclude: got {exclude[0]} with an MJCF file, wanted a URDF: lock its joints instead")
    path = str(source.path)
    model = pin.buildModelFromMJCF(path)
    model = model[0] if isinstance(model, tuple) else model
    collision, visual = (pin.buildGeomFromMJCF(model, path, kind) for kind in _KINDS)
    effort: dict[str, float] = {}
    for actuator in ET.parse(path).getroot().iterfind("actuator/*"):
        bounds = actuator.get("forcerange") or (actuator.get("ctrlrange") if actuator.tag == "motor" else None)
        if bounds and actuator.get("joint"):
            gear = float((actuator.get("gear") or "1").split()[0])
            effort[str(actuator.get("joint"))] = gear * max(abs(float(b)) for b in bounds.split())
    return Described(model, collision, visual, frozenset(), effort, told)


def _exclude(root: ET.Element, links: Sequence[str]) -> None:
    """Take links and all that they carry out of a URDF. Raises UsageError."""
    names = [link.get("name", "") for link in root.findall("link")]
    for name in links:
        if name not in names:
            raise UsageError(f"--exclude: got {name}, wanted {nearest(name, names)}")
    gone = set(links)
    while True:
        joints = [j for j in root.findall("joint") if _link(j, "child") in gone or _link(j, "parent") in gone]
        more = {_link(j, "child") for j in joints if _link(j, "parent") in gone} - gone
        if not more:
            break
        gone |= more
    for joint in joints:
        root.remove(joint)
    for link in root.findall("link"):
        if link.get("name") in gone:
            root.remove(link)


def _told_apart(root: ET.Element) -> None:
    """Rename links that are called as joints are: one name, one frame."""
    joints = {joint.get("name", "") for joint in root.findall("joint")}
    ends = [end for joint in root.findall("joint") for end in (*joint.findall("parent"), *joint.findall("child"))]
    for link in root.findall("link"):
        name = link.get("name", "")
        if name in joints:
            link.set("name", f"{name}_link")
            for end in ends:
                if end.get("link") == name:
                    end.set("link", f"{name}_link")


def _link(joint: ET.Element, end: str) -> str:
    found = joint.find(end)
    return "" if found is None else found.get("link", "")


def take(robot: Described, asked: Asked) -> Arm:
    """Return the arm that is asked for, or the only one there is. Raises UsageError, IntakeError."""
    told = list(robot.told)
    chain, tip = _chain(robot, asked, told)
    model, locked = robot.model, {}
    q = pin.neutral(model)
    names = list(model.names)
    for name in asked.lock:
        if name not in names:
            raise UsageError(f"--lock: got {name}, wanted {nearest(name, names[1:])}")
    for j in range(1, model.njoints):
        if j in chain or model.nqs[j] != 1:
            continue
        at = model.idx_qs[j]
        low, high = model.lowerPositionLimit[at], model.upperPositionLimit[at]
        free = asked.lock.get(names[j], 0.0)
        q[at] = free if names[j] in asked.lock or low >= high else min(max(free, low), high)
        locked[names[j]] = float(q[at])
    lock = [j for j in range(1, model.njoints) if j not in chain]
    reduced, (collision, visual) = pin.buildReducedModel(model, [robot.collision, robot.visual], lock, q)
    if locked:
        at = [name for name, value in locked.items() if value != 0.0]
        words = ", ".join(f"{name} at {locked[name]:.3g}" for name in at[:4])
        told.append(f"{len(locked)} other joints are locked at 0{f', but {words}' if at else ''}; --lock NAME=VALUE")
    if robot.mimic:
        told.append(f"mimic joints are locked: {', '.join(sorted(robot.mimic)[:4])}")
    if asked.scale != 1.0:
        told.append(f"all lengths are {asked.scale:g} times those of the description")
        _scaled(reduced, (collision, visual), asked.scale)
    joints = tuple(_joint(robot, reduced, k, told) for k in range(1, reduced.njoints))
    return Arm(reduced, collision, visual, joints, tip, locked, told)


def _scaled(model: pin.Model, geometries: Sequence[pin.GeometryModel], scale: float) -> None:
    """Scale all lengths of a model and what it carries; masses stay, moments of inertia go with the square."""
    for k in range(model.njoints):
        model.jointPlacements[k].translation = scale * np.array(model.jointPlacements[k].translation)
        old = model.inertias[k]
        model.inertias[k] = pin.Inertia(old.mass, scale * np.array(old.lever), scale**2 * np.array(old.inertia))
    for frame in model.frames:
        frame.placement.translation = scale * np.array(frame.placement.translation)
    for geometry in geometries:
        for thing in geometry.geometryObjects:
            thing.placement.translation = scale * np.array(thing.placement.translation)
            thing.meshScale = scale * np.array(thing.meshScale)


def _joint(robot: Described, model: pin.Model, k: int, told: list[str]) -> Joint:
    """Return joint k with what its description states."""
    name, v = model.names[k], model.idx_vs[k]
    low, high = -TURN, TURN
    if model.nqs[k] == 2:
        told.append(f"{name} turns without end: its range is ±{TURN:g} rad here")
    else:
        low, high = float(model.lowerPositionLimit[model.idx_qs[k]]), float(model.upperPositionLimit[model.idx_qs[k]])
        if not low < high:
            told.append(f"{name} has no range in the description: ±{RANGE:g} rad is assumed")
            low, high = -RANGE, RANGE
        elif low < -2 * TURN or high > 2 * TURN:
            told.append(f"{name} has a range of {low:.3g} to {high:.3g} rad: ±{TURN:g} is taken")
            low, high = max(low, -TURN), min(high, TURN)
    effort = robot.effort.get(name, float(model.effortLimit[v]))
    speed = float(model.velocityLimit[v])
    return Joint(name, low, high, _usable(speed, 100.0), _usable(effort, 2000.0), float(model.armature[v]))


def _usable(value: float, most: float) -> float:
    return value if 0.0 < value < most else math.nan


def frame_of(model: pin.Model, name: str) -> pin.Frame:
    """Return a frame by name: a body's before others of that name; None where there is none."""
    found = [f for f in model.frames if f.name == name]
    return next((f for f in found if f.type == pin.FrameType.BODY), found[0] if found else None)


def _chain(robot: Described, asked: Asked, told: list[str]) -> tuple[list[int], str]:
    """Return the joints of the arm from base to tip, and the tip's frame. Raises UsageError, IntakeError."""
    model = robot.model
    if asked.tip:
        frame = frame_of(model, asked.tip)
        if frame is None:
            raise UsageError(f"--tip: got {asked.tip}, wanted {nearest(asked.tip, [f.name for f in model.frames])}")
        end, tip = int(frame.parentJoint), asked.tip
        chain = _up(robot, end)
    else:
        ends = _ends(robot, asked)
        if not ends:
            raise IntakeError("no chain of three or more revolute joints is found; --tip FRAME says where it ends")
        if len(ends) > 1:
            names = ", ".join(f"{model.names[ch[0]]} … {model.names[ch[-1]]} ({len(ch)})" for ch in ends)
            raise UsageError(f"--tip: got nothing, wanted the end of one of {names}; or --side left or right")
        chain = ends[0]
        end, tip = chain[-1], ""
    if asked.joints:
        chain = [j for j in chain if fnmatch.fnmatch(model.names[j], asked.joints)]
    elif len(chain) > JOINTS_MAX:
        told.append(f"joints before the arm are locked: {', '.join(model.names[j] for j in chain[:-JOINTS_MAX])}")
        chain = chain[-JOINTS_MAX:]
    if len(chain) < 2:
        raise IntakeError(f"{len(chain)} revolute joints lead to the tip; two at least make an arm")
    if not tip or end != chain[-1]:
        tip = tip or _tip(robot, chain[-1], told)
    return chain, tip


def _revolute(robot: Described, j: int) -> bool:
    kind = robot.model.joints[j].shortname()
    return (
        bool(re.search(r"^JointModelR(evoluteUn|UB|[XYZ]|evolute)", kind)) and robot.model.names[j] not in robot.mimic
    )


def _up(robot: Described, end: int) -> list[int]:
    chain: list[int] = []
    while end > 0:
        if _revolute(robot, end):
            chain.insert(0, end)
        end = int(robot.model.parents[end])
    return chain


def _ends(robot: Described, asked: Asked) -> list[list[int]]:
    """Return the chains that may be arms: of revolute joints, not of a hand, a leg or a head."""
    model = robot.model
    arm = {
        j
        for j in range(1, model.njoints)
        if _revolute(robot, j) and not HAND.search(model.names[j]) and not OTHER.search(model.names[j])
    }
    forks = {j for j in arm if sum(int(model.parents[c]) == j for c in range(1, model.njoints)) > 1}
    chains = []
    for j in sorted(arm):
        chain = [k for k in _up(robot, j) if k in arm]
        below = [c for c in arm if int(model.parents[c]) == j]
        hand = j in forks and len(chain) >= 4 and all(_depth(robot, c, arm) <= 3 for c in below)
        if (
            (not below or hand)
            and len(chain) >= 3
            and not any(k in forks and len(_up(robot, k)) >= 5 for k in chain[:-1])
        ):
            chains.append(chain[-JOINTS_MAX:] if len(chain) > JOINTS_MAX else chain)
    if asked.side:
        initial = asked.side[0]
        pattern = re.compile(rf"{asked.side}|(^|_){initial}_|_{initial}($|\d|_)|^{initial}[A-Z_]", re.I)
        chains = [chain for chain in chains if pattern.search(model.names[chain[-1]])]
    most = max((len(chain) for chain in chains), default=0)
    return [chain for chain in chains if len(chain) >= most - 1]


def _depth(robot: Described, j: int, arm: set[int]) -> int:
    below = [c for c in arm if int(robot.model.parents[c]) == j]
    return 1 + max((_depth(robot, c, arm) for c in below), default=0)


def _tip(robot: Described, end: int, told: list[str]) -> str:
    """Return the frame at the end of a chain whose name says that it is one, else the farthest."""
    frames = [f for f in robot.model.frames if int(f.parentJoint) == end and f.type != pin.FrameType.JOINT]
    frames = [f for f in frames if f.type in (pin.FrameType.BODY, pin.FrameType.OP_FRAME, pin.FrameType.FIXED_JOINT)]
    bodies = [f for f in frames if f.type == pin.FrameType.BODY] or frames
    if not bodies:
        raise IntakeError(f"{robot.model.names[end]} carries no link; --tip FRAME says where the arm ends")
    for word in TIPS:
        found = [f for f in bodies if word in f.name.lower() and "inertia" not in f.name.lower()]
        if found:
            chosen = max(found, key=lambda f: float(np.linalg.norm(f.placement.translation)))
            break
    else:
        chosen = max(bodies, key=lambda f: float(np.linalg.norm(f.placement.translation)))
    told.append(f"the tip is {chosen.name}; --tip FRAME for another")
    return str(chosen.name)


def within(inertia: pin.Inertia) -> pin.Inertia:
    """Return a possible inertia a hair within what a body can have, for physics engines that take it to the last digit.

    Published identifications are often cut off at the very bound: their largest moment is the sum of the others.
    """
    moments, axes = np.linalg.eigh(np.array(inertia.inertia))
    most = (1.0 - HAIR) * (moments[0] + moments[1])
    if moments[2] <= most:
        return inertia
    moments[2] = most
    return pin.Inertia(inertia.mass, np.array(inertia.lever), axes @ np.diag(moments) @ axes.T)


def impossible(inertia: pin.Inertia) -> str:
    """Return why no body has such an inertia, '' where one may."""
    if inertia.mass < 1e-5:
        return f"a mass of {inertia.mass:.3g} kg"
    moments: F64 = np.linalg.eigvalsh(np.array(inertia.inertia))
    if moments[0] <= 0.0:
        return f"a moment of inertia of {moments[0]:.3g} kg m2"
    if moments[2] > (moments[0] + moments[1]) * 1.001:
        return f"moments {moments[0]:.3g}, {moments[1]:.3g}, {moments[2]:.3g} kg m2: one more than the others together"
    return ""
