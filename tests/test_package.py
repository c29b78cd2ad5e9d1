"""The wheel carries what the program needs outside its source, and finds it there."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.lab import ROOT


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
