"""A rover over UDP whose packets the kernel delays, loses and reorders: it slows or stops, it never touches."""

import subprocess
import time
from contextlib import suppress

import pytest

from rtctl.errors import RtctlError
from tests.test_base_daemon import Pair

MANGLE = "delay 100ms 20ms loss 10% reorder 25% 50%"  # each way
PATIENCE = 120.0  # [s]


def patient(pair, verb, **keys):
    """Ask for what may be refused, as an operator does who tries again."""
    with suppress(RtctlError):
        pair.ask(verb, **keys)


@pytest.fixture
def mangled():
    """The loopback interface with packets mangled."""
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    subprocess.run(f"tc qdisc add dev lo root netem {MANGLE}".split(), check=True)
    yield
    subprocess.run(["tc", "qdisc", "del", "dev", "lo", "root"], check=True)


@pytest.mark.usefixtures("mangled")
def test_a_rover_goes_round_a_disc_over_a_bad_link_without_contact(tmp_path):
    with Pair(tmp_path) as pair:
        pair.daemon()
        end = time.monotonic() + PATIENCE
        status = pair.ask("status")
        while status["status"] != "arrived" and time.monotonic() < end:
            if status["state"] == "SAFE_STOP":
                patient(pair, "reset")
            elif status["state"] == "IDLE":
                patient(pair, "arm")
            elif status["state"] == "RUN" and status["goal_m"] is None:
                patient(pair, "goal", position_m=[40.0, 0.0, 0.0])
            time.sleep(0.2)
            status = pair.ask("status")
        truth = pair.truth()
        assert truth["contacts"] == 0
        assert status["x_m"][0] > 5.0, status
