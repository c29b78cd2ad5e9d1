"""The same scenes through this controller and through a barrier controller of the literature, side by side.

    python -m tools.barrier                        # goals 20, 30, 40 mm beside a ball, a table, a gap, walls
    python -m tools.barrier SCENARIO.toml ...      # scenarios of an arm

The rival is the torque controller of D. Morton and M. Pavone, *Safe, Task-Consistent Manipulation with Operational
Space Control Barrier Functions*, IROS 2025: an operational-space law whose torque a quadratic program changes as little
as it can, seen in the task and in its null space, so that every barrier holds,

    min  |W_o J A^-1 (tau - tau_nom)|^2 + |W_j N A^-1 (tau - tau_nom)|^2 + w |slack|^2
    s.t. h'' + (a1 + a2) h' + a1 a2 h >= -slack      h: distance - clearance, margins of joints; |tau| <= tau_max

with h'' linear in tau. It plays on the same drives and the same plant, sees the same obstacles, has the same points for
the links, the same v_max, clearance and torque limits; the program is solved by quadprog. Both are judged by the
simulator alone. What the paper leaves to the user is stated in `Gains`.
"""

import argparse
import math
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import quadprog

from rtctl.app.arm import ARM
from rtctl.app.arm_scene import ArmPlay
from rtctl.app.sim import simulate_scenario
from rtctl.app.tally import Leg
from rtctl.app.vehicle import Turn
from rtctl.arm.model import Model
from rtctl.arm.robot import Robot
from rtctl.arm.task import within
from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError
from rtctl.kernel.rotations import R_of, log3, quat_of
from rtctl.plain import Json
from rtctl.spec.read import convert
from rtctl.spec.scenario import Scenario, goal_of, load_scenario, robot_file
from rtctl.types import F64, Command, Drive, Feedback, Goal, Shape, Task
from rtctl.world import primitives

ROOT = Path(__file__).resolve().parent.parent
PANDA = ROOT / "configs" / "panda.toml"
HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
DOWN = (0.0, 1.0, 0.0, 0.0)
NOTHING = np.zeros(0)  # a record that nobody reads


class Gains(NamedTuple):
    """What the published form leaves open."""

    kp: float = 50.0  # [1/s2] of the tip, critically damped
    kp_rot: float = 50.0
    kp_posture: float = 10.0  # [1/s2] towards the posture at rest, in the null space
    a1: float = 10.0  # [1/s] how fast a barrier may be approached
    a2: float = 10.0
    task: float = 1.0  # weight of what the tip's acceleration is changed by
    posture: float = 0.1  # and the null space's
    slack: float = 2000.0
    near: float = 0.4  # [m] pairs farther apart have no barrier
    pairs: int = 40  # the nearest of them that have


class Barrier:
    """The rival, on the joints' true model."""

    def __init__(self, robot: Robot, gains: Gains) -> None:
        self.robot, self.gains, self.failed = robot, gains, 0

    def torque(self, f: Feedback, goal: Goal | None, hold: Goal, shapes: dict[str, Shape]) -> F64:
        """Return the torque (n,) [Nm] for feedback f, on the way to a goal or holding."""
        robot, k = self.robot, self.gains
        m = robot.body.evaluate(f.q, f.qd, robot.points)
        nominal, N = self._nominal(m, f, hold if goal is None else goal)
        rows, bounds = self._barriers(m, f, shapes)
        n, A_inv = robot.n, m.A_inv
        # in accelerations a = A^-1 (tau - h - g); the slack is shared
        weight = k.task * m.J.T @ m.J + k.posture * N.T @ N + 1e-6 * np.eye(n)
        P = np.zeros((n + 1, n + 1))
        P[:n, :n], P[n, n] = weight, k.slack
        wanted = A_inv @ (nominal - m.h - m.g)
        G = [np.append(row, 1.0) for row in rows]
        b = list(bounds)
        for i in range(n):  # |tau| <= tau_max, tau = A a + h + g
            for sign in (1.0, -1.0):
                G.append(np.append(sign * m.A[i], 0.0))
                b.append(-robot.tau_max[i] - sign * (m.h + m.g)[i])
        try:
            a = quadprog.solve_qp(P, np.append(weight @ wanted, 0.0), np.array(G).T, np.array(b))[0][:n]
        except ValueError:  # nothing within the torque limits: it gives what it can
            self.failed += 1
            a = np.zeros(n)
        tau: F64 = np.clip(m.A @ a + m.h + m.g, -robot.tau_max, robot.tau_max)
        return tau

    def _nominal(self, m: Model, f: Feedback, goal: Goal) -> tuple[F64, F64]:
        """Return the operational-space torque (n,) and the null-space projector of accelerations (n, n)."""
        k, robot = self.gains, self.robot
        twist = m.J @ f.qd
        e, e_rot = goal.position - m.x, log3(R_of(goal.wxyz) @ m.R.T)
        damping, damping_rot = 2.0 * math.sqrt(k.kp), 2.0 * math.sqrt(k.kp_rot)
        v = e * k.kp / damping  # the speed wanted, no more than the limit: as the law beside which it is put
        v *= min(1.0, robot.motion.v_max / max(float(np.linalg.norm(v)), 1e-9))
        w = e_rot * k.kp_rot / damping_rot
        w *= min(1.0, robot.motion.w_max / max(float(np.linalg.norm(w)), 1e-9))
        wanted = np.concatenate((damping * (v - twist[:3]), damping_rot * (w - twist[3:])))
        S = _rows(goal.task)
        J = S @ m.J
        Lambda = np.linalg.inv(J @ m.A_inv @ J.T + 1e-4 * np.eye(len(S)))
        Jbar = m.A_inv @ J.T @ Lambda
        N = np.eye(robot.n) - Jbar @ J
        rest = k.kp_posture * (robot.q_rest - f.q) - 2.0 * math.sqrt(k.kp_posture) * f.qd
        a = Jbar @ (S @ (wanted - m.Jdqd)) + N @ rest
        return m.A @ a + m.h + m.g, N

    def _barriers(self, m: Model, f: Feedback, shapes: dict[str, Shape]) -> tuple[list[F64], list[float]]:
        """Return rows (n,) and bounds of row a >= bound, for accelerations a (n,) [rad/s2] of the joints."""
        k, robot = self.gains, self.robot
        total, product = k.a1 + k.a2, k.a1 * k.a2
        rows, bounds = [], []
        for i in range(robot.n):
            for sign, margin in ((1.0, f.q[i] - robot.q_min[i]), (-1.0, robot.q_max[i] - f.q[i])):
                rows.append(sign * np.eye(robot.n)[i])
                bounds.append(-total * sign * f.qd[i] - product * margin)
            for sign in (1.0, -1.0):
                rows.append(-sign * np.eye(robot.n)[i])
                bounds.append(-k.a1 * (robot.qd_max[i] - sign * f.qd[i]))
        ahead = robot.body.evaluate(f.q + 1e-6 * f.qd, f.qd, robot.points)
        for distance, point, normal, velocity in self._near(m, shapes):
            J = m.Jp[point]
            closing = float(normal @ (J @ f.qd - velocity))
            drift = float(normal @ ((ahead.Jp[point] - J) @ f.qd)) * 1e6
            rows.append(normal @ J)
            bounds.append(-drift - total * closing - product * (distance - robot.avoid.rho_min))
        return rows, bounds

    def _near(self, m: Model, shapes: dict[str, Shape]) -> list[tuple[float, int, F64, F64]]:
        """Return the nearest pairs: distance [m], point, normal (3,) off the obstacle, its velocity (3,) [m/s]."""
        found = []
        for shape in shapes.values():
            one = primitives.with_shape(primitives.obstacles_empty(1), 0, shape, known=self.robot.meshes)
            out = np.empty((1, 4, len(m.P)))
            primitives.distances_into(m.P.T.copy(), self.robot.points.radius, one, np.inf, out)
            for j in np.flatnonzero(out[0, 0] < self.gains.near):
                velocity = shape.velocity + np.cross(shape.omega, m.P[j] - shape.position)
                found.append((float(out[0, 0, j]), int(j), out[0, 1:, j].copy(), velocity))
        return sorted(found, key=lambda pair: pair[0])[: self.gains.pairs]


def _rows(task: Task) -> F64:
    """Return the rows of the six that a task asks for."""
    return np.eye(6)[[row for row in range(6) if int(task) >> row & 1]]


def play(scenario: Scenario, where: Path, source: Path, gains: Gains) -> tuple[Json, int]:
    """Return the figures of a scenario for the rival, and in how many periods its program had no solution."""
    play = ARM.load(where, None).simulate(scenario, source)
    assert isinstance(play, ArmPlay)
    robot, link, tally = play.robot, play.link, play.tally
    shapes: dict[str, Shape] = {}
    rival, goal, to_come = Barrier(robot, gains), None, sorted(scenario.goal, key=lambda each: each.at_s)
    with closing(link):
        start = link.greet(True)
        home = robot.body.evaluate(start.q, start.qd, robot.points)
        hold = Goal(home.x, quat_of(home.R), Task.POSE, robot.tolerance, robot.tolerance_rot)
        command, slot = Command(Drive.DISABLE, np.zeros(robot.n)), 0
        while play.look() < scenario.duration_s:
            for edit in play.simulator.obstacles():
                if edit.shape is None:
                    shapes.pop(edit.name, None)
                else:
                    shapes[edit.name] = edit.shape
            feedback = link.read(slot, 0, 0.0, 0.0)
            if to_come and play.truth.time >= to_come[0].at_s:
                pose = quat_of(robot.body.evaluate(feedback.q, feedback.qd, robot.points).R)
                goal = goal_of(to_come.pop(0), pose, robot.tolerance, robot.tolerance_rot)
                goal = goal._replace(task=within(goal.task, robot.axes)[0])
                tally.legs.append(Leg(goal, play.truth.time, play.truth.tip.copy()))
            enabled = bool((feedback.drive == 1).all())
            tau = rival.torque(feedback, goal, hold, shapes) if enabled else np.zeros(robot.n)
            command = Command(Drive.TORQUE if enabled else Drive.ENABLE, tau)
            play.add(Turn(feedback, command, NOTHING, link.write(command)))
            slot += 1
        return play.figures(()), rival.failed


def cases() -> Iterator[tuple[str, Scenario]]:
    """Yield the scenes that the tool has of its own, by name."""

    def scene(name: str, seconds: float, goal: Json, *obstacles: Json) -> tuple[str, Scenario]:
        table = {"robot": "panda.toml", "duration_s": seconds, "start_q_rad": HOME, "goal": (goal | {"at_s": 0.3},)}
        return name, convert(table | {"obstacle": obstacles}, Scenario, name)

    ahead = {"position_m": (0.5, 0.0, 0.35), "wxyz": DOWN}
    for room in (0.02, 0.03, 0.04):
        # the hand's side is 82 mm from its middle plane at this height
        ball = {"name": "ball", "type": "sphere", "radius_m": 0.05, "position_m": (0.5, 0.152 + room, 0.42)}
        yield scene(f"goal {room * 1e3:.0f} mm beside a ball", 4.0, ahead, ball)
    table = {"name": "table", "type": "plane", "position_m": (0.0, 0.0, -0.02), "normal": (0.0, 0.0, 1.0)}
    yield scene("50 mm above a table", 5.0, {"position_m": (0.5, 0.1, 0.03), "wxyz": DOWN}, table)
    columns = [
        {"name": f"c{k}", "type": "sphere", "radius_m": 0.05, "position_m": (0.52, side, 0.15 + 0.09 * (k % 5))}
        for k, side in enumerate([-0.19] * 5 + [0.19] * 5)
    ]
    yield scene("a gap of 0.38 m", 6.0, {"position_m": (0.68, 0.0, 0.33), "wxyz": DOWN}, *columns)
    wall = {"name": "wall", "type": "box", "size_m": (0.04, 0.5, 0.4), "position_m": (0.55, 0.0, 0.2)}
    yield scene("behind a wall", 12.0, {"position_m": (0.7, 0.0, 0.3)}, wall)
    low = {"name": "wall", "type": "box", "size_m": (0.4, 0.03, 0.35), "position_m": (0.55, 0.0, 0.175)}
    yield scene("from one side of a wall to the other", 8.0, {"position_m": (0.5, 0.3, 0.2)}, low)
    elbow = {"name": "rod", "type": "capsule", "radius_m": 0.03, "length_m": 0.5, "position_m": (0.15, 0.45, 0.55)}
    yield scene("a rod beside the elbow", 6.0, {"position_m": (0.1, 0.55, 0.35)}, elbow)


def row(name: str, ours: Json, rival: Json, failed: int) -> bool:
    """Print a row of the table; return whether ours arrives wherever the rival does, as soon, and touches nothing."""
    cells = [name]
    for run in (ours, rival):
        took, near = run["time_to_goal_s"], run["min_clearance_m"]["all"]
        cells += [
            f"{took:.2f} s" if run["arrived"] else f"{1e3 * run['final_error_m']:.0f} mm short",
            "-" if near is None else f"{1e3 * near:.1f}",
            str(run["contacts"]),
        ]
    cells += [f"{rival['max_speed_m_s']:.2f}", str(failed)]
    print("| " + " | ".join(cells) + " |", flush=True)
    sooner = ours["arrived"] and (not rival["arrived"] or ours["time_to_goal_s"] <= rival["time_to_goal_s"])
    clean = rival["arrived"] and rival["contacts"] == 0
    return ours["contacts"] == 0 and (sooner or not clean)


def main(arguments: list[str] | None = None) -> int:
    """Print the table; return 1 where the rival arrives untouched and ours does not, or later, or touches."""
    parser = argparse.ArgumentParser(prog="python -m tools.barrier", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("files", nargs="*", type=Path, help="scenarios of an arm (the tool's own)")
    asked = parser.parse_args(arguments)
    try:
        scenes = [(path.stem, load_scenario(path), path) for path in asked.files]
        scenes = scenes or [(name, scenario, PANDA) for name, scenario in cases()]
        figures = "arrived | nearest [mm] | contacts"
        print(f"| scene | rtctl: {figures} | barrier: {figures} | its top speed [m/s] | unsolved |")
        print("|---" * 9 + "|")
        good = 0
        for name, scenario, source in scenes:
            where = robot_file(scenario, source)
            good += row(name, simulate_scenario(scenario, where, source), *play(scenario, where, source, Gains()))
    except RtctlError as error:
        print(f"barrier: {error}", file=sys.stderr)
        return error.exit_code
    print(f"\n{good} of {len(scenes)}: touches nothing, and arrives as soon wherever the rival does without touching")
    return EXIT_OK if good == len(scenes) else EXIT_FAILED


if __name__ == "__main__":
    sys.exit(main())
