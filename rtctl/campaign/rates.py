"""Rates with their intervals, and the figures of a group of runs."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rtctl.plain import Json

Z95 = 1.959963984540054  # two-sided 95 % of the normal distribution
GROUPED = ("set", "robot", "variant", "plant", "faults")


class Rate(NamedTuple):
    """A share of runs and the interval that holds the true one in 95 of 100 campaigns."""

    hits: int
    of: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """The share itself."""
        return self.hits / self.of if self.of else math.nan

    def __str__(self) -> str:
        if not self.of:
            return "-"
        return f"{100 * self.share:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"


def wilson(count: int, of: int, z: float = Z95) -> Rate:
    """Return a rate with its score interval.

    (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n), with p = count/n
    (Wilson, J. Am. Stat. Assoc. 22, 1927, 209-212): it stays within 0 and 1 and is no point at 0 of n.
    """
    if of == 0:
        return Rate(0, 0, 0.0, 1.0)
    p, w = count / of, z * z / of
    middle, half = p + 0.5 * w, z * math.sqrt(p * (1.0 - p) / of + 0.25 * w / of)
    low = 0.0 if count == 0 else (middle - half) / (1.0 + w)
    high = 1.0 if count == of else (middle + half) / (1.0 + w)
    return Rate(count, of, low, high)


class Group(NamedTuple):
    """The figures of runs of one kind."""

    name: tuple[str, ...]  # the values of GROUPED
    arrived: Rate
    failed: Rate  # contact, limit, NaN, error
    time: tuple[float, float]  # [s] to the goal, median and 95 of 100
    slower: float  # median of the time to the goal over the certificate's, NaN without
    plan: tuple[float, float]  # [s] to a first way
    clearance: float  # [m] least of all
    held: tuple[tuple[str, int], ...]  # why others did not arrive


def group(name: tuple[str, ...], rows: Sequence[Json]) -> Group:
    """Return the figures of runs."""
    arrived = [row for row in rows if row["outcome"] == "arrived"]
    short = [row for row in rows if row["outcome"] != "arrived"]
    ratio = [r["time_to_goal_s"] / r["reference_s"] for r in arrived if r["reference_s"] and r["time_to_goal_s"]]
    held = Counter(_reason(row) for row in short)
    return Group(
        name,
        wilson(len(arrived), len(rows)),
        wilson(sum(bool(row["failures"]) for row in rows), len(rows)),
        quantiles(row["time_to_goal_s"] for row in arrived),
        quantiles(ratio)[0],
        quantiles(row["plan_time_s"] for row in rows),
        min((row["min_clearance_m"] for row in rows if row["min_clearance_m"] is not None), default=math.nan),
        tuple(held.most_common()),
    )


def _reason(row: Json) -> str:
    if row["outcome"] in ("contact", "limit", "nan", "error", "died", "stopped"):
        return str(row["outcome"])
    return str(row["status"] or row["outcome"])


def groups(rows: Iterable[Json], by: Sequence[str] = GROUPED) -> list[Group]:
    """Return the figures of each group in the order of the names, then those of all when there are several."""
    found: dict[tuple[str, ...], list[Json]] = {}
    for row in rows:
        found.setdefault(tuple(str(row[k] or "") for k in by), []).append(row)
    out = [group(name, found[name]) for name in sorted(found)]
    every = [row for part in found.values() for row in part]
    return [*out, group(("all", *[""] * (len(by) - 1)), every)] if len(out) > 1 else out


def quantiles(values: Iterable[float | None]) -> tuple[float, float]:
    """Return the median and 95 of 100 of the values that are there, NaN where none is."""
    there = [v for v in values if v is not None]
    return (float(np.median(there)), float(np.quantile(there, 0.95))) if there else (math.nan, math.nan)


def severity(row: Json) -> tuple[float, ...]:
    """Return what sorts the worst run first."""
    rank = {"nan": 0, "contact": 1, "limit": 2, "died": 3, "error": 4}.get(row["outcome"], 5)
    if rank == 5 and row["failures"]:
        rank = 2
    if rank == 5 and row["outcome"] == "arrived":
        return (6.0, -(row["time_to_goal_s"] or 0.0))
    return (float(rank), -(row["final_error_m"] or 0.0) - (row["final_error_rad"] or 0.0))
