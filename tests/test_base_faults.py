"""Rows 58 to 69 of the fault catalogue on the rover: each fault by name, what is done about it, and how it ends."""

from pathlib import Path

import numpy as np
import pytest

from firmware_sim.inject import fault_at
from firmware_sim.rover import KINDS
from rtctl.rover import faults
from rtctl.rover.signals import Ask
from rtctl.types import State, Status, Verb
from tests.base_lab import ROVER, ROVER_PX4, BaseLab

DRIVING = 3.0  # [s] of the double's clock at which faults come: arming takes less than one


def setpoints(packets: list[bytes]) -> list[bytes]:
    """Return the SET_POSITION_TARGET_LOCAL_NED among packets."""
    return [p for p in packets if int.from_bytes(p[7:10], "little") == 84]


def test_every_fault_of_the_base_has_a_test_that_names_it():
    here = Path(__file__).parent
    text = "".join((here / f"test_base_{name}.py").read_text() for name in ("faults", "link", "law", "sight"))
    assert [f.name for f in faults.FAULTS if f'"{f.name}"' not in text] == []
    assert len({f.name for f in faults.FAULTS}) == len(faults.FAULTS) < 64


def test_heartbeat_late_holds_and_heartbeat_lost_latches():
    lab = BaseLab(inject=["mute@3.0"]).driving(seconds=2.5)
    assert lab.speed > 1.5
    assert lab.run(3.5, lambda: "heartbeat_late" in lab.faults)
    assert lab.m.state == State.RUN
    lab.run(1.4)
    assert lab.speed < 0.3  # zero twist, streamed on
    assert setpoints(lab.sent)
    assert lab.run(2.0, lambda: lab.m.state == State.SAFE_STOP)
    assert "heartbeat_lost" in lab.faults
    lab.run(1.0)
    lab.tick(Verb.RESET)
    assert "heartbeat_lost" in lab.m.refusal  # still gone


def test_a_rebooted_autopilot_is_asked_anew_and_never_armed_again_by_itself():
    lab = BaseLab(inject=["reboot@3.0"]).driving(seconds=2.5)
    granted = dict(lab.link.talk.rates)
    lab.link.talk.rates.clear()
    assert lab.run(2.0, lambda: lab.m.state == State.SAFE_STOP)
    lab.run(3.0)
    assert {"rebooted", "disarmed", "mode_taken"} & set(lab.seen)
    assert lab.link.talk.rates == granted  # streams were asked for again
    assert not lab.rover.autopilot.armed
    lab.run(2.0)
    assert lab.speed < 0.05
    lab.tick(Verb.RESET)
    assert lab.run(2.0, lambda: lab.m.state == State.IDLE)
    assert lab.armed().m.state == State.RUN  # by an operator's verb


def test_rebooted_is_latched_where_no_other_sign_of_it_came_through():
    lab = BaseLab().driving(seconds=2.0)
    pilot = lab.rover.autopilot
    pilot.booted = pilot.time - 0.1  # the clock starts anew; mode, arming and streams are as they were
    assert lab.run(3.0, lambda: "rebooted" in lab.faults)
    assert lab.m.state == State.SAFE_STOP
    assert lab.link.view.reboots == 1


def test_mode_taken_by_a_person_is_obeyed_within_one_tick_and_never_fought():
    lab = BaseLab(inject=["rc_mode@4.0"]).driving(seconds=3.0)
    assert lab.run(2.0, lambda: not lab.m.last.ours)
    assert lab.asks[-1] == Ask.SILENCE  # the very tick that saw it
    assert not setpoints(lab.sent)
    assert "mode_taken" in lab.faults
    assert lab.m.state == State.SAFE_STOP
    sent = []
    for _ in range(150):
        lab.tick()
        sent += lab.sent
    assert not setpoints(sent)
    assert {int.from_bytes(p[7:10], "little") for p in sent} <= {0, 111}  # heartbeats and TIMESYNC: no mode, no disarm
    assert lab.speed > 0.2  # the person drives on
    lab.tick(Verb.RESET)
    lab.run(1.0)
    assert not setpoints(lab.sent)
    assert lab.rover.autopilot.armed
    lab.tick(Verb.TERM)
    assert lab.m.done  # leaves without touching the vehicle


def test_disarmed_by_somebody_else_ends_the_run():
    lab = BaseLab(inject=["disarm@3.0"]).driving(seconds=2.5)
    assert lab.run(1.0, lambda: "disarmed" in lab.faults)
    assert lab.m.state == State.SAFE_STOP
    assert lab.asks[-1] == Ask.SILENCE


def test_engage_refused_stays_idle_and_shows_the_whole_reason():
    lab = BaseLab(inject=["refuse_arming@0.0"])
    lab.tick(Verb.ARM)
    assert lab.run(5.0, lambda: lab.m.state == State.IDLE)
    assert "engage_refused" in lab.seen
    texts = [detail for _, name, detail in lab.servo.events if name == "vehicle"]
    assert any(
        "Radio failsafe on, hardware safety switch is on and the battery is below its arming" in t for t in texts
    )
    assert any(t == "arming: failed" for t in texts)


def test_without_an_answer_arming_is_tried_three_times_then_given_up():
    lab = BaseLab()
    lab.rover.faults.append(fault_at("deaf", 0.0, None, KINDS))
    sent = []
    for k in range(200):
        lab.tick(Verb.NONE if k else Verb.ARM)
        sent += [p for p in lab.sent if int.from_bytes(p[7:10], "little") == 76]
    assert len(sent) == 3
    assert [p[10 + 30 + 2] if len(p) > 44 else 0 for p in sent] == [0, 1, 2]  # confirmation counts the repeats
    assert lab.m.state == State.IDLE
    assert any("no answer" in detail for _, _, detail in lab.servo.events)


def test_estimator_bad_brakes_and_latches():
    lab = BaseLab(inject=["ekf_bad@3.0:2"]).driving(seconds=2.5)
    assert lab.run(1.5, lambda: "estimator_bad" in lab.faults)
    assert lab.m.state == State.SAFE_STOP
    lab.run(4.0)
    assert lab.speed < 0.05
    assert lab.m.state == State.SAFE_STOP  # healthy again, still latched
    lab.tick(Verb.RESET)
    assert not lab.m.refusal


@pytest.mark.parametrize("config", [ROVER, ROVER_PX4])
def test_a_position_jump_stops_and_what_was_seen_jumps_along(config):
    disc = {"name": "disc", "type": "cylinder", "radius_m": 1.0, "length_m": 2.0, "position_m": [9.0, 4.0, 0.0]}
    lab = BaseLab(config, obstacles=[disc], inject=["ekf_reset@3.0"]).driving(seconds=1.0)
    assert lab.run(4.0, lambda: "position_jump" in lab.faults)
    assert lab.m.state == State.SAFE_STOP
    lab.run(1.0)
    truth = lab.rover.truth()
    np.testing.assert_allclose(lab.m.here.x, (truth.x + 3.0, truth.y), atol=0.1)  # re-seeded
    i, j = (np.array([9.0 + 3.0 - 1.0, 4.0]) / 0.35).astype(int) - lab.m.chart.origin
    assert lab.m.chart.cells[i - 3 : i + 4, j - 3 : j + 4].any()  # the disc's near side, in the new frame


def test_position_stale_holds_and_position_lost_latches_then_the_autopilot_stops_by_itself():
    lab = BaseLab(inject=["silent@3.0"]).driving(seconds=2.5)
    assert lab.run(1.5, lambda: "position_stale" in lab.faults)
    assert lab.m.state == State.RUN
    assert lab.run(2.0, lambda: "position_lost" in lab.faults)
    assert lab.m.state == State.SAFE_STOP
    lab.run(1.5)
    assert lab.speed < 0.05  # zero twist was streamed, heard or not


def test_scan_stale_holds_and_goes_on_when_it_is_back():
    lab = BaseLab(inject=["blind@3.0:1.5"]).driving(seconds=2.5)
    assert lab.run(1.5, lambda: "scan_stale" in lab.faults)
    lab.run(0.9)
    assert lab.speed < 1.0
    assert lab.m.state == State.RUN
    assert lab.run(3.0, lambda: not lab.faults)
    lab.run(2.0)
    assert lab.speed > 1.5


@pytest.mark.parametrize(("config", "bound"), [(ROVER, 5.5), (ROVER_PX4, 3.5)])
def test_when_our_setpoints_stop_the_autopilot_stops_by_itself(config, bound):
    lab = BaseLab(config).driving(seconds=3.5)
    assert lab.speed > 1.5
    for _ in range(round(bound / lab.base.dt)):  # killed: nothing is said any more
        lab.rover.exchange([])
    assert lab.speed < 0.06


def test_every_way_out_sends_explicit_zeros_then_hold_and_disarms_what_we_armed():
    lab = BaseLab().driving(seconds=3.0)
    lab.tick(Verb.TERM)
    assert lab.run(6.0, lambda: lab.m.done)
    assert lab.speed < 0.1
    assert not lab.rover.autopilot.armed
    v = [r["v"] for r, a in zip(lab.records, lab.asks, strict=True) if a == Ask.DRIVE]
    assert abs(v[-1]) < 0.05


def test_ss1_ends_in_the_autopilots_own_hold():
    lab = BaseLab(inject=["mute@3.0:3.5"]).driving(seconds=2.5)
    assert lab.run(8.0, lambda: lab.rover.autopilot.mode == 4)
    assert lab.speed < 0.1
    lab.run(1.0)
    assert lab.asks[-1] == Ask.SILENCE
    assert lab.m.state == State.SAFE_STOP
    assert "mode_taken" not in lab.seen  # it was ours to give away


def test_status_after_a_stop_and_reset_needs_arming_again():
    lab = BaseLab().driving(seconds=2.0)
    lab.tick(Verb.STOP)
    assert lab.m.state == State.SAFE_STOP
    lab.run(3.0)
    assert lab.speed < 0.05
    lab.tick(Verb.RESET)
    assert lab.run(3.0, lambda: lab.m.state == State.IDLE)
    assert lab.m.status == Status.NO_GOAL
    lab.run(1.0)
    assert not lab.rover.autopilot.armed
