"""A log's MAVLink packets as a .tlog: what ground stations and pymavlink's tools read."""

import struct
from collections.abc import Iterable
from pathlib import Path

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.read.reader import Log, read, segments

STAMP = struct.Struct(">Q")  # [us] of the Unix epoch, before each packet


def packets(logs: Iterable[Log], links: Iterable[str] = ()) -> list[tuple[int, bytes]]:
    """Return (log_time [ns], packet) of all links, or those named, both ways, in the order of time."""
    found: list[tuple[int, bytes]] = []
    for log in logs:
        for name in links or log.header.links:
            for way in ("rx", "tx"):
                topic = log[schema.mavlink_topic(name, way)]
                found += zip(topic.time.tolist(), map(schema.mavlink_packet, topic.payloads), strict=True)
    found.sort(key=lambda row: row[0])
    return found


def export_tlog(log: Path | str, out: Path | str) -> int:
    """Write every MAVLink packet of a log (all its segments) to `out`; return how many. Raises LogError."""
    logs = [read(path) for path in segments(log)]
    if not any(each.header.links for each in logs):
        raise LogError(f"{log}: has no MAVLink link")
    rows = packets(logs)
    with open(out, "wb") as file:
        for time, raw in rows:
            file.write(STAMP.pack(time // 1000) + raw)
    return len(rows)
