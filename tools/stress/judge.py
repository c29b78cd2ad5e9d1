"""What a run must show: the criteria of the stress set, and whether a diagnosis is true of the geometry."""

from typing import TYPE_CHECKING

import numpy as np

from firmware_sim.bullet import pb
from firmware_sim.plant import Plant
from rtctl.app.arm import ArmServo
from rtctl.arm.robot import Robot
from rtctl.arm.task import error_of
from rtctl.kernel.rotations import R_of
from rtctl.types import F64

if TYPE_CHECKING:
    from tools.stress.play import Seen, Watch

CLOSING = 0.005  # [m/s] of the arm's own point towards the obstacle: faster, and the contact is the arm's
AT_LIMIT = 0.85  # of the bound on torque, joint speed or tip speed
TIP_TOLERANCE = 0.02  # of v_max
OVERHANG = 0.03  # [m] farthest that the spheres which the controller knows reach beyond the links
REST = 0.012  # [m/s] mean speed of a tip at rest
CREEP = 0.03  # [m/s] mean speed of a tip that creeps at most
SLOW = 0.04  # of full speed: who comes nearer more slowly does not move towards the goal
LATE = 0.7  # [s] by which a diagnosis may come later than the stall that it tells
SINGULAR = 2.0  # times the threshold of damping: the state of now, not of the moment of the diagnosis


def failures(robot: Robot, s: "Seen") -> list[str]:
    """Return what a run broke, [] when nothing."""
    out = []
    c = s.contact
    if c is not None and c.cause == "self":
        out.append(f"the arm touched itself: {c.link}, {c.other.removeprefix('self:')} at {c.time:.3f} s")
    elif c is not None and c.arm_m_s > CLOSING:
        out.append(f"{c.link} ran into {c.other} at {c.arm_m_s:.3f} m/s, {c.time:.3f} s")
    elif c is not None and not at_limit(s):
        out.append(f"{c.other} ran {c.link} down, which fled at {s.retreat:.3f} of {s.can_retreat:.3f} m/s")
    if not s.finite:
        out.append("not a number")
    for what, ratio, bound in (
        ("torque", s.torque, 1.0),
        ("torque rate", s.rate, 1.0 + 1e-9),
        ("joint speed", s.joint_speed, 1.0),
        ("tip speed", s.tip_speed, 1.0 + TIP_TOLERANCE),
    ):
        if not ratio <= bound:
            out.append(f"{what} at {ratio:.4f} of its limit")
    if not s.margin >= 0.0:
        out.append(f"a joint {-s.margin:.4f} rad beyond its limit")
    wrong = set(s.faults) - {"contact", "goal_in_obstacle"}
    if wrong:
        out.append(f"fault {', '.join(sorted(wrong))}")
    if s.diagnosis:
        out.append(f"untrue: {s.diagnosis}")
    return out


def at_limit(s: "Seen") -> bool:
    """Return whether an arm that was run down fled at its limit."""
    bound = max(s.recent_torque, s.recent_speed, s.recent_tip) >= AT_LIMIT
    return bound or s.retreat >= AT_LIMIT * s.can_retreat


def diagnosis(servo: ArmServo, watch: "Watch", status: str, detail: str) -> str:
    """Return what is untrue of the last status of an arm that did not arrive, '' when it is borne out."""
    m, robot, plant = servo.memory, servo.robot, watch.plant
    if m.goal is None:
        return _why_no_goal(servo, plant)
    wide = robot.avoid.rho0 + robot.avoid.look_ahead * 0.5 * robot.motion.v_max
    stall = round(robot.stop.stall / robot.dt)
    rest = _speed(watch.path_of[-stall:], robot.dt) if len(watch.path_of) > stall else np.inf
    if status == "moving" and _creeps(servo, watch):
        return "moving, yet it gets no nearer to its goal"
    if status in ("moving", "escaping"):
        return "" if rest > REST or m.still < stall else f"{status}, at {1e3 * rest:.1f} mm/s for {robot.stop.stall} s"
    if rest > 4.0 * REST and status != "shadowed":
        return f"{status}, yet the tip moves at {1e3 * rest:.1f} mm/s"
    if status in ("limited", "shadowed", "local_minimum", "saturated"):
        told = [_untrue(servo, plant, wide, status, part) for part in detail.split("; ")]
        return "; ".join(part for part in told if part)
    if status in ("singular", "unreachable"):
        sigma = least_eigenvalue(robot, plant, [i for i in range(6) if int(m.goal.task) >> i & 1])
        bound = SINGULAR * robot.motion.epsilon
        return "" if sigma < bound else f"{status}, with {sigma:.3g} of {robot.motion.epsilon:g}"
    return f"status {status} of an arm {watch.legs[-1].error:.3f} m short"


def _creeps(servo: ArmServo, watch: "Watch") -> bool:
    """Return whether a tip has come nearer to its goal by no pace worth the word for longer than a diagnosis takes."""
    m, robot = servo.memory, servo.robot
    assert m.goal is not None
    rows = range(len(watch.path_of) - round((robot.stop.stall + LATE) / robot.dt), len(watch.path_of), 20)
    if rows.start < 0 or _speed(watch.path_of[rows.start :], robot.dt) > CREEP:
        return False
    left = []
    for k in rows:
        error, turn = error_of(m.goal, watch.path_of[k], R_of(watch.turn_of[k]))
        left.append(max(error / robot.motion.v_max, turn / robot.motion.w_max))
    return left[0] - min(left) < min(SLOW * robot.stop.stall, 0.4 * left[0])


def _untrue(servo: ArmServo, plant: Plant, wide: float, status: str, detail: str) -> str:
    """Return what is untrue of one of those that are said to hold the arm, '' when it is borne out."""
    m, robot = servo.memory, servo.robot
    name, _, rest = detail.partition(" at ")
    if status == "limited":
        i = robot.joints.index(name)
        margin = plant.q[i] - robot.q_min[i] if "lower" in rest else robot.q_max[i] - plant.q[i]
        zone = float(robot.limit.rho0[i])
        return "" if margin < zone + 0.01 else f"limited by {detail}, which has {margin:.3f} rad to go"
    if status == "saturated":
        i = robot.joints.index(name)
        ratio = abs(m.sent[0][i]) / robot.tau_max[i]
        return "" if ratio > 0.9 else f"saturated by {detail}, which has {ratio:.2f} of its torque"
    if status == "shadowed":
        assert m.goal is not None
        gap = goal_gap(plant, name, m.goal.position)
        return "" if gap < wide else f"shadowed by {detail}, {gap:.3f} m from the goal"
    if " and " in detail:  # two links
        own = plant.self_clearance()
        return "" if own < robot.self_avoid.rho0 + OVERHANG else f"local_minimum of {detail}, {own:.3f} m apart"
    if not rest:
        return f"local_minimum with {detail or 'nothing'} that holds the arm"
    gap = plant.clearances().get(name, np.inf)
    return "" if gap < wide + OVERHANG else f"local_minimum at {detail}, which is {gap:.3f} m away"


def _why_no_goal(servo: ArmServo, plant: Plant) -> str:
    """The goal was given up: refused, or the arm was stopped by an obstacle that came onto its points."""
    said = [f"{name} {detail}" for _, name, detail in servo.events if name in ("fault", "rejected")]
    if not any("contact" in line for line in said):
        return f"no goal: {'; '.join(said) or 'nothing said'}"
    nearest = min(plant.clearances().values(), default=np.inf)
    return "" if servo.memory.reaction else f"contact, with the nearest obstacle {nearest:.3f} m away"


def _speed(path: list[F64], dt: float) -> float:
    """Return the mean speed [m/s] along a path, a row a period."""
    return (
        float(np.linalg.norm(np.diff(path[::20], axis=0), axis=1).sum() / (len(path) * dt)) if len(path) > 40 else 0.0
    )


def goal_gap(plant: Plant, name: str, goal: F64) -> float:
    """Return the distance [m] of a goal to an obstacle, by pybullet."""
    body = plant.bodies.get(name, -1)
    if body < 0:
        return np.inf
    ball = pb.createCollisionShape(pb.GEOM_SPHERE, radius=1e-4, physicsClientId=plant.client)
    probe = pb.createMultiBody(0.0, ball, -1, goal.tolist(), physicsClientId=plant.client)
    points = pb.getClosestPoints(probe, body, 10.0, physicsClientId=plant.client)
    pb.removeBody(probe, physicsClientId=plant.client)
    return min((float(p[8]) for p in points), default=np.inf)


def least_eigenvalue(robot: Robot, plant: Plant, rows: list[int]) -> float:
    """Return the least eigenvalue [1/kg] of the rows of J A^-1 J^T, angular ones scaled by the length, by pybullet."""
    q, zero = plant.q, [0.0] * robot.n
    A = np.array(pb.calculateMassMatrix(plant.body, q, physicsClientId=plant.client)) + np.diag(plant.armature)
    state = pb.getLinkState(plant.body, plant.tip, computeForwardKinematics=1, physicsClientId=plant.client)
    at, _ = pb.multiplyTransforms(*pb.invertTransform(*state[:2]), state[4], (0.0, 0.0, 0.0, 1.0))
    J = np.vstack(pb.calculateJacobian(plant.body, plant.tip, at, q, zero, zero, physicsClientId=plant.client))
    J[3:] *= robot.motion.length
    return float(np.linalg.eigvalsh(J[rows] @ np.linalg.solve(A, J[rows].T))[0])
