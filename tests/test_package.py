"""The wheel carries what the program needs outside its source, and finds it there."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from rtctl.cli import main
from rtctl.errors import EXTRAS
from tests.lab import ROOT

CORE = """
import sys
for name in {absent!r}: sys.modules[name] = None
import rtctl.app.daemon, rtctl.app.arm, rtctl.app.replay, rtctl.app.sim, rtctl.library, rtctl.design.arm
import rtctl.log.record.recorder, rtctl.log.view.report, rtctl.log.view.export, rtctl.view.follow
from rtctl.cli import main
sys.exit(main(["log", "info", "tests/golden/goals.mcap"]))
"""
GOLDEN = str(ROOT / "tests" / "golden" / "goals.mcap")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that holds what the wheel installs."""
    folder = tmp_path_factory.mktemp("wheel")
    call = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(call, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder / "site")
    return folder / "site"


def test_the_wheel_carries_all_that_comes_with_the_program(installed: Path) -> None:
    have = {str(path.relative_to(installed)) for path in installed.rglob("*") if path.is_file()}
    wanted = subprocess.run(["git", "ls-files", "configs"], cwd=ROOT, check=True, capture_output=True, text=True)
    assert {f"rtctl/share/{name}" for name in wanted.stdout.split()} <= have
    assert not [name for name in have if name.startswith(("tests/", "tools/", "configs/"))]


def test_an_installed_program_finds_its_scenarios_outside_the_source(installed: Path, tmp_path: Path) -> None:
    code = (
        f"import sys; sys.path[:] = [p for p in sys.path if {str(ROOT)!r} not in p or 'site-packages' in p]\n"
        f"sys.path.insert(0, {str(installed)!r})\n"
        "sys.meta_path[:] = [f for f in sys.meta_path if 'ditable' not in repr(f)]\n"
        "from rtctl.spec.shipped import scenario_file\n"
        "from rtctl.spec.scenario import load_scenario, robot_file\n"
        "for name in ('demo', 'trap', 'u'):\n"
        "    path = scenario_file(name); print(path, robot_file(load_scenario(path), path))\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True)
    for line in done.stdout.splitlines():
        assert all(path.startswith(str(installed)) for path in line.split()), line
    assert len(done.stdout.splitlines()) == 3


def test_the_core_does_without_any_extra() -> None:
    code = CORE.format(absent=sorted({*EXTRAS, "websockets"}))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "panda" in done.stdout


@pytest.mark.parametrize(
    ("module", "extra", "call"),
    [
        ("matplotlib", "report", ["log", "plot", GOLDEN, "--out", "never.png"]),
        ("viser", "view", ["view", GOLDEN]),
    ],
)
def test_a_missing_extra_is_named_in_a_line(
    module: str, extra: str, call: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == module or name.startswith("rtctl.log.view")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    assert main(call) == 2
    said = capsys.readouterr().err
    assert f"pip install 'rtctl[{extra}]'" in said
    assert len(said.splitlines()) == 1


def test_every_optional_module_is_of_an_extra_that_there_is() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(EXTRAS.values()) <= set(extras)
