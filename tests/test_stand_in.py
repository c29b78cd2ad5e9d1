"""What stands in for pybullet, against pybullet: places, Jacobians, distances, and whole runs without it."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pybullet
import pytest

from firmware_sim import obstacles, oracle, plant, second, shapes, stand_in
from firmware_sim.plant import Plant
from firmware_sim.reality import reality_of
from firmware_sim.second import SecondPlant
from firmware_sim.settings import Settings, SettingsError, load
from tests.bodies import F64

ROOT = Path(__file__).parents[1]
CONFIGS = ("panda", "ur5", "puma560", "planar4", "openarm")
MODULES = (obstacles, oracle, plant, second, shapes)
MARGIN = 2e-3  # [m] pybullet's margin of 1 mm about hulls, and what it rounds off
WITHOUT = "import sys; sys.modules['pybullet'] = None; from rtctl.cli import main; sys.exit(main(sys.argv[1:]))"


def solids() -> list[dict[str, Any]]:
    """Obstacles of every form, about the arm."""
    turned = {"wxyz": [0.8, 0.36, -0.48, 0.0]}
    return [
        {"name": "ball", "type": "sphere", "radius_m": 0.1, "position_m": [0.5, 0.2, 0.4]},
        {"name": "rod", "type": "capsule", "radius_m": 0.04, "length_m": 0.4, "position_m": [-0.4, 0.3, 0.3], **turned},
        {
            "name": "can",
            "type": "cylinder",
            "radius_m": 0.06,
            "length_m": 0.2,
            "position_m": [0.2, -0.5, 0.5],
            **turned,
        },
        {"name": "box", "type": "box", "size_m": [0.2, 0.1, 0.3], "position_m": [0.0, 0.55, 0.2], **turned},
        {"name": "cone", "type": "cone", "radius_m": 0.1, "height_m": 0.3, "position_m": [-0.5, -0.3, 0.5], **turned},
        {"name": "egg", "type": "ellipsoid", "semi_axes_m": [0.1, 0.2, 0.05], "position_m": [0.6, -0.2, 0.8], **turned},
        {"name": "floor", "type": "plane", "position_m": [0.0, 0.0, -0.3]},
    ]


def settings_of(name: str) -> Settings:
    return load(ROOT / "configs" / f"{name}.toml")


def standing(settings: Settings, q: F64, here: ModuleType, patch: pytest.MonkeyPatch) -> SecondPlant:
    for module in MODULES:
        patch.setattr(module, "pb", here)
    return SecondPlant(settings, q, solids(), reality_of({"engine": "mujoco"}, settings))


def postures(settings: Settings, count: int) -> Iterator[F64]:
    rng = np.random.default_rng(20261130)
    low, high = (np.array([getattr(j, key) for j in settings.joints]) for key in ("q_min", "q_max"))
    for _ in range(count):
        yield rng.uniform(0.8 * low, 0.8 * high)


@pytest.mark.parametrize("name", CONFIGS)
def test_links_stand_and_turn_where_pybullet_has_them(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of(name)
    for q in postures(settings, 4):
        one = standing(settings, q, pybullet, monkeypatch)
        tip, tree = one.tip_pose()[0], {one.links[k]: one.links.get(p, "") for k, p in one.parent.items()}
        states = {link: pybullet.getLinkState(one.body, k, 1, 1, one.client)[4:6] for k, link in one.links.items()}
        one.close()
        other = standing(settings, q, stand_in, monkeypatch)
        assert {other.links[k]: other.links.get(p, "") for k, p in other.parent.items()} == tree
        for k, link in other.links.items():
            place, turned = stand_in.getLinkState(other.body, k, 1, 1, other.client)[4:6]
            assert np.allclose(place, states[link][0], atol=2e-6)
            assert abs(float(np.asarray(turned) @ np.asarray(states[link][1]))) == pytest.approx(1.0, abs=1e-6)
        assert other.tip_pose()[0] == pytest.approx(tip, abs=2e-6)
        other.close()


@pytest.mark.parametrize("name", CONFIGS)
def test_it_measures_what_pybullet_measures(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they touch, depths are of two kinds: only that they touch is compared."""
    settings, compared = settings_of(name), 0
    for q in postures(settings, 6):
        one = standing(settings, q, pybullet, monkeypatch)
        there, itself = one.clearances(), one.self_clearance()
        one.close()
        other = standing(settings, q, stand_in, monkeypatch)
        found = other.clearances()
        assert set(found) == set(there)
        for obstacle, d in there.items():
            if d > MARGIN:
                assert found[obstacle] == pytest.approx(d, abs=MARGIN), obstacle
                compared += 1
            elif d < -MARGIN:
                assert found[obstacle] <= 0.0, obstacle
        if itself > MARGIN:
            assert other.self_clearance() == pytest.approx(itself, abs=MARGIN)
        other.close()
    assert compared > 20


@pytest.mark.parametrize("here", [pybullet, stand_in])
@pytest.mark.parametrize("name", CONFIGS)
def test_a_place_of_a_link_moves_as_finite_differences_say(
    name: str, here: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, place, step = settings_of(name), np.array([0.3, 0.5, 0.7]), 3e-3
    for q in postures(settings, 2):
        world = standing(settings, q, here, monkeypatch)
        for link in world.links:
            R, t = frame(here, world, link)
            local = R.T @ (place - t)
            columns = []
            for j in range(len(q)):
                ends = []
                for way in (step, -step):
                    world.place(q + way * np.eye(len(q))[j])
                    R, t = frame(here, world, link)
                    ends.append(R @ local + t)
                columns.append((ends[0] - ends[1]) / (2.0 * step))
            world.place(q)
            found = oracle.jacobian(world.oracle.arm, link, place, q.tolist())
            assert np.allclose(found, np.array(columns).T, atol=2e-4), world.links[link]  # states are single floats
        world.close()


def frame(here: ModuleType, world: SecondPlant, link: int) -> tuple[F64, F64]:
    place, turned = here.getLinkState(world.body, link, 1, 1, world.client)[4:6]
    return np.array(pybullet.getMatrixFromQuaternion(turned)).reshape(3, 3), np.array(place)


def test_a_contact_has_the_link_and_the_speeds_that_pybullet_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm falls onto a ball that comes up to it."""
    settings = settings_of("planar4")
    found = []
    for here in (pybullet, stand_in):
        for module in MODULES:
            monkeypatch.setattr(module, "pb", here)
        ball = {"name": "ball", "type": "sphere", "radius_m": 0.1, "position_m": [0.9, 0.0, -0.3]}
        world = SecondPlant(
            settings, [0.0] * 4, [ball | {"velocity_m_s": [0.0, 0.0, 0.4]}], reality_of({"engine": "mujoco"}, settings)
        )
        for _ in range(600):
            for _ in range(world.substeps):
                world.step([0.0] * 4, [0.0] * 4)
            world.scene_ns = world.time_ns
            world.advance_world()
            if world.contacts:
                break
        found.append(world.contacts[0])
        world.close()
    one, other = found
    assert (other.link, other.other, other.cause) == (one.link, one.other, one.cause)
    assert other.time == pytest.approx(one.time, abs=0.005)
    assert other.arm_m_s == pytest.approx(one.arm_m_s, abs=0.05)
    assert other.other_m_s == pytest.approx(one.other_m_s, abs=0.05)
    assert np.allclose(other.row, one.row, atol=0.05)


def test_what_only_an_engine_does_is_refused_and_so_is_pybullet_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of("planar4")
    for module in MODULES:
        monkeypatch.setattr(module, "pb", stand_in)
    world = Plant(settings, [0.0] * 4, [])
    with pytest.raises(AttributeError):
        world.step([0.0] * 4, [0.0] * 4)
    monkeypatch.setattr("firmware_sim.reality.IS_THERE", False)
    assert reality_of({}, settings).engine == "mujoco"
    with pytest.raises(SettingsError, match='pybullet is not installed; wanted "mujoco"'):
        reality_of({"engine": "bullet"}, settings)


def test_a_run_without_pybullet_is_that_of_the_second_engine(tmp_path: Path) -> None:
    """Its motion is MuJoCo's either way; distances are within what the two readings of the shapes differ by."""
    text = (ROOT / "configs" / "scenarios" / "planar4.toml").read_text()
    told = tmp_path / "told.toml"
    told.write_text(text.replace('"../', f'"{ROOT}/configs/') + '\n[plant]\nengine = "mujoco"\n')
    runs = []
    for start in ([sys.executable, "-c", WITHOUT], [sys.executable, "-m", "rtctl"]):
        done = subprocess.run(
            [*start, "sim", str(told), "--json"], capture_output=True, text=True, cwd=ROOT, check=False
        )
        assert done.returncode == 0, done.stderr
        runs.append(json.loads(done.stdout))
    one, other = runs
    assert [g["arrived"] for g in one["goals"]] == [g["arrived"] for g in other["goals"]]
    assert one["contacts"] == other["contacts"] == 0
    assert one["digest"] == other["digest"]
    for name, d in other["min_clearance_m"].items():
        assert one["min_clearance_m"][name] == pytest.approx(d, abs=MARGIN), name
