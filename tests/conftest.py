"""What every test shares: repeatable property tests."""

import signal

import pytest
from hypothesis import settings

# Files that start daemons, drives or recorders: one after the other, whatever else runs beside them (pytest -n).
MACHINE = {
    *("base_daemon", "base_link", "base_unit", "bench", "campaign", "can", "cli", "console", "crash", "daemon", "demo"),
    *("firmware_sim", "log_runs", "log_tools", "mutants", "obstacle_feed", "ordeal", "recorder", "ring", "service"),
    *("trust", "view", "viewers", "waiting"),
}


@pytest.hookimpl(tryfirst=True)  # pytest-xdist reads the groups in a hook of the same name
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the tests of a file together, so that what they share is made once, and those of MACHINE on one worker."""
    if hasattr(config, "workerinput"):
        for item in items:
            alone = item.path.stem.removeprefix("test_") in MACHINE or item.path.parent.name == "hil"
            item.add_marker(pytest.mark.xdist_group("machine" if alone else item.path.name))


# No deadline: compilation and a busy machine are not failures. Derandomised: a red run is red again.
settings.register_profile("rtctl", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("rtctl")

# A shell's background job ignores SIGINT, and so would every program that a test starts and interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
