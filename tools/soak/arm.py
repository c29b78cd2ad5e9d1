"""An arm on a long way: daemon, recorder and drives as processes, judged by the drives, the kernel and the logs."""

import json
import math
import time
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from tools.ordeal.pair import Failed, Pair, descriptors, wait_for
from tools.soak.growth import GROWTH, quarters, resident

GOALS = ((0.50, 0.35, 0.40), (0.50, -0.35, 0.40), (0.55, 0.25, 0.25), (0.40, -0.25, 0.65))  # [m]
TABLE = {"name": "table", "type": "plane", "position_m": [0.0, 0.0, -0.05]}
POST = {"name": "post", "type": "capsule", "radius_m": 0.04, "length_m": 0.5, "position_m": [0.62, 0.10, 0.02]}
WAY = ([1.2, 0.10, 0.42], [0.50, -0.08, 0.42], [0.10, -0.9, 0.42])  # [m] of a ball over the arm's, and back
SPEED, PASSES, REST = 0.25, 60, 30.0  # [m/s]; times in a run; [s] at least from one to the next
TOLERANCE = 0.003  # [m]
PATIENCE = 30.0  # [s] of robot time for a goal
STEP = 60.0  # [s] between lines
SPARE = 3  # descriptors that a daemon may have more than before: a segment, who asks
NAMES = ("daemon", "recorder", "drives")


class Sample(NamedTuple):
    """One minute."""

    memory: tuple[float, ...]  # [MB] of daemon, recorder, drives
    descriptors: int  # of the daemon
    messages: int  # of the log's segments that were closed: read whole and deleted
    goals: int


class Account(NamedTuple):
    """A run."""

    samples: list[Sample]
    missed: int  # slots
    dropped: int  # entries of the log
    late: int  # goals that were not reached, by the plant's account
    contacts: int
    faults: list[str]
    failure: str  # '' for none


def scenario_in(folder: Path, config: Path, minutes: float) -> Path:
    """Write the world of a run; return its path."""
    passes = max(1, min(PASSES, round(60.0 * minutes / REST)))
    ways = [[0.0, *WAY[0]]]
    for k in range(passes):
        at = 60.0 * minutes * (k + 0.5) / passes
        ways.append([at, *WAY[0]])
        for before, point in pairwise((*WAY, WAY[0])):
            at += math.dist(before, point) / SPEED
            ways.append([at, *point])
    ball = {"name": "ball", "type": "sphere", "radius_m": 0.07}
    lines = [f'robot = "{config}"', "duration_s = 3600.0"]  # drives do not end by it
    for table in (TABLE, POST, {**ball, "waypoints": ways}):
        lines += ["[[obstacle]]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    path = folder / "soak_world.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


class Run:
    """Goals one after the other, and what is looked at each minute."""

    def __init__(self, pair: Pair) -> None:
        assert pair.daemon is not None
        assert pair.drives is not None
        self.pair, self.told = pair, pair.status()
        self.pids = (pair.daemon.popen.pid, pair.children()[0], pair.drives.popen.pid)
        self.asked = self.reached = self.late = 0
        self.samples: list[Sample] = []
        self.faults: set[str] = set()
        self.goals_told = self.messages = 0

    def look(self) -> float:
        """Return the daemon's time [s] after taking its account."""
        self.told = self.pair.status()
        self.faults |= set(self.told["faults"])
        if self.told["state"] not in ("ARMED", "RUN"):
            raise Failed(f"{self.told['state']}: {', '.join(self.faults) or 'no fault'}")
        return float(self.told["time_s"])

    def pursue(self, until: float) -> None:
        """Go for the next goal, and be there by the plant's account; not beyond a time [s]."""
        goal = GOALS[self.asked % len(GOALS)]
        answer = self.pair.ask({"verb": "goal", "position_m": goal})
        if not answer.get("ok"):
            raise Failed(f"a goal was refused: {answer}")
        self.asked += 1
        begun = self.look()
        while self.told["time_s"] < min(begun + PATIENCE, until):
            truth = self.pair.later() if self.told["status"] == "arrived" else None
            self.look()
            if truth is not None and self.told["status"] == "arrived":  # and was not pushed away meanwhile
                self.reached += math.dist(truth.tip, goal) < TOLERANCE
                self.late += math.dist(truth.tip, goal) >= TOLERANCE
                return
            time.sleep(0.02)
        self.late += self.told["time_s"] < until

    def sample(self) -> Sample:
        """Take a minute's account; the log's closed segments are read whole, and deleted."""
        self.pair.lossy = self.told["log"]["dropped"] > 0  # which is told; a hole that is not is a failure
        logs = self.pair.logs()[:-1]
        messages = self.pair.are_whole(logs)
        for path in logs:
            path.unlink()
        memory = tuple(resident(pid) for pid in self.pids)
        goals, self.goals_told = self.reached - self.goals_told, self.reached
        self.samples.append(Sample(memory, descriptors(self.pids[0]), messages, goals))
        return self.samples[-1]


def soak(folder: Path, config: Path, minutes: float, realtime: bool) -> Account:
    """Return the account of a run of so many minutes of robot time."""
    pair, run, failure = Pair(folder, config.resolve(), {"segment_s": "20.0"}, realtime), None, ""
    try:
        world = scenario_in(folder, pair.config, minutes)
        pair.start_drives("--scenario", str(world), "--camera", str(folder / "run" / "ordeal.sock"))
        pair.start_daemon()
        run = Run(pair)
        if not (answer := pair.ask({"verb": "arm"})).get("ok"):
            raise Failed(f"arming was refused: {answer}")
        wait_for(lambda: run.look() and run.told["state"] == "RUN", lambda: f"not armed: {run.told}")
        for minute in range(1, max(1, round(minutes)) + 1):
            while run.look() < STEP * minute:
                run.pursue(STEP * minute)
            s = run.sample()
            memory = "  ".join(f"{name} {value:6.1f}" for name, value in zip(NAMES, s.memory, strict=True))
            print(
                f"{minute:4d} min  MB: {memory}  {s.descriptors:3d} open  {s.messages:8d} read  {s.goals:3d} goals",
                flush=True,
            )
    except Failed as error:
        failure = str(error)
    finally:
        truth = pair.truth()
        pair.end()
    told: dict[str, Any] = run.told if run else {}
    samples, late, faults = (run.samples, run.late, sorted(run.faults)) if run else ([], 0, [])
    lost = (int(told.get("missed", 0)), int(told.get("log", {}).get("dropped", 0)))
    return Account(samples, *lost, late, truth.contacts if truth else 0, faults, failure)


def judged(account: Account) -> bool:
    """Print what a run came to; return whether nothing was missed, touched or grew."""
    if account.failure or not account.samples:
        print(f"ended: {account.failure or 'nothing was seen'}")
        return False
    grown = False
    for k, name in enumerate(NAMES):
        before, after = quarters([s.memory[k] for s in account.samples])
        grown |= after - before >= GROWTH
        print(f"{name}: {before:.1f} then {after:.1f} MB")
    opened = quarters([float(s.descriptors) for s in account.samples])
    goals, read = sum(s.goals for s in account.samples), sum(s.messages for s in account.samples)
    print(
        f"{goals} goals, {account.late} not reached, {account.contacts} contacts, {account.missed} slots missed, "
        f"{read} messages read, {account.dropped} dropped, {opened[0]:.1f} then {opened[1]:.1f} descriptors, "
        f"faults: {', '.join(account.faults) or 'none'}"
    )
    lost = account.missed or account.dropped or account.late
    return not (lost or account.contacts or account.faults or grown or opened[1] - opened[0] > SPARE)
