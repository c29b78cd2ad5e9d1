"""The benchmark runs, says so in both ways, and measures the law against a floor that computes the same."""

import json
import shutil

import pytest

from tools import bench, bench_law
from tools.bench_rig import Floor, case, robot_and_spec


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counts that show that it runs."""
    monkeypatch.setattr(bench, "QUICK", {"law": 4, "tick": 8, "call": 4, "wake": 4, "log": 0.1, "demo": 1})


@pytest.mark.usefixtures("tiny")
def test_json_has_the_machine_and_a_row_of_every_part(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--quick", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {"cpu", "cores", "kernel", "load", "floor"} <= set(said["machine"])
    assert {r["part"] for r in said["rows"]} == set(bench.PARTS)
    named = [r["name"] for r in said["rows"]]
    rare = {"diagnose", "supervise", "take goals", "edit obstacles"}  # Python that few ticks need: of 60, maybe none
    assert set(bench.STAGES.values()) - rare < set(named)
    for r in said["rows"]:
        assert (r["p50"] is None) == (r["p99"] is None)
        assert r["p50"] is not None or r["note"].startswith("left out") or "MB" in r["note"]


@pytest.mark.usefixtures("tiny")
def test_the_table_has_a_line_for_each_row(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)  # nothing to compare with: the rows say why
    assert bench.main(["--quick", "--part", "law", "--part", "wake"]) == 0
    text = capsys.readouterr().out
    assert text.count("no floor: no C++ compiler") == 8
    assert "cyclictest" in text
    assert "left out: not installed (rt-tests)" in text


@pytest.mark.usefixtures("tiny")
def test_a_part_runs_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--quick", "--json", "--part", "ring", "--part", "gc"]) == 0
    assert {r["part"] for r in json.loads(capsys.readouterr().out)["rows"]} == {"ring", "gc"}


def test_the_floor_computes_what_the_law_does() -> None:
    floor, why = Floor.build()
    if floor is None:
        assert why
        return
    robot, _ = robot_and_spec()
    for m, slots in ((16, 1), (16, 16), (64, 1), (64, 16), (64, 256)):
        one = case(robot, m, slots)
        assert bench_law.difference(floor.bind(one), one) < 1e-6  # [Nm]
