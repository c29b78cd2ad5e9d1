"""The daemon and its drives as processes, and what is told of them by others than the daemon."""

import ctypes
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader

from rtctl.errors import LinkError
from rtctl.hal.client import Session

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "configs" / "panda.toml"
QUICK = {"self_collision": "false", "segment_s": "10.0", "disk_floor_MB": "1.0"}
PATIENCE = 300.0  # [s] for what must happen; what never does fails, what is slow does not
COMPILING = 3000.0  # [s]
ASK = 120.0  # [s] for an answer
REST = 0.01  # [rad/s]
STILL = 1e-6  # [rad] that a joint with a closed brake may move
STOPPED_WITHIN = 1.0  # [s] of the drives' time from the last command that one took to its joint's rest
NO_LIMIT = resource.RLIM_INFINITY
PIDFD_OPEN, PIDFD_GETFD = 434, 438  # numbers of the system calls


class Failed(Exception):
    """A promise that was not kept."""


class Truth(NamedTuple):
    """What the drives and the plant say of themselves."""

    time: float  # [s] of theirs
    q: list[float]  # [rad]
    tip: list[float]  # [m]
    speed: list[float]  # [rad/s]
    torque: list[float]  # [Nm]
    brake: list[bool]
    trips: list[dict[str, Any]]
    contacts: int
    written: int  # [ns] when

    @property
    def safe(self) -> bool:
        """Whether no motor gives torque, every brake holds and nothing moves."""
        return all(self.brake) and not any(self.torque) and all(abs(v) < REST for v in self.speed)


def wait_for(true: Callable[[], object], what: Callable[[], str], patience: float = PATIENCE) -> None:
    """Wait until something is true. Raises Failed where it does not become so within `patience` [s]."""
    end = time.monotonic() + patience
    while not true():
        if time.monotonic() > end:
            raise Failed(what())
        time.sleep(0.01)


def config_in(folder: Path, source: Path, keys: Mapping[str, str]) -> Path:
    """Write the robot's file with a bus, a console and logs of its own, and other values of keys; return its path."""
    (folder / "run").mkdir(mode=0o700, exist_ok=True)
    text = source.read_text(encoding="utf-8")
    own = {"channel": f'"{folder}/bus"', "directory": f'"{folder}/logs"'}
    for key, value in {**own, **keys}.items():
        text, count = re.subn(rf"(?m)^{key} = \S+", f"{key} = {value}", text)
        assert count == 1, key
    path = folder / "ordeal.toml"
    path.write_text(text + f'\n[console]\nsocket = "{folder}/run/ordeal.sock"\n', encoding="utf-8")
    return path


class Child:
    """A process whose output goes to a file."""

    def __init__(self, command: list[str], output: Path, environment: Mapping[str, str] | None = None) -> None:
        self.output = output
        with output.open("wb") as file:
            self.popen = subprocess.Popen(
                command, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, env=environment
            )

    @property
    def text(self) -> str:
        """What it has said."""
        return self.output.read_text(errors="replace")

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self.popen.poll() is None

    def said(self, word: str) -> None:
        """Wait until it has said a word. Raises Failed where it ends without."""
        there = lambda: word in self.text or not self.alive  # noqa: E731
        wait_for(there, lambda: f"no {word!r} in: {self.text[-500:]}", COMPILING)
        if word not in self.text:
            raise Failed(f"ended with {self.popen.poll()} before {word!r}: {self.text[-800:]}")

    def ended(self) -> int:
        """Return the exit code once it has ended."""
        wait_for(lambda: not self.alive, lambda: f"does not end: {self.text[-500:]}")
        return int(self.popen.returncode)

    def kill(self) -> None:
        """Kill it and wait."""
        self.popen.kill()
        self.popen.wait()


class Pair:
    """A daemon and its drives, in lockstep unless told otherwise."""

    def __init__(
        self, folder: Path, source: Path = SOURCE, keys: Mapping[str, str] = QUICK, realtime: bool = False
    ) -> None:
        """`keys`: other values of keys of the robot's file `source`."""
        self.folder, self.config = folder, config_in(folder, source, keys)
        self.pace = [] if realtime else ["--lockstep"]
        self.environment: Mapping[str, str] | None = None  # of what is started from now on
        self.report = folder / "report.json"
        self.drives: Child | None = None
        self.daemon: Child | None = None
        self.born: set[int] = set()  # children that the daemon had
        self.lossy = False  # whether entries of this daemon's log may be lost
        self.read: set[Path] = set()
        self._number = 0
        self._session: Session | None = None

    # ---- processes

    def _start(self, *command: str) -> Child:
        self._number += 1
        return Child(
            [sys.executable, "-m", *command, *self.pace], self.folder / f"{self._number}.out", self.environment
        )

    def start_drives(self, *more: str) -> None:
        """Start the drives; `more` of their command line."""
        self.report.unlink(missing_ok=True)
        self.drives = self._start("firmware_sim", str(self.config), "--report", str(self.report), *more)
        self.drives.said("drives ready")

    def start_daemon(self) -> None:
        """Start the daemon and wait until it is ready."""
        self.lossy, self._session = False, None
        self.daemon = self._start("rtctl", "run", str(self.config))
        self.daemon.said("rtctl: ready")
        self.children()

    def children(self) -> list[int]:
        """Return the daemon's children, which are remembered."""
        if self.daemon is None or not self.daemon.alive:
            return []
        pid = self.daemon.popen.pid
        found = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        self.born |= set(found)
        return found

    def end(self) -> None:
        """Kill what is left."""
        for child in (self.daemon, self.drives):
            if child is not None and child.alive:
                child.kill()
        for pid in self.born:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    # ---- what is asked

    def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """Return the daemon's answer. Raises Failed where none comes to a caller who calls twice."""
        said = ""
        for _ in range(2):  # a connection may have been closed: after a refusal, or when it broke
            try:
                if self._session is None:
                    self._session = Session(f"{self.folder}/run/ordeal.sock", ASK)
                return self._session.ask(message)
            except LinkError as error:
                self._session, said = None, str(error)
        raise Failed(f"{message}: {said}")

    def status(self) -> dict[str, Any]:
        """Return the daemon's account of itself."""
        return self.ask({"verb": "status"})

    # ---- what others say

    def truth(self) -> Truth | None:
        """Return the drives' account, None before the first."""
        try:
            written = self.report.stat().st_mtime_ns
            told = json.loads(self.report.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        speed, torque, brake = told["speed_rad_s"], told["torque_Nm"], told["brake"]
        at, touched = (told["q_rad"], told["tip_m"]), told["contacts"]
        return Truth(told["time_s"], *at, speed, torque, brake, told["trips"], touched, written)

    def later(self) -> Truth:
        """Return an account that was written after now, twice: the first may have been under way."""
        truth = self.truth()
        for _ in range(2):
            before = truth.written if truth else 0

            def newer(before: int = before) -> bool:
                nonlocal truth
                truth = self.truth()
                return truth is not None and truth.written > before

            wait_for(newer, lambda: "the drives tell nothing")
        assert truth is not None
        return truth

    def becomes_safe(self) -> Truth:
        """Return the drives' account once all are without torque, braked and at rest."""
        last: list[Truth] = []

        def safe() -> bool:
            truth = self.truth()
            last[:] = [truth] if truth else []
            return truth is not None and truth.safe

        self.later()
        wait_for(safe, lambda: f"not at rest without torque: {last}")
        for trip in last[0].trips:
            took = trip["command_to_rest_s"]
            if took is None or took > STOPPED_WITHIN:
                raise Failed(f"a drive that tripped took {took} s to rest: {trip}")
        return last[0]

    def nobody_left(self) -> None:
        """See to it that none of the daemon's processes is left. Raises Failed."""
        wait_for(lambda: not any(map(_lives, self.born)), lambda: f"left: {sorted(filter(_lives, self.born))}")
        self.born.clear()

    def logs(self) -> list[Path]:
        """Return the files of the log, oldest first."""
        return sorted((self.folder / "logs").glob("*.mcap"))

    def are_whole(self, logs: Sequence[Path]) -> int:
        """Read what of the logs was not read before with mcap's own reader; return how many messages. Raises Failed."""
        count = 0
        for path in logs:
            if path in self.read:
                continue
            self.read.add(path)
            numbers: dict[str, int] = {}
            with path.open("rb") as file:
                for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
                    count += 1
                    before, numbers[channel.topic] = numbers.get(channel.topic), message.sequence
                    if before is not None and message.sequence != before + 1 and not self.lossy:
                        raise Failed(f"{path.name}: {channel.topic} goes from {before} to {message.sequence}")
        return count


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def descriptors(pid: int) -> int:
    """Return how many descriptors a process has."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def break_sockets(pid: int, rng: Callable[[list[int]], int]) -> bool:
    """Shut one of a process's connected sockets down from outside, as if the peer had gone; False where none may be."""
    libc = ctypes.CDLL(None, use_errno=True)
    sockets = []
    for entry in os.listdir(f"/proc/{pid}/fd"):
        with suppress(OSError):
            if os.readlink(f"/proc/{pid}/fd/{entry}").startswith("socket:"):
                sockets.append(int(entry))
    handle = libc.syscall(PIDFD_OPEN, pid, 0)
    if handle < 0 or not sockets:
        return False
    try:
        copy = libc.syscall(PIDFD_GETFD, handle, rng(sorted(sockets)), 0)
    finally:
        os.close(handle)
    if copy < 0:
        return False
    with socket.socket(fileno=copy) as theirs, suppress(OSError):
        theirs.shutdown(socket.SHUT_RDWR)
    return True
