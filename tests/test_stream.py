"""Streams of goals with velocities: the plant's own tip against the circle that is driven, and a stream that ends."""

import math
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtctl import design as cfg
from rtctl.app import arm_log
from rtctl.app.adviser import Adviser
from rtctl.app.guide import Guide, seen_of
from rtctl.app.replay import replay
from rtctl.app.sim import simulate
from rtctl.arm import faults
from rtctl.arm.osc import approach_speed
from rtctl.arm.stream import SMOOTH, aim, changing
from rtctl.cli import main
from rtctl.cli.values import goal_messages
from rtctl.control.faults import GOOD_TICKS
from rtctl.errors import EXIT_USAGE, ConfigError, RequestError
from rtctl.hal.messages import Bounds, checked, decode, request_of
from rtctl.kernel.rotations import R_of, log3
from rtctl.log.read.run import read_run
from rtctl.log.record.requests import decode_request, encode_request
from rtctl.plain import Json
from rtctl.spec.goal import goal_contradiction
from rtctl.spec.read import convert
from rtctl.spec.scenario import GoalTable, goal_of
from rtctl.types import F64, GOAL_TIMEOUT, Goal, Request, State, Status, Task, Verb
from tests.lab import DOWN, PANDA, Run, Standing, goal, lab, play, recorded, robot, same

CENTRE, RADIUS, SPEED = np.array([0.5, 0.0, 0.4]), 0.05, 0.157  # [m], [m], [m/s]
RATE = SPEED / RADIUS  # [rad/s]
BEGIN, JUDGED = 1.5, 1.0  # [s] when a stream begins; of it that is not judged
WXYZ = DOWN.tolist()
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def circle(t: float) -> F64:
    """Where the circle is (3,) [m] `t` [s] after it began; it rests before."""
    a = RATE * max(t, 0.0)
    return CENTRE + RADIUS * np.array([math.cos(a), math.sin(a), 0.0])


def along(t: float) -> F64:
    """How fast it is then (3,) [m/s]."""
    return SPEED * np.array([-math.sin(RATE * t), math.cos(RATE * t), 0.0])


def stream(hz: float, seconds: float, fed: bool, late: float = 0.0, lost: float = 0.0) -> list[Json]:
    """The circle as goals of a scenario: each up to `late` [s] after its time, a share of them `lost`."""
    rng, goals = np.random.default_rng(3), [{"at_s": 0.0, "position_m": circle(0.0).tolist(), "wxyz": WXYZ}]
    for k in range(round(seconds * hz) + 1):
        t, at, gone = k / hz, BEGIN + k / hz + rng.uniform(0.0, late), rng.uniform() < lost
        velocity = {"velocity_m_s": along(t).tolist()} if fed else {}
        if not gone:
            at = max(at, goals[-1]["at_s"] + 0.002)
            goals.append({"at_s": at, "position_m": circle(t).tolist(), "wxyz": WXYZ, **velocity})
    return goals


@cache
def circled(hz: float, fed: bool, late: float = 0.0, lost: float = 0.0) -> Run:
    return play({"duration_s": BEGIN + 4.0, "goal": stream(hz, 4.0, fed, late, lost)})


def judged(run: Run) -> Run:
    return run.since(BEGIN + JUDGED)


def lag(run: Run) -> F64:
    """How far the plant's tip is from where the circle is at that time (T,) [m]."""
    out: F64 = np.linalg.norm(run.tip - np.array([circle(t - BEGIN) for t in run.t]), axis=1)
    return out


def jerk(run: Run, ticks: int = 1) -> F64:
    """How fast the acceleration of the plant's tip changes [m/s3], by differences of so many ticks.

    Of one tick most of it is what the encoders' steps do to an arm at rest, too: 95 m/s3, 210 at most.
    """
    x, h = run.tip, ticks
    third = x[3 * h :] - 3.0 * x[2 * h : -h] + 3.0 * x[h : -2 * h] - x[: -3 * h]
    out: F64 = np.linalg.norm(third, axis=1) / (h * robot().dt) ** 3
    return out


def rms(values: F64) -> float:
    return float(np.sqrt((values**2).mean()))


def no_rougher(run: Run, than: Run) -> bool:
    """Whether a run jerks no more than another does: all of it, and at its worst."""
    return rms(jerk(run)) <= rms(jerk(than)) and bool(jerk(run, 5).max() <= jerk(than, 5).max())


def speeds(run: Run) -> F64:
    out: F64 = np.linalg.norm(np.diff(run.tip, axis=0), axis=1) / robot().dt
    return out


def troubles(run: Run) -> list[str]:
    return [detail for _, name, detail in run.events if name in ("fault", "rejected")]


# ---- following


def test_the_velocity_takes_the_lag_from_26_mm_to_3_without_more_jerk():
    fed, bare = judged(circled(20.0, True)), judged(circled(20.0, False))
    assert 0.020 < lag(bare).mean() < 0.030  # as ever
    assert lag(fed).max() <= 0.003
    assert no_rougher(fed, bare)
    assert rms(jerk(fed, 5)) < 0.5 * rms(jerk(bare, 5))
    assert troubles(circled(20.0, True)) == []


def test_it_starts_without_more_jerk_either():
    whole = [circled(20.0, fed).since(BEGIN - 0.1) for fed in (True, False)]
    assert no_rougher(*whole)


@pytest.mark.parametrize("hz", [10.0, 50.0, 100.0])
def test_goals_that_come_late_or_not_at_all_do_not_jerk_it_more_than_without_velocities(hz: float):
    fed, bare = circled(hz, True, 0.01, 0.05), circled(hz, False, 0.01, 0.05)
    assert troubles(fed) == []
    assert lag(judged(fed)).max() <= 0.006
    assert no_rougher(judged(fed), judged(bare))


def test_while_it_goes_on_it_is_never_there_and_at_its_end_it_arrives():
    end = [{"at_s": BEGIN + 3.0, "position_m": circle(3.0).tolist(), "wxyz": WXYZ}]
    goals = [g for g in stream(20.0, 3.0, True) if g["at_s"] < BEGIN + 2.99]
    run = play({"duration_s": BEGIN + 4.5, "goal": goals + end})
    status, t = run.record["status"], run.t
    assert (status[(t > BEGIN + 0.01) & (t < BEGIN + 2.99)] == Status.MOVING).all()
    assert run.memory.status == Status.ARRIVED
    assert np.linalg.norm(run.tip[-1] - circle(3.0)) < 0.002
    assert troubles(run) == []
    told = run.figures["goals"]
    assert [g["arrived"] for g in told] == [True, *[None] * (len(told) - 2), True]
    assert max(g["error_m"] for g in told[30:-1]) < 0.003  # to where it had come
    assert run.figures["arrived"]


def test_the_tool_turns_with_a_goal_that_turns():
    rate, every = 0.8, 50  # [rad/s], [ticks]

    def turned(t: float) -> F64:
        return np.array([0.0, math.cos(0.5 * rate * t), math.sin(0.5 * rate * t), 0.0])

    def off(fed: bool) -> float:
        """The largest angle [rad] from the plant's tip to where the goal has turned."""
        found = []
        with lab() as here:
            here.running().ask(CENTRE, turned(0.0))
            here.run(2.0)
            for k in range(40):
                asked = goal(here.memory, CENTRE, turned(k * every * 1e-3))
                here.step(Request(goal=asked._replace(omega=np.array([0.0, 0.0, rate])) if fed else asked))
                for i in range(1, every):
                    here.step()
                    if k >= 20:
                        R = R_of(here.simulator.truth().tip_wxyz)
                        found.append(np.linalg.norm(log3(R.T @ R_of(turned((k * every + i) * 1e-3)))))
        return float(max(found))

    assert off(False) > 0.08
    assert off(True) < 0.015


def test_a_stream_that_asks_for_more_than_v_max_gets_v_max():
    away = [0.35, -0.35, 0.45]
    goals = [{"at_s": 0.0, "position_m": away, "wxyz": WXYZ}]
    for k in range(10):
        place = [0.35, -0.35 + 1.2 * 0.05 * k, 0.45]
        goals.append({"at_s": 2.0 + 0.05 * k, "position_m": place, "wxyz": WXYZ, "velocity_m_s": [0.0, 1.2, 0.0]})
    run = play({"duration_s": 2.9, "goal": goals})
    assert speeds(run).max() > 0.9 * robot().motion.v_max
    assert speeds(run).max() <= 1.01 * robot().motion.v_max


def test_a_stream_through_a_ball_does_not_take_the_arm_into_it():
    ball = {"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": [0.5, 0.0, 0.4]}
    goals = [{"at_s": 0.0, "position_m": [0.5, -0.25, 0.4], "wxyz": WXYZ}]
    for k in range(50):
        place = [0.5, -0.25 + 0.25 * 0.04 * k, 0.4]
        goals.append({"at_s": 2.0 + 0.04 * k, "position_m": place, "wxyz": WXYZ, "velocity_m_s": [0.0, 0.25, 0.0]})
    run = play({"duration_s": 4.5, "goal": goals, "obstacle": [ball]})
    assert run.figures["contacts"] == 0
    assert run.figures["min_clearance_m"]["ball"] >= robot().avoid.rho_min - 1e-3
    assert run.memory.state == State.RUN


def test_a_goal_that_jumps_is_followed_no_more_violently_than_one_without_a_velocity():
    def leapt(fed: bool) -> Run:
        goals = stream(20.0, 3.0, fed)
        for g in goals:
            if g["at_s"] > BEGIN + 1.5:
                g["position_m"] = [x + dx for x, dx in zip(g["position_m"], (0.0, 0.0, 0.15), strict=True)]
        return play({"duration_s": BEGIN + 3.0, "goal": goals})

    fed, bare = leapt(True), leapt(False)
    assert speeds(fed).max() <= 1.01 * robot().motion.v_max
    assert no_rougher(fed.since(BEGIN), bare.since(BEGIN))


# ---- a stream that ends


def test_a_stream_that_is_cut_off_stops_the_arm_and_the_next_goal_takes_it_up_again():
    cut = BEGIN + 2.0
    goals = [g for g in stream(20.0, 3.0, True) if g["at_s"] <= cut]
    back = {"at_s": cut + 1.5, "position_m": circle(0.0).tolist(), "wxyz": WXYZ}
    run = play({"duration_s": cut + 4.0, "goal": [*goals, back]})
    over = goals[-1]["at_s"] + GOAL_TIMEOUT
    v, t = speeds(run), run.t[1:]
    assert v[(t > over - 0.02) & (t < over)].min() > 0.8 * SPEED  # until then it went on
    assert v[(t > over + 0.15) & (t < back["at_s"])].max() < 0.01
    there = run.tip[(run.t > over) & (run.t < back["at_s"])]
    assert np.linalg.norm(there - there[0], axis=1).max() < 0.01
    held = run.record[(run.t > over + 0.01) & (run.t < back["at_s"])]
    assert (held["faults"] & faults.BIT["goal_stale"] != 0).all()
    assert (held["state"] == State.RUN).all()
    assert (held["status"] == Status.NO_GOAL).all()
    assert run.memory.status == Status.ARRIVED
    assert run.memory.in_force == 0
    assert troubles(run) == ["RUN: goal_stale: no goal of a stream came within the time-out of the last"]


@pytest.mark.parametrize("velocity", [None, [0.0, 0.1, 0.0]])
def test_the_age_of_a_goal_is_counted_in_ticks(velocity: list[float] | None):
    arm = Standing()
    asked = goal(arm.memory, [0.5, 0.1, 0.5])._replace(timeout=0.08)
    arm.tick(Request(goal=asked if velocity is None else asked._replace(velocity=np.array(velocity))))
    arm.ticks(80)
    assert "goal_stale" not in arm.present
    arm.tick()
    assert arm.present == {"goal_stale"}
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.1, 0.5])))
    arm.ticks(GOOD_TICKS - 1)
    assert arm.present == {"goal_stale"}
    arm.tick()
    assert arm.present == set()


def test_slots_that_were_missed_count():
    arm = Standing()
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.1, 0.5])._replace(velocity=np.array([0.0, 0.1, 0.0]), timeout=0.1)))
    at = arm.memory.goal
    assert at is not None
    arm.tick(missed=4)
    now = arm.memory.goal
    assert now is not None
    np.testing.assert_allclose(now.position - np.array([0.5, 0.1, 0.5]), [0.0, 5e-4, 0.0], atol=1e-12)
    arm.ticks(95)
    assert "goal_stale" not in arm.present
    arm.tick()
    assert "goal_stale" in arm.present


def test_between_goals_the_target_goes_on_and_not_beyond_its_time_out():
    arm = Standing()
    v, w = np.array([0.1, -0.2, 0.05]), np.array([0.0, 0.3, 0.4])
    arm.tick(Request(goal=Goal(np.array([0.5, 0.1, 0.5]), UPRIGHT, Task.POSE, 1e-3, 1e-2, velocity=v, omega=w)))
    for k in range(1, 400):
        arm.tick()
        found, t = arm.memory.goal, min(k * 1e-3, GOAL_TIMEOUT)
        assert found is not None
        np.testing.assert_allclose(found.position, np.array([0.5, 0.1, 0.5]) + v * t, atol=1e-9)
        np.testing.assert_allclose(log3(R_of(found.wxyz)), w * t, atol=1e-9)


def test_hold_ends_a_stale_stream():
    arm = Standing()
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.1, 0.5])._replace(timeout=0.05)))
    arm.ticks(100)
    assert "goal_stale" in arm.present
    assert arm.ask(Verb.HOLD) == ""
    arm.ticks(GOOD_TICKS)
    assert arm.present == set()
    assert arm.memory.goal is None


def test_a_goal_that_rests_and_was_reached_in_time_is_stale_no_more():
    arm = Standing()
    arm.tick(Request(goal=goal(arm.memory, arm.memory.tip.x)._replace(timeout=0.05)))
    arm.ticks(200)
    assert arm.memory.status == Status.ARRIVED
    assert arm.present == set()


# ---- log


def test_a_log_of_a_stream_is_replayed_to_the_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    goals = stream(50.0, 0.6, True, 0.01, 0.05)
    rows = "".join("[[goal]]\n" + "".join(f"{k} = {v!r}\n" for k, v in each.items()) for each in goals)
    recorded(tmp_path, f'robot = "{PANDA}"\nduration_s = 2.6\n{rows}')
    monkeypatch.setattr(arm_log, "rebuilt", lambda run: (cfg.load(PANDA), robot()))
    found = replay(read_run(tmp_path / "run.mcap"))
    assert found.identical, found
    assert found.ticks > 2500


def test_a_request_keeps_the_velocities_of_its_goal():
    asked = Goal(CENTRE, UPRIGHT, Task.POSE, 1e-3, 1e-2, velocity=along(0.3), omega=along(0.7), timeout=0.1 + 0.2)
    tick, back = decode_request(encode_request(7, Request(goal=asked)))
    assert tick == 7
    assert same(back.goal, asked)
    bare = asked._replace(velocity=None, omega=None, timeout=None)
    assert not {"velocity", "omega", "timeout"} & set(
        msgspec.json.decode(encode_request(7, Request(goal=bare)))["goal"]
    )


# ---- beside the servo


def test_nothing_is_looked_for_beside_a_stream(monkeypatch: pytest.MonkeyPatch):
    looked: list[str] = []
    monkeypatch.setattr(Guide, "_first", lambda self, m, goal: looked.append("first"))
    monkeypatch.setattr(Guide, "_held", lambda self, m, goal: looked.append("held"))
    arm, guide = Standing(), Guide(robot(), plans=True, at_once=True)
    for k in range(40):
        asked = goal(arm.memory, circle(0.01 * k), DOWN)._replace(velocity=along(0.01 * k))
        arm.tick(Request(goal=asked))
        guide.begin()
        for _ in range(9):
            arm.tick()
            assert guide.advise(seen_of(arm.memory)) is None
    assert looked == []
    arm.tick(Request(goal=goal(arm.memory, circle(0.4), DOWN)))  # its end is an ordinary goal
    guide.begin()
    guide.advise(seen_of(arm.memory))
    assert looked == ["first"]


def test_the_daemon_shows_its_guide_no_stream_and_of_plain_goals_that_follow_fast_the_last_alone():
    arm = Standing()
    adviser = Adviser(robot())
    try:
        shown: list[int] = []
        adviser._shown = lambda memory: bytes(shown.append(memory.tick) or 0)  # type: ignore[method-assign, func-returns-value]
        for asked in (goal(arm.memory, circle(0.0))._replace(velocity=along(0.0)), goal(arm.memory, circle(0.0))):
            for _ in range(20):  # fifty a second
                arm.tick(Request(goal=asked))
                adviser.begin()
                for _ in range(20):
                    adviser.advise(arm.memory)
                    arm.tick()
        assert shown == []
        last = arm.memory.tick - 20
        for _ in range(400):
            adviser.advise(arm.memory)
            arm.tick()
        assert shown
        assert 190 <= shown[0] - last <= 260
    finally:
        adviser.close()


# ---- what is said


def said(**keys: object) -> Goal:
    table = convert({"position_m": [0.4, 0.0, 0.5], **keys}, GoalTable, "goal")
    assert goal_contradiction(table) is None
    return goal_of(table, UPRIGHT, 1e-3, 1e-2)


def test_a_goal_that_moves_has_a_time_out_and_one_that_rests_none():
    assert said().timeout is None
    assert said(velocity_m_s=[0.1, 0.0, 0.0]).timeout == GOAL_TIMEOUT
    assert said(velocity_rad_s=[0.1, 0.0, 0.0], wxyz=[1, 0, 0, 0]).timeout == GOAL_TIMEOUT
    assert said(velocity_m_s=[0.1, 0.0, 0.0], timeout_ms=40).timeout == pytest.approx(0.04)
    assert said(timeout_ms=40).timeout == pytest.approx(0.04)
    ends = said(velocity_m_s=[0.0, 0.0, 0.0])
    assert (ends.velocity, ends.timeout, ends.streams) == (None, None, False)


@pytest.mark.parametrize(
    ("keys", "place"),
    [
        ({"velocity_m_s": [0.1, 0.0]}, "velocity_m_s"),
        ({"velocity_m_s": [0.1, 0.0, 11.0]}, "velocity_m_s"),
        ({"velocity_m_s": [0.1, 0.0, "x"]}, "velocity_m_s"),
        ({"velocity_rad_s": [0.1, 0.0, 99.0], "wxyz": [1.0, 0.0, 0.0, 0.0]}, "velocity_rad_s"),
        ({"velocity_rad_s": [0.1, 0.0, 0.0]}, "velocity_rad_s"),
        ({"velocity_rad_s": [0.1, 0.0, 0.0], "hold": "orientation"}, "velocity_rad_s"),
        ({"timeout_ms": 0}, "timeout_ms"),
        ({"timeout_ms": 1e6}, "timeout_ms"),
        ({"position_m": None, "wxyz": [1.0, 0.0, 0.0, 0.0], "velocity_m_s": [0.1, 0.0, 0.0]}, "velocity_m_s"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_place(keys: Json, place: str):
    message = {"verb": "goal", "position_m": [0.4, 0.0, 0.5], **keys}
    with pytest.raises(RequestError, match=rf"goal\.{place}.*wanted"):
        checked({k: v for k, v in message.items() if v is not None})


@pytest.mark.parametrize(
    "keys", [{"velocity_m_s": [0.1, 0.0, 0.0]}, {"timeout_ms": 100}, {"velocity_rad_s": [0.0, 0.0, 0.1]}]
)
def test_a_base_says_that_it_follows_no_stream(keys: Json):
    base = Bounds((0.0, 0.0, 0.0), 50.0, 0.1, 0.1, local=lambda a, b: None)
    message = decode(msgspec.json.encode({"verb": "goal", "position_m": [1.0, 0.0, 0.0], **keys}))
    with pytest.raises(RequestError, match=rf"goal\.{next(iter(keys))}: got .*, wanted a goal that rests"):
        request_of(message, base, lambda: UPRIGHT.tolist())


def test_a_scenario_of_a_base_is_refused_by_the_place(tmp_path: Path):
    scene = tmp_path / "scene.toml"
    scene.write_text(
        'robot = "rover"\nduration_s = 1.0\n[[goal]]\nat_s = 0.1\nposition_m = [1.0, 0.0, 0.0]\n'
        "velocity_m_s = [0.1, 0.0, 0.0]\n"
    )
    with pytest.raises(ConfigError, match=r"goal\[0\]\.velocity_m_s.*wanted a goal that rests"):
        simulate(scene)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"velocity": np.array([np.nan, 0.0, 0.0])}, "velocity"),
        ({"omega": np.array([np.inf, 0.0, 0.0])}, "velocity"),
        ({"velocity": np.array([0.0, 0.0, -101.0])}, "velocity"),
        ({"timeout": -1.0}, "time-out"),
        ({"timeout": math.inf}, "time-out"),
    ],
)
def test_the_tick_itself_takes_none_that_nothing_moves_like(bad: dict[str, Any], words: str):
    arm = Standing()
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.1, 0.5])._replace(**bad)))
    assert words in arm.memory.refusal
    assert arm.memory.goal is None


# ---- the forms


SIZES = st.floats(-2.0, 2.0, allow_subnormal=False)
WAYS = st.tuples(SIZES, SIZES, SIZES).map(np.array)


@given(WAYS, WAYS, st.floats(2.0, 12.0), st.floats(0.1, 1.0), st.floats(1.0, 8.0))
def test_the_point_aimed_at_is_approached_at_the_sum_of_both_velocities(
    e: F64, v: F64, k: float, v_max: float, a_max: float
):
    way = aim(e, v, k, v_max, a_max)
    d, found = float(np.linalg.norm(e)), float(np.linalg.norm(way))
    wanted = v + (e / d * approach_speed(d, k, v_max, a_max) if d > 1e-9 else 0.0)
    size = float(np.linalg.norm(wanted))
    assert approach_speed(found, k, v_max, a_max) == pytest.approx(min(size, v_max), abs=1e-9)
    if size > 1e-6:
        np.testing.assert_allclose(way / found, wanted / size, atol=1e-9)


def test_a_change_of_velocity_is_believed_within_its_time():
    a, v, t = np.zeros(3), np.zeros(3), 0.0
    true = np.array([0.4, -0.3, 0.0])
    for gap in [0.05, 0.02, 0.1, 0.05] * 8:
        a, v, t = changing(v, v + true * gap, a, gap, 5.0), v + true * gap, t + gap
    np.testing.assert_allclose(a, true, atol=0.02)
    assert t > 10.0 * SMOOTH
    assert np.linalg.norm(changing(np.zeros(3), np.array([9.0, 0.0, 0.0]), np.zeros(3), 0.01, 5.0)) <= 5.0 + 1e-12


# ---- the command line


def lines(text: str) -> list[Json]:
    return [message for _, message in goal_messages(text.splitlines(), "f")]


def test_a_file_of_goals_may_have_velocities():
    found = lines("x,y,z,vx,vy,vz,timeout_ms\n0.4,0,0.5,0.1,0,0,100\n")
    wanted = {"verb": "goal", "position_m": [0.4, 0, 0.5], "velocity_m_s": [0.1, 0, 0], "timeout_ms": 100}
    assert found == [wanted]
    assert lines('{"position_m": [0.4, 0, 0.5], "velocity_m_s": [0.1, 0, 0], "timeout_ms": 100}') == [wanted]


def test_a_file_of_goals_that_move_wants_a_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "g.csv"
    file.write_text("x,y,z,vx,vy,vz\n0.4,0,0.5,0.1,0,0\n")
    assert main(["goals", str(file)]) == EXIT_USAGE
    assert f"{file}:2: got a goal that moves, wanted --rate HZ" in capsys.readouterr().err
