"""The demo: played by two processes over a bus, told by the log and the drives, drawn on one page."""

import re
import signal
import struct
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from rtctl.kernel.rotations import R_of
from rtctl.log import read
from rtctl.spec.scenario import load_scenario
from rtctl.types import F64, Goal, Shape, State, Task
from rtctl.world.outline import axis_view
from rtctl.world.outline import outline as outline_of
from tests.arms import NO_POINTS, panda
from tests.rig import ROOT, config_at
from tools import demo, player
from tools.outcome import Given, GoalOutcome, Outcome, judge
from tools.pair import Child, DemoError, working_copy
from tools.trace import Trace

GOALS = [(0.45, 0.2, 0.45), (0.45, -0.2, 0.45)]
SCENE = f"""
robot = "panda"
duration_s = {{duration}}
[[goal]]
at_s = 0.3
position_m = {list(GOALS[0])}
hold = "orientation"
[[goal]]
at_s = 1.6
position_m = {list(GOALS[1])}
"""
BALL = """
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = 0.05
waypoints = [[0.0, 0.9, 0.0, 0.45], [1.6, 0.9, 0.0, 0.45], [2.3, 0.60, 0.0, 0.45], [3.2, 0.9, 0.0, 0.45]]
"""
BLOCK = f"""
[[obstacle]]
name = "block"
type = "box"
size_m = [0.12, 0.12, 0.12]
position_m = {list(GOALS[1])}
"""


class Run:
    """A demo that has been played: what it printed and left behind."""

    def __init__(self, folder: Path, scene: str) -> None:
        self.out = folder / "out"
        scenario = folder / "scene.toml"
        scenario.write_text(scene)
        command = [sys.executable, "-m", "tools.demo", "--lockstep", "--config", str(config_at(folder))]
        options = ["--scenario", str(scenario), "--out", str(self.out)]
        done = subprocess.run([*command, *options], capture_output=True, text=True, cwd=ROOT, check=False)
        self.code, self.text, self.errors = done.returncode, done.stdout, done.stderr
        print(self.text, self.errors)

    def tick(self, field: str) -> np.ndarray[Any, Any]:
        """A column of the log that the summary names."""
        (path,) = re.findall(r"(?m)^log +(\S+)", self.text)
        array = read(path)["/tick"].array[field]
        return np.asarray(array)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two goals and a ball that comes near the way between them."""
    return Run(tmp_path_factory.mktemp("good"), SCENE.format(duration=4.2) + BALL)


# ---- end to end


def test_a_demo_that_reaches_its_goals_says_so_and_exits_with_success(good: Run) -> None:
    assert (good.code, good.errors) == (0, "")
    for line in (
        r"panda: 2 goals, 1 obstacles, 4\.2 s, over socketpair",
        r" +\d\.\d\d s  state RUN",
        r" +0\.\d\d s  goal 1 of 2: \(0\.45, 0\.2, 0\.45\) m, orientation kept",
        r" +\d\.\d\d s  goal 1: arrived",
        r" +1\.\d\d s  goal 2 of 2: \(0\.45, -0\.2, 0\.45\) m",
        r" +\d\.\d\d s  goal 2: arrived",
        r" +\d\.\d\d s  RUN +goal  \d  error +\d+\.\d mm  speed \d\.\d\d m/s  nearest +\d+ mm ball",
        r"contacts +0",
        r"faults +none",
        r"exit codes +controller 0, drives 0",
        r"PASS  2 of 2 goals reached, 0 contacts",
    ):
        assert re.search(rf"(?m)^{line}\s*$", good.text), line
    lines = good.text.strip().split("\n")
    assert lines[0].startswith("LOCKSTEP")
    assert lines[-1].startswith("LOCKSTEP")
    assert not re.search("missed|deadline misses|wake-up late|drives late", good.text)
    assert "\x1b" not in good.text  # colours are for terminals


def test_where_the_encoders_say_the_tip_is_agrees_with_the_summary(good: Run) -> None:
    rows = re.findall(r"(?m)^([12]) +([+-]\S+) +([+-]\S+) +([+-]\S+) .* (\d+\.\d\d) mm ", good.text)
    assert [tuple(map(float, row[1:4])) for row in rows] == GOALS
    slot, q = good.tick("slot"), good.tick("q")
    running = np.flatnonzero(good.tick("state") == State.RUN)
    put = [np.flatnonzero((good.tick("goal") == goal).all(1))[0] for goal in GOALS]
    ends = [put[1] - 1, running[-1]]
    assert int(slot[put[1]]) - int(slot[put[0]]) == pytest.approx(1300, abs=250)  # 1.3 s, more or less
    for row, end, goal in zip(rows, ends, GOALS, strict=True):
        x = panda().evaluate(q[end], np.zeros(7), NO_POINTS).x
        away = float(np.linalg.norm(x - goal))
        assert away < 5e-3
        assert float(row[4]) == pytest.approx(away * 1e3, abs=1.0)


def test_the_clearance_is_the_drives_and_the_controller_keeps_more_than_it_thinks(good: Run) -> None:
    (told,) = re.findall(r"(?m)^ball +(\d+\.\d) mm", good.text)
    rho = good.tick("rho")[good.tick("state") == State.RUN]
    assert 0.0 < rho.min() < 0.1  # it came within the influence
    assert float(told) * 1e-3 > rho.min() - 2e-3  # spheres cover the links, the margin is pybullet's
    assert float(told) < 200.0


def test_the_plot_is_one_legible_page(good: Run) -> None:
    path = good.out / "demo.png"
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", head[16:24]) == (1600, 1200)
    page = matplotlib.image.imread(path)[:, :, :3]
    ink = np.asarray((page < 0.98).any(2))
    assert 0.05 < ink.mean() < 0.6
    thirds = [ink[:, k : k + 400].mean() for k in range(0, 1600, 400)]
    assert min(thirds) > 0.02  # every part of it shows something


def test_a_goal_inside_an_obstacle_fails_the_demo_by_name(tmp_path: Path) -> None:
    run = Run(tmp_path, SCENE.format(duration=2.0) + BLOCK)
    assert (run.code, run.errors) == (1, "")
    assert re.search(r"(?m)^ +1\.\d\d s  goal 2 of 2: .* refused: goal: lies 0\.060 m inside obstacle block", run.text)
    assert "FAIL  1 of 2 goals reached, 0 contacts" in run.text
    assert re.search(r"(?m)^ +goal 2: refused: goal: lies 0\.060 m inside obstacle block$", run.text)
    assert "goal 1:" not in run.text.split("FAIL")[1]
    assert (run.out / "demo.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


def test_what_does_not_start_is_told_in_one_line(tmp_path: Path) -> None:
    scenario = tmp_path / "scene.toml"
    scenario.write_text(SCENE.format(duration=1.0))
    command = [sys.executable, "-m", "tools.demo", "--lockstep", "--scenario", str(scenario), "--out", str(tmp_path)]
    done = subprocess.run(
        [*command, "--interface", "socketcan", "--channel", "none0"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert re.match(r"demo: drives ended with exit code 78: firmware_sim: none0: cannot be opened", done.stderr)


# ---- judging


def traced(x: F64, goals: Mapping[int, Goal]) -> Trace:
    """A trace of a tip that was at x (N, 3), one row a slot, all of it driven."""
    n = len(x)
    yes, zero = np.ones(n, np.bool_), np.zeros(n)
    return Trace(
        slot=np.arange(n),
        time=np.linspace(0.0, 1e-3 * (n - 1), n),
        missed=np.zeros(n, np.int64),
        q=np.zeros((n, 7)),
        x=x,
        xd=np.zeros((n, 3)),
        wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        goals=dict(goals),
        ratio=np.zeros((n, 7)),
        driven=yes,
        running=yes,
        lateness=zero,
        compute=zero,
        age=zero,
        faults=(),
        period=1e-3,
        joints=("a",),
        tracks={},
        v_max=0.5,
        influence=0.1,
        clearance=0.02,
    )


def account(**changes: Any) -> dict[str, Any]:
    """A drives' report without an incident."""
    quiet = {"min_clearance_m": {"all": 0.1, "ball": 0.1}, "min_self_clearance_m": 0.1, "contact_events": []}
    return {**quiet, "trips": [], **changes}


def judged(x: F64, goal: Goal, **changes: Any) -> Outcome:
    """The outcome of one goal, given in slot 10."""
    given = [Given(1, (0.0, 0.0, 0.0), 10)]
    exits = changes.pop("exits", {"controller": 0, "drives": 0})
    return judge(traced(x, {10: goal}), account(**changes), given, 1, len(x), "", exits)


def goal_at(position: list[float], task: Task = Task.POSITION, turn: float = 0.0) -> Goal:
    """A goal with an orientation about z [rad]."""
    return Goal(np.array(position), np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)]), task, 1e-3, 1e-2)


def line(*stretches: tuple[int, float]) -> F64:
    """A tip that stays at distances from the origin along x for so many slots."""
    return np.vstack([np.tile([distance, 0.0, 0.0], (count, 1)) for count, distance in stretches])


def test_a_goal_counts_where_the_tip_is_at_the_end_of_its_time() -> None:
    origin = goal_at([0.0, 0.0, 0.0])
    (there,) = judged(line((10, 0.1), (50, 0.1), (30, 0.0049)), origin).goals
    assert there.reached
    assert [there.first, there.last] == pytest.approx([0.05, 0.05])
    assert there.error == pytest.approx(0.0049)
    (back,) = judged(line((10, 0.1), (50, 0.1), (30, 0.0), (20, 0.03), (5, 0.001)), origin).goals
    assert back.reached
    assert [back.first, back.last] == pytest.approx([0.05, 0.1])
    (gone,) = judged(line((10, 0.1), (50, 0.0), (5, 0.0051)), origin).goals
    assert (gone.reached, gone.first, gone.last) == (False, 0.0, None)


def test_an_orientation_counts_only_where_it_was_asked_for() -> None:
    still = line((40, 0.0))
    assert judged(still, goal_at([0.0, 0.0, 0.0], Task.POSITION, 1.0)).goals[0].error_rot is None
    assert judged(still, goal_at([0.0, 0.0, 0.0], Task.POSE, 0.019)).failures == []
    askew = judged(still, goal_at([0.0, 0.0, 0.0], Task.POSE, 0.021))
    assert askew.failures == ["goal 1: not reached, 0.0 mm, 0.0210 rad away at the end"]


def test_the_deviation_is_the_distance_from_the_segment_not_from_its_line() -> None:
    way = np.array([[1.0, 0.0, 0.0]] * 11 + [[0.5, 0.03, 0.04], [-0.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert judged(way, goal_at([0.0, 0.0, 0.0])).goals[0].deviation == pytest.approx(0.2)
    assert judged(way[[*range(12), 13]], goal_at([0.0, 0.0, 0.0])).goals[0].deviation == pytest.approx(0.05)


def test_whatever_else_went_wrong_fails_the_run_by_name() -> None:
    still, origin = line((40, 0.0)), goal_at([0.0, 0.0, 0.0])
    touched = {"time": 1.5, "link": "hand", "other": "ball", "cause": "arm"}
    assert judged(still, origin, contact_events=[touched]).failures == ["contact: hand and ball at 1.50 s"]
    codes = {"controller": 0, "drives": -9}
    assert judged(still, origin, exits=codes).failures == ["drives ended with exit code -9"]
    early = judge(traced(still, {10: origin}), account(), [Given(1, (0.0, 0.0, 0.0), 10)], 3, 40, "FAULT", {})
    assert early.failures == ["goal 2: was never given", "goal 3: was never given", "ended early: FAULT"]


# ---- real time, where the machine keeps it


def outcome(reached: bool, missed: int = 0, slipped: float = 0.0) -> Outcome:
    """An outcome with one goal."""
    goal = GoalOutcome(Given(1, (0.0, 0.0, 0.0), 0), 0.0, reached, 0.0, 0.0, 0.1, None, 0.0)
    return Outcome([goal], [], {}, None, [], [], 10, missed, 10, 0.0, 0.0, slipped, (), 0.0, 0.0, "", {"controller": 0})


@pytest.mark.parametrize(
    ("options", "attempts", "played", "code"),
    [
        ([], [outcome(True)], ["real time"], 0),
        ([], ["too slow", outcome(True)], ["real time", "lockstep"], 0),  # the trial showed that it is too slow
        ([], [outcome(False, missed=3), outcome(True)], ["real time", "lockstep"], 0),
        ([], [outcome(False, slipped=0.01), outcome(False)], ["real time", "lockstep"], 1),
        ([], [outcome(False)], ["real time"], 1),  # not the machine's fault
        ([], [outcome(True, missed=3)], ["real time"], 0),
        (["--realtime"], [outcome(False, missed=3)], ["real time"], 1),
        (["--lockstep"], [outcome(True)], ["lockstep"], 0),
    ],
)
def test_lockstep_takes_over_only_where_the_machine_was_late(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    options: list[str],
    attempts: list[Outcome | str],
    played: list[str],
    code: int,
) -> None:
    modes: list[str] = []
    left = iter(attempts)

    def attempt(
        config: Path, file: Path, scenario: object, out: Path, lockstep: bool, trial: bool, told: demo.Told
    ) -> Outcome | str:
        modes.append("lockstep" if lockstep else "real time")
        return next(left)

    monkeypatch.setattr(demo, "_attempt", attempt)
    monkeypatch.setattr(demo, "probed", lambda period: "")
    assert demo.main(["--scenario", str(ROOT / "configs/demo.toml"), "--out", str(tmp_path), *options]) == code
    assert modes == played


def test_a_machine_that_wakes_up_late_plays_in_lockstep_at_once_and_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def attempt(*given: Any) -> Outcome:
        given[6].begin(given[4])
        return outcome(True)

    monkeypatch.setattr(demo, "_attempt", attempt)
    monkeypatch.setattr(demo.os, "sched_getaffinity", lambda process: {0, 1})
    late = [demo.clock.Slot(k, 0, 9e-4) for k in range(1000)]
    monkeypatch.setattr(demo.clock, "grid", lambda period: iter(late))
    assert demo.main(["--scenario", str(ROOT / "configs/demo.toml"), "--out", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.strip().split("\n")
    assert lines[0] == lines[-1] == demo.LOCKSTEP
    assert "wakes up 0.90 ms late" in lines[1]


class Clockwork:
    """Stands for a controller whose time has stopped."""

    def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        running = {"ok": True, "state": "RUN", "tick": 5, "missed": 0, "time_s": 0.005, "faults": [], "error_m": None}
        return {**running, "slot": 5, "clearance_m": {}, "speed_m_s": 0.0, "log": {"path": ""}}


def test_a_controller_whose_time_stands_still_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(player, "STUCK_S", 0.2)
    scenario = load_scenario(ROOT / "configs/demo.toml")
    stuck = player._Player(Clockwork(), scenario, lambda style, text: None, tuple)  # type: ignore[arg-type]
    with pytest.raises(DemoError, match="stood still"):
        stuck.play()


def test_a_child_that_ends_early_is_told_with_its_last_words(tmp_path: Path) -> None:
    child = Child("child", [sys.executable, "-c", "print('first'); print('why'); raise SystemExit(3)"], tmp_path / "o")
    with pytest.raises(DemoError, match=r"^child ended with exit code 3: why$"):
        child.expect("ready")
    assert child.end() == 3
    child.close()
    assert (tmp_path / "o").read_text() == "first\nwhy\n"


# ---- copies of config files


def test_a_working_copy_changes_what_it_is_told_and_keeps_the_comments(tmp_path: Path) -> None:
    source, target = tmp_path / "a.toml", tmp_path / "b.toml"
    source.write_text('# top\n[link]  # bus\nchannel = "x" # old\nbitrate = 5\n\n[log]\ndirectory = "d"\n')
    working_copy(source, target, {"link": {"channel": "a\\b"}, "console": {"socket": "s"}})
    text = target.read_text()
    assert text.startswith('# top\n[link]  # bus\nchannel = "a\\\\b"\n')
    assert "bitrate = 5\n\n[log]\ndirectory" in text
    assert text.endswith('[console]\nsocket = "s"\n')


def test_a_file_that_cannot_be_changed_line_by_line_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "a.toml"
    source.write_text('link = { channel = "x" }\n')
    with pytest.raises(DemoError, match=r"a\.toml: its tables link are written"):
        working_copy(source, tmp_path / "b.toml", {"link": {"channel": "y"}})


# ---- outlines


def surface(kind: str, d: list[float], rng: np.random.Generator) -> F64:
    """Points all over the surface of a solid, in its own frame."""
    u = rng.normal(size=(40_000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    round_, height = u[:, :2] / np.linalg.norm(u[:, :2], axis=1, keepdims=True), rng.uniform(-1, 1, (len(u), 1))
    match kind:
        case "sphere":
            return u * d[0]
        case "capsule":
            return np.vstack([u * d[0] + [0, 0, d[1]], u * d[0] - [0, 0, d[1]]])
        case "box":
            return u / np.abs(u).max(1, keepdims=True) * d[:3]
        case "cylinder":
            return np.hstack([round_ * d[0], np.sign(height) * d[1]])
        case "cone":
            low = height < 0
            return np.hstack([round_ * np.where(low, d[0], d[1]), np.where(low, -d[2], d[2])])
        case _:  # |x/a|^2n + |y/b|^2n + |z/c|^2n = 1
            n = d[3] if kind == "n_ellipsoid" else 1.0
            v = np.sign(u) * np.abs(u) ** (1.0 / n)
            return v / (np.abs(v) ** (2 * n)).sum(1, keepdims=True) ** (1 / (2 * n)) * d[:3]


@pytest.mark.parametrize("plane", [(1, 0), (1, 2)])
@pytest.mark.parametrize(
    ("kind", "dims"),
    [
        ("sphere", [0.2]),
        ("capsule", [0.1, 0.3]),
        ("box", [0.1, 0.2, 0.3]),
        ("cylinder", [0.2, 0.1]),
        ("cone", [0.2, 0.05, 0.2]),
        ("ellipsoid", [0.1, 0.2, 0.3]),
        ("n_ellipsoid", [0.1, 0.2, 0.3, 3.0]),
    ],
)
def test_an_outline_is_the_hull_of_the_solid_s_shadow(kind: str, dims: list[float], plane: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    wxyz = np.array([0.8, 0.3, -0.4, 0.33])
    d = np.array([*dims, *[0.0] * (4 - len(dims))])
    place = np.array([0.3, -0.2, 0.5])
    shape = Shape("it", kind, d, place, wxyz / np.linalg.norm(wxyz), np.zeros(3), np.zeros(3))
    shadow = (place + surface(kind, dims, rng) @ R_of(shape.wxyz).T)[:, plane]
    hull, outline = ConvexHull(shadow), ConvexHull(outline_of(shape, axis_view(*plane)))
    assert outline.volume == pytest.approx(hull.volume, rel=0.01)
    outside = (outline.equations[:, :2] @ shadow.T + outline.equations[:, 2:]).max(0)
    assert outside.max() < 2e-3  # [m], between two of its corners


def test_a_demo_that_is_told_to_end_leaves_no_process_behind(tmp_path: Path) -> None:
    scenario = tmp_path / "scene.toml"
    scenario.write_text(SCENE.format(duration=60.0))
    command = [sys.executable, "-m", "tools.demo", "--lockstep", "--scenario", str(scenario), "--out", str(tmp_path)]
    demo = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert demo.stdout is not None
    assert any("ready, log" in line for line in demo.stdout)
    children = Path(f"/proc/{demo.pid}/task/{demo.pid}/children").read_text().split()
    assert len(children) >= 2
    demo.send_signal(signal.SIGTERM)
    demo.communicate()
    assert demo.returncode == 130
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]
