"""A law of your own against the same drives: yours drives, and what keeps the arm from harm stays.

python docs/examples/own_controller.py configs/panda.toml law.png
rtctl sim demo --law docs/examples/own_controller.py:sway
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import rtctl

SWING, SECONDS = 0.7, 4.0  # [rad] of the first joint to each side, once in that time
STIFFNESS, DAMPING = 100.0, 20.0  # [1/s2], [1/s]
RADIUS = 0.06  # [m] of the ball
SCENE = """
robot = "{robot}"
duration_s = {seconds}
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = {radius}
position_m = {place}
"""


def swayed(robot: rtctl.Robot, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return joints (n,) [rad] and speeds (n,) [rad/s] at t [s] of a motion that knows nothing of obstacles."""
    rate, q, qd = 2.0 * np.pi / SECONDS, np.array(robot.home), np.zeros(robot.n)
    q[0] += SWING * np.sin(rate * t)
    qd[0] = SWING * rate * np.cos(rate * t)
    return q, qd


def sway(robot: rtctl.Robot, memory, feedback) -> np.ndarray:
    """Return the torques (n,) [Nm] of the law: A (k (q_ref - q) + d (qd_ref - qd)); gravity is given beside it."""
    q, qd = swayed(robot, memory.tick * robot.dt)
    joints = memory.joints
    return memory.model.A @ (STIFFNESS * (q - joints.q) + DAMPING * (qd - joints.qd))


def play(config: str | Path, folder: Path) -> tuple[dict, np.ndarray]:
    """Return the figures of a run with a ball where the tip would go, and its ticks."""
    robot = rtctl.load(config)
    furthest, rest = swayed(robot, SECONDS / 4.0)[0], np.zeros(robot.n)
    place = robot.body.evaluate(furthest, rest, robot.points, robot.own).x
    scene = SCENE.format(robot=Path(config).resolve(), seconds=SECONDS, radius=RADIUS, place=place.tolist())
    (folder / "scene.toml").write_text(scene)
    figures = rtctl.simulate(folder / "scene.toml", log=folder / "run.mcap", law=sway)
    return figures, rtctl.read(folder / "run.mcap")["/tick"]


def draw(robot: rtctl.Robot, ticks: np.ndarray, path: str | Path) -> None:
    """Draw where the law wants the first joint and where it is let, and how near the ball is."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    wanted = [swayed(robot, k * robot.dt)[0][0] for k in ticks.tick]
    above.plot(1e-9 * ticks.time, wanted, "--", label="as the law wants it")
    above.plot(1e-9 * ticks.time, ticks.q[:, 0], label="as it is")
    above.set_ylabel("joint 1 [rad]")
    above.legend()
    below.plot(1e-9 * ticks.time, 1e3 * ticks.rho[:, 0])
    below.set_ylabel("from the ball [mm]")
    below.set_xlabel("t [s]")
    figure.savefig(path)


if __name__ == "__main__":
    with TemporaryDirectory() as made:
        found, log = play(sys.argv[1], Path(made))
        near, touched = found["min_clearance_m"]["ball"], found["contacts"]
        print(f"{1e3 * near:.0f} mm from the ball at the least, {touched} contacts")
        draw(rtctl.load(sys.argv[1]), log, sys.argv[2])
