"""The conversation with a vehicle whose MAVLink is MAVSDK's C++ stack: found, asked, armed, driven, let go."""

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mavsdk")

from rtctl.app.rover import ROVER as VEHICLE
from rtctl.app.rover_link import open_link
from rtctl.app.servo import Servo
from rtctl.design.rover import build
from rtctl.hal.clock import Slot
from rtctl.hal.mavlink.wire import InProcess
from rtctl.rover import faults
from rtctl.rover.pipe import warm
from rtctl.spec.base import load
from rtctl.types import Request, State, Verb
from tests.base_lab import ROVER, goal_at
from tests.mavsdk_vehicle import ARM, INTERVAL, SET_MODE, MavsdkVehicle


class Wall(InProcess):
    """An exchange by the wall clock."""

    def now(self) -> float:
        return time.monotonic()


@pytest.fixture
def vehicle() -> Iterator[MavsdkVehicle]:
    found = MavsdkVehicle()
    yield found
    found.close()


def driven(config: Path, vehicle: MavsdkVehicle) -> tuple[Any, Any]:
    """Return a servo on a link to the vehicle, after the handshake, and a function that turns it until."""
    checked = load(config)
    base: Any = build(checked, config)
    warm(base)  # the vehicle lives by the wall clock: nothing may compile while it is not heard
    link: Any = open_link(checked, config, Wall(vehicle.exchange, 0.02))
    start = link.handshake()
    servo = Servo(VEHICLE, base, link, None, start)
    link.settle()
    slots = iter(range(1 << 30))

    def turn(until: Any, seconds: float, request: Request = Request()) -> bool:  # noqa: B008
        for _ in range(round(50 * seconds)):
            servo.turn(Slot(next(slots), 0, 0.0), request)
            request = Request()
            if until():
                return True
        return False

    return servo, turn


def test_mavsdk_is_found_asked_armed_driven_and_let_go(vehicle: MavsdkVehicle) -> None:
    servo, turn = driven(ROVER, vehicle)
    link: Any = servo.link
    assert link.vehicle == (1, 1)
    assert link.talk.rates["LOCAL_POSITION_NED"] == 40.0  # 50 was denied
    asked = [fields["param1"] for command, fields in vehicle.commands if command == INTERVAL]
    assert {32.0, 30.0, 193.0} <= set(asked)
    assert not vehicle.armed
    turn(lambda: not servo.memory.in_force, 5.0)
    assert turn(lambda: servo.memory.state == State.RUN, 10.0, Request(Verb.ARM)), servo.events
    kinds = [command for command, _ in vehicle.commands if command in (SET_MODE, ARM)]
    assert kinds[:2] == [SET_MODE, ARM]
    turn(lambda: math.hypot(vehicle.y - 4.0, vehicle.x) < 0.5, 15.0, Request(goal=goal_at(4.0, 0.0)))
    assert math.hypot(vehicle.y - 4.0, vehicle.x) < 0.5  # east, north: the stack read what was meant
    points = [fields for name, fields in vehicle.heard if name == "SET_POSITION_TARGET_LOCAL_NED"]
    assert {point["type_mask"] for point in points} <= {0x05C7, 0x05E7}
    assert all(point["vy"] == 0.0 for point in points)
    beats = [fields for name, fields in vehicle.heard if name == "HEARTBEAT"]
    assert {(beat["type"], beat["autopilot"]) for beat in beats} == {(18, 8)}
    assert link.view.clock.round_trip < 0.5  # TIMESYNC was answered and matched
    assert "uplink_lost" not in faults.names(servo.faults_seen)
    assert turn(lambda: servo.memory.done, 10.0, Request(Verb.TERM))
    assert not vehicle.armed
    assert abs(vehicle.v) < 0.2
