"""Where moments come from: a servo that lives, through its ring; or a log, at any time of it."""

import json
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from rtctl.errors import LinkError, LogError, RtctlError
from rtctl.hal import client
from rtctl.log import schema
from rtctl.log.entry import Kind
from rtctl.log.header import Header, header_from_json
from rtctl.log.read.run import Run
from rtctl.log.record.surroundings import Surroundings, Thing
from rtctl.log.record.tap import Tap, living
from rtctl.plain import Json
from rtctl.types import F64, RecordRow
from rtctl.view.known import Known, known_obstacles
from rtctl.view.moment import Moment, Reader

SAID = 12  # events that a page lists
TRAIL = 300  # places behind, at DRAWN
CHART = 30.0  # [s] that a chart shows
CHART_HZ = 10.0
CELL = 0.25  # [m] of what a base has seen
CELLS = 6000  # the newest, that are kept
DRAWN = 30.0  # [Hz] of moments
ROWS = 40_000  # records of a log that are held: 22 minutes at DRAWN, of a longer log fewer a second
REQUEST, EVENT = int(Kind.REQUEST), int(Kind.EVENT)


class Sample(NamedTuple):
    """One point of the chart."""

    time: float  # [s]
    error: float  # [m]
    clearance: float  # [m] nan: nothing near
    speed: float  # [m/s]
    torque: float  # largest share of the rated one


class Seen:
    """Where a base's scan has met something: cells of the floor, the newest of them."""

    def __init__(self) -> None:
        self._cells: dict[tuple[int, int], None] = {}

    def take(self, scan: F64) -> None:
        """Take what a scan met, (k, 3) [m]."""
        for x, y in np.unique(np.round(scan[:, :2] / CELL).astype(int), axis=0).tolist():
            self._cells[(x, y)] = self._cells.pop((x, y), None)  # the newest last
        for old in list(self._cells)[: max(0, len(self._cells) - CELLS)]:
            del self._cells[old]

    def places(self) -> F64:
        """Return the cells' middles (k, 3) [m]."""
        return np.array([[x * CELL, y * CELL, 0.02] for x, y in self._cells]).reshape(-1, 3)


class Story:
    """What led to a moment: obstacles, events, the way behind, the last seconds as a chart."""

    def __init__(self, header: Header) -> None:
        self.header, self.reader = header, Reader(header)
        self.detail = ""  # what holds the robot, in the controller's words
        self.said: deque[tuple[float, str]] = deque(maxlen=SAID)
        self.trail: deque[F64] = deque(maxlen=TRAIL)
        self.chart: deque[Sample] = deque(maxlen=round(CHART * CHART_HZ))
        self.seen = Seen()
        self.moment: Moment | None = None
        self._around = Surroundings(header)

    @property
    def things(self) -> dict[str, tuple[Thing, bool]]:
        """Return the obstacles by name, and whether each is the config's own."""
        return self._around.things()

    def know(self, known: list[Known], time: float) -> None:
        """Take the obstacles that there are, and no others; time [s] of the robot."""
        self._around.restart([(each.slot, each.shape) for each in known], time)

    def message(self, kind: int, payload: bytes, time: float | None = None) -> None:
        """Take a request or an event into account; time [s] of the robot, by default the last moment's."""
        now = time if time is not None else self.moment.time if self.moment is not None else 0.0
        if kind == REQUEST:
            self._around.request(payload, now)
            return
        event = _json(payload)
        name, detail = str(event.get("name", "")), str(event.get("detail", ""))
        if name not in ("state", "fault", "rejected", "vehicle"):
            self.detail = detail
        if name:
            at = event.get("time", now)
            self.said.append(
                (float(at) if isinstance(at, int | float) else now, f"{name}: {detail}" if detail else name)
            )

    def tick(self, record: RecordRow) -> None:
        """Take a record; one whose numbers cannot be drawn changes nothing."""
        if not self.reader.is_sound(record):
            return
        names = [self._around.name_of(k) for k in range(len(record["rho"]))]
        m = self.moment = self.reader.moment(record, names)
        self.trail.append(m.place)
        if len(m.scan):
            self.seen.take(m.scan)
        if not self.chart or m.time - self.chart[-1].time >= 1.0 / CHART_HZ:
            near = m.clearances[0][1] if m.clearances else np.nan
            torque = max((share for _, share in m.torques), default=0.0)
            self.chart.append(Sample(m.time, m.error, near, m.speed, torque))


class Source(Protocol):
    """What a page follows."""

    @property
    def story(self) -> Story: ...
    @property
    def folder(self) -> Path | None: ...  # of the config's URDF, where that is to be trusted
    def step(self) -> str: ...  # go on to now; what the page must say beside the moment, '' for nothing


class Live:
    """A daemon or a simulation that runs."""

    def __init__(self, robot: str = "", socket: str = "", ring: Path | None = None) -> None:
        """Find the ring of `robot`, or of the only servo that lives. Raises LinkError."""
        self.robot, self.socket, self._given = robot, socket, ring
        self._tap: Tap | None = None
        self._open()

    def _open(self) -> None:
        path = self._given if self._given is not None else _only(living(self.robot), self.robot)
        try:
            tap = Tap(path)
            blob = json.loads(tap.blob)
            header = header_from_json(blob["header"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise LinkError(f"{path}: cannot be followed: {error}") from None
        self._tap, self.story, self.robot = tap, Story(header), header.robot
        config = blob.get("config", "")
        self.folder = Path(config).parent if config else None
        self._resync()

    def _resync(self) -> None:
        """Ask once what was told before: the ring holds but the last seconds."""
        try:
            with client.Session(self.socket or client.find(self.robot)) as session:
                status, world = session.ask({"verb": "status"}), session.ask({"verb": "world"})
        except RtctlError:  # a simulation has no console: its scenario's obstacles come again and again
            return
        self.story.detail = str(status.get("detail") or "")
        self.story.know(known_obstacles(world), float(status.get("time_s") or 0.0))

    def step(self) -> str:
        """Take what came; open the next ring of the robot when this one has ended."""
        if self._tap is None:
            try:
                self._open()
            except RtctlError:
                return "The daemon has ended. Waiting for the next one."
            return ""
        seen = self._tap.look()
        if seen.tick and len(seen.tick) == self.story.header.dtype.itemsize:
            record = np.frombuffer(seen.tick, self.story.header.dtype)[0]
        else:
            record = None
        if record is not None and self.story.moment is None:
            self.story.tick(record)
        for kind, payload in seen.messages:
            self.story.message(kind, payload)
        if record is not None:
            self.story.tick(record)
        if seen.lost:
            self._resync()
        if self._tap.closed or (record is None and self._tap.ended):  # who ticks lives: to ask the system costs more
            if self._given is None:
                self._tap.unmap()
                self._tap = None
            return "The run has ended."
        return ""


def _only(rings: list[Path], robot: str) -> Path:
    if not rings:
        whose = f" of {robot}" if robot else ""
        raise LinkError(f"no daemon{whose} of this user runs: start rtctl run, or name a log: rtctl view run.mcap")
    if len(rings) > 1:
        names = sorted({path.name.removeprefix("rtctl-").split("-")[0] for path in rings})
        key, told = ("--robot NAME", names) if len(names) == len(rings) else ("--ring FILE", sorted(map(str, rings)))
        raise LinkError(f"several daemons run: choose one by {key}: {', '.join(told)}")
    return rings[0]


class Recorded:
    """A log, at any time of it."""

    def __init__(self, run: Run, progress: Callable[[int], None] = lambda done: None) -> None:
        """Read what is drawn of a run. Raises LogError when it has no ticks of rtctl."""
        total = run.count(schema.TICK)
        if not total:
            raise LogError(f"{run.path}: no tick in it: nothing to see")
        self.folder: Path | None = None
        self._header = run.header
        each = max(1, round(1.0 / (DRAWN * run.header.period)), total // ROWS)
        rows, done = [], 0
        for piece in run.pieces(schema.TICK):
            rows.append(piece.array[(-done) % each :: each].copy())
            done += len(piece)
            progress(done)
        self._rows = np.concatenate(rows)
        self.times: F64 = self._rows["time"].astype(np.float64)
        ticks = self._rows["tick"].astype(np.int64)
        messages = []
        for topic, kind in ((schema.REQUEST, REQUEST), (schema.EVENT, EVENT)):
            for payload in run[topic].payloads if topic in run else ():
                body = _json(bytes(payload))
                data = body["data"] if isinstance(body.get("data"), dict) else body
                messages.append((int(np.searchsorted(ticks, _tick(data))), kind, json.dumps(data)))
        self._messages = sorted(messages, key=lambda message: message[:2])
        self.at = self.times[0]  # [s] where the page is
        self._row = self._next = 0  # what the story knows already
        self.story = Story(self._header)

    @property
    def span(self) -> tuple[float, float]:
        """Return the robot's time [s] at the first and the last record."""
        return float(self.times[0]), float(self.times[-1])

    def seek(self, time: float) -> None:
        """Go to a time [s]."""
        self.at = min(max(time, self.times[0]), self.times[-1])

    def step(self) -> str:
        """Go on, or back, to where the page is."""
        row = max(0, int(np.searchsorted(self.times, self.at, "right")) - 1)
        first = self._row
        if row + 1 < self._row or (row - self._row) > CHART * DRAWN:
            self.story, self._next = Story(self._header), 0
            first = max(0, row + 1 - round(CHART * DRAWN))
        for k in range(first, row + 1):
            self._tell(k)
            self.story.tick(self._rows[k])
        self._row = row + 1
        return ""

    def _tell(self, row: int) -> None:
        """Tell the story what was said up to a row, each at its own time."""
        while self._next < len(self._messages) and self._messages[self._next][0] <= row:
            at, kind, text = self._messages[self._next]
            self.story.message(kind, text.encode(), float(self.times[min(at, len(self.times) - 1)]))
            self._next += 1


def _tick(message: Json) -> int:
    tick = message.get("tick", 0)
    return tick if isinstance(tick, int) else 0


def _json(payload: bytes) -> Json:
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        value = None
    return value if isinstance(value, dict) else {}
