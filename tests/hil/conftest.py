"""Tests in tests/hil/guest need SocketCAN; outside, each is reported with what it did beside vcan0.

All that are selected run in one pytest beside vcan0 (tools.vcan: a namespace or a guest), which writes one JSON line a
report; here stand items that turn those lines back into passed, failed and skipped.
"""

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from tools import vcan

GUEST = Path(__file__).resolve().parent / "guest"
REPORTS = "RTCTL_VCAN_REPORTS"  # file that the pytest beside vcan0 appends to
TIMEOUT = 1500.0  # [s] for all of them together
INSIDE = vcan.available().kind == "here"
RESULTS = pytest.StashKey["Results"]()


class RemoteFailure(Exception):
    """What went wrong beside vcan0, as its pytest tells it."""


class Results(dict[str, list[dict[str, Any]]]):
    """Reports by node id, and the output of the pytest that made them."""

    def __init__(self, ids: list[str]) -> None:
        super().__init__()
        with tempfile.NamedTemporaryFile(prefix="rtctl-reports-", suffix=".jsonl", dir="/tmp") as file:
            env = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")} | {REPORTS: file.name}
            command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", *ids]
            output = bytearray()
            root = GUEST.parent.parent.parent
            try:
                status = vcan.run(command, timeout=TIMEOUT, cwd=root, env=env, out=output.extend, err=output.extend)
                self.account = f"exit status {status}\n{output.decode(errors='replace')[-8000:]}"
            except vcan.VcanError as error:
                self.account = f"{error}\n{output.decode(errors='replace')[-8000:]}"
            for line in Path(file.name).read_text().splitlines():
                report = json.loads(line)
                self.setdefault(report["id"], []).append(report)


class RemoteItem(pytest.Item):
    """A test that runs beside vcan0, seen from outside."""

    def __init__(self, *, function: pytest.Function, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.remote_id = function.nodeid
        self.place = function.reportinfo()
        self.own_markers.extend(function.own_markers)
        self.keywords.update(function.keywords)
        self.add_marker(pytest.mark.xdist_group("vcan"))  # one worker, hence one guest

    def reportinfo(self) -> tuple[os.PathLike[str] | str, int | None, str]:
        return self.place

    def runtest(self) -> None:
        require()
        if RESULTS not in self.session.stash:
            self.session.stash[RESULTS] = Results(
                [i.remote_id for i in self.session.items if isinstance(i, RemoteItem)]
            )
        results = self.session.stash[RESULTS]
        if self.remote_id not in results:
            raise RemoteFailure(f"no report of {self.remote_id} came back: {results.account}")
        for report in results[self.remote_id]:
            for title, content in report["sections"]:
                self.add_report_section(report["when"], title.removeprefix("Captured "), content)
            if report["outcome"] == "failed":
                raise RemoteFailure(report["text"])
            if report["outcome"] == "skipped":
                pytest.skip(report["text"])

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        return str(excinfo.value) if isinstance(excinfo.value, RemoteFailure) else super().repr_failure(excinfo, style)


def require() -> vcan.Venue:
    """Where vcan0 can be had; else skips with the reason and the install command, or fails where CI=true."""
    venue = vcan.available()
    if not venue and os.environ.get("CI") == "true":
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
    """Outside, stand-ins take the place of the tests that need SocketCAN, last: compiled code is cached by then."""
    if INSIDE:
        return
    for i, item in enumerate(items):
        if isinstance(item, pytest.Function) and item.path.is_relative_to(GUEST) and item.parent is not None:
            items[i] = RemoteItem.from_parent(item.parent, name=item.name, function=item)
    items.sort(key=lambda item: isinstance(item, RemoteItem))


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
