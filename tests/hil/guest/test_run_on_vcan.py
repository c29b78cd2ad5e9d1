"""Controller and drives as two processes on a real SocketCAN bus: what a kernel, a kill or a stranger can do to them.

One session serves most tests: each begins with the tip under way, however the one before ended.
"""

import signal
import subprocess
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from rtctl.errors import EXIT_CONFIG, EXIT_OK
from tests.rig import IDS, JOINTS, Process, Rig, Tap, stopped, until
from tools.vcan import BRING_UP, CHANNEL

WATCHDOG = 0.020  # [s] of configs/panda.toml
STEP = 0.0005  # [s] of the drives' own clock
STILL = 0.01  # [m/s] a drive cannot say 0: the nearest it can is 2.4 mrad/s
WATCHDOG_BIT, BRAKE_BIT = 1, 16  # of a reply's status byte
ACTIVE = "20000004#0040000000000000"  # error frame: the controller is error-active again
REST = 0.5  # [s] from the last command until every joint stands, whatever happens


def run(command: str) -> None:
    subprocess.run(command.split(), check=True, timeout=30)


def bring_up() -> None:
    """Make the interface anew."""
    subprocess.run(["ip", "link", "del", CHANNEL], check=False, capture_output=True)
    subprocess.run(["sh", "-c", BRING_UP], check=True)


class Beside(Rig):
    """A rig whose controller is replaced when a test has used it up, on a bus that is mended before each test."""

    controlling: Process | None = None

    def told(self) -> list[float]:
        """Return the joint angles [rad] as the drives report them, in a report that is not older than this call."""
        asked = self.report()["time_s"]
        until(lambda: self.report()["time_s"] > asked, lambda: f"no news: {self.report()}")
        return list(self.report()["q_rad"])

    def ready(self) -> Process:
        """Have drives and a controller that an operator can set going; return the controller."""
        run(f"ip link set {CHANNEL} up")
        run(f"cansend {CHANNEL} {ACTIVE}")
        if self.plant is None:
            self.drives()
        if self.controlling is None or self.controlling.popen.poll() is not None:
            self.controlling = self.controller()
        return self.controlling


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beside]:
    """Both processes on a fresh interface."""
    bring_up()
    with Beside(tmp_path_factory.mktemp("session"), can=CHANNEL) as rig:
        yield rig


@pytest.fixture
def rig(session: Beside) -> Beside:
    """The session with the tip under way."""
    session.ready()
    session.under_way()
    return session


@pytest.fixture
def controller(rig: Beside) -> Process:
    """The controller that drives the arm."""
    assert rig.controlling is not None
    return rig.controlling


def stays(rig: Beside, state: str, ticks: int = 200) -> None:
    """Assert that the state lasts, and that the arm, by the drives' own account, stays where it is."""
    until(lambda: np.ptp([rig.told(), rig.told()], axis=0).max() < 1e-4, lambda: "does not come to rest")
    first, stood = rig.status(), rig.told()
    until(lambda: rig.status()["tick"] >= first["tick"] + ticks, lambda: "stands still")
    assert (first["state"], rig.status()["state"]) == (state, state)
    np.testing.assert_allclose(rig.told(), stood, atol=1e-3)


def stopped_by_watchdog(trips: list[dict[str, Any]]) -> None:
    """Assert that every drive stopped its joint by itself, in time."""
    assert len(trips) == JOINTS
    for trip in trips:
        assert trip["code"] == 0xD
        assert WATCHDOG - STEP <= trip["command_to_fault_s"] <= WATCHDOG + STEP
        assert trip["command_to_rest_s"] <= REST


def report_bits(tap: Tap) -> list[int]:
    """Return the status byte of each drive's newest reply."""
    newest = {one.can_id: one.data[9] for one in tap.heard if one.can_id - 0x10 in IDS}
    assert len(newest) == JOINTS
    return list(newest.values())


def test_a_second_controller_on_the_interface_is_refused(session: Beside) -> None:
    controller = session.ready()
    controller.popen.send_signal(signal.SIGSTOP)  # in a guest two programs in real time leave a third no core
    try:
        second = session.launch()
        assert second.wait() == EXIT_CONFIG
    finally:
        controller.popen.send_signal(signal.SIGCONT)
    assert second.text.count("\n") == 1
    assert f"in use by process {controller.popen.pid} of user " in second.text
    assert "wanted one rtctl per bus" in second.text
    session.under_way()  # the first can go on


def test_error_passive_is_told_and_refuses_arming_while_it_lasts(rig: Beside) -> None:
    assert rig.ask("disarm")["ok"]
    rig.reach("IDLE")
    run(f"cansend {CHANNEL} 20000004#0030000000000000")
    until(lambda: "error_passive" in rig.status()["faults"], lambda: f"not noticed: {rig.status()}")
    assert rig.ask("arm")["error"].startswith("arm: error_passive")
    run(f"cansend {CHANNEL} {ACTIVE}")
    until(lambda: rig.ask("arm")["ok"], lambda: f"still refused: {rig.status()}")


def test_bus_off_is_a_safe_stop_that_a_restart_does_not_leave(rig: Beside) -> None:
    run(f"cansend {CHANNEL} 20000040#0000000000000000")
    assert rig.reach("SAFE_STOP")["faults"] == ["bus_off"]
    assert rig.ask("reset")["error"].startswith("reset: bus_off")
    run(f"cansend {CHANNEL} 20000100#0000000000000000")  # restarted
    until(lambda: rig.status()["speed_m_s"] < STILL, lambda: f"moves: {rig.status()}")
    stays(rig, "SAFE_STOP")
    assert rig.ask("reset")["ok"]
    rig.reach("IDLE")


def test_an_interface_that_goes_down_stops_the_arm_and_coming_up_does_not_start_it(rig: Beside) -> None:
    before = len(rig.report()["trips"])
    run(f"ip link set {CHANNEL} down")
    assert "link_down" in rig.reach("SAFE_STOP")["faults"]
    stopped_by_watchdog(rig.trips(before))
    stood = rig.told()
    run(f"ip link set {CHANNEL} up")
    until(lambda: "drive_fault" in rig.status()["faults"], lambda: f"no replies: {rig.status()}")
    stays(rig, "SAFE_STOP")
    assert {"link_down", "drive_fault"} <= set(rig.status()["faults"])
    np.testing.assert_allclose(rig.told(), stood, atol=1e-3)


def test_a_queue_that_does_not_drain_is_a_safe_stop(rig: Beside) -> None:
    run(f"tc qdisc add dev {CHANNEL} root netem delay 60s limit 10")
    told = rig.reach("SAFE_STOP")
    run(f"tc qdisc del dev {CHANNEL} root")
    assert "send_failed" in told["faults"]
    stays(rig, "SAFE_STOP")


def test_a_suspended_controller_leaves_the_stop_to_the_drives_and_wakes_up_stopped(
    rig: Beside, controller: Process
) -> None:
    before = len(rig.report()["trips"])
    with rig.tap() as tap:
        controller.signal(signal.SIGSTOP)
        until(lambda: stopped(controller.popen.pid), lambda: "runs")
        stopped_by_watchdog(rig.trips(before))
        asleep = len(tap.heard)
        controller.signal(signal.SIGCONT)
        assert "drive_fault" in rig.reach("SAFE_STOP")["faults"]
        first = rig.status()["tick"]
        stays(rig, "SAFE_STOP")
        last = rig.status()["tick"]
        until(lambda: len(tap.commands(asleep)) >= JOINTS * (last - first), lambda: "commands are missing on the bus")
        heard = len(tap.commands(asleep)) // JOINTS
        assert heard <= rig.status()["tick"] - first + 100
        until(lambda: all(one.stop for one in tap.commands()[-JOINTS:]), lambda: "goes on asking for torque")
        assert all(bits & WATCHDOG_BIT and bits & BRAKE_BIT for bits in report_bits(tap))


def test_a_killed_controller_leaves_the_stop_to_the_drives(rig: Beside, controller: Process) -> None:
    before = len(rig.report()["trips"])
    controller.signal(signal.SIGKILL)
    assert controller.wait() == -signal.SIGKILL
    stopped_by_watchdog(rig.trips(before))
    stood = rig.told()
    with rig.tap() as tap:
        rig.ready()
        told = rig.status()
        assert (told["state"], told["faults"]) == ("IDLE", ["drive_fault"])
        assert all(bits & WATCHDOG_BIT and bits & BRAKE_BIT for bits in report_bits(tap))
    np.testing.assert_allclose(rig.told(), stood, atol=1e-3)


def test_a_second_master_is_a_safe_stop_until_a_restart(rig: Beside, controller: Process) -> None:
    run(f"cansend {CHANNEL} 003##1FFFFFFFFFFFFFFFD00000000")
    assert "foreign_command" in rig.reach("SAFE_STOP")["faults"]
    until(lambda: rig.status()["speed_m_s"] < STILL, lambda: f"moves: {rig.status()}")
    assert "foreign_command" in rig.ask("reset")["error"]
    controller.signal(signal.SIGTERM)
    assert controller.wait() == EXIT_OK
