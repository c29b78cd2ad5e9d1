"""`rtctl sim`: controller and virtual vehicle in one process, in lockstep, deterministic.

The controller is the daemon's own servo on the same bytes; only the bus is a function call. What is reported comes
from the simulator's account of the truth, which the controller never sees.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from rtctl.app.choose import vehicle_of
from rtctl.app.servo import Servo
from rtctl.app.tally import number
from rtctl.app.vehicle import C, F, M, Play, R, Setup, Turn, Vehicle
from rtctl.hal.clock import lockstep
from rtctl.plain import Json
from rtctl.spec.scenario import Scenario, load_scenario, robot_file

Watch: TypeAlias = Callable[[Any, Any, Any], None]  # is shown servo, truth and turn of the vehicle after each period
Over: TypeAlias = Callable[[Any, float], bool]  # truth, and how long [s] the last goal has been kept


def simulate(
    path: str | Path, log: str | Path | None = None, realtime: bool = False, watch: Watch | None = None
) -> Json:
    """Return the figures of a scenario file, played from its start to `duration_s`; write an MCAP log if asked."""
    scenario = load_scenario(path)
    return simulate_scenario(scenario, robot_file(scenario, path), Path(path), log, realtime, watch)


def simulate_scenario(
    scenario: Scenario,
    where: Path,
    source: Path,
    log: str | Path | None = None,
    realtime: bool = False,
    watch: Watch | None = None,
) -> Json:
    """Return the figures of a scenario for the robot file `where`; paths in it are relative to the file `source`."""
    vehicle = vehicle_of(where)
    return simulate_setup(vehicle, vehicle.load(where, None), scenario, source, log, realtime, watch)


def simulate_setup(
    vehicle: Vehicle[R, M, F, C],
    setup: Setup[R, M, F, C],
    scenario: Scenario,
    source: Path,
    log: str | Path | None = None,
    realtime: bool = False,
    watch: Watch | None = None,
    over: Over | None = None,
) -> Json:
    """Return the figures of a scenario for a robot file already read; `over` ends the run before its time."""
    play = setup.simulate(scenario, source)
    robot, link, sink = play.robot, play.link, None
    try:
        start = link.greet(True)
        if log is not None:
            from rtctl.log.record.writer import McapSink

            sink = McapSink(Path(log), setup.header(robot, start, link))
        servo = Servo(vehicle, robot, link, sink, start, stamp=lambda now: round(now * 1e9))
        begun, ticks = time.perf_counter(), _played(servo, scenario, play, realtime, watch, over)
        elapsed = time.perf_counter() - begun
    finally:
        if sink is not None:
            sink.close("end")
        link.close()
    return {
        **play.figures(servo.events),
        "mode_final": servo.memory.state.name,
        "faults": list(vehicle.names(servo.faults_seen)),
        "ticks": ticks,
        "missed": servo.missed,
        "realtime_factor": number(ticks * robot.dt / elapsed),
        "digest": servo.digest.hexdigest(),
    }


def _played(
    servo: Servo[R, M, F, C],
    scenario: Scenario,
    play: Play[R, M, F, C],
    realtime: bool,
    watch: Watch | None,
    over: Over | None,
) -> int:
    """Run the servo in lockstep until the scenario is over; return the ticks it took."""
    dt, begun = servo.robot.dt, time.monotonic()
    ticks = 0
    for slot in lockstep():
        if play.look() >= scenario.duration_s or slot.slot * dt > scenario.duration_s + play.arm_time:
            break
        if over is not None and over(play.truth, play.kept):
            break
        turn: Turn[F, C] = servo.turn(slot, play.request(servo.memory))
        play.add(turn)
        if watch is not None:
            watch(servo, play.truth, turn)
        ticks += 1
        if realtime:
            time.sleep(max(0.0, begun + ticks * dt - time.monotonic()))
    return ticks
