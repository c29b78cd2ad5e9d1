"""`rtctl run` as a process beside its drives: how it starts, what it refuses, and how it ends whatever happens."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from rtctl.arm.sensing import REST_SPEED
from rtctl.errors import EXIT_CONFIG, EXIT_FAILED, EXIT_OK
from rtctl.log.schema import TX
from rtctl.protocol import mit
from rtctl.types import Drive, State, Verb
from tests.rig import AWAY, JOINTS, MOVING, Process, Rig, states_of, stopped, until

STOP_DISTANCE = 0.5**2 / (2 * 5.0)  # [m] from v_max at a_max, both of configs/panda.toml


def one_line(process: Process) -> str:
    """All that a process said after whose daemon starts, which must be one line and no traceback."""
    text = re.sub(r"^rtctl: starting .*\n", "", process.text).strip()
    assert "\n" not in text, text
    assert "Traceback" not in text
    return text


# ---- one session for what leaves it as it was


@pytest.fixture(scope="class")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A controller that is IDLE, its drives beside it."""
    with Rig(tmp_path_factory.mktemp("session")) as rig:
        rig.drives()
        rig.controller()
        yield rig


@pytest.fixture
def idle(session: Rig) -> Rig:
    """The shared session, brought back to IDLE."""
    if session.status()["state"] == "RUN":
        session.ask("disarm")
    elif session.status()["state"] == "SAFE_STOP":
        session.ask("reset")
    session.reach("IDLE")
    return session


class TestSession:
    """What leaves a session as it was shares one, and it ends with them: in lockstep it takes a whole core."""

    def test_a_controller_comes_up_idle_and_nothing_moves_before_it_is_armed(self, idle: Rig) -> None:
        first = idle.status()
        assert (first["state"], first["faults"]) == ("IDLE", [])
        reply = idle.ask("goal", position_m=AWAY)
        assert (reply["ok"], reply["error"]) == (False, "goal: not possible in state IDLE")
        until(lambda: idle.status()["tick"] > first["tick"] + 200, lambda: "stands still")
        np.testing.assert_allclose(idle.status()["q_rad"], first["q_rad"], atol=1e-3)

    def test_verbs_in_the_wrong_state_are_refused_with_the_reason(self, idle: Rig) -> None:
        for verb in ("disarm", "stop"):
            reply = idle.ask(verb)
            assert (reply["ok"], reply["error"]) == (False, f"{verb}: not possible in state IDLE")
        idle.arm()
        for verb in ("arm", "reset", "recover"):
            assert idle.ask(verb)["error"] == f"{verb}: not possible in state RUN"
        assert idle.ask("stop")["ok"]
        idle.reach("SAFE_STOP")
        for verb in ("arm", "disarm", "stop", "recover"):
            assert idle.ask(verb)["error"] == f"{verb}: not possible in state SAFE_STOP"
        assert "not possible in state SAFE_STOP" in idle.ask("goal", position_m=AWAY)["error"]

    def test_a_goal_told_while_it_arms_is_taken_when_it_runs(self, idle: Rig) -> None:
        assert idle.ask("arm")["ok"]
        assert idle.ask("goal", position_m=AWAY)["ok"]
        until(lambda: idle.status()["goal_m"] == AWAY, lambda: f"not taken: {idle.status()}")
        assert not idle.status()["queued"]

    def test_the_status_tells_of_the_arm_and_the_program_while_it_runs(self, idle: Rig) -> None:
        idle.arm()
        idle.go()
        moving = idle.status()
        assert moving["robot"] == "panda"
        assert (moving["state"], moving["status"]) == ("RUN", "moving")
        assert moving["goal_m"] == AWAY
        assert moving["error_m"] == pytest.approx(float(np.linalg.norm(np.subtract(AWAY, moving["x_m"]))), abs=1e-6)
        assert len(moving["q_rad"]) == JOINTS
        assert 0.0 < moving["torque_ratio"] < 1.0
        assert (moving["missed"], moving["faults"]) == (0, [])
        assert moving["log"] | {"path": ""} == {"path": "", "dropped": 0, "degraded": False}
        assert Path(moving["log"]["path"] + ".open").exists() or Path(moving["log"]["path"]).exists()
        until(lambda: idle.status()["status"] == "arrived", lambda: f"not there: {idle.status()}")
        shown = subprocess.run(
            [sys.executable, "-m", "rtctl", "status", "--socket", idle.console],
            capture_output=True,
            text=True,
            check=True,
        )
        assert "RUN" in shown.stdout
        assert "arrived" in shown.stdout

    def test_a_stream_of_goals_is_followed_to_its_end_and_one_that_breaks_off_is_stale(self, idle: Rig) -> None:
        idle.arm()
        begun = idle.status()["x_m"]
        lines = [
            f"{begun[0]:.4f},{begun[1] + 0.005 * k:.4f},{begun[2]:.4f},0,0.1,0,10000" for k in range(20)
        ]  # as they come: nobody waits at one that moves
        end = f"{begun[0]:.4f},{begun[1] + 0.1:.4f},{begun[2]:.4f},0,0,0,10000"
        sent = subprocess.run(
            [sys.executable, "-m", "rtctl", "goals", "-", "--socket", idle.console],
            input="\n".join(["x,y,z,vx,vy,vz,timeout_ms", *lines, end]) + "\n",
            capture_output=True,
            text=True,
            check=True,
        )
        assert sent.stdout.count("arrived") == 1
        np.testing.assert_allclose(idle.status()["x_m"], np.add(begun, [0.0, 0.1, 0.0]), atol=5e-3)
        assert idle.ask("goal", position_m=begun, velocity_m_s=[0.0, -0.1, 0.0], timeout_ms=50)["ok"]
        until(lambda: idle.status()["faults"] == ["goal_stale"], lambda: f"not stale: {idle.status()}")
        stale = idle.status()
        assert (stale["state"], stale["status"]) == ("RUN", "no_goal")
        assert stale["goal_timeout_ms"] == 50.0
        assert stale["goal_age_ms"] > 50.0
        assert stale["goal_velocity_m_s"] == [0.0, -0.1, 0.0]
        assert idle.ask("hold")["ok"]
        until(lambda: idle.status()["faults"] == [], lambda: f"still stale: {idle.status()}")

    def test_a_ball_on_the_tip_is_refused_and_the_arm_stays_where_it_is(self, idle: Rig) -> None:
        idle.arm()
        before = idle.status()
        ball = {"name": "ball", "type": "sphere", "radius_m": 0.1, "position_m": before["x_m"]}
        reply = idle.ask("obstacle", set=ball)
        assert reply["error"].startswith("obstacle ball: would lie 0.")
        until(lambda: idle.status()["tick"] > before["tick"] + 200, lambda: "stands still")
        after = idle.status()
        assert (after["state"], after["faults"]) == ("RUN", [])
        np.testing.assert_allclose(after["q_rad"], before["q_rad"], atol=2e-3)

    def test_a_second_controller_on_the_bus_is_refused(self, idle: Rig) -> None:
        second = idle.launch()
        assert second.wait() == EXIT_CONFIG
        first = next(p for p in idle.started if "rtctl: ready" in p.text)
        assert f"in use by process {first.popen.pid} of user " in one_line(second)
        assert "wanted one rtctl per bus" in one_line(second)
        assert idle.status()["faults"] == []


# ---- how it ends


def test_sigterm_brings_a_moving_arm_to_rest_holds_it_and_leaves(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drives()
        with rig.tap() as tap:
            controller = rig.controller()
            rig.arm()
            rig.go()
            controller.signal(signal.SIGTERM)
            assert controller.wait() == EXIT_OK
            report = rig.end_drives()
        log = rig.log()
    assert states_of(log) == ["IDLE", "ARMED", "RUN", "STOPPING", "IDLE"]
    ticks = log["/tick"].array
    asked = int(np.flatnonzero(ticks["verb"] == Verb.TERM)[0])
    assert np.linalg.norm(ticks["xd"][asked]) > MOVING
    assert ticks["time"][-1] - ticks["time"][asked] < 2.0
    stopping = ticks[asked : np.flatnonzero(ticks["state"] == State.STOPPING)[-1]]
    assert (stopping["command"] == Drive.TORQUE).all()  # held to the end
    assert (np.abs(stopping["qd"][-50:]) < REST_SPEED).all()
    assert np.linalg.norm(ticks["x"][-1] - ticks["x"][asked]) < 1.5 * STOP_DISTANCE
    np.testing.assert_allclose(report["q_rad"], ticks["q"][-1], atol=2e-3)  # nothing sank when the torque went
    assert ticks["command"][-1] == Drive.DISABLE
    assert set(report["states"].values()) == {"DISABLED"}
    assert report["trips"] == []
    last = tap.commands()[-10 * JOINTS :]
    assert len(last) == 10 * JOINTS
    assert all(one.stop for one in last)
    bus = log["/can/can0"].array
    sent = bus[bus["direction"] == TX][-10 * JOINTS :]
    assert {bytes(data[:8]) for data in sent["data"]} == {mit.DISABLE}
    assert log.sentinel["reason"] == "stopped"


def test_a_second_signal_takes_the_torque_at_once(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        controller = rig.sent_away()
        controller.signal(signal.SIGTERM)
        controller.signal(signal.SIGINT)  # two of one number may become one on their way
        assert controller.wait() == EXIT_OK
        log = rig.log()
    assert states_of(log)[-2:] == ["STOPPING", "FAULT"]
    ticks = log["/tick"].array
    last = ticks[-1]
    assert np.abs(last["qd"]).max() > 3 * REST_SPEED  # it did not wait for rest
    assert (last["command"], last["tau_sent"].any()) == (Drive.DISABLE, False)
    assert (ticks["verb"][-1], ticks["command"][-2]) == (Verb.TERM, Drive.TORQUE)  # in the very tick that heard it


@pytest.mark.parametrize("cause", ["stop", "drive_fault"])
def test_sigterm_in_a_safe_stop_leaves_within_two_seconds(tmp_path: Path, cause: str) -> None:
    with Rig(tmp_path) as rig:
        rig.drives(*(["--inject", "drive_fault@0.4:panda_joint3"] if cause == "drive_fault" else []))
        controller = rig.controller()
        rig.arm()
        rig.go()
        if cause == "stop":
            assert rig.ask("stop")["ok"]
        told = rig.reach("SAFE_STOP")
        assert told["faults"] == ([] if cause == "stop" else ["drive_fault"])
        controller.signal(signal.SIGTERM)
        assert controller.wait() == EXIT_OK
        log = rig.log()
    ticks = log["/tick"].array
    asked = int(np.flatnonzero(ticks["verb"] == Verb.TERM)[0])
    assert ticks["state"][asked - 1] == State.SAFE_STOP
    assert ticks["time"][-1] - ticks["time"][asked] < 2.0
    assert ticks["command"][-1] == Drive.DISABLE
    assert (np.abs(ticks["q"][-1] - ticks["q"][asked]) < 0.3).all()


def test_a_killed_controller_leaves_a_whole_log_and_its_successor_comes_up_idle(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        controller = rig.sent_away()
        controller.signal(signal.SIGKILL)
        assert controller.wait() == -signal.SIGKILL
        assert [trip["code"] for trip in rig.trips()] == [0xD] * JOINTS
        stood = rig.report()["q_rad"]
        first = rig.log(0)
        assert first.complete
        assert first.sentinel["reason"] == "producer died"
        assert states_of(first) == ["IDLE", "ARMED", "RUN"]
        assert np.linalg.norm(first["/tick"].xd[-1]) > MOVING

        successor = rig.controller()
        assert rig.status()["state"] == "IDLE"
        assert rig.status()["faults"] == ["drive_fault"]
        assert "drive_fault" in rig.ask("arm")["error"]
        tick = rig.status()["tick"]
        until(lambda: rig.status()["tick"] > tick + 300, lambda: "stands still")
        np.testing.assert_allclose(rig.report()["q_rad"], stood, atol=1e-4)
        until(lambda: rig.ask("reset")["ok"], lambda: f"no reset: {rig.status()}")
        rig.arm()  # an operator, and nobody else, sets it going again
        rig.go()
        successor.signal(signal.SIGTERM)
        assert successor.wait() == EXIT_OK
        second = rig.log()
    assert states_of(second) == ["IDLE", "ARMED", "RUN", "STOPPING", "IDLE"]


def test_a_tick_that_raises_ends_in_a_damped_stop_with_the_drives_disabled(tmp_path: Path) -> None:
    script = """
import sys, time, traceback
from rtctl import cli
from rtctl.app import arm
told = traceback.TracebackException.__init__
def slowly(*args, **options):
    time.sleep(1.5)  # sources on a slow disk: longer than the drives wait
    told(*args, **options)
traceback.TracebackException.__init__ = slowly
tick, count = arm.tick, 0
def raising(robot, memory, feedback, request):
    global count
    count += memory.goal is not None
    if count > 300:
        raise ZeroDivisionError("injected")
    return tick(robot, memory, feedback, request)
arm.tick = raising
sys.exit(cli.main(sys.argv[1:]))
"""
    with Rig(tmp_path) as rig:
        rig.drives()
        with rig.tap() as tap:
            controller = rig.process([sys.executable, "-c", script, "run", str(rig.config), "--lockstep"])
            controller.expect("rtctl: ready")
            rig.arm()
            assert rig.ask("goal", position_m=AWAY)["ok"]
            assert controller.wait() == EXIT_FAILED
            report = rig.end_drives()
        log = rig.log()
    assert "ZeroDivisionError: injected" in controller.text
    ticks = log["/tick"].array
    assert np.linalg.norm(ticks["xd"][-1]) > MOVING
    assert report["trips"] == []  # the controller stopped the arm, not the watchdog
    assert set(report["states"].values()) == {"DISABLED"}
    np.testing.assert_array_less(np.abs(np.subtract(report["q_rad"], ticks["q"][-1])), 0.2)
    commands = tap.commands()
    stops = [one.stop for one in commands]
    assert all(stops[-10 * JOINTS :])
    damped = len(stops) - 1 - max(i for i, stop in enumerate(stops) if not stop)
    assert damped >= 10 * JOINTS
    assert log.sentinel["reason"] == "failed"


def test_a_dry_run_sends_stop_frames_alone(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drives()
        with rig.tap() as tap:
            controller = rig.controller("--dry")
            assert rig.ask("arm")["ok"]
            until(lambda: rig.status()["state"] == "IDLE", lambda: f"armed: {rig.status()}")  # no drive followed
            controller.signal(signal.SIGTERM)
            assert controller.wait() == EXIT_OK
        report = rig.end_drives()
        log = rig.log()
    commands = tap.commands()
    assert len(commands) > 500 * JOINTS
    assert all(one.stop for one in commands)
    assert report["max_torque_Nm"] == dict.fromkeys(report["max_torque_Nm"], 0.0)
    assert "ARMED" in states_of(log)
    assert Drive.ENABLE in log["/tick"].command  # computed and logged, not sent


# ---- what it refuses


def test_without_drives_it_says_so_in_one_line(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        alone = rig.launch()
        assert alone.wait() == EXIT_FAILED
        assert one_line(alone).startswith(f"rtctl: {tmp_path}/bus: nothing serves this bus (No such file or directory)")


def test_a_drive_that_does_not_answer_is_named(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drives("--now", "--inject", "silent@0:panda_joint4")
        controller = rig.launch()
        assert controller.wait() == EXIT_CONFIG
    last = controller.text.splitlines()[-1]
    assert "joint panda_joint4 (id 4): got no answer; what came: 0x11 panda_joint1, 0x12 panda_joint2" in last
    assert "wanted a reply on id 0x14" in last
    assert "Traceback" not in controller.text


@pytest.mark.parametrize(("key", "register"), [("t_max_Nm", "23 TMAX"), ("v_max_rad_s", "22 VMAX")])
def test_drives_scaled_otherwise_than_the_file_says_are_refused_by_joint_and_register(
    tmp_path: Path, key: str, register: str
) -> None:
    with Rig(tmp_path) as rig:
        rig.drives()
        file = rig.config.read_text()
        head, table, tail = file.partition("[drives.PANDA12]")
        old = next(line for line in tail.splitlines() if line.startswith(key))
        rig.config.write_text(head + table + tail.replace(old, f"{key} = 20.0", 1))
        controller = rig.launch()
        assert controller.wait() == EXIT_CONFIG
        assert rig.report()["max_torque_Nm"]["panda_joint5"] == 0.0
    last = controller.text.splitlines()[-1]
    got = old.split()[-1].removesuffix(".0")
    assert f"joint panda_joint5 (id 5): register {register}: got {got} (" in last
    assert last.endswith("%), wanted 20")
    assert "Traceback" not in controller.text


# ---- drives that vanish


def test_in_lockstep_drives_that_vanish_are_a_fault_and_are_taken_up_again_when_they_return(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        drives = rig.drives()
        controller = rig.controller()
        rig.arm()
        drives.end()
        assert "link_down" in rig.reach("SAFE_STOP")["faults"]
        tick = rig.status()["tick"]
        until(lambda: rig.status()["tick"] > tick + 50, lambda: "stands still")  # it goes on, and answers
        rig.drives()
        rig.under_way()
        controller.signal(signal.SIGTERM)
        assert controller.wait() == EXIT_OK
        assert "Traceback" not in controller.text


def test_in_lockstep_a_controller_whose_drives_are_gone_ends_when_it_is_told_to(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        drives = rig.drives()
        controller = rig.controller()
        rig.arm()
        drives.end()
        rig.reach("SAFE_STOP")
        controller.signal(signal.SIGTERM)
        assert controller.wait() == EXIT_OK
        assert "Bad file descriptor" not in controller.text


# ---- who listens


def test_an_output_that_nobody_reads_does_not_stop_the_loop(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    command = [sys.executable, "-m", "rtctl", "run"]
    with Rig(tmp_path) as rig:
        rig.drives()
        controller = subprocess.Popen([*command, str(rig.config), "--lockstep"], stdout=writer, stderr=writer)
        os.close(writer)
        try:
            until(lambda: Path(rig.console).exists() and rig.status().get("tick", 0) > 0, lambda: "does not run")
            rig.arm()
            rig.go()
            until(lambda: rig.status()["status"] == "arrived", lambda: f"not there: {rig.status()}")
            controller.send_signal(signal.SIGTERM)
            assert controller.wait(60.0) == EXIT_OK
        finally:
            controller.kill()
            controller.wait()
            os.close(reader)


def test_a_reader_that_leaves_after_the_first_line_does_not_stop_the_loop(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rtctl", "run"]
    with Rig(tmp_path) as rig:
        rig.drives()
        controller = subprocess.Popen([*command, str(rig.config), "--lockstep"], stdout=subprocess.PIPE)
        try:
            assert controller.stdout is not None
            assert controller.stdout.readline().startswith(b"rtctl: panda on socketpair:")
            controller.stdout.close()  # as `| head -1` does
            until(lambda: Path(rig.console).exists() and rig.status().get("tick", 0) > 0, lambda: "does not run")
            rig.arm()
            rig.go()
            controller.send_signal(signal.SIGTERM)
            assert controller.wait(60.0) == EXIT_OK
        finally:
            controller.kill()
            controller.wait()


# ---- stopped and continued, in real time


def test_a_controller_that_was_suspended_sends_no_burst_and_does_not_move_again(tmp_path: Path) -> None:
    period = 0.005
    slow = {"servo_hz": "200", "model_hz": "100", "watchdog_ms": "100.0", "stale_hold_ms": "30.0"}
    slow["stale_stop_ms"] = "90.0"
    with Rig(tmp_path, slow, lockstep=False) as rig:
        rig.drives()
        with rig.tap() as tap:
            controller = rig.controller()
            rig.under_way()
            before = len(rig.report()["trips"])
            controller.signal(signal.SIGSTOP)
            until(lambda: stopped(controller.popen.pid), lambda: "not stopped")
            for trip in rig.trips(before):
                assert trip["code"] == 0xD
                assert trip["command_to_fault_s"] <= 0.1 + 0.001
            stood = rig.report()["q_rad"]
            time.sleep(1.0)  # two hundred slots that must not be made up for
            asleep, woken = len(tap.heard), time.monotonic()
            controller.signal(signal.SIGCONT)
            assert "deadline" in rig.reach("SAFE_STOP")["faults"]
            until(lambda: "drive_fault" in rig.status()["faults"], lambda: f"not noticed: {rig.status()}")
            until(lambda: len(tap.commands(asleep)) > 20 * JOINTS, lambda: "sends nothing")
            commands = tap.commands(asleep)
            # beside the grid's own: the turn that was interrupted, the late one, and the first slot of the window
            assert len(commands) <= JOINTS * ((commands[-1].at - woken) / period + 3)
            assert rig.status()["missed"] >= 200
            until(lambda: all(one.stop for one in tap.commands()[-JOINTS:]), lambda: "goes on asking for torque")
            np.testing.assert_allclose(rig.report()["q_rad"], stood, atol=1e-3)
            controller.signal(signal.SIGTERM)
            assert controller.wait() == EXIT_OK
