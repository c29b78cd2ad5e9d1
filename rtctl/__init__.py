"""Reactive torque-level motion control in operational space.

    import rtctl

    robot = rtctl.load("configs/panda.toml")             # constants of an arm, from its file
    memory = rtctl.initial(robot, q)                      # at rest at q (n,) [rad], drives off
    memory, command, record = rtctl.tick(robot, memory, feedback, request)    # one period; pure
    figures = rtctl.simulate("configs/demo.toml", log="run.mcap")
    ticks = rtctl.read("run.mcap")["/tick"]               # ticks.q (N, n) [rad], ticks.tau_sent (N, n) [Nm]
    goals = rtctl.plan(robot, q, goal, memory.world.obstacles)

These names are kept; what stands elsewhere may move. The nouns (Feedback, Request, Goal, ...) are in `rtctl.types`.
Nothing is imported before it is used.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"
__all__ = ["Robot", "initial", "load", "plan", "read", "simulate", "tick"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'rtctl' has no attribute {name!r}; it offers {', '.join(__all__)}")
    home = "rtctl.app.plan" if name == "plan" else "rtctl.library"
    value = globals()[name] = getattr(import_module(home), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
