"""What the file says is fixed to the tip, and how the arm is mounted: pybullet says what that weighs."""

from pathlib import Path

import numpy as np
import pytest

from firmware_sim.bullet import pb
from firmware_sim.plant import Plant
from firmware_sim.settings import load
from rtctl import design
from rtctl.arm.points import no_points
from rtctl.design.arm import rigid_body
from rtctl.design.report import report
from rtctl.errors import ConfigError
from tests.lab import PANDA, lab

TOOL = "[tool]\nmass_kg = 1.3\ncom_m = [0.02, -0.03, 0.08]\ninertia_kg_m2 = [0.004, 0.001, 0.0, 0.006, 0.0, 0.005]\n"
WALL = "[robot.base_pose]\nrpy_rad = [1.2, 0.4, -0.7]\n"


def written(folder: Path, *tables: str) -> Path:
    """Write the Panda's file with further tables; return its path."""
    path = folder / "panda.toml"
    path.write_text(PANDA.read_text() + "\n" + "\n".join(tables))
    return path


def plant_terms(path: Path, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pybullet's gravity torque (n,) [Nm] and mass matrix (n, n) [kg m2] of the plant of a file."""
    settings = load(path)
    plant = Plant(settings, settings.home, [])
    zero = [0.0] * len(q)
    g = pb.calculateInverseDynamics(plant.body, q.tolist(), zero, zero, physicsClientId=plant.client)
    A = pb.calculateMassMatrix(plant.body, q.tolist(), physicsClientId=plant.client)
    plant.close()
    return np.array(g), np.array(A)


@pytest.mark.parametrize("tables", [(TOOL,), (WALL,), (TOOL, WALL)])
def test_the_model_weighs_what_pybullet_weighs_with_a_tool_and_on_a_wall(tmp_path: Path, tables: tuple[str, ...]):
    path = written(tmp_path, *tables)
    config = design.load(path)
    body, q = rigid_body(config, path), np.array([0.3, -0.5, 0.2, -1.9, 0.4, 1.4, 0.6])
    model = body.evaluate(q, np.zeros(7), no_points())
    g, A = plant_terms(path, q)
    np.testing.assert_allclose(model.g, g, atol=2e-4)
    np.testing.assert_allclose(model.A, A, atol=2e-4)


def test_a_payload_is_weighed_at_its_place_and_forgotten_to_the_bit(tmp_path: Path):
    point = TOOL.partition("inertia")[0]
    path, bare = written(tmp_path, point), design.load(PANDA)
    body, q = rigid_body(bare, PANDA), np.array([0.3, -0.5, 0.2, -1.9, 0.4, 1.4, 0.6])
    before = body.evaluate(q, q, no_points())
    model = body.evaluate(q, np.zeros(7), no_points(), payload=(1.3, 0.02, -0.03, 0.08))
    g, A = plant_terms(path, q)
    np.testing.assert_allclose(model.g, g, atol=2e-4)
    np.testing.assert_allclose(model.A, A, atol=2e-4)
    after = body.evaluate(q, q, no_points())
    assert before.g.tobytes() == after.g.tobytes()
    assert before.A.tobytes() == after.A.tobytes()


def test_check_prints_what_the_tool_takes_of_each_joint(tmp_path: Path):
    path = written(tmp_path, TOOL)
    config = design.load(path)
    rows = {row.name: row for row in report(config, design.build(config, path)).rows}
    q = np.array(config.robot.home_rad)
    less, more = plant_terms(PANDA, q)[0], plant_terms(path, q)[0]
    share = rows["of it the tool at panda_joint2"].value
    assert 100.0 * abs(more - less)[1] / (0.95 * 87.0) < share < 25.0
    assert rows["gravity with payload_max_kg"].value > rows["gravity at panda_joint2"].value


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ("[tool]\nmass_kg = 14.0\ncom_m = [0.0, 0.0, 0.2]\n", "tool.mass_kg"),
        ("[tool]\nmass_kg = -1.0\n", "tool.mass_kg"),
        ("[tool]\nmass_kg = 1.0\ninertia_kg_m2 = [0.1, 0.0, 0.0, 0.1, 0.0, 0.3]\n", "tool.inertia_kg_m2"),
        ("[tool]\nmass_kg = 1.0\ncom = [0.0, 0.0, 0.1]\n", "tool.com"),
    ],
)
def test_a_tool_that_no_joint_carries_or_no_body_is_is_refused_by_name(tmp_path: Path, table: str, key: str):
    path = written(tmp_path, table)
    with pytest.raises(ConfigError, match=key):
        design.build(design.load(path), path)


def test_a_largest_payload_that_cannot_be_held_at_home_is_refused(tmp_path: Path):
    path = tmp_path / "panda.toml"
    path.write_text(PANDA.read_text().replace("payload_max_kg = 3.0", "payload_max_kg = 60.0"))
    with pytest.raises(ConfigError, match="payload_max_kg"):
        design.build(design.load(path), path)


def test_an_arm_with_a_tool_on_a_wall_arrives_as_if_nothing_were_external(tmp_path: Path):
    with lab(path=written(tmp_path, TOOL, WALL)) as here:
        here.running()
        x = here.simulator.truth().tip.copy()
        here.ask(x + np.array([0.05, 0.08, 0.06]))
        here.run(2.0)
        assert here.memory.status.name == "ARRIVED"
        assert np.linalg.norm(here.simulator.truth().tip - x - np.array([0.05, 0.08, 0.06])) < 1e-3
        assert not here.memory.noticed
