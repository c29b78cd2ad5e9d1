"""Step the law yourself: a perfect plant of ten lines in place of drives, and the tick as a function.

python docs/examples/step_the_law.py
"""

import numpy as np

import rtctl
from rtctl.types import Command, Drive, Feedback, Goal, Request, Task, Verb


class Plant:
    """An arm whose drives give what they are sent: qdd = A(q)^-1 (tau - g(q)), slowly, without friction."""

    def __init__(self, robot: rtctl.Robot, q: np.ndarray) -> None:
        self.robot, self.q, self.qd, self.slot = robot, q.copy(), np.zeros(robot.n), 0
        self.tau, self.enabled = np.zeros(robot.n), False

    def feedback(self) -> Feedback:
        """Return what the drives would tell: q, qd, tau (n,) [rad, rad/s, Nm]."""
        n = self.robot.n
        return Feedback(
            slot=self.slot,
            missed=0,
            q=self.q.copy(),
            qd=self.qd.copy(),
            tau=self.tau.copy(),
            age=np.full(n, self.robot.dt),
            replies=np.ones(n, np.int64),
            drive=np.full(n, int(self.enabled), np.int64),
            link=0,
            lateness=0.0,
            compute=0.0,
        )

    def step(self, command: Command, model: object) -> None:
        """Go on by one period under a command; model: the tick's own A (n, n) and g (n,)."""
        self.enabled = command.drive in (Drive.ENABLE, Drive.TORQUE)
        self.tau = command.tau.copy()
        if command.drive == Drive.TORQUE:
            self.qd += self.robot.dt * model.A_inv @ (self.tau - model.g)
        else:
            self.qd[:] = 0.0  # brakes
        self.q += self.robot.dt * self.qd
        self.slot += 1


def run(config: str, q: np.ndarray, goal: np.ndarray, seconds: float) -> np.ndarray:
    """Return the tip's way (k, 3) [m] from posture q (n,) [rad] to a goal (3,) [m]."""
    robot = rtctl.load(config)
    memory, plant, way = rtctl.initial(robot, q), Plant(robot, q), []
    there = Goal(goal, np.array([1.0, 0.0, 0.0, 0.0]), robot.axes & Task.POSITION, 0.003, 0.02)
    for k in range(round(seconds / robot.dt)):
        asked = Request(Verb.ARM) if k == 0 else Request(goal=there) if k == round(0.2 / robot.dt) else Request()
        memory, command, _ = rtctl.tick(robot, memory, plant.feedback(), asked)
        plant.step(command, memory.model)
        way.append(memory.tip.x.copy())
    left = np.linalg.norm(way[-1] - goal) * 1e3
    print(f"{memory.state.name}, {memory.status.name.lower()}, {left:.1f} mm from the goal")
    return np.array(way)


if __name__ == "__main__":
    run("configs/planar4.toml", np.array([0.6, -0.5, -0.6, -0.5]), np.array([1.2, 0.4, 0.0]), 4.0)
