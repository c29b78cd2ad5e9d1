"""Six and seven joints through wrist, elbow and shoulder singularities: bounded, without chatter, told truthfully."""

import re
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rtctl.types import LimitFlag, State
from tests.arms import PANDA_HOME
from tests.lab import PANDA, Run, play

GIVEN = 0.4
UR5_HOME = [0.0, -1.2, 1.4, -1.7, -1.5, 0.0]


class Way(NamedTuple):
    """A way through or to a singularity."""

    start: list[float]
    goal: dict[str, Any]
    arrives: bool
    seconds: float = 3.6


PANDA_WAYS = {
    "elbow, stretched start": Way([0.0, 0.3, 0.0, -0.3, 0.0, 1.9, 0.785], {"position_m": [0.4, 0.1, 0.5]}, True),
    "wrist, goal in it": Way(PANDA_HOME.tolist(), {"position_m": [0.85, 0.0, 0.3], "wxyz": [0, 1, 0, 0]}, False, 5.4),
    "elbow, goal out of reach": Way(PANDA_HOME.tolist(), {"position_m": [0.95, 0.0, 0.45]}, False, 6.0),
}
UR5_WAYS = {
    "wrist": Way([0.0, -1.2, 1.4, -1.7, -0.05, 0.0], {"position_m": [0.45, 0.25, 0.4], "hold": "orientation"}, True),
    "elbow": Way([0.0, -0.9, 0.08, -0.8, -1.5, 0.0], {"position_m": [0.5, 0.2, 0.45], "hold": "orientation"}, True),
    "shoulder": Way(UR5_HOME, {"position_m": [0.0, 0.12, 0.75]}, True),
    "out of reach": Way(UR5_HOME, {"position_m": [0.85, 0.2, 0.45], "hold": "orientation"}, False, 5.4),
}


def ur5(folder: Path) -> Path:
    """Write the config of a UR5 behind virtual drives; return its path."""
    names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    rows = zip(names, (6.2, 6.2, 3.1, 6.2, 6.2, 6.2), (150.0,) * 3 + (28.0,) * 3, strict=True)
    joints = "".join(
        f'{{ name = "{name}_joint", can_id = {i}, q_min_rad = -{q}, q_max_rad = {q}, qd_max_rad_s = 3.15, '
        f'tau_max_Nm = {tau}, tau_rate_Nm_s = 2000.0, drive = "UR{tau:.0f}" }},\n'
        for i, (name, q, tau) in enumerate(rows, 1)
    )
    drives = "".join(
        f"[drives.UR{tau}]\np_max_rad = 12.5\nv_max_rad_s = 10.0\nt_max_Nm = {tau + 5}.0\n" for tau in (150, 28)
    )
    head = f"""[robot]
name = "ur5"
kind = "arm"
urdf = "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"
tip_frame = "ee_link"
home_rad = {UR5_HOME}
joints = [
{joints}]
{drives}
"""
    text = PANDA.read_text()
    path = folder / "ur5.toml"
    path.write_text(head + text[text.index("[loop]") :])
    return path


@cache
def run(name: str, config: Path) -> Run:
    way = UR5_WAYS[name] if config != PANDA else PANDA_WAYS[name]
    goal = {"at_s": GIVEN, **way.goal}
    return play({"duration_s": GIVEN + way.seconds, "start_q_rad": way.start, "goal": [goal]}, config)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The UR5's file."""
    return ur5(Path(tmp_path_factory.mktemp("ur5")))


def judged(way: Way, done: Run) -> None:
    """Assert what holds of every way."""
    figures, record = done.figures, done.record
    running = record["state"] == State.RUN
    assert done.memory.state == State.RUN
    for name in ("max_torque_ratio", "max_torque_rate_ratio", "max_joint_speed_ratio"):
        assert figures[name] <= 1.0 + 1e-9, name
    assert figures["contacts"] == 0
    # no chatter: at rest in the end, and no torque that turns about from tick to tick
    assert np.abs(done.qd[-300:]).max() < 0.1
    tau = record["tau_sent"][running]
    rough = np.abs(np.diff(tau, 2, axis=0)).mean(axis=0) / done.robot.tau_max
    assert rough.max() < 0.01
    assert figures["arrived"] == way.arrives
    names = {name for _, name, _ in done.events}
    if way.arrives:
        assert not names & {"singular", "unreachable"}
    else:
        # the free directions were used: most of the way is done, and what is missing is named as lost
        assert figures["final_error_m"] < 0.25 * float(np.linalg.norm(done.tip[0] - np.array(way.goal["position_m"])))
        _, told, detail = done.events[-1]
        way_left = np.array(way.goal["position_m"]) - done.tip[-1]
        if told == "singular":
            assert detail.startswith("cannot ")
        else:  # stretched out towards a goal that is too far away
            assert told == "unreachable"
            found = re.fullmatch(r"cannot move along (\S+) (\S+) (\S+), (\S+) m too far", detail)
            assert found
            lost, far = np.array([float(c) for c in found.groups()[:3]]), float(found[4])
            assert lost @ way_left / np.linalg.norm(way_left) > 0.9
            assert far == pytest.approx(np.linalg.norm(way_left), abs=2e-3)


@pytest.mark.parametrize("name", PANDA_WAYS)
def test_seven_joints_pass_or_approach_a_singularity(name: str):
    done = run(name, PANDA)
    assert (done.record["cut"] & LimitFlag.SINGULAR).any()
    judged(PANDA_WAYS[name], done)


@pytest.mark.parametrize("name", UR5_WAYS)
def test_six_joints_pass_or_approach_a_singularity(name: str, config: Path):
    done = run(name, config)
    assert done.record["sigma_min"][done.record["state"] == State.RUN].min() < 0.1
    judged(UR5_WAYS[name], done)
