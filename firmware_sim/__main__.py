"""The virtual drives on the bus a robot file names.

python -m firmware_sim configs/panda.toml --scenario scenarios/demo.toml --report report.json
"""

import argparse
import gc
import os
import signal
import sys
import time
import tomllib
from contextlib import suppress
from typing import Any

from firmware_sim.bank_kernels import ALL_READ
from firmware_sim.batch import Batch
from firmware_sim.bus import Bus, open_bus
from firmware_sim.camera import Camera
from firmware_sim.codec import REGISTER_ID
from firmware_sim.drive import NS
from firmware_sim.inject import KINDS
from firmware_sim.kernel import cold
from firmware_sim.reality import plant_table
from firmware_sim.report import Report
from firmware_sim.rover import is_rover, open_rover
from firmware_sim.rover_serve import serve
from firmware_sim.settings import SettingsError
from firmware_sim.simulator import Simulator, open_simulator

# [s] of silence after which lockstep time goes on by itself: a busy machine is silent for less, and a controller that
# misses a reply waits for 2 s (rtctl.app.vehicle.LOCKSTEP_WAIT). Were this shorter, one lost reply would trip them all.
QUIET_S = 3.0
ASLEEP_S = 0.05  # [s] from one period to the next while nobody speaks and every brake is closed
SLIP_NS = 10 * 1_000_000  # a real-time clock that is later than this gives the lost time up
CATCH_UP = 20  # steps in a row before frames are answered: a state of the past would pass for one of now
PRIORITY = 60  # of the real-time scheduler, below the controller's
ORACLE_PERIODS = 5  # between two measurements of clearance in real time: 2.5 mm at 0.5 m/s, and the loop stays free
SELF_EXITS = (signal.SIGTERM, signal.SIGINT)


class Loop:
    """Bus, drives, plant and observers of one run; owns nothing, closes nothing."""

    def __init__(self, simulator: Simulator, bus: Bus, report: Report, camera: Camera | None) -> None:
        self.simulator, self.bus, self.report, self.camera = simulator, bus, report, camera
        self.came, self.replies = Batch(bus.capacity), Batch(2 * bus.capacity)  # an injected fault answers one twice
        self.stop = False
        self.frames = 0
        self.periods = 0
        for number in SELF_EXITS:
            signal.signal(number, self._on_signal)

    def _on_signal(self, *_: object) -> None:
        self.stop = True

    def hear(self) -> None:
        """Take the frames that have come."""
        self.came.count = 0
        self.bus.receive(self.came)
        self.frames += self.came.count

    def say(self) -> None:
        """Send what the drives have answered."""
        self.bus.send(self.replies)
        self.replies.count = 0

    def observe(self, oracle: bool) -> None:
        """Tell everybody who watches how things are at the end of a period."""
        if oracle:
            self.report.observe()
        if self.camera is not None:
            self.camera.tick(self.simulator.plant.time_ns, self.simulator.plant.scene_ns)
        self.report.flush()

    def lockstep(self) -> None:
        """Step one period when every joint has its command; by the wall clock once nobody has spoken for QUIET_S.

        A second command for a joint closes a cycle that others have missed: a lost frame must not stop time.
        """
        simulator, came = self.simulator, self.came
        period = simulator.settings.period_ns / NS
        heard = time.monotonic()
        due = 0.0
        while not self.stop:
            now = time.monotonic()
            quiet = now - heard >= QUIET_S
            self.bus.wait(max(due - now, 0.0) if quiet else QUIET_S - (now - heard))
            self.hear()
            if came.count:
                heard = time.monotonic()
                due = 0.0
            elif quiet and time.monotonic() >= due:
                due = max(due, time.monotonic() - QUIET_S) + (period if self._awake() else ASLEEP_S)
                self._advance()
            at, why = simulator.answer(came, self.replies, 0, clocked=True)
            while why != ALL_READ:
                self._advance()
                at, why = simulator.answer(came, self.replies, at, clocked=True)
            self.say()

    def _awake(self) -> bool:
        """Tell whether a joint may move, or a trip still waits to see it at rest."""
        return any(not d.brake or (d.trips and d.trips[-1].rest < 0) for d in self.simulator.drives)

    def _advance(self) -> None:
        """Send what waits, so that the controller can think meanwhile, then run one period."""
        self.say()
        self.simulator.advance()
        self.periods += 1
        self.observe(oracle=True)

    def realtime(self) -> None:
        """Run the physics on an absolute grid of its own; answer each frame when it comes, with the state of then.

        Steps are taken when a frame comes, and a period late at most where none does: who is spoken to every period is
        woken once in it. Lost time is made up for, but by at most SLIP_NS: in a longer rush the drives' time would pass
        so much faster than the controller's that a moment of its silence would trip their watchdogs. The rest is given
        up and counted. Who watches comes after the answers.
        """
        simulator, plant = self.simulator, self.simulator.plant
        clock = Clock(plant.step_ns, patience=plant.substeps * plant.step_ns)
        started = simulator.started
        looked = 0
        while not self.stop:
            self.bus.wait(clock.left())
            before = self.periods
            for _ in range(CATCH_UP):
                if not clock.due():
                    break
                simulator.step()
                self.periods += clock.steps % plant.substeps == 0
            self.hear()  # now: a cycle's frames come one after the other, and meanwhile they all have
            simulator.answer(self.came, self.replies)
            self.say()
            if simulator.started and not started:  # what was late before does not matter any more
                started = True
                clock.forget()
            if self.periods > before:
                self.report.extra |= clock.account()
                oracle = self.periods >= looked
                looked = self.periods + ORACLE_PERIODS if oracle else looked
                self.observe(oracle)


class Clock:
    """The grid of the physics steps on the wall clock."""

    def __init__(self, step: int, patience: int = 0) -> None:
        """`step` [ns] is the grid's period, `patience` [ns] by how much later than on time a step may be taken."""
        self.step, self.patience = step, patience
        self.next = time.monotonic_ns() + step
        self.steps = self.slipped = self.latest = self.before = 0

    def left(self) -> float:
        """Return the time [s] until the next step must be taken."""
        return max(self.next + self.patience - time.monotonic_ns(), 0) / NS

    def due(self) -> bool:
        """Tell whether it is time for the next step, and if so count it as done."""
        late = time.monotonic_ns() - self.next
        if late < 0:
            return False
        self.latest = max(self.latest, late - self.patience)
        if late > SLIP_NS:
            lost = late // self.step
            self.slipped += lost
            self.next += lost * self.step
        self.next += self.step
        self.steps += 1
        return True

    def forget(self) -> None:
        """Begin the account of lateness anew."""
        self.latest, self.before = 0, self.slipped

    def account(self) -> dict[str, float]:
        """Return the steps given up in all; and since a drive was first enabled the time, and the worst lateness."""
        slipped_s = (self.slipped - self.before) * self.step / NS
        return {"slipped_steps": self.slipped, "slipped_s": slipped_s, "max_late_s": self.latest / NS}


def hasten() -> None:
    """Ask for what keeps a process punctual, and go without where it is refused.

    Drives are hardware: nothing that runs on the machine should make them late. The controller goes first all the same.
    On a single core this process could keep everything else from running, so there it does not ask.
    """
    gc.disable()
    if (os.cpu_count() or 1) > 1:  # of the machine: this process may well be bound to one of them
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def arguments(argv: list[str] | None) -> argparse.Namespace:
    """Return the parsed command line."""
    parser = argparse.ArgumentParser(
        prog="python -m firmware_sim",
        description="Virtual drives and a plant on the bus a robot file names.",
        epilog="example: python -m firmware_sim configs/panda.toml --inject silent@2.0:panda_joint3:0.5. Faults: "
        + "; ".join(f"{k} ({v})" for k, v in KINDS.items()),
    )
    parser.add_argument("config", help="robot file (TOML)")
    parser.add_argument("--scenario", help="obstacles, faults and start of a scenario file (TOML)")
    parser.add_argument("--plant", metavar="FILE", help="how the arm differs from its description: [plant] of a file")
    parser.add_argument("--lockstep", action="store_true", help="time follows the commands instead of the wall clock")
    parser.add_argument("--camera", metavar="SOCKET", help="tell the scenario's obstacles to this control socket")
    parser.add_argument("--report", metavar="FILE", help="JSON of clearances, contacts, trips; renewed twice a second")
    parser.add_argument(
        "--inject", action="append", default=[], metavar="FAULT", help="kind@seconds[:joint[:seconds]], repeatable"
    )
    parser.add_argument(
        "--now", action="store_true", help="start the scenario's clock at once, not when a drive is first enabled"
    )
    parser.add_argument("--seed", type=int, default=0, help="of injected faults that are random")
    return parser.parse_args(argv)


def _scenario(path: str | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        with open(path, "rb") as file:
            scenario = tomllib.load(file)
    except (OSError, ValueError) as error:
        raise SettingsError(f"{path}: {error}") from error
    for table in scenario.get("obstacle", ()):
        if "file" in table:  # relative to the file that names it
            table["file"] = os.path.join(os.path.dirname(os.path.abspath(path)), table["file"])
    return scenario


def run(args: argparse.Namespace) -> None:
    """Open everything, serve until a signal, write the report."""
    scenario = _scenario(args.scenario)
    if args.plant:
        scenario["plant"] = plant_table(args.plant)
    if is_rover(args.config):
        serve(open_rover(args.config, scenario, args.inject, not args.now, args.seed), args.config, args.report)
        return
    if cold():
        print("firmware_sim: compiles its drives, at this first start", file=sys.stderr, flush=True)
    simulator = open_simulator(args.config, scenario, None, args.seed, None, args.inject, wait=not args.now)
    simulator.exact = False  # the report tells the least distances alone
    settings = simulator.settings
    bus = open_bus(settings.interface, settings.channel, [*(r.motor for r in settings.ratings), REGISTER_ID])
    named = {o["name"] for o in scenario.get("obstacle", ())}
    camera = Camera(args.camera, [s for s in simulator.plant.solids if s.name in named]) if args.camera else None
    report = Report(simulator, args.report, "lockstep" if args.lockstep else "realtime")
    loop = Loop(simulator, bus, report, camera)
    gc.collect()
    gc.freeze()
    mode = "lockstep" if args.lockstep else "real time"
    print(f"drives ready on {settings.interface} {bus.name} ({len(simulator.drives)} joints, {mode})", flush=True)
    try:
        if args.lockstep:
            loop.lockstep()
        else:
            hasten()
            loop.realtime()
    finally:
        report.extra |= {"periods": loop.periods, "frames": loop.frames, "bus_dropped": bus.dropped}
        if camera is not None:
            report.extra["camera"] = {"sent": camera.sent, "refused": camera.refused, "refusal": camera.refusal}
            camera.close()
        report.close()
        bus.close()
        simulator.close()


def main(argv: list[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    args = arguments(argv)
    try:
        run(args)
    except SettingsError as error:
        print(f"firmware_sim: {error}", file=sys.stderr)
        return 78
    return 0


if __name__ == "__main__":
    sys.exit(main())
