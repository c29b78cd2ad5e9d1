"""What every test shares: repeatable property tests."""

import signal
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from xdist.scheduler import LoadScopeScheduling  # type: ignore[import-untyped]

# Files that start daemons, drives or recorders: one after the other, whatever else runs beside them (pytest -n).
# They end last; what can as well run beside them is not listed.
MACHINE = {
    *("base_daemon", "base_link", "base_unit", "campaign", "can", "console", "crash", "daemon", "demo", "firmware_sim"),
    *("obstacle_feed", "ordeal", "recorder", "ring", "service", "trust", "view", "viewers", "waiting"),
}


class ByFile(LoadScopeScheduling):  # type: ignore[misc]  # the library has no types
    """Keeps the tests of a file together, so that what they share is made once, and those of MACHINE on one worker."""

    def _split_scope(self, nodeid: str) -> str:
        path = Path(nodeid.partition("::")[0])
        alone = path.stem.removeprefix("test_") in MACHINE or path.parent.name == "hil"
        return "machine" if alone else str(path)


@pytest.hookimpl(optionalhook=True)  # where pytest-xdist is off there is no such hook
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByFile:
    """Return the order in which workers get tests; groups by mark do not reach pytest-xdist 3.8 from pytest 9.2."""
    return ByFile(config, log)


# No deadline: compilation and a busy machine are not failures. Derandomised: a red run is red again.
settings.register_profile("rtctl", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("rtctl")

# A shell's background job ignores SIGINT, and so would every program that a test starts and interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
