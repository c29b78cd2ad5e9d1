"""`rtctl sim`: controller and virtual vehicle in one process, in lockstep, deterministic.

The controller is the daemon's own servo on the same bytes; only the bus is a function call. What is reported comes
from the simulator's account of the truth, which the controller never sees.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rtctl.app.choose import refuse_law, vehicle_of
from rtctl.app.live import Live
from rtctl.app.own_law import AnyLaw, OwnLawError, raised
from rtctl.app.servo import Servo
from rtctl.app.tally import number
from rtctl.app.vehicle import C, F, M, Play, R, Setup, Sink, Turn, Vehicle
from rtctl.errors import until_interrupted
from rtctl.hal.clock import lockstep
from rtctl.plain import Json
from rtctl.spec.scenario import Scenario, load_scenario, robot_file

Watch: TypeAlias = Callable[[Any, Any, Any], None]  # is shown servo, truth and turn of the vehicle after each period
RESTED = 0.1  # [s] at rest: then an arm whose law raised has been stopped
Over: TypeAlias = Callable[[Any, float], bool]  # truth, and how long [s] the last goal has been kept


def simulate(
    path: str | Path,
    log: str | Path | None = None,
    realtime: bool = False,
    watch: Watch | None = None,
    shown: Callable[[Path], None] | None = None,
    law: AnyLaw | None = None,
) -> Json:
    """Return the figures of a scenario file, played from its start to `duration_s`; write an MCAP log if asked.

    shown: people see it, in real time, and may command it; is told of the ring that viewers look into, and the scenario
    begins when it returns. When that is over the robot goes on, until a KeyboardInterrupt.

    law: a law of one's own for an arm, law(robot, memory, feedback) in each tick, before it:

        tau = law + what obstacles, the own links and joint limits push + h + g

    It gives (n,) [Nm], or None for this program's own law. `memory` is what the last tick left: memory.joints.q, .qd
    (n,), memory.tip.x (3,), memory.goal, memory.model.A (n, n), .J (6, n); `feedback` came from the drives just now.
    Nothing of it is trusted. It is given no more acceleration than this program's own motion has ([motion] a_max,
    alpha_max, and of joints what brakes them), and that within 20 ms. The guards hold its torque back where the arm
    could not stop in time before a limit, an obstacle or a link of its own, or where a joint or the tip would be faster
    than it may; magnitude and rate are limited. Gravity, what the arm carries and friction are given beside it. It acts
    in RUN alone: a stop, a fault that brakes and parking are this program's. Its torques are in the log, and a replay
    gives the same bits.

    Raises OwnLawError when the law raises; the arm has been stopped then.
    """
    scenario = load_scenario(path)
    return simulate_scenario(scenario, robot_file(scenario, path), Path(path), log, realtime, watch, shown, law)


def simulate_scenario(
    scenario: Scenario,
    where: Path,
    source: Path,
    log: str | Path | None = None,
    realtime: bool = False,
    watch: Watch | None = None,
    shown: Callable[[Path], None] | None = None,
    law: AnyLaw | None = None,
) -> Json:
    """Return the figures of a scenario for the robot file `where`; paths in it are relative to the file `source`.

    The rest as for `simulate`.
    """
    vehicle = vehicle_of(where)
    if law is not None:
        refuse_law(vehicle, where)
    setup = vehicle.load(where, None)
    play = setup.simulate(scenario, source)
    robot, link = play.robot, play.link
    with ExitStack() as stack:
        stack.callback(link.close)
        start = link.greet(True)
        sinks: list[Sink] = []
        live = None
        if log is not None:
            from rtctl.log.record.writer import McapSink

            file = McapSink(Path(log), setup.header(robot, start, link))
            stack.callback(file.close, "end")
            sinks.append(file)
        if shown is not None:
            live = stack.enter_context(
                closing(Live(setup.header(robot, start, link), where, Path(log) if log else None))
            )
            sinks.append(live)
        servo = Servo(vehicle, robot, link, _sink(sinks), start, stamp=lambda now: round(now * 1e9))
        if law is not None:
            servo.drive_by(law)
        if live is not None and shown is not None:
            live.serve(servo)
            shown(live.ring)
        begun, ticks = time.perf_counter(), _played(servo, scenario, play, realtime, watch, live)
        elapsed = time.perf_counter() - begun
        found = _figures(servo, play, ticks, elapsed)
        if live is not None:
            _linger(servo, play, live, ticks)
    return found


def simulate_setup(
    vehicle: Vehicle[R, M, F, C],
    setup: Setup[R, M, F, C],
    scenario: Scenario,
    source: Path,
    watch: Watch | None = None,
    over: Over | None = None,
) -> Json:
    """Return the figures of a scenario for a robot file already read; `over` ends the run before its time."""
    play = setup.simulate(scenario, source)
    with closing(play.link):
        servo = Servo(vehicle, play.robot, play.link, None, play.link.greet(True))
        begun, ticks = time.perf_counter(), _played(servo, scenario, play, False, watch, None, over)
        return _figures(servo, play, ticks, time.perf_counter() - begun)


def _figures(servo: Servo[R, M, F, C], play: Play[R, M, F, C], ticks: int, elapsed: float) -> Json:
    vehicle, robot = servo.vehicle, servo.robot
    return {
        **play.figures(servo.events),
        "mode_final": servo.memory.state.name,
        "faults": list(vehicle.names(servo.faults_seen)),
        "ticks": ticks,
        "missed": servo.missed,
        "realtime_factor": number(ticks * robot.dt / elapsed),
        "digest": servo.digest.hexdigest(),
    }


def _sink(sinks: list[Sink]) -> Sink | None:
    return Both(sinks) if len(sinks) > 1 else sinks[0] if sinks else None


class Both(NamedTuple):
    """Several sinks as one."""

    sinks: list[Sink]

    def put_many(self, kind: int, payloads: Sequence[bytes], time_ns: int) -> bool:
        """Put into all of them; return whether all took it."""
        took = [sink.put_many(kind, payloads, time_ns) for sink in self.sinks]
        return all(took)


def _played(
    servo: Servo[R, M, F, C],
    scenario: Scenario,
    play: Play[R, M, F, C],
    realtime: bool,
    watch: Watch | None,
    live: Live | None,
    over: Over | None = None,
) -> int:
    """Run the servo in lockstep until the scenario is over; return the ticks it took."""
    dt, begun = servo.robot.dt, time.monotonic()
    ticks = 0
    for slot in lockstep():
        if play.look() >= scenario.duration_s or slot.slot * dt > scenario.duration_s + play.arm_time:
            break
        if over is not None and over(play.truth, play.kept):
            break
        request = play.request(servo.memory)
        turn: Turn[F, C] = servo.turn(slot, request if live is None else live.asked(slot.slot, request))
        play.add(turn)
        if watch is not None:
            watch(servo, play.truth, turn)
        ticks += 1
        if servo.failure is not None and servo.memory.rest * dt >= RESTED:
            break
        if live is not None:
            live.answer(servo.memory.refusal)
        if realtime or live is not None:
            time.sleep(max(0.0, begun + ticks * dt - time.monotonic()))
    if servo.failure is not None:
        raise OwnLawError(f"the law raised {raised(servo.failure)}; the arm was stopped") from servo.failure
    return ticks


def _linger(servo: Servo[R, M, F, C], play: Play[R, M, F, C], live: Live, ticks: int) -> None:
    """Go on for those who look, without the scenario's goals, until a KeyboardInterrupt."""
    dt, begun = servo.robot.dt, time.monotonic()
    with until_interrupted():
        for slot in itertools.islice(lockstep(), ticks, None):
            play.look()
            servo.turn(slot, live.asked(slot.slot, play.request(servo.memory)))
            live.answer(servo.memory.refusal)
            time.sleep(max(0.0, begun + (slot.slot - ticks + 1) * dt - time.monotonic()))
