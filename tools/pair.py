"""Drives and controller as two processes on one bus, for one run: started, listened to, ended in order."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from rtctl import design as cfg
from rtctl.errors import RtctlError

START_S = 600.0  # [s] for a process to be ready: the first ever compiles every kernel
END_S = 300.0  # [s] for a process to end: the controller waits for its log
POLL = 0.05  # [s] between two looks at the controller


class Cores(NamedTuple):
    """Where the processes of a run in real time have their place."""

    controller: int
    others: frozenset[int]  # drives, player


def placed() -> Cores | None:
    """Return a core for the controller alone and those for the rest, None where there is one core for all.

    The last one: interrupts and whatever else runs prefer the first.
    """
    *others, last = sorted(os.sched_getaffinity(0))
    return Cores(last, frozenset(others)) if others else None


class DemoError(RtctlError):
    """The demo cannot be played."""


class Child:
    """A process whose output is shown line by line, and kept in a file.

    The file is written here: a process that drives an arm should not wait for a disk.
    """

    def __init__(self, name: str, command: list[str], output: Path) -> None:
        self.name = name
        self._file = output.open("wb")
        self._rest = b""
        self._last = "without a word"
        self.popen = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for the demo, which ends both in order
        )
        assert self.popen.stdout is not None
        self._pipe = self.popen.stdout
        os.set_blocking(self._pipe.fileno(), False)

    def lines(self) -> list[str]:
        """Return the whole lines it has printed since the last call."""
        data = bytearray(self._rest)
        while chunk := self._pipe.read(1 << 16):
            data += chunk
            self._file.write(chunk)
        *whole, self._rest = bytes(data).split(b"\n")
        lines = [line.decode(errors="replace") for line in whole]
        self._last = next((line for line in reversed(lines) if line.strip()), self._last)
        return lines

    def expect(self, word: str) -> list[str]:
        """Wait until it has printed `word`; return all lines. Raises DemoError when it ends or takes too long."""
        deadline = time.monotonic() + START_S
        seen: list[str] = []
        while not any(word in line for line in seen):
            code = self.popen.poll()
            new = self.lines()
            seen += new
            if not new and (code is not None or time.monotonic() > deadline):
                how = "is not ready" if code is None else f"ended with exit code {code}"
                raise DemoError(f"{self.name} {how}: {self._last}")
            time.sleep(0.0 if new else POLL)
        return seen

    def close(self) -> None:
        """Close pipe and file of a process that has ended."""
        self._pipe.close()
        self._file.close()

    def end(self, patience: float = END_S) -> int:
        """Ask it to end; return its exit code, negative when it had to be killed."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGTERM)
        try:
            return self.popen.wait(patience)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            return self.popen.wait()


class Pair:
    """Drives and controller, started for one run in a folder; leaving ends both, the controller first."""

    def __init__(self, config: Path, scenario: Path, folder: Path, lockstep: bool) -> None:
        self.config, self.scenario, self.folder = config, scenario, folder
        self.mode = ["--lockstep"] if lockstep else []
        loaded = cfg.load(config)
        self.console, self.rate = loaded.console.socket or "", loaded.loop.servo_hz
        self.cores = None if lockstep else placed()
        self.report_file = folder / "report.json"
        self.report_file.unlink(missing_ok=True)
        self.drives: Child | None = None
        self.controller: Child | None = None
        self.exits: dict[str, int] = {}
        self.children: list[Child] = []
        self.said: list[str] = []  # not yet shown

    def __enter__(self) -> Self:
        python = [sys.executable, "-m"]
        options = ["--scenario", str(self.scenario), "--camera", self.console, "--report", str(self.report_file)]
        try:
            command = [*python, "firmware_sim", str(self.config), *self.mode, *options]
            self.drives = self.start("drives", command)
            if self.cores is not None:  # their clock must not wait for the controller, nor it for them
                os.sched_setaffinity(self.drives.popen.pid, self.cores.others)
            self.said += self.drives.expect("drives ready")
            command = [*python, "rtctl", "run", str(self.config), *self.mode]
            self.controller = self.start("controller", command)
            self.said += self.controller.expect("rtctl: ready")
        except BaseException:
            self.end()
            raise
        return self

    def start(self, name: str, command: list[str]) -> Child:
        """Start a child that ends with the pair."""
        child = Child(name, command, self.folder / f"{name}.out")
        self.children.append(child)
        return child

    def lines(self) -> list[str]:
        """Return what the controller has printed since the last call."""
        if self.drives is not None:
            self.drives.lines()  # a full pipe would hold it up
        said, self.said = self.said, []
        return said if self.controller is None else said + self.controller.lines()

    def end(self) -> None:
        """End both and note their exit codes and last words; the controller first, while its drives still answer."""
        for child in reversed(self.children):
            self.exits[child.name] = child.end()
            self.said += child.lines()
            child.close()
        self.children.clear()
        self.controller = self.drives = None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def report(self) -> dict[str, Any]:
        """Return the drives' account as it stands."""
        try:
            return dict(json.loads(self.report_file.read_text()))
        except FileNotFoundError:
            return {}


def working_copy(source: Path, target: Path, changes: Mapping[str, Mapping[str, str | int | None]]) -> None:
    """Write a config with the strings and numbers in `changes` [table][key] replaced, comments and all else kept.

    Raises DemoError when the file is written in a way that this cannot change.
    """
    text = source.read_text(encoding="utf-8")
    for table, values in changes.items():
        for key, value in values.items():
            line = "" if value is None else f"{key} = {json.dumps(value)}\n"
            head = re.search(rf"(?m)^\[{table}\][^\n]*\n", text)
            if head is None:
                text += f"\n[{table}]\n{line}" if line else ""
                continue
            rest = text[head.end() :]
            stop = re.search(r"(?m)^\[", rest)
            body, tail = (rest, "") if stop is None else (rest[: stop.start()], rest[stop.start() :])
            text = text[: head.end()] + line + re.sub(rf"(?m)^{key} *=[^\n]*\n", "", body) + tail
    wanted = tomllib.loads(source.read_text(encoding="utf-8"))
    for table, values in changes.items():
        entries = wanted.setdefault(table, {})
        for key, value in values.items():
            entries.pop(key, None)
            if value is not None:
                entries[key] = value
    try:
        as_wanted = tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        as_wanted = False
    if not as_wanted:
        raise DemoError(f"{source}: its tables {', '.join(changes)} are written in a way that a copy cannot change")
    target.write_text(text, encoding="utf-8")
