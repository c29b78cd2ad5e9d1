"""Faults on demand, by name and time: what drives, sensors and bus do when they go wrong.

`kind@t[:joint[:duration]]` on the command line, `[[fault]]` tables in a scenario. A joint is a name or an index from 0;
without one the fault holds for every joint. Without a duration, or with 0, it lasts.
"""

import math
import random
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from firmware_sim.drive import NS, Drive
from firmware_sim.drive import Fault as Code
from firmware_sim.settings import SettingsError

KINDS = {
    "drive_fault": "the drive latches an over-current fault",
    "overheat": "the winding is at its trip temperature",
    "hot": "the winding is half way into derating",
    "watchdog": "commands are lost on their way to the drive",
    "silent": "the drive takes commands, its replies are lost",
    "drop": "commands and replies are lost, each with probability 1/2",
    "duplicate": "every reply comes twice",
    "corrupt_crc": "one bit of every reply is flipped",
    "corrupt_command": "one bit of every command is flipped",
    "weak": "the drive gives half the torque it is told, and says nothing of it",
    "stuck_encoder": "the encoder repeats its last position and speed",
    "dead_encoder": "the encoder repeats its last position, the speed that the drive makes of it is 0",
    "false_velocity": "the encoder's speed reads 1 rad/s too high",
    "encoder_jump": "the encoder is off by 0.5 rad",
    "push": "something pushes a link of the arm: link, newton, direction in the world",
    "reboot": "the drive loses its supply for a moment: registers from flash, disabled",
    "foreign": "somebody else tells the drive to give no torque, after each command",
    "error_passive": "the controller's CAN interface is error-passive",
    "bus_off": "the controller's CAN interface is off the bus: it sends nothing and hears nothing",
}
INTERFACE = ("bus_off", "error_passive")  # what befalls the controller's interface, whichever the joint
FOREVER = 1 << 62
JUMP = 0.5  # [rad]
ONCE = frozenset(("drive_fault", "weak", "reboot"))  # done at its time, and over


class Fault(NamedTuple):
    """One fault: what, when [ns], and which joint (-1 = all)."""

    kind: str
    start: int
    end: int
    joint: int
    low: float = -180.0  # [deg] of a range sensor's angles, clockwise from the front
    high: float = 180.0
    value: float = math.nan  # how much, where the kind has a size; of a push [N]
    link: str = ""  # that is pushed at its centre of mass
    direction: tuple[float, ...] = (0.0, 0.0, 1.0)  # (3,) in the world


def _joint(value: Any, names: Sequence[str]) -> int:
    if value in (None, "", -1):
        return -1
    text = str(value)
    k = names.index(text) if text in names else int(text) if text.isdigit() else len(names)
    if k >= len(names):
        raise SettingsError(f"fault: joint {text} is not one of {', '.join(names)}")
    return k


def _fault(kind: str, at_s: float, joint: Any, duration_s: float | None, names: Sequence[str]) -> Fault:
    if kind not in KINDS:
        raise SettingsError(f"fault: {kind} is not one of {', '.join(KINDS)}")
    start = round(at_s * NS)
    end = start + round(duration_s * NS) if duration_s else FOREVER
    return Fault(kind, start, end, _joint(joint, names))


def fault_at(
    kind: str,
    at_s: float,
    duration_s: float | None,
    kinds: Iterable[str],
    angles: tuple[float, float] = (-180.0, 180.0),
    value: float = math.nan,
) -> Fault:
    """Return a fault of the whole machine. SettingsError for a kind that is none of `kinds`."""
    if kind not in kinds:
        raise SettingsError(f"fault: {kind} is not one of {', '.join(kinds)}")
    start = round(at_s * NS)
    return Fault(kind, start, start + round(duration_s * NS) if duration_s else FOREVER, -1, *angles, value)


def faults_of(tables: Iterable[dict[str, Any]], names: Sequence[str]) -> list[Fault]:
    """Return the faults of a scenario's [[fault]] tables."""
    return [_of_table(t, names) for t in tables]


def _of_table(t: dict[str, Any], names: Sequence[str]) -> Fault:
    fault = _fault(t["kind"], float(t["at_s"]), t.get("joint"), t.get("duration_s"), names)
    if fault.kind != "push":
        return fault
    for key in ("link", "newton"):
        if t.get(key) is None:
            raise SettingsError(f"fault: a push wants {key}")
    direction = tuple(map(float, t.get("direction") or (0.0, 0.0, -1.0)))
    size = math.sqrt(sum(d * d for d in direction))
    if size == 0.0:
        raise SettingsError("fault.direction: got 0 0 0, wanted a direction in the world")
    return fault._replace(value=float(t["newton"]), link=str(t["link"]), direction=tuple(d / size for d in direction))


def parse(text: str, names: Sequence[str]) -> Fault:
    """Read `kind@t[:joint[:duration]]`; SettingsError says what would have been right."""
    kind, _, rest = text.partition("@")
    parts = rest.split(":")
    if kind == "push":
        raise SettingsError(f"--inject {text}: a push wants link and newton: give it in a scenario's [[fault]]")
    try:
        duration = float(parts[2]) if len(parts) > 2 else None
        return _fault(kind, float(parts[0]), parts[1] if len(parts) > 1 else None, duration, names)
    except ValueError as error:
        raise SettingsError(f"--inject {text}: wanted kind@seconds[:joint[:seconds]]") from error


class Injector:
    """Holds the faults of a run; reproducible from its seed."""

    def __init__(self, faults: Sequence[Fault], seed: int = 0) -> None:
        self.faults = list(faults)
        self.seed, self.random = seed, random.Random(seed)
        self.done: set[int] = set()
        self.stuck: dict[int, tuple[float, float]] = {}

    def quiet(self, now: int) -> bool:
        """Tell whether nothing is injected at time `now` [ns], nor an encoder to be let go that was stuck until now."""
        if not self.faults:
            return True
        return not self.stuck and not any(
            f.start <= now < f.end and not (k in self.done and f.kind in ONCE) for k, f in enumerate(self.faults)
        )

    def active(self, kind: str, now: int, joint: int) -> bool:
        """Tell whether a fault of this kind holds for a joint at time `now` [ns]."""
        return any(f.kind == kind and f.start <= now < f.end and f.joint in (-1, joint) for f in self.faults)

    def command(self, now: int, joint: int, data: bytes) -> bytes | None:
        """Return what of a command reaches the drive, None if nothing."""
        if not self.faults:
            return data
        if self.active("watchdog", now, joint) or (self.active("drop", now, joint) and self.random.random() < 0.5):
            return None
        return self._flipped(data) if self.active("corrupt_command", now, joint) else data

    def reply(self, now: int, joint: int, data: bytes) -> list[bytes]:
        """Return what of a reply reaches the bus."""
        if not self.faults:
            return [data]
        if self.active("silent", now, joint) or (self.active("drop", now, joint) and self.random.random() < 0.5):
            return []
        if self.active("corrupt_crc", now, joint):
            data = self._flipped(data)
        return [data, data] if self.active("duplicate", now, joint) else [data]

    def interface(self, now: int) -> str:
        """Return which of INTERFACE holds at time `now` [ns], the worst; "" for none."""
        held = (k for k in INTERFACE if any(f.kind == k and f.start <= now < f.end for f in self.faults))
        return next(held, "")

    def _flipped(self, data: bytes) -> bytes:
        bit = self.random.randrange(len(data) * 8)
        return data[: bit // 8] + bytes((data[bit // 8] ^ 1 << bit % 8,)) + data[bit // 8 + 1 :]

    def encoder(self, now: int, joint: int, q: float, qd: float) -> tuple[float, float]:
        """Return what the encoder reads of the true q [rad], qd [rad/s]."""
        if not self.faults:
            return q, qd
        if self.active("stuck_encoder", now, joint):
            return self.stuck.setdefault(joint, (q, qd))
        if self.active("dead_encoder", now, joint):
            return self.stuck.setdefault(joint, (q, 0.0))
        self.stuck.pop(joint, None)
        if self.active("false_velocity", now, joint):
            return q, qd + 1.0
        return (q + JUMP, qd) if self.active("encoder_jump", now, joint) else (q, qd)

    def pushes(self, now: int) -> dict[str, tuple[float, ...]]:
        """Return the forces [N] in the world on links at time `now` [ns], by the links' names."""
        found: dict[str, tuple[float, ...]] = {}
        for f in self.faults:
            if f.kind == "push" and f.start <= now < f.end:
                before = found.get(f.link, (0.0, 0.0, 0.0))
                found[f.link] = tuple(b + f.value * d for b, d in zip(before, f.direction, strict=True))
        return found

    def apply(self, now: int, drives: Sequence[Drive]) -> None:
        """Let the faults that happen inside a drive happen, once each, or for as long as they last where they heat."""
        for k, f in enumerate(self.faults):
            if not f.start <= now < f.end or (k in self.done and f.kind not in ("overheat", "hot")):
                continue
            self.done.add(k)
            for joint, drive in enumerate(drives):
                if f.joint not in (-1, joint):
                    continue
                if f.kind == "drive_fault":
                    drive.trip(Code.OVER_CURRENT)
                elif f.kind == "overheat":
                    drive.temperature = 125.0
                elif f.kind == "hot":
                    drive.temperature = 110.0
                elif f.kind == "weak":
                    drive.strength = 0.5
                elif f.kind == "reboot":
                    drive.boot()
