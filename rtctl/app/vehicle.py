"""What a vehicle is to the program around its tick: one struct of functions, of which an arm and a rover are values.

A `Vehicle` knows nothing of a file; `load` gives a `Setup`, which knows one robot file; `open` gives a `Link`.
`simulate` gives a `Play`, a link that ends in a simulator and the scenario that goes with it; `rebuild` gives a
`Rebuilt`, the same robot from the log alone. None of them is global, so one program can hold several.
"""

from collections.abc import Callable, Iterable, Iterator, MutableSequence, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np

from rtctl.hal.can.link import CanLink
from rtctl.hal.clock import Slot
from rtctl.hal.messages import Bounds
from rtctl.log.header import Header
from rtctl.log.read.run import Run
from rtctl.log.read.topic import Structured
from rtctl.plain import Json
from rtctl.spec.robot import ConsoleTable, LogTable
from rtctl.spec.scenario import Scenario
from rtctl.types import F64, Advice, ObstacleEdit, Record, Request, State, Status
from rtctl.world.obstacle_table import World

Say: TypeAlias = Callable[[str], None]
Said: TypeAlias = tuple[float, str, str]  # robot time [s], name, detail
Event: TypeAlias = tuple[str, str]  # name and detail, for people


# [s] for replies before a lockstep slot goes on without them. No simulated time passes meanwhile: drives in lockstep
# let none pass either until their controller has been silent for longer than this (firmware_sim.__main__.QUIET_S).
LOCKSTEP_WAIT = 2.0
LOCKSTEP_SILENT = 0.05  # [s] the same once a slot went without: a drive that fell silent need not be waited for


def never() -> bool:
    """Return False."""
    return False


class Constants(Protocol):
    """What every robot has."""

    @property
    def name(self) -> str: ...
    @property
    def dt(self) -> float: ...  # [s] servo period


class Remembered(Protocol):
    """What every memory has; a field means the same in all of them."""

    @property
    def tick(self) -> int: ...
    @property
    def state(self) -> State: ...
    @property
    def status(self) -> Status: ...
    @property
    def in_force(self) -> int: ...  # bits of the faults
    @property
    def refusal(self) -> str: ...  # why this tick's request was refused, '' when it was not
    @property
    def rest(self) -> int: ...  # ticks at rest
    @property
    def done(self) -> bool: ...  # nothing more to do: the daemon may leave
    @property
    def world(self) -> World: ...
    @property
    def rho(self) -> F64: ...  # (K,) [m] to each known obstacle


R = TypeVar("R", bound=Constants)
M = TypeVar("M", bound=Remembered)
F = TypeVar("F")
C = TypeVar("C")
R_co = TypeVar("R_co", bound=Constants, covariant=True)
M_contra = TypeVar("M_contra", bound=Remembered, contravariant=True)
F_co = TypeVar("F_co", covariant=True)
C_contra = TypeVar("C_contra", contravariant=True)


class Sink(Protocol):
    """Where messages go: the recorder's ring, or a file."""

    def put_many(self, kind: int, payloads: Sequence[bytes], time_ns: int) -> bool: ...


class Link(Protocol[F_co, C_contra]):
    """The other end of the wire, whatever it is."""

    @property
    def received(self) -> Sequence[bytes]: ...  # raw frames of the last read
    @property
    def counters(self) -> tuple[int, ...]: ...  # of protected frames, for a replay; () where it needs none
    @property
    def said(self) -> MutableSequence[str]: ...  # what the vehicle told people since it was last emptied

    def greet(self, lockstep: bool, say: Say | None = None, ended: Callable[[], bool] = never) -> F_co:
        """Return the feedback that the handshake leaves.

        say: is told what is waited for. ended: whether to give up. Raises RtctlError.
        """
        ...

    def settle(self) -> None: ...  # take what came since then, just before the loop
    def read(self, slot: int, missed: int, lateness: float, compute: float) -> F_co: ...
    def write(self, command: C_contra) -> Sequence[bytes]: ...  # the frames that were sent
    def wait_replies(self, timeout: float) -> bool: ...  # [s] in lockstep
    def close(self) -> None: ...


class Advising(Protocol[M_contra]):
    """Whoever looks beside the servo for what a goal needs."""

    events: list[Event]  # to be told; whoever does takes them out

    def begin(self) -> None: ...  # a goal was taken
    def advise(self, memory: M_contra) -> Advice | None: ...  # never waits
    def close(self) -> None: ...


class Silent:
    """Nobody: no advice."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def begin(self) -> None:
        """Do nothing."""

    def advise(self, memory: object) -> Advice | None:
        """Return None."""
        return None

    def close(self) -> None:
        """Do nothing."""


class Turn(NamedTuple, Generic[F, C]):
    """What one turn of the loop did."""

    feedback: F
    command: C
    record: Record
    frames: Sequence[bytes]  # sent


class Loop(Protocol):
    """How the servo process is scheduled."""

    @property
    def realtime(self) -> str: ...
    @property
    def cpu(self) -> int | None: ...
    @property
    def priority(self) -> int: ...


class Setup(NamedTuple, Generic[R, M, F, C]):
    """One robot file, read and checked."""

    name: str  # of the robot
    loop: Loop
    console: ConsoleTable
    log: LogTable
    resource: tuple[str, str]  # what one process alone may use, and the key that names it
    place: str  # the link, as people read it
    build: Callable[[], R]
    open: Callable[[], Link[F, C]]
    header: Callable[[R, F, Link[F, C]], Header]
    simulate: Callable[[Scenario, Path], "Play[R, M, F, C]"]  # the scenario and its file


class Play(Protocol[R_co, M_contra, F, C]):
    """A scenario played to a simulated vehicle: what it is told, and what comes of it."""

    @property
    def robot(self) -> R_co: ...
    @property
    def link(self) -> Link[F, C]: ...
    @property
    def arm_time(self) -> float: ...  # [s] beside the scenario's own, within which the vehicle must be running
    @property
    def truth(self) -> object: ...  # the simulator's own account of the last period
    @property
    def kept(self) -> float: ...  # [s] that the last of all goals has been kept, 0 before

    def look(self) -> float: ...  # take the truth of now; the scenario's time [s]
    def request(self, memory: M_contra) -> Request: ...
    def add(self, turn: Turn[F, C]) -> None: ...
    def figures(self, events: Sequence[Said]) -> Json: ...


class Rebuilt(NamedTuple, Generic[R, F, C]):
    """What a log tells of its vehicle, or another config for it."""

    robot: R
    start: F  # the feedback of the handshake
    feedbacks: Callable[[Structured], Iterable[F]]
    shown: str  # the field of a record that is drawn
    wire: CanLink | None  # whose counters a replay continues; None: the records alone are compared
    encode: Callable[[C], Sequence[bytes]] | None  # commands into the frames of `wire`


class Checkpoints(NamedTuple, Generic[R, M]):
    """How a memory is kept in the log."""

    encode: Callable[[M, tuple[int, ...]], bytes | None]  # with the link's counters; None: not worth its bytes
    decode: Callable[[bytes, R, M], tuple[M, tuple[int, ...]]]  # with any memory of this robot; ValueError


class Vehicle(NamedTuple, Generic[R, M, F, C]):
    """What an arm and a rover do each in their own way."""

    rx: int  # kinds of the log's messages
    tx: int
    load: Callable[[Path, float | None], Setup[R, M, F, C]]  # [s] to wait for the vehicle, None: as the file says
    warm: Callable[[R], None]  # compile and load everything that a tick needs
    compile_part: Callable[[R, int], None]  # 0 or 1: what each of two processes compiles first
    bounds: Callable[[R, Link[F, C]], Bounds]  # of goals
    initial: Callable[[R, F], M]
    tick: Callable[[R, M, F, Request], tuple[M, C, Record]]
    flagged: Callable[[F, int], F]  # the feedback with further bits of types.Link
    harmless: Callable[[C], C]  # what a command becomes in a dry run
    events: Callable[[R, M, M, F], list[Event]]  # what changed from a memory to the next
    names: Callable[[int], tuple[str, ...]]  # of faults
    status: Callable[[R, M, Link[F, C], Sequence[Said]], Json]  # what `rtctl status` shows beside what all have
    adviser: Callable[[R, bool], Advising[M]]  # started; bool: in lockstep
    misplaced: Callable[[R, M, ObstacleEdit], str]  # why an obstacle cannot be where a person says, '' where it can
    fallback: Callable[[R, M, Link[F, C], Sink, Iterator[Slot], bool], None]  # a turn raised; bool: in lockstep
    farewell: Callable[[R, M, Link[F, C], Sink], None]  # the last frames
    rebuild: Callable[[Run, Path | None], Rebuilt[R, F, C]]  # a log, another config for it
    checkpoints: Checkpoints[R, M] | None  # None: a log is replayed from its beginning alone
    keeps_step: bool  # its simulated drives can be run in lockstep over the bus
    takes_law: bool  # a law of somebody's own may drive it


SomeVehicle: TypeAlias = Vehicle[Any, Any, Any, Any]  # chosen by a file; its functions fit one another


def clearances(m: Remembered) -> dict[str, float]:
    """Return the distance [m] to each known obstacle that is near enough to have one, by name."""
    return {name: float(d) for name, d in zip(m.world.names, m.rho, strict=True) if name and np.isfinite(d)}
