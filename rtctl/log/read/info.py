"""What a log is, at a glance: from its end when it is whole, by reading it when it is not."""

from pathlib import Path

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.mcap.names import INFO
from rtctl.log.mcap.summary import WRAP
from rtctl.log.read.examine import missing_numbers
from rtctl.log.read.reader import Log, read
from rtctl.plain import Json


def info(path: Path | str) -> Json:
    """Return duration; per topic n, Hz and sequence holes; dropouts, exit cause, versions, config hash.

    Raises LogError when the file cannot be read or is not an MCAP file.
    """
    log = read(path)
    start, stop = log.span
    duration = (stop - start) / 1e9
    counts = log.counts
    dropouts = log[schema.DROPOUT].json if schema.DROPOUT in counts else []
    return {
        "path": str(path),
        "bytes": log.size,
        "complete": log.complete,
        "torn_bytes": 0 if log.complete else log.size - log.good,
        "start_ns": start,
        "end_ns": stop,
        "duration_s": duration,
        "beyond_2_63_ns": log.beyond,
        "topics": {
            name: {
                "messages": n,
                "hz": (n - 1) / duration if duration > 0.0 and n > 1 else 0.0,
                "holes": holes(log, name, n, first, last),
                "schema": log.schema_of(name),
            }
            for name, (n, first, last) in sorted(counts.items())
        },
        "dropouts": {"messages": len(dropouts), "entries": sum(_count(d) for d in dropouts)},
        "damaged_chunks": log.damaged,
        "sentinel": log.sentinel,
        **_origin(log),
    }


def holes(log: Log, name: str, count: int, first: int, last: int) -> int:
    """Return how many sequence numbers a topic lacks; 0 where another program's do not count its messages."""
    if INFO in log.metadata:
        return (last - first + 1 - count) % WRAP if first or last else 0
    return sum(missing_numbers(numbers) or 0 for numbers in log.sequences(name))


def _count(dropout: Json) -> int:
    count = dropout.get("count", 0)
    return count if isinstance(count, int) else 0


def _origin(log: Log) -> Json:
    """Return what the header says; {} for the logs of other programs."""
    try:
        header = log.header
    except LogError:
        return {}
    return {
        "robot": header.robot,
        "joints": list(header.joints),
        "period_s": header.period,
        "versions": dict(header.versions),
        "revision": header.revision,
        "config_sha256": header.config_sha256,
        "extra": dict(header.extra),
        "attachments": {name: len(data) for name, data in log.attachments.items()},
    }
