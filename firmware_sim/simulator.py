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

from firmware_sim.bank import Bank
from firmware_sim.batch import CAPACITY, Batch
from firmware_sim.cells import LARGEST, TORQUE
from firmware_sim.drive import NS
from firmware_sim.gripper import Finger
from firmware_sim.inject import Injector, faults_of, parse
from firmware_sim.plant import Plant
from firmware_sim.reality import Reality, braked, reality_of
from firmware_sim.rover import is_rover, open_rover
from firmware_sim.settings import Settings, SettingsError, load
from firmware_sim.shapes import ObstacleEdit, reported, shape_at
from firmware_sim.traffic import Traffic
from firmware_sim.wire import Wire, of_registers

F64 = NDArray[np.float64]
REPLIES = 2 * CAPACITY  # to a batch of frames: an injected fault answers one twice


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
        reality: Reality | None = None,
    ) -> None:
        """`wait`: the scenario's clock (obstacles, faults) is 0 until a drive is enabled; `reality`: see `Plant`."""
        self.settings = settings
        self.reality = reality_of({}, settings) if reality is None else reality
        rows = zip(settings.ratings, braked(self.reality), strict=True)
        self.bank = Bank([r if brake else r._replace(release_ns=0) for r, brake in rows], settings.fd)
        self.drives = self.bank.drives
        self.injector = injector
        real = self.reality
        traffic = Traffic(real.reply_loss, real.reply_late, real.talkers, settings.fd, injector.seed)
        self.fingers = [Finger(setting, real.gripper_thing) for setting in settings.grippers]
        self.wire = Wire(self.bank, injector, settings.fd, traffic, [finger.drive for finger in self.fingers])
        self.plant = plant_of(settings, start_q, obstacles, self.reality)
        self.started = not wait
        self.exact = True  # whether every truth tells exact clearances; else their least over the run alone are exact
        self._size = frozenset((self.bank.size,))
        self._came, self._replies = Batch(CAPACITY, self.bank.size), Batch(REPLIES, self.bank.size)
        self._steps = 0
        self._pushes = any(f.kind == "push" for f in injector.faults)
        self.plant.push({f.link: (0.0, 0.0, 0.0) for f in injector.faults if f.kind == "push"})  # they are links
        self._shown: set[str] = set()
        self._truth: Truth | None = None
        self._sense()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.plant.time_ns / NS

    @property
    def max_torque(self) -> list[float]:
        """Largest torque of each drive at the end of a period so far [Nm]."""
        largest: list[float] = self.bank.f[:, LARGEST].tolist()
        return largest

    def exchange(self, frames: list[bytes]) -> list[bytes]:
        """Take the frames of one servo period, return the replies, advance one period (but for register frames)."""
        if len(frames) <= CAPACITY and self._size.issuperset(map(len, frames)):
            self._came.load(frames)
            self._replies.count = 0
            self.answer(self._came, self._replies)
            said = self._replies.unload()
        else:
            said = [reply for raw in frames for reply in self.wire.answer_one(self.plant.scene_ns, raw)]
        if not frames or not all(map(of_registers, frames)):
            self.advance()
        return said

    def answer(self, came: Batch, replies: Batch, first: int = 0, clocked: bool = False) -> tuple[int, int]:
        """Take a batch of frames from `first` on, see `Wire.answer`."""
        return self.wire.answer(self.plant.scene_ns, came, replies, first, clocked)

    def advance(self) -> None:
        """Run drives and plant for one servo period."""
        for _ in range(self.plant.substeps):
            self.step()

    def step(self) -> None:
        """Run drives and plant for one physics step; the last one of a period closes it."""
        plant, bank = self.plant, self.bank
        if not self.injector.quiet(plant.scene_ns):
            self.injector.apply(plant.scene_ns, self.drives)
        if self._pushes:
            plant.push(self.injector.pushes(plant.scene_ns))
        enabled = bank.actuate(plant.step_ns)
        plant.step(bank.torque.tolist(), bank.drag.tolist())
        for finger in self.fingers:
            finger.step(plant.step_ns)
        self.started = self.started or enabled
        if self.started:
            plant.scene_ns += plant.step_ns
        self._sense()
        self._steps += 1
        if self._steps % plant.substeps == 0:
            plant.advance_world()
            bank.close_period()
            self._truth = None

    def _sense(self) -> None:
        now = self.plant.scene_ns
        q, qd = self.plant.joints.read(self.plant.q, self.plant.qd)
        if self.injector.quiet(now):
            self.bank.sense(q, qd)
            return
        for k, drive in enumerate(self.drives):
            drive.sense(*self.injector.encoder(now, k, q[k], qd[k]))

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
            clearance, own = plant.clearances(self.exact), plant.self_clearance(self.exact)
            tau = self.bank.f[:, TORQUE].copy()
            self._truth = Truth(
                self.time, np.array(plant.q), np.array(plant.qd), tau, tip, wxyz, clearance, own, len(plant.contacts)
            )
        return self._truth

    def close(self) -> None:
        """Free the plant."""
        self.plant.close()


def plant_of(
    settings: Settings, start_q: Sequence[float], obstacles: Sequence[dict[str, Any]], reality: Reality
) -> Plant:
    """Return the arm and its world in the engine that `[plant]` asks for. Raises SettingsError, also without it."""
    if reality.engine != "mujoco":
        return Plant(settings, start_q, obstacles, reality)
    try:
        from firmware_sim.second import SecondPlant
    except ModuleNotFoundError as error:
        raise SettingsError(f'plant.engine: {error}; pip install "rtctl[sim]"') from error
    return SecondPlant(settings, start_q, obstacles, reality)


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
        of_what = int((scenario or {}).get("seed", seed))
        rover: Any = open_rover(
            config_path, scenario, inject, wait, of_what
        )  # exchange, truth, close: all that is asked
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
    reality = reality_of(play.get("plant") or {}, settings)
    return Simulator(settings, q, obstacles, Injector(faults, int(play.get("seed", seed))), wait, reality)
