"""The paper's first experiment with your arm: straight to the goal under the speed limit, then round a ball in the way.

python docs/examples/paper_with_my_arm.py configs/panda.toml line.png
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import rtctl

SCENARIO = """
robot = "{robot}"
duration_s = {seconds}
[[goal]]
at_s = 0.5
position_m = {goal}
"""
BALL = """
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = 0.03
position_m = {middle}
"""


def play(
    config: str | Path, aside: float = 0.45, seconds: float = 6.0
) -> dict[str, tuple[dict, np.ndarray, np.ndarray]]:
    """Return of the ways without and with a ball: figures, places of the tip (N, 3) [m], speeds (N,) [m/s].

    aside: [m] from where the tip begins to its goal, along y.
    """
    config = Path(config).resolve()
    robot = rtctl.load(config)
    begin = rtctl.initial(robot, robot.home).tip.x
    goal, found = begin + np.array([0.0, aside, 0.0]), {}
    with tempfile.TemporaryDirectory() as folder:
        text = SCENARIO.format(robot=config, seconds=seconds, goal=goal.round(4).tolist())
        middle = 0.5 * (begin + goal) + np.array([0.03, 0.0, 0.02])  # a ball dead ahead could only be waited for
        for name, more in (("free", ""), ("ball", BALL.format(middle=middle.round(4).tolist()))):
            file, log = Path(folder) / f"{name}.toml", Path(folder) / f"{name}.mcap"
            file.write_text(text + more)
            figures = rtctl.simulate(file, log=log)
            ticks = rtctl.read(log)["/tick"].load("x", "xd")
            found[name] = figures, ticks.x, np.linalg.norm(ticks.xd, axis=1)
    return found


def draw(found: dict[str, tuple[dict, np.ndarray, np.ndarray]], path: str | Path) -> None:
    """Draw both ways from the side, and the speeds."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1)
    for name, (_, x, speed) in found.items():
        above.plot(x[:, 1], x[:, 2], label=name)
        below.plot(np.arange(len(speed)), speed, label=name)
    above.set(xlabel="y [m]", ylabel="z [m]", aspect="equal")
    below.set(xlabel="tick", ylabel="speed of the tip [m/s]")
    above.legend()
    figure.savefig(path)


if __name__ == "__main__":
    ways = play(sys.argv[1])
    for name, (figures, _, _) in ways.items():
        print(f"{name}: arrived {figures['arrived']}, {1e3 * figures['line_deviation_m']:.1f} mm off the line")
    draw(ways, sys.argv[2])
