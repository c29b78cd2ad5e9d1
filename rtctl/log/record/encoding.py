"""Entries of the ring into MCAP message records, many at a time and in their order."""

import json
from collections import deque

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log

from rtctl.log import schema
from rtctl.log.entry import Batch, Kind, Payload
from rtctl.log.header import Header
from rtctl.log.mcap.rows import Encoded, Rows, assembled, copies, message, rows_for, single, stamped
from rtctl.log.record.rover_scene import BaseScene
from rtctl.log.record.scene import Scene
from rtctl.log.record.surroundings import HZ, Drawing
from rtctl.log.schema import MESSAGE
from rtctl.plain import Json
from rtctl.types import I64, U8, Array, RecordRow

INFO, WARNING, ERROR = 2, 3, 4  # levels of foxglove.Log
LEVELS = {"rejected": WARNING, "fault": ERROR}  # by the event's name
TEXTS = {
    int(Kind.EVENT): schema.EVENT,
    int(Kind.REQUEST): schema.REQUEST,
    int(Kind.CHECKPOINT): schema.CHECKPOINT,
}  # JSON
EVIDENCE = 50  # ticks that are kept with a fault
SHOWN = (  # of each tick in a fault's evidence
    "tick", "time", "missed", "link", "q", "qd", "tau_measured", "age", "replies", "drive", "lateness", "x", "error",
    "innovation", "tau_wanted", "tau_sent", "cut", "state", "status", "faults",
)  # fmt: skip
_TICK, _EVENT, _REQUEST = int(Kind.TICK), int(Kind.EVENT), int(Kind.REQUEST)
CAN_FRAME = np.dtype([("id", "<u4"), ("len", "u1"), ("flags", "u1"), ("reserved", "<u2"), ("data", "u1", (8,))])
CANFD_FRAME = np.dtype([("id", "<u4"), ("len", "u1"), ("flags", "u1"), ("reserved", "<u2"), ("data", "u1", (64,))])
EFF, RTR, ERR = 0x80000000, 0x40000000, 0x20000000  # flag bits of the kernel's can_id
BRS, ESI = 0x01, 0x02  # of canfd_frame.flags


class Encoder:
    """Turns batches into message records; remembers the last entry seen, so that holes become dropouts.

    offset: log_time - monotonic time [ns], one for each segment.
    """

    def __init__(self, header: Header, number: int = 0) -> None:
        self.header = header
        self.offset = 0
        self.number = number  # of the last entry encoded
        self.time = 0  # [ns] its monotonic time
        self.dropped = 0  # entries missing so far, by the holes in their numbers
        self.malformed = 0  # entries of a wrong size or kind
        self.channels = schema.channels(header)
        self._id = {channel.topic: channel.id for channel in self.channels}
        self._can_id = [self._id[schema.can_topic(bus)] for bus in header.buses]
        self._own: dict[int, int] = {}  # sequence numbers of the channels that the recorder itself writes
        joints = schema.joint_state_layout(header.joints)
        self._tick = rows_for(
            [(self._id[schema.TICK], schema.tick_layout(header.dtype)), (self._id[schema.JOINT_STATES], joints)]
        )
        self._has_state = {"q", "qd", "tau_measured"} <= set(header.dtype.names or ())
        self._can: dict[tuple[int, int], Rows] = {}
        self._scene: Drawing = Scene(header) if self._has_state else BaseScene(header)
        self._due = 0  # [ns] monotonic, of the next scene
        self._recent: deque[bytes] = deque(maxlen=EVIDENCE)  # the last ticks
        self._evidence: dict[int, list[bytes]] = {}  # by the index of a fault's entry in the batch

    def encode(self, batch: Batch) -> Encoded:
        """Return the records of a batch, dropouts found on the way first.

        Entries that make no sense are counted in `malformed` and left out.
        """
        pieces: list[Payload] = [b""] * len(batch.kind)
        columns: list[tuple[I64, int, I64, I64, int]] = []
        time = np.array(batch.time, dtype=np.int64)
        sequence = np.array(batch.sequence, dtype=np.int64)
        views = self._watch(batch)
        for key, indices in self._groups(batch).items():
            rows = np.array(indices, dtype=np.int64)
            payloads = [batch.payload[i] for i in indices]
            columns += self._group(key, rows, payloads, time[rows], sequence[rows], pieces)
        dropouts = self._dropouts(batch)
        return assembled(dropouts, pieces, columns, views)

    def _watch(self, batch: Batch) -> list[Encoded]:
        """Go through a batch in its order: what viewers show, what operators asked, and the evidence of faults."""
        found: list[Encoded] = []
        self._evidence.clear()
        size = self.header.dtype.itemsize
        ticks: list[Payload] = list(self._recent)
        for index, (kind, payload, time) in enumerate(zip(batch.kind, batch.payload, batch.time, strict=True)):
            if kind == _TICK and len(payload) == size:
                ticks.append(payload)
                if time >= self._due:
                    found += self._views(np.frombuffer(payload, self.header.dtype)[0], time)
            elif kind == _REQUEST:
                found += self._asked(bytes(payload), time, ticks[-1] if ticks else None)
            elif kind == _EVENT:
                data = event_of(bytes(payload))
                if data.get("name") == "fault":
                    self._evidence[index] = [bytes(each) for each in ticks[-EVIDENCE:]]
                found.append(self._said(level_of(data), text_of(data), time))
        self._recent.extend(bytes(each) for each in ticks[-EVIDENCE:])  # the ring's memory is not ours to keep
        return found

    def _views(self, record: RecordRow, time: int) -> list[Encoded]:
        period = round(1e9 / HZ)
        self._due = max(self._due + period, time - period) if self._due else time + period
        if not self._scene.can_show(record):
            return []
        stamp = time + self.offset
        return [
            self._message(schema.TF, time, self._scene.frames(record, stamp)),
            self._message(schema.SCENE, time, self._scene.update(record, stamp)),
        ]

    def _asked(self, payload: bytes, time: int, tick: Payload | None) -> list[Encoded]:
        now = float(np.frombuffer(tick, self.header.dtype)["time"][0]) if tick is not None else 0.0
        self._scene.request(payload, now)
        data = event_of(payload)
        said = []
        if str(data.get("verb", "none")) != "none":
            said.append(f"operator: {data['verb']}")
        goal = data.get("goal")
        if isinstance(goal, dict):
            said.append(f"goal: {goal.get('position')}")
        return [self._said(INFO, text, time) for text in said]

    def _said(self, level: int, text: str, time: int) -> Encoded:
        message = Log(level=Log.Level.Name(level), message=text, name="rtctl")
        stamp = time + self.offset
        message.timestamp.seconds, message.timestamp.nanos = stamp // 1_000_000_000, stamp % 1_000_000_000
        return self._message(schema.LOG, time, message.SerializeToString(deterministic=True))

    def own(self, topic: str, time: int, content: Json) -> Encoded:
        """Return one message of the recorder itself; time: monotonic [ns]."""
        return self._message(topic, time, json.dumps(content).encode())

    def _message(self, topic: str, time: int, content: bytes) -> Encoded:
        channel = self._id[topic]
        sequence = self._own[channel] = self._own.get(channel, 0) + 1
        data = message(channel, sequence, time + self.offset, content)
        return single(data, channel, sequence, time + self.offset)

    def _groups(self, batch: Batch) -> dict[tuple[int, int, int], list[int]]:
        """Return the entries' indices by what can be encoded in one go: kind, payload size and data size."""
        groups: dict[tuple[int, int, int], list[int]] = {}
        for index, (kind, payload) in enumerate(zip(batch.kind, batch.payload, strict=True)):
            size = len(payload)
            data = payload[4] if size in (16, 72) else 0  # a frame's len; anything for the others
            key = (kind, size, data)
            if key in groups:
                groups[key].append(index)
            else:
                groups[key] = [index]
        return groups

    def _group(
        self,
        key: tuple[int, int, int],
        rows: I64,
        payloads: list[Payload],
        time: I64,
        sequence: I64,
        pieces: list[Payload],
    ) -> list[tuple[I64, int, I64, I64, int]]:
        """Encode one group into `pieces`; return (rows, channel, time, sequence, offset in the piece) of its parts."""
        kind, size, data = key
        stamp = time + self.offset
        base = kind & 0xFF
        if kind == Kind.TICK and size == self.header.dtype.itemsize:
            block = self._ticks(payloads, stamp, sequence)
            second = MESSAGE.itemsize + self._tick.dtype["body0"].itemsize
            parts = [(self._id[schema.TICK], 0), (self._id[schema.JOINT_STATES], second)]
            if not self._has_state:
                block, parts = block[:, :second], parts[:1]
        elif base in (Kind.CAN_TX, Kind.CAN_RX) and size in (16, 72) and kind >> 8 < len(self._can_id):
            channel = self._can_id[kind >> 8]
            block = self._frames(payloads, base, channel, min(data, size - 8), stamp, time, sequence)
            parts = [(channel, 0)]
        elif base in (Kind.MAV_TX, Kind.MAV_RX) and kind >> 8 < len(self.header.links):
            return self._packets(kind, rows, payloads, time, sequence, pieces)
        elif kind in TEXTS:
            return self._texts(kind, rows, payloads, stamp, sequence, pieces)
        else:
            self.malformed += len(rows)
            return []
        width = block.shape[1]
        view = memoryview(block.tobytes())
        for number, row in enumerate(rows.tolist()):
            pieces[row] = view[number * width : (number + 1) * width]
        return [(rows, channel, stamp, sequence, at) for channel, at in parts]

    def _ticks(self, payloads: list[Payload], stamp: I64, sequence: I64) -> U8:
        record = np.frombuffer(b"".join(payloads), self.header.dtype)
        block = copies(self._tick.template, len(payloads))
        rows = block.reshape(-1).view(self._tick.dtype)
        stamped(rows["head0"], stamp, sequence)
        body = rows["body0"]
        for name in self.header.dtype.names or ():
            body[name] = record[name]
        if self._has_state:
            stamped(rows["head1"], stamp, sequence)
            state = rows["body1"]
            state["sec"], state["nanosec"] = stamp // 1_000_000_000, stamp % 1_000_000_000
            state["position"], state["velocity"] = record["q"], record["qd"]
            state["effort"] = record["tau_measured"]
        return block

    def _frames(
        self, payloads: list[Payload], kind: int, channel: int, size: int, stamp: I64, time: I64, sequence: I64
    ) -> U8:
        found = self._can.get((channel, size))
        if found is None:
            found = self._can[channel, size] = rows_for([(channel, schema.can_layout(size))])
        fd = len(payloads[0]) == 72
        frame = np.frombuffer(b"".join(payloads), CANFD_FRAME if fd else CAN_FRAME)
        block = copies(found.template, len(payloads))
        rows = block.reshape(-1).view(found.dtype)
        stamped(rows["head0"], stamp, sequence)
        body = rows["body0"]
        extended = (frame["id"] & EFF) != 0
        body["stamp_ns"], body["dlc"] = time, size
        wide = (frame["id"] & (EFF | ERR)) != 0
        body["id"] = frame["id"] & np.where(wide, np.uint32(0x1FFFFFFF), np.uint32(0x7FF))
        body["direction"] = schema.TX if kind == Kind.CAN_TX else schema.RX
        body["is_extended"], body["is_rtr"] = extended, (frame["id"] & RTR) != 0
        body["is_error"] = (frame["id"] & ERR) != 0
        if fd:
            body["fd"], body["brs"], body["esi"] = 1, (frame["flags"] & BRS) != 0, (frame["flags"] & ESI) != 0
        if size:
            body["data"] = frame["data"][:, :size]
        return block

    def _packets(
        self, kind: int, rows: I64, payloads: list[Payload], time: I64, sequence: I64, pieces: list[Payload]
    ) -> list[tuple[I64, int, I64, I64, int]]:
        """MAVLink packets, one by one: there are hundreds a second, of many sizes."""
        way = "tx" if kind & 0xFF == Kind.MAV_TX else "rx"
        channel = self._id[schema.mavlink_topic(self.header.links[kind >> 8], way)]
        stamps, sequences = time.tolist(), sequence.tolist()
        for number, row in enumerate(rows.tolist()):
            data = schema.mavlink_message(bytes(payloads[number]), stamps[number])
            pieces[row] = message(channel, sequences[number], stamps[number] + self.offset, data)
        return [(rows, channel, time + self.offset, sequence, 0)]

    def _texts(
        self, kind: int, rows: I64, payloads: list[Payload], stamp: I64, sequence: I64, pieces: list[Payload]
    ) -> list[tuple[I64, int, I64, I64, int]]:
        channel = self._id[TEXTS[kind]]
        times, sequences = stamp.tolist(), sequence.tolist()
        for number, row in enumerate(rows.tolist()):
            data = bytes(payloads[number])
            if kind == Kind.EVENT:
                data = self._event(data, row)
            pieces[row] = message(channel, sequences[number], times[number], data)
        return [(rows, channel, stamp, sequence, 0)]

    def _event(self, payload: bytes, row: int) -> bytes:
        """Return an event's JSON, a fault's with its evidence; what is not a JSON object becomes its message."""
        evidence = self._evidence.get(row)
        if not evidence and event_is_object(payload):
            return payload
        data = event_of(payload)
        if evidence:
            records = np.frombuffer(b"".join(evidence), self.header.dtype)
            data["evidence"] = {name: _plain(records[name]) for name in SHOWN if name in (records.dtype.names or ())}
        return json.dumps(data).encode()

    def _dropouts(self, batch: Batch) -> list[Encoded]:
        """Return a dropout for every hole in the entries' numbers, and move on."""
        if not batch.number:
            return []
        found = []
        if batch.number[-1] - self.number != len(batch.number):
            before, since = self.number, self.time
            for number, time in zip(batch.number, batch.time, strict=True):
                if number != before + 1:
                    found.append(self._dropout(number - before - 1, since, time))
                before, since = number, time
        self.number, self.time = batch.number[-1], batch.time[-1]
        return found

    def _dropout(self, count: int, since: int, until: int) -> Encoded:
        self.dropped += count
        offset = self.offset
        return self.own(schema.DROPOUT, until, {"count": count, "from_ns": since + offset, "to_ns": until + offset})

    def missing(self, number: int, time: int) -> list[Encoded]:
        """Return a dropout for the entries after the last one encoded up to `number`: they will never come."""
        count = number - self.number
        if count <= 0:
            return []
        since, self.number = self.time, number
        return [self._dropout(count, since, time)]


def event_of(payload: bytes) -> Json:
    """Return the JSON object of an event or request; {"message": text} for anything else."""
    try:
        data = json.loads(payload)
    except (ValueError, RecursionError):
        data = None
    return data if isinstance(data, dict) else {"message": payload.decode("utf-8", "replace")}


def event_is_object(payload: bytes) -> bool:
    """Return whether a payload is a JSON object."""
    try:
        return isinstance(json.loads(payload), dict)
    except (ValueError, RecursionError):
        return False


def text_of(event: Json) -> str:
    """Return an event as people read it."""
    return str(event.get("message") or ": ".join(str(event[key]) for key in ("name", "detail") if event.get(key)))


def level_of(event: Json) -> int:
    """Return the level of foxglove.Log: 2 info, 3 warning, 4 error."""
    return LEVELS.get(str(event.get("name")), INFO)


def _plain(values: Array) -> object:
    """Return numbers for JSON, which has no infinities: those become null."""
    if values.dtype.kind != "f":
        return values.tolist()
    plain = values.astype(object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()
