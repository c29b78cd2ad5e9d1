"""The paper's experiment with your arm: straight to a goal under the speed limit, then the decay of a unit mass.

python docs/examples/straight_line.py configs/planar4.toml
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import rtctl

SCENE = """
robot = "{robot}"
duration_s = {seconds}
start_q_rad = {start}
[[goal]]
at_s = 0.3
position_m = {goal}
"""


def run(robot: Path, start: list[float], goal: list[float], seconds: float, folder: Path) -> tuple[float, float]:
    """Return how far [m] the tip left the straight line, and its top speed [m/s]."""
    scene, log = folder / "line.toml", folder / "line.mcap"
    scene.write_text(SCENE.format(robot=robot.resolve(), start=start, goal=goal, seconds=seconds))
    figures = rtctl.simulate(scene, log=log)
    tick = rtctl.read(log)["/tick"].load("x", "xd")
    speed = np.linalg.norm(tick.xd, axis=1)
    print(f"off the line {figures['goals'][0]['line_deviation_m'] * 1e3:.2f} mm, top speed {speed.max():.3f} m/s")
    return figures["goals"][0]["line_deviation_m"], float(speed.max())


def draw(log: Path, picture: Path) -> None:
    """Draw speed over time of a log."""
    from matplotlib import pyplot

    tick = rtctl.read(log)["/tick"].load("xd", "time")
    figure, axes = pyplot.subplots(figsize=(6, 3), layout="constrained")
    axes.plot(tick.field("time"), np.linalg.norm(tick.xd, axis=1))
    axes.set(xlabel="t [s]", ylabel="speed of the tip [m/s]")
    figure.savefig(picture)
    pyplot.close(figure)


if __name__ == "__main__":
    config = Path(sys.argv[1] if len(sys.argv) > 1 else "configs/planar4.toml")
    with tempfile.TemporaryDirectory() as name:
        run(config, [0.6, -0.5, -0.6, -0.5], [1.2, 0.4, 0.0], 5.0, Path(name))
        draw(Path(name) / "line.mcap", Path("straight_line.png"))
