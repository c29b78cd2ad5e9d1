"""Your own obstacle: any of the shapes, put into the way, and how near the arm comes to it.

python docs/examples/your_own_obstacle.py
"""

import tempfile
from pathlib import Path

import numpy as np

import rtctl

SCENE = """
robot = "{robot}"
duration_s = 6.0
start_q_rad = [0.6, -0.5, -0.6, -0.5]

[[goal]]
at_s = 0.3
position_m = [1.2, 0.4, 0.0]

[[obstacle]]
name = "pillar"
type = "n_ellipsoid"             # the paper's: n = 1 an ellipsoid, n = 4 nearly a box
semi_axes_m = [0.10, 0.06, 0.5]
n = 4
position_m = {place}
"""


def run(robot: Path, place: list[float], folder: Path) -> tuple[float, float]:
    """Return the least clearance [m] that the oracle and that the controller's spheres saw."""
    scene, log = folder / "pillar.toml", folder / "pillar.mcap"
    scene.write_text(SCENE.format(robot=robot.resolve(), place=place))
    figures = rtctl.simulate(scene, log=log)
    rho = rtctl.read(log)["/tick"].rho  # (N, K) [m] by slot, infinite where there is none
    oracle, own = figures["min_clearance_m"]["pillar"], float(np.min(rho))
    print(f"arrived {figures['arrived']}; clearance: oracle {oracle * 1e3:.0f} mm, spheres {own * 1e3:.0f} mm")
    return oracle, own


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        run(Path("configs/planar4.toml"), [1.75, 0.75, 0.0], Path(name))
