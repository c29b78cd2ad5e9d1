"""Type what stands in docs/tutorial.md, as a newcomer with a description of an arm of his own does, and time it.

    python -m tools.tutorial                    from `git clone` on, into a folder that is new, at a home that is empty
    python -m tools.tutorial --here             without step 1: in this checkout, with what is installed

Commands that do not end (drives, daemon, view) get a terminal each and are ended by Ctrl-C with their step. A browser
without a screen opens what the pages ask it to. A step in which the machine was too busy for real time is done again
with --lockstep, as the page says, and that is told. Exit status 0 when every command did what the tutorial says.
"""

import argparse
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tools.browser import DRAWS, Browser, missing

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tutorial.md"
OWN = "my_arm.urdf"  # the reader's, in the tutorial's words
LIKE = "z1_description/urdf/z1.urdf"  # it is played by: of example-robot-data
READY = {
    "firmware_sim": "drives ready",
    "rtctl run": "rtctl: ready",
    "--view": "the scenario begins",
    "rtctl view": "http://",
}
REALTIME = ("firmware_sim", "rtctl run")  # in their commands: what --lockstep may stand behind
BUSY = ("feedback_lost", "feedback_stale", "deadline")  # what a machine that is too busy is told by
SCENE = """(() => {
  const small = document.createElement("canvas");
  small.width = small.height = 96;
  small.getContext("2d").drawImage(document.querySelector("canvas[data-engine]"), 0, 0, 96, 96);
  return small.toDataURL();
})()"""  # a small picture of the page's 3D scene
PATIENCE = 3000.0  # [s] for one command


class Step(NamedTuple):
    """A section of the tutorial."""

    title: str
    commands: list[str]


def steps(text: str) -> list[Step]:
    """Return the numbered sections of a page and the commands in them: indented lines after an empty one."""
    found: list[Step] = []
    block = False
    for before, line in zip(["", *text.splitlines()], text.splitlines(), strict=False):
        if line.startswith("## "):
            found.append(Step(line[3:], []))
        block = line.startswith("    ") and (block or not before)
        if block and found:
            found[-1].commands.append(line.strip())
    return [step for step in found if re.match(r"\d", step.title)]


def ready_word(command: str) -> str:
    """Return what a command that does not end says when it is ready, '' for one that ends."""
    return next((word for part, word in READY.items() if part in command), "")


def lockstep(command: str) -> str:
    """Return a command as the page says it for a busy machine: of drives and daemon time waits for whoever is late."""
    return f"{command} --lockstep" if any(part in command for part in REALTIME) else command


class Terminal:
    """A shell of its own and what it said."""

    def __init__(self, folder: Path, number: int, before: str, environment: dict[str, str]) -> None:
        self.output, self._done = folder / f"terminal{number}.txt", 0
        with self.output.open("wb") as file:
            self.shell = subprocess.Popen(
                ["bash"],
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )
        self._type(before)

    def _type(self, text: str) -> None:
        assert self.shell.stdin is not None
        self.shell.stdin.write(text.encode() + b"\n")
        self.shell.stdin.flush()

    @property
    def said(self) -> str:
        """What it has said."""
        return self.output.read_text(errors="replace")

    def run(self, command: str) -> int:
        """Type a command; return its exit code once it has ended."""
        self._done += 1
        self._type(f'{command}\necho "<{self._done}:$?>"')
        return int(self._wait(rf"<{self._done}:(\d+)>"))

    def begin(self, command: str, word: str) -> None:
        """Type a command that does not end; return when it says a word. Raises TimeoutError."""
        self._type(f"{command}\nexit")
        self._wait(f"({re.escape(word)})")

    def _wait(self, pattern: str) -> str:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            if match := re.search(pattern, self.said):
                return match.group(1)
            if self.shell.poll() is not None:
                break
            time.sleep(0.05)
        raise TimeoutError(f"no {pattern} in: {self.said[-800:]}")

    def end(self) -> None:
        """Press Ctrl-C and close it."""
        if self.shell.poll() is None:
            os.killpg(self.shell.pid, signal.SIGINT)
            time.sleep(0.2)
            assert self.shell.stdin is not None
            self.shell.stdin.close()
        try:
            self.shell.wait(60)
        except subprocess.TimeoutExpired:
            os.killpg(self.shell.pid, signal.SIGKILL)
            self.shell.wait()


class Reader:
    """Who follows the tutorial."""

    def __init__(self, folder: Path, here: bool, browser: Browser) -> None:
        self.folder, self.place, self.browser = folder, folder / "rtctl", browser
        if here:  # what it writes is not for the checkout
            self.place.mkdir()
            for name in ("configs", ".venv"):
                (self.place / name).symlink_to(ROOT / name)
        self.opened = folder / "opened.txt"
        told = folder / "browser"
        told.write_text(f'#!/bin/sh\necho "$1" >> {self.opened}\n', encoding="utf-8")
        told.chmod(0o755)
        self.environment = {**os.environ, "BROWSER": str(told)}
        for name in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "PYTHONDONTWRITEBYTECODE"):
            self.environment.pop(name, None)
        if not here:  # nothing is compiled yet, nothing was fetched
            (folder / "home").mkdir()
            self.environment["HOME"] = str(folder / "home")
        self.terminals: list[Terminal] = []

    def follow(self, step: Step) -> None:
        """Do a step, again in lockstep where the machine is too busy.

        Raises AssertionError where a command fails or a page does not come.
        """
        try:
            self._type(step.commands, first=step.title.startswith("1"))
        except AssertionError as error:
            if not any(part in command for command in step.commands for part in REALTIME):
                raise
            if not any(fault in str(error) for fault in BUSY):
                raise
            print(
                f"    this machine is too busy for it ({error}): again, as the page says, with --lockstep", flush=True
            )
            self.close()
            self._type([lockstep(command) for command in step.commands], first=False)
        self.close()

    def close(self) -> None:
        """Press Ctrl-C in every terminal, the last one first, and close them."""
        for terminal in reversed(self.terminals):
            terminal.end()
        self.terminals.clear()

    def _type(self, commands: list[str], first: bool) -> None:
        """Type commands. Raises AssertionError where one fails or a page does not come."""
        if any(OWN in command for command in commands):
            shutil.copy(_described(self.place), self.place / OWN)
        main = self._terminal(first)
        for command in commands:
            command = command.replace("URL-OF-THE-REPOSITORY", str(ROOT))
            print(f"    {command}", flush=True)
            if word := ready_word(command):
                pages = self._pages()
                self._terminal().begin(command, word)
                if "view" in command:
                    self._seen(pages, moves="--view" in command)
            elif code := main.run(command):
                raise AssertionError(f"{command}: exit code {code}: {main.said[-800:]}")

    def _terminal(self, first: bool = False) -> Terminal:
        before = f"cd {shlex.quote(str(self.folder))}" if first else f"cd {self.place} && . .venv/bin/activate"
        number = len(list(self.folder.glob("terminal*.txt")))
        self.terminals.append(Terminal(self.folder, number, before, self.environment))
        return self.terminals[-1]

    def _pages(self) -> list[str]:
        return self.opened.read_text().split() if self.opened.exists() else []

    def _seen(self, before: list[str], moves: bool) -> None:
        """Look at the page that the browser was sent to: a scene is drawn, and changes where something moves."""
        until = time.monotonic() + PATIENCE
        while len(self._pages()) <= len(before):
            if time.monotonic() > until:
                raise AssertionError("no page was opened")
            time.sleep(0.05)
        self.browser.go(self._pages()[-1])
        self.browser.wait("""document.querySelector("canvas[data-engine]") !== null""")
        self.browser.drawn()
        first = self.browser.run(f"return {SCENE}")
        while moves and self.browser.run(f"return {SCENE}") == first:
            if time.monotonic() > until:
                raise AssertionError("nothing moves in the page")
            time.sleep(0.5)
        self.browser.go("about:blank")


def _described(place: Path) -> Path:
    found = sorted((place / ".venv").resolve().rglob(LIKE))
    if not found:
        raise AssertionError(f"{place}: no {LIKE}, which plays the reader's arm")
    return found[0]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.tutorial", description="The tutorial, typed and timed.")
    parser.add_argument("--here", action="store_true", help="in this checkout, without step 1")
    args = parser.parse_args(argv)
    if lacking := missing():
        parser.error(lacking)
    with Browser(DRAWS) as browser, tempfile.TemporaryDirectory(prefix="rtctl-tutorial-") as name:
        reader, begun, failure = Reader(Path(name), args.here, browser), time.monotonic(), ""
        try:
            for step in steps(PAGE.read_text(encoding="utf-8"))[1 if args.here else 0 :]:
                at = time.monotonic()
                print(step.title, flush=True)
                reader.follow(step)
                print(f"    {time.monotonic() - at:6.1f} s, {time.monotonic() - begun:6.1f} s since the beginning")
        except (AssertionError, TimeoutError, OSError) as error:
            failure = str(error)
        finally:
            reader.close()
    print(f"ended: {failure}" if failure else "all of it did what the page says")
    return 1 if failure else 0


if __name__ == "__main__":
    sys.exit(main())
