"""Which obstacle was in which slot, and where: from the config and the requests of a log."""

import math
from typing import NamedTuple

from rtctl.log import schema
from rtctl.log.header import Header
from rtctl.log.read.run import Run
from rtctl.log.record.encoding import event_of
from rtctl.log.record.surroundings import Surroundings
from rtctl.plain import Json
from rtctl.types import B1, I64


class Way(NamedTuple):
    """Where an obstacle was seen: for drawing."""

    name: str
    type: str
    dims: list[float]
    path: list[list[float]]  # [m] positions
    wxyz: list[float]
    ticks: list[int]  # of each position: since when it was there


class Slots:
    """Which obstacle was in which slot, and where: from the requests."""

    def __init__(self, run: Run, header: Header) -> None:
        scene = Surroundings(header)
        self.owner: dict[int, list[tuple[int, str]]] = {}  # slot -> (from tick, name)
        self.ways: dict[str, Way] = {}
        self.goals: list[list[float]] = []
        self.asked: list[int] = []  # ticks
        for slot in range(header.slots):
            if name := scene.name_of(slot):
                self.owner[slot] = [(-1, name)]
        for shape in scene.shapes():
            self._seen(shape, 0)
        previous = {slot: rows[-1][1] for slot, rows in self.owner.items()}
        for payload in run[schema.REQUEST].payloads if schema.REQUEST in run else ():
            body = event_of(payload)
            tick = body["tick"] if isinstance(body.get("tick"), int) else 0
            if isinstance(body.get("goal"), dict):
                self._aimed(body["goal"], tick)
            if not body.get("obstacles"):
                continue
            scene.request(payload, 0.0)
            for edit in body["obstacles"] if isinstance(body["obstacles"], list) else ():
                if isinstance(edit, dict) and isinstance(edit.get("shape"), dict):
                    self._seen({**edit["shape"], "name": edit.get("name", "")}, tick)
            for slot in range(header.slots):
                name = scene.name_of(slot)
                if name != previous.get(slot, ""):
                    self.owner.setdefault(slot, []).append((tick, name))
                    previous[slot] = name

    def _aimed(self, goal: Json, tick: int) -> None:
        try:
            x, y, z = (round(float(v), 4) for v in goal["position"])
        except (KeyError, TypeError, ValueError):
            return
        if all(map(math.isfinite, (x, y, z))) and (not self.goals or self.goals[-1] != [x, y, z]):
            self.goals.append([x, y, z])
            self.asked.append(tick)

    def _seen(self, shape: Json, tick: int) -> None:
        try:
            name, p = str(shape["name"]), [round(float(v), 4) for v in shape["position"]]
            dims, wxyz = [float(v) for v in shape["dims"]], [float(v) for v in shape["wxyz"]]
        except (KeyError, TypeError, ValueError):
            return
        old = self.ways.get(name)
        path, ticks = (old.path, old.ticks) if old is not None else ([], [])
        if not path or path[-1] != p:
            path.append(p)
            ticks.append(tick)
        self.ways[name] = Way(name, str(shape.get("type", "")), dims, path, wxyz, ticks)

    def mine(self, slot: int, tick: I64) -> "list[tuple[str, B1]]":
        """Return by name the rows in which that obstacle had the slot."""
        rows = self.owner.get(slot, [(-1, f"slot {slot}")])
        found = []
        for k, (start, name) in enumerate(rows):
            stop = rows[k + 1][0] if k + 1 < len(rows) else 1 << 62
            inside = (tick >= start) & (tick < stop)
            if name and inside.any():
                found.append((name, inside))
        return found


def slot_names(run: Run) -> list[str]:
    """Return by slot the names of the obstacles that had it, one after another."""
    owners = Slots(run, run.header).owner
    found = []
    for slot in range(run.header.slots):
        names = dict.fromkeys(name for _, name in owners.get(slot, ()) if name)
        found.append(", then ".join(names) or f"slot {slot}")
    return found
