"""All drives of an arm at once: the state of each in a row of two tables, the rules in compiled code.

What happens every period (a cycle's commands and replies, the passing of time) is done for all rows by
`firmware_sim.bank_kernels`. What is rare (registers, frames of another form, injected faults, reports) is done by
`Drive`'s own Python: a `Slot` is a drive whose attributes are the cells of its row.
"""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_sim import bank_kernels, cells, codec
from firmware_sim.batch import Batch
from firmware_sim.drive import Drive, Rating, State, Trip
from rtctl.protocol.frame import CAN_MTU, CANFD_MTU

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Slot(Drive):
    """A drive that lives in a bank: `Drive` whose state is a row of numbers."""

    def __init__(self, rating: Rating, f: F64, i: I64) -> None:
        self._f, self._i = f, i
        super().__init__(rating)
        f[cells.RATED] = rating.torque
        i[cells.MOTOR], i[cells.REPLY_ID] = rating.motor, int(self.registers[codec.MST_ID])
        i[cells.RELEASE_AFTER_NS] = rating.release_ns

    def trip(self, code: int) -> None:
        """Latch a fault; the row knows whether the newest one waits to see the joint at rest."""
        super().trip(code)
        self._note_restless()

    def _clockwork(self, dt_ns: int, dt: float) -> None:
        super()._clockwork(dt_ns, dt)
        self._note_restless()

    def _note_restless(self) -> None:
        self._i[cells.RESTLESS] = bool(self.trips) and self.trips[-1].rest < 0

    def write_down(self) -> None:
        """Keep what the compiled code has found: a new trip, or the rest after one."""
        event = int(self._i[cells.EVENT])
        self._i[cells.EVENT] = 0
        if event & cells.TRIPPED:
            self.trips.append(Trip(self.fault, int(self._i[cells.TRIP_AT]), int(self._i[cells.TRIP_VALID])))
        if event & cells.RESTED:
            self.trips[-1].rest = self.uptime_ns


def _float(column: int) -> property:
    def get(self: Slot) -> float:
        return float(self._f[column])

    def put(self: Slot, value: float) -> None:
        self._f[column] = value

    return property(get, put)


def _whole(column: int, kind: type = int) -> property:
    def get(self: Slot) -> Any:
        return kind(self._i[column])

    def put(self: Slot, value: int) -> None:
        self._i[column] = value

    return property(get, put)


def _group(first: int, last: int, kind: type, head: tuple[int, ...] = ()) -> property:
    """Return a property for a tuple of neighbouring floats."""

    def get(self: Slot) -> Any:
        return kind(*head, *self._f[first : last + 1].tolist())

    def put(self: Slot, value: Sequence[float]) -> None:
        self._f[first : last + 1] = value[len(head) :]

    return property(get, put)


ATTRIBUTES = {
    "q": _float(cells.Q),
    "qd": _float(cells.QD),
    "zero": _float(cells.ZERO),
    "temperature": _float(cells.TEMPERATURE),
    "torque": _float(cells.TORQUE),
    "strength": _float(cells.STRENGTH),
    "slew": _float(cells.SLEW),
    "slew_bound": _float(cells.SLEW_BOUND),
    "slew_budget": _float(cells.SLEW_BUDGET),
    "over_speed": _float(cells.OVER_SPEED),
    "command": _group(cells.COMMAND_P, cells.COMMAND_T, codec.Command, (0,)),
    "scale": _group(cells.SCALE_P, cells.SCALE_T, codec.Scale),
    "state": _whole(cells.STATE, State),
    "fault": _whole(cells.FAULT),
    "watchdog_tripped": _whole(cells.WATCHDOG_TRIPPED, bool),
    "brake": _whole(cells.BRAKE, bool),
    "release_ns": _whole(cells.RELEASE_NS),
    "flags": _whole(cells.FLAGS),
    "silence_ns": _whole(cells.SILENCE_NS),
    "fault_age_ns": _whole(cells.FAULT_AGE_NS),
    "uptime_ns": _whole(cells.UPTIME_NS),
    "last_valid_ns": _whole(cells.LAST_VALID_NS),
    "timeout_ns": _whole(cells.TIMEOUT_NS),
    "counter_in": _whole(cells.COUNTER_IN),
    "counter_out": _whole(cells.COUNTER_OUT),
    "rejected": _whole(cells.REJECTED),
}
for _name, _property in ATTRIBUTES.items():
    setattr(Slot, _name, _property)


class Bank:
    """The drives of one arm; owns their state."""

    def __init__(self, ratings: Sequence[Rating], fd: bool) -> None:
        """`fd`: whether the link carries FD frames; what it carries else the drives do not hear."""
        n = len(ratings)
        self.f: F64 = np.zeros((n, cells.FLOATS))
        self.i: I64 = np.zeros((n, cells.INTS), dtype=np.int64)
        self.drives = [Slot(r, f, i) for r, f, i in zip(ratings, self.f, self.i, strict=True)]
        self.torque, self.drag = np.zeros(n), np.zeros(n)  # what each joint gets [Nm]
        self._room = bytearray(16 * n)
        self._motion: F64 = np.frombuffer(self._room, dtype=np.float64).reshape(2, n)  # q, qd as the joints truly are
        self._pack = struct.Struct(f"{2 * n}d").pack_into
        self.size = CANFD_MTU if fd else CAN_MTU  # [bytes] of a raw frame
        e2e = any(r.e2e for r in ratings)
        self._forms: list[I64] = [np.array((self.size, fd, e2e, clocked), dtype=np.int64) for clocked in (False, True)]

        self._warm()

    def _warm(self) -> None:
        """Have everything compiled, or loaded: on no drives and no frames."""
        f, i, none = self.f[:0], self.i[:0], Batch(1)
        bank_kernels.answer(f, i, self._forms[0], none.raw, none.lengths[:0], 0, none.raw, 0)
        bank_kernels.actuate(f, i, 1, self.torque, self.drag)
        bank_kernels.sense(f, i, self._motion)
        bank_kernels.close_period(f, i)

    def answer(self, came: Batch, replies: Batch, first: int, end: int, clocked: bool) -> tuple[int, int]:
        """Take the frames of a batch from `first` to `end`, that one not included, and add the replies to another.

        Returns the next frame and why it stopped there, see `bank_kernels.answer`; `clocked`: for the clock, too.
        """
        before = replies.count
        at, replies.count, why = bank_kernels.answer(
            self.f, self.i, self._forms[clocked], came.raw, came.lengths[:end], first, replies.raw, before
        )
        if replies.room != self.size:
            replies.lengths[before : replies.count] = self.size
        return at, why

    def actuate(self, dt_ns: int) -> bool:
        """Advance all drives by dt; `torque` and `drag` are then what the joints get. Return whether one is enabled."""
        event, enabled = bank_kernels.actuate(self.f, self.i, dt_ns, self.torque, self.drag)
        if event:
            self._write_down()
        return enabled

    def sense(self, q: Sequence[float], qd: Sequence[float]) -> None:
        """Let every drive take its joint's true position [rad] and speed [rad/s]."""
        self._pack(self._room, 0, *q, *qd)
        if bank_kernels.sense(self.f, self.i, self._motion):
            self._write_down()

    def close_period(self) -> None:
        """Note the largest torques; forget which drives were commanded."""
        bank_kernels.close_period(self.f, self.i)

    def _write_down(self) -> None:
        for drive in self.drives:
            drive.write_down()
