"""The oracle's distances against all of pybullet's, measured one and all in every look."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_sim.bullet import pb
from firmware_sim.oracle import SELF_SIGHT, SIGHT, reach_of
from firmware_sim.plant import Plant
from firmware_sim.settings import load

F64 = NDArray[np.float64]
CONFIGS = Path(__file__).resolve().parent.parent / "configs"
ARMS = ("panda", "ur5", "openarm_e2e", "puma560", "planar4")
NOISE = 1e-4  # [m] of pybullet's distances


def world(rng: np.random.Generator, size: float) -> list[dict[str, Any]]:
    """Return obstacles of all kinds about an arm: at rest, drifting, turning, coming and going."""

    def place() -> list[float]:
        d = rng.normal(size=3)
        return [float(v) for v in d / np.linalg.norm(d) * rng.uniform(0.5, 1.2) * size]

    def walk() -> list[list[float]]:
        return [[t, *place()] for t in (0.0, 0.3, 0.5, 0.9)]

    return [
        {"name": "floor", "type": "plane", "position_m": [0.0, 0.0, -0.06]},
        {"name": "ball", "type": "sphere", "radius_m": 0.07, "waypoints": walk()},
        {"name": "crate", "type": "box", "size_m": [0.2, 0.1, 0.3], "position_m": place(), "rpy_rad": [0.3, 0.1, 1.0]},
        {
            "name": "mill",
            "type": "box",
            "size_m": [0.6, 0.1, 0.05],
            "position_m": place(),
            "omega_rad_s": [1.0, 2.0, 0.5],
        },
        {"name": "post", "type": "capsule", "radius_m": 0.04, "length_m": 0.5, "position_m": place(), "appears_s": 0.2},
        {"name": "guest", "type": "ellipsoid", "semi_axes_m": [0.1, 0.05, 0.2], "waypoints": walk(), "vanishes_s": 0.6},
        {
            "name": "drift",
            "type": "cone",
            "radius_m": 0.1,
            "height_m": 0.3,
            "position_m": place(),
            "velocity_m_s": [0.3, -0.2, 0.1],
            "omega_rad_s": [0.0, 0.0, 3.0],
        },
    ]


def everything(plant: Plant) -> tuple[dict[str, float], float]:
    """Return all clearances and the self-clearance by measuring every pair."""
    found = {}
    for name, body in plant.bodies.items():
        points = pb.getClosestPoints(plant.body, body, SIGHT, physicsClientId=plant.client)
        found[name] = min((p[8] for p in points if p[3] in plant.oracle.moving), default=SIGHT)
    own = SELF_SIGHT
    for a, b in plant.oracle.far_pairs:
        points = pb.getClosestPoints(plant.body, plant.body, SIGHT, a, b, physicsClientId=plant.client)
        own = min((own, *(p[8] for p in points)))
    return found, own


def postures(plant: Plant, rng: np.random.Generator, count: int) -> Any:
    """Yield postures along a wild way between the joints' limits, with rests and jumps."""
    joints = plant.settings.joints
    low, high = np.array([j.q_min for j in joints]), np.array([j.q_max for j in joints])
    q, goal = np.array(plant.settings.home), np.array(plant.settings.home)
    for k in range(count):
        if k % 60 == 0:
            goal = rng.uniform(low, high)
        if k % 150 == 149:
            q = rng.uniform(low, high)
        if k % 100 < 80:
            q = q + 0.01 * rng.uniform(0.2, 1.0) * (goal - q) / max(1.0, float(np.abs(goal - q).max()))
        yield q


@pytest.mark.parametrize("arm", ARMS)
def test_distances_are_those_of_all_pairs_to_the_bit(arm: str) -> None:
    rng = np.random.default_rng(ARMS.index(arm))
    settings = load(CONFIGS / f"{arm}.toml")
    plant = Plant(settings, settings.home, world(rng, 0.8))
    careless = Plant(settings, settings.home, [s.spec for s in plant.solids])
    least: dict[str, float] = {}
    told: dict[str, float] = {}
    own = own_told = math.inf
    for q in postures(plant, rng, 600):
        for p in (plant, careless):
            p.place(q)
            p.scene_ns += 1_500_000
            p.advance_world()
        exact, own_exact = everything(plant)
        assert plant.clearances() == exact
        assert plant.self_clearance() == own_exact
        loose, own_loose = careless.clearances(exact=False), careless.self_clearance(exact=False)
        assert loose.keys() == exact.keys()
        for name, d in exact.items():
            least[name] = min(d, least.get(name, d))
            told[name] = min(loose[name], told.get(name, math.inf))
            assert told[name] == least[name], name  # the least over the run is exact at every moment
            assert least[name] <= loose[name] <= d + NOISE
        own, own_told = min(own, own_exact), min(own_told, own_loose)
        assert own_told == own
        assert own <= own_loose <= own_exact + NOISE
    assert min(least.values()) < 0.0 < max(least.values())  # it has met some of them
    assert sorted(c[1:4] for c in plant.contacts if c.cause == "self") == sorted(
        c[1:4] for c in careless.contacts if c.cause == "self"
    )
    plant.close()
    careless.close()


@pytest.mark.parametrize("arm", ARMS)
def test_no_link_moves_further_than_its_reach_allows(arm: str) -> None:
    """Corners of the links' boxes against the bound, for one joint turned at a time in many postures."""
    settings = load(CONFIGS / f"{arm}.toml")
    plant = Plant(settings, settings.home, [])
    rng = np.random.default_rng(7)
    joints = settings.joints
    oracle = plant.oracle
    plant.place(settings.home)
    reach = {i: reach_of(oracle.arm, i) for i in oracle.shaped}
    local = {i: corners(plant, i) for i in oracle.shaped}
    for _ in range(30):
        q = np.array([rng.uniform(j.q_min, j.q_max) for j in joints])
        for j in range(len(joints)):
            turned = q.copy()
            turned[j] += rng.uniform(-0.5, 0.5)
            before, after = placed(plant, q, local), placed(plant, turned, local)
            for i in oracle.shaped:
                moved = np.linalg.norm(after[i] - before[i], axis=1).max()
                assert moved <= reach[i][j] * abs(turned[j] - q[j]) + 1e-9
    plant.close()


def corners(plant: Plant, link: int) -> F64:
    """Return the corners of a link's box at home, in the frame of the link (8, 3)."""
    low, high = pb.getAABB(plant.body, link, physicsClientId=plant.client)
    box = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
    at, R = frame_of(plant, link)
    return (box - at) @ R


def frame_of(plant: Plant, link: int) -> tuple[F64, F64]:
    """Return position and rotation of a link's frame."""
    state = pb.getLinkState(plant.body, link, 0, 1, physicsClientId=plant.client)
    return np.array(state[4]), np.array(pb.getMatrixFromQuaternion(state[5])).reshape(3, 3)


def placed(plant: Plant, q: F64, local: dict[int, F64]) -> dict[int, F64]:
    """Return where the corners are at posture q."""
    plant.place(q)
    found = {}
    for i, points in local.items():
        at, R = frame_of(plant, i)
        found[i] = points @ R.T + at
    return found
