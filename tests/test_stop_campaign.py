"""The campaign of stops plays every fault with every kind of brakes on every arm, and its judge is not blind."""

import tomllib
from collections.abc import Callable
from itertools import islice

import numpy as np
import pytest

from rtctl.campaign.case import Asked
from rtctl.campaign.play import played
from rtctl.types import F64, Truth
from tests.lab import ROOT, robot
from tools.stop_campaign import ARMS, BRAKES, KINDS, case_of, source
from tools.stop_judge import Course, Run, judged

PLANAR = robot(ROOT / "configs" / "planar4.toml")
DT, N = 0.01, 40
Ways = Callable[[F64], F64]  # of the times (T,) [s]


def test_every_fault_is_played_on_every_arm_with_every_kind_of_brakes() -> None:
    whole = len(ARMS) * len(KINDS) * len(BRAKES)
    found = list(islice(source.cases(Asked((), range(1), whole, {})), whole + 1))
    assert len(found) == whole == len({(case.robot, case.set) for case in found})
    assert {case.set for case in found} == {f"{kind} {brakes}" for kind in KINDS for brakes in BRAKES}
    without = {case.config for case in found if case.set.endswith(" none")}
    assert len(without) == len(ARMS) + 1  # the OpenArm as its maker ships it, and with E2E frames
    for text in without:
        assert {joint["brake"] for joint in tomllib.loads(text)["robot"]["joints"]} == {False}


def truths(speeds: dict[int, Ways], at: float = 1.0) -> list[Truth]:
    """Return what is true of the level arm, whose joints have the speeds that are given."""
    out, t = [], np.arange(N) * DT
    qd = np.zeros((N, PLANAR.n))
    for j, speed in speeds.items():
        qd[:, j] = speed(t)
    q = PLANAR.home + np.vstack([np.zeros(PLANAR.n), np.cumsum(qd[1:] * DT, axis=0)])
    for k in range(N):
        tip = PLANAR.body.evaluate(q[k], np.zeros(PLANAR.n), PLANAR.points, PLANAR.own).x.copy()
        out.append(Truth(at + t[k], q[k], qd[k], np.zeros(PLANAR.n), tip, np.zeros(4), {}, 1.0, 0))
    return out


def judge(brakes: str, kind: str, speeds: dict[int, Ways], joint: int = 1, at: float = 1.0) -> Run:
    """Return the judgement of an arm that stops like this."""
    course = Course(at)
    course.rows += truths(speeds, at)
    return judged(PLANAR, course, None, (kind, joint, at), brakes)


def went_on(speeds: dict[int, Ways], without: dict[int, Ways], contacts: int = 0) -> Run:
    """Return the judgement of an arm that notices nothing and goes on like this; without: without the fault."""
    course, alone = Course(1.0), Course(1.0)
    course.going += truths(speeds)
    alone.going += truths(without)
    course.contacts = contacts
    return judged(PLANAR, course, alone, ("weak", 1, 1.0), "none")


def still(t: F64) -> F64:
    return np.zeros(len(t))


@pytest.mark.parametrize("brakes", BRAKES)
def test_an_arm_that_stays_breaks_nothing(brakes: str) -> None:
    assert judge(brakes, "drive_fault", {0: still}).broken == ()


def test_one_that_is_driven_on_is_seen() -> None:
    assert any("faster" in text for text in judge("ideal", "weak", {1: lambda t: 2.0 * t}).broken)
    assert any("held" in text for text in judge("none", "silent", {1: lambda t: 2.0 * t}).broken)
    assert any("held" in text for text in judge("none", "drive_fault", {2: lambda t: 2.0 * t}).broken)
    assert any("way" in text for text in judge("slipping", "weak", {0: lambda t: 0.2 + 0.0 * t}).broken)


def test_a_fault_that_nobody_notices_may_do_no_harm() -> None:
    """The same arm without the fault at the same time is the measure: it is on its way, too."""
    limit = float(PLANAR.qd_max[2])
    fast = {0: lambda t: 1.0 + 0.0 * t, 1: lambda t: 2.0 * t}
    assert went_on(fast, fast).broken == ()
    assert went_on(fast, fast).noticed is None
    assert any("faster" in text for text in went_on(*[{**fast, 2: lambda t: 1.1 * limit + 0.0 * t}] * 2).broken)
    assert any("way" in text for text in went_on({0: lambda t: 0.8 + 0.0 * t}, {0: fast[0]}).broken)
    assert any("contacts" in text for text in went_on(fast, fast, 1).broken)
    over = float((PLANAR.q_max - PLANAR.home)[1]) / (N * DT) * 1.2
    assert any("limit" in text for text in went_on({1: lambda t: over + 0.0 * t}, {}).broken)
    with pytest.raises(ValueError, match="compared"):
        judged(PLANAR, Course(1.0), None, ("weak", 1, 1.0), "none")


def test_a_joint_that_nothing_drives_may_go_on_on_a_level_arm_but_not_gather_speed() -> None:
    """Nothing pulls there: by itself it goes at the speed that it had, all others locked."""
    assert judge("none", "stuck_encoder", {1: lambda t: 0.5 + 0.0 * t}).falls == pytest.approx(0.2 / 0.25, abs=0.05)
    driven = judge("none", "stuck_encoder", {1: lambda t: 0.5 + 3.0 * t})
    assert any("free fall" in text for text in driven.broken)


def test_a_joint_that_is_held_may_not_pass_its_limit_and_one_that_falls_may() -> None:
    over = float((PLANAR.q_max - PLANAR.home)[1]) / (N * DT) * 1.2
    assert any("limit" in text for text in judge("none", "silent", {1: lambda t: over + 0.0 * t}).broken)
    assert not any("limit" in text for text in judge("none", "drive_fault", {1: lambda t: over + 0.0 * t}).broken)


ONCE_BROKEN = [  # arm, fault, brakes, seed, number, and what was beyond its bound
    ("planar4", "watchdog", "ideal", 0, 10),  # gives its last torque on, and threw the light joints while others faded
    ("openarm_e2e", "stuck_encoder", "ideal", 0, 44),  # the joint fell away, slowly at first, and past its limit
    ("planar4", "reboot", "ideal", 0, 55),  # what a closing brake's jerk was taken to last drove it on, 0.09 to 0.12 m
    ("puma560", "stuck_encoder", "none", 0, 161),  # held by what the encoder said; a surprise had not told whose it was
    ("puma560", "false_velocity", "none", 0, 166),  # held by a speed that was false by less than is asked elsewhere
    ("planar4", "drive_fault", "ideal", 0, 180),  # damped joint by joint, a stretched arm went on as a whole, 0.09 m
    ("openarm_e2e", "foreign", "none", 25, 244),  # a joint that a second master let fall was taken for held
    ("panda", "weak", "none", 25, 462),  # a torque that was not given made another joint's encoder look stuck: it fell
    ("ur5", "weak", "none", 25, 973),  # the same, 20 contacts
    ("ur5", "false_velocity", "none", 25, 728),  # what a false speed made the model expect of a wrist let that fall too
    ("panda", "stuck_encoder", "none", 25, 722),  # let go, a joint was driven by half a step of its drive's torque
    ("planar4", "encoder_jump", "none", 25, 985),  # damped by the drive's kd alone, a heavy joint went on for 2 s
    ("planar4", "dead_encoder", "ideal", 27, 0),  # all: taken for a contact, and held by what they said, at 14 rad/s
    ("planar4", "dead_encoder", "ideal", 27, 1),  # one: the same, 0.96 m
    ("planar4", "error_passive", "none", 25, 755),  # braked by a fault that clears by itself, and taken for astray
]


@pytest.mark.parametrize(("arm", "kind", "brakes", "seed", "number"), ONCE_BROKEN)
def test_what_once_broke_a_bound_keeps_it(arm: str, kind: str, brakes: str, seed: int, number: int) -> None:
    row = played(case_of(arm, kind, brakes, seed, number))
    assert (row["outcome"], row["failures"]) == ("stopped", "")
