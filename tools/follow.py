"""How an arm follows a stream of goals on a circle, with their velocity and without it, by the plant's own account.

    python -m tools.follow                                   # 10, 20, 50, 100 Hz; the same with late and lost goals
    python -m tools.follow --arm ur5 --radius 0.1 --speed 0.2
    python -m tools.follow --rates 20 --jitter 0.01 --loss 0.05

Lag: from the tip to where the circle is at that time. Jerk: third differences of the tip, over 5 periods each (over one
most of it is what the encoders' steps do to an arm at rest, too) and over one. All from one second after the stream
began until it ends. Jitter: each goal comes up to that much after its time.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtctl.app.arm import ARM, load
from rtctl.app.sim import simulate_setup
from rtctl.app.vehicle import Setup
from rtctl.spec.scenario import Scenario, TimedGoal
from rtctl.types import F64
from tools.golden import GOLDEN

CONFIGS = GOLDEN.parents[1] / "configs"
CENTRES = {"panda": (0.5, 0.0, 0.4), "ur5": (0.5, 0.1, 0.4)}
BEGIN, BEFORE = 1.5, 1.0  # [s] when the stream begins; of it that is not judged
DOWN = (0.0, 1.0, 0.0, 0.0)


class Circle(NamedTuple):
    """What is driven."""

    centre: tuple[float, float, float]  # [m]
    radius: float  # [m]
    speed: float  # [m/s]

    def at(self, t: float) -> F64:
        """Return where it is (3,) [m] `t` [s] after its beginning; it rests before."""
        a = self.speed / self.radius * max(t, 0.0)
        return np.array(self.centre) + self.radius * np.array([math.cos(a), math.sin(a), 0.0])

    def velocity(self, t: float) -> F64:
        """Return how fast it is then (3,) [m/s]."""
        a = self.speed / self.radius * t
        return self.speed * np.array([-math.sin(a), math.cos(a), 0.0])


class Stream(NamedTuple):
    """How its goals come."""

    hz: float
    fed: bool  # with their velocity
    jitter: float = 0.0  # [s] that each is late at most
    loss: float = 0.0  # share of them that never comes
    seconds: float = 5.0
    seed: int = 0


class Followed(NamedTuple):
    """What became of a stream, by the plant's account, a row a period."""

    t: F64  # (T,) [s] since the stream began
    tip: F64  # (T, 3) [m]
    lag: F64  # (T,) [m]
    dt: float  # [s]
    figures: dict[str, Any]

    def judged(self, seconds: float) -> np.ndarray:
        """Return which rows are judged."""
        return (self.t >= BEFORE) & (self.t <= seconds)

    def jerk(self, seconds: float, periods: int) -> F64:
        """Return how fast the tip's acceleration changes [m/s3], over so many periods, where it is judged."""
        x, h = self.tip[self.judged(seconds)], periods
        third = x[3 * h :] - 3.0 * x[2 * h : -h] + 3.0 * x[h : -2 * h] - x[: -3 * h]
        out: F64 = np.linalg.norm(third, axis=1) / (h * self.dt) ** 3
        return out


def goals_of(circle: Circle, stream: Stream) -> tuple[TimedGoal, ...]:
    """Return the goals of a scenario: first where the circle begins, then the stream."""
    rng, out = np.random.default_rng(stream.seed), [TimedGoal(at_s=0.0, position_m=_three(circle.at(0.0)), wxyz=DOWN)]
    for k in range(round(stream.seconds * stream.hz) + 1):
        t, late, lost = k / stream.hz, rng.uniform(0.0, stream.jitter), rng.uniform() < stream.loss
        at = max(BEGIN + t + late, out[-1].at_s + 2e-3)
        if lost:
            continue
        velocity = _three(circle.velocity(t)) if stream.fed else None
        out.append(TimedGoal(at_s=at, position_m=_three(circle.at(t)), wxyz=DOWN, velocity_m_s=velocity))
    return tuple(out)


def _three(v: F64) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def followed(setup: Setup[Any, Any, Any, Any], arm: str, circle: Circle, stream: Stream) -> Followed:
    """Play a stream; return what the plant did."""
    scenario = Scenario(robot=arm, duration_s=BEGIN + stream.seconds, goal=goals_of(circle, stream))
    t: list[float] = []
    tip: list[F64] = []

    def watch(servo: object, truth: Any, turn: object) -> None:
        t.append(truth.time - BEGIN)
        tip.append(truth.tip.copy())

    figures = simulate_setup(ARM, setup, scenario, CONFIGS / f"{arm}.toml", watch)
    times, tips = np.array(t), np.array(tip)
    lag = np.linalg.norm(tips - np.array([circle.at(each) for each in t]), axis=1)
    return Followed(times, tips, lag, float(np.median(np.diff(times))), figures)


def row(stream: Stream, found: Followed) -> str:
    """Return a line of the table."""
    judged = found.judged(stream.seconds)
    jerk, fine = found.jerk(stream.seconds, 5), found.jerk(stream.seconds, 1)
    how = f"{stream.jitter * 1e3:.0f} ms, {stream.loss:.0%}" if stream.jitter or stream.loss else ""
    return (
        f"| {stream.hz:g} | {how} | {'yes' if stream.fed else 'no'} | {found.lag[judged].mean() * 1e3:.1f} | "
        f"{found.lag[judged].max() * 1e3:.1f} | {_rms(jerk):.1f} | {jerk.max():.0f} | {_rms(fine):.0f} | "
        f"{fine.max():.0f} | {', '.join(found.figures['faults'])} |"
    )


def _rms(values: F64) -> float:
    return float(np.sqrt((values**2).mean()))


COLUMNS = (
    "Hz",
    "late, lost",
    "velocity",
    "lag, mean [mm]",
    "most",
    "jerk, rms [m/s³]",
    "most",
    "of 1 ms",
    "most",
    "faults",
)
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


def main(argv: list[str] | None = None) -> int:
    """Play the streams and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="panda", choices=sorted(CENTRES))
    parser.add_argument("--radius", type=float, default=0.05, help="[m]")
    parser.add_argument("--speed", type=float, default=0.157, help="[m/s]")
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 20.0, 50.0, 100.0], help="[Hz]")
    parser.add_argument("--jitter", type=float, nargs="+", default=[0.0, 0.01], help="[s]")
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0, 0.05], help="share; one for each jitter")
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args(argv)
    path = Path(CONFIGS / f"{arguments.arm}.toml")
    setup, circle = load(path), Circle(CENTRES[arguments.arm], arguments.radius, arguments.speed)
    print(HEAD, flush=True)
    for hz in arguments.rates:
        for jitter, loss in zip(arguments.jitter, arguments.loss, strict=True):
            for fed in (False, True):
                stream = Stream(hz, fed, jitter, loss, arguments.seconds)
                print(row(stream, followed(setup, arguments.arm, circle, stream)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
