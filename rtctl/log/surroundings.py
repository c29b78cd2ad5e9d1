"""The obstacles of a log and how they are drawn, whatever moves among them.

Obstacles are followed by the same rule as the controller's own table: the first free slot, extrapolated by velocity.
"""

import json
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from rtctl.log import draw
from rtctl.log.header import SCENE_FILE, Header

HZ = 30.0
LARGEST = 1e6  # [m, rad, N] of anything drawn; comparing is false for NaN


class Thing(NamedTuple):
    """An obstacle as it was last told."""

    shape: dict[str, Any]
    time: float  # [s] robot time for which its position holds


class Surroundings:
    """Follows the obstacles of the config and of the requests."""

    drawn: ClassVar[tuple[str, ...]] = ()  # fields of a record without which nothing can be shown

    def __init__(self, header: Header) -> None:
        self.about = _json(header.files.get(SCENE_FILE, ""))
        self._slots: list[str] = [""] * header.slots
        self._things: dict[str, Thing] = {}
        self._gone: list[str] = []
        for shape in self.about.get("obstacles", ()):
            self._set(shape, 0.0)
        self._fixed = set(self._things)

    def request(self, payload: bytes, time: float) -> None:
        """Take a request's obstacles into account; time [s] of the robot."""
        edits = _json(payload.decode("utf-8", "replace")).get("obstacles", ())
        for edit in edits if isinstance(edits, list) else ():
            name, shape = str(edit.get("name", "")), edit.get("shape")
            if isinstance(shape, dict):
                if name not in self._fixed:
                    self._set({**shape, "name": name}, time - float(edit.get("age") or 0.0))
                continue
            for each in [n for n in self._things if name in (n, "*") and n not in self._fixed]:
                self._clear(each)

    def _set(self, shape: dict[str, Any], time: float) -> None:
        name = str(shape.get("name", ""))
        if name not in self._things:
            if "" not in self._slots:
                return
            self._slots[self._slots.index("")] = name
        self._things[name] = Thing(shape, time)

    def _clear(self, name: str) -> None:
        del self._things[name]
        self._slots[self._slots.index(name)] = ""
        self._gone.append(name)

    def name_of(self, slot: int) -> str:
        """Return the name of the obstacle in a slot, '' for none."""
        return self._slots[slot] if 0 <= slot < len(self._slots) else ""

    def shapes(self) -> list[dict[str, Any]]:
        """Return the obstacles as they were last told."""
        return [thing.shape for thing in self._things.values()]

    def can_show(self, record: Any) -> bool:
        """Return whether a record's numbers can be drawn: a log takes whatever bits a tick had."""
        names = record.dtype.names or ()
        return all(name in names and bool((np.abs(record[name]) < LARGEST).all()) for name in self.drawn)

    def frames(self, record: Any, ns: int) -> bytes:
        """Return foxglove.FrameTransforms of what moves at log_time `ns`."""
        raise NotImplementedError

    def own(self, message: Any, record: Any, ns: int) -> None:
        """Add to a SceneUpdate what is drawn beside the obstacles."""
        raise NotImplementedError

    def body(self, message: Any) -> None:
        """Add to a SceneUpdate what hangs on the frames and never changes."""
        raise NotImplementedError

    @cached_property
    def _body(self) -> bytes:
        message = SceneUpdate()
        self.body(message)
        data: bytes = message.SerializeToString(deterministic=True)
        return data

    def update(self, record: Any, ns: int) -> bytes:
        """Return foxglove.SceneUpdate at log_time `ns`; what was cleared is deleted."""
        message = SceneUpdate()
        for name in self._gone:
            draw.stamped(message.deletions.add(type=0, id=_called(name)).timestamp, ns)
        self._gone.clear()
        now = float(record["time"])
        for name, (shape, told) in self._things.items():
            colour = draw.GREY if name in self._fixed else draw.BLUE
            draw.obstacle(draw.entity_of(message, _called(name), ns), shape, now - told, colour)
        self.own(message, record, ns)
        data: bytes = message.SerializeToString(deterministic=True) + self._body  # repeated fields add up
        return data


def _called(name: str) -> str:
    return f"obstacle {name}"


def _json(text: "str | bytes") -> dict[str, Any]:
    try:
        value = json.loads(text or "{}")
    except (ValueError, RecursionError):
        value = {}
    return value if isinstance(value, dict) else {}
