"""The obstacles that a daemon says it knows, as requests tell them."""

from typing import NamedTuple

import numpy as np

from rtctl.log.record.draw import quaternion
from rtctl.plain import Json
from rtctl.world.primitives import BOX, CAPSULE, CONE, MESH, PLANE, SPHERE, SUPERQUADRIC


class Known(NamedTuple):
    """One of them."""

    slot: int
    shape: Json  # as a request's


def known_obstacles(world: Json) -> list[Known]:
    """Return the obstacles in the answer to `world`; of a cloud the answer has no points, and it is left out."""
    rows = world.get("obstacles")
    if not isinstance(rows, dict):
        return []
    found = []
    for k, name in enumerate(world["names"]):
        shape = _shape(int(rows["kind"][k]), [float(v) for v in rows["dims"][k]], str(world["meshes"][k]))
        if shape is None:
            continue
        pose = {"position": rows["p"][k], "wxyz": list(quaternion(np.array(rows["R"][k])))}
        motion = {"velocity": rows["v"][k], "omega": rows["w"][k]}
        influence, clearance = rows["room"][k][:2] if "room" in rows else (0.0, 0.0)  # a daemon of before has none
        room = {"influence": float(influence), "clearance": float(clearance)} if influence else {}
        found.append(Known(int(world["slots"][k]), {"name": str(name), **shape, **pose, **motion, **room}))
    return found


def _shape(kind: int, dims: list[float], mesh: str) -> Json | None:
    """Return type and dims of what the controller keeps as a kind of solid."""
    a, b, c, p, r = dims
    named = {
        SPHERE: ("sphere", [a, 0.0, 0.0, 0.0]),
        CAPSULE: ("capsule", [a, b, 0.0, 0.0]),
        PLANE: ("plane", [0.0] * 4),
        BOX: ("box", [a, b, c, 0.0]),
        CONE: ("cone", [a, b, c, 0.0]),
        SUPERQUADRIC: ("n_ellipsoid", [a, b, c, 0.5 * p]) if p == r else ("n_cylinder", [a, b, c, 0.5 * r]),
        MESH: ("mesh", [0.0] * 4),
    }.get(kind)
    return None if named is None else {"type": named[0], "dims": named[1], "mesh": mesh}
