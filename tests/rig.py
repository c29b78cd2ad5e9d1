"""A controller and its drives as two processes on one bus: started, spoken to, hurt, and read afterwards."""

import json
import math
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from rtctl.hal.client import Session
from rtctl.log import Log, read, segments
from rtctl.protocol import frame, mit
from rtctl.types import State

ROOT = Path(__file__).resolve().parent.parent
PANDA = ROOT / "configs" / "panda.toml"
PATIENCE = 120.0  # [s] for anything to happen; what never happens fails, what is slow does not
COMPILING = 900.0  # [s]
AWAY = [0.45, 0.35, 0.45]  # [m] a goal some 0.4 m from home, nothing in between
BACK = [0.45, -0.35, 0.45]
MOVING = 0.15  # [m/s] a tip at this speed is under way
JOINTS = 7
IDS = range(1, JOINTS + 1)  # of command frames
RCVBUFFORCE = 33  # SO_RCVBUFFORCE of Linux: past the kernel's limit, for root
QUICK = {"self_collision": "false"}  # its preparation takes longer than everything else together


class Heard(NamedTuple):
    """One frame on the bus and when a bystander heard it."""

    at: float  # [s] monotonic
    can_id: int
    data: bytes

    @property
    def command(self) -> bool:
        """Whether it commands a drive."""
        return self.can_id in IDS

    @property
    def stop(self) -> bool:
        """Whether it is the stop frame."""
        return self.command and self.data[:8] == mit.DISABLE


class Tap:
    """A bystander on the bus who writes down every frame, and may speak."""

    def __init__(self, bus: str, can: bool) -> None:
        if can:
            self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            # 14 frames a millisecond fill the kernel's usual buffer in 40 ms, and a busy machine may take that long
            self.socket.setsockopt(socket.SOL_SOCKET, RCVBUFFORCE, 1 << 24)
            self.socket.bind((bus,))
        else:
            self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self.socket.connect(bus)
        self.heard: list[Heard] = []
        self._stop, self._stopped = socket.socketpair()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while True:
            ready = select.select([self._stopped, self.socket], [], [])[0]
            if self.socket not in ready:  # it is told to stop, and has written down all that came before
                return
            try:
                raw = self.socket.recv(80)
            except OSError:  # the interface went down
                raw = b""
            if not raw:
                return
            one = frame.unpack(raw)
            self.heard.append(Heard(time.monotonic(), one.can_id, one.data))

    def commands(self, since: int = 0) -> list[Heard]:
        """Return the commands heard from the frame `since` on."""
        return [one for one in self.heard[since:] if one.command]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.send(b"!")
        self._thread.join()
        for sock in (self.socket, self._stop, self._stopped):
            sock.close()


def config_at(
    folder: Path, changes: Mapping[str, str] | None = None, can: str = "", name: str = "panda", robot: str = "panda"
) -> Path:
    """Write a robot's file with a bus, a console and logs of its own; return its path.

    `can` names a SocketCAN interface instead; `changes` replaces values by key, `{"servo_hz": "500"}`.
    """
    (folder / "run").mkdir(mode=0o700, exist_ok=True)
    bus = {"interface": '"socketcan"', "channel": f'"{can}"'} if can else {"channel": f'"{folder}/bus"'}
    source = PANDA.with_stem(robot)
    text = re.sub(r'(?m)^urdf = "(\w+\.urdf)"', lambda m: f'urdf = "{source.with_name(m[1])}"', source.read_text())
    for key, value in {**bus, **QUICK, "directory": f'"{folder}/logs"', **(changes or {})}.items():
        text, count = re.subn(rf"(?m)^{key} = \S+", f"{key} = {value}", text)
        assert count == 1, key
    path = folder / f"{name}.toml"
    path.write_text(text + f'\n[console]\nsocket = "{folder}/run/{name}.sock"\n')
    return path


class Process:
    """A child with its output in a file: a full pipe must not be part of a test unless it is the test."""

    def __init__(self, command: list[str], output: Path) -> None:
        self.output = output
        with output.open("wb") as file:
            self.popen = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)

    @property
    def text(self) -> str:
        """What it has said so far."""
        return self.output.read_text(errors="replace")

    def expect(self, word: str) -> None:
        """Wait until it has said `word`; the first of all starts compiles the kernels meanwhile."""
        ended = self.popen.poll
        until(lambda: word in self.text or ended() is not None, lambda: f"no {word!r} in: {self.text}", COMPILING)
        assert word in self.text, f"ended with {self.popen.poll()}, without {word!r}: {self.text}"

    def signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        self.popen.send_signal(number)

    def wait(self) -> int:
        """Return the exit code once it has ended."""
        try:
            return self.popen.wait(COMPILING)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running: {self.text}") from None

    def end(self) -> None:
        """See to it that it is gone."""
        if self.popen.poll() is None:
            self.popen.kill()
            self.popen.wait()


class Rig:
    """Controller and drives on a bus; ends both on leaving."""

    def __init__(
        self,
        folder: Path,
        changes: Mapping[str, str] | None = None,
        can: str = "",
        lockstep: bool = True,
        robot: str = "panda",
    ) -> None:
        self.folder, self.can = folder, can
        self.mode = ["--lockstep"] if lockstep else []
        self.config = config_at(folder, changes, can, robot=robot)
        self.console = str(folder / "run" / "panda.sock")
        self.report_path = folder / "report.json"
        self.started: list[Process] = []
        self.plant: Process | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in reversed(self.started):
            process.end()
            print(f"--- {process.output.name}\n{process.text[-4000:]}")  # pytest shows it when the test failed

    def process(self, command: list[str]) -> Process:
        """Start a child that ends with the rig."""
        process = Process(command, self.folder / f"{len(self.started)}.out")
        self.started.append(process)
        return process

    def drives(self, *options: str) -> Process:
        """Start the drives and wait until they listen."""
        command = [sys.executable, "-m", "firmware_sim", str(self.config), *self.mode]
        self.plant = self.process([*command, "--report", str(self.report_path), *options])
        self.plant.expect("drives ready")
        return self.plant

    def launch(self, *options: str) -> Process:
        """Start a controller."""
        return self.process([sys.executable, "-m", "rtctl", "run", str(self.config), *self.mode, *options])

    def controller(self, *options: str) -> Process:
        """Start a controller and wait until it is IDLE."""
        process = self.launch(*options)
        process.expect("rtctl: ready")
        return process

    def ask(self, verb: str, **content: Any) -> dict[str, Any]:
        """Return the controller's reply."""
        with Session(self.console, PATIENCE) as session:
            return session.ask({"verb": verb, **content})

    def status(self) -> dict[str, Any]:
        """Return how things stand."""
        return self.ask("status")

    def reach(self, *states: str) -> dict[str, Any]:
        """Wait for one of the states; return the status that showed it."""
        last: dict[str, Any] = {}

        def there() -> bool:
            last.update(self.status())
            return last["state"] in states

        until(there, lambda: f"waited for {states}, last seen: {last}")
        return last

    def arm(self) -> None:
        """Bring the arm to RUN, holding."""
        reply = self.ask("arm")
        assert reply["ok"], reply
        self.reach("RUN")

    def go(self, position: list[float] | None = None) -> None:
        """Send a goal and wait until the tip is well under way."""
        reply = self.ask("goal", position_m=position or AWAY)
        assert reply["ok"], reply
        until(lambda: self.status()["speed_m_s"] > MOVING, lambda: f"does not move: {self.status()}")

    def under_way(self) -> None:
        """Have the tip under way, whatever state the arm is in: as a patient operator would."""

        def moves() -> bool:
            told = self.status()
            x = told["x_m"]
            match told["state"]:
                case "SAFE_STOP" | "FAULT":
                    self.ask("reset")
                case "IDLE":
                    if not self.ask("arm")["ok"]:
                        self.ask("reset")
                case "RUN" if told["goal_m"] is None or told["status"] == "arrived":
                    self.ask("goal", position_m=max(AWAY, BACK, key=lambda goal: math.dist(goal, x)))
            return told["state"] == "RUN" and told["goal_m"] is not None and told["speed_m_s"] > MOVING

        until(moves, lambda: f"does not move: {self.status()}")

    def sent_away(self) -> Process:
        """Start both, arm, and have the tip under way; return the controller."""
        self.drives()
        controller = self.controller()
        self.arm()
        self.go()
        return controller

    def tap(self) -> Tap:
        """Return a bystander on the bus; use it in a `with`."""
        return Tap(self.can or f"{self.folder}/bus", bool(self.can))

    def report(self) -> dict[str, Any]:
        """Return the drives' report as it stands; written twice a second."""
        if not self.report_path.exists():
            return {}
        return dict(json.loads(self.report_path.read_text()))

    def trips(self, before: int = 0) -> list[dict[str, Any]]:
        """Return the drives' trips, but for those `before`, once every joint has tripped and stands."""

        def new() -> list[dict[str, Any]]:
            return list(self.report().get("trips", ())[before:])

        until(
            lambda: len(new()) >= JOINTS and all(trip["command_to_rest_s"] is not None for trip in new()),
            lambda: f"no rest: {self.report()}",
        )
        return new()

    def end_drives(self) -> dict[str, Any]:
        """End the drives; return their final report."""
        assert self.plant is not None
        self.plant.signal(signal.SIGTERM)
        assert self.plant.wait() == 0, self.plant.text
        return self.report()

    def logs(self) -> list[Path]:
        """Return the log files, oldest first, open ones included."""
        return sorted((self.folder / "logs").glob("*.mcap*"))

    def log(self, index: int = -1) -> Log:
        """Wait until a log is whole; return it."""
        until(lambda: bool(self.logs()) and self.logs()[index].suffix == ".mcap", lambda: f"open: {self.logs()}")
        return read(segments(self.logs()[index])[-1])


def states_of(log: Log) -> list[str]:
    """Return the states that a log went through, in order."""
    seen = [State(s).name for s in log["/tick"].state.tolist()]
    return [s for s, before in zip(seen, ["", *seen[:-1]], strict=True) if s != before]


def until(true: Callable[[], object], why: Callable[[], str], patience: float = PATIENCE) -> None:
    """Wait until something is true; fail with `why()` when it does not become so within `patience` [s]."""
    deadline = time.monotonic() + patience
    while not true():
        assert time.monotonic() < deadline, why()
        time.sleep(0.02)


def stopped(pid: int) -> bool:
    """Return whether a process is stopped by a signal."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
