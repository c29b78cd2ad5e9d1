"""What the rover does with what it sees, does not see, and is told wrongly: range sensors as sources of their own.

The oracle is the double's geometry and its own account of what the sensor was told to hide.
"""

import math

import numpy as np
import pytest

from rtctl.rover import occupancy
from rtctl.rover.signals import Ask
from rtctl.spec.base import load
from rtctl.types import State, Status, Verb
from tests.base_lab import ROVER, BaseLab, goal_at
from tests.test_base_link import distance_sensor, fed, obstacle_distance

DISC = {"name": "disc", "type": "cylinder", "radius_m": 2.0, "length_m": 2.0, "position_m": [14.0, 0.0, 0.0]}


def configured(folder, *tables: str, edits=()):
    """Return the path of the rover's config with further tables."""
    text = ROVER.read_text()
    for old, new in edits:
        text = text.replace(old, new)
    path = folder / "rover.toml"
    path.write_text("\n".join([text, *tables]))
    return path


def stood_and_said(lab: BaseLab, *reasons: str) -> None:
    """Check that the base touched nothing, stands, and says why."""
    assert lab.rover.truth().contacts == 0
    assert lab.least > 0.3
    assert lab.speed < 0.1
    assert {lab.m.status.name.lower(), *lab.faults} & set(reasons), (lab.m.status, lab.faults)


# -- sources ---------------------------------------------------------------------------------------------------------


def test_a_scan_comes_from_any_component_of_the_vehicle_and_from_one_while_two_speak():
    lab = BaseLab()
    assert lab.rover.lidar.end.codec.srcComponent == 195
    cells = [400] * 72
    f = fed(lab, obstacle_distance(cells, 5, 5.0, 0.0, 12, component=196))
    assert f.scans == 0  # 195 speaks
    assert any("196" in line and "name both" in line for line in lab.link.events)
    f = fed(lab, obstacle_distance(cells, 5, 5.0, 0.0, 12, component=195))
    assert f.scans == 1


def test_when_a_sensor_comes_back_as_another_component_it_is_heard_again():
    lab = BaseLab(inject=["scan_component@4.0"]).driving(seconds=3.0)
    assert lab.run(2.0, lambda: "scan_stale" in lab.faults)
    assert lab.run(4.0, lambda: not lab.faults)
    lab.run(2.0)
    assert lab.speed > 1.0


def test_named_sensors_are_mounted_where_the_config_says_and_fused(tmp_path):
    front = (
        '[[sensor]]\nname = "front"\ncomponent = 195\noffset_m = [0.4, 0.1]\nyaw_rad = 0.5\nmax_m = 8.0\nmin_m = 0.5'
    )
    rear = '[[sensor]]\nname = "rear"\ncomponent = 196\nyaw_rad = 3.14159\nframe = "body"'
    lab = BaseLab(configured(tmp_path, front, rear))
    cells = [65535] * 72
    cells[0], cells[1], cells[2] = 300, 900, 40
    f = fed(lab, obstacle_distance(cells, 5, 5.0, 0.0, 12, 195), obstacle_distance(cells, 5, 5.0, 0.0, 0, 196))
    assert (f.sensor, f.scans) == (0, 1)
    np.testing.assert_allclose(f.scan[:3], (3.0, np.inf, -1.0))  # beyond max_m, below min_m
    assert f.scan_start == pytest.approx(0.5)
    np.testing.assert_allclose(f.scan_offset, (0.4, 0.1))
    f = fed(lab)
    assert (f.sensor, f.scans) == (1, 1)
    assert abs(f.scan_start) == pytest.approx(3.14159, abs=1e-4)  # body, whatever was sent
    lab.link.wire._waiting = []
    lab.tick()


@pytest.mark.parametrize(("frame", "said", "start"), [("as sent", 0, 10.0), ("body", 0, 0.0), ("north", 12, 10.0)])
def test_the_frame_is_what_the_config_says_or_as_sent(frame, said, start, tmp_path):
    lab = BaseLab(configured(tmp_path, f'[[sensor]]\nname = "s"\nframe = "{frame}"'))
    lab.link.view.yaw = math.radians(80.0)  # 10 degrees east of north
    f = fed(lab, obstacle_distance([400] * 72, 5, 5.0, 0.0, said))
    assert math.degrees(f.scan_start) == pytest.approx(start)


def test_below_the_minimum_and_zero_are_unknown_and_an_unknown_scan_is_none():
    lab = BaseLab()
    lab.link.wire.rest(0.0)
    cells = [400] * 72
    cells[3], cells[4], cells[5] = 0, 15, 20
    f = fed(lab, obstacle_distance(cells, 5, 5.0, 0.0, 12, low=20))
    np.testing.assert_allclose(f.scan[2:7], (4.0, -1.0, -1.0, 0.2, 4.0))
    before = lab.link.view.ranging.known_at
    fed(lab, obstacle_distance([65535] * 72, 5, 5.0, 0.0, 12))
    assert lab.link.view.ranging.known_at == before


def test_a_signed_link_takes_no_unsigned_scan(tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    keyed = f'signing = "required"\nkey_file = "{key}"\nstate_file = "{tmp_path / "stamps"}"'
    lab = BaseLab(configured(tmp_path, edits=[('signing = "off"', keyed)]))
    f = fed(lab, obstacle_distance([400] * 72, 5, 5.0, 0.0, 12))
    assert (f.scans, f.refused) == (0, 1)


def test_distance_sensors_alone_are_sight_enough_to_drive_slowly_past_nothing(tmp_path):
    beams = '[[sensor]]\nname = "ring"\nmessage = "DISTANCE_SENSOR"'
    config = configured(tmp_path, beams)
    ring = [distance_sensor(k, 800) for k in range(8)]
    lab = BaseLab(config, relay=lambda way, packets: packets if way == "up" else [*packets, *ring])
    lab.armed().tick(goal=goal_at(6.0, 0.0))
    assert lab.run(15.0, lambda: lab.m.status == Status.ARRIVED), (lab.m.status, lab.faults)


# -- seen, free, unknown ---------------------------------------------------------------------------------------------


def test_unknown_is_not_free_when_all_of_the_scan_is_unknown_while_it_drives_at_the_disc():
    lab = BaseLab(obstacles=[DISC], inject=["scan_unknown@4.0"]).driving(30.0, 0.0, seconds=3.5)
    assert lab.speed > 1.5
    lab.run(8.0)
    stood_and_said(lab, "blind")
    assert lab.m.here.x[0] < 12.0 - 1.0


@pytest.mark.parametrize("window", ["-45:45", "-30:60", "-60:20"])
def test_a_front_that_is_unknown_from_the_start_is_not_driven_into_and_named(window):
    lab = BaseLab(obstacles=[DISC], inject=[f"scan_blind@0:0:{window}"]).driving(30.0, 0.0, seconds=12.0)
    assert lab.rover.truth().contacts == 0
    assert math.hypot(*lab.m.here.x) < 1.5  # from the second look on it creeps
    assert lab.m.status in (Status.BLIND, Status.MOVING)
    low, high = window.split(":")
    said = [detail for _, name, detail in lab.servo.events if name == "blind"]
    width = 5.0  # of a sector: its edges belong to it
    assert any(f"{(float(low) - 0.5 * width) % 360.0:g} to {float(high) + 0.5 * width:g} deg" in text for text in said)


def test_a_front_that_goes_dark_under_way_stops_the_base_short_of_what_it_never_saw():
    lab = BaseLab(obstacles=[DISC], inject=["scan_blind@2.0:0:-45:45"]).driving(30.0, 0.0, seconds=12.0)
    stood_and_said(lab, "blind", "scan_wrong")


def test_a_blind_back_hinders_nobody_who_drives_ahead():
    lab = BaseLab(inject=["scan_blind@0:0:100:260"]).armed()
    assert lab.arrive(15.0, 2.0)
    assert lab.seen == ()


def test_it_drives_on_when_it_sees_again():
    lab = BaseLab(inject=["scan_unknown@3.0:4.0"]).driving(seconds=2.5)
    assert lab.run(4.0, lambda: lab.m.status == Status.BLIND)
    assert lab.run(6.0, lambda: lab.speed > 1.5)


def test_a_spurious_zero_behind_is_no_contact():
    lab = BaseLab(inject=["scan_zero@0.0"]).armed()
    assert lab.arrive(12.0, 0.0)
    assert "contact" not in lab.seen


def test_what_was_seen_counts_for_its_time_and_its_place_moves_with_the_window():
    chart = occupancy.empty(np.zeros(2))
    step = -2.0 * math.pi / 72
    clear = np.full(72, np.inf)
    clear[18] = -1.0  # one sector to the right knows nothing
    chart = occupancy.integrate_scan(chart, occupancy.PlacedScan(np.zeros(2), 0.0, step, clear, 12.0), 100)
    chart = occupancy.stood(chart, np.zeros(2), 0.5, 100)
    ahead, right = np.array([1.0, 0.0]), np.array([0.0, -1.0])
    gap, first = occupancy.seen_ahead(chart, np.zeros(2), ahead, 0.5, 3.0, 99)
    assert (gap, first) == (math.inf, 100)
    gap, _ = occupancy.seen_ahead(chart, np.zeros(2), ahead, 0.5, 3.0, 100)
    assert gap < 0.3  # too old
    gap, _ = occupancy.seen_ahead(chart, np.zeros(2), right, 0.5, 3.0, 99)
    assert gap < 1.0
    away = occupancy.moved(chart, np.array([26.0, 0.0]))
    assert (away.origin != chart.origin).any()
    gap, first = occupancy.seen_ahead(away, np.zeros(2), ahead, 0.5, 3.0, 99)
    assert (gap, first) == (math.inf, 100)


# -- frames ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [0, 1, 2], ids=["body-as-north", "north-as-body", "mirrored"])
def test_a_frame_that_turns_with_or_against_the_vehicle_is_noticed_and_named(wrong):
    lab = BaseLab(obstacles=[{**DISC, "position_m": [12.0, 2.0, 0.0]}], inject=[f"scan_frame@0:0:{wrong}"])
    lab.driving(30.0, 0.0, seconds=14.0)
    stood_and_said(lab, "scan_wrong", "blind", "local_minimum", "shadowed")
    if "scan_wrong" in lab.seen:
        assert any("set frame in [[sensor]]" in detail for _, _, detail in lab.servo.events)


def test_a_right_frame_is_never_called_wrong_while_it_winds_through_solids():
    solids = [
        {**DISC, "name": f"d{k}", "radius_m": 1.0, "position_m": [5.0 + 4.0 * k, (-1) ** k * 2.0, 0.0]}
        for k in range(4)
    ]
    lab = BaseLab(obstacles=solids).armed()
    assert lab.arrive(24.0, 0.0)
    assert "scan_wrong" not in lab.seen


# -- asked and done --------------------------------------------------------------------------------------------------


def test_no_effect_is_told_with_the_numbers_where_the_ground_gives_a_sixth_of_the_yaw_rate():
    lab = BaseLab(inject=["weak_yaw@0.0"]).armed()
    lab.tick(goal=goal_at(-10.0, 1.0))
    assert lab.run(8.0, lambda: "no_effect" in lab.faults)
    assert lab.m.state == State.SAFE_STOP
    assert any("no_effect" in detail and "asked" in detail and "rad/s" in detail for _, _, detail in lab.servo.events)


def test_no_effect_of_speed_on_wheels_that_slip():
    lab = BaseLab(inject=["weak_drive@3.0"]).driving(seconds=2.0)
    assert lab.run(8.0, lambda: "no_effect" in lab.faults)


def test_uplink_lost_is_told_and_latched_and_a_link_that_heals_moves_nothing():
    lab = BaseLab(inject=["deaf@3.0:7.0"]).driving(seconds=2.5)
    assert lab.run(4.5, lambda: "uplink_lost" in lab.faults)
    assert lab.m.state == State.SAFE_STOP
    lab.run(9.0)
    assert lab.speed < 0.05
    assert lab.asks[-1] != Ask.ENGAGE


# -- where it is -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bias", [0.0, 0.05, 0.1, 0.2])
def test_a_bias_of_the_reported_speed_moves_neither_the_estimate_nor_what_arrived_means(bias):
    lab = BaseLab(inject=[f"speed_bias@0:0:{bias}"]).armed()
    assert lab.arrive(6.0, 1.0, 15.0)
    lab.run(2.0)
    truth = lab.rover.truth()
    assert np.hypot(lab.m.here.x[0] - truth.x, lab.m.here.x[1] - truth.y) < 0.05
    assert np.hypot(truth.x - 6.0, truth.y - 1.0) < 0.3 + 0.05


def test_positions_that_stop_end_the_coasting_and_do_not_move_the_map():
    lab = BaseLab(obstacles=[DISC], inject=["position_frozen@4.0:15.0"]).driving(8.0, 0.0, seconds=3.0)
    kept = lab.m.chart.origin.copy()
    assert lab.run(4.0, lambda: "position_lost" in lab.faults)
    lab.run(8.0)
    truth = lab.rover.truth()
    assert np.hypot(lab.m.here.x[0] - truth.x, lab.m.here.x[1] - truth.y) < 2.0 * 2.0 * 1.5  # it coasted for 1.5 s
    assert lab.run(8.0, lambda: lab.m.unheard < 0.1)
    lab.run(0.5)
    assert "position_jump" not in lab.seen
    truth = lab.rover.truth()
    assert np.hypot(lab.m.here.x[0] - truth.x, lab.m.here.x[1] - truth.y) < 0.05
    np.testing.assert_array_equal(lab.m.chart.origin, kept)


def test_gps_lost_slows_at_once_and_then_holds():
    lab = BaseLab(inject=["gps_loss@4.0"]).driving(seconds=3.5)
    assert lab.speed > 1.5
    lab.run(2.3)
    assert lab.m.last.fix_lost
    assert lab.speed < 0.8
    assert lab.run(2.0, lambda: "gps_lost" in lab.faults)
    lab.run(2.0)
    assert lab.speed < 0.1


def test_a_home_that_moves_is_recognised_by_what_the_numbers_agree_with():
    lab = BaseLab(inject=["home_relative@0.0"], pose=(5.0, 3.0, 0.0))
    lab.run(6.0)
    assert lab.link.view.relative_to_home
    assert lab.link.view.firmware == (4, 0, 0)
    assert any("relative to home" in line for _, _, line in lab.servo.events)
    place = lab.link.local(-35.363262, 149.165237)  # the origin
    np.testing.assert_allclose(place, (-5.0, -3.0), atol=0.05)


# -- whose hold ------------------------------------------------------------------------------------------------------


def test_our_own_hold_is_nobodys_mode_and_one_reset_is_enough():
    lab = BaseLab(inject=["mute@3.0:3.5"]).driving(seconds=2.5)
    assert lab.run(8.0, lambda: lab.rover.autopilot.mode == 4)
    lab.run(2.0)
    lab.tick(Verb.RESET)
    assert not lab.m.refusal
    lab.run(2.0)
    assert lab.m.state == State.IDLE
    assert "mode_taken" not in lab.seen
    assert lab.armed().m.state == State.RUN


def test_the_shipped_config_names_no_sensor_and_listens_to_any():
    assert load(ROVER).sensor == ()
