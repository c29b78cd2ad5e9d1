"""Rows of the benchmark: how a time is taken, and what a figure says."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from rtctl.hal import clock
from rtctl.types import F64, I64

PRIORITY = 80


class Row(NamedTuple):
    """One figure [us]; `ratio` where there is something to compare with."""

    part: str
    name: str
    p50: float | None
    p99: float | None
    ratio: float | None = None  # to `rival`, of the medians unless the note says otherwise
    rival: str = ""
    note: str = ""


def row(part: str, name: str, ns: "I64 | F64 | list[int]", **more: Any) -> Row:
    """Return the row of measured times [ns]."""
    values = np.asarray(ns, np.float64) * 1e-3
    return Row(part, name, float(np.median(values)), float(np.percentile(values, 99)), **more)


def timed(call: Callable[[], object], count: int) -> I64:
    """Return the time [ns] of each of `count` calls."""
    now, out = time.perf_counter_ns, np.empty(count, np.int64)
    for i in range(count):
        begin = now()
        call()
        out[i] = now() - begin
    return out


@contextmanager
def urgent() -> Iterator[str]:
    """Run under SCHED_FIFO as the daemon does, if that is granted; give the policy's name."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        yield f"SCHED_OTHER ({error.strerror})"
        return
    try:
        with clock.light_sleep():
            yield f"SCHED_FIFO {PRIORITY}"
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
