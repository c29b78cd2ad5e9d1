"""What a campaign costs beside its runs: processor time of client and scheduler for a run that does nothing.

python -m tools.campaign_cost
"""

import sys
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from rtctl.campaign.case import Asked, Case, Scene
from rtctl.campaign.engine import perform
from rtctl.plain import Json

FEW, MANY = 100, 1100  # runs of the two campaigns; their difference leaves the start out
WORKERS = 1


class Nothing:
    """Cases whose runs do nothing; their configs are as long as real ones."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        """Yield the cases."""
        text = (Path(__file__).parents[1] / "configs" / "panda.toml").read_text(encoding="utf-8")
        for number in range(asked.scenes):
            yield Case("tools.campaign_cost", "panda", text, 0, number)

    def scene(self, case: Case) -> Scene:
        """Return an empty scene."""
        return Scene({}, Path("scenario.toml"))

    def play(self, case: Case, scene: Scene, config: Path) -> Json:
        """Return a row of nothing."""
        return {"outcome": "arrived", "failures": ""}


def cost(runs: int) -> float:
    """Return the processor time [s] of client and scheduler, which are this process."""
    rows = []
    begun = time.process_time()
    perform(source.cases(Asked((), range(1), runs, {})), lambda row, crew: rows.append(row["key"]), WORKERS)
    assert len(set(rows)) == runs
    return time.process_time() - begun


source = Nothing()


def main() -> int:
    """Print the cost of a run."""
    import_module("distributed")  # once, and no cost of a run
    few = cost(FEW)
    print(f"{few:.2f} s to begin, play {FEW} and end", flush=True)
    each = (cost(MANY) - few) / (MANY - FEW)
    print(f"{1e3 * each:.2f} ms of client and scheduler a run")
    return 0


if __name__ == "__main__":
    sys.exit(main())
