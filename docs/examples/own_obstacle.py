"""An obstacle of your own: a shape and a motion that no file describes, told to the law as a camera would tell it.

python docs/examples/own_obstacle.py configs/panda.toml clearance.png
"""

import sys
from pathlib import Path

import numpy as np
from step_the_law import Bench

from rtctl.types import ObstacleEdit, Request, Shape

PERIOD = 0.02  # [s] a camera of 50 Hz
RADIUS = 0.06  # [m]


def shape(position: np.ndarray, velocity: np.ndarray) -> Shape:
    """Return a sphere at position (3,) [m] that moves with velocity (3,) [m/s]; docs/obstacles.md has the others."""
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    return Shape("pendulum", "sphere", np.array([RADIUS, 0, 0, 0]), position, upright, velocity, np.zeros(3))


def pendulum(t: float, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return place (3,) [m] and velocity (3,) [m/s] of what swings by 25 cm about a middle, once in 3 s."""
    phase = 2.0 * np.pi * t / 3.0
    swing = np.array([0.0, 0.25, 0.0])
    return middle + np.cos(phase) * swing, -2.0 * np.pi / 3.0 * np.sin(phase) * swing


def play(config: str | Path, seconds: float = 3.0) -> tuple[Bench, np.ndarray]:
    """Return a bench that held its place while the pendulum swung past, and the way between them (N,) [m]."""
    bench = Bench(config)
    bench.arm()
    middle = bench.memory.tip.x + np.array([RADIUS + 0.05, 0.0, 0.0])
    every, gaps = round(PERIOD / bench.robot.dt), []
    for k in range(round(seconds / bench.robot.dt)):
        place, velocity = pendulum(k * bench.robot.dt, middle)
        edit = ObstacleEdit("pendulum", shape(place, velocity))
        bench.step(Request(obstacles=(edit,)) if k % every == 0 else Request())
        points = bench.robot.body.evaluate(bench.q, bench.qd, bench.robot.points, bench.robot.own).P
        gaps.append((np.linalg.norm(points - place, axis=1) - bench.robot.points.radius).min() - RADIUS)
    return bench, np.array(gaps)


def draw(bench: Bench, gaps: np.ndarray, path: str | Path) -> None:
    """Draw how near the pendulum came, and how far the tip gave way."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    time, x = bench.column("time")[-len(gaps) :], bench.column("x")[-len(gaps) :]
    above.plot(time, 1e3 * gaps)
    above.set_ylabel("clearance of the spheres [mm]")
    below.plot(time, 1e3 * np.linalg.norm(x - x[0], axis=1))
    below.set_ylabel("tip from its place [mm]")
    below.set_xlabel("t [s]")
    figure.savefig(path)


if __name__ == "__main__":
    played, way = play(sys.argv[1])
    print(f"the pendulum came as near as {1e3 * way.min():.0f} mm to the spheres")
    draw(played, way, sys.argv[2])
