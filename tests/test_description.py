"""A robot's description: `check` and the virtual drives find the same files and say the same of what no body has."""

import re
from pathlib import Path

import pytest

from firmware_sim.plant import Plant
from firmware_sim.settings import SettingsError, load
from firmware_sim.settings import package_dirs as their_folders
from rtctl import design as cfg
from rtctl.design.description import notes
from rtctl.errors import ConfigError
from rtctl.spec.urdf import package_folders, share_folders, urdf_file
from tests.lab import ROOT

ARMS = ("panda", "ur5", "puma560", "planar4", "openarm", "openarm_e2e")
MESH = re.compile(r'<mesh[^>]*filename="([^"]+)"')


def planar(folder: Path, link: str, inertia: str) -> Path:
    """Write the planar arm with the inertia of a link changed; return its config."""
    head, mark, tail = (ROOT / "configs" / "planar4.urdf").read_text().partition(f'<link name="{link}">')
    (folder / "planar4.urdf").write_text(head + mark + re.sub(r"<inertia [^>]*/>", inertia, tail, count=1))
    (folder / "arm.toml").write_text((ROOT / "configs" / "planar4.toml").read_text())
    return folder / "arm.toml"


@pytest.mark.parametrize("name", ARMS)
def test_both_find_the_same_urdf(name: str) -> None:
    path = ROOT / "configs" / f"{name}.toml"
    assert urdf_file(cfg.load(path).robot.urdf, path).resolve() == load(path).urdf.resolve()


def test_both_look_for_packages_in_the_same_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ours").mkdir()
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'ours'}:{tmp_path / 'none'}")
    assert {p.resolve() for p in share_folders()} == {p.resolve() for p in their_folders()}
    assert tmp_path / "ours" in their_folders()


def test_both_find_meshes_of_a_package_above_the_urdf(tmp_path: Path) -> None:
    panda = load(ROOT / "configs" / "panda.toml").urdf
    package = panda.relative_to(next(f for f in panda.parents if (f / "example-robot-data").is_dir())).parts[0]
    for name in MESH.findall(panda.read_text()):
        ours = [f / name.removeprefix("package://") for f in package_folders(panda)]
        theirs = [f / name.removeprefix("package://") for f in (*their_folders(), *list(panda.parents)[:4])]
        assert next(f for f in ours if f.is_file()).resolve() == next(f for f in theirs if f.is_file()).resolve()
    assert package == "example-robot-data"


def test_an_inertia_that_no_body_has_is_named_and_refused_by_both_where_it_moves(tmp_path: Path) -> None:
    wrong = '<inertia ixx="0.001" ixy="0.0001" ixz="0" iyy="0.002" iyz="0" izz="0.5"/>'
    path = planar(tmp_path, "link_4", wrong)
    with pytest.raises(ConfigError, match=r"link_4.*no body has"):
        cfg.build(cfg.load(path), path)
    settings = load(path)
    with pytest.raises(SettingsError, match="link_4: no body has"):
        Plant(settings, settings.home, ())


def test_a_diagonal_one_is_only_warned_of_as_published_ones_are() -> None:
    path = ROOT / "configs" / "puma560.toml"
    config = cfg.load(path)
    found = notes(urdf_file(config.robot.urdf, path), [j.name for j in config.robot.joints])
    assert [note.about for note in found] == ["link_3"]
    assert not found[0].refused
    rows = {row.name: row for row in cfg.check(config, cfg.build(config, path)).rows}
    assert rows["inertia of link_3"].verdict == "warn"


def test_a_home_in_a_limit_zone_is_told_the_nearest_that_is_not(tmp_path: Path) -> None:
    text = (ROOT / "configs" / "openarm.toml").read_text()
    text = text.replace("home_rad = [0.5, -1.2, 0.0, 1.4,", "home_rad = [0.5, -1.7, 0.0, 0.1,")
    (tmp_path / "arm.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"the nearest is \[0.5, -1.545, 0, 0.2, 0, 0, 0\]"):
        cfg.load(tmp_path / "arm.toml")
