"""The crash campaign: kill -9 at random instants, and a disk that fills, must lose no committed message.

    python -m tools.crash                      # 200 kills of the servo process, of the recorder, of both, by turns
    python -m tools.crash --trials 6 --seed 3
    python -m tools.crash --full               # a file system of 2 MB fills while the arm runs

The servo process is the daemon's own servo on a CAN bus of virtual joints, going from goal to goal past obstacles at
its own rate, with the daemon's recorder. What was committed is read from the ring's first page by a third process;
what arrived is counted by the mcap package's reader. Exit code 1 when anything is missing.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import make_reader

from rtctl import design as cfg
from rtctl.app.arm import ARM
from rtctl.app.arm_link import ArmLink, first_feedback
from rtctl.app.arm_log import header_of
from rtctl.app.arm_scene import ArmTurn
from rtctl.app.daemon import _review
from rtctl.app.servo import Servo
from rtctl.arm.pipe import warm
from rtctl.hal import clock
from rtctl.log import read
from rtctl.log.record import ring as rings
from rtctl.log.record.recorder import Recorder, rescue
from rtctl.types import Command, Drive, Request, State, Verb
from tools.bench_rig import CONFIG, Arm, Bus, request, robot_and_spec

VICTIMS = ("servo", "recorder", "both")
COUNTED = ("/tick", "/can/can0", "/request", "/event")  # a message of these is one entry of the ring
SEGMENT_S = 1.5  # so short that kills meet changes of files, too
RUN_S = (0.02, 2.5)  # [s] from the first tick to the kill
DISK = 2 << 20  # [bytes] of the disk that fills


class Rig:
    """The daemon's servo between a recorder and virtual joints that obey."""

    def __init__(self, folder: Path, **options: Any) -> None:
        robot, spec = robot_and_spec()
        self.bus, self.arm = Bus(spec), Arm(robot)
        header = header_of(cfg.load(CONFIG), CONFIG, robot, self.arm.q)
        self.recorder = Recorder.start(folder, header, **options)
        self.servo = Servo(ARM, robot, ArmLink(spec, self.bus.transport), self.recorder, first_feedback(self.arm.q))
        self.servo.link.write(Command(Drive.DISABLE, np.zeros(robot.n)))
        self._slot = 0

    def turn(self, asked: Request | None = None) -> ArmTurn:
        """Take one turn."""
        self.bus.answer(self.arm.feedback())
        k = self._slot
        turn = self.servo.turn(clock.Slot(k, 0, 0.0), request(self.servo.memory, k) if asked is None else asked)
        self.arm.obey(self.servo.memory, turn.command.drive, turn.command.tau)
        self.recorder.beat(time.monotonic_ns())
        self._slot += 1
        return turn

    def close(self) -> None:
        """Close the log and the bus."""
        self.recorder.close("stopped")
        self.bus.close()


class Trial(NamedTuple):
    """What one kill did."""

    victim: str
    after: float  # [s]
    committed: int  # entries, by the ring's first page
    logged: int  # of these, by mcap's reader over all files
    holes: int  # in the sequence numbers
    doubled: int
    files: int
    problem: str  # '' when all is as it should be


def serve(folder: Path, pipe: int) -> None:
    """Be the servo process: tell ring and recorder, then turn until SIGTERM."""
    rig = Rig(folder / "log", segment_s=SEGMENT_S, folders=[folder])
    ending: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: ending.append(number))
    os.write(pipe, json.dumps([str(rig.recorder.ring_path), rig.recorder.pid]).encode() + b"\n")
    for _ in clock.grid(rig.servo.robot.dt):
        rig.turn()
        if ending:
            break
    rig.close()


def trial(folder: Path, victim: str, after: float, rng: random.Random) -> Trial:
    """Start, kill, recover, count."""
    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        with suppress(BaseException):
            os.close(out)
            serve(folder, into)
            code = 0
        os._exit(code)
    os.close(into)
    with os.fdopen(out) as told:
        ring_path, recorder = json.loads(told.readline())
    ring = rings.attach(Path(ring_path))  # maps the pages: they stay though the file goes
    time.sleep(after)
    victims = {"servo": [child], "recorder": [recorder], "both": [child, recorder]}[victim]
    rng.shuffle(victims)
    for pid in victims:
        os.kill(pid, signal.SIGKILL)
    if victim == "recorder":
        time.sleep(rng.uniform(0.0, 0.2))
        os.kill(child, signal.SIGTERM)
    os.waitpid(child, 0)
    if victim == "both":
        rescue(folder / "log", [folder])
    else:
        _wait_gone(Path(ring_path))
    committed = ring.words[rings.NUMBER] - (ring.words[rings.CLOSED] == 1)
    dropped = ring.words[rings.DROPPED]
    ring.unmap()
    return _judged(folder / "log", victim, after, committed, dropped)


def _wait_gone(path: Path, timeout: float = 60.0) -> None:
    until = time.monotonic() + timeout
    while path.exists():
        if time.monotonic() > until:
            return
        time.sleep(0.01)


def counted(path: Path) -> Iterator[tuple[str, int]]:
    """Yield topic and sequence number of every message, by mcap's own reader with checksums."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            yield channel.topic, message.sequence


def _judged(folder: Path, victim: str, after: float, committed: int, dropped: int) -> Trial:
    numbers: dict[str, list[int]] = {}
    problems = [f"{path.name} left" for path in folder.glob("*.open")]
    files = sorted(folder.glob("*.mcap"))
    for path in files:
        here: Counter[str] = Counter()
        for topic, number in counted(path):
            here[topic] += 1
            numbers.setdefault(topic, []).append(number)
        ours = {topic: n for topic, (n, _, _) in read(path).counts.items()}
        if ours != dict(here):
            problems.append(f"{path.name}: {ours}, another reader finds {dict(here)}")
    rows = [numbers.get(topic, []) for topic in COUNTED]
    logged = sum(len(row) for row in rows)
    holes = sum(max(row, default=0) - len(set(row)) for row in rows)
    doubled = sum(len(row) - len(set(row)) for row in rows)
    if logged < committed or holes or doubled or dropped:
        problems.append(f"{committed} committed, {logged} logged, {holes} holes, {doubled} doubled, {dropped} dropped")
    return Trial(victim, after, committed, logged, holes, doubled, len(files), "; ".join(problems))


def campaign(trials: int, seed: int, say: Any = print) -> list[Trial]:
    """Return the trials, victims by turns, instants at random."""
    rng = random.Random(seed)
    robot, _ = robot_and_spec()
    warm(robot)
    done = []
    for k in range(trials):
        with tempfile.TemporaryDirectory(prefix="rtctl-crash-") as name:
            one = trial(Path(name), VICTIMS[k % 3], rng.uniform(*RUN_S), rng)
        done.append(one)
        say(
            f"{k + 1:4d}  kill -9 {one.victim:8s} after {one.after:5.3f} s: {one.committed:6d} committed, "
            f"{one.logged:6d} in {one.files} files  {one.problem or 'ok'}"
        )
    return done


def fill(folder: Path) -> dict[str, Any]:
    """Return what happens when the disk of `folder` is full: the arm goes on, the file is whole, arming is refused."""
    robot, _ = robot_and_spec()
    warm(robot)
    with tempfile.TemporaryDirectory(prefix="rtctl-full-") as name:
        rig = Rig(folder, folders=[Path(name)], floor_bytes=0)
        full = -1
        for k in range(200_000):
            rig.turn()
            if k % 50 == 0:
                time.sleep(0.002)  # as the real grid would: the recorder gets its turn
                _review(rig.servo, rig.recorder)
            if full < 0 and rig.servo.flags and rig.servo.memory.state == State.RUN:
                full = k
            if full >= 0 and k >= full + 500:
                break
        went_on = rig.servo.memory.state == State.RUN
        before = rig.servo.memory.tick
        rig.turn(Request(Verb.DISARM))
        for _ in range(5000):
            if rig.turn(Request()).record["state"][0] == State.IDLE:
                break
        rig.turn(Request(Verb.ARM))
        refusal, state = rig.servo.memory.refusal, rig.servo.memory.state.name
        stats = rig.recorder.stats()
        rig.close()
    files = sorted(folder.glob("*.mcap"))
    return {
        "tick_when_full": full,
        "tick_after": before,
        "went_on": went_on,
        "arming": refusal,
        "state": state,
        "lost": stats.lost,
        "files": [path.name for path in files],
        "open": [path.name for path in folder.glob("*.open")],
        "bytes": sum(path.stat().st_size for path in files),
        "complete": all(read(path).complete for path in files),
        "ticks": [n for path in files for topic, n in counted(path) if topic == "/tick"],
        "reason": str(read(files[-1]).sentinel.get("reason")) if files else "",
    }


def no_small_disk() -> str:
    """Return why a file system of its own cannot be had, '' when it can."""
    command = ["unshare", "-rm", "mount", "-t", "tmpfs", "-o", f"size={DISK}", "none", tempfile.gettempdir()]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        return f"unshare: {error.strerror}"
    return "" if done.returncode == 0 else f"unshare -rm mount -t tmpfs: {done.stderr.strip() or 'failed'}"


def fill_small_disk() -> dict[str, Any]:
    """Run `fill` on a tmpfs of 2 MB in a mount namespace of its own. Raises RuntimeError where none can be had."""
    with tempfile.TemporaryDirectory(prefix="rtctl-disk-") as disk:
        mount = f'mount -t tmpfs -o size={DISK} none "$0" && exec "$@"'
        command = ["unshare", "-rm", "sh", "-c", mount, disk, sys.executable, "-m", "tools.crash", "--fill", disk]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"unshare -rm with a tmpfs: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def main(arguments: list[str] | None = None) -> int:
    """Run the campaign; exit code 1 when a message is missing."""
    parser = argparse.ArgumentParser(
        prog="tools.crash", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--full", action="store_true", help="fill a file system of 2 MB instead")
    parser.add_argument("--fill", metavar="FOLDER", default="", help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.fill:
        print(json.dumps(fill(Path(chosen.fill))))
        return 0
    if chosen.full:
        found = fill_small_disk()
        print(json.dumps({**found, "ticks": len(found["ticks"])}, indent=2))
        return 0 if found["went_on"] and found["complete"] and found["state"] == "IDLE" else 1
    done = campaign(chosen.trials, chosen.seed, lambda text: print(text, flush=True))
    bad = [one for one in done if one.problem]
    committed = sum(one.committed for one in done)
    print(f"{len(done)} kills, {committed} messages committed, {len(bad)} trials lost any")
    return 1 if bad else 0


if __name__ == "__main__":
    with closing(sys.stdin):
        sys.exit(main())
