"""The drives' own loops against a plant of two links in closed form, and each rule of theirs by itself.

All of it is run by the interpreter, on a small record: the constants of a real arm take a minute to derive there.
"""

import inspect
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from rtctl.arm import own_loop as module
from rtctl.arm.encoders import BEYOND, DISAGREE_TICKS, EQUAL, RESIDUAL, TRAVEL
from rtctl.arm.faults import BIT
from rtctl.arm.hot import fresh, record_of
from rtctl.arm.model import Model
from rtctl.arm.sensing import Surroundings
from rtctl.types import F64, Feedback, RecordRow, Severity, State
from rtctl.world.primitives import obstacles_empty
from rtctl.world.rooms import OWN_CLEARANCE, OWN_INFLUENCE
from tests.lab import healthy

DT, GRAVITY, N = 2e-3, 9.81, 2
M, L = np.array([1.0, 0.8]), np.array([0.4, 0.3])  # [kg] at the ends of links of [m]
BRAKING, LOWERING, SINKING = 1, 2, 3
STEPS = 4  # of the plant and of the drives' loops, in a period
SPACE = np.zeros((6, N))


@pytest.fixture(autouse=True)
def _plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the module's kernels be what they are written as: compiled ones are of one layout of constants."""
    for name, value in vars(module).items():
        if hasattr(value, "py_func"):
            monkeypatch.setattr(module, name, value.py_func)


def constants(**changes: float | F64) -> RecordRow:
    """Return the constants of an arm of two joints without brakes."""
    values: dict[str, float | F64] = {
        "brakeless": 1.0,
        "dt": DT,
        "stop_kp": np.array([60.0, 40.0]),
        "stop_kd": np.array([1.0, 0.5]),
        "stop_damping": np.array([0.4, 0.2]),
        "stop_decay": 10.0,
        "braking": np.array([15.0, 20.0]),
        "q_min": np.array([-2.5, -2.5]),
        "q_max": np.array([2.5, 2.5]),
        "tau_max": np.array([30.0, 15.0]),
        "tau_rate": np.array([1000.0, 800.0]),
        "viscous": np.array([0.3, 0.2]),
        "safety_lost_periods": 10.0,
        "safety_torque_tolerance": np.array([3.0, 1.5]),
        "tau_lsb": np.array([0.04, 0.02]),
        "joint_r_qd": np.array([0.005, 0.005]),
        "avoid_rho_min": 0.015,
        **changes,
    }
    row = np.zeros(1, np.dtype((np.record, [(k, np.float64, np.shape(v)) for k, v in values.items()])))
    for name, value in values.items():
        row[name][0] = value
    return row[0]


def memory(q: F64, qd: F64, torque: F64) -> RecordRow:
    """Return the memory of an arm that is stopped at q (n,) [rad], qd [rad/s], the torque (n,) [Nm] sent last."""
    m = record_of(fresh())[0]
    m.state, m.reaction, m.tick = int(State.SAFE_STOP), int(Severity.SS1), 100
    m.q[:N], m.qd[:N], m.sent[0, :N] = q, qd, torque
    return m


def model_of(q: F64, qd: F64) -> Model:
    """Return the model of two point masses in an upright plane; q [rad] from hanging down, as any textbook has it."""
    (m1, m2), (l1, l2), both = M, L, q[0] + q[1]
    c2, s2 = np.cos(q[1]), np.sin(q[1])
    A = np.array(
        [
            [(m1 + m2) * l1**2 + m2 * l2**2 + 2.0 * m2 * l1 * l2 * c2, m2 * l2**2 + m2 * l1 * l2 * c2],
            [m2 * l2**2 + m2 * l1 * l2 * c2, m2 * l2**2],
        ]
    )
    h = m2 * l1 * l2 * s2 * np.array([-(2.0 * qd[0] * qd[1] + qd[1] ** 2), qd[0] ** 2])
    outer = m2 * GRAVITY * l2 * np.sin(both)
    g = np.array([(m1 + m2) * GRAVITY * l1 * np.sin(q[0]) + outer, outer])
    elbow = np.array([[l1 * np.cos(q[0]), 0.0], [0.0, 0.0], [l1 * np.sin(q[0]), 0.0]])
    tip = elbow + l2 * np.array([[np.cos(both)] * 2, [0.0, 0.0], [np.sin(both)] * 2])
    return made(A, h, g, np.vstack((tip, np.zeros((3, N)))), np.array([elbow, tip]), q, qd)


def made(A: F64, h: F64, g: F64, J: F64, Jp: F64, q: F64, qd: F64) -> Model:
    """Return a model of what the loops read; the rest is nothing."""
    zero, n = np.zeros(3), len(g)
    blank = (np.zeros((1, 3, 3)), np.zeros((6, 6)), np.zeros(0), np.zeros((0, n)))
    return Model(q, qd, A, np.linalg.inv(A), h, g, zero, np.eye(3), J, np.zeros(6), np.zeros((1, 3)), Jp, *blank)


def around(rho: tuple[float, ...] = (), **rooms: float) -> Surroundings:
    """Return obstacles that are so near [m]; rooms: of the first one."""
    k = len(rho)
    obstacles = obstacles_empty(k)
    if rooms:
        obstacles.room[0, OWN_INFLUENCE], obstacles.room[0, OWN_CLEARANCE] = rooms["influence"], rooms["clearance"]
    return Surroundings(obstacles, np.zeros(k, np.bool_), np.zeros(k), np.array(rho), np.zeros(k), 0.0, 0.5)


class Course(NamedTuple):
    """What became of the arm, a row a period."""

    q: F64  # (T, n) true
    qd: F64
    p: F64  # (T, n) asked for
    phase: F64  # (T,)
    memory: RecordRow

    @property
    def tip(self) -> F64:
        """Return the speed (T-1,) [m/s] of the tip."""
        x = np.array(
            [
                [L[0] * np.sin(q[0]) + L[1] * np.sin(q.sum()), L[0] * np.cos(q[0]) + L[1] * np.cos(q.sum())]
                for q in self.q
            ]
        )
        return np.asarray(np.linalg.norm(np.diff(x, axis=0), axis=1) / DT)


def play(
    c: RecordRow, q: F64, qd: F64, seconds: float, spoil: Callable[[Feedback, int], Feedback] = lambda f, k: f
) -> Course:
    """Return the course of a stop: the drives close their loops STEPS times a period, each on its own encoder."""
    q, qd = q.copy(), qd.copy()
    m, rows = memory(q, qd, model_of(q, qd).g), []
    tau = m.sent[0, :N].copy()
    for k in range(round(seconds / DT)):
        m.tick += 1
        m.q[:N], m.qd[:N] = q, qd
        model = model_of(q, qd)
        f = spoil(healthy(q, k, DT, qd=qd.copy()), k)
        module.own_loop(c, m, f, model, around(), model.g)
        rows.append((q.copy(), qd.copy(), m.own_p[:N].copy(), m.own_phase))
        for _ in range(STEPS):
            tau = m.own_kp[:N] * (m.own_p[:N] - q) + m.own_kd[:N] * (m.own_v[:N] - qd) + m.own_t[:N]
            tau = np.where(f.drive == 1, np.clip(tau, -c.tau_max, c.tau_max), 0.0)
            now = model_of(q, qd)
            qd += DT / STEPS * now.A_inv @ (tau - now.h - now.g - c.viscous * qd)
            q += DT / STEPS * qd
        m.rest = m.rest + 1 if np.abs(qd).max() < 0.03 else 0
        if m.off:
            break
    q_all, qd_all, p_all, phase = (np.array(column) for column in zip(*rows, strict=True))
    return Course(q_all, qd_all, p_all, phase, m)


# ---- the whole of it, judged by the plant


def test_a_moving_arm_comes_to_rest_as_the_model_says_although_the_drives_are_soft() -> None:
    """What the model knows is given beforehand, so that it goes as it is asked to: soft springs have nothing to do."""
    c = constants(stop_kp=np.full(2, 2.0), stop_kd=np.full(2, 0.05), stop_damping=np.zeros(2))
    found = play(c, np.array([1.1, 0.7]), np.array([1.5, -2.0]), 0.95)
    assert (found.phase == BRAKING).all()
    assert np.abs(found.q - found.p).max() < 0.01  # 0.0045 seen
    assert np.abs(found.qd[-1]).max() < 0.02
    speed = np.abs(found.qd)
    assert (speed[1:] <= np.maximum(speed[:-1], 0.03) + 0.01).all()  # no joint is thrown back
    for i in range(N):  # v decays at the rate of a stop, from no more than the joint's braking
        t = DT * np.arange(len(speed))
        v, fastest = speed[0, i], []
        for _ in t:
            fastest.append(v)
            v -= DT * min(10.0 * v, c.braking[i])
        np.testing.assert_allclose(speed[:, i], fastest, atol=0.06)


@pytest.mark.parametrize("joint", [0, 1])
def test_what_cannot_be_held_falls_and_does_not_pull_the_other_along(joint: int) -> None:
    def tripped(f: Feedback, k: int) -> Feedback:
        return f._replace(drive=np.where(np.arange(N) == joint, 2, 1))

    c = constants(stop_kp=np.full(2, 20.0), stop_kd=np.full(2, 0.3), stop_damping=np.full(2, 0.05))
    found = play(c, np.array([1.1, 0.7]), np.zeros(2), 0.3, tripped)
    assert np.abs(found.q[-1, joint] - found.q[0, joint]) > 0.3
    assert np.abs(found.q[:, 1 - joint] - found.q[0, 1 - joint]).max() < 0.02
    assert found.memory.lost == 1 << joint
    assert abs(found.memory.own_t[joint]) <= 0.25 * c.tau_lsb[joint]


def test_it_is_held_for_a_second_lowered_to_where_gravity_moves_nothing_and_let_go() -> None:
    found = play(constants(), np.array([0.4, 0.2]), np.zeros(2), 15.0)
    begun = int(np.argmax(found.phase == LOWERING))
    assert DT * begun == pytest.approx(1.0, abs=2.0 * DT)
    assert np.abs(found.q[:begun] - found.q[0]).max() < 1e-3
    down = found.phase == LOWERING
    assert 0.098 < found.tip[down[1:]].max() < 0.104  # the tip is what is fastest here
    assert (np.diff(found.q[down].sum(axis=1)) < 1e-4).all()  # down, and no way back
    assert np.abs(model_of(found.p[-1], np.zeros(2)).g / np.array([30.0, 15.0])).max() < 0.0105
    sinks = int(np.argmax(found.phase == SINKING))
    assert found.memory.off == 1
    assert DT * (len(found.q) - sinks) == pytest.approx(4.0, abs=0.01)
    assert np.abs(found.qd[-100:]).max() < 0.03


def test_it_is_lowered_no_further_than_the_limits_of_its_joints() -> None:
    c = constants(q_min=np.array([0.8, 0.2]))
    found = play(c, np.array([0.9, 0.3]), np.zeros(2), 4.0)
    held = found.phase != SINKING
    np.testing.assert_allclose(found.p[held][-1], [0.81, 0.21], atol=1e-3)  # [rad] this much is left to each
    assert (found.p >= [0.805, 0.205]).all()
    slowest = np.abs(np.diff(found.p[held], axis=0)) / DT  # it comes to them softly
    away = found.p[held][:-1] - [0.805, 0.205]
    assert (slowest <= np.maximum(away, 0.0) / 0.4 + 0.012).all()
    assert (found.q[held] >= [0.80, 0.20]).all()


def test_a_joint_that_flies_at_its_limit_is_at_rest_before_it() -> None:
    found = play(
        constants(q_max=np.array([1.3, 2.5]), braking=np.array([6.0, 20.0])),
        np.array([1.1, 0.7]),
        np.array([1.4, 0.0]),
        0.6,
    )
    assert found.q[:, 0].max() < 1.3
    assert found.p[:, 0].max() <= 1.295
    assert abs(found.qd[-1, 0]) < 0.02


# ---- each rule


@pytest.mark.parametrize(
    ("brakeless", "state", "reaction", "sinks", "off", "wanted"),
    [
        (1.0, State.SAFE_STOP, Severity.SS1, 0, 0, True),
        (1.0, State.SAFE_STOP, Severity.STO, 0, 0, True),
        (1.0, State.SAFE_STOP, Severity.SS2, 0, 0, False),
        (1.0, State.SAFE_STOP, Severity.SS1, 0, 1, False),
        (0.0, State.SAFE_STOP, Severity.SS1, 1, 0, False),
        (1.0, State.STOPPING, Severity.NONE, 1, 0, True),
        (1.0, State.STOPPING, Severity.SS1, 0, 0, False),
        (1.0, State.STOPPING, Severity.NONE, 1, 1, False),
        (0.0, State.STOPPING, Severity.NONE, 1, 0, False),
        (1.0, State.RUN, Severity.SS1, 1, 0, False),
    ],
)
def test_which_stops_are_the_drives_own(
    brakeless: float, state: State, reaction: Severity, sinks: int, off: int, wanted: bool
) -> None:
    m = memory(np.zeros(2), np.zeros(2), np.zeros(2))
    m.state, m.reaction, m.sinks, m.off = int(state), int(reaction), sinks, off
    assert module.holds_itself(constants(brakeless=brakeless), m) is wanted


def distrusted(monitors: dict[tuple[int, int], float], **said: object) -> tuple[int, int]:
    """Return the bits of the positions and of the speeds that are untrue; said: of memory or feedback."""
    m = memory(np.array([0.1, 0.2]), np.zeros(2), np.zeros(2))
    m.own_since, m.tick = 100, 100
    f = healthy(np.array([0.1, 0.2]), 0, DT)
    for key, value in said.items():
        if key in Feedback._fields:
            f = f._replace(**{key: value})
        else:
            setattr(m, key, value)
    for where, value in monitors.items():
        m.encoder_monitors[where] = value
    module._distrust(constants(dt=1e-3), m, f)
    return int(m.no_position), int(m.no_speed)


SURPRISED = BIT["innovation"]


@pytest.mark.parametrize(
    ("monitors", "said", "wanted"),
    [
        ({}, {}, (0, 0)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051}, {}, (2, 2)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): -0.0051}, {}, (2, 2)),
        ({(EQUAL, 1): 0.019, (TRAVEL, 1): 0.0051}, {}, (0, 0)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 5e-3}, {}, (0, 0)),
        ({(EQUAL, 0): 0.02, (TRAVEL, 1): 1.0}, {}, (0, 0)),
        ({(BEYOND, 0): DISAGREE_TICKS}, {}, (1, 1)),
        ({(BEYOND, 0): DISAGREE_TICKS - 1}, {}, (0, 0)),
        ({(RESIDUAL, 1): 0.302}, {}, (0, 0)),
        ({(RESIDUAL, 1): 0.302}, {"in_force": SURPRISED}, (2, 2)),
        ({(RESIDUAL, 1): -0.302}, {"in_force": SURPRISED}, (2, 2)),
        ({(RESIDUAL, 1): 0.302}, {"in_force": BIT["collision_hard"]}, (2, 2)),
        ({(RESIDUAL, 1): 0.302}, {"in_force": BIT["drive_fault"]}, (0, 0)),
        ({(RESIDUAL, 1): 0.3}, {"in_force": SURPRISED}, (0, 0)),
        ({}, {"q": np.array([np.nan, 0.2])}, (1, 1)),
        ({}, {"qd": np.array([0.0, np.inf])}, (2, 2)),
        ({}, {"qd": np.array([0.0, np.inf]), "replies": np.array([1, 0])}, (0, 0)),
        ({}, {"q": np.array([0.1, 0.3005])}, (2, 0)),
        ({}, {"q": np.array([0.2, 0.2])}, (0, 0)),
        ({}, {"q": np.array([-0.0005, 0.2])}, (1, 0)),
        ({}, {"q": np.array([0.1, 0.2 + 0.0999])}, (0, 0)),
        ({}, {"q": np.array([0.1, 0.31]), "replies": np.array([1, 0])}, (0, 0)),
        # what a joint that fell does to the others, later than 0.1 s from the onset
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051}, {"lost": 1, "tick": 200}, (2, 2)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051}, {"lost": 1, "tick": 201}, (0, 0)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051}, {"lost": 0, "tick": 201}, (2, 2)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051}, {"no_position": 1}, (3, 2)),
        # what is expected of a joint follows from the torques, and from the speeds of the others
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051}, {"own_untrue": 1}, (0, 0)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051, (BEYOND, 0): DISAGREE_TICKS}, {}, (1, 1)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051, (BEYOND, 0): DISAGREE_TICKS, (EQUAL, 0): 0.02}, {}, (3, 3)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051, (RESIDUAL, 0): 0.302}, {"in_force": SURPRISED}, (1, 1)),
        ({(EQUAL, 1): 0.02, (TRAVEL, 1): 0.0051, (RESIDUAL, 0): 0.302}, {}, (2, 2)),
    ],
)
def test_whose_measurements_are_untrue(
    monitors: dict[tuple[int, int], float], said: dict[str, object], wanted: tuple[int, int]
) -> None:
    assert distrusted(monitors, **said) == wanted


@pytest.mark.parametrize("i", [0, 1])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_who_flees_while_the_drive_says_that_it_gives_little_of_what_it_is_told(i: int, side: float) -> None:
    """Told 6 and 3 Nm lately, twice what an echo may be wrong by; a quarter of the least of these is little."""
    c, told, here, other = constants(), side * np.array([6.0, 3.0]), np.arange(2) == i, np.array([0.5, 0.6])

    def lost(share: float = 0.24, away: float = -0.01, flees: float = -0.21, **said: object) -> int:
        m = held(own_phase=BRAKING, own_since=100)
        m.own_v[:2] = 0.3
        m.sent[:, :2] = told
        f = healthy(other + np.where(here, side * away, 0.0), 0, DT, qd=0.3 + np.where(here, side * flees, 0.0))
        f = f._replace(tau=np.where(here, share * told, told))
        for key, value in said.items():
            if key == "sent":
                m.sent[2, i] = value
            else:
                f = f._replace(**{key: value})
        module._distrust(c, m, f)
        assert (m.no_position, m.no_speed) == (0, 0)
        return int(m.lost)

    assert lost() == 1 << i
    assert lost(share=-1.0) == 1 << i
    assert lost(share=0.26) == 0
    assert lost(flees=-0.19) == 0
    assert lost(flees=0.21) == 0  # it comes back
    assert lost(away=0.01) == 0
    assert lost(away=0.01, flees=0.21) == 1 << i
    assert lost(replies=np.where(here, 0, 1)) == 0
    assert lost(share=0.1, sent=1.01 * c.safety_torque_tolerance[i] * side) == 1 << i
    assert lost(share=0.1, sent=0.99 * c.safety_torque_tolerance[i] * side) == 0  # a tick ago it was told as little
    assert lost(share=0.24, sent=0.9 * told[i]) == 0  # little is of the least


def test_a_joint_that_is_let_go_drifts_by_less_than_a_step_of_the_torque() -> None:
    """No step of a drive is no torque: what is asked for lies by a quarter of one on either side in turn."""
    c, m = constants(), held(own_phase=BRAKING, own_since=100, no_speed=2, tick=101)
    model, f = model_of(m.q[:2], m.qd[:2]), healthy(np.array([0.5, 0.6]), 0, DT)
    asked = []
    for _ in range(8):
        module.own_loop(c, m, f, model, around(), model.g)
        asked.append(float(m.own_t[1]))
        m.tick += 1
    assert asked[-4:] == pytest.approx([0.005, -0.005, 0.005, -0.005])


def test_a_joint_whose_position_alone_is_untrue_is_damped_by_its_speed_as_measured() -> None:
    c, m = constants(), held(own_phase=BRAKING, own_since=100, no_position=2)
    model, f = model_of(m.q[:2], m.qd[:2]), healthy(np.array([0.5, 0.6]), 0, DT, qd=np.array([0.0, 0.9]))
    m.own_t[:2] = 0.0
    c.tau_rate = np.array([1e6, 1e6])
    torque = []
    for qd in (0.9, 0.4):
        again = m.copy()
        module.own_loop(c, again, f._replace(qd=np.array([0.0, qd])), model, around(), model.g)
        torque.append(float(again.own_t[1]))
    assert torque[0] - torque[1] == pytest.approx(-0.5 * c.stop_damping[1])


@pytest.mark.parametrize(
    ("faults", "wanted"),
    [
        ((), 0),
        (("torque_mismatch",), 1),
        (("foreign_command",), 1),
        (("torque_mismatch", "innovation"), 0),  # it may follow from an encoder that lies
        (("foreign_command", "collision_hard"), 0),
        (("drive_fault",), 0),
    ],
)
def test_a_stop_that_begins_with_an_untrue_torque_knows_it(faults: tuple[str, ...], wanted: int) -> None:
    m = memory(np.zeros(2), np.zeros(2), np.zeros(2))
    m.in_force, m.own_untrue = sum(BIT[name] for name in faults), 1 - wanted
    module._begin(constants(), m, healthy(m.q[:2], 0, DT), 2)
    assert m.own_untrue == wanted


def test_a_stop_begins_where_the_joints_are_at_their_speed_with_the_torque_they_have() -> None:
    c, m = constants(), memory(np.array([2.6, -2.6]), np.array([0.3, -0.4]), np.array([3.0, -2.0]))
    m.lost, m.in_force = 3, SURPRISED
    m.encoder_monitors[EQUAL, :2] = 0.019, 0.02
    module._begin(c, m, healthy(m.q[:2], 0, DT, qd=m.qd[:2].copy()), 2)
    assert m.own_phase == BRAKING
    assert m.own_since == 100
    assert m.own_p[:2].tolist() == [2.5, -2.5]  # within the limits
    assert m.own_t[:2].tolist() == [3.0, -2.0]
    assert m.lost == 0
    assert m.own_v[:2].tolist() == [0.3, 0.0]  # the second has repeated itself since before the surprise
    assert m.own_kp[:2].tolist() == [60.0, 0.0]
    assert m.own_kd[:2].tolist() == [1.0, 0.0]
    m.in_force = BIT["drive_fault"]
    module._begin(c, m, healthy(m.q[:2], 0, DT, qd=m.qd[:2].copy()), 2)
    assert m.own_kp[:2].tolist() == [60.0, 40.0]
    assert m.own_kd[:2].tolist() == [1.0, 0.5]
    assert m.own_v[:2].tolist() == [0.3, -0.4]


def held(**said: object) -> RecordRow:
    """Return the memory of an arm that is held at (0.5, 0.6) rad, with what is said of it."""
    c, m = constants(), memory(np.array([0.5, 0.6]), np.array([0.01, 0.02]), np.array([1.0, 2.0]))
    m.own_phase, m.own_since = LOWERING, 0
    m.own_p[:2], m.own_kp[:2], m.own_kd[:2], m.own_t[:2] = m.q[:2], c.stop_kp, c.stop_kd, m.sent[0, :2]
    m.own_v[:2] = 0.05, 0.06
    for key, value in said.items():
        setattr(m, key, value)
    return m


@pytest.mark.parametrize("i", [0, 1])
def test_what_is_let_go_and_what_is_damped(i: int) -> None:
    c, bit = constants(), 1 << i
    f = healthy(np.array([0.5, 0.6]), 0, DT)
    for m, feedback in ((held(no_speed=bit), f), (held(), f._replace(drive=np.where(np.arange(2) == i, 0, 1)))):
        module._let_go(c, m, feedback)
        assert m.lost == bit
        assert (m.own_kp[i], m.own_kd[i], m.own_v[i]) == (0.0, 0.0, 0.0)
        assert m.own_t[i] == (m.sent[0, i] if m.no_speed else 0.0)  # a drive that hears takes it back at its rate
        assert m.own_kp[1 - i] == c.stop_kp[1 - i]
        assert m.own_kd[1 - i] == c.stop_kd[1 - i]
    m = held(no_position=bit)
    module._let_go(c, m, f)
    assert m.lost == 0
    assert (m.own_kp[i], m.own_kd[i], m.own_v[i]) == (0.0, c.stop_kd[i], 0.0)
    assert m.own_kp[1 - i] == c.stop_kp[1 - i]
    assert m.own_v[1 - i] != 0.0


def test_a_joint_that_moves_by_its_own_account_is_held_again_where_it_is_then() -> None:
    c, f = constants(), healthy(np.array([0.5, 0.6]), 0, DT)

    def again(**said: object) -> RecordRow:
        m = held(**said)
        m.own_kp[1] = m.own_kd[1] = m.own_v[1] = m.own_p[1] = 0.0
        if m.encoder_monitors[EQUAL, 0] == 1.0:  # what the others do is nothing to it
            m.encoder_monitors[EQUAL, 1] = 0.02
        module._let_go(c, m, f)
        return m

    m = again()
    assert (m.own_kp[1], m.own_kd[1], m.own_p[1], m.own_v[1]) == (40.0, 0.5, 0.6, 0.02)
    assert m.own_v[0] == 0.05  # the other goes on
    m = held()
    m.own_kd[1], m.encoder_monitors[EQUAL, 1] = 0.0, 0.02
    module._let_go(c, m, f)
    assert m.own_kd[1] == 0.0
    assert again(own_phase=SINKING).own_kd[1] == 0.0
    for beyond, to in ((2.7, 2.5), (-2.7, -2.5)):
        m = held()
        m.own_kd[1], m.q[1] = 0.0, beyond
        module._let_go(c, m, f)
        assert m.own_p[1] == to


def random_arm(seed: int, n: int = 4) -> tuple[RecordRow, RecordRow, Model]:
    """Return constants, memory and model of an arm that nobody built: links side by side more than in a row."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(n, n))
    A = 0.2 * W @ W.T + np.diag(rng.uniform(1.0, 3.0, n))
    J, Jp = rng.normal(0.0, 0.4, (6, n)), rng.normal(0.0, 0.4, (3, 3, n))
    g = rng.choice([-1.0, 1.0], n) * rng.uniform(1.0, 8.0, n)
    model = made(A, rng.normal(size=n), g, J, Jp, rng.normal(size=n), rng.normal(size=n))
    c = constants(
        q_min=np.full(n, -5.0), q_max=np.full(n, 5.0), viscous=rng.uniform(0.1, 1.0, n), tau_max=np.full(n, 20.0)
    )
    m = record_of(fresh())[0]
    m.q[:n], m.qd[:n], m.own_v[:n], m.own_t[:n] = model.q, model.qd, rng.normal(size=n), rng.normal(size=n)
    m.own_p[:n], m.own_kp[:n], m.own_kd[:n] = model.q, 50.0, 1.0
    return c, m, model


@pytest.mark.parametrize("lost", [0, 1, 2, 5, 10, 12])
def test_what_moves_joints_that_are_held_is_solved_for_those_that_fall(lost: int) -> None:
    """Against a direct solution of A_ll a = t - g - h - B qd - A_lh a_h, and of the others' torque with it."""
    c, m, model = random_arm(lost)
    asked, m.lost = np.array([1.0, -2.0, 0.5, 3.0]), lost
    given_before = asked.copy()
    found = module._inertial(c, m, model, model.g, asked)
    np.testing.assert_array_equal(asked, given_before)
    fall = np.array([bool(lost >> i & 1) for i in range(4)])
    qdd = asked.copy()
    net = m.own_t[:4] - model.g - model.h - c.viscous * m.qd[:4] - model.A[:, ~fall] @ asked[~fall]
    qdd[fall] = np.linalg.solve(model.A[np.ix_(fall, fall)], net[fall])
    np.testing.assert_allclose(found, model.A @ qdd + model.h + c.viscous * m.own_v[:4], atol=1e-6)


@pytest.mark.parametrize(
    ("end", "way", "stays"), [(-5.0, -1, True), (-5.0, 1, False), (5.0, 1, True), (5.0, -1, False)]
)
def test_a_joint_that_has_fallen_to_its_end_pulls_no_more(end: float, way: int, stays: bool) -> None:
    c, m, model = random_arm(7)
    m.lost, m.q[2] = 4, end
    g = model.g.copy()
    g[2] = m.own_t[2] - model.h[2] - c.viscous[2] * m.qd[2] - 0.5 * way  # what would drive it further, or back
    qdd = np.zeros(4)
    if not stays:
        qdd[2] = (m.own_t[2] - g[2] - model.h[2] - c.viscous[2] * m.qd[2]) / model.A[2, 2]
    wanted = model.A @ qdd + model.h + c.viscous * m.own_v[:4]
    np.testing.assert_allclose(module._inertial(c, m, model, g, np.zeros(4)), wanted, atol=1e-9)


# ---- how it is lowered


@pytest.mark.parametrize("tip", [0.01, 1.0])
@pytest.mark.parametrize("point", [0.01, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_it_is_lowered_against_gravity_at_the_first_speed_that_is_reached(seed: int, tip: float, point: float) -> None:
    c, m, model = random_arm(seed)
    model = model._replace(J=tip * model.J, Jp=point * model.Jp)
    u = module._slope(c, m, model, model.g)
    np.testing.assert_allclose(u / np.linalg.norm(u), -model.g / np.linalg.norm(model.g), atol=1e-12)
    shares = [np.abs(u).max() / 0.2, np.linalg.norm(model.J[:3] @ u) / 0.10]
    shares += [np.linalg.norm(p @ u) / 0.12 for p in model.Jp]
    assert max(shares) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("scale", [1.0, 0.0625])
def test_which_joints_are_not_lowered(scale: float) -> None:
    c, _, model = random_arm(3)
    c.tau_max[:4] = 20.0 * scale
    model = model._replace(J=0.0 * model.J, Jp=0.0 * model.Jp)
    pulls = np.array([4.0, -5.0, 3.0, -2.0])

    def moved(gravity: F64 = pulls, **said: object) -> list[bool]:
        row = record_of(fresh())[0]
        row.own_p[:4] = row.q[:4] = said.get("q", np.zeros(4))
        row.own_p[:4] += np.asarray(said.get("ahead", np.zeros(4)))
        row.own_kp[:4], row.own_kd[:4], row.lost = 50.0 * scale, said.get("kd", np.ones(4)), said.get("lost", 0)
        u = module._slope(c, row, model, scale * gravity)
        assert (u * gravity <= 0.0).all()
        assert not u.any() or np.abs(u).max() == pytest.approx(0.2)
        return [bool(one) for one in u]

    assert moved() == [True] * 4
    assert moved(lost=5) == [False, True, False, True]
    assert moved(kd=np.array([1.0, 0.0, 1e-9, 1.0])) == [True, False, True, True]
    # 0.01 of 20 Nm moves nothing worth lowering
    assert moved(np.array([0.2, -0.2, 0.2001, -0.2001])) == [False, False, True, True]
    assert moved(np.array([0.0, 0.1, -0.1, 0.2])) == [False] * 4
    # at limits: only what would take it further
    assert moved(q=np.array([-4.99, 4.99, 4.99, -4.99])) == [False, False, True, True]
    assert moved(q=np.array([-4.98995, 4.98995, 4.99, -4.99])) == [True] * 4
    # on something: the spring presses it down with more than a tenth of its torque, 2 Nm of 50 Nm/rad; not if it lifts
    assert moved(ahead=np.array([-0.0401, 0.0401, 0.0401, -0.0401])) == [False, False, True, True]
    assert moved(ahead=np.array([-0.0399, 0.0399, 0.0, 0.0])) == [True] * 4


@pytest.mark.parametrize(
    ("rho", "rooms", "torque", "present", "wanted"),
    [
        ((), {}, 1.0, 0, False),
        ((), {}, 1.0, BIT["contact"], True),
        ((), {}, 1.0, BIT["drive_fault"], False),
        ((0.0299,), {}, 1.0, 0, True),
        ((0.03,), {}, 1.0, 0, False),
        ((0.0299,), {}, -1.0, 0, False),  # it is lowered away from it
        ((0.0299,), {}, 0.0, 0, False),
        ((0.05, 0.0299), {}, 1.0, 0, True),
        ((0.0299, 0.05), {}, 1.0, 0, True),
        ((0.0599,), {"influence": 0.1, "clearance": 0.03}, 1.0, 0, True),
        ((0.0601,), {"influence": 0.1, "clearance": 0.03}, 1.0, 0, False),
        ((0.0599,), {"influence": 0.0, "clearance": 0.03}, 1.0, 0, False),
    ],
)
def test_whether_something_lies_under_the_arm(
    rho: tuple[float, ...], rooms: dict[str, float], torque: float, present: int, wanted: bool
) -> None:
    m = held(present=present)
    m.tau_obstacles[:2] = 0.5 * torque, 2.0 * torque
    u = np.array([0.02, -0.1])  # the obstacle's push on the second joint outweighs the first
    assert module._obstructed(constants(), m, around(rho, **rooms), u) is wanted


def test_an_arm_with_something_under_it_is_held_there_until_it_is_gone() -> None:
    c, model = constants(), model_of(np.array([0.5, 0.6]), np.zeros(2))
    m = held(own_since=0, tick=30001, present=BIT["contact"])  # a tick longer than it is lowered otherwise
    m.own_v[:2] = 0.0
    module._go_on(c, m, model, around(), model.g)
    assert m.own_phase == LOWERING
    assert not m.own_v[:2].any()
    m.present = 0
    module._go_on(c, m, model, around(), model.g)
    assert m.own_phase == SINKING  # and this long it has tried
    assert m.own_since == 30001
    m = held(own_since=0, tick=30000)
    module._go_on(c, m, model, around(), model.g)
    assert m.own_phase == LOWERING
    assert m.own_v[0] < 0.05  # it slows down from the speed it had, 0.2 rad/s in 0.4 s
    np.testing.assert_allclose(0.05 - m.own_v[0], 0.5 * DT, atol=1e-12)


def test_how_far_a_joint_may_go() -> None:
    c, m = constants(), held()
    assert module._ahead(c, m, 0, 0.1) == pytest.approx(2.5 - 0.005 - 0.5)
    assert module._ahead(c, m, 1, 0.1) == pytest.approx(2.5 - 0.005 - 0.6)
    assert module._ahead(c, m, 1, -0.1) == pytest.approx(0.6 + 2.5 - 0.005)
    assert module._ahead(c, m, 1, 0.0) == module._ahead(c, m, 1, -0.1)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_how_a_joint_brakes(side: float) -> None:
    """As it decays, 10 v; no more than the law brakes it, 15 rad/s2; but twice that where its limit is near."""
    c = constants(q_min=-np.full(2, 2.5), q_max=np.full(2, 2.5))

    def rate(v: float, left: float, i: int = 0) -> float:
        m = held()
        m.own_v[i], m.own_p[i] = side * v, side * (2.5 - 0.005 - left)
        return float(module._braking(c, m, i))

    assert rate(0.5, 2.0) == pytest.approx(5.0)
    assert rate(2.0, 2.0) == pytest.approx(15.0)
    assert rate(2.0, 2.0, 1) == pytest.approx(20.0)
    assert rate(2.0, 0.1) == pytest.approx(20.0)  # v^2 / 2 s
    assert rate(2.0, 0.01) == pytest.approx(30.0)
    assert rate(0.1, 0.0) == pytest.approx(0.5 * 0.01 / 1e-3)
    assert rate(2.0, -1.0) == pytest.approx(30.0)
    assert rate(0.0, 0.0) == 0.0


def test_where_a_joint_goes_in_a_tick() -> None:
    c, still = constants(), model_of(np.array([0.5, 0.6]), np.zeros(2))
    m = held(own_phase=BRAKING, own_since=100)
    m.own_v[:2] = 1.0, -0.5
    module._go_on(c, m, still, around(), still.g)
    np.testing.assert_allclose(m.own_v[:2], [1.0 - 10.0 * DT, -0.5 + 5.0 * DT])
    np.testing.assert_allclose(m.own_p[:2], [0.5 + 0.98 * DT, 0.6 - 0.49 * DT])
    m = held(own_phase=BRAKING, own_since=100)
    m.own_p[:2], m.own_v[:2] = (2.4949, -2.4949), (0.5, -0.5)
    module._go_on(c, m, still, around(), still.g)
    assert m.own_p[:2].tolist() == [2.495, -2.495]
    assert m.own_v[:2].tolist() == [0.0, 0.0]
    m = held(own_phase=BRAKING, own_since=100)
    m.own_p[:2], m.own_v[:2] = (2.499, -2.499), (0.0, 0.0)  # nearer to the limit: it stays
    module._go_on(c, m, still, around(), still.g)
    assert m.own_p[:2].tolist() == [2.499, -2.499]


@pytest.mark.parametrize(("ticks", "phase"), [(499, BRAKING), (500, LOWERING)])
def test_it_is_held_for_a_second(ticks: int, phase: int) -> None:
    m, model = held(own_phase=BRAKING, own_since=100, tick=100 + ticks), model_of(np.array([0.5, 0.6]), np.zeros(2))
    module._go_on(constants(), m, model, around(), model.g)
    assert m.own_phase == phase
    assert m.own_since == (100 if phase == BRAKING else 600)


@pytest.mark.parametrize(
    ("ticks", "rest", "off"),
    [(1999, 9999, 0), (2000, 250, 1), (2000, 249, 0), (5999, 0, 0), (6000, 0, 1), (1000, 9999, 0)],
)
def test_what_holds_it_at_the_end_fades_and_when_it_is_cut(ticks: int, rest: int, off: int) -> None:
    m, model = held(own_phase=SINKING, own_since=100, tick=100 + ticks, rest=rest), model_of(np.zeros(2), np.zeros(2))
    m.own_g[:2] = 3.0, 4.0
    module._go_on(constants(), m, model, around(), model.g)
    assert m.off == off
    np.testing.assert_allclose(m.own_kp[:2], np.exp(-DT) * np.array([60.0, 40.0]))
    np.testing.assert_allclose(m.own_g[:2], np.exp(-DT) * np.array([3.0, 4.0]))
    assert m.own_kd[:2].tolist() == [1.0, 0.5]


# ---- the torque beside


def asked(m: RecordRow, f: Feedback, g: F64, c: RecordRow | None = None) -> RecordRow:
    """Return the memory after a tick of an arm that does not move, as its model is."""
    model = made(np.eye(2), np.zeros(2), g, SPACE, np.zeros((1, 3, 2)), m.q[:2].copy(), np.zeros(2))
    module.own_loop(constants(viscous=np.zeros(2)) if c is None else c, m, f, model, around(), g)
    return m


def resting(**said: object) -> RecordRow:
    """Return the memory of an arm that is held, and stands."""
    m = held(own_phase=BRAKING, own_since=100, **said)
    m.own_v[:2] = 0.0
    return m


def test_the_torque_beside_is_gravity_and_damps_where_the_speed_is_known() -> None:
    g, f = np.array([1.2, 2.2]), healthy(np.array([0.5, 0.6]), 0, DT)
    m = asked(resting(), f, g)
    np.testing.assert_allclose(m.own_t[:2], g - np.array([0.4, 0.2]) * np.array([0.01, 0.02]))
    np.testing.assert_allclose(m.own_g[:2], g)
    for unheard in (
        f._replace(replies=np.zeros(2, np.int64)),
        f._replace(age=np.full(2, 10.0 * DT + 1e-9)),
    ):
        np.testing.assert_allclose(asked(resting(), unheard, g).own_t[:2], g)
    m = asked(resting(), f._replace(age=np.full(2, 10.0 * DT)), g)
    assert (m.own_t[:2] < g).all()
    m = asked(resting(no_position=2), f, g)
    np.testing.assert_allclose(m.own_t[:2] - g, [-0.4 * 0.01, 0.0])
    m = asked(resting(no_speed=2), f, g)
    assert m.own_t[1] == pytest.approx(2.0 - 800.0 * DT)  # let go, at the rate of its torque


def test_the_torque_beside_keeps_its_bounds() -> None:
    f = healthy(np.array([0.5, 0.6]), 0, DT)
    m = resting()
    m.own_t[:2] = 1.0, 2.0
    assert asked(m, f, np.array([9.0, -9.0])).own_t[:2] == pytest.approx([1.0 + 1000.0 * DT, 2.0 - 800.0 * DT])
    m = resting()
    m.own_t[:2] = 29.9, -14.9
    assert asked(m, f, np.array([90.0, -90.0])).own_t[:2].tolist() == [30.0, -15.0]
    m = resting()
    m.own_t[:2] = 0.0
    assert asked(m, f, np.array([np.nan, 1.0])).own_t[0] == 0.0
    assert m.own_t[1] == pytest.approx(1.0, abs=0.01)


def test_gravity_is_not_taken_anew_while_it_fades() -> None:
    m = resting(tick=200)
    m.own_phase, m.own_g[:2] = SINKING, (0.5, 0.25)
    asked(m, healthy(np.array([0.5, 0.6]), 0, DT), np.array([9.0, 9.0]))
    np.testing.assert_allclose(m.own_g[:2], np.exp(-DT) * np.array([0.5, 0.25]))


def test_a_stop_begins_once() -> None:
    m = memory(np.array([0.5, 0.6]), np.zeros(2), np.zeros(2))
    f = healthy(np.array([0.5, 0.6]), 0, DT)
    asked(m, f, np.zeros(2))
    assert m.own_phase == BRAKING
    m.q[:2] = 0.7, 0.8
    asked(m, f._replace(q=np.array([0.7, 0.8])), np.zeros(2))
    assert m.own_p[:2].tolist() == [0.5, 0.6]


def test_the_inertia_is_asked_for_of_no_more_than_what_the_law_brakes_with() -> None:
    """The largest change of v that counts is twice the braking; a joint that is at once at its edge has more."""
    m = resting()
    m.own_p[:2], m.own_v[:2] = (2.4949, -2.4949), (4.0, -4.0)  # 4 rad/s to nothing in a tick
    m.q[:2], m.qd[:2] = m.own_p[:2], m.own_v[:2]
    m.own_t[:2] = 0.0
    c = constants(viscous=np.zeros(2), tau_rate=np.full(2, 1e6), stop_damping=np.zeros(2), tau_max=np.full(2, 100.0))
    asked(m, healthy(m.q[:2].copy(), 0, DT), np.zeros(2), c)
    np.testing.assert_allclose(m.own_t[:2], [-30.0, 40.0])
    m = resting()
    m.own_v[:2], m.own_t[:2] = (1.0, -0.5), 0.0
    m.qd[:2] = m.own_v[:2]
    asked(m, healthy(m.q[:2].copy(), 0, DT), np.zeros(2), c)
    np.testing.assert_allclose(m.own_t[:2], [-10.0, 5.0])


def test_what_the_drives_give_by_their_loops() -> None:
    c, m = constants(), held()
    m.own_p[:2], m.own_v[:2] = (0.52, 0.57), (0.05, -0.06)
    wanted = [60.0 * 0.02 + 1.0 * 0.04 + 1.0, 40.0 * -0.03 + 0.5 * -0.08 + 2.0]
    np.testing.assert_allclose(module.given(c, m, 2), wanted)
    m.lost = 1
    np.testing.assert_allclose(module.given(c, m, 2), [0.0, wanted[1]])
    m.lost, m.own_p[:2] = 0, (5.0, -5.0)
    assert module.given(c, m, 2).tolist() == [30.0, -15.0]


def test_every_kernel_of_it_is_tried() -> None:
    names = {name for name, f in vars(module).items() if inspect.isfunction(f) and f.__module__ == module.__name__}
    assert len(names) == 14


@pytest.mark.parametrize("lost", [0, 2, 5, 10])
def test_joints_that_are_let_go_are_taken_to_give_nothing(lost: int) -> None:
    c, m, _ = random_arm(lost)
    m.lost = lost
    q, qd, p, v = m.q[:4], m.qd[:4], m.own_p[:4], m.own_v[:4]
    gives = np.clip(50.0 * (p - q) + 1.0 * (v - qd) + m.own_t[:4], -20.0, 20.0)
    falls = [bool(lost >> i & 1) for i in range(4)]
    np.testing.assert_allclose(module.given(c, m, 4), np.where(falls, 0.0, gives))


@pytest.mark.parametrize("i", [0, 1])
def test_a_joint_whose_encoder_begins_to_lie_in_a_stop_is_let_go_in_the_same_tick(i: int) -> None:
    c, q, qd = constants(), np.array([0.5, 0.6]), np.array([0.2, -0.1])
    m, model = memory(q, qd, np.array([1.0, 2.0])), model_of(q, qd)
    m.encoder_monitors[BEYOND, i] = DISAGREE_TICKS
    module.own_loop(c, m, healthy(q, 0, DT), model, around(), model.g)
    assert (m.no_speed, m.lost) == (1 << i, 1 << i)
    assert m.own_kd[:2].tolist() == [0.0 if k == i else c.stop_kd[k] for k in range(2)]
