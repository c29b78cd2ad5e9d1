"""Every fault of the table, produced at the tick: what is seen, what the arm does, and who may clear it."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rtctl.arm.faults import BIT, FAULTS, TABLE, describe
from rtctl.arm.law import prepared
from rtctl.arm.robot import Robot
from rtctl.control.faults import GOOD_TICKS, Fault
from rtctl.types import Command, Drive, Link, ObstacleEdit, Request, Severity, State, Verb
from tests.arms import PANDA_HOME
from tests.lab import Standing as Arm
from tests.lab import goal, healthy, robot, sphere

TIP, BELOW = [0.307, 0.0, 0.487], [0.307, 0.0, 0.3]  # [m] about the tip at home, and free of it

# What the published catalogue demands, by name: reaction and clear rule.
DEMANDED = {
    "feedback_stale": (Severity.SS2, "A"),
    "feedback_lost": (Severity.SS1, "R"),
    "duplicate_reply": (Severity.LOG, "A"),
    "disorder": (Severity.SS2, "R"),
    "corrupt_frames": (Severity.SS2, "R"),
    "foreign_command": (Severity.SS1, "L"),
    "rx_overflow": (Severity.LOG, "A"),
    "error_passive": (Severity.LOG, "A"),
    "bus_off": (Severity.SS1, "R"),
    "send_failed": (Severity.SS1, "R"),
    "link_down": (Severity.SS1, "R"),
    "drive_fault": (Severity.SS1, "R"),
    "drive_disabled": (Severity.SS1, "R"),
    "torque_mismatch": (Severity.SS1, "R"),
    "encoder_stuck": (Severity.SS1, "R"),
    "encoder_jump": (Severity.SS1, "R"),
    "velocity_mismatch": (Severity.SS1, "R"),
    "not_finite": (Severity.SS1, "L"),
    "deadline": (Severity.SS2, "R"),
    "goal_in_obstacle": (Severity.SS2, "A"),
    "contact": (Severity.SS2, "R"),
    "feed_stale": (Severity.SS2, "A"),
    "outside_limits": (Severity.SS1, "R"),
    "overspeed": (Severity.SS1, "R"),
    "innovation": (Severity.SS1, "R"),
    "log_degraded": (Severity.LOG, "A"),
    "collision": (Severity.SS2, "R"),
    "collision_hard": (Severity.SS1, "R"),
    "goal_stale": (Severity.SS2, "A"),
    "error_passive_long": (Severity.SS2, "A"),
}


def joint(index: int, value: float, rest: float = 0.0) -> np.ndarray:
    out = np.full(7, rest)
    out[index] = value
    return out


def age_of(periods: int) -> dict[str, Any]:
    """Return what the link says of a joint that was silent for that many periods."""
    replies = np.ones(7, np.int64)
    replies[4] = 0
    return {"age": joint(4, periods * 1e-3, 1e-3), "replies": replies}


class Case(NamedTuple):
    """How a fault is produced: what is said of one slot after the other, and what just fails to be one."""

    slots: Callable[[Arm], list[dict[str, Any]]]
    nearly: Callable[[Arm], list[dict[str, Any]]] | None = None
    alone: bool = False  # the innovation, which would find it sooner and cut the torque, is not judged
    unsurprised: bool = False  # the same, and nothing else


def flag(which: Link, count: int = 1) -> Callable[[Arm], list[dict[str, Any]]]:
    return lambda arm: [{"link": int(which)}] * count


def said(*slots: dict[str, Any]) -> Callable[[Arm], list[dict[str, Any]]]:
    return lambda arm: list(slots)


def jumps(*offsets: float) -> Callable[[Arm], list[dict[str, Any]]]:
    return lambda arm: [{"q": arm.q + joint(1, offset)} for offset in offsets]


def drifts(step: float, count: int) -> Callable[[Arm], list[dict[str, Any]]]:
    """The position moves although the speed is said to be nought."""
    return lambda arm: [{"q": arm.q + joint(1, step * (k + 1))} for k in range(count)]


def seen(shape: Any, age: float = 0.0) -> dict[str, Any]:
    return {"request": Request(obstacles=(ObstacleEdit(shape.name, shape, age),))}


def off_torque(error: float, count: int) -> Callable[[Arm], list[dict[str, Any]]]:
    return lambda arm: [{"tau": arm.command.tau + joint(6, error)}] * count


def corrupt(*pattern: int) -> Callable[[Arm], list[dict[str, Any]]]:
    return lambda arm: [{"link": int(Link.CORRUPT)} if bad else {} for bad in pattern]


def beyond(excess: float) -> Callable[[Arm], list[dict[str, Any]]]:
    """A joint that is pushed over its limit at 1 rad/s; what the others must feel of it is not looked at."""

    def slots(arm: Arm) -> list[dict[str, Any]]:
        low = robot().q_min[3]
        slack = prepared(arm.robot._replace(safety=arm.robot.safety._replace(friction=np.full(7, np.inf))))
        arm.__init__(arm.memory.state, np.where(np.arange(7) == 3, low + 0.01, PANDA_HOME), slack)  # type: ignore[misc]
        steps = round((0.01 + excess) / 1e-3)
        return [{"q": arm.q - joint(3, 1e-3 * k), "qd": joint(3, -1.0)} for k in range(1, steps + 1)]

    return slots


def ball_on_goal(near: float) -> Callable[[Arm], list[dict[str, Any]]]:
    def slots(arm: Arm) -> list[dict[str, Any]]:
        there = [0.5, 0.3, 0.5]
        arm.tick(Request(goal=goal(arm.memory, there)))
        return [seen(sphere("ball", [there[0], there[1] + 0.1, there[2]], 0.1 + near))]

    return slots


def streamed(age: int) -> Callable[[Arm], list[dict[str, Any]]]:
    """A goal that holds for 100 ms, `age` ticks ago."""

    def slots(arm: Arm) -> list[dict[str, Any]]:
        arm.tick(Request(goal=goal(arm.memory, [0.5, 0.3, 0.5])._replace(timeout=0.1)))
        return [{}] * age

    return slots


def creeping(speed: float, pause: int, ticks: int) -> Callable[[Arm], list[dict[str, Any]]]:
    """A joint so slow [rad/s] that its encoder repeats itself for `pause` ticks between two steps."""
    return lambda arm: [
        {"q": arm.q + joint(2, 1e-3 * pause * speed * (k // pause)), "qd": joint(2, speed)} for k in range(ticks)
    ]


def disagrees(speed: float, said: float, ticks: int) -> Callable[[Arm], list[dict[str, Any]]]:
    """A joint's position moves at one speed [rad/s] and its drive says another."""
    return lambda arm: [{"q": arm.q + joint(2, 1e-3 * speed * (k + 1)), "qd": joint(2, said)} for k in range(ticks)]


def pushed(acceleration: float) -> Callable[[Arm], list[dict[str, Any]]]:
    """Something accelerates the second joint [rad/s2] of an arm that has held itself for a while, for 30 ms."""

    def slots(arm: Arm) -> list[dict[str, Any]]:
        times = 1e-3 * np.arange(1, 31)
        moves = [
            {"q": arm.q + joint(1, 0.5 * acceleration * t**2), "qd": joint(1, acceleration * t)} for t in times.tolist()
        ]
        return [*[{}] * 520, *moves]

    return slots


CASES = {
    "feedback_stale": Case(said(age_of(4)), said(age_of(3))),
    "feedback_lost": Case(said(age_of(11)), said(age_of(10))),
    "duplicate_reply": Case(flag(Link.DUPLICATE)),
    "disorder": Case(flag(Link.DISORDER), flag(Link.SEQUENCE)),
    "corrupt_frames": Case(corrupt(1, 0, 0, 0, 1, 0, 0, 0, 0, 1), corrupt(1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1)),
    "foreign_command": Case(flag(Link.FOREIGN_COMMAND)),
    "rx_overflow": Case(flag(Link.OVERFLOW)),
    "error_passive": Case(flag(Link.ERROR_PASSIVE)),
    "bus_off": Case(flag(Link.BUS_OFF)),
    "send_failed": Case(flag(Link.SEND_FAILED, 2), said({"link": int(Link.SEND_FAILED)}, {}, {"link": 2}, {})),
    "link_down": Case(flag(Link.DOWN)),
    "drive_fault": Case(said({"drive": np.array([1, 1, 0xC, 1, 1, 1, 1])})),
    "drive_disabled": Case(
        said(*[{"drive": np.array([1, 1, 0, 1, 1, 1, 1])}] * 5), said(*[{"drive": np.array([1, 1, 0, 1, 1, 1, 1])}] * 4)
    ),
    "torque_mismatch": Case(off_torque(3.0, 6), off_torque(0.5, 20)),
    "encoder_stuck": Case(said(*[{"qd": joint(2, 0.5)}] * 25), creeping(0.015, 25, 150), alone=True),
    "velocity_mismatch": Case(disagrees(0.3, 1.5, 40), said(*[{"qd": joint(2, 0.1)}] * 14), unsurprised=True),
    "encoder_jump": Case(jumps(0.3, 0.3), jumps(0.003, 0.0, 0.3, 0.0, 0.003, 0.0)),
    "not_finite": Case(said({"qd": joint(3, np.nan)})),
    "deadline": Case(said(*[{"missed": 1}] * 3), said({"missed": 1}, {"missed": 1}, {}, {"missed": 9})),
    "goal_in_obstacle": Case(ball_on_goal(0.02), ball_on_goal(-0.02)),
    "contact": Case(lambda arm: [seen(sphere("ball", TIP, 0.05)), {}], said(seen(sphere("ball", BELOW, 0.05)))),
    "feed_stale": Case(
        said(seen(sphere("ball", [0.0, 5.0, 0.0], 0.1, (0.1, 0.0, 0.0)), 0.49), *[{}] * 12),
        said(seen(sphere("ball", [0.0, 5.0, 0.0], 0.1, (0.1, 0.0, 0.0)), 0.49), *[{}] * 9),
    ),
    "outside_limits": Case(beyond(0.03), beyond(0.01), alone=True),
    "overspeed": Case(said({"qd": joint(0, 2.175 * 1.25)}), said({"qd": joint(0, 2.175 * 1.15)})),
    "innovation": Case(drifts(0.003, 30), jumps(*[2e-4, -2e-4] * 20)),
    "log_degraded": Case(flag(Link.LOG_DEGRADED)),
    "collision": Case(pushed(15.0), pushed(3.0), alone=True),
    "collision_hard": Case(pushed(40.0), alone=True),
    "goal_stale": Case(streamed(101), streamed(100)),
    "error_passive_long": Case(
        said(*[{"link": int(Link.ERROR_PASSIVE)}] * 1000), said(*[{"link": int(Link.ERROR_PASSIVE)}] * 999)
    ),
}


@cache
def unjudged() -> Robot:
    """Return the robot without a bound on what measurement and estimate may differ by, and easily touched."""
    arm = robot()
    loose = arm.safety._replace(innovation_max=np.inf, velocity_tolerance=np.full(arm.n, np.inf))
    touchy, struck = 0.02 * arm.tau_rated, 0.2 * arm.tau_rated
    return prepared(arm._replace(safety=loose, collision=touchy, collision_hard=struck))


def produced(name: str, arm: Arm) -> bool:
    """Produce a fault; return whether it was in force at the end."""
    if CASES[name].alone:
        arm.__init__(arm.memory.state, arm=unjudged())  # type: ignore[misc]
    if CASES[name].unsurprised:  # the filters are faster, and then the torque is gone within 4 ms
        loose = robot().safety._replace(innovation_max=np.inf)
        arm.__init__(arm.memory.state, arm=prepared(robot()._replace(safety=loose)))  # type: ignore[misc]
    for slot in CASES[name].slots(arm):
        arm.tick(**slot)
    return name in arm.present


@pytest.fixture(params=sorted(CASES))
def name(request: pytest.FixtureRequest) -> Any:
    """Each fault in turn."""
    return request.param


def test_the_table_is_the_published_one():
    assert {f.name: (f.severity, f.clear) for f in FAULTS} == DEMANDED
    assert [BIT[f.name] for f in FAULTS] == [1 << i for i in range(len(FAULTS))]
    assert [BIT[f.name] for f in FAULTS] == [1 << i for i in range(len(FAULTS))]


def test_every_fault_of_the_table_is_named_by_a_test():
    here = Path(__file__).parent
    text = "".join(p.read_text() for p in sorted(here.rglob("test_*.py")))
    assert [f.name for f in FAULTS if f'"{f.name}"' not in text] == []
    assert set(CASES) == {f.name for f in FAULTS}


def test_each_fault_is_seen(name: str):
    assert produced(name, Arm())


@pytest.mark.parametrize("close", [n for n, case in CASES.items() if case.nearly])
def test_what_is_not_quite_a_fault_is_none(close: str):
    arm = Arm()
    nearly = CASES[close].nearly
    assert nearly is not None
    for slot in nearly(arm):
        arm.tick(**slot)
        assert close not in arm.present
    if close != "outside_limits":  # an arm that stays put there whatever is done has other faults
        assert arm.state() == State.RUN


def test_the_reaction_is_the_one_demanded(name: str):
    arm = Arm()
    produced(name, arm)
    severity, clear = DEMANDED[name]
    memory = arm.memory
    if severity >= Severity.SS2 and clear != "A":
        assert memory.state == State.SAFE_STOP
        assert memory.reaction >= severity
    elif "feedback_lost" not in arm.present:
        assert memory.state == State.RUN


def test_nothing_brings_motion_back_but_an_operator(name: str):
    arm = Arm()
    produced(name, arm)
    arm.ticks(3 * GOOD_TICKS)
    if DEMANDED[name][1] == "A":
        lasts = name in ("feed_stale", "goal_in_obstacle", "goal_stale")  # nobody looked again, took it away, sent one
        assert (name in arm.present) == lasts
        assert arm.state() == State.RUN
        return
    assert name in arm.present
    assert arm.state() == State.SAFE_STOP
    assert arm.ask(Verb.ARM) == "arm: not possible in state SAFE_STOP"
    assert arm.state() == State.SAFE_STOP


def test_an_automatic_fault_clears_after_its_good_ticks_and_not_before(name: str):
    if DEMANDED[name][1] != "A" or name == "feed_stale":  # that one clears when the obstacle is seen again: below
        return
    arm = Arm()
    produced(name, arm)
    if name == "goal_in_obstacle":
        arm.tick(Request(obstacles=(ObstacleEdit("ball", None),)))
        arm.ticks(GOOD_TICKS - 2)
    elif name == "goal_stale":
        arm.tick(Request(goal=goal(arm.memory, [0.5, 0.3, 0.5])))
        arm.ticks(GOOD_TICKS - 1)
    else:
        arm.ticks(GOOD_TICKS - 1)
    assert name in arm.present
    arm.tick()
    assert name not in arm.present


def test_a_latched_stop_is_left_through_reset_to_rest_and_idle(name: str):
    severity, clear = DEMANDED[name]
    if clear != "R" or severity < Severity.SS2:
        return
    arm = Arm()
    produced(name, arm)
    if name == "contact":
        arm.tick(Request(obstacles=(ObstacleEdit("ball", None),)))
    arm.ticks(200)
    assert arm.ask(Verb.RESET) == ""
    assert arm.present == set()
    assert arm.state() == State.STOPPING
    arm.ticks(250)
    assert arm.state() == State.IDLE
    assert arm.ask(Verb.ARM) == ""
    assert arm.state() == State.ARMED


@pytest.mark.parametrize("lasting", ["foreign_command", "not_finite"])
def test_some_faults_want_a_restart_of_the_program(lasting: str):
    assert DEMANDED[lasting][1] == "L"
    arm = Arm()
    produced(lasting, arm)
    arm.ticks(20)
    assert TABLE.by_name[lasting].text in arm.ask(Verb.RESET)
    assert arm.state() == State.SAFE_STOP
    assert lasting in arm.present


def test_a_fault_that_is_still_there_is_not_reset():
    arm = Arm()
    produced("bus_off", arm)
    down: dict[str, Any] = {"link": int(Link.BUS_OFF)}
    arm.ticks(10, **down)
    assert "bus-off" in arm.ask(Verb.RESET, **down)
    assert arm.state() == State.SAFE_STOP
    assert arm.ask(Verb.RESET) == ""


def test_every_fault_that_is_there_refuses_arming_but_a_doubled_reply(name: str):
    arm = Arm(State.IDLE)
    arm.command = Command(Drive.DISABLE, np.zeros(7))
    slot: dict[str, Any] = {"link": int(Link.LOG_DEGRADED)}
    produced(name, arm)
    arm.memory = arm.memory._replace(in_force=BIT[name], good=np.zeros(len(FAULTS), np.int64), state=State.IDLE)
    verdict = arm.ask(Verb.ARM, **(slot if name == "log_degraded" else {}))
    if name == "duplicate_reply":
        assert verdict == ""
        assert arm.state() == State.ARMED
    else:
        assert TABLE.by_name[name].text in verdict
        assert arm.state() == State.IDLE


def test_faults_of_a_driven_arm_are_none_of_one_at_rest():
    arm = Arm(State.IDLE)
    arm.command = Command(Drive.DISABLE, np.zeros(7))
    arm.ticks(10, tau=np.full(7, 20.0))  # somebody tries the brakes
    arm.ticks(10, drive=np.zeros(7, np.int64))
    assert arm.present == set()


# ---- reactions


def test_stale_feedback_brakes_and_holds_and_the_goal_goes_on_when_it_comes_back():
    arm = Arm()
    arm.tick(Request(goal=goal(arm.memory, [0.45, 0.2, 0.5])))
    arm.ticks(30)
    assert np.linalg.norm(arm.memory.v_ref) > 0.05
    for _ in range(40):
        arm.tick(**age_of(4))
    assert arm.present == {"feedback_stale"}
    assert np.linalg.norm(arm.memory.v_ref) < 1e-3
    assert arm.state() == State.RUN
    arm.ticks(GOOD_TICKS + 5)
    assert arm.memory.goal is not None
    assert np.linalg.norm(arm.memory.v_ref) > 0.0


def test_a_damped_stop_cuts_torque_at_rest_and_never_gives_it_back():
    arm = Arm()
    arm.tick(link=int(Link.BUS_OFF))
    assert (arm.state(), arm.memory.reaction) == (State.SAFE_STOP, Severity.SS1)
    assert arm.drive() == Drive.TORQUE  # held while it comes to rest
    arm.ticks(120)
    assert arm.drive() == Drive.DISABLE
    assert not arm.command.tau.any()
    arm.ticks(300, qd=np.full(7, 0.5))
    assert arm.drive() == Drive.DISABLE


def test_a_damped_stop_of_an_arm_that_does_not_rest_cuts_torque_after_its_time():
    arm, speed = Arm(arm=unjudged()), np.full(7, 0.2)
    arm.tick(link=int(Link.DOWN), qd=speed)
    ticks = round(robot().stop.time / robot().dt)
    for k in range(ticks):
        assert arm.drive() == Drive.TORQUE, k
        arm.q = arm.q + speed * robot().dt
        arm.tick(qd=speed)
    assert arm.drive() == Drive.DISABLE


def test_a_controlled_stop_holds_for_as_long_as_nobody_resets_it():
    arm = Arm()
    produced("deadline", arm)
    assert (arm.state(), arm.memory.reaction) == (State.SAFE_STOP, Severity.SS2)
    arm.ticks(1500)
    assert arm.drive() == Drive.TORQUE
    np.testing.assert_allclose(arm.command.tau, arm.memory.model.g, atol=0.2)


def test_a_worse_fault_makes_a_controlled_stop_a_damped_one_and_not_the_other_way_round():
    arm = Arm()
    produced("deadline", arm)
    arm.tick(link=int(Link.BUS_OFF))
    assert arm.memory.reaction == Severity.SS1
    arm.tick(missed=10)
    assert arm.memory.reaction == Severity.SS1


def test_a_number_that_is_none_never_becomes_torque():
    for field in ("q", "qd", "tau"):
        for bad in (np.nan, np.inf, -np.inf):
            arm = Arm()
            for k in range(7):
                arm.tick(**dict[str, Any]({field: joint(k, bad)}))
                assert np.isfinite(arm.command.tau).all(), (field, bad)
                assert (np.abs(arm.command.tau) <= robot().tau_max).all()
            arm.ticks(3)
            assert "not_finite" in arm.present
            assert arm.state() == State.SAFE_STOP


def test_a_drive_that_was_never_heard_counts_as_lost():
    arm = Arm(State.IDLE)
    arm.tick(drive=joint(2, -1, 1).astype(np.int64))
    assert "feedback_lost" in arm.present


def test_a_drives_fault_is_cleared_on_reset_and_only_then():
    arm = Arm()
    hot: dict[str, Any] = {"drive": np.array([1, 1, 0xC, 1, 1, 1, 1])}
    arm.ticks(300, **hot)
    assert arm.drive() == Drive.DISABLE
    assert "reset again" in arm.ask(Verb.RESET, **hot)
    assert arm.drive() == Drive.CLEAR
    arm.ticks(150, **hot)
    assert arm.drive() == Drive.DISABLE  # the cause lasts
    assert arm.ask(Verb.RESET) == ""


def test_a_moving_obstacle_that_is_seen_again_is_stale_no_more():
    arm = Arm()
    produced("feed_stale", arm)
    moving = sphere("ball", [0.0, 5.0, 0.0], 0.1, (0.1, 0.0, 0.0))
    for _ in range(GOOD_TICKS + 1):
        arm.tick(Request(obstacles=(ObstacleEdit("ball", moving),)))
    assert arm.present == set()
    assert arm.state() == State.RUN


def test_a_description_names_fault_joint_and_code():
    feedback = healthy(PANDA_HOME, 0, drive=np.array([1, 0xD, 1, 1, 1, 1, 1]))
    line = describe(BIT["drive_fault"] | BIT["bus_off"], feedback, robot().joints, State.SAFE_STOP)
    assert line.startswith("SAFE_STOP: bus_off: the controller went bus-off; drive_fault: ")
    assert "panda_joint2: communication lost" in line
    assert "\n" not in line
    assert describe(0, feedback, robot().joints, State.RUN) == "RUN"


@pytest.mark.parametrize("each", FAULTS, ids=lambda f: f.name)
def test_latching_keeps_what_an_operator_must_clear(each: Fault):
    bit = BIT[each.name]
    in_force, good = TABLE.latch(bit, 0, np.full(len(FAULTS), 1 << 30))
    assert in_force == bit
    for _ in range(GOOD_TICKS - 1):
        in_force, good = TABLE.latch(0, in_force, good)
        assert in_force == bit
    in_force, good = TABLE.latch(0, in_force, good)
    assert in_force == (0 if each.clear == "A" else bit)
    assert TABLE.cleared(bit, 0) == (bit if each.clear == "L" else 0)
    assert TABLE.cleared(bit, bit) == bit
