"""The command line: what it says, where it says it, and its exit codes."""

import io
import json
import math
import os
import pwd
import re
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtctl.arm.record import record_dtype
from rtctl.arm.task import names
from rtctl.cli import build_parser, main, values
from rtctl.errors import EXIT_CONFIG, EXIT_FAILED, EXIT_OK, EXIT_USAGE, UsageError, until_interrupted
from rtctl.hal import doctor
from rtctl.hal.console import Console
from rtctl.hal.messages import Bounds
from rtctl.log import Kind, McapSink, make_header
from rtctl.types import ObstacleEdit, Request, Task, Verb

ROOT = Path(__file__).parent.parent
Said = pytest.CaptureFixture[str]


COMES_TO = {Verb.ARM: "RUN", Verb.RECOVER: "RUN", Verb.DISARM: "IDLE", Verb.STOP: "SAFE_STOP", Verb.RESET: "IDLE"}


class Arm:
    """A daemon of few words: takes goals, reaches those with y >= 0 after a few looks, refuses to arm twice."""

    def __init__(self, folder: Path, name: str = "toy") -> None:
        self.console = Console(str(folder / f"rtctl-{name}.sock"), 0.001, Bounds((0.0, 0.0, 0.0), 1.0, 0.003, 0.015))
        self.console.publish(self.status)
        self.requests: list[Request] = []
        self.state, self.goal, self.looks, self.over = "RUN", np.zeros(3), 0, threading.Event()
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def status(self) -> dict[str, Any]:
        self.looks += 1
        there = self.looks > 2 and self.goal[1] >= 0.0
        return {
            "robot": "toy",
            "state": self.state,
            "status": "arrived" if there else "moving",
            "detail": "",
            "tick": self.looks,
            "time_s": 1.5,
            "q_rad": [0.0, math.pi / 2],
            "x_m": [0.1, 0.2, 0.3],
            "wxyz": [0.0, 1.0, 0.0, 0.0],
            "goal_m": self.goal,
            "error_m": 0.0012,
            "error_rad": 0.01,
            "clearance_m": {"crate": 0.25, "ball": 0.021, "wall": math.inf},
            "missed": 3,
            "lateness_s": 12e-6,
            "faults": ["drive_fault"] if self.state == "FAULT" else [],
            "log": {"path": "logs/x.mcap", "dropped": 0},
        }

    def _refusal(self, verb: Verb) -> str:
        return "arm: is in RUN, wanted IDLE" if verb == Verb.ARM and self.state == "RUN" else ""

    def _run(self) -> None:
        slot = 0
        while not self.over.is_set():
            request = self.console.poll(slot)
            if request != Request():
                self.requests.append(request)
            if request.goal is not None:
                self.goal, self.looks = request.goal.position, 0
                self.state = "FAULT" if self.goal[2] < 0.0 else "RUN"
            self.console.answer(not self._refusal(request.verb), self._refusal(request.verb))
            self.state = self.state if self._refusal(request.verb) else COMES_TO.get(request.verb, self.state)
            slot += 1
            self.over.wait(0.0005)

    def close(self) -> None:
        self.over.set()
        self.thread.join()
        self.console.close()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    return tmp_path


@pytest.fixture
def arm(folder: Path) -> Iterator[Arm]:
    toy = Arm(folder)
    yield toy
    toy.close()


def run(*words: str, stdin: str = "") -> "subprocess.CompletedProcess[str]":
    """Run the command as people do."""
    return subprocess.run(
        [sys.executable, "-m", "rtctl", *words], capture_output=True, text=True, input=stdin, cwd=ROOT, check=False
    )


# -- the command line itself ----------------------------------------------------------------------------------------


def commands(parser: Any, name: str = "rtctl") -> Iterator[tuple[str, Any]]:
    yield name, parser
    for action in parser._actions:
        if isinstance(action.choices, dict):
            for word, below in action.choices.items():
                yield from commands(below, f"{name} {word}")


COMMANDS = dict(commands(build_parser()))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example_of_itself(name: str) -> None:
    text = COMMANDS[name].format_help()
    assert f"\n  {name}" in text.split("example:")[1] or name == "rtctl"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_example_in_the_help_parses(name: str) -> None:
    lines = COMMANDS[name].format_help().split("example:")[1].splitlines()
    for line in [line.strip() for line in lines if line.strip().startswith("rtctl")]:
        for call in line.split("&&"):
            words = re.split(r"[>&|]", call)[0].split()
            assert build_parser().parse_args(words[1:]).work is not None


def test_the_commands_of_the_published_interface_exist() -> None:
    wanted = {"check", "run", "arm", "disarm", "stop", "reset", "goal", "goals", "obstacle", "obstacle set"}
    wanted |= {"obstacle clear", "status", "sim", "log", "log info", "log export", "doctor", "bench"}
    assert {f"rtctl {word}" for word in wanted} <= set(COMMANDS)


def test_help_and_asking_a_daemon_load_nothing_heavy() -> None:
    code = (
        "import sys; import rtctl.cli, rtctl.hal.client; rtctl.cli.build_parser().format_help();"
        "print(sorted({'numpy','numba','pinocchio','msgspec','rich','can','pybullet','mcap'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["dance"],
        ["goal", "1", "2"],
        ["goal", "0.1", "0.2", "nan"],
        ["goal", "0.1", "0.2", "1e999"],
        ["goal", "0.1", "0.2", "0.3", "--rpy", "0", "0", "0", "--wxyz", "1", "0", "0", "0"],
        ["goal", "0.1", "0.2", "0.3", "--timeout", "-1"],
        ["obstacle"],
        ["obstacle", "clear"],
        ["obstacle", "set", "ball", "sphere", "radius_m"],
        ["obstacle", "set", "ball", "sphere", "radius_m=1", "radius_m=2"],
        ["obstacle", "set", "ball", "sphere", "position_m=1,nan,2"],
        ["status", "--sock", "x"],
        ["status", "--socket", "a", "--robot", "b"],
        ["doctor", "--wakes", "0"],
        ["check"],
    ],
    ids=" ".join,
)
def test_a_wrong_call_is_exit_code_2_and_one_line_on_stderr(words: list[str], capsys: Said) -> None:
    assert main(words) == EXIT_USAGE
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("rtctl: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("words", [["check", "none.toml"], ["run", "none.toml"], ["sim", "none.toml"]], ids=" ".join)
def test_a_file_that_is_not_there_is_exit_code_78_and_one_line_naming_it(words: list[str]) -> None:
    out = run(*words)
    assert out.returncode == EXIT_CONFIG
    assert out.stdout == ""
    assert out.stderr.startswith("rtctl: none.toml")
    assert out.stderr.count("\n") == 1


def test_no_daemon_is_exit_code_1_and_says_where_it_looked(folder: Path, capsys: Said) -> None:
    assert main(["stop"]) == EXIT_FAILED
    assert str(folder) in capsys.readouterr().err


def test_output_into_a_closed_pipe_is_quiet() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "rtctl", "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == EXIT_FAILED


def test_an_interrupt_is_quiet(arm: Arm) -> None:
    words = [sys.executable, "-m", "rtctl", "goal", "0.1", "-0.2", "0.3", "--wait"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT)
    while not arm.looks:  # it waits for a goal that is never reached
        arm.over.wait(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert out == b""
    assert b"Traceback" not in err
    assert process.returncode == EXIT_FAILED


def test_an_interrupt_while_compiled_code_runs_is_one_too() -> None:
    with until_interrupted():  # as the interpreter tells it, that finds it beside a result
        raise SystemError("servo returned a result with an exception set") from KeyboardInterrupt()
    with pytest.raises(SystemError), until_interrupted():
        raise SystemError("another")


def test_the_version_is_that_of_the_package() -> None:
    from importlib.metadata import version

    assert run("--version").stdout == f"rtctl {version('rtctl')}\n"


# -- operator's verbs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "end"),
    [("disarm", "IDLE"), ("stop", "SAFE_STOP, at rest; rtctl reset leaves it"), ("reset", "IDLE"), ("recover", "RUN")],
)
def test_a_verb_reaches_the_daemon_and_says_what_it_came_to(arm: Arm, word: str, end: str, capsys: Said) -> None:
    assert main([word]) == EXIT_OK
    assert [request.verb.name for request in arm.requests] == [word.upper()]
    assert capsys.readouterr().out == f"{word}: {end}\n"


def test_a_verb_that_is_not_to_wait_says_that_it_was_taken(arm: Arm, capsys: Said) -> None:
    assert main(["stop", "--no-wait"]) == EXIT_OK
    assert capsys.readouterr().out == "stop: accepted\n"


def test_a_refusal_is_exit_code_1_with_the_supervisors_reason(arm: Arm, capsys: Said) -> None:
    assert main(["arm"]) == EXIT_FAILED
    assert capsys.readouterr().err == "rtctl: refused: arm: is in RUN, wanted IDLE\n"


def test_a_goal_reaches_the_tick_as_it_was_typed(arm: Arm) -> None:
    words = ["-.3", "-1e-3", "5e-1", "--wxyz", "0", "1", "0", "0", "--tolerance", "0.01", "--no-wait"]
    assert main(["goal", *words]) == EXIT_OK
    goal = arm.requests[0].goal
    assert goal is not None
    assert goal.position.tolist() == [-0.3, -0.001, 0.5]
    assert goal.wxyz.tolist() == [0.0, 1.0, 0.0, 0.0]
    assert goal.tolerance == 0.01


def test_a_heading_is_a_bases_and_an_arm_says_what_it_takes_instead(arm: Arm, capsys: Said) -> None:
    assert main(["goal", "0.3", "0", "0.5", "--heading", "1.5"]) == EXIT_FAILED
    assert "goal.heading_rad: got 1.5, wanted rpy_rad or wxyz" in capsys.readouterr().err
    assert not arm.requests


def test_hold_orientation_asks_for_the_present_one(arm: Arm) -> None:
    assert main(["goal", "0.3", "0", "0.5", "--hold-orientation"]) == EXIT_OK
    goal = arm.requests[0].goal
    assert goal is not None
    assert goal.wxyz.tolist() == [0.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("words", "task"),
    [
        ([], Task.POSITION),
        (["--axes", "xz"], Task.X | Task.Z),
        (["--rpy", "0", "0", "1"], Task.POSE),
        (["--direction", "0", "0", "-1", "--tool-axis", "y"], Task.POSITION | Task.DIRECTION),
        (["--axes", "y", "--direction", "0", "1", "0"], Task.Y | Task.DIRECTION),
        (["--axes", "none", "--direction", "0", "1", "0"], Task.DIRECTION),
    ],
    ids=lambda value: "" if isinstance(value, list) else names(value),
)
def test_a_goal_constrains_what_was_typed(arm: Arm, words: list[str], task: Task) -> None:
    assert main(["goal", "0.1", "0.2", "0.3", *words, "--wait", "--reply", "60"]) == EXIT_OK
    goal = arm.requests[0].goal
    assert goal is not None
    assert goal.task == task
    assert goal.axis.tolist() == ([0.0, 1.0, 0.0] if "--tool-axis" in words else [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--axes", "xw"], "axes"),
        (["--axes", "xx"], "goal.axes: got x, x, wanted each axis once"),
        (["--tool-axis", "x"], "goal.tool_axis: got x, wanted a direction beside it"),
        (["--direction", "0", "0", "0"], "goal.direction"),
        (["--axes", "none"], "wanted a position, an orientation or a direction"),
    ],
    ids=["unknown axis", "axis twice", "axis without direction", "no direction", "nothing"],
)
def test_a_part_of_a_pose_that_makes_no_sense_is_refused(arm: Arm, words: list[str], why: str, capsys: Said) -> None:
    assert main(["goal", "0.1", "0.2", "0.3", *words]) == EXIT_USAGE
    assert why in capsys.readouterr().err
    assert arm.requests == []


def test_a_goal_out_of_reach_is_refused_in_one_line(arm: Arm, capsys: Said) -> None:
    assert main(["goal", "3", "0", "0.5"]) == EXIT_FAILED
    assert "3.041 m from the base" in capsys.readouterr().err
    assert arm.requests == []


@pytest.mark.parametrize(
    ("words", "code", "why"),
    [
        (["0.3", "0.1", "0.5"], EXIT_OK, "arrived"),
        (["0.3", "-0.1", "0.5", "--timeout", "0.2"], EXIT_FAILED, "moving"),
        (["0.3", "0.1", "-0.5"], EXIT_FAILED, "FAULT: drive_fault"),
    ],
    ids=["reached", "never reached", "fault on the way"],
)
def test_wait_returns_what_became_of_the_goal(arm: Arm, capsys: Said, words: list[str], code: int, why: str) -> None:
    assert main(["goal", *words, "--wait", "--json"]) == code
    outcome = json.loads(capsys.readouterr().out)
    assert outcome["arrived"] is (code == EXIT_OK)
    assert outcome["why"].startswith(why)
    assert outcome["error_m"] == 0.0012


def test_a_file_of_goals_is_sent_one_after_the_other(arm: Arm, tmp_path: Path, capsys: Said) -> None:
    file = tmp_path / "tour.csv"
    file.write_text('# a tour\nx,y,z\n0.1,0.2,0.3\n\n{"position_m": [0.2, 0.2, 0.3]}\n0.3,0.2,0.3\n')
    assert main(["goals", str(file)]) == EXIT_OK
    assert [r.goal.position[0] for r in arm.requests if r.goal] == [0.1, 0.2, 0.3]
    assert capsys.readouterr().out.count("arrived") == 3


def test_a_goal_that_fails_ends_the_stream_unless_told_to_keep_going(arm: Arm, tmp_path: Path) -> None:
    file = tmp_path / "tour.csv"
    file.write_text("0.1,-0.2,0.3\n5,0,0\n0.1,0.2,0.3\n")
    assert main(["goals", str(file), "--timeout", "0.1"]) == EXIT_FAILED
    assert len(arm.requests) == 1
    assert main(["goals", str(file), "--timeout", "0.1", "--keep-going"]) == EXIT_FAILED
    assert len(arm.requests) == 3  # the one out of reach never came to a tick


def test_goals_come_from_standard_input_as_a_stream(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("0.1 ,-0.2,0.3\n0.2,-0.2,0.3\n"))
    assert main(["goals", "-", "--rate", "1000"]) == EXIT_OK
    assert [r.goal.position[0] for r in arm.requests if r.goal] == [0.1, 0.2]


def test_an_obstacle_is_set_from_key_value_words(arm: Arm) -> None:
    words = ["crate", "box", "size_m=0.2,0.4,0.1", "position_m=[0.5, 0, 0.05]", "velocity_m_s=0,-0.1,0"]
    assert main(["obstacle", "set", *words]) == EXIT_OK
    assert main(["obstacle", "clear", "crate"]) == EXIT_OK
    assert main(["obstacle", "clear", "--all"]) == EXIT_OK
    edits: list[ObstacleEdit] = [edit for request in arm.requests for edit in request.obstacles]
    assert edits[0].shape is not None
    assert edits[0].shape.dims[:3].tolist() == [0.1, 0.2, 0.05]  # half sizes
    assert edits[0].shape.velocity.tolist() == [0.0, -0.1, 0.0]
    assert [(e.name, e.shape) for e in edits[1:]] == [("crate", None), ("*", None)]


def test_an_obstacle_with_a_wrong_key_is_refused_before_anybody_is_asked(folder: Path, capsys: Said) -> None:
    assert main(["obstacle", "set", "b", "sphere", "radius=1", "position_m=0,0,1"]) == EXIT_USAGE
    assert "obstacle.set.radius: got an unknown name, wanted radius_m" in capsys.readouterr().err


# -- which daemon ---------------------------------------------------------------------------------------------------


def test_with_several_daemons_one_must_be_named(arm: Arm, folder: Path, capsys: Said) -> None:
    other = Arm(folder, "other")
    try:
        assert main(["stop"]) == EXIT_USAGE
        assert "--robot NAME" in capsys.readouterr().err
        assert main(["stop", "--robot", "other"]) == EXIT_OK
        assert main(["stop", "--socket", arm.console.path]) == EXIT_OK
    finally:
        other.close()
    assert (len(arm.requests), len(other.requests)) == (1, 1)


def test_a_socket_without_a_daemon_does_not_count(arm: Arm, folder: Path) -> None:
    import socket

    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(folder / "rtctl-dead.sock"))
    assert main(["reset"]) == EXIT_OK


# -- status ---------------------------------------------------------------------------------------------------------


def test_status_as_json_is_the_daemons_own(arm: Arm, capsys: Said) -> None:
    assert main(["status", "--json"]) == EXIT_OK
    found = json.loads(capsys.readouterr().out)
    assert found["clearance_m"] == {"crate": 0.25, "ball": 0.021, "wall": None}
    assert found["q_rad"] == [0.0, math.pi / 2]


def test_status_shows_state_task_nearest_obstacle_first_and_joints_in_degrees(arm: Arm, capsys: Said) -> None:
    assert main(["status"]) == EXIT_OK
    text = capsys.readouterr().out
    for words in ("RUN", "moving", "+0.100 +0.200 +0.300", "1.2 mm", "0.57 deg", "+90.0", "missed 3", "logs/x.mcap"):
        assert words in text
    assert text.index("21.0 mm") < text.index("250.0 mm") < text.index("wall")


def test_watching_without_a_terminal_prints_a_line_at_a_time_until_interrupted(arm: Arm) -> None:
    words = [sys.executable, "-m", "rtctl", "status", "--watch"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    first = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert "RUN" in first
    assert "clearance 21.0 mm" in first
    assert (process.returncode, err) == (EXIT_OK, "")


def test_watching_a_daemon_that_ends_says_so(arm: Arm) -> None:
    words = [sys.executable, "-m", "rtctl", "status", "--watch", "--json"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    assert json.loads(process.stdout.readline())["ok"] is True
    arm.close()
    _, err = process.communicate()
    assert process.returncode == EXIT_FAILED
    assert err.count("\n") == 1
    assert "daemon" in err
    arm.over.set()


# -- files of goals -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("1,2,3", {"position_m": [1, 2, 3]}),
        ("1,2,3,0.1,0.2,0.3", {"position_m": [1, 2, 3], "rpy_rad": [0.1, 0.2, 0.3]}),
        ("1,2,3,1,0,0,0", {"position_m": [1, 2, 3], "wxyz": [1, 0, 0, 0]}),
        ("z,y,x,tolerance_m\n3,2,1,0.01", {"position_m": [1, 2, 3], "tolerance_m": 0.01}),
        ("x,y,z,roll,pitch,yaw\n1,2,3,,,", {"position_m": [1, 2, 3]}),
        ("x,y,z,axes\n1,2,3,xy", {"position_m": [1, 2, 3], "axes": ["x", "y"]}),
        ("dx,dy,dz,tool_axis\n0,0,-1,-x", {"direction": [0, 0, -1], "tool_axis": "-x"}),
        ('{"rpy_rad": [1,2,3]}', {"rpy_rad": [1, 2, 3]}),
        ('{"position_m": [1,2,3], "hold": "orientation"}', {"position_m": [1, 2, 3], "hold": "orientation"}),
    ],
)
def test_a_goal_line_in_each_form(text: str, wanted: dict[str, Any]) -> None:
    ((_, message),) = values.goal_messages(text.splitlines(), "f")
    assert message == {"verb": "goal", **wanted}


@pytest.mark.parametrize(
    "text",
    [
        "1,2",
        "1,2,nan",
        "1,2,3,4",
        "x,y,w\n1,2,3",
        "x,y,z,roll\n1,2,3,4",
        "x,y\n1,2",
        "x,y,x\n1,2,3",
        "x,y,z\n1,2",
        "{",
        '{"a": 1}',
        '{"position_m": [NaN, 0, 0]}',
        "[" * 5000,
        '{"a":' * 9000,
    ],
)
def test_a_goal_line_that_makes_no_sense_is_named_by_file_and_line(text: str) -> None:
    with pytest.raises(UsageError, match=r"^f:[12]: "):
        list(values.goal_messages(text.splitlines(), "f"))


# -- offline --------------------------------------------------------------------------------------------------------


def test_the_printed_schema_of_configs_is_the_one_that_is_shipped() -> None:
    shipped = json.loads((ROOT / "configs" / "schema.json").read_text())
    assert json.loads(run("schema", "config").stdout) == shipped


@pytest.mark.parametrize("what", ["scenario", "request"])
def test_the_other_schemas_are_json_with_a_title(what: str, capsys: Said) -> None:
    assert main(["schema", what]) == EXIT_OK
    assert json.loads(capsys.readouterr().out)["title"] == f"rtctl {what}"


def test_check_prints_the_derived_robot() -> None:
    out = run("check", "configs/panda.toml")
    assert (out.returncode, out.stderr) == (EXIT_OK, "")
    for words in ("bus load", "rho_num", "eta", "points cover", "braking distance"):
        assert words in out.stdout


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of three ticks of a robot with two joints."""
    dtype = record_dtype(2, 1)
    path = tmp_path / "run.mcap"
    sink = McapSink(path, make_header("toy", ["a", "b"], 1, 0.001))
    for k in range(3):
        record = np.zeros((), dtype)
        record["tick"], record["x"], record["rho"] = k, (0.1 * k, 0.2, 0.3), np.inf
        sink.put(Kind.TICK, record.tobytes(), 1_000_000 * (k + 1))
    sink.close("end")
    return path


def test_log_info_counts_what_was_written(log: Path, capsys: Said) -> None:
    assert main(["log", "info", str(log), "--json"]) == EXIT_OK
    found = json.loads(capsys.readouterr().out)
    assert found["robot"] == "toy"
    assert found["complete"] is True
    assert found["topics"]["/tick"]["messages"] == 3
    assert main(["log", "info", str(log)]) == EXIT_OK
    assert re.search(r"/tick +3 ", capsys.readouterr().out)


def test_log_export_writes_the_chosen_fields_exactly(log: Path, capsys: Said) -> None:
    assert main(["log", "export", str(log), "--fields", "tick,x,rho"]) == EXIT_OK
    rows = [line.split(",") for line in capsys.readouterr().out.splitlines()]
    assert rows[0] == ["log_time_ns", "tick", "x.0", "x.1", "x.2", "rho.0"]
    numbers = [[float(cell) for cell in row[1:]] for row in rows[1:]]
    assert numbers == [[k, 0.1 * k, 0.2, 0.3, math.inf] for k in range(3)]


def test_log_export_names_the_fields_there_are(log: Path, capsys: Said) -> None:
    assert main(["log", "export", str(log), "--fields", "zz"]) == EXIT_USAGE
    assert "tau_sent" in capsys.readouterr().err


def test_a_file_that_is_no_log_is_one_line(tmp_path: Path, capsys: Said) -> None:
    path = tmp_path / "x.mcap"
    path.write_text("no log")
    assert main(["log", "info", str(path)]) == EXIT_FAILED
    assert capsys.readouterr().err.count("\n") == 1


def test_the_summary_of_a_simulation_shows_its_figures(capsys: Said) -> None:
    from rtctl.cli.summary import show

    goal = {"at_s": 0.1, "arrived": True, "time_to_goal_s": 1.234, "error_m": 1e-3, "error_rad": 0.002}
    result = {
        "arrived": True,
        "contacts": 0,
        "mode_final": "RUN",
        "faults": ["frame_lost"],
        "goals": [{**goal, "line_deviation_m": 3e-4}, {**goal, "arrived": False, "time_to_goal_s": None}],
        "min_clearance_m": {"all": 0.02, "ball": 0.02, "crate": None},
        "path_length_m": 1.5,
        "max_torque_ratio": 0.42,
        "statuses": [[0.0, "moving", ""], [1.3, "shadowed", "ball"]],
        "ticks": 8000,
        "missed": 0,
        "realtime_factor": 4.2,
        "digest": "ab" * 32,
    }
    show(result, "demo.toml", "run.mcap")
    text = capsys.readouterr().out
    for words in ("arrived", "1.23 s", "0.30 mm", "not reached", "20.0 mm", "42 %", "shadowed", "ab" * 32, "run.mcap"):
        assert words in text
    assert "frame_lost" in text


# -- doctor ---------------------------------------------------------------------------------------------------------


def machine(root: Path, **files: str) -> str:
    """Build a /sys and /proc as a test wants them; `__` stands for a slash."""
    (root / "dev/shm").mkdir(parents=True)
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return str(root)


def rows_of(root: str) -> dict[str, doctor.Row]:
    return {row.name: row for row in doctor.examine(root, wakes=10)}


def nothing_granted(which: int) -> tuple[int, int]:
    return (0, 0)


CAN0 = {"sys__class__net__can0__type": "280", "sys__class__net__can0__flags": "0x40081"}


def test_doctor_reads_each_can_interface(tmp_path: Path) -> None:
    good = {**CAN0, "sys__class__net__can0__mtu": "72", "sys__class__net__can0__tx_queue_len": "128"}
    short = {k.replace("can0", "can1"): v for k, v in good.items()} | {"sys__class__net__can1__tx_queue_len": "10"}
    down = {k.replace("can0", "can2"): v for k, v in good.items()} | {"sys__class__net__can2__flags": "0x40080"}
    ethernet = {"sys__class__net__eth0__type": "1"}
    rows = rows_of(machine(tmp_path, **good, **short, **down, **ethernet))
    verdicts = [rows[f"CAN interface can{i}"].verdict for i in range(3)]
    assert verdicts == [doctor.OK, doctor.WARN, doctor.WARN]
    assert rows["CAN interface can0"].got == "up, CAN FD, txqueuelen 128"
    assert not any("eth0" in name for name in rows)


def test_doctor_warns_of_a_slow_clock_a_lazy_governor_and_no_real_time_share(tmp_path: Path) -> None:
    files = {
        "sys__devices__system__clocksource__clocksource0__current_clocksource": "hpet",
        "sys__devices__system__cpu__cpu0__cpufreq__scaling_governor": "powersave",
        "proc__sys__kernel__sched_rt_runtime_us": "0",
        "proc__version": "Linux version 6.1.0 SMP PREEMPT_DYNAMIC",
    }
    rows = rows_of(machine(tmp_path, **files))
    names = ("clock source", "CPU governor", "real-time share", "preemption")
    assert [rows[name].verdict for name in names] == [doctor.WARN] * 4


def test_doctor_fails_without_real_time_rights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = machine(tmp_path, proc__self__status="Name:\tx\nCapEff:\t0000000000000000")
    monkeypatch.setattr(resource, "getrlimit", nothing_granted)
    rows = doctor.examine(root, wakes=10)
    verdicts = {row.name: row.verdict for row in rows}
    assert verdicts["real-time priority"] == verdicts["locked memory"] == doctor.FAIL
    assert doctor.exit_code(rows) == EXIT_FAILED
    assert "FAIL" in doctor.render(rows)


@pytest.mark.parametrize("capability", [14, 23], ids=["IPC_LOCK", "SYS_NICE"])
def test_doctor_takes_a_capability_for_a_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capability: int
) -> None:
    root = machine(tmp_path, proc__self__status=f"CapEff:\t{1 << capability:016x}")
    monkeypatch.setattr(resource, "getrlimit", nothing_granted)
    rows = {row.name: row.verdict for row in doctor.examine(root, wakes=10)}
    wanted = {14: (doctor.FAIL, doctor.OK), 23: (doctor.OK, doctor.FAIL)}[capability]
    assert (rows["real-time priority"], rows["locked memory"]) == wanted


def test_doctor_leaves_the_callers_scheduler_alone_and_its_verdict_is_the_exit_code(capsys: Said) -> None:
    before = os.sched_getscheduler(0)
    code = main(["doctor", "--wakes", "10", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert os.sched_getscheduler(0) == before
    assert code == (EXIT_OK if found["ok"] else EXIT_FAILED)
    assert {row["name"] for row in found["findings"]} >= {"wake-up latency", "real-time priority", "clock source"}


@pytest.mark.parametrize(("name", "code"), [("root", 2), ("0", 2), (str(os.geteuid()), 2), ("no such user", 1)])
def test_only_a_strangers_lock_can_be_passed_over(name: str, code: int, capsys: Said) -> None:
    assert main(["run", "none.toml", "--pass-lock-of", name]) == code
    said = capsys.readouterr().err
    assert said.startswith("rtctl: ")
    assert name in said


def test_whose_lock_is_passed_over_reaches_the_daemon(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rtctl.app import daemon

    asked: list[Any] = []

    def run(config: str, **how: Any) -> int:
        asked.append(how["passing"])
        return EXIT_OK

    monkeypatch.setattr(daemon, "run", run)
    config = folder / "toy.toml"
    config.write_text((ROOT / "configs" / "panda.toml").read_text())
    monkeypatch.setattr("rtctl.cli.offline.prepare", lambda *_, **__: None)
    assert main(["run", str(config), "--pass-lock-of", "nobody", "--pass-lock-of", "12345"]) == EXIT_OK
    assert main(["run", str(config)]) == EXIT_OK
    assert asked == [{pwd.getpwnam("nobody").pw_uid, 12345}, frozenset()]
