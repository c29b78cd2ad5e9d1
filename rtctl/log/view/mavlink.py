"""MAVLink packets in logs: topics /mavlink/<link>/rx and tx, found whatever envelope carries the bytes."""

import base64
import json
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from mcap.records import Schema

from rtctl.errors import LogError
from rtctl.log.read.run import Run

Sender: TypeAlias = tuple[str, str, int, int]  # link, way, system, component
V1, V2 = 0xFE, 0xFD  # first byte of a packet
PREFIX = "/mavlink/"


class Packet(NamedTuple):
    """One packet and what its header says."""

    time: int  # [ns] log_time
    link: str
    way: str  # rx | tx
    system: int
    component: int
    message: int
    sequence: int
    data: bytes


class Listing(NamedTuple):
    """What one sender sent of one kind of message."""

    link: str
    way: str
    system: int
    component: int
    message: int
    name: str
    packets: int
    hz: float
    lost: int  # packets of this sender that never came, by the holes in their numbers; -1: it numbers none


def header_of(data: bytes) -> tuple[int, int, int, int] | None:
    """Return (system, component, message, sequence) of a packet, None when it is none."""
    if len(data) >= 10 and data[0] == V2:
        return data[5], data[6], int.from_bytes(data[7:10], "little"), data[4]
    if len(data) >= 6 and data[0] == V1:
        return data[3], data[4], data[5], data[2]
    return None


def topics(run: Run) -> list[str]:
    """Return the topics of MAVLink links. Raises LogError when there is none."""
    found = [t for t in run.topics if t.startswith(PREFIX)]
    if not found:
        raise LogError(f"{run.path}: no MAVLink in it; it has {', '.join(run.topics) or 'nothing'}")
    return found


def packets(run: Run) -> list[Packet]:
    """Return all packets in the order of time. Raises LogError when there is no link, or none can be read."""
    found = []
    for name in topics(run):
        topic = run[name]
        link, _, way = name.removeprefix(PREFIX).rpartition("/")
        bytes_of = _opener(run, name)
        for at, payload in zip(topic.time.tolist(), topic.payloads, strict=True):
            data = bytes_of(payload)
            head = header_of(data)
            if head is not None:
                found.append(Packet(at, link, way, *head, data))
    return sorted(found, key=lambda packet: packet.time)


def _opener(run: Run, topic: str) -> Callable[[bytes], bytes]:
    """Return how to get at the packet in a message: by its protobuf's first field of bytes, its JSON, or as it is."""
    channel, kind = run.logs[0].channel(topic)
    if channel.message_encoding == "protobuf" and kind is not None:
        return _from_protobuf(kind)
    if channel.message_encoding == "json":
        return _from_json
    return lambda payload: payload


def _from_protobuf(kind: Schema) -> Callable[[bytes], bytes]:
    try:
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(kind.data).file:
            pool.Add(file)
        maker = message_factory.GetMessageClass(pool.FindMessageTypeByName(kind.name))
    except (DecodeError, KeyError, TypeError):
        return lambda payload: payload
    fields = [f.name for f in maker.DESCRIPTOR.fields if f.type == f.TYPE_BYTES]

    def opened(payload: bytes) -> bytes:
        try:
            return bytes(getattr(maker.FromString(payload), fields[0])) if fields else payload
        except DecodeError:
            return b""

    return opened


def _from_json(payload: bytes) -> bytes:
    try:
        content = json.loads(payload)
        return base64.b64decode(next(content[k] for k in ("packet", "data", "raw") if k in content))
    except (ValueError, TypeError, StopIteration, RecursionError):
        return b""


def listing(run: Run) -> list[Listing]:
    """Return what was sent on each link, by sender and kind of message."""
    every = packets(run)
    groups: dict[tuple[str, str, int, int, int], list[int]] = {}
    numbers: dict[Sender, set[int]] = {}
    lost: dict[Sender, int] = {}
    last: dict[Sender, int] = {}
    for p in every:
        sender = (p.link, p.way, p.system, p.component)
        if sender in last:
            lost[sender] = lost.get(sender, 0) + (p.sequence - last[sender] - 1) % 256
        last[sender] = p.sequence
        numbers.setdefault(sender, set()).add(p.sequence)
        groups.setdefault((*sender, p.message), []).append(p.time)
    rows = []
    for (link, way, system, component, message), times in sorted(groups.items()):
        span = (times[-1] - times[0]) / 1e9
        hz = (len(times) - 1) / span if span > 0.0 else 0.0
        sender = (link, way, system, component)
        counts = len(numbers[sender]) > 1 or len(times) < 3  # a simulated link may number nothing
        missing = lost.get(sender, 0) if counts else -1
        rows.append(Listing(link, way, system, component, message, name_of(message), len(times), hz, missing))
    return rows


def name_of(message: int) -> str:
    """Return a message's name in the common dialect, '' where the dialect is not installed or does not know it."""
    try:
        from pymavlink.dialects.v20 import common  # type: ignore[import-not-found,import-untyped,unused-ignore]
    except ImportError:
        return ""
    found = common.mavlink_map.get(message)
    return str(getattr(found, "msgname", "") or getattr(found, "name", "")) if found else ""
