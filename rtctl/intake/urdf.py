"""The URDF of an arm alone: its joints with usable limits, inertias, convex collision geometry, what one sees."""

from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from rtctl.intake.body import Arm, frame_of
from rtctl.intake.shapes import Piece, write_stl
from rtctl.types import F64

LOOKS = (".stl", ".obj", ".dae")


class Limits(NamedTuple):
    """What the URDF says of a joint: nothing is missing any more."""

    low: float  # [rad]
    high: float
    speed: float  # [rad/s]
    effort: float  # [Nm]


def write(folder: Path, name: str, origin: str, arm: Arm, limits: list[Limits], pieces: list[Piece]) -> Path:
    """Write NAME.urdf and its hulls into a folder; return the URDF's path."""
    model = arm.model
    meshes = f"{name}_meshes"
    (folder / meshes).mkdir(parents=True, exist_ok=True)
    carriers = [_carrier(model, j) for j in range(model.njoints)]
    taken = set(carriers)
    lines = ['<?xml version="1.0"?>', f"<!-- The arm of {origin.replace('--', '-')}, written by rtctl init. -->"]
    lines.append(f"<robot name={quoteattr(name)}>")
    fixed: list[str] = []
    for j in range(model.njoints):
        inside = [p for p in pieces if p.joint == j]
        seen = [g for g in arm.visual.geometryObjects if int(g.parentJoint) == j]
        groups = dict.fromkeys([carriers[j], *(p.frame for p in inside)])
        for frame in groups:
            link = carriers[j] if frame == carriers[j] else _free(frame, taken)
            own = [p for p in inside if p.frame == frame]
            looks = [g for g in seen if frame == carriers[j]]
            inertia = _inertial(model.inertias[j]) if j and frame == carriers[j] else []
            shapes = [_collision(p, folder, f"{meshes}/{link}_{k}.stl") for k, p in enumerate(own)]
            lines += [
                f"  <link name={quoteattr(link)}>",
                *inertia,
                *filter(None, map(_visual, looks)),
                *shapes,
                "  </link>",
            ]
            if link != carriers[j]:
                fixed += _fixed(carriers[j], link, pin.SE3.Identity())
    for k, limit in enumerate(limits, 1):
        lines += _joint(model, k, carriers, limit)
    frame = frame_of(model, arm.tip)
    if arm.tip not in taken:
        lines.append(f"  <link name={quoteattr(arm.tip)}/>")
        fixed += _fixed(carriers[int(frame.parentJoint)], arm.tip, frame.placement)
    path = folder / f"{name}.urdf"
    path.write_text("\n".join([*lines, *fixed, "</robot>", ""]), encoding="utf-8")
    return path


def _carrier(model: pin.Model, j: int) -> str:
    """Return the name of the link that a joint moves: that of the body at it, where there is one."""
    if j == 0:
        return "arm_base"
    bodies = [f for f in model.frames if int(f.parentJoint) == j and f.type == pin.FrameType.BODY]
    at = [f.name for f in bodies if np.allclose(f.placement.homogeneous, np.eye(4), atol=1e-9)]
    return str(at[0]) if at else f"{model.names[j]}_link"


def _free(name: str, taken: set[str]) -> str:
    """Return a name like the one given that no link has yet."""
    name = name or "piece"
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _numbers(values: F64) -> str:
    return " ".join(f"{float(v) + 0.0:.9g}" for v in values)


def _origin(placement: pin.SE3) -> str:
    rpy = pin.rpy.matrixToRpy(np.array(placement.rotation))
    return f'<origin xyz="{_numbers(np.array(placement.translation))}" rpy="{_numbers(rpy)}"/>'


def _inertial(inertia: pin.Inertia) -> list[str]:
    I = np.array(inertia.inertia)
    keys = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    moments = " ".join(f'{key}="{I[a, b]:.9g}"' for key, a, b in keys)
    return [
        "    <inertial>",
        f'      <origin xyz="{_numbers(np.array(inertia.lever))}" rpy="0 0 0"/>',
        f'      <mass value="{inertia.mass:.9g}"/>',
        f"      <inertia {moments}/>",
        "    </inertial>",
    ]


def _collision(piece: Piece, folder: Path, file: str) -> str:
    shape = piece.primitive
    if not shape:
        write_stl(folder / file, piece.corners, piece.faces)
        shape = f"<mesh filename={quoteattr(file)}/>"
    return f"    <collision>{_origin(piece.placement)}<geometry>{shape}</geometry></collision>"


def _visual(thing: pin.GeometryObject) -> str:
    """Return what one sees of a mesh, by the maker's file; '' for what is no mesh of a file."""
    path = Path(str(thing.meshPath))
    if path.suffix.lower() not in LOOKS or not path.is_file():
        return ""
    shape = f"<mesh filename={quoteattr(str(path))} scale={quoteattr(_numbers(np.array(thing.meshScale)))}/>"
    return f"    <visual>{_origin(thing.placement)}<geometry>{shape}</geometry></visual>"


def _joint(model: pin.Model, k: int, carriers: list[str], limit: Limits) -> list[str]:
    joint = model.joints[k]
    data = joint.createData()
    joint.calc(data, pin.neutral(model)[model.idx_qs[k] : model.idx_qs[k] + model.nqs[k]])
    axis = np.array(data.S).ravel()[3:6]
    bounds = (
        f'lower="{limit.low:.9g}" upper="{limit.high:.9g}" effort="{limit.effort:.9g}" velocity="{limit.speed:.9g}"'
    )
    return [
        f'  <joint name={quoteattr(model.names[k])} type="revolute">',
        f"    {_origin(model.jointPlacements[k])}",
        f"    <parent link={quoteattr(carriers[int(model.parents[k])])}/>",
        f"    <child link={quoteattr(carriers[k])}/>",
        f'    <axis xyz="{_numbers(axis)}"/>',
        f"    <limit {bounds}/>",
        "  </joint>",
    ]


def _fixed(parent: str, child: str, placement: pin.SE3) -> list[str]:
    return [
        f'  <joint name={quoteattr(child + "_fixed")} type="fixed">',
        f"    {_origin(placement)}",
        f"    <parent link={quoteattr(parent)}/>",
        f"    <child link={quoteattr(child)}/>",
        "  </joint>",
    ]
