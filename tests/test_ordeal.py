"""The judge of the ordeal (`python -m tools.ordeal`) is not blind."""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tools.ordeal.clock import WallClock
from tools.ordeal.pair import Failed, Pair, Truth, break_sockets
from tools.ordeal.steps import STEPS


def test_each_sort_of_trouble_of_the_ordeal_has_a_step():
    names = {step.__name__ for step in STEPS}
    assert {"kill_daemon", "kill_recorder", "terminate", "drives_vanish", "breaks", "disk", "few_descriptors"} <= names
    assert {"pause_daemon", "pause_drives", "pause_recorder", "garbage", "crowd", "set_clock"} <= names


REST = Truth(1.0, [0.0] * 2, [0.0] * 3, [0.0] * 2, [0.0] * 2, [True] * 2, [], 0, 0)


def test_rest_without_torque_is_told_from_all_else():
    assert REST.safe
    assert not REST._replace(torque=[0.0, 0.5]).safe
    assert not REST._replace(brake=[True, False]).safe
    assert not REST._replace(speed=[0.0, -0.1]).safe


def test_a_drive_that_takes_long_to_rest_a_hole_in_a_log_and_a_process_that_is_left_are_failures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pair = Pair(tmp_path)
    late = REST._replace(trips=[{"joint": "a", "command_to_rest_s": 1.5}])
    monkeypatch.setattr(pair, "later", lambda: late)
    monkeypatch.setattr(pair, "truth", lambda: late)
    with pytest.raises(Failed, match=r"took 1\.5 s"):
        pair.becomes_safe()
    monkeypatch.setattr("tools.ordeal.pair.PATIENCE", 0.1)
    monkeypatch.setattr("tools.ordeal.pair.wait_for.__defaults__", (0.1,))
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as left:
        pair.born.add(left.pid)
        with pytest.raises(Failed, match=f"left: .{left.pid}"):
            pair.nobody_left()
        left.send_signal(signal.SIGKILL)
    pair.nobody_left()


def test_the_wall_clock_of_a_process_is_set_and_the_monotonic_is_not(tmp_path: Path):
    try:
        clock = WallClock(tmp_path)
    except FileNotFoundError:
        pytest.skip("needs a C compiler")
    code = (
        "import time; print(time.time(), time.monotonic(), flush=True); input(); print(time.time(), time.monotonic())"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, env=clock.environment) as child:
        assert child.stdout is not None
        assert child.stdin is not None
        wall, run = map(float, child.stdout.readline().split())
        clock.set(-600_000_000)
        child.stdin.write(b"\n")
        child.stdin.close()
        then, still = map(float, child.stdout.readline().split())
    passed = still - run
    assert passed >= 0.0
    assert then - wall == pytest.approx(passed - 6e8, abs=3600.0)


def test_a_connection_is_broken_from_outside():
    code = "import socket, sys; a, b = socket.socketpair(); print(flush=True); sys.exit(0 if a.recv(1) == b'' else 3)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        if not break_sockets(child.pid, random.Random(1).choice):
            child.kill()
            assert os.geteuid() != 0
            pytest.skip("the kernel lets nobody take another's descriptor here")
        assert child.wait(60) == 0
