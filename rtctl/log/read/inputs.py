"""The inputs of the tick, out of a log: what a replay feeds to `arm.pipe.tick`, bit for bit."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rtctl.arm.record import grippers_seen
from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.mcap.walk import I64_MAX
from rtctl.log.read.reader import Log
from rtctl.log.read.topic import Structured
from rtctl.log.record.requests import decode_request
from rtctl.types import Feedback, Request

QUIET = Request()
EVERYTHING = (0, I64_MAX)


class Logged(NamedTuple):
    """One tick as it was logged."""

    record: Any  # one element of `Header.dtype`: also what came out
    feedback: Any  # Feedback of an arm, BaseFeedback of a base
    request: Request
    log_time: int  # [ns]


def feedbacks_of(records: Structured) -> Iterator[Feedback]:
    """Yield the feedback that each record was made from."""
    q, qd, tau, age = (np.ascontiguousarray(records[name]) for name in ("q", "qd", "tau_measured", "age"))
    replies, drive = (records[name].astype(np.int64) for name in ("replies", "drive"))
    grippers = grippers_seen(records)
    scalars = ("slot", "missed", "link", "lateness", "compute")
    rows = zip(*(records[name].tolist() for name in scalars), strict=True)
    for k, (slot, missed, link, lateness, compute) in enumerate(rows):
        yield Feedback(
            slot=slot,
            missed=missed,
            q=q[k],
            qd=qd[k],
            tau=tau[k],
            age=age[k],
            replies=replies[k],
            drive=drive[k],
            link=link,
            lateness=lateness,
            compute=compute,
            grippers=grippers[k],
        )


def requests_of(log: Log, span: tuple[int, int] = EVERYTHING) -> dict[int, Request]:
    """Return the requests by the tick they reached; ticks that were asked nothing are absent.

    span: of log_time [ns], as in `inputs`: a request bears its tick's. Raises LogError when one cannot be read: a
    replay without it would not be one.
    """
    found: dict[int, Request] = {}
    if schema.REQUEST not in log:
        return found
    for payload in (log[schema.REQUEST] if span == EVERYTHING else log.window(schema.REQUEST, *span)).payloads:
        try:
            tick, request = decode_request(payload)
        except (ValueError, RecursionError) as error:
            raise LogError(f"{log.path}: {error}") from None
        found[tick] = request
    return found


def inputs(
    logs: Iterable[Log],
    feedbacks: Callable[[Structured], Iterable[Any]] = feedbacks_of,
    span: tuple[int, int] = EVERYTHING,
) -> Iterator[Logged]:
    """Yield the ticks of a log's segments, in order; `feedbacks` makes them of records, an arm's unless given.

    span: of log_time [ns] from which to which, that one not included.

    Raises LogError where a tick is missing: what follows depends on it.
    """
    expected = -1
    for log in logs:
        requests = requests_of(log, span)
        for piece in log.pieces(schema.TICK) if span == EVERYTHING else (log.window(schema.TICK, *span),):
            records = piece.array
            try:
                made = list(feedbacks(records))
                ticks, times = records["tick"].tolist(), piece.time.tolist()
            except (ValueError, TypeError, KeyError) as error:  # numpy's, for a record without a field
                raise LogError(f"{log.path}: its ticks are not those of such a robot: {error}") from None
            for k, (tick, feedback) in enumerate(zip(ticks, made, strict=True)):
                if expected not in (-1, tick):
                    missing = f"ticks {expected} to {tick - 1} are missing"
                    raise LogError(f"{log.path}: {missing}; what follows depends on them")
                expected = tick + 1
                yield Logged(records[k], feedback, requests.get(tick, QUIET), times[k])
