"""The paper's experiments: the numbers of every figure, against energy, analytic solutions and plain geometry."""

import json
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from rtctl import experiment
from rtctl.cli import main
from rtctl.control.firas import field_params
from rtctl.experiment import bounce, enclosure, forms, limits, line, minimum, moving, potential, puma, rates
from rtctl.experiment.mass import Mass, motion_params, obstacles_of
from rtctl.experiment.outline import Figurine
from rtctl.experiment.style import styled
from rtctl.types import F64

ROOT = Path(__file__).parents[1]


# ---- the point mass


@cache
def flights() -> potential.Data:
    return potential.run(starts=(-0.1, 0.42), speeds=(0.2, 0.5))


def test_a_mass_without_damping_turns_where_its_energy_is_spent():
    eta = (0.5 / (1.0 / 0.02 - 1.0 / 0.2)) ** 2
    for case in flights().cases:
        for speed, turned in zip(flights().speeds, case.heights, strict=True):
            spent = brentq(lambda r, v=speed: 0.5 * eta * (1.0 / r - 1.0 / 0.2) ** 2 - 0.5 * v * v, 1e-3, 0.2)
            assert turned == pytest.approx(spent, abs=2e-4), (case.shape.type, speed)


def test_energy_along_a_slanting_bounce_is_kept_up_to_what_sampling_pumps():
    for case in flights().cases:
        assert case.energy < 0.04, case.shape.type  # a force held for 1 ms: 1.02 V, 4 % of the energy
        assert case.throw.least > 0.0198  # of V_MAX, slanting: the sampled turn is 0.2 mm late at most


def test_masses_reach_the_goal_round_every_solid_and_keep_the_clearance():
    numbers = potential.figures(flights())["shapes"]
    for kind in ("ellipsoid", "cylinder", "cone"):
        assert min(numbers[kind]["clearance_m"]) > 0.0197, kind
        assert max(numbers[kind]["top_speed_m_s"]) < 0.515, kind  # the field may add what it took on the way in
    assert max(numbers["ellipsoid"]["goal_error_m"] + numbers["cylinder"]["goal_error_m"]) < 1e-6


def test_the_push_on_a_mass_is_the_slope_of_its_potential():
    params = field_params(0.5, 0.2, 0.02, 1e-3, 1.0, 0.0, 1e3)
    shape = potential.SHAPES[1][0]  # the tilted cylinder
    mass = Mass(obstacles_of(shape), params, 1e-3)

    def U(x: F64) -> float:
        rho = _distance_to_cylinder(x, 0.16, 0.2, potential.TILT)
        return 0.5 * params.eta * max(1.0 / rho - 1.0 / 0.2, 0.0) ** 2

    for x in np.array([[-0.3, 0.02, 0.05], [0.1, 0.0, 0.35], [0.05, -0.22, 0.0], [-0.3, 0.1, 0.25]]):
        slope = np.array([(U(x + h) - U(x - h)) / 2e-6 for h in 1e-6 * np.eye(3)])
        assert mass.push(x, np.zeros(3)) == pytest.approx(-slope, rel=1e-4, abs=1e-7)


def _distance_to_cylinder(x: F64, radius: float, half: float, tilt: float) -> float:
    along = x @ np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    out = np.array([np.sqrt(x @ x - along**2) - radius, abs(along) - half])
    return float(np.hypot(*np.maximum(out, 0.0)))


def test_the_last_of_the_way_is_the_decay_of_a_critically_damped_unit_mass():
    motion = motion_params(0.5, 5.0, 200.0)
    omega, e0 = np.sqrt(200.0), 0.02
    far = potential.SHAPES[0][0]._replace(position=np.array([9.0, 0.0, 0.0]))
    mass = Mass(obstacles_of(far), field_params(0.5, 0.2, 0.02, 1e-3, 1.0, 0.0, 1e3), 1e-3)
    path = mass.fly(np.array([-e0, 0.0, 0.0]), np.array([0.5 * omega * e0, 0.0, 0.0]), 0.6, np.zeros(3), motion)
    wanted = (e0 + 0.5 * omega * e0 * path.t) * np.exp(-omega * path.t)
    assert -path.x[:, 0] == pytest.approx(wanted, abs=0.01 * e0)


# ---- the sampled bounce


def test_a_sampled_bounce_pumps_what_the_law_says_and_no_more_than_the_bound():
    data = bounce.run(rates=(100.0, 225.0, 1000.0), phases=5)
    numbers = bounce.figures(data)
    assert numbers["leaves_plain"] == pytest.approx([2.47, 1.36, 1.06], rel=0.025)
    assert numbers["leaves_worst_speed"][1] < numbers["bound"][1] < 1.45
    assert numbers["leaves_worst_speed"][2] < numbers["bound"][2] < 1.065
    assert numbers["bound"][0] is None  # at 100 Hz nothing is promised of an undamped mass
    assert max(numbers["leaves_damped"]) < 1.0  # as it is used, the field only takes energy
    assert min(numbers["least_distance_damped_m"]) > bounce.CLEARANCE


@pytest.mark.parametrize("speed", [0.1, 0.5])
def test_the_gain_is_the_delay_times_the_integral_of_stiffness_times_speed_squared(speed: float):
    eta, rho0, dt = (0.5 / 40.0) ** 2, 0.1, 1e-3
    least = brentq(lambda r: eta * (1.0 / r - 1.0 / rho0) ** 2 - speed**2, 1e-3, rho0)

    def work(r: float) -> float:
        s = 1.0 / r - 1.0 / rho0
        return eta * (1.0 / r**4 + 2.0 * s / r**3) * np.sqrt(max(speed**2 - eta * s * s, 0.0))

    gained = 1.5 * dt * 2.0 * quad(work, least, rho0, limit=200)[0]
    assert bounce.gain(speed, dt) == pytest.approx(gained / (0.5 * speed**2), rel=1e-5)


# ---- arms through the whole pipe; clearances are pybullet's


def test_a_panda_goes_straight_below_its_limit_and_decays_like_a_unit_mass():
    data = line.run()
    numbers = line.figures(data)
    assert max(numbers["line_deviation_m"]) < 1e-3
    assert numbers["top_speed_m_s"] < 1.005 * numbers["v_max_m_s"]
    assert max(numbers["final_error_m"]) < 3e-4
    assert numbers["decay_1_s"] == pytest.approx(numbers["decay_analytic_1_s"], rel=0.05)
    drawn(line, data)


def test_the_planar_arm_keeps_every_link_off_walls_and_pillars():
    data = enclosure.run(goals=enclosure.GOALS[:2])
    numbers = enclosure.figures(data)
    assert max(numbers["error_m"]) < 5e-3
    assert numbers["contacts"] == 0
    assert numbers["faults"] == []
    assert numbers["min_clearance_m"]["pillar"] > 0.02
    figurine = Figurine(data.trace.robot.body)
    for row in range(500, len(data.trace.time), 900):
        seen = data.trace.clearance["pillar"][row]
        assert seen == pytest.approx(_rods_to_pillar(figurine, data, row), abs=2e-3)
    drawn(enclosure, data)


def _rods_to_pillar(figurine: Figurine, data: enclosure.Data, row: int) -> float:
    """Return the distance of the arm's rods, radius 3 cm, to the pillar in the plane, as pybullet's sight goes."""
    ends = np.vstack([figurine.joints(data.trace.q[row]), data.trace.tip[row]])[:, :2]
    pillar = next(o for o in enclosure.OBSTACLES if o["name"] == "pillar")
    c, radius = np.array(pillar["position_m"][:2]), float(pillar["radius_m"])
    gaps = []
    for a, b in pairwise(ends):
        u = np.clip((c - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        gaps.append(np.linalg.norm(c - a - u * (b - a)) - radius - 0.03)
    return min(float(min(gaps)), 0.5)


def test_the_puma_goes_over_the_ball():
    data = puma.run(goals=puma.GOALS[:1])
    numbers = puma.figures(data)
    assert numbers["arrived"] == [True]
    assert numbers["contacts"] == 0
    assert numbers["faults"] == []
    assert 0.02 < numbers["min_clearance_m"]["ball"] < 0.05  # it does come near
    assert numbers["line_deviation_m"][0] > 0.05
    assert numbers["max_torque_ratio"] < 1.0
    drawn(puma, data)


def test_a_joint_asked_beyond_its_limit_stops_short_and_is_named():
    data = limits.run(turns=limits.TURNS[1:2])
    numbers = limits.figures(data)
    assert numbers["joint_7_would_need_rad"][0] > numbers["joint_7_limit_rad"]
    assert numbers["arrived"] == [False]
    assert numbers["diagnosis"] == ["limited panda_joint7 at its upper limit"]
    assert 0.0 < numbers["min_joint_margin_rad"] < numbers["zone_rad"]
    assert numbers["error_m"][0] < 0.01  # the tip stays
    drawn(limits, data)


def test_the_arm_yields_to_a_ball_and_comes_back():
    data = moving.run(speed=0.5)
    numbers = moving.figures(data)
    assert numbers["contacts"] == 0
    assert numbers["min_clearance_m"] > 0.02
    assert numbers["yielded_m"] > 0.02
    assert numbers["error_after_m"] < 1e-3
    assert numbers["faults"] == []
    drawn(moving, data)


def test_a_slow_loop_takes_its_own_lateness_for_no_load():
    """At 100 Hz the model is 20 ms behind a fast wrist: a load was noticed that is not there, then `innovation`."""
    run = rates._played(rates.config_file("panda"), 100, 100, True, lambda part: None)
    assert (run.arrived, run.contacts, run.faults) == (True, 0, ())


def test_the_papers_rates_work_and_the_estimator_is_worth_its_name():
    data = rates.run(pairs=((225, 100),))
    carried, held = rates.figures(data)["runs"]
    for row in (carried, held):
        assert row["arrived"]
        assert row["contacts"] == 0
        assert row["faults"] == []
    assert carried["min_clearance_m"] > 0.02
    assert carried["max_speed_m_s"] < 0.52
    assert carried["tip_error_rms_m"] < 0.5 * held["tip_error_rms_m"]
    assert "| 225 / 100 | yes |" in rates.table(data)
    drawn(rates, data)


def test_the_papers_forms_are_compared_and_play():
    data = forms.run(samples=150, forms=(("sum", "task"),), lasts=2.6)
    numbers = forms.figures(data)
    assert numbers["samples"] > 130
    assert 2.5 < numbers["sum_over_blend"]["median"] < 5.0
    assert 5.0 < numbers["task_to_normal_deg"]["median"] < 20.0
    assert [run["form"] for run in numbers["runs"]] == ["sum, task"]
    assert numbers["runs"][0]["arrived"]
    assert numbers["runs"][0]["contacts"] == 0
    assert 0.02 < numbers["runs"][0]["min_clearance_m"] < 0.06
    drawn(forms, data)


def drawn(module, data) -> None:
    """Draw the figure: it must have axes, and nothing it warns of (warnings are errors)."""
    with styled():
        figure = module.draw(data)
        figure.canvas.draw()
    assert figure.axes


# ---- the command


def test_the_command_writes_a_figure_and_its_numbers_the_same_each_time(tmp_path: Path, capsys):
    for folder in ("a", "b"):
        assert main(["experiment", "bounce", "--out", str(tmp_path / folder), "--json"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == second
    told = json.loads(first)["bounce"]
    written = json.loads((tmp_path / "a" / "bounce.json").read_text())
    assert told.items() <= written.items()
    for kind in ("png", "svg", "json"):
        a, b = ((tmp_path / folder / f"bounce.{kind}").read_bytes() for folder in ("a", "b"))
        assert a == b, kind
    assert (tmp_path / "a" / "bounce.png").read_bytes().startswith(b"\x89PNG")


def test_a_field_stays_before_a_wall_and_in_a_bucket_and_help_leads_out():
    f = minimum.figures(minimum.run(seconds=(6.2, 8.0, 5.2, 4.0)))
    for name, arrived, held in (
        ("wall", False, {"wall"}),
        ("escape", True, set()),
        ("trap", False, {"floor", "near", "far", "left", "right"}),
        ("plan", True, set()),
    ):
        one = f[name]
        assert (one["arrived"], one["status"]) == (arrived, "arrived" if arrived else "local_minimum"), name
        assert {part.partition(" at ")[0] for part in one["held_by"].split("; ") if part} <= held, name
        assert one["contacts"] == 0, name
        assert one["min_clearance_m"] > 0.02, name
        assert one["faults"] == [], name


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["nope", "--out", "x"], "got 'nope', wanted one of potential"),
        (["line"], "--out is missing"),
        (["--out", "x"], "wanted names or --all"),
        (["line", "--all", "--out", "x"], "wanted names or --all"),
    ],
)
def test_a_wrong_call_is_one_line(arguments: list[str], complaint: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["experiment", *arguments]) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_every_experiment_is_listed_and_has_its_picture_on_its_page(capsys):
    assert main(["experiment", "--list"]) == 0
    listed = [row.split()[0] for row in capsys.readouterr().out.splitlines()]
    assert listed == list(experiment.NAMES)
    page = (ROOT / "docs" / "experiments.md").read_text(encoding="utf-8")
    for name in listed:
        assert f"({name}.png)" in page, name
        assert (ROOT / "docs" / f"{name}.png").stat().st_size < 150_000, name
