"""Defects that published controllers of this kind have. Each is a claim, and the claim fails with the defect put in."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtctl.arm import law as law_module
from rtctl.arm import limits, osc, pipe, servo_level, supervision, terms
from rtctl.arm.model import Model
from rtctl.arm.osc import OperationalSpace
from rtctl.control import supervisor
from rtctl.control.firas import field_buffers
from rtctl.control.supervisor import Event
from rtctl.types import F64, Drive, Request, Shape, State, Verb
from rtctl.world import primitives
from rtctl.world.primitives import obstacles_empty, with_shape
from tests.arms import PANDA_HOME
from tests.lab import lab, play, robot, sphere

Patch = pytest.MonkeyPatch
ZERO = np.zeros(3)
law: Any = law_module  # its parts are exchanged here, those it imports as well


def model_at(q: F64) -> Model:
    return robot().body.evaluate(q, np.zeros(7), robot().points, robot().own)


def law_at(q: F64, *shapes: Shape, e: F64 = ZERO) -> terms.Law:
    """Return the law for an arm at rest at q whose tip is to go along e."""
    arm, model = robot(), model_at(q)
    table = obstacles_empty(arm.slots)
    for k, shape in enumerate(shapes):
        table = with_shape(table, k, shape)
    space = osc.operational_space(model.J, model.A_inv, model.Lambda_inv, np.eye(6), arm.motion)
    return law.evaluate_law(
        arm,
        model,
        space,
        table,
        terms.Motion(
            q,
            np.zeros(7),
            osc.Twist(ZERO, ZERO),
            osc.Twist(e, ZERO),
            osc.Twist(e, ZERO),
            q,
            1.0,
            np.zeros(7),
            False,
            np.zeros(7),
            terms.nothing_ahead(arm),
            np.zeros(0),
        ),
    )


def interpreted(patch: Patch) -> None:
    """Let the law look its parts up when it runs, so that one of them can be exchanged."""
    whole = law.law.py_func
    parts = "_work_in rows_in params_of motion_limits _torques _bound _bounds approach_params _near nearby_in"
    for part in (*parts.split(), "_slewed", "_let_pass", "_hold_back"):
        patch.setattr(law, part, getattr(law, part).py_func)
    patch.setattr(law, "law", lambda constants, *rest: whole(constants.view(np.recarray), *rest))
    patch.setattr(servo_level, "law", law.law)
    patch.setattr(servo_level, "act", servo_level.act.py_func)
    patch.setattr(pipe, "servo", servo_level.servo.py_func)


# ---- not a number at a singular pose


def finite_and_moderate_at_a_singular_pose() -> bool:
    """The stretched arm, to the bit: joints 1, 3, 5 and 7 share one axis."""
    torques = [law_at(np.zeros(7), e=e) for e in 0.4 * np.eye(3)]
    wanted = np.array([t.drive + t.keep for t in torques])
    return bool(np.isfinite(wanted).all() and np.abs(wanted).max() < 300.0)


def bare_inverse(J: F64, A_inv: F64, Lambda_inv: F64, S: F64, p: osc.MotionParams) -> OperationalSpace:
    try:
        Lambda = np.linalg.inv(Lambda_inv)
    except np.linalg.LinAlgError:
        Lambda = np.full((6, 6), np.nan)
    Jbar = A_inv @ J.T @ Lambda
    return OperationalSpace(Lambda.astype(np.float64), Jbar, np.eye(7) - J.T @ Jbar.T, 0.0, False)


def test_a_singular_pose_gives_a_torque_that_is_a_number(monkeypatch: Patch):
    assert finite_and_moderate_at_a_singular_pose()
    monkeypatch.setattr(osc, "operational_space", bare_inverse)
    with np.errstate(all="ignore"):
        assert not finite_and_moderate_at_a_singular_pose()


# ---- a normal that flips inside and pulls deeper


def pushed_out_at_every_depth() -> bool:
    model = model_at(PANDA_HOME)
    out = True
    for depth in (-0.02, -0.001, 0.001, 0.01, 0.03):
        centre = model.x + np.array([0.0, 0.0, -0.06])
        nearest = law_at(PANDA_HOME, sphere("ball", centre, 1e-3))
        radius = nearest.rho[0] + 1e-3 + depth
        torques = law_at(PANDA_HOME, sphere("ball", centre, radius))
        j = int(torques.nearest[0])
        away = model.P[j] - centre
        assert torques.rho[0] == pytest.approx(-depth, abs=1e-6)
        out = out and bool(away @ model.Jp[j] @ model.A_inv @ torques.tau_obstacles > 0.0)
    return out


def test_penetration_pushes_out(monkeypatch: Patch):
    assert pushed_out_at_every_depth()
    true_field = law.field_to

    def flipping(*arguments: Any) -> int:
        flags, seen = true_field(*arguments), arguments[5]
        if seen.rho_min.min() < 0.0:  # gradient of |distance|
            seen.tau[:] *= -1.0
        return int(flags)

    interpreted(monkeypatch)
    assert pushed_out_at_every_depth()
    monkeypatch.setattr(law, "field_to", flipping)
    assert not pushed_out_at_every_depth()


# ---- a gradient that is no unit vector


def push_depends_on_the_gap_alone() -> bool:
    """One free point of one kilogram before balls of three sizes: the acceleration is that of the paper."""
    p, forces = robot().avoid, []
    for radius in (0.03, 0.3, 3.0):
        table = with_shape(obstacles_empty(4), 0, sphere("ball", [0.0, 0.0, 0.0], radius))
        out = field_buffers(4, 1, 3)
        at = np.array([[radius + 0.04, 0.0, 0.0]])
        eye = np.eye(3).reshape(1, 3, 3)
        points = law.MovingPoints(at, eye, eye, np.zeros(1), np.ones(1, np.int64))
        law.field_to(points, ZERO, ZERO, table, p, out, True, terms.nothing_ahead(robot()).ends)
        forces.append(out.tau[0])
    wanted = p.eta * (1.0 / 0.04 - 1.0 / p.rho0) / 0.04**2
    return bool(np.allclose(forces, wanted, rtol=1e-9))


def test_the_gradient_of_the_distance_is_a_unit_vector(monkeypatch: Patch):
    assert push_depends_on_the_gap_alone()
    true_field = law.field_to

    def unnormalised(points: law.MovingPoints, *arguments: Any) -> int:
        flags, seen = true_field(points, *arguments), arguments[4]
        seen.tau[:] *= np.linalg.norm(points.P[0])  # p - centre instead of its direction
        return int(flags)

    monkeypatch.setattr(law, "field_to", unnormalised)
    assert not push_depends_on_the_gap_alone()


# ---- avoidance in the null space

BEHIND = {
    "duration_s": 1.6,
    "goal": [{"at_s": 0.4, "position_m": [0.55, 0.0, 0.45]}],
    "obstacle": [{"name": "ball", "type": "sphere", "radius_m": 0.04, "position_m": [0.45, 0.0, 0.45]}],
}


def the_arm_stops_before_a_ball_on_its_line() -> bool:
    run = play(BEHIND)
    touched = run.figures["contacts"] > 0 or run.memory.state != State.RUN  # stopped by its own sense of contact
    return not touched and run.figures["min_clearance_m"]["ball"] > 0.01


def test_avoidance_goes_before_the_goal(monkeypatch: Patch):
    assert the_arm_stops_before_a_ball_on_its_line()
    true_law = servo_level.law

    def in_the_null_space(*arguments: Any) -> Any:
        out, space, torques = true_law(*arguments), arguments[4], arguments[8].torques
        projected = space.NT @ torques[terms.OBSTACLES]
        torques[terms.KEEP] += projected - torques[terms.OBSTACLES]
        torques[terms.OBSTACLES] = projected
        return out

    monkeypatch.setattr(servo_level, "law", in_the_null_space)
    monkeypatch.setattr(servo_level, "act", servo_level.act.py_func)
    monkeypatch.setattr(pipe, "servo", servo_level.servo.py_func)  # looks its parts up when it runs
    assert not the_arm_stops_before_a_ball_on_its_line()


# ---- lower limits treated otherwise than upper ones


def both_limits_push_alike() -> bool:
    """Nothing else changes when the arm turns about its upright first joint, from one end of it to the other."""
    alike = True
    for near in (0.15, 0.05, 0.005, -0.03):
        q = PANDA_HOME.copy()
        q[0] = robot().q_max[0] - near
        upper, A_inv = law_at(q).tau_limits, model_at(q).A_inv
        q[0] = robot().q_min[0] + near
        alike = alike and (A_inv @ upper)[0] < 0.0 and bool(np.allclose(upper, -law_at(q).tau_limits, atol=1e-6))
    return alike


def test_lower_and_upper_joint_limits_are_the_same_law(monkeypatch: Patch):
    assert both_limits_push_alike()
    true_field = law.joint_limit_field

    def upper_only(q: F64, qd: F64, q_min: F64, *arguments: Any) -> int:
        return int(true_field(q, qd, np.full(7, -np.inf), *arguments))

    interpreted(monkeypatch)
    assert both_limits_push_alike()
    monkeypatch.setattr(law, "joint_limit_field", upper_only)
    assert not both_limits_push_alike()


# ---- distances to segments


def segment_distances_are_right(measure: Callable[[Shape, F64], tuple[F64, F64]]) -> bool:
    """Against the least of many samples along the segment."""
    rng = np.random.default_rng(4)
    worst = 0.0
    for _ in range(40):
        wxyz = rng.normal(size=4)
        shape = Shape(
            "bar",
            "capsule",
            np.array([0.05, rng.uniform(0.05, 0.5), 0.0, 0.0]),
            rng.uniform(-1, 1, 3),
            wxyz / np.linalg.norm(wxyz),
            ZERO,
            ZERO,
        )
        P = rng.uniform(-1.0, 1.0, (50, 3))
        w, x, y, z = shape.wxyz
        axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        samples = shape.position + np.linspace(-1, 1, 4001)[:, None] * shape.dims[1] * axis
        true = np.array([np.sqrt(((samples - p) ** 2).sum(1).min()) for p in P]) - 0.05
        worst = max(worst, float(np.abs(measure(shape, P)[0] - true).max()))
    return worst < 1e-4


def along_the_line(shape: Shape, P: F64) -> tuple[F64, F64]:
    """Forget that a segment ends."""
    w, x, y, z = shape.wxyz
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    offset = P - shape.position
    foot = offset - np.outer(offset @ axis, axis)
    return np.linalg.norm(foot, axis=1) - shape.dims[0], foot


def test_segments_end():
    assert segment_distances_are_right(primitives.distance)
    assert not segment_distances_are_right(along_the_line)


# ---- no action when the command is too large


def too_much_is_limited_and_still_brakes(limit: Callable[..., limits.Limited]) -> bool:
    """A joint at speed, a brake that must be kept, and a drive that wants far more than there is."""
    arm = robot()
    qd = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
    keep = -0.5 * arm.tau_max * np.sign(qd)
    bounds, brakes = limits.TorqueBounds(arm.tau_max, arm.tau_rate, arm.tau_lsb, arm.stop.damping), True
    for drive in (np.full(7, 1e6), -np.full(7, 1e6), 1e6 * qd):
        tau = limit(limits.TorqueParts(drive, keep), qd, keep, bounds, arm.dt).tau
        brakes = brakes and bool((np.abs(tau) <= arm.tau_max).all() and (tau * qd).sum() < 0.0 and tau.any())
        # the reference is the brake itself: within one step of it nothing is given away
        brakes = brakes and bool((np.abs(tau - keep) <= arm.tau_rate * arm.dt * (1 + 1e-9)).all())
    return brakes


def all_or_nothing(torque: limits.TorqueParts, *arguments: Any) -> limits.Limited:
    wanted = torque.drive + torque.keep
    tau = wanted if (np.abs(wanted) <= robot().tau_max).all() else np.zeros(7)
    return limits.Limited(wanted, tau, 0, 1.0)


def test_a_command_that_is_too_large_still_brakes():
    assert too_much_is_limited_and_still_brakes(limits.limit_torque)
    assert not too_much_is_limited_and_still_brakes(all_or_nothing)


# ---- no torque at exit


def held_until_it_rests() -> bool:
    """SIGTERM in full motion: torque until every joint is slow, and the tip does not sag when it goes."""
    with lab() as here:
        here.running()
        here.run(0.6)
        here.ask([0.5, 0.3, 0.35])
        here.run(0.35)
        assert max(np.abs(here.simulator.plant.qd)) > 0.2
        here.step(Request(Verb.TERM))
        while not here.memory.done:
            fast = max(np.abs(here.simulator.plant.qd)) > 0.1
            if fast and here.turns[-1].command.drive != Drive.TORQUE:
                return False
            here.step()
            assert len(here.turns) < 5000
        if max(np.abs(here.simulator.plant.qd)) > 0.1:
            return False
        rest = here.simulator.plant.tip_pose()[0]
        here.run(0.5)
        return float(np.abs(here.simulator.plant.tip_pose()[0] - rest).max()) < 2e-3


def test_the_arm_does_not_fall_at_exit(monkeypatch: Patch):
    assert held_until_it_rests()
    monkeypatch.setitem(supervisor.TABLE, (State.RUN, Event.TERM), State.FAULT)
    assert not held_until_it_rests()


# ---- a jump when it is switched on again


def starts_where_it_is() -> bool:
    """Run, stop, be moved by hand, run again: nothing moves."""
    with lab() as here:
        here.running()
        here.ask([0.4, 0.1, 0.5])
        here.run(0.5)
        here.step(Request(Verb.DISARM))
        here.until(State.IDLE)
        here.simulator.plant.place(PANDA_HOME + np.array([0.15, 0.1, -0.1, 0.15, 0.1, -0.1, 0.2]))
        here.run(0.4)
        before = here.simulator.plant.tip_pose()[0]
        here.running()
        farthest = 0.0
        for _ in range(500):
            here.step()
            farthest = max(farthest, float(np.linalg.norm(here.simulator.plant.tip_pose()[0] - before)))
        return farthest < 5e-3


def test_switching_on_again_begins_from_where_the_arm_is(monkeypatch: Patch):
    assert starts_where_it_is()
    monkeypatch.setattr(supervision, "held_here", lambda robot, m: m)
    assert not starts_where_it_is()


# ---- a speed limit that is passed

FAR = {"duration_s": 1.1, "goal": [{"at_s": 0.4, "position_m": [0.5, 0.35, 0.4], "hold": "orientation"}]}


def within_the_speed_limit() -> bool:
    run = play(FAR)
    return float(np.linalg.norm(np.diff(run.tip, axis=0), axis=1).max()) / robot().dt <= 1.01 * robot().motion.v_max


def test_the_speed_limit_holds(monkeypatch: Patch):
    assert within_the_speed_limit()
    interpreted(monkeypatch)
    assert within_the_speed_limit()

    def unlimited(error: osc.Twist, *a: Any) -> None:
        p, out = a[-3], a[-1]
        out.linear[:], out.angular[:] = p.k_p / p.k_v * error.linear, p.k_p / p.k_v * error.angular

    monkeypatch.setattr(law, "velocity_reference", unlimited)

    def unbounded(*a: Any) -> None:
        a[-1][:2] = np.inf

    monkeypatch.setattr(law, "tip_bounds", unbounded)
    assert not within_the_speed_limit()


def test_the_limit_holds_however_far_the_goal_jumps():
    with lab() as here:
        here.running()
        here.run(0.6)
        tips = []
        for k in range(600):
            if k % 100 == 0:
                here.ask([0.45, 0.3 if k % 200 else -0.3, 0.5])
            else:
                here.step()
            tips.append(here.simulator.plant.tip_pose()[0])
        speed = np.linalg.norm(np.diff(tips, axis=0), axis=1) / robot().dt
        assert speed.max() <= 1.01 * robot().motion.v_max
        assert speed.max() > 0.2
