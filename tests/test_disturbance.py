"""Payload and friction that nobody told of: seen by the momentum observer, carried by the law, judged by the plant."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rtctl.arm import faults
from rtctl.arm.disturbance import BANDWIDTH, LASTING, beyond, carried, observed, rounding, settled, slow_part
from rtctl.arm.hot import fresh, record_of
from rtctl.arm.sensing import _stick, _surprise
from rtctl.experiment import rates, scene
from rtctl.kernel.rotations import quat_of
from rtctl.types import State
from tests.lab import ROOT, Lab, lab, robot


class Case(NamedTuple):
    """What an arm carries and how it rubs, and how far it goes [m] from its home with its orientation kept."""

    payload: float  # [kg] at the tip
    coulomb: Sequence[float] | float  # [Nm]
    way: Sequence[float]


CASES = {
    "openarm_e2e": Case(0.5, [0.3] * 4 + [0.06] * 3, (0.04, 0.05, 0.06)),
    "panda": Case(1.0, 0.5, (0.15, 0.2, -0.1)),
    "planar4": Case(1.0, 0.5, (-0.2, 0.15, 0.0)),
    "puma560": Case(1.0, 0.5, (-0.1, 0.15, -0.15)),
    "ur5": Case(1.0, 0.5, (-0.1, 0.2, -0.1)),
}


def until(here: Lab, what: Any, seconds: float) -> float:
    """Play slots until the memory is so; return the time [s] that it took. Fails when it takes longer."""
    for k in range(round(seconds / here.robot.dt)):
        if what(here.memory):
            return k * here.robot.dt
        here.step()
    raise AssertionError("not within its time")


def arrived(name: str, here: Lab) -> float:
    """Ask the arm for the goal of its case; return the time [s] until it says that it is there."""
    x, wxyz = here.simulator.truth().tip, quat_of(here.memory.tip.R)
    here.ask(x + np.array(CASES[name].way), wxyz)
    return until(here, lambda m: m.status.name == "ARRIVED", 6.0)


@pytest.mark.parametrize("name", CASES)
def test_what_nobody_told_of_is_carried_to_the_goal(name: str):
    """Its time is compared with that of the same arm as its model is; place, angle and rest are the plant's truth."""
    case, path = CASES[name], ROOT / "configs" / f"{name}.toml"
    with lab(path=path) as here:
        plain = arrived(name, here.running())
        assert not here.memory.noticed
    plant = {"payload_kg": case.payload, "coulomb_Nm": case.coulomb}
    with lab(path=path, scenario={"plant": plant}) as here:
        here.running()
        x, R = here.simulator.truth().tip.copy(), here.memory.tip.R.copy()
        assert arrived(name, here) < plain + 2.0
        until(here, lambda m: m.settled, 12.0)
        here.run(1.5)  # the last of the way
        tips = []
        for _ in range(500):
            here.step()
            tips.append(here.simulator.plant.tip_pose()[0])
        assert np.ptp(tips, axis=0).max() < 0.5e-3
        truth = here.simulator.truth()
        assert np.linalg.norm(truth.tip - x - np.array(case.way)) < 3e-3
        assert 2.0 * np.arccos(min(abs(truth.tip_wxyz @ quat_of(R)), 1.0)) < 1e-2
        assert faults.names(here.servo.faults_seen) == ()
        assert {name for _, name, _ in here.servo.events} <= {"state", "moving", "arrived"}


@pytest.mark.parametrize("hz", [225, 100])
@pytest.mark.parametrize("plant", [{"payload_kg": 1.0}, {"coulomb_Nm": 0.5}, {"payload_kg": 1.0, "coulomb_Nm": 0.5}])
def test_at_slow_rates_it_is_carried_as_well(hz: int, plant: dict[str, float]):
    """The paper's rates and slower ones: the place is the plant's. Each was stopped by `innovation` on its way."""
    goal = np.array(rates.LINE)
    scenario = {"duration_s": 3.0, "goal": [{"at_s": rates.GIVEN, "position_m": goal.tolist()}], "plant": plant}
    trace = scene.played(scenario, scene.config_file("panda"), changes=rates.changes_of(hz, 100))
    assert trace.figures["faults"] == []
    assert trace.figures["arrived"]
    assert np.linalg.norm(trace.tip[-1] - goal) < 3e-3
    rest = trace.tip[trace.rows(2.5, 3.0)]
    assert np.ptp(rest, axis=0).max() < 3e-3


def test_nothing_is_learnt_of_a_joint_that_is_silent_while_it_is_damped(tmp_path: Path):
    """The plant carries nothing and does not rub, so nothing is to be carried, however a joint brakes unheard.

    At a slow servo rate a drive may be silent for tens of milliseconds before it counts as lost. What its braking makes
    of the observer's torque is several Nm.
    """
    path = scene.variant(ROOT / "configs" / "panda.toml", tmp_path, rates.changes_of(100, 100))
    with lab(path=path, inject=("drive_fault@0.8:6", "silent@0.84:3:0.08")) as here:
        here.running()
        here.ask([0.45, 0.35, 0.45])
        until(here, lambda m: m.state == State.SAFE_STOP, 2.0)
        unheard, carried, seen = 0, 0.0, 0.0
        while not here.memory.off:
            turn = here.step()
            if turn.feedback.replies[3] == 0:
                unheard += 1
                carried = max(carried, float(np.abs(here.memory.lasting).max()))
                seen = max(seen, abs(float(here.memory.external[3])))
        assert unheard >= 2
        assert seen > 2.0  # [Nm]: there was something to be taken in
        assert carried < 0.5


def test_a_light_joint_that_sticks_under_a_payload_has_no_stuck_encoder():
    """The wrist stands by its friction while the payload, its centre beside the tip, is accelerated by other joints."""
    plant = {
        "payload_kg": 1.535,
        "payload_com_m": [0.045, -0.036, 0.045],
        "coulomb_Nm": [1.36, 1.84, 3.6, 1.78, 0.33, 0.017, 0.45],
    }
    with lab(scenario={"plant": plant}) as here:
        here.running()
        until(here, lambda _: here.simulator.time >= 0.5, 1.0)
        here.ask([0.50, 0.35, 0.40], quat_of(here.memory.tip.R))
        stood = 0.0
        for _ in range(round(0.8 / here.robot.dt)):
            here.step()
            truth = here.simulator.truth()
            stood += here.robot.dt * (abs(truth.qd[4]) < 1e-3 < 0.1 < abs(truth.qd[0]))
        assert stood > 0.05
        assert faults.names(here.servo.faults_seen) == ()


def test_a_joint_that_stands_is_not_predicted_to_move_by_what_friction_may_hold():
    """Closed form: friction takes F / A of the acceleration, all of a lesser one, nothing of a joint that moves."""
    arm, F = robot(), robot().friction_max
    model = arm.body.evaluate(arm.home, np.zeros(arm.n), arm.points, arm.own)
    A, m = model.A.diagonal(), record_of(fresh())[0]
    asked = np.array([3.0, -3.0, 0.5, -0.5, 3.0, -1.0, 1.0]) * F / A
    qdd = asked.copy()
    _stick(arm.arm.constants[0], m, model, qdd)
    np.testing.assert_array_equal(qdd, asked)  # nothing is noticed that friction could explain
    m.noticed = 1
    m.qd_measured[4] = 0.06
    _stick(arm.arm.constants[0], m, model, qdd)
    np.testing.assert_allclose(qdd, np.array([2.0, -2.0, 0.0, 0.0, 3.0, 0.0, 0.0]) * F / A, atol=1e-9)


def test_an_arm_with_an_unknown_load_may_surprise_its_filters_by_what_the_observer_is_behind():
    """Closed form: LASTING / BANDWIDTH of what does not last yet, within what a payload takes, over A sigma."""
    arm = robot()
    model, c = arm.body.evaluate(arm.home, np.zeros(arm.n), arm.points, arm.own), arm.arm.constants[0]
    m = record_of(fresh())[0]
    m.external[6], m.lasting[6], m.unsure[6] = 0.5, 0.1, 9.0
    assert _surprise(c, m, model) == 1.0  # nothing is noticed
    m.noticed = 1
    one = model.A[6, 6] * c.joint_sigma_qdd[6]
    assert _surprise(c, m, model) == pytest.approx(1.0 + 0.4 * LASTING / BANDWIDTH / one)
    m.unsure[6] = 0.05
    assert _surprise(c, m, model) == pytest.approx(1.0 + 0.05 / one)
    m.unsure[6] = 0.0  # the arm is not accelerated: no load explains a surprise
    assert _surprise(c, m, model) == 1.0


# ---- the observer alone


def test_the_observer_finds_a_torque_on_a_pendulum_from_its_motion_alone():
    """A point mass m at l with inertia A = m l^2, integrated here: A qdd + m g l sin q = tau + external."""
    A, weight, dt = 0.8, 3.0, 1e-3
    q, qd, r, external, tau = 0.3, 0.0, np.zeros(1), 1.7, 2.0
    for k in range(round(8.0 / BANDWIDTH / dt)):
        before = qd
        load = weight * np.sin(q)
        qd += dt * (tau + external - load) / A
        q += dt * qd
        r = observed(r, np.array([[A]]), np.array([qd]), np.array([before]), np.array([load]), np.array([tau]), dt)
        assert r[0] == pytest.approx(external * (1.0 - np.exp(-BANDWIDTH * dt * (k + 1))), abs=1e-9)
    assert r[0] == pytest.approx(external, abs=2e-3)


def test_what_is_carried_stays_within_what_was_declared():
    d = np.zeros(2)
    for _ in range(5000):
        d = slow_part(d, np.array([5.0, -0.3]), np.array([2.0, 2.0]), 1e-3)
    np.testing.assert_allclose(d, [2.0, -0.3], atol=1e-6)


def test_the_bound_is_the_weight_of_the_payload_at_its_lever_and_friction():
    """A lever of 0.5 m about a horizontal axis, and an upright axis that no weight turns."""
    J = np.zeros((6, 2))
    J[:, 0], J[:, 1] = [0.0, 0.0, -0.5, 0.0, 1.0, 0.0], [0.2, 0.0, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(carried(J, 2.0, np.array([0.1, 0.3])), [2.0 * 9.81 * 0.6 + 0.1, 0.3])


def test_rounding_of_speeds_is_never_taken_for_a_torque():
    """An oracle of its own: speeds of a joint that nothing pushes, rounded as a drive does, for a minute."""
    rng, A, step, dt = np.random.default_rng(3), np.array([[1.4]]), 0.0049, 1e-3
    bound = rounding(A, np.array([step / np.sqrt(12.0)]), np.array([0.01]))
    r, d, before, largest = np.zeros(1), np.zeros(1), np.zeros(1), 0.0
    qd, tau = 0.0, 0.0
    for k in range(60_000):
        if k % 500 == 0:
            tau = float(rng.uniform(-2.0, 2.0)) - 0.5 * qd
        qd += dt * tau / A[0, 0]
        seen = np.array([np.round(qd / step) * step])
        r = observed(r, A, seen, before, np.zeros(1), np.array([tau]), dt)
        d, before = slow_part(d, r, np.array([9.0]), dt), seen
        largest = max(largest, abs(d[0]))
    assert 0.0 < largest < 0.5 * bound[0]
    assert not beyond(d, bound)
    assert beyond(d + 2.0 * bound, bound)
    assert LASTING < BANDWIDTH


def test_an_arm_that_has_come_to_rest_at_its_goal_does_not_go_on_pushing():
    assert not settled(False, True, 0.5)
    assert settled(False, True, 0.3)
    assert settled(True, False, 0.5)
    assert not settled(True, True, 0.8)
    assert not settled(False, False, 0.0)
