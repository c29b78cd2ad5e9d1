"""Which drives are on the joints: those of the shipped table, or virtual ones that fit."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from rtctl.errors import UsageError
from rtctl.intake.body import Joint
from rtctl.protocol.mit import DRIVES
from rtctl.spell import nearest

ARMATURE_PER_NM = 5e-4  # [kg m2/Nm] of geared drives whose rotors nobody states: between the two kinds of Damiao's
P_MAX = 12.5  # [rad] of a virtual drive


class Model(NamedTuple):
    """A drive that one can buy. Peak torque and speed bound what the joint may ask; scales: `protocol.mit.DRIVES`."""

    peak_Nm: float
    speed_rad_s: float
    armature_kg_m2: float  # rotor's inertia times gear squared


# Peak torque and no-load speed at 24 V: data sheets of Shenzhen Damiao Technology (damiaokeji.com), drive DM-J<number>.
# Rotor inertia and gear: openarm_description of Enactic (joint_dynamics), 1.95e-4 x 9^2, 2.0e-5 x 40^2, 1.8e-5 x 10^2;
# nan where no source states it.
DAMIAO = {
    "DM4310": Model(7.0, 20.94, 0.0018),
    "DM4310_48V": Model(7.0, 41.9, 0.0018),
    "DM4340": Model(27.0, 5.445, 0.032),
    "DM4340_48V": Model(27.0, 10.0, 0.032),
    "DM6006": Model(11.0, 28.8, math.nan),
    "DM8006": Model(20.0, 26.2, math.nan),
    "DM8009": Model(40.0, 16.75, 0.0158),
    "DM10010L": Model(120.0, 15.7, math.nan),
}
MAKERS = {"damiao": ("DM", DAMIAO)}


class Drive(NamedTuple):
    """The drive of one joint."""

    name: str
    peak: float  # [Nm] inf for a virtual one: what the joint states
    speed: float  # [rad/s]
    armature: float  # [kg m2]
    table: tuple[float, float, float] | None  # p_max, v_max, t_max of a [drives] table; None: the catalogue has it


def parse(text: str, count: int) -> list[str]:
    """Return the drives that `--drives` names, [] for virtual ones. Raises UsageError."""
    if text in ("", "virtual"):
        return []
    maker, colon, listed = text.partition(":")
    if maker not in MAKERS or not colon:
        raise UsageError(f"--drives: got {text}, wanted virtual, or {', '.join(MAKERS)}:TYPE,TYPE,… base to tip")
    prefix, known = MAKERS[maker]
    names = [word if word.startswith(prefix) else prefix + word for word in listed.split(",")]
    for name in names:
        if name not in known:
            raise UsageError(f"--drives: got {name}, wanted {nearest(name, known)}")
    if len(names) != count:
        raise UsageError(f"--drives: got {len(names)} drives, wanted {count}, one a joint from base to tip")
    return names


def chosen(names: Sequence[str], joints: Sequence[Joint]) -> list[Drive]:
    """Return a drive for each joint, whose torque [Nm] and speed [rad/s] are known by now."""
    if names:
        found = [(name, DAMIAO[name], joint) for name, joint in zip(names, joints, strict=True)]
        return [
            Drive(
                n,
                min(m.peak_Nm, DRIVES[n].t_max),
                min(m.speed_rad_s, DRIVES[n].v_max),
                _armature(m.armature_kg_m2, m.peak_Nm),
                None,
            )
            for n, m, _ in found
        ]
    tables: dict[tuple[float, float, float], str] = {}
    drives = []
    for joint in joints:
        reach = max(abs(joint.low), abs(joint.high))
        table = (max(P_MAX, math.ceil(reach)), float(max(10, math.ceil(joint.speed))), _scale(joint.effort))
        name = tables.setdefault(table, f"V{len(tables) + 1}")
        armature = joint.armature or _armature(math.nan, joint.effort)
        drives.append(Drive(name, joint.effort, joint.speed, armature, table))
    return drives


def _armature(stated: float, torque: float) -> float:
    return stated if math.isfinite(stated) else round(min(ARMATURE_PER_NM * torque, 0.5), 5)


def _scale(torque: float) -> float:
    """Return a round torque [Nm] above one."""
    step = 10.0 ** math.floor(math.log10(torque))
    return round(math.ceil(1.05 * torque / step * 2.0) / 2.0 * step, 6)
