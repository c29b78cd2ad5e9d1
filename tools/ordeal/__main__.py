"""Random steps with a daemon and its drives, judged by the drives, the plant, the process table and the logs.

    python -m tools.ordeal                          # 100000 steps: some hours
    python -m tools.ordeal --steps 200 --seed 7     # a failing run is the same again up to the machine's timing

After every kill and every end: no torque, brakes closed, no motion, by the drives' own account; none of the daemon's
processes left; every log read whole by the mcap package. At any time: the daemon lives, answers, and opens no more
descriptors than it closes; no torque in IDLE or FAULT. Exit status 0 when all of it was so.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from tools.ordeal.clock import WallClock
from tools.ordeal.pair import Failed, Pair
from tools.ordeal.steps import HEAVY, STEPS, World, look, terminate

LOOK = 0.01  # share of the steps after which everything is looked at


class Account(NamedTuple):
    """What became of an ordeal."""

    steps: Counter[str]
    lives: int  # of daemons
    messages: int  # read from their logs
    failure: str  # '' for none


def ordeal(
    folder: Path, steps: int, seed: int, say: Callable[[str], None] = lambda text: None, heavy: float = 1.0
) -> Account:
    """Return what became of random steps; heavy: how much more often than usual something dies."""
    rng, done = random.Random(seed), Counter[str]()
    weights = [weight * (heavy if step in HEAVY else 1.0) for step, weight in STEPS.items()]
    pair = Pair(folder)
    world, failure = None, ""
    try:
        clock = _clock(folder, say)
        pair.environment = clock.environment if clock else None
        world = World(pair, rng, clock)
        for k in range(steps):
            step = rng.choices(list(STEPS), weights)[0]
            done[step.__name__] += 1
            step(world)
            world.alive()
            if rng.random() < LOOK:
                look(world)
            if k % 1000 == 999:
                say(f"{k + 1} steps, {world.lives} daemons, {world.messages} messages read")
        terminate(world)
    except Failed as error:
        failure = f"step {sum(done.values())}, {step.__name__ if done else 'start'}: {error}"
    finally:
        pair.end()
    return Account(done, world.lives if world else 0, world.messages if world else 0, failure)


def _clock(folder: Path, say: Callable[[str], None]) -> WallClock | None:
    try:
        return WallClock(folder)
    except (OSError, subprocess.CalledProcessError) as error:
        say(f"the wall clock is not set: {error}")
        return None


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.ordeal", description="Random steps, judged from outside.")
    parser.add_argument("--steps", type=int, default=100_000, help="%(default)s")
    parser.add_argument("--seed", type=int, default=1, help="%(default)s")
    parser.add_argument("--heavy", type=float, default=1.0, help="how much more often something dies (%(default)s)")
    args = parser.parse_args(argv)
    begun = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="rtctl-ordeal-"))
    account = ordeal(folder, args.steps, args.seed, lambda text: print(text, flush=True), args.heavy)
    print("  ".join(f"{name} {count}" for name, count in account.steps.most_common()))
    print(
        f"{account.steps.total()} steps in {time.monotonic() - begun:.0f} s, {account.lives} daemons, "
        f"{account.messages} messages read: {account.failure or 'all promises kept'}"
    )
    if account.failure:
        print(f"kept in {folder}")
    return 1 if account.failure else 0


if __name__ == "__main__":
    sys.exit(main())
