"""Raw frames of the bus to the drives of an arm and back, with whatever the injected faults do to them on their way.

A batch goes through compiled code as far as it is of the common form and nothing is injected; what is not goes frame
by frame through `Drive`'s own Python, in the same order.
"""

from collections.abc import Sequence

import numpy as np

from firmware_sim import codec
from firmware_sim.bank import Bank
from firmware_sim.bank_kernels import AGAIN, ALL_READ, EVERYBODY, UNCOMMON
from firmware_sim.batch import Batch
from firmware_sim.cells import COMMANDED
from firmware_sim.drive import Drive
from firmware_sim.inject import Injector
from firmware_sim.traffic import SILENT, Traffic
from rtctl.protocol import frame

NO_TORQUE = bytes.fromhex("7fff7ff0000007ff")  # of the MIT mode: no gains, the middle of every range
TOLD = {  # error frames of Linux by which an interface says what it has become: identifier, data[1]
    "bus_off": (frame.ERR_BUSOFF, 0),
    "error_passive": (frame.ERR_CRTL, 0x10),  # too many errors in what it received
    "": (frame.ERR_CRTL | frame.ERR_RESTARTED, 0x40),  # error-active again
}


class Wire:
    """Routes frames by their identifier; owns nothing."""

    def __init__(
        self, bank: Bank, injector: Injector, fd: bool, traffic: Traffic = SILENT, others: Sequence[Drive] = ()
    ) -> None:
        """`others`: drives of the bus that are no joint's."""
        self.others = {d.rating.motor: d for d in others}
        self.bank, self.injector, self.fd, self.traffic = bank, injector, fd, traffic
        self.drives = bank.drives
        self.by_id = {d.rating.motor: k for k, d in enumerate(self.drives)}
        self.interface = ""  # of inject.INTERFACE, what the controller's was told to be

    def answer(self, now: int, came: Batch, replies: Batch, first: int, clocked: bool) -> tuple[int, int]:
        """Take the frames of a batch from `first` on, each answered at once; add the replies to another batch.

        now: [ns] on the scenario's clock. clocked: stop before a second frame to a drive within a period (AGAIN), and
        once every drive has had one (EVERYBODY). Returns the next frame, and why it stopped there: else ALL_READ.
        """
        at, quiet = first, self.traffic.quiet and self.injector.quiet(now) and not self.interface
        while at < came.count:
            end = self._own(came, at)
            if quiet and at < end:
                at, why = self.bank.answer(came, replies, at, end, clocked)
                if why != UNCOMMON and (why != ALL_READ or at == came.count):
                    return at, why
            raw = came.frame(at)
            if clocked and self._repeats(raw):
                return at, AGAIN
            replies.extend(self.answer_one(now, raw))
            at += 1
            if clocked and self.bank.i[:, COMMANDED].all():
                return at, EVERYBODY
        return at, ALL_READ

    def _own(self, came: Batch, first: int) -> int:
        """Return where the first frame from `first` on is that one of the others has to take; else the end."""
        if not self.others:
            return came.count
        ids = came.raw[first : came.count, 0].astype(np.int64) | came.raw[first : came.count, 1].astype(np.int64) << 8
        at = np.flatnonzero(np.isin(ids, list(self.others)))
        return first + int(at[0]) if len(at) else came.count

    def _repeats(self, raw: bytes) -> bool:
        """Tell whether a frame commands a joint that has its command of this period already."""
        try:
            f = frame.unpack(raw)
        except ValueError:
            return False
        k = self.by_id.get(f.can_id, -1)
        return k >= 0 and bool(self.bank.i[k, COMMANDED]) and not (f.error or f.rtr or f.extended)

    def answer_one(self, now: int, raw: bytes) -> list[bytes]:
        """Take one frame; return the replies to it, after what the controller's interface says of itself."""
        before, self.interface = self.interface, self.injector.interface(now)
        said = [] if self.interface == before else [self._told(self.interface)]
        return said if self.interface == "bus_off" else said + self._answered(now, raw)

    def _told(self, state: str) -> bytes:
        can_id, detail = TOLD[state]
        return frame.pack(can_id, bytes((0, detail)) + bytes(6), fd=self.fd, error=True)

    def _answered(self, now: int, raw: bytes) -> list[bytes]:
        try:
            f = frame.unpack(raw)
        except ValueError:
            return []
        if f.error or f.rtr or f.extended or f.fd != self.fd:
            return []
        if f.can_id == codec.REGISTER_ID:
            return self._register(now, f.data)
        k = self.by_id.get(f.can_id, -1)
        if f.can_id in self.others:
            return self._other(self.others[f.can_id], self.others[f.can_id].receive(f.data))
        if k < 0:
            return []
        self.bank.i[k, COMMANDED] = 1
        data = self.injector.command(now, k, f.data)
        said = self._sent(now, k, self.drives[k].receive(data) if data is not None else None)
        if self.injector.active("foreign", now, k):
            said.append(frame.pack(f.can_id, NO_TORQUE, fd=self.fd, brs=self.fd))
            said += self._sent(now, k, self.drives[k].receive(NO_TORQUE))
        return said

    def _register(self, now: int, data: bytes) -> list[bytes]:
        motor = codec.decode_register(data).motor if len(data) >= 8 else -1
        if motor in self.others:
            return self._other(self.others[motor], self.others[motor].register(data))
        k = self.by_id.get(motor, -1)
        return self._sent(now, k, self.drives[k].register(data)) if k >= 0 else []

    def _other(self, drive: Drive, reply: bytes | None) -> list[bytes]:
        can_id = int(drive.registers[codec.MST_ID])
        return [] if reply is None else [frame.pack(can_id, reply, fd=self.fd, brs=self.fd)]

    def _sent(self, now: int, k: int, reply: bytes | None) -> list[bytes]:
        """Return a drive's reply as frames on the bus, after whatever injector and traffic do to it."""
        if reply is None:
            return []
        can_id = int(self.drives[k].registers[codec.MST_ID])
        sent = [frame.pack(can_id, p, fd=self.fd, brs=self.fd) for p in self.injector.reply(now, k, reply)]
        return sent if self.traffic.quiet else self.traffic.carried(k, sent)


def of_registers(raw: bytes) -> bool:
    """Tell whether a frame is a register frame, which takes no time."""
    if raw[:1] != b"\xff":
        return False
    try:
        f = frame.unpack(raw)
    except ValueError:
        return False
    return f.can_id == codec.REGISTER_ID and not (f.error or f.rtr or f.extended)
