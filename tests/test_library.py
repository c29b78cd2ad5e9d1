"""What `import rtctl` offers is what its list says; the examples of the pages run."""

import inspect
import subprocess
import sys
from importlib import util
from types import ModuleType

import numpy as np
import pytest

import rtctl
from rtctl.errors import ConfigError
from tests.lab import ROOT

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
