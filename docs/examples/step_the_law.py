"""The law, stepped by hand: a tick, then your own physics for a period, then the next tick.

python docs/examples/step_the_law.py configs/panda.toml path.png
"""

import sys
from pathlib import Path

import numpy as np

import rtctl
from rtctl.types import Command, Drive, Feedback, Goal, Request, Task, Verb

NOTHING = Request()


class Bench:
    """An arm without wires: the pure tick, and between two ticks A qdd + h + g = tau, integrated."""

    def __init__(self, config: str | Path) -> None:
        self.robot = rtctl.load(config)
        self.q = np.array(self.robot.home)  # (n,) [rad] begin where the config says
        self.qd = np.zeros(self.robot.n)
        self.memory = rtctl.initial(self.robot, self.q)
        self.sent = Command(Drive.DISABLE, np.zeros(self.robot.n))
        self.slot = 0
        self.ticks: list[np.ndarray] = []  # a record a tick

    def step(self, request: Request = NOTHING) -> None:
        """Run one tick, then the physics for its period."""
        n, enabled = self.robot.n, self.sent.drive in (Drive.ENABLE, Drive.TORQUE)
        feedback = Feedback(
            slot=self.slot,
            missed=0,
            q=self.q,
            qd=self.qd,
            tau=self.sent.tau if enabled else np.zeros(n),
            age=np.zeros(n),
            replies=np.ones(n, np.int64),
            drive=np.full(n, int(enabled)),
            link=0,
            lateness=0.0,
            compute=0.0,
        )
        self.memory, self.sent, record = rtctl.tick(self.robot, self.memory, feedback, request)
        self.ticks.append(record[0])
        self.slot += 1
        if self.sent.drive == Drive.TORQUE:  # else the brakes hold it
            model = self.robot.body.evaluate(self.q, self.qd, self.robot.points, self.robot.own)
            qdd = np.linalg.solve(model.A, self.sent.tau - model.h - model.g)
            self.qd = self.qd + self.robot.dt * qdd
            self.q = self.q + self.robot.dt * self.qd

    def arm(self) -> None:
        """Enable the drives and wait until they hold."""
        self.step(Request(verb=Verb.ARM))
        while self.memory.state.name != "RUN":
            self.step()

    def go(self, position: np.ndarray, seconds: float) -> None:
        """Send the tip to a position (3,) [m] and run for some seconds."""
        goal = Goal(np.asarray(position, float), np.array([1.0, 0, 0, 0]), Task.POSITION, 0.003, 0.015)
        self.step(Request(goal=goal))
        for _ in range(round(seconds / self.robot.dt)):
            self.step()

    def column(self, name: str) -> np.ndarray:
        """Return a field of all ticks; `rtctl log plot run.mcap --list` names them."""
        return np.array([tick[name] for tick in self.ticks])


def play(config: str | Path) -> Bench:
    """Return a bench after a move of 15 cm to the side and 10 cm down."""
    bench = Bench(config)
    bench.arm()
    bench.go(bench.memory.tip.x + np.array([0.0, 0.15, -0.10]), 1.5)
    return bench


def draw(bench: Bench, path: str | Path) -> None:
    """Draw the distance to the goal and the torques over time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    above.semilogy(bench.column("time"), 1e3 * bench.column("error"))
    above.set_ylabel("to the goal [mm]")
    below.plot(bench.column("time"), bench.column("tau_sent"))
    below.set_ylabel("torque [Nm]")
    below.set_xlabel("t [s]")
    figure.savefig(path)


if __name__ == "__main__":
    played = play(sys.argv[1])
    print(f"{1e3 * played.column('error')[-1]:.2f} mm from the goal after {played.column('time')[-1]:.2f} s")
    draw(played, sys.argv[2])
