"""The inputs of the tick, out of a log: what a replay feeds to `control.pipe.tick`, bit for bit."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.reader import Log
from rtctl.log.request import decode_request
from rtctl.types import Feedback, Request


class Logged(NamedTuple):
    """One tick as it was logged."""

    record: Any  # one element of `Header.dtype`: also what came out
    feedback: Feedback
    request: Request


def feedback_of(record: Any) -> Feedback:
    """Return the feedback that a record was made from."""
    return Feedback(
        slot=int(record["slot"]),
        missed=int(record["missed"]),
        q=np.array(record["q"], dtype=np.float64),
        qd=np.array(record["qd"], dtype=np.float64),
        tau=np.array(record["tau_measured"], dtype=np.float64),
        age=np.array(record["age"], dtype=np.float64),
        replies=np.array(record["replies"], dtype=np.int64),
        drive=np.array(record["drive"], dtype=np.int64),
        link=int(record["link"]),
        lateness=float(record["lateness"]),
        compute=float(record["compute"]),
    )


def requests_of(log: Log) -> dict[int, Request]:
    """Return the requests by the tick they reached; ticks that were asked nothing are absent.

    Raises LogError when one cannot be read: a replay without it would not be one.
    """
    found = {}
    for payload in log[schema.REQUEST].payloads:
        try:
            tick, request = decode_request(payload)
        except (ValueError, RecursionError) as error:
            raise LogError(f"{log.path}: {error}") from None
        found[tick] = request
    return found


def inputs(logs: Iterable[Log]) -> Iterator[Logged]:
    """Yield the ticks of a log's segments, in order.

    Raises LogError where a tick is missing: what follows depends on it.
    """
    expected = -1
    for log in logs:
        requests = requests_of(log)
        for record in log[schema.TICK].array:
            tick = int(record["tick"])
            if expected not in (-1, tick):
                raise LogError(f"{log.path}: ticks {expected} to {tick - 1} are missing; what follows depends on them")
            expected = tick + 1
            yield Logged(record, feedback_of(record), requests.get(tick, Request()))
