"""What `import rtctl` offers beside `rtctl.app.plan.plan`: names that are kept, each with its shapes and units.

n is the number of joints, K the number of obstacle slots, N the number of ticks in a log.
"""

from pathlib import Path

import numpy as np

from rtctl import design
from rtctl.app.arm_link import first_feedback
from rtctl.app.sim import simulate
from rtctl.arm.memory import Memory
from rtctl.arm.pipe import initial as _initial
from rtctl.arm.pipe import tick
from rtctl.arm.robot import Robot
from rtctl.errors import ConfigError
from rtctl.log.read.run import read_run as read
from rtctl.types import F64

__all__ = ["Robot", "initial", "load", "read", "simulate", "tick"]


def load(path: str | Path) -> Robot:
    """Return the constants of the arm that a config file describes.

    robot.n joints; robot.q_min, q_max (n,) [rad]; robot.tau_max (n,) [Nm]; robot.dt [s]. Raises ConfigError, which
    names file, key, what came and what was wanted.
    """
    if design.is_base(str(path)):
        raise ConfigError(f"{path}: robot.kind", "base", "arm: a rover is simulated with rtctl.simulate")
    return design.build(design.load(path), path)


def initial(robot: Robot, q: F64) -> Memory:
    """Return the memory before the first tick: drives off, at rest at q (n,) [rad].

    memory.joints.q, .qd (n,) [rad], [rad/s]; memory.tip.x (3,) [m]; memory.model.A (n, n) [kg m2]; memory.state.
    """
    at = np.asarray(q, np.float64)
    if at.shape != (robot.n,):
        raise ConfigError("q", f"shape {at.shape}", f"({robot.n},), one angle a joint of {robot.name}")
    return _initial(robot, first_feedback(at))
