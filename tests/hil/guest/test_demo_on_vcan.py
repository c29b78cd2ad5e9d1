"""The beginning of `make demo` over a real SocketCAN bus: controller and drives as two processes.

All of it: python -m tools.vcan -- python -m tools.demo --lockstep --interface socketcan --channel vcan0
"""

import json
from pathlib import Path

import pytest

from rtctl.log import read
from rtctl.log.schema import RX, TX
from rtctl.types import State
from tools.demo import main

JOINTS = 7
SECONDS = 17.0  # a guest needs seven for each
GOALS = 3


def test_the_demo_reaches_its_goals_round_its_obstacles(
    vcan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = ["--lockstep", "--interface", "socketcan", "--channel", vcan]
    status = main([*bus, "--seconds", str(SECONDS), "--out", str(tmp_path)])
    said, why = capsys.readouterr()
    assert status == 0, said + why
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["contacts"], report["trips"], report["camera"]["refused"]) == (0, [], 0)
    assert min(report["min_clearance_m"].values()) > 0.0
    assert report["min_self_clearance_m"] > 0.0
    (path,) = (tmp_path / "logs").glob("*.mcap")
    log = read(path)
    ticks = log["/tick"].array
    assert (ticks["missed"] == 0).all()
    assert (ticks["state"] == State.RUN).sum() * 1e-3 >= SECONDS - 1.0
    assert len({tuple(goal) for goal in ticks["goal"][ticks["status"] > 0].tolist()}) == GOALS
    frames = log["/can/can0"].array
    sent, received = (int((frames["direction"] == way).sum()) for way in (TX, RX))
    assert 0 <= sent - JOINTS * len(ticks) <= 20 * JOINTS  # one command a joint and tick, and the last stop frames
    assert abs(sent - received) <= 20 * JOINTS  # answers to the last stop frames may come too late to be logged
    assert sorted(set(frames["id"].tolist())) == [*range(1, JOINTS + 1), *range(0x11, 0x11 + JOINTS)]
    assert "PASS" in said
