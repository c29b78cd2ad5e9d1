"""Whole runs against the virtual robot's own account: what is promised of motion, of starts, and of repeating a run."""

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtctl import design as cfg
from rtctl.app.sim import simulate
from rtctl.types import F64, LimitFlag, State, Status
from tests.arms import PANDA_HOME
from tests.lab import PANDA, ROOT, Run, changed, play, robot

HOME = PANDA_HOME.tolist()
TURNED, TWISTED = [0.8, 0.2, -0.3, -1.8, 0.2, 1.9, 0.3], [-0.8, -0.3, 0.3, -2.2, 0.2, 1.9, 0.3]
GIVEN = 0.4  # [s] when a goal is given

# start, goal: all free of obstacles and of joint limits
FREE: dict[str, tuple[list[float], dict[str, Any]]] = {
    "position": (HOME, {"position_m": [0.45, 0.35, 0.45]}),
    "position low": (HOME, {"position_m": [0.35, -0.45, 0.65]}),
    "pose": (HOME, {"position_m": [0.5, -0.3, 0.35], "wxyz": [0.0, 1.0, 0.0, 0.0]}),
    "orientation held": (HOME, {"position_m": [0.5, 0.3, 0.3], "hold": "orientation"}),
    "orientation turned": (HOME, {"position_m": [0.4, 0.2, 0.5], "rpy_rad": [2.6, 0.3, 0.5]}),
    "position far": (TURNED, {"position_m": [0.3, -0.35, 0.6]}),
    "pose far": (TWISTED, {"position_m": [0.45, 0.25, 0.4], "rpy_rad": [3.1, 0.0, 0.4]}),
}


@cache
def free(name: str, path: Path = PANDA) -> Run:
    start, goal = FREE[name]
    return play({"duration_s": 2.7, "start_q_rad": start, "goal": [{"at_s": GIVEN, **goal}]}, path)


def off_line(run: Run, goal: list[float]) -> F64:
    """Return the distance (T,) [m] of the tip from the line through where it was when the goal was given."""
    later = run.since(GIVEN)
    start, end = later.tip[0], np.array(goal)
    along = (end - start) / np.linalg.norm(end - start)
    offset = later.tip - start
    return np.linalg.norm(offset - np.outer(offset @ along, along), axis=1)


def speeds(run: Run) -> F64:
    return np.linalg.norm(np.diff(run.tip, axis=0), axis=1) / np.diff(run.t)


# ---- free motion


@pytest.mark.parametrize("name", FREE)
def test_a_free_goal_is_reached_on_a_straight_line_below_the_speed_limit(name: str):
    run = free(name)
    assert run.figures["arrived"]
    assert run.figures["final_error_m"] < 5e-4
    assert run.figures["final_error_rad"] < 0.005
    assert run.figures["contacts"] == 0
    assert off_line(run, FREE[name][1]["position_m"]).max() < 1e-3
    assert speeds(run).max() <= 1.01 * robot().motion.v_max
    assert run.figures["max_torque_rate_ratio"] <= 1.0 + 1e-9
    assert run.memory.state == State.RUN


def test_the_reported_figures_are_those_of_the_path():
    run = free("pose")
    deviation = off_line(run, FREE["pose"][1]["position_m"]).max()
    assert run.figures["line_deviation_m"] == pytest.approx(deviation, abs=5e-5)
    assert run.figures["max_speed_m_s"] == pytest.approx(speeds(run).max(), rel=1e-6)
    path = np.linalg.norm(np.diff(run.tip, axis=0), axis=1).sum()
    assert run.figures["path_length_m"] == pytest.approx(path, rel=1e-6)
    qd_ratio, margin = np.abs(run.qd / robot().qd_max).max(), np.minimum(run.q - robot().q_min, robot().q_max - run.q)
    assert run.figures["max_joint_speed_ratio"] == pytest.approx(qd_ratio, rel=1e-6)
    assert run.figures["min_joint_margin_rad"] == pytest.approx(margin.min(), rel=1e-6)
    sent = run.record["tau_sent"]
    assert run.figures["max_torque_ratio"] == pytest.approx(np.abs(sent / robot().tau_rated).max(), rel=1e-6)


def test_what_the_controller_knew_was_quantised():
    run = free("pose")
    codes = (run.record["q"] + 12.5) * 65535.0 / 25.0
    np.testing.assert_allclose(codes, np.round(codes), atol=1e-6)
    speed = (run.record["qd"] + 10.0) * 4095.0 / 20.0
    np.testing.assert_allclose(speed, np.round(speed), atol=1e-6)
    rounding = np.abs(run.record["q"][2:] - run.q[:-2])  # a reply tells of the state before its command
    assert 0.4 * 25.0 / 65535.0 < rounding.max() < 0.51 * 25.0 / 65535.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for configs."""
    return tmp_path_factory.mktemp("configs")


@pytest.mark.parametrize("name", ["pose", "position"])
def test_a_model_at_a_quarter_of_the_rate_makes_the_same_path(name: str, folder: Path):
    quarter, full = free(name), free(name, changed(folder, "full", model_hz=1000))
    assert full.record["model_evaluated"].all()
    assert quarter.record["model_evaluated"].mean() == pytest.approx(0.25, abs=0.01)
    assert quarter.t.shape == full.t.shape
    assert np.linalg.norm(quarter.tip - full.tip, axis=1).max() < 1e-3
    assert full.figures["arrived"]


def test_the_papers_rates_work_on_the_plain_protocol(folder: Path):
    path = changed(
        folder,
        "paper",
        servo_hz=225,
        model_hz=100,
        watchdog_ms=50.0,
        stale_hold_ms=15.0,
        stale_stop_ms=50.0,
        protocol='"mit"',
        fd="false",
    )
    path.write_text("".join(x for x in path.read_text().splitlines(True) if not x.startswith("data_bitrate")))
    for name in ("pose", "orientation held"):
        run = free(name, path)
        assert run.figures["arrived"]
        assert off_line(run, FREE[name][1]["position_m"]).max() < 2e-3
        assert speeds(run).max() <= 1.01 * robot().motion.v_max
        assert run.memory.state == State.RUN
        assert run.memory.in_force == 0


# ---- starts and goals that ask for trouble


def ball(at: list[float], radius: float, **more: Any) -> dict[str, Any]:
    return {"name": "ball", "type": "sphere", "radius_m": radius, "position_m": at, **more}


def to(*position: float, **more: Any) -> list[dict[str, Any]]:
    return [{"at_s": GIVEN, "position_m": list(position), **more}]


HARD: dict[str, dict[str, Any]] = {
    "stretched upright": {"start_q_rad": [0, 0, 0, -0.075, 0, 1.571, 0.785], "goal": to(0.5, 0.2, 0.5)},
    "stretched out": {"start_q_rad": [0, 1.2, 0, -0.075, 0, 1.6, 0.785], "goal": to(0.9, 0.1, 0.4)},
    "all but zero": {"start_q_rad": [0, 0, 0, -0.075, 0, 0, 0], "goal": to(0.3, 0.2, 0.7, wxyz=[0.0, 1.0, 0.0, 0.0])},
    "wrist in line": {"start_q_rad": [0, -0.5, 0, -2, 0, -0.01, 0.785], "goal": to(0.4, 0.2, 0.5, hold="orientation")},
    "past a limit": {"start_q_rad": [0, -0.785, 0, -3.15, 0, 1.571, 0.785], "goal": to(0.45, 0.2, 0.45)},
    "past two limits": {"start_q_rad": [2.95, -0.785, 0, -2.356, 0, 3.8, 0.785], "goal": to(-0.35, 0.1, 0.45)},
    "inside an influence": {"goal": to(0.45, 0.3, 0.5), "obstacle": [ball([0.307, 0.15, 0.48], 0.03)]},
    "nearer than the clearance": {"goal": to(0.45, 0.3, 0.5), "obstacle": [ball([0.307, 0.0, 0.44], 0.02)]},
    "elbow inside an influence": {"goal": to(0.45, 0.2, 0.45), "obstacle": [ball([0.0, 0.14, 0.62], 0.03)]},
    "a goal inside": {"goal": to(0.5, 0.3, 0.4), "obstacle": [ball([0.5, 0.3, 0.42], 0.08)]},
    "a goal at the surface": {"goal": to(0.5, 0.3, 0.52), "obstacle": [ball([0.5, 0.3, 0.4], 0.1)]},
    "a goal that is swallowed": {
        "goal": to(0.5, 0.3, 0.5),
        "obstacle": [ball([0.5, 0.9, 0.5], 0.12, velocity_m_s=[0.0, -0.4, 0.0])],
    },
    "hardly out of reach": {"goal": to(0.0, 0.8, 0.9)},
    "hardly out of reach, held": {"goal": to(0.8, 0.3, 0.5, hold="orientation")},
    "a goal just above a table": {
        "goal": to(0.5, 0.1, 0.08, hold="orientation"),
        "obstacle": [{"name": "table", "type": "plane", "position_m": [0.0, 0.0, 0.04]}],
    },
    "far out of reach": {"goal": to(3.0, 0.0, 0.3)},
    "inside its own base": {"goal": to(0.0, 0.0, 0.3)},
    "under its own base": {"goal": to(0.0, 0.0, -0.4)},
}
REACHED = {
    "stretched upright",
    "stretched out",
    "wrist in line",
    "past a limit",
    "inside an influence",
    "nearer than the clearance",
    "elbow inside an influence",
}


@cache
def hard(name: str) -> Run:
    return play({"duration_s": STALLED[name][0] if name in STALLED else 2.4, **HARD[name]})


# how long it takes to be sure, and what is then said to hold the arm
STALLED = {
    "a goal just above a table": (4.2, Status.SHADOWED, "table"),
    "hardly out of reach, held": (5.6, Status.SINGULAR, ""),
}


@pytest.mark.parametrize("name", HARD)
def test_nothing_that_is_asked_makes_it_violent(name: str):
    run = hard(name)
    for field in run.record.dtype.names or ():
        if run.record[field].dtype.kind == "f" and field != "rho":  # infinite where there is no obstacle
            assert np.isfinite(run.record[field]).all(), field
    assert not np.isnan(run.record["rho"]).any()
    assert not (run.record["cut"] & LimitFlag.NON_FINITE).any()
    assert run.figures["max_torque_ratio"] <= 1.0
    assert run.figures["max_torque_rate_ratio"] <= 1.0 + 1e-9
    assert run.figures["max_joint_speed_ratio"] <= 1.0
    assert run.figures["contacts"] == 0
    assert speeds(run).max() <= 1.15 * robot().motion.v_max  # fields and limits push too; the motion task itself: above
    assert run.memory.state == State.RUN
    assert [d for _, event, d in run.events if event == "fault" and "goal_in_obstacle" not in d] == []


def _detail(run: Run) -> str:
    return " ".join(detail for _, name, detail in run.events if name == "fault")


@pytest.mark.parametrize("name", sorted(REACHED))
def test_a_bad_start_is_no_excuse(name: str):
    assert hard(name).figures["arrived"]


@pytest.mark.parametrize("name", ["past a limit", "past two limits"])
def test_a_joint_past_its_limit_comes_back_slowly_and_stays_inside(name: str):
    run = hard(name)
    arm = robot()
    excess = np.maximum(arm.q_min - run.q, run.q - arm.q_max)
    out = np.flatnonzero((excess > 0.0).any(axis=1))
    assert out[0] == 0
    assert 0.1 < run.t[out[-1]] < 1.0
    assert (np.diff(out) == 1).all()  # once inside, always inside
    joints = excess[0] > 0.0
    while_out = run.qd[: out[-1]][:, joints]
    assert np.abs(while_out).max() < 0.5 * arm.qd_max.min()
    inward = np.where(run.q[0] > arm.q_max, -1.0, 1.0)[joints]
    assert (while_out * inward).min() > -0.02


@pytest.mark.parametrize("name", sorted(STALLED))
def test_an_arm_that_cannot_arrive_says_why(name: str):
    run = hard(name)
    assert not run.figures["arrived"]
    _, status, what = STALLED[name]
    assert run.memory.status == status
    _, told, detail = run.events[-1]
    assert told == status.name.lower()
    assert what in detail


@pytest.mark.parametrize(
    ("name", "reason"),
    [("a goal inside", "inside obstacle ball"), ("far out of reach", "wanted at most the arm's reach")],
)
def test_an_impossible_goal_is_refused_in_words(name: str, reason: str):
    run = hard(name)
    assert [reason in detail for _, event, detail in run.events if event == "rejected"] == [True]
    assert run.figures["goals"] == []
    assert np.linalg.norm(run.tip[-1] - run.since(GIVEN).tip[0]) < 2e-3


def test_a_goal_that_is_swallowed_is_given_up_while_it_is():
    run = hard("a goal that is swallowed")
    assert "goal_in_obstacle" in _detail(run)
    assert run.figures["min_clearance_m"]["ball"] > 0.0


# ---- the command

KEYS = {
    "arrived",
    "time_to_goal_s",
    "final_error_m",
    "final_error_rad",
    "path_length_m",
    "line_deviation_m",
    "max_speed_m_s",
    "min_clearance_m",
    "min_self_clearance_m",
    "contacts",
    "min_joint_margin_rad",
    "max_torque_ratio",
    "max_torque_rate_ratio",
    "max_joint_speed_ratio",
    "statuses",
    "mode_final",
    "faults",
    "ticks",
    "missed",
    "realtime_factor",
    "digest",
}

SCENARIO = f"""
robot = "{PANDA}"
duration_s = 1.0
seed = 3
[[goal]]
at_s = 0.3
position_m = [0.4, 0.1, 0.5]
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = 0.05
waypoints = [[0.0, 0.5, 0.4, 0.5], [1.0, 0.5, 0.2, 0.5]]
[[obstacle]]
name = "wall"
type = "box"
size_m = [0.1, 0.1, 0.5]
position_m = [0.5, -0.3, 0.25]
[[fault]]
at_s = 0.6
kind = "drop"
duration_s = 0.003
joint = 2
"""


@pytest.fixture(scope="module")
def scenario(folder: Path) -> Path:
    """A scenario with goals, obstacles and a fault that is random."""
    path = folder / "short.toml"
    path.write_text(SCENARIO)
    return path


def comparable(figures: dict[str, Any]) -> dict[str, Any]:
    """Return what two runs must agree on: all but how long they took."""
    return {k: v for k, v in figures.items() if k != "realtime_factor"}


@pytest.fixture(scope="module")
def printed(scenario: Path) -> dict[str, Any]:
    """What another process prints of it."""
    command = [sys.executable, "-m", "rtctl", "sim", str(scenario), "--json"]
    environment = {**os.environ, "PYTHONHASHSEED": "5"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if "compil" not in line] == []
    assert done.stdout.count("\n") == 1
    figures: dict[str, Any] = json.loads(done.stdout)
    return figures


def test_the_command_prints_every_published_figure(printed: dict[str, Any]):
    assert set(printed) >= KEYS
    assert set(printed["min_clearance_m"]) == {"all", "ball", "wall"}
    assert printed["min_clearance_m"]["all"] == min(printed["min_clearance_m"][k] for k in ("ball", "wall"))
    assert all(len(s) == 3 and isinstance(s[0], float) and isinstance(s[1], str) for s in printed["statuses"])
    assert printed["statuses"][0][1] == "moving"
    assert printed["mode_final"] == "RUN"
    assert printed["missed"] == 0
    assert 990 < printed["ticks"] <= 1000  # the handshake took a few
    assert len(printed["digest"]) == 64
    assert printed["realtime_factor"] > 0.0


def test_the_same_scenario_gives_the_same_run_here_and_in_another_process(
    scenario: Path, printed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cfg, "build", lambda config, path: robot())
    one, two = (comparable(simulate(scenario)) for _ in range(2))
    assert one == two
    assert json.loads(json.dumps(one)) == comparable(printed)


def test_another_seed_and_another_goal_give_another_digest(
    scenario: Path, printed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cfg, "build", lambda config, path: robot())
    other = scenario.with_name("other.toml")
    short = SCENARIO.replace("duration_s = 1.0", "duration_s = 0.5")
    other.write_text(short.replace("[0.4, 0.1, 0.5]", "[0.4, 0.1, 0.501]"))
    half = scenario.with_name("half.toml")
    half.write_text(short)
    digests = {simulate(path)["digest"] for path in (other, half)} | {printed["digest"]}
    assert len(digests) == 3
