"""The fault detectors one by one, from the evidence alone: the number that is a fault, and the one next to it.

test_faults.py asks what the arm does about them; here each bound of the published table is met from both sides.
"""

from typing import Any

import numpy as np
import pytest

from rtctl.arm import detection
from rtctl.arm.faults import (
    ASTRAY,
    AUTOMATIC,
    BIT,
    BRAKES,
    DISTRUST,
    FAULT_CODES,
    FAULTS,
    JUMP_WINDOW,
    REFUSES_ARMING,
    STOPS,
    TABLE,
    Bounds,
    Counters,
    Evidence,
    SafetyParams,
    counted,
    describe,
    detect,
    implausible_positions,
    names,
)
from rtctl.control.faults import GOOD_TICKS, Fault, FaultTable
from rtctl.types import Feedback, Link, Severity, State

DT = 1e-3
BOUNDS = Bounds(stale_periods=3, lost_periods=10, feed_timeout=0.5)
HEALTHY = Evidence(
    flags=0,
    age=DT,
    feed_age=0.0,
    missed=0,
    active=True,
    powered=True,
    implausible=False,
    slew_follows_echo=False,
    armed_outside=False,
    not_finite=False,
    has_goal=True,
    innovation=1.0,
)


def found(link: int = 0, counters: Counters = Counters(), **evidence: Any) -> set[str]:  # noqa: B008 - a frozen value
    """Return the faults that are present."""
    return set(names(detect(link, HEALTHY._replace(**evidence), counters, BOUNDS, DT)))


BY_EVIDENCE: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
    ("feedback_stale", {"age": 4 * DT}, {"age": 3 * DT}),
    ("feedback_lost", {"age": 11 * DT}, {"age": 10 * DT}),
    ("feedback_lost", {"flags": detection.UNHEARD}, {"flags": 0}),
    ("drive_fault", {"flags": detection.FAULT}, {"flags": detection.DISABLED}),
    ("encoder_stuck", {"flags": detection.STUCK}, {"flags": detection.STIRS}),
    ("velocity_mismatch", {"flags": detection.DISAGREE}, {"flags": detection.TORQUE}),
    ("innovation", {"flags": detection.UNEXPLAINED}, {"flags": detection.TOUCHED}),
    ("not_finite", {"flags": detection.NOT_FINITE}, {"flags": detection.BEYOND}),
    ("not_finite", {"not_finite": True}, {"not_finite": False}),
    ("deadline", {"missed": 10}, {"missed": 9}),
    ("deadline", {"missed": 10}, {"missed": 10, "powered": False}),
    ("goal_in_obstacle", {"flags": detection.GOAL_INSIDE}, {"flags": detection.GOAL_INSIDE, "has_goal": False}),
    ("goal_in_obstacle", {"flags": detection.GOAL_INSIDE}, {"flags": 0}),
    ("goal_stale", {"flags": detection.GOAL_OLD}, {"flags": detection.GOAL_OLD, "has_goal": False}),
    ("goal_stale", {"flags": detection.GOAL_OLD}, {"flags": 0}),
    ("contact", {"flags": detection.CONTACT}, {"flags": detection.CONTACT, "active": False}),
    ("contact", {"flags": detection.CONTACT}, {"flags": 0}),
    ("feed_stale", {"feed_age": 0.501}, {"feed_age": 0.5}),
    ("outside_limits", {"flags": detection.OUTSIDE}, {"flags": detection.OUTSIDE, "active": False}),
    ("outside_limits", {"flags": detection.OUTSIDE}, {"flags": detection.OUTSIDE, "armed_outside": True}),
    ("outside_limits", {"flags": detection.OUTSIDE}, {"flags": detection.BEYOND}),
    ("overspeed", {"flags": detection.FAST}, {"flags": detection.FAST, "active": False}),
    ("overspeed", {"flags": detection.FAST}, {"flags": 0}),
]
BY_COUNT: list[tuple[str, dict[str, int], dict[str, int]]] = [
    ("corrupt_frames", {"corrupt_window": 0b1000010001}, {"corrupt_window": 0b1000010000}),
    ("send_failed", {"send_failed": 2}, {"send_failed": 1}),
    ("drive_disabled", {"disabled": 5}, {"disabled": 4}),
    ("torque_mismatch", {"mismatch": 5}, {"mismatch": 4}),
    ("torque_mismatch", {"slew_follows_echo": 5}, {"slew_follows_echo": 4}),
    ("encoder_jump", {"jumps": 0b101}, {"jumps": 0b100}),
    ("deadline", {"missed": 3}, {"missed": 2}),
    ("innovation", {"innovation": 5}, {"innovation": 4}),
    ("error_passive_long", {"passive": 1000}, {"passive": 999}),
]
BY_FLAG = {
    Link.DUPLICATE: "duplicate_reply",
    Link.DISORDER: "disorder",
    Link.FOREIGN_COMMAND: "foreign_command",
    Link.OVERFLOW: "rx_overflow",
    Link.ERROR_PASSIVE: "error_passive",
    Link.BUS_OFF: "bus_off",
    Link.DOWN: "link_down",
    Link.LOG_DEGRADED: "log_degraded",
}


def test_a_healthy_tick_shows_no_fault():
    assert found() == set()


@pytest.mark.parametrize(("name", "there", "near"), BY_EVIDENCE)
def test_what_is_seen_is_a_fault_at_its_bound_and_not_before(name: str, there: dict[str, Any], near: dict[str, Any]):
    assert name in found(**there)
    assert name not in found(**near)
    assert found(**there) - {name} <= {"feedback_stale"}  # what is lost is stale as well


@pytest.mark.parametrize(("name", "there", "near"), BY_COUNT)
def test_what_is_counted_is_a_fault_at_its_bound_and_not_before(name: str, there: dict[str, int], near: dict[str, int]):
    assert found(counters=Counters(**there)) == {name}
    assert found(counters=Counters(**near)) == set()


@pytest.mark.parametrize("flag", [flag for flag in Link if flag])
def test_a_flag_of_the_link_is_its_fault_and_no_other(flag: Link):
    assert found(link=int(flag)) == ({BY_FLAG[flag]} if flag in BY_FLAG else set())


def test_slots_missed_are_no_fault_where_no_torque_flows():
    assert found(counters=Counters(missed=3), powered=False) == set()


# ---- counters

RUNS: list[tuple[str, dict[str, Any], dict[str, Any]]] = [  # counter, what adds to it, what ends it
    ("send_failed", {"link": int(Link.SEND_FAILED)}, {}),
    ("disabled", {"flags": detection.DISABLED}, {}),
    ("disabled", {"flags": detection.DISABLED}, {"flags": detection.DISABLED, "active": False}),
    ("mismatch", {"flags": detection.TORQUE}, {}),
    ("mismatch", {"flags": detection.TORQUE}, {"flags": detection.TORQUE, "active": False}),
    ("slew_follows_echo", {"slew_follows_echo": True}, {}),
    ("slew_follows_echo", {"slew_follows_echo": True}, {"slew_follows_echo": True, "active": False}),
    ("slew_follows_echo", {"slew_follows_echo": True}, {"slew_follows_echo": True, "link": int(Link.DERATED)}),
    ("missed", {"missed": 1}, {}),
    ("passive", {"link": int(Link.ERROR_PASSIVE)}, {}),
    ("innovation", {"innovation": 8.1}, {"innovation": 8.0}),
    ("innovation", {"innovation": np.nan}, {"innovation": np.nan, "active": False}),
]


def tick(counters: Counters, link: int = 0, **evidence: Any) -> Counters:
    """Return the counters after a tick."""
    return Counters(*counted(link, HEALTHY._replace(**evidence), counters, 8.0))


@pytest.mark.parametrize(("name", "adds", "ends"), RUNS)
def test_ticks_running_are_counted_and_one_without_begins_anew(name: str, adds: dict[str, Any], ends: dict[str, Any]):
    counters = Counters()
    for k in range(1, 4):
        counters = tick(counters, **adds)
        assert counters == Counters(**{name: k})
    assert tick(counters, **ends) == Counters()


@pytest.mark.parametrize(
    ("name", "adds", "window"),
    [("corrupt_window", {"link": int(Link.CORRUPT)}, 10), ("jumps", {"implausible": True}, 50)],
)
def test_what_comes_now_and_then_is_counted_within_a_window(name: str, adds: dict[str, Any], window: int):
    assert JUMP_WINDOW == 50
    counters = tick(Counters(), **adds)
    for k in range(window):
        assert getattr(counters, name) == 1 << k
        counters = tick(counters)
    assert counters == Counters()
    counters = tick(tick(counters, **adds), **adds)
    assert getattr(counters, name) == 0b11


def test_jumps_of_an_arm_that_is_not_driven_are_forgotten():
    assert tick(Counters(jumps=1), implausible=True, active=False) == Counters()


# ---- the table


def test_each_word_of_faults_has_the_rows_that_its_name_says():
    for fault in FAULTS:
        bit = BIT[fault.name]
        assert bool(AUTOMATIC & bit) == (fault.clear == "A")
        assert bool(STOPS & bit) == (fault.severity >= Severity.SS2 and fault.clear != "A")
        assert bool(BRAKES & bit) == (fault.severity >= Severity.SS2)
        assert bool(REFUSES_ARMING & bit) == (fault.name != "duplicate_reply")
        assert names(bit) == (fault.name,)
        assert TABLE.severity(bit) == fault.severity
        assert TABLE.stops(bit) == (Severity.NONE if fault.clear == "A" else fault.severity)


MOTION = "position speed"
# Row of the published catalogue, reaction, how it clears, and what it makes untrue.
CATALOGUE = f"""
feedback_stale     2  SS2 A
feedback_lost      2  SS1 R {MOTION} link
duplicate_reply    4  LOG A
disorder           5  SS2 R
corrupt_frames     6  SS2 R
foreign_command    8  SS1 L torque
rx_overflow        9  LOG A
error_passive     10  LOG A
bus_off           11  SS1 R link
send_failed       12  SS1 R link
link_down         13  SS1 R link
drive_fault       15  SS1 R
drive_disabled    17  SS1 R
torque_mismatch   18  SS1 R torque
encoder_stuck     19  SS1 R {MOTION}
encoder_jump      20  SS1 R {MOTION}
velocity_mismatch 21  SS1 R {MOTION}
not_finite        25  SS1 L {MOTION}
deadline          30  SS2 R
goal_in_obstacle  43  SS2 A
contact           44  SS2 R
feed_stale        45  SS2 A
outside_limits    50  SS1 R
overspeed         50  SS1 R
innovation        21  SS1 R {MOTION} torque
log_degraded      51  LOG A
collision         24  SS2 R
collision_hard    24  SS1 R
goal_stale        47  SS2 A
error_passive_long 10 SS2 A
"""


def test_every_row_is_that_of_the_catalogue():
    wanted = [line.split() for line in CATALOGUE.strip().splitlines()]
    assert [[f.name, str(f.row), f.severity.name, f.clear, *f.untrue] for f in FAULTS] == wanted


def test_what_the_measurements_no_longer_tell_and_what_goes_astray():
    rows = [line.split() for line in CATALOGUE.strip().splitlines()]
    distrusted = {row[0] for row in rows if {"position", "speed", "torque"} & set(row[4:])}
    assert set(names(DISTRUST)) == distrusted
    assert set(names(ASTRAY)) == distrusted | {"contact", "outside_limits"}


ROWS = (
    Fault("passes", 1, Severity.SS2, "A", "by itself"),
    Fault("stays", 2, Severity.SS1, "R", "until reset"),
    Fault("lasts", 3, Severity.STO, "L", "until restart"),
    Fault("told", 4, Severity.LOG, "A", "only told"),
)
SMALL = FaultTable.of(ROWS)


def test_an_automatic_fault_is_in_force_until_it_was_absent_for_its_ticks_and_the_others_for_good():
    good = np.full(4, 1 << 30)
    force, good = SMALL.latch(0b0111, 0, good)
    assert (force, good.tolist()[:3]) == (0b0111, [0, 0, 0])
    for k in range(1, GOOD_TICKS):
        force, good = SMALL.latch(0, force, good)
        assert (force, good[0]) == (0b0111, k)
    force, good = SMALL.latch(0, force, good)
    assert force == 0b0110
    for _ in range(3 * GOOD_TICKS):
        force, good = SMALL.latch(0, force, good)
    assert force == 0b0110


def test_one_tick_with_an_automatic_fault_begins_its_absence_anew():
    force, good = SMALL.latch(1, 0, np.zeros(4, np.int64))
    for _ in range(GOOD_TICKS - 1):
        force, good = SMALL.latch(0, force, good)
    force, good = SMALL.latch(1, force, good)
    for _ in range(GOOD_TICKS - 1):
        force, good = SMALL.latch(0, force, good)
    assert force == 1


def test_a_fault_that_was_never_there_is_not_in_force():
    assert SMALL.latch(0, 0, np.zeros(4, np.int64))[0] == 0


def test_a_reset_leaves_what_is_present_and_what_needs_a_restart():
    assert SMALL.cleared(0b0111, 0) == 0b0100
    assert SMALL.cleared(0b0111, 0b0010) == 0b0110
    assert SMALL.cleared(0b0010, 0b1111) == 0b0010


def test_the_worst_reaction_counts_and_automatic_faults_stop_nobody_for_good():
    assert SMALL.severity(0b1011) == Severity.SS1
    assert SMALL.severity(0b1001) == Severity.SS2
    assert SMALL.severity(0b0111) == Severity.STO
    assert SMALL.severity(0) == Severity.NONE
    assert SMALL.stops(0b1011) == Severity.SS1
    assert SMALL.stops(0b1001) == Severity.NONE


def test_faults_are_told_in_the_order_of_the_table():
    assert SMALL.names(0b1010) == ("stays", "told")
    assert SMALL.reasons(0b0110) == "stays (until reset); lasts (until restart)"
    assert SMALL.reasons(0) == ""
    assert SMALL.describe(0, State.RUN) == "RUN"
    told = SMALL.describe(0b0011, State.FAULT, {"stays": "!"})
    assert told == "FAULT: passes: by itself; stays: until reset!"


def feedback(drive: list[int]) -> Feedback:
    n = len(drive)
    zero = np.zeros(n)
    return Feedback(0, 0, zero, zero, zero, zero, np.ones(n, np.int64), np.array(drive), 0, 0.0, 0.0)


def test_a_drives_fault_is_told_with_joint_and_code():
    bit = BIT["drive_fault"]
    assert "(b: communication lost)" in describe(bit, feedback([1, 0xD, 0]), ("a", "b", "c"), State.RUN)
    assert "(a: 0x2, c: overload)" in describe(bit, feedback([2, 1, 0xE]), ("a", "b", "c"), State.RUN)
    assert "(cleared since)" in describe(bit, feedback([1, 1, 0]), ("a", "b", "c"), State.RUN)
    assert "a:" not in describe(BIT["bus_off"], feedback([0xD]), ("a",), State.RUN)
    assert FAULT_CODES == {
        0x8: "over-voltage",
        0x9: "under-voltage",
        0xA: "over-current",
        0xB: "MOS hot",
        0xC: "coil hot",
        0xD: "communication lost",
        0xE: "overload",
    }


# ---- how far a joint can have moved

AT = {"q": 0.0, "age": DT, "replies": 1, "q_previous": 0.0, "age_previous": DT, "qd_max": 2.0}


def implausible(elapsed: float = DT, **joint: float) -> bool:
    """Return what is said of one joint; another beside it stands still."""
    one = {**AT, **joint}
    both = {key: np.array([AT[key], one[key]]) for key in AT}
    replies = both.pop("replies").astype(np.int64)
    out = implausible_positions(
        both["q"], both["age"], replies, both["q_previous"], both["age_previous"], both["qd_max"], elapsed, DT
    )
    assert not out[0]
    return bool(out[1])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("elapsed", "age_previous", "age", "periods"),
    [(DT, DT, DT, 1), (3 * DT, DT, DT, 3), (DT, 3 * DT, DT, 3), (2 * DT, DT, 2 * DT, 1), (DT, DT, 5 * DT, 1)],
)
def test_a_position_is_implausible_beyond_one_and_a_half_of_what_the_speed_limit_allows(
    sign: float, elapsed: float, age_previous: float, age: float, periods: int
):
    """Between the two measurements lie the periods that passed, more for an old one before, fewer for one now."""
    reach = 1.5 * 2.0 * periods * DT + 0.002
    more = {"elapsed": elapsed, "age_previous": age_previous, "age": age}
    assert not implausible(q=0.5 + sign * reach * 0.999, q_previous=0.5, **more)
    assert implausible(q=0.5 + sign * reach * 1.001, q_previous=0.5, **more)


def test_a_joint_that_did_not_answer_or_tells_no_number_is_not_implausible():
    assert implausible(q=1.0, replies=1)
    assert implausible(q=1.0, replies=2)
    assert not implausible(q=1.0, replies=0)
    assert not implausible(q=np.nan)
    assert not implausible(q=np.inf)


def test_faults_that_clear_by_themselves_do_so_after_fifty_ticks_wherever_they_stand_in_the_table():
    """As docs/faults.md says; the bit of each decides, not that of its neighbour."""
    rules = "RALAR"
    table = FaultTable.of([Fault(str(i), i, Severity.SS2, rule, "") for i, rule in enumerate(rules)])
    everything = (1 << len(rules)) - 1
    in_force, good = table.latch(everything, 0, np.zeros(len(rules), np.int64))
    for _ in range(49):
        in_force, good = table.latch(0, in_force, good)
        assert in_force == everything
    in_force, good = table.latch(0, in_force, good)
    assert table.names(in_force) == tuple(str(i) for i, rule in enumerate(rules) if rule != "A")


def test_an_observed_obstacle_may_creep_at_a_tenth_of_a_metre_in_a_second():
    assert SafetyParams._field_defaults == {"creep": 0.1}


def test_a_description_without_a_drives_fault_is_that_of_the_table():
    nothing = feedback([0xE, 1])
    for name in ("contact", "overspeed"):
        assert describe(BIT[name], nothing, ("a", "b"), State.SAFE_STOP) == TABLE.describe(BIT[name], State.SAFE_STOP)
        assert describe(BIT[name], nothing, ("a", "b"), State.SAFE_STOP).startswith(f"SAFE_STOP: {name}: ")
    assert describe(0, nothing, ("a", "b"), State.RUN) == "RUN"


@pytest.mark.parametrize("active", [True, False])
@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (0, set()),
        (detection.TOUCHED, {"collision"}),
        (detection.STRUCK, {"collision_hard"}),
        (detection.TOUCHED | detection.STRUCK, {"collision_hard"}),
    ],
)
def test_what_touches_an_arm_that_is_driven_is_one_fault_of_the_two(flags: int, told: set[str], active: bool):
    assert found(flags=flags, active=active) == (told if active else set())
    beside = found(flags=flags | detection.FAULT, active=active)
    assert beside == {"drive_fault"} | (told if active else set())


def test_a_collision_is_told_with_its_link_where_it_is_known():
    nothing = feedback([1, 0xD])
    for name in ("collision", "collision_hard"):
        for link in ("", "link4"):
            told = describe(BIT[name], nothing, ("a", "b"), State.SAFE_STOP, link)
            assert told == TABLE.describe(BIT[name], State.SAFE_STOP) + (f" at {link}" if link else "")
