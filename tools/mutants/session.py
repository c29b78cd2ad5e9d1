"""A pytest session that runs its tests once as they are, and then those that a mutant's line concerns once a mutant."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import pytest

from tools.mutants.change import Mutant
from tools.mutants.trial import SURVIVED, Change, in_child


class Job(NamedTuple):
    """What a session is to do."""

    file: Path
    source: str
    mutants: list[Mutant]
    known: Path  # results, a line of JSON each; those that are there are not made again
    jobs: int  # at once
    say: Callable[[str], None]


class Trials:
    """The plugin: takes the place of the loop that runs the tests."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.on_import: set[int] = set()  # lines of the module that run when everything is imported
        self.lines: dict[str, set[int]] = {}  # that a test came by
        self.seconds: dict[str, float] = {}
        self.survivors: list[Mutant] = []
        self.trouble = ""

    def pytest_sessionstart(self) -> None:
        """Begin to look: the tests are collected next, and import the program."""
        sys.settrace(self._trace(self.on_import))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run everything once, then every mutant."""
        sys.settrace(None)
        by_id = {item.nodeid: item for item in session.items}
        for item in session.items:
            self._unchanged(item)
        if session.testsfailed or not by_id:
            self.trouble = f"{session.testsfailed} of {len(by_id)} tests fail where nothing is changed"
            return True
        known = self._known()
        waiting, running = iter(self.job.mutants), dict[int, Mutant]()
        done = 0
        for mutant in self._not_known(waiting, known):
            if len(running) >= self.job.jobs:
                self._one_ended(running)
            items = self._concerned(mutant, by_id)
            if not items:
                self._result(mutant, SURVIVED)
                continue
            text = mutant.applied(self.job.source)
            seconds = sum(self.seconds[item.nodeid] for item in items)
            anew = bool(self.on_import & set(range(mutant.line, mutant.last + 1)))
            running[in_child(Change(self.job.file, text, mutant.scope, anew), items, seconds)] = mutant
            done += 1
            if done % 50 == 0:
                self.job.say(f"{self.job.file.name}: {done} tried, {len(self.survivors)} survivors")
        while running:
            self._one_ended(running)
        return True

    def _unchanged(self, item: pytest.Item) -> None:
        """Run a test as it is; note its time and the lines of the module that it came by."""
        sys.settrace(self._trace(self.lines.setdefault(item.nodeid, set())))
        begun = time.process_time()
        try:
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
        finally:
            sys.settrace(None)
        self.seconds[item.nodeid] = time.process_time() - begun

    def _trace(self, found: set[int]) -> Callable[[FrameType, str, object], Any]:
        """Return a trace function that adds the lines of the module to `found`."""
        wanted = str(self.job.file)

        def trace(frame: FrameType, event: str, argument: object) -> Any:
            if frame.f_code.co_filename != wanted:
                return None
            found.add(frame.f_lineno)
            return trace

        return trace

    def _concerned(self, mutant: Mutant, by_id: dict[str, pytest.Item]) -> list[pytest.Item]:
        """Return the tests that come by the lines of a mutant, the quickest first; all for what runs on import."""
        span = set(range(mutant.line, mutant.last + 1))
        everywhere = bool(self.on_import & span)
        names = [name for name, lines in self.lines.items() if everywhere or lines & span]
        return [by_id[name] for name in sorted(names, key=self.seconds.__getitem__)]

    def _known(self) -> dict[str, int]:
        if not self.job.known.exists():
            return {}
        return dict(json.loads(line) for line in self.job.known.read_text(encoding="utf-8").splitlines())

    def _not_known(self, waiting: Iterator[Mutant], known: dict[str, int]) -> Iterator[Mutant]:
        """Yield the mutants whose killing is not known yet: survivors are tried again."""
        for mutant in waiting:
            if known.get(mutant.key, SURVIVED) == SURVIVED:
                yield mutant

    def _one_ended(self, running: dict[int, Mutant]) -> None:
        pid, status = os.wait()
        mutant = running.pop(pid)
        self._result(mutant, SURVIVED if status == 0 else 1)

    def _result(self, mutant: Mutant, status: int) -> None:
        if status == SURVIVED:
            self.survivors.append(mutant)
        with self.job.known.open("a", encoding="utf-8") as file:
            file.write(json.dumps([mutant.key, status]) + "\n")


def run(job: Job, tests: Sequence[str]) -> Trials:
    """Return what became of the mutants of a module under its tests."""
    trials = Trials(job)
    flags = ["-q", "-s", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore", "-p", "tools.mutants.profile"]
    with open(os.devnull, "w", encoding="utf-8") as null, redirect_stdout(null):
        pytest.main([*flags, *tests], plugins=[trials])
    return trials
