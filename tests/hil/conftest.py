"""Tests in tests/hil/guest need SocketCAN; outside, each is reported with what it did beside vcan0.

All that are selected run in one pytest beside vcan0 (tools.vcan: a namespace or a guest), which writes one JSON line a
report; here stand items that turn those lines back into passed, failed and skipped. That pytest runs beside the tests
on the host, which take about as long.
"""

import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tools import vcan

GUEST = Path(__file__).resolve().parent / "guest"
ROOT = GUEST.parent.parent.parent
WARM = """
from rtctl import design
from rtctl.arm import pipe
pipe.warm(design.build(design.load("configs/panda.toml"), "configs/panda.toml"))
"""
REPORTS = "RTCTL_VCAN_REPORTS"  # file that the pytest beside vcan0 appends to
TIMEOUT = 3600.0  # [s] for all of them together, on a busy machine
INSIDE = vcan.available().kind == "here"
RESULTS = pytest.StashKey["Results"]()


class RemoteFailure(Exception):
    """What went wrong beside vcan0, as its pytest tells it."""


class Results:
    """Reports by node id, from a pytest beside vcan0 that runs in the background.

    One process starts it; any other that is told the same folder reads the reports as they come. It ends with the
    process that all of them belong to, however that ends.
    """

    def __init__(self, folder: Path) -> None:
        self.output, self.lines, self.ended = (folder / name for name in ("output", "lines", "ended"))

    def start(self, ids: list[str], owner: int) -> None:
        """Run these tests while the process `owner` lives."""
        self.lines.parent.mkdir()
        self.lines.touch()
        tests = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", *ids]
        beside = [sys.executable, "-m", "tools.vcan", "--timeout", str(TIMEOUT), "--", *tests]
        # A guest sees the compiled kernels that are in the cache when it starts.
        job = f"{shlex.join([sys.executable, '-c', WARM])} && exec {shlex.join(beside)}"
        watch = f"while kill -0 $! && kill -0 {owner}; do sleep 0.5; done 2>/dev/null; kill $! 2>/dev/null"
        command = f"({job}) & {watch}; wait $!; echo $? > {shlex.quote(str(self.ended))}"
        env = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")} | {REPORTS: str(self.lines)}
        with self.output.open("wb") as out:  # in the background: nobody waits for it by its process
            subprocess.run(
                ["sh", "-c", f"({command}) &"], cwd=ROOT, env=env, stdout=out, stderr=out, start_new_session=True
            )

    def of(self, remote_id: str) -> list[dict[str, Any]]:
        """Return the reports of a test, once it or all are done."""
        while True:
            over = self.ended.exists()
            whole = self.lines.read_text().rpartition("\n")[0] if self.lines.exists() else ""
            found = [report for report in map(json.loads, whole.splitlines()) if report["id"] == remote_id]
            if over or any(report["when"] == "teardown" for report in found):
                return found
            time.sleep(0.5)

    def account(self) -> str:
        """Exit status and the end of the output."""
        return f"exit status {self.ended.read_text().strip()}\n{self.output.read_text(errors='replace')[-8000:]}"


class RemoteItem(pytest.Item):
    """A test that runs beside vcan0, seen from outside."""

    def __init__(self, *, function: pytest.Function, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.remote_id = function.nodeid
        self.place = function.reportinfo()
        self.own_markers.extend(function.own_markers)
        self.keywords.update(function.keywords)

    def reportinfo(self) -> tuple[os.PathLike[str] | str, int | None, str]:
        return self.place

    def runtest(self) -> None:
        require()
        results = started(self.session)
        reports = results.of(self.remote_id)
        if not reports:
            raise RemoteFailure(f"no report of {self.remote_id} came back: {results.account()}")
        for report in reports:
            for title, content in report["sections"]:
                self.add_report_section(report["when"], title.removeprefix("Captured "), content)
            if report["outcome"] == "failed":
                raise RemoteFailure(report["text"])
            if report["outcome"] == "skipped":
                pytest.skip(report["text"])

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        return str(excinfo.value) if isinstance(excinfo.value, RemoteFailure) else super().repr_failure(excinfo, style)


def started(session: pytest.Session) -> Results:
    """The run beside vcan0, started now if it was not."""
    if RESULTS not in session.stash:
        config = session.config
        base = config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]  # no fixture: no test has begun
        worker = os.environ.get("PYTEST_XDIST_WORKER", "")
        results = session.stash[RESULTS] = Results((base.parent if worker else base) / "beside_vcan")
        if worker in ("", "gw0"):
            ids = [i.remote_id for i in session.items if isinstance(i, RemoteItem)]
            results.start(ids, os.getppid() if worker else os.getpid())
    return session.stash[RESULTS]


def require() -> vcan.Venue:
    """Where vcan0 can be had; else skips with the reason and the install command, or fails where CI=true.

    What no install cures, a processor that the guest cannot run on, is skipped there, too.
    """
    venue = vcan.available()
    if not venue and venue.kind != "never" and os.environ.get("CI") == "true":
        pytest.fail(venue.reason, pytrace=False)
    if not venue:
        pytest.skip(venue.reason)
    return venue


@pytest.fixture
def venue() -> vcan.Venue:
    """Where tools.vcan runs commands on this machine."""
    return require()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Outside, stand-ins take the place of the tests that need SocketCAN, last: done by then."""
    if INSIDE:
        return
    for i, item in enumerate(items):
        if isinstance(item, pytest.Function) and item.path.is_relative_to(GUEST) and item.parent is not None:
            items[i] = RemoteItem.from_parent(item.parent, name=item.name, function=item)
    items.sort(key=lambda item: isinstance(item, RemoteItem))


def pytest_collection_finish(session: pytest.Session) -> None:
    """It starts first: a guest takes many minutes."""
    wanted = any(isinstance(item, RemoteItem) for item in session.items) and not session.config.option.collectonly
    if wanted and vcan.available():
        started(session)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Beside vcan0, every report is put on disk at once: a guest that is killed keeps what it had told."""
    if not INSIDE or REPORTS not in os.environ:
        return
    text = str(report.longrepr[2]) if isinstance(report.longrepr, tuple) else report.longreprtext
    told = {"id": report.nodeid, "when": report.when, "outcome": report.outcome, "text": text}
    with open(os.environ[REPORTS], "a", encoding="utf-8") as file:
        file.write(json.dumps(told | {"sections": report.sections}) + "\n")
        file.flush()
        os.fsync(file.fileno())
