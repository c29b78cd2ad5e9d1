"""The obstacles of a log and how they are drawn, whatever moves among them.

Obstacles are followed by the same rule as the controller's own table: the first free slot, extrapolated by velocity.
"""

import base64
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from rtctl.log.header import SCENE_FILE, Header, meshes_of
from rtctl.log.record import draw
from rtctl.plain import Json
from rtctl.types import F64, RecordRow
from rtctl.world import tree
from rtctl.world.meshes import Meshes
from rtctl.world.primitives import LARGEST, NUMBERS

HZ = 30.0
GRID = 4  # cells a side, of a cloud
BOXES = GRID**3  # drawn of one mesh or cloud at most
BOUND = 1e6  # [m, rad, N] of anything drawn; comparing is false for NaN


class Thing(NamedTuple):
    """An obstacle as it was last told."""

    shape: Json
    time: float  # [s] robot time for which its position holds
    boxes: F64  # (k, 6) [m] of a mesh or a cloud, see draw.obstacle


class Surroundings:
    """Follows the obstacles of the config and of the requests."""

    def __init__(self, header: Header) -> None:
        self.about = _json(header.files.get(SCENE_FILE, ""))
        self._header = header
        self._slots: list[str] = [""] * header.slots
        self._things: dict[str, Thing] = {}
        self._gone: list[str] = []
        for shape in self.about.get("obstacles", ()):
            if _is_shape(shape):
                self._set(shape, 0.0)
        self._fixed = set(self._things)

    def request(self, payload: bytes, time: float) -> None:
        """Take a request's obstacles into account; time [s] of the robot."""
        edits = _json(payload.decode("utf-8", "replace")).get("obstacles", ())
        for edit in edits if isinstance(edits, list) else ():
            if not isinstance(edit, dict):
                continue
            name, shape, age = str(edit.get("name", "")), edit.get("shape"), edit.get("age", 0.0)
            if shape is not None:
                if name not in self._fixed and _are_numbers([age], 1) and _is_shape(shape):
                    self._set({**shape, "name": name}, time - age)
                continue
            for each in [n for n in self._things if name in (n, "*") and n not in self._fixed]:
                self._clear(each)

    def restart(self, known: Sequence[tuple[int, Json]], time: float) -> None:
        """Take the obstacles that the controller has, each in its slot, for all there are; time [s] of the robot."""
        for name in list(self._things):
            self._clear(name)
        for slot, shape in known:
            name = str(shape.get("name", ""))
            if 0 <= slot < len(self._slots) and _is_shape(shape):
                self._slots[slot] = name
                self._things[name] = Thing(shape, time, self._boxes_of(shape))

    def _set(self, shape: Json, time: float) -> None:
        name = str(shape.get("name", ""))
        if name not in self._things:
            if "" not in self._slots:
                return
            self._slots[self._slots.index("")] = name
        self._things[name] = Thing(shape, time, self._boxes_of(shape))

    def _boxes_of(self, shape: Json) -> F64:
        """Return (k, 6) [m] boxes about the surface of a mesh or the points of a cloud; none for other shapes."""
        try:
            if shape.get("type") == "mesh":
                return tree.boxes_of(self._solids.body(str(shape["mesh"])), BOXES)
            if shape.get("type") == "cloud":
                radius, step = (float(v) for v in shape["dims"][:2])
                points = np.frombuffer(base64.b64decode(shape["cloud"]), "<i2").reshape(-1, 3) * step
                return _boxed(points, radius)
        except (ValueError, KeyError, TypeError, IndexError):  # as the log has it
            pass
        return np.zeros((0, 6))

    @cached_property
    def _solids(self) -> Meshes:
        return meshes_of(self._header)

    def things(self) -> dict[str, tuple[Thing, bool]]:
        """Return the obstacles as they were last told, by name, and whether each is the config's own."""
        return {name: (thing, name in self._fixed) for name, thing in self._things.items()}

    def _clear(self, name: str) -> None:
        del self._things[name]
        self._slots[self._slots.index(name)] = ""
        self._gone.append(name)

    def name_of(self, slot: int) -> str:
        """Return the name of the obstacle in a slot, '' for none."""
        return self._slots[slot] if 0 <= slot < len(self._slots) else ""

    def shapes(self) -> list[Json]:
        """Return the obstacles as they were last told."""
        return [thing.shape for thing in self._things.values()]


class Drawing(Surroundings, ABC):
    """What moves among the obstacles, and how all of it is drawn."""

    drawn: ClassVar[tuple[str, ...]]  # fields of a record without which nothing can be shown

    def can_show(self, record: RecordRow) -> bool:
        """Return whether a record's numbers can be drawn: a log takes whatever bits a tick had."""
        names = record.dtype.names or ()
        return all(name in names and bool((np.abs(record[name]) < BOUND).all()) for name in self.drawn)

    @abstractmethod
    def frames(self, record: RecordRow, ns: int) -> bytes:
        """Return foxglove.FrameTransforms of what moves at log_time `ns`."""

    @abstractmethod
    def own(self, message: SceneUpdate, record: RecordRow, ns: int) -> None:
        """Add to a SceneUpdate what is drawn beside the obstacles."""

    @abstractmethod
    def body(self, message: SceneUpdate) -> None:
        """Add to a SceneUpdate what hangs on the frames and never changes."""

    @cached_property
    def _body(self) -> bytes:
        message = SceneUpdate()
        self.body(message)
        data: bytes = message.SerializeToString(deterministic=True)
        return data

    def update(self, record: RecordRow, ns: int) -> bytes:
        """Return foxglove.SceneUpdate at log_time `ns`; what was cleared is deleted."""
        message = SceneUpdate()
        for name in self._gone:
            draw.stamped(message.deletions.add(type=0, id=_called(name)).timestamp, ns)
        self._gone.clear()
        now = float(record["time"])
        for name, (shape, told, boxes) in self._things.items():
            colour = draw.GREY if name in self._fixed else draw.BLUE
            draw.obstacle(draw.entity_of(message, _called(name), ns), shape, boxes, now - told, colour)
        self.own(message, record, ns)
        data: bytes = message.SerializeToString(deterministic=True) + self._body  # repeated fields add up
        return data


def _is_shape(shape: object) -> bool:
    """Return whether a shape is one that the controller's table takes: it refuses others, and they are not drawn."""
    return isinstance(shape, dict) and all(_are_numbers(shape.get(name), count) for name, count in NUMBERS)


def _are_numbers(values: object, count: int) -> bool:
    if not isinstance(values, list) or len(values) != count:
        return False
    return all(isinstance(v, int | float) and abs(v) <= LARGEST for v in values)


def _boxed(points: F64, radius: float) -> F64:
    """Return at most BOXES boxes (k, 6) [m] that hold the balls about points (n, 3), cell by cell of a grid."""
    low, size = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-9)
    cells = np.minimum((points - low) / size * GRID, GRID - 1).astype(np.int64)
    number = cells @ (GRID * GRID, GRID, 1)
    parts = [points[number == each] for each in np.unique(number)]
    return np.array([[*(part.min(axis=0) - radius), *(part.max(axis=0) + radius)] for part in parts])


def _called(name: str) -> str:
    return f"obstacle {name}"


def _json(text: "str | bytes") -> Json:
    try:
        value = json.loads(text or "{}")
    except (ValueError, RecursionError):
        value = {}
    return value if isinstance(value, dict) else {}
