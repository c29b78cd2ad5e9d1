"""An operator's verbs from a page: the daemon's own console judges each, and what it refuses is what the page says."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rtctl.errors import RtctlError
from rtctl.hal import client
from rtctl.plain import Json
from rtctl.types import F64

LOCKED = "The page is read-only. Unlock it first."
NO_CONSOLE = "Nothing here takes commands: this is a record."
OWN = "view_"  # before the names of obstacles that a page adds
PERIOD = 0.2  # [s] between two places of what is being dragged


class Answer(NamedTuple):
    """What became of a command."""

    ok: bool
    text: str


class Operator:
    """Asks one daemon's console; refuses everything but a stop until it is unlocked."""

    def __init__(self, socket: Callable[[], str] | None) -> None:
        """`socket` finds the control socket, or raises RtctlError; None: nothing takes commands."""
        self._socket = socket
        self.unlocked = False
        self._count = 0

    @property
    def can_ask(self) -> bool:
        """Return whether there is anybody to ask."""
        return self._socket is not None

    def verb(self, name: str) -> Answer:
        """Ask for a verb of the console. A stop needs no unlocking: whoever sees the need may ask."""
        return self._ask({"verb": name}, f"{name}: accepted", always=name == "stop")

    def hold(self, place: F64, is_base: bool) -> Answer:
        """Ask to stay here: an arm by its verb; a base, which has none, by a goal where it is now."""
        message: Json = {"verb": "goal", "position_m": _rounded(place)} if is_base else {"verb": "hold"}
        return self._ask(message, "hold: accepted")

    def goal(self, place: F64, keeps_orientation: bool) -> Answer:
        """Ask to go to a place (3,) [m]."""
        message: Json = {"verb": "goal", "position_m": _rounded(place)}
        if keeps_orientation:
            message["hold"] = "orientation"
        return self._ask(message, f"goal {' '.join(f'{v:.3f}' for v in place)}: accepted")

    def new_name(self) -> str:
        """Return a name for an obstacle that the page adds."""
        self._count += 1
        return f"{OWN}{self._count}"

    def obstacle(self, name: str, kind: str, size: float, place: F64) -> Answer:
        """Ask to set a sphere or box; size [m]: its radius or half its side."""
        own = {"radius_m": size} if kind == "sphere" else {"size_m": [2.0 * size] * 3}
        shape = {"name": name, "type": kind, **own, "position_m": _rounded(place)}
        return self._ask({"verb": "obstacle", "set": shape}, f"obstacle {name}: set")

    def clear(self, name: str) -> Answer:
        """Ask to forget an obstacle."""
        return self._ask({"verb": "obstacle", "clear": name}, f"obstacle {name}: cleared")

    def _ask(self, message: Json, done: str, always: bool = False) -> Answer:
        if self._socket is None:
            return Answer(False, NO_CONSOLE)
        if not self.unlocked and not always:
            return Answer(False, LOCKED)
        try:
            reply = client.ask(self._socket(), message)
        except RtctlError as error:
            return Answer(False, str(error))
        if reply.get("ok") is True:
            return Answer(True, str(reply.get("text") or done))
        return Answer(False, f"refused: {reply.get('error', 'without a reason')}")


def beside(place: F64, heading: float | None) -> F64:
    """Return where (3,) [m] a new obstacle is put: clear of the robot, ahead of a base, outwards of a tip."""
    if heading is not None:
        return np.asarray(place + 2.0 * np.array([math.cos(heading), math.sin(heading), 0.0]))
    flat = np.array([place[0], place[1], 0.0])
    away = flat / (np.linalg.norm(flat) or 1.0) if flat.any() else np.array([1.0, 0.0, 0.0])
    return np.asarray(place + 0.25 * away)


def _rounded(place: Sequence[float] | F64) -> list[float]:
    return [round(float(v), 4) for v in place]
