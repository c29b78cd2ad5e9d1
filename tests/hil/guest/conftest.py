"""Fixtures of tests that run beside a real SocketCAN interface."""

import subprocess

import pytest

from tools.vcan import CHANNEL

RENEW = f"""\
link del {CHANNEL}
link add dev {CHANNEL} type vcan
link set {CHANNEL} mtu 72 txqueuelen 128
link set {CHANNEL} up
"""


@pytest.fixture
def vcan() -> str:
    """Name of a fresh vcan interface: no frame, counter or queueing discipline of an earlier test is left in it."""
    made = subprocess.run(["ip", "-force", "-batch", "-"], input=RENEW, text=True, capture_output=True, check=False)
    assert made.returncode == 0 or "Cannot find device" in made.stderr, made.stderr  # a test may have deleted it
    return CHANNEL
