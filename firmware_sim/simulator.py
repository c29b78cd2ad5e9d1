"""Drives and plant in lockstep, in the caller's process: the semantics of `rtctl.types.Simulator`.

A call of `exchange` is one servo period: every frame is taken in the order given and answered at once, from the state
the previous period ended in; then drives and plant run one period. A call that carries register frames alone (the
handshake) is answered without any time passing.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_sim import codec
from firmware_sim.drive import NS, Drive, State
from firmware_sim.inject import Injector, faults_of, parse
from firmware_sim.plant import Plant
from firmware_sim.rover import is_rover, open_rover
from firmware_sim.settings import Settings, SettingsError, load
from firmware_sim.shapes import ObstacleEdit, reported, shape_at
from rtctl.protocol import frame

F64 = NDArray[np.float64]


class Truth(NamedTuple):
    """The simulator's own account after a cycle; fields as `rtctl.types.Truth`."""

    time: float
    q: F64
    qd: F64
    tau: F64
    tip: F64
    tip_wxyz: F64
    clearance: dict[str, float]
    self_clearance: float
    contacts: int


class Simulator:
    """A virtual robot on a virtual bus; owns the plant."""

    def __init__(
        self,
        settings: Settings,
        start_q: Sequence[float],
        obstacles: Sequence[dict[str, Any]],
        injector: Injector,
        wait: bool = False,
    ) -> None:
        """`wait`: the scenario's clock (obstacles, faults) stands at 0 until a drive is enabled."""
        self.settings = settings
        self.drives = [Drive(r) for r in settings.ratings]
        self.by_id = {d.rating.motor: k for k, d in enumerate(self.drives)}
        self.plant = Plant(settings, start_q, obstacles)
        self.injector = injector
        self.commanded: set[int] = set()  # joints that got a cyclic frame this period
        self.max_torque = [0.0] * len(self.drives)
        self.started = not wait
        self._steps = 0
        self._shown: set[str] = set()
        self._truth: Truth | None = None
        self._sense()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.plant.time_ns / NS

    def exchange(self, frames: list[bytes]) -> list[bytes]:
        """Take the frames of one servo period, return the replies, advance one period (but for register frames)."""
        replies, cyclic = [], not frames
        for raw in frames:
            reply, register = self.answer(raw)
            cyclic = cyclic or not register
            replies.extend(reply)
        if cyclic:
            self.advance()
        return replies

    def repeats(self, raw: bytes) -> bool:
        """Tell whether a frame commands a joint that has its command of this period already."""
        try:
            f = frame.unpack(raw)
        except ValueError:
            return False
        return self.by_id.get(f.can_id, -1) in self.commanded and not (f.error or f.rtr or f.extended)

    def answer(self, raw: bytes) -> tuple[list[bytes], bool]:
        """Take one frame; return the replies to it and whether it was a register frame."""
        try:
            f = frame.unpack(raw)
        except ValueError:
            return [], False
        if f.error or f.rtr or f.extended:
            return [], False
        if f.can_id == codec.REGISTER_ID:
            return self._register(f), True
        k = self.by_id.get(f.can_id, -1)
        if k < 0 or f.fd != self.settings.fd:
            return [], False
        self.commanded.add(k)
        data = self.injector.command(self.plant.scene_ns, k, f.data)
        reply = self.drives[k].receive(data) if data is not None else None
        return self._sent(k, reply), False

    def _register(self, f: frame.Frame) -> list[bytes]:
        if f.fd != self.settings.fd or len(f.data) < 8:
            return []
        k = self.by_id.get(codec.decode_register(f.data).motor, -1)
        return self._sent(k, self.drives[k].register(f.data)) if k >= 0 else []

    def _sent(self, k: int, reply: bytes | None) -> list[bytes]:
        """Return a drive's reply as frames on the bus, after whatever the injector does to it."""
        if reply is None:
            return []
        can_id = int(self.drives[k].registers[codec.MST_ID])
        fd = self.settings.fd
        payloads = self.injector.reply(self.plant.scene_ns, k, reply)
        return [frame.pack(can_id, p, fd=fd, brs=fd) for p in payloads]

    def advance(self) -> None:
        """Run drives and plant for one servo period."""
        for _ in range(self.plant.substeps):
            self.step()

    def step(self) -> None:
        """Run drives and plant for one physics step; the last one of a period closes it."""
        plant = self.plant
        self.injector.apply(plant.scene_ns, self.drives)
        acts = [d.actuate(plant.step_ns) for d in self.drives]
        plant.step([a.torque for a in acts], [a.drag for a in acts])
        self.started = self.started or any(d.state is State.ENABLED for d in self.drives)
        if self.started:
            plant.scene_ns += plant.step_ns
        self._sense()
        self._steps += 1
        if self._steps % plant.substeps == 0:
            plant.advance_world()
            self.max_torque = [max(m, abs(d.torque)) for m, d in zip(self.max_torque, self.drives, strict=True)]
            self.commanded.clear()
            self._truth = None

    def _sense(self) -> None:
        q, qd = self.plant.q, self.plant.qd
        for k, drive in enumerate(self.drives):
            drive.sense(*self.injector.encoder(self.plant.scene_ns, k, q[k], qd[k]))

    def obstacles(self) -> list[ObstacleEdit]:
        """Return what a perfect camera reports now: every obstacle present, and those that have vanished as cleared."""
        edits: list[ObstacleEdit] = []
        shown: set[str] = set()
        for s in self.plant.solids:
            shape = shape_at(s, self.plant.scene_ns / NS)
            if shape is not None:
                shown.add(s.name)
                edits.append(ObstacleEdit(s.name, reported(s, shape)))
            elif s.name in self._shown:
                edits.append(ObstacleEdit(s.name, None))
        self._shown = shown
        return edits

    def truth(self) -> Truth:
        """Return the plant's true state and clearances; measured once a period, when asked for."""
        if self._truth is None:
            plant = self.plant
            tip, wxyz = plant.tip_pose()
            clearance, own = plant.clearances(), plant.self_clearance()
            tau = np.array([d.torque for d in self.drives])
            self._truth = Truth(
                self.time, np.array(plant.q), np.array(plant.qd), tau, tip, wxyz, clearance, own, len(plant.contacts)
            )
        return self._truth

    def close(self) -> None:
        """Free the plant."""
        self.plant.close()


def open_simulator(
    config_path: str | Path,
    scenario: dict[str, Any] | None = None,
    start_q: Sequence[float] | None = None,
    seed: int = 0,
    control_hz: float | None = None,
    inject: Sequence[str] = (),
    wait: bool = False,
) -> Simulator:
    """Open a virtual robot: the file's drives and static obstacles, plus a scenario's obstacles, faults and start.

    `start_q` [rad] goes before the scenario's start_q_rad, that before the file's home. `seed` drives injected faults
    that are random; nothing else is. `inject` holds further faults as `kind@t[:joint[:duration]]`; with `wait` the
    scenario's clock stands at 0 until a drive is enabled. Raises SettingsError.
    """
    if is_rover(config_path):
        rover: Any = open_rover(config_path, scenario, inject, wait)  # exchange, truth and close: all that is asked
        return rover  # type: ignore[no-any-return]
    settings = load(config_path, control_hz)
    play = scenario or {}
    chosen = start_q if start_q is not None else play.get("start_q_rad") or settings.home
    q = [float(v) for v in chosen]
    if len(q) != len(settings.joints):
        raise SettingsError(f"start_q_rad: {len(q)} values for {len(settings.joints)} joints")
    names = [j.name for j in settings.joints]
    faults = [*faults_of(play.get("fault", ()), names), *(parse(text, names) for text in inject)]
    obstacles = [*settings.obstacles, *play.get("obstacle", ())]
    return Simulator(settings, q, obstacles, Injector(faults, int(play.get("seed", seed))), wait)
