"""What `import rtctl` offers is what its list says; the examples of the pages run."""

import inspect
import subprocess
import sys
from importlib import util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import rtctl
from rtctl.errors import ConfigError
from tests.lab import PANDA, ROOT

EXAMPLES = ROOT / "docs" / "examples"
PLANAR = ROOT / "configs" / "planar4.toml"
START, GOAL = [0.6, -0.5, -0.6, -0.5], [1.2, 0.4, 0.0]


def example(name: str) -> ModuleType:
    spec = util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_list_is_true():
    public = {name for name in dir(rtctl) if not name.startswith("_")}
    modules = {name for name in public if inspect.ismodule(getattr(rtctl, name))}
    assert public - modules == {*rtctl.__all__, "Any", "import_module"}
    assert sorted(rtctl.__all__) == rtctl.__all__
    for name in rtctl.__all__:
        assert inspect.getdoc(getattr(rtctl, name)), name
        assert f"rtctl.{name}" in (rtctl.__doc__ or "") or name == "Robot", name
    with pytest.raises(AttributeError, match="it offers Robot, initial"):
        rtctl.nothing  # noqa: B018


def test_importing_it_imports_nothing_heavy():
    code = "import rtctl, sys; print(sorted({'numpy', 'numba', 'pinocchio', 'pybullet', 'viser'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_mistakes_are_told_in_a_line(tmp_path):
    with pytest.raises(ConfigError, match=r"robot.kind: got base"):
        rtctl.load(ROOT / "configs" / "rover.toml")
    with pytest.raises(ConfigError, match=r"got shape \(3,\), wanted \(4,\), one angle a joint"):
        rtctl.initial(rtctl.load(PLANAR), np.zeros(3))
    assert PANDA.is_file()


def test_stepping_the_law_arrives(capsys):
    way = example("step_the_law").run(str(PLANAR), np.array(START), np.array(GOAL), 4.0)
    assert np.linalg.norm(way[-1] - GOAL) < 0.003
    assert "RUN, arrived" in capsys.readouterr().out


def test_the_straight_line_of_the_paper_and_its_table(tmp_path):
    away, speed = example("straight_line").run(PLANAR, START, GOAL, 5.0, tmp_path)
    assert away < 0.01
    assert speed < 1.02 * 0.5
    table = example("log_to_pandas").frame(tmp_path / "line.mcap")
    assert list(table.columns) == ["tau joint_1", "tau joint_2", "tau joint_3", "tau joint_4", "error", "nearest"]
    assert table["error"].iloc[-1] < 0.003
    assert (np.diff(table.index) > 0).all()


def test_an_obstacle_of_ones_own_is_kept_clear_of(tmp_path: Path):
    oracle, own = example("your_own_obstacle").run(PLANAR, [1.75, 0.75, 0.0], tmp_path)
    assert 0.0 < own <= oracle + 1e-6 < 0.5
