"""The memory of the tick, written into the log now and then: a replay can begin there, and on many processors at once.

JSON on the outside, the bytes of all arrays in one piece inside, so that a checkpoint costs the servo a few tenths of a
millisecond and nothing is lost: floats come back to the bit. What belongs to the robot (its meshes) is left out. A
checkpoint is data from a file: whatever would not fit this robot's memory, array by array, is refused.
"""

from collections.abc import Iterator
from enum import Enum
from functools import cache
from typing import NamedTuple, get_args, get_type_hints

import msgspec
import numpy as np

from rtctl.arm.escape import DIRECTIONS, Phase
from rtctl.arm.flat import shapes_of
from rtctl.arm.hot import HOT, record_of
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.plain import Json
from rtctl.types import Array, Severity, State, Status, Task
from rtctl.world.primitives import MESH

PERIOD = 5.0  # [s] of robot time between two


class Checkpoint(NamedTuple):
    """What a replay needs to go on behind a tick."""

    memory: Memory
    counters: tuple[int, ...]  # of each joint's newest protected frame


def due(tick: int, dt: float) -> bool:
    """Return whether a checkpoint follows this tick of a servo of period dt [s]."""
    return (tick + 1) % round(PERIOD / dt) == 0


def encode_checkpoint(memory: Memory, counters: tuple[int, ...]) -> bytes | None:
    """Return the JSON of a checkpoint; None while a cloud is among the obstacles: its tree is not worth its bytes."""
    if any(len(cloud) for cloud in memory.placed.obstacles.clouds):
        return None
    blobs: list[bytes] = []
    fields = [_plain(getattr(memory, name), blobs) for name in memory.__struct_fields__]
    body = {"tick": memory.tick, "layout": layout(), "counters": counters, "memory": fields, "data": b"".join(blobs)}
    return msgspec.json.encode(body)


def decode_checkpoint(data: bytes, robot: Robot, template: Memory) -> Checkpoint:
    """Return the checkpoint of `encode_checkpoint`; template: any memory of this robot.

    Raises ValueError when it is of another version of the program, of another robot, or damaged.
    """
    try:
        body = msgspec.json.decode(data)
        if body["layout"] != layout():
            raise ValueError("of another version")
        raw = _Raw(msgspec.convert(body["data"], bytes))
        hints = get_type_hints(Memory)
        values = zip(Memory.__struct_fields__, body["memory"], strict=True)
        fields: Json = {name: _value(node, hints[name], raw) for name, node in values}
        memory = Memory(**fields)
        memory = _with_meshes(memory, robot)
        _check(memory, template)
        shapes = shapes_of(
            memory.placed.obstacles, memory.placed.moving, memory.placed.creep, memory.placed.stale
        )  # made anew: they are not checked singly
        return Checkpoint(memory._replace(shapes=shapes), tuple(int(c) & 0xFF for c in body["counters"]))
    except (msgspec.MsgspecError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise ValueError(f"not a checkpoint: {error}") from None


@cache
def layout() -> str:
    """Return what names the fields that this version keeps."""
    return ";".join(f"{name}:{','.join(fields)}" for name, fields in _layouts())


def _layouts() -> Iterator[tuple[str, tuple[str, ...]]]:
    yield "Memory", Memory.__struct_fields__
    yield "hot", tuple(f"{name} {HOT[name].base.str}{HOT[name].shape}" for name in HOT.names or ())
    for name, kind in sorted(_kinds().items()):
        yield name, kind._fields


@cache
def _kinds() -> Json:
    """Return the named tuples that a memory may hold, by name."""
    found: Json = {}
    waiting: list[type] = [Memory]
    while waiting:
        for hint in get_type_hints(waiting.pop()).values():
            for kind in (hint, *get_args(hint)):
                if isinstance(kind, type) and hasattr(kind, "_fields") and kind.__name__ not in found:
                    found[kind.__name__] = kind
                    waiting.append(kind)
    return found


def _plain(value: object, blobs: list[bytes]) -> object:
    """Return a value as JSON knows it; arrays are appended to blobs."""
    if isinstance(value, np.ndarray):
        blobs.append(value.tobytes())
        return {"a": value.dtype.str, "s": value.shape}
    if isinstance(value, tuple):
        left_out = {"World": "known", "Obstacles": "mesh"}.get(type(value).__name__, "")
        nodes = [None if name == left_out else _plain(each, blobs) for name, each in _named(value)]
        return {"n": type(value).__name__, "f": nodes} if hasattr(value, "_fields") else nodes
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.generic):
        value = value.item()
    return {"x": value.hex()} if isinstance(value, float) else value  # JSON has no infinity


def _named(value: tuple[object, ...]) -> Iterator[tuple[str, object]]:
    names = getattr(value, "_fields", None)
    return zip(names, value, strict=True) if names else (("-", each) for each in value)


class _Raw:
    """The bytes of all arrays, taken from the front."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, dtype: np.dtype[np.generic], shape: tuple[int, ...]) -> Array:
        count = int(np.prod(shape, dtype=np.int64))
        if dtype.hasobject or count < 0:
            raise ValueError("not a checkpoint: an array of no numbers")
        found = np.frombuffer(self.data, dtype, count, self.at).reshape(shape).copy()  # writable, as all in a memory
        self.at += found.nbytes
        return found


def _value(node: object, hint: object, raw: _Raw) -> object:
    if isinstance(node, dict) and "a" in node:
        return raw.take(np.dtype(node["a"]), tuple(node["s"]))
    if isinstance(node, dict) and "n" in node:
        kind = _kinds()[node["n"]]
        hints = get_type_hints(kind)
        return kind(*(_value(f, hints[name], raw) for name, f in zip(kind._fields, node["f"], strict=True)))
    if isinstance(node, dict):
        return float.fromhex(node["x"])
    if isinstance(node, list):
        return tuple(_value(each, object, raw) for each in node)
    return hint(node) if isinstance(hint, type) and issubclass(hint, Enum) else node


def _with_meshes(memory: Memory, robot: Robot) -> Memory:
    obstacles = memory.placed.obstacles._replace(mesh=robot.meshes.data)
    bodies = [robot.meshes.start(name) for name in robot.meshes.names]
    meshes = obstacles.dims[obstacles.kind == MESH]
    if not np.isin(meshes[:, 3], bodies).all() or not ((obstacles.group >= 0) & (obstacles.group < robot.slots)).all():
        raise ValueError("not a checkpoint of this robot: obstacles")
    placed = memory.placed._replace(known=robot.meshes, obstacles=obstacles)
    return memory._replace(placed=placed)


def _check(memory: Memory, template: Memory) -> None:
    """Raise ValueError where a field could not stand in the template's place."""
    for name in Memory.__struct_fields__:
        if name != "blocked_by":
            _like(getattr(memory, name), getattr(template, name), name)
    if memory.n != template.n:
        raise ValueError("not a checkpoint of this robot: joints")
    if not isinstance(memory.blocked_by, tuple) or not all(isinstance(text, str) for text in memory.blocked_by):
        raise ValueError("not a checkpoint: blocked_by")
    h = record_of(memory.hot)[0]
    kinds = {
        "state": State,
        "reaction": Severity,
        "status": Status,
        "task": Task,
        "goal_task": Task,
        "hold_task": Task,
        "escape_phase": Phase,
    }
    for name, kind in kinds.items():
        kind(int(h[name]))  # raises ValueError
    if not h["escape_ticks"] >= 0 or (h["escape_phase"] == Phase.CHOOSING and h["escape_ticks"] >= DIRECTIONS):
        raise ValueError("not a checkpoint: escape")


def _like(value: object, wanted: object, place: str) -> None:
    if isinstance(wanted, np.ndarray):
        fits = isinstance(value, np.ndarray) and (value.dtype, value.shape) == (wanted.dtype, wanted.shape)
    elif isinstance(wanted, tuple):
        fits = isinstance(value, tuple) and type(value) is type(wanted) and len(value) == len(wanted)
        if isinstance(value, tuple) and fits:
            for k, (a, b) in enumerate(zip(value, wanted, strict=True)):
                _like(a, b, f"{place}.{wanted._fields[k] if hasattr(wanted, '_fields') else k}")
    else:
        fits = isinstance(value, type(wanted.item() if isinstance(wanted, np.generic) else wanted))
    if not fits:
        raise ValueError(f"not a checkpoint of this robot: {place}")
