"""A log into pandas: a row a tick, a column a joint.

pip install pandas
python docs/examples/log_to_pandas.py run.mcap
"""

import sys
from pathlib import Path

import pandas as pd

import rtctl


def frame(path: Path) -> pd.DataFrame:
    """Return torques [Nm], distance to the goal [m] and nearest obstacle [m] of a log, by robot time [s]."""
    log = rtctl.read(path)
    tick = log["/tick"].load("tau_sent", "error", "rho", "time")
    table = pd.DataFrame(tick.tau_sent, columns=[f"tau {name}" for name in log.header.joints])
    table["error"], table["nearest"] = tick.error, tick.rho.min(axis=1)
    table.index = pd.Index(tick.field("time"), name="t [s]")
    return table


if __name__ == "__main__":
    found = frame(Path(sys.argv[1]))
    print(found.describe().loc[["min", "mean", "max"]].round(3).T)
