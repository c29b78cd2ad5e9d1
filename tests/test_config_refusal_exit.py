"""A refused config ends the program with code 78 and one line on stderr that names the key; no traceback."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.config_leaves import replaced, write

PANDA = Path(__file__).parents[1] / "configs" / "panda.toml"
TABLE: dict[str, Any] = tomllib.loads(PANDA.read_text())


def check(path: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run `rtctl check` as a user does."""
    command = [sys.executable, "-m", "rtctl", "check", str(path), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(
    ("path", "value", "place"),
    [
        (("robot", "joints", 2, "q_min_rad"), float("nan"), "robot.joints[2].q_min_rad"),
        (("motion", "v_max_m_s"), ..., "motion.v_max_m_s"),
        (("motion", "speed"), 1.0, "motion.speed"),
        (("loop", "servo_hz"), "fast", "loop.servo_hz"),
        (("safety", "watchdog_ms"), 2.5, "safety.watchdog_ms"),
        (("robot", "tip_frame"), "panda_tool", "robot.tip_frame"),
        (("link", "data_bitrate"), 2_000_000, "loop.servo_hz"),
    ],
)
def test_a_refused_config_exits_78_with_one_line_that_names_the_key(
    path: tuple[str | int, ...], value: Any, place: str, tmp_path: Path
) -> None:
    file = write(tmp_path / "panda.toml", replaced(TABLE, path, value))
    done = check(file)
    assert (done.returncode, done.stdout) == (78, "")
    assert len(done.stderr.splitlines()) == 1
    assert f"{file}: {place}: got " in done.stderr


def test_a_file_that_is_no_toml_exits_78_naming_the_line(tmp_path: Path) -> None:
    file = tmp_path / "bad.toml"
    file.write_text("[robot]\nname = 'panda\n")
    done = check(file)
    assert done.returncode == 78
    assert f"{file}: line 2" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_the_shipped_config_passes_and_prints_its_figures() -> None:
    done = check(PANDA, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    figures = {row["name"]: row["value"] for row in json.loads(done.stdout)["rows"]}
    assert figures["obstacle eta"] == pytest.approx(1.56e-4, rel=2e-3)
