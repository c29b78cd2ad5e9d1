"""Logs in the formats of other programs: CSV, Parquet, candump, BLF, MAVLink's tlog."""

import contextlib
import csv
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, TypeVar

import numpy as np

from rtctl.errors import LogError
from rtctl.log import schema
from rtctl.log.read.fields import FIELDS, unit_of
from rtctl.log.read.run import Run
from rtctl.log.read.topic import Structured, Topic
from rtctl.log.view.mavlink import packets
from rtctl.spell import nearest
from rtctl.types import I64

if TYPE_CHECKING:
    import pyarrow as pa

T = TypeVar("T")
Progress = Callable[[int], None]  # told how many messages are done
_BRS, _ESI = 1, 2  # flags of a candump line of CAN FD


def columns(topic: Topic, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the fields asked for, all if none. Raises LogError for one that the topic does not have."""
    for name in names:
        if name not in topic.fields:
            raise LogError(f"{topic.name}: got field {name}, wanted {nearest(name, topic.fields)}")
    return names or topic.fields


def to_csv(run: Run, topic: str, names: tuple[str, ...], out: IO[str], progress: Progress) -> int:
    """Write fields of a topic, or the JSON of its messages; return how many rows."""
    writer = csv.writer(out, lineterminator="\n")
    done = 0
    for k, piece in enumerate(run.pieces(topic)):
        if not _is_array(piece):
            if k == 0:
                writer.writerow(["log_time_ns", "json"])
            rows: Iterable[tuple[object, ...]] = [
                (at, text.decode("utf-8", "replace"))
                for at, text in zip(piece.time.tolist(), piece.payloads, strict=True)
            ]
        else:
            chosen = columns(piece, names)
            if k == 0:
                kind = piece.array.dtype
                writer.writerow(["log_time_ns", *(t for name in chosen for t in titles(name, kind[name].shape))])
            parts = [
                piece.array[name].reshape(len(piece), int(np.prod(piece.array.dtype[name].shape))).tolist()
                for name in chosen
            ]
            rows = (
                (at, *(v for part in row for v in part)) for at, *row in zip(piece.time.tolist(), *parts, strict=True)
            )
        writer.writerows(rows)
        done += len(piece)
        progress(done)
    return done


def titles(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return one title per number of a field: q.0, q.1, …; force.3.x would be force.3.0."""
    found = [name]
    for size in shape:
        found = [f"{title}.{i}" for title in found for i in range(size)]
    return found


def _is_array(topic: Topic) -> bool:
    return topic.dtype is not None or topic.schema == "rtctl.CanFrame"


def to_parquet(run: Run, topic: str, names: tuple[str, ...], path: Path, progress: Progress) -> int:
    """Write a topic as Parquet: arrays as lists of fixed size, units and meanings as metadata of the columns."""
    import pyarrow.parquet as pq

    writer, done = None, 0
    with contextlib.ExitStack() as stack:
        for piece in run.pieces(topic):
            table = _table(piece, names)
            if writer is None:
                writer = stack.enter_context(pq.ParquetWriter(path, table.schema, compression="zstd"))
            writer.write_table(table)
            done += len(piece)
            progress(done)
    return done


def _table(piece: Topic, names: tuple[str, ...]) -> "pa.Table":
    import pyarrow as pa

    arrays, fields = [pa.array(piece.time, pa.timestamp("ns"))], [pa.field("log_time", pa.timestamp("ns"))]
    arrays, fields = [*arrays, pa.array(piece.sequence)], [*fields, pa.field("sequence", pa.int64())]
    if not _is_array(piece):
        arrays.append(pa.array([p.decode("utf-8", "replace") for p in piece.payloads], pa.string()))
        return pa.Table.from_arrays(arrays, schema=pa.schema([*fields, pa.field("json", pa.string())]))
    for name in columns(piece, names):
        values = piece.array[name]
        column = pa.array(np.ascontiguousarray(values).reshape(-1))
        if values.ndim > 1:
            column = pa.FixedSizeListArray.from_arrays(column, int(np.prod(values.shape[1:])))
        meta = {"unit": unit_of(name), "text": FIELDS[name].text} if name in FIELDS else None
        arrays.append(column)
        fields.append(pa.field(name, column.type, metadata=meta))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def buses(run: Run) -> list[str]:
    """Return the topics of CAN buses. Raises LogError when there is none."""
    found = [
        t for t in run.topics if t.startswith(schema.can_topic("")) and run.logs[0].schema_of(t) == "rtctl.CanFrame"
    ]
    if not found:
        raise LogError(f"{run.path}: no CAN bus in it; it has {', '.join(run.topics) or 'nothing'}")
    return found


def frames(run: Run) -> Iterator[tuple[str, I64, Structured]]:
    """Yield (bus, log_time [ns], frames) of all buses, piece by piece."""
    for topic in buses(run):
        for piece in run.pieces(topic):
            yield topic.removeprefix(schema.can_topic("")), piece.time, piece.array


def to_candump(run: Run, out: IO[str], progress: Progress) -> int:
    """Write all frames as `candump -L` does, in the order of time, times to the microsecond."""
    done = 0
    for _, lines in _merged(run, candump_lines):
        out.writelines(lines)
        done += len(lines)
        progress(done)
    return done


def _merged(run: Run, make: Callable[[str, I64, Structured], list[T]]) -> Iterator[tuple[I64, list[T]]]:
    """Yield (times, what `make` gives for each frame); several buses are merged by time."""
    names = buses(run)
    if len(names) == 1:
        for bus, time, array in frames(run):
            yield time, make(bus, time, array)
        return
    times, things = [], []
    for bus, time, array in frames(run):
        times.append(time)
        things += make(bus, time, array)
    every = np.concatenate(times)
    order = np.argsort(every, kind="stable")
    yield every[order], [things[i] for i in order.tolist()]


def candump_lines(bus: str, time: I64, array: Structured) -> list[str]:
    """Return the line of each frame."""
    us = (time + 500) // 1000
    stamps = zip((us // 1_000_000).tolist(), (us % 1_000_000).tolist(), strict=True)
    ids, sizes, data = array["id"].tolist(), array["dlc"].tolist(), array["data"].tobytes().hex().upper()
    wide, rtr, err = array["is_extended"].tolist(), array["is_rtr"].tolist(), array["is_error"].tolist()
    fd, way = array["fd"].tolist(), array["direction"].tolist()
    flags = (array["brs"] * _BRS + array["esi"] * _ESI).tolist()
    lines = []
    for k, (second, micro) in enumerate(stamps):
        number = f"{ids[k] | 0x20000000:08X}" if err[k] else f"{ids[k]:08X}" if wide[k] else f"{ids[k]:03X}"
        text = data[128 * k : 128 * k + 2 * sizes[k]]
        body = f"##{flags[k]:X}{text}" if fd[k] else f"#R{sizes[k] or ''}" if rtr[k] else f"#{text}"
        lines.append(f"({second}.{micro:06d}) {bus} {number}{body} {'T' if way[k] else 'R'}\n")
    return lines


def to_blf(run: Run, path: Path, progress: Progress) -> int:
    """Write all frames as Vector's BLF, through python-can."""
    import can

    names = [topic.removeprefix(schema.can_topic("")) for topic in buses(run)]
    done = 0

    def messages(bus: str, time: I64, array: Structured) -> list[can.Message]:
        found = []
        for at, row in zip(time.tolist(), array, strict=True):
            size = int(row["dlc"])
            found.append(
                can.Message(
                    timestamp=at / 1e9,
                    arbitration_id=int(row["id"]),
                    is_extended_id=bool(row["is_extended"]),
                    is_remote_frame=bool(row["is_rtr"]),
                    is_error_frame=bool(row["is_error"]),
                    is_fd=bool(row["fd"]),
                    bitrate_switch=bool(row["brs"]),
                    error_state_indicator=bool(row["esi"]),
                    is_rx=row["direction"] == schema.RX,
                    dlc=size,
                    data=b"" if row["is_rtr"] else row["data"][:size].tobytes(),
                    channel=names.index(bus),
                )
            )
        return found

    with can.BLFWriter(path) as writer:
        for _, batch in _merged(run, messages):
            for message in batch:
                writer.on_message_received(message)
            done += len(batch)
            progress(done)
    return done


def to_tlog(run: Run, path: Path, progress: Progress) -> int:
    """Write all MAVLink packets, both ways in the order of time, each after its time as big-endian [us]."""
    found = packets(run)
    with path.open("wb") as file:
        for packet in found:
            file.write((packet.time // 1000).to_bytes(8, "big") + packet.data)
    progress(len(found))
    return len(found)


@contextlib.contextmanager
def text_file(path: str) -> Iterator[IO[str]]:
    """Open a file for text; `-` is the standard output."""
    if path == "-":
        yield sys.stdout
        return
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        yield file
