"""What `import rtctl` offers is what its list says; the examples of the pages run."""

import inspect
import subprocess
import sys
from importlib import util
from pathlib import Path
from types import ModuleType

import matplotlib.image
import numpy as np
import pytest

import rtctl
from rtctl.errors import ConfigError
from tests.lab import ROOT

PANDA = ROOT / "configs" / "panda.toml"
EXAMPLES = ROOT / "docs" / "examples"


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


def test_mistakes_are_told_in_a_line():
    with pytest.raises(ConfigError, match=r"robot.kind: got base"):
        rtctl.load(ROOT / "configs" / "rover.toml")


def test_a_log_becomes_a_table():
    table = example("log_to_pandas").frame(ROOT / "tests" / "golden" / "goals.mcap")
    log = rtctl.read(ROOT / "tests" / "golden" / "goals.mcap")
    assert list(table.columns[-3:]) == ["tau panda_joint7", "error", "nearest"]
    assert len(table) == log.count("/tick")
    assert table["error"].iloc[-1] == log["/tick"].error[-1]
    assert (np.diff(table.index) > 0).all()


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))  # one script uses another


@pytest.mark.usefixtures("examples")
def test_the_law_is_stepped_by_hand(tmp_path):
    """By where the integrated arm is, not by what the law believes."""
    script = example("step_the_law")
    bench = script.play(PANDA)
    reached = bench.robot.body.evaluate(bench.q, bench.qd, bench.robot.points, bench.robot.own).x
    np.testing.assert_allclose(reached, bench.column("goal")[-1], atol=1e-3)
    assert np.linalg.norm(reached - bench.column("x")[0]) > 0.15
    assert (np.abs(bench.column("tau_sent")) <= bench.robot.tau_max).all()
    script.draw(bench, tmp_path / "a.png")
    assert drawn(tmp_path / "a.png")


@pytest.mark.usefixtures("examples")
def test_an_obstacle_of_ones_own_is_given_way_to(tmp_path):
    script = example("own_obstacle")
    bench, gaps = script.play(PANDA, 2.0)
    x = bench.column("x")[-len(gaps) :]
    assert 0.0 < gaps.min() < 0.06
    assert 0.003 < np.linalg.norm(x - x[0], axis=1).max() < 0.2
    script.draw(bench, gaps, tmp_path / "a.png")
    assert drawn(tmp_path / "a.png")


@pytest.mark.usefixtures("examples")
def test_the_papers_experiment_is_played_with_any_arm(tmp_path):
    """Contacts and clearance are the simulator's."""
    script = example("paper_with_my_arm")
    ways = script.play(PANDA, seconds=2.5)
    free, ball = ways["free"][0], ways["ball"][0]
    assert free["arrived"]
    assert free["line_deviation_m"] < 1e-3 < 0.03 < ball["line_deviation_m"]
    assert ball["contacts"] == 0
    assert ball["min_clearance_m"]["ball"] > 0.01
    script.draw(ways, tmp_path / "a.png")
    assert drawn(tmp_path / "a.png")


def drawn(path: Path) -> bool:
    return bool(np.ptp(matplotlib.image.imread(path)) > 0.5)
