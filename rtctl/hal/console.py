"""The control socket, daemon side: what operators, cameras and planners say, one message per tick at most.

Every call is non-blocking and its work is bounded: whatever peers do, a poll costs at most one wait of zero length, one
accepted connection, one received message and one reply. The verdict on a request is the tick's own: `poll` hands the
request out, `answer` sends what became of it.
"""

import errno
import math
import os
import select
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import NamedTuple

import msgspec
import numpy as np

from rtctl import trust
from rtctl.errors import RequestError, RtctlError
from rtctl.hal import messages
from rtctl.hal.client import MESSAGE_MAX
from rtctl.hal.lobby import PEERS_MAX, Door, listen
from rtctl.hal.messages import Bounds, Notice
from rtctl.plain import Json
from rtctl.types import Array, ObstacleEdit, Request

EDITS_PER_SLOT = 4  # obstacle edits handed to one tick; a longer camera frame is spread over several
NOTICES_MAX = 64  # names that may wait for their slot
BYTES_PER_SLOT = 8 * 1024  # of requests on average: a full message costs the next slots their turn
IDLE = 1.0  # [s] of silence after which a peer must make room for a new one
STATUS_AGE = 0.02  # [s] for which one snapshot answers every status query
NOTHING = Request()

StatusFn = Callable[[], Json]
PlaceFn = Callable[[ObstacleEdit], str]  # why an obstacle cannot be where a person says, '' where it can


class _Peer:
    """One connection."""

    def __init__(self, link: socket.socket, slot: int) -> None:
        self.link, self.slot = link, slot  # slot: when it last spoke


class _Held(NamedTuple):
    """A request that came and waits for its tick."""

    peer: _Peer
    request: Request


class Console:
    """The listening socket, its peers, and the requests between them and the tick."""

    def __init__(
        self,
        path: str,
        period: float,
        bounds: Bounds,
        members: Iterable[int] = (),
        door: Door | None = None,
    ) -> None:
        """Listen at `path`; serve this user, root and the user ids in `members`.

        `period` [s] of a slot; goals must lie in `bounds`. door: who listens there already, and its callers.
        Raises ConfigError when the place is unsafe or taken.
        """
        self.path, self.counts = path, Counter[str]()
        self._period, self._bounds = period, bounds
        self._admitted = frozenset((0, os.geteuid(), *members))
        self._listener, callers = door or Door(listen(path))
        self._epoll = select.epoll()
        self._epoll.register(self._listener, select.EPOLLIN)
        self._peers: dict[int, _Peer] = {}
        self._buffer = bytearray(MESSAGE_MAX)
        self._held: _Held | None = None  # read, not yet given to a tick
        self._asker: _Peer | None = None  # whose request is before the tick now
        self._notices: dict[str, tuple[Notice, int]] = {}  # a camera's news that wait, and the slot they came in
        self._camera_turn = False  # whether the request before the tick is the camera's
        self._camera_refusal = ""  # the tick's word on the camera's last news; told with the next frame
        self._credit = BYTES_PER_SLOT  # bytes that may be read before the next ones must wait
        self._status: StatusFn = dict
        self._world: StatusFn = dict
        self._misplaced: PlaceFn = lambda edit: ""
        self._snapshot, self._snapshot_slot = b"", -1
        self._slot = 0
        for link in callers:
            self._admit(link)

    def publish(self, status: StatusFn, world: StatusFn = dict, misplaced: PlaceFn = lambda edit: "") -> None:
        """Set where snapshots come from, and who judges the place of an obstacle that a person tells of.

        Called only when somebody asks or tells; `status` at most once in STATUS_AGE.
        """
        self._status, self._world, self._misplaced = status, world, misplaced

    def poll(self, slot: int) -> Request:
        """Return the request for the tick of `slot`; call `answer` after that tick. Never blocks, bounded work."""
        self._slot = slot
        self._answer_asker(False, "the controller gave no verdict")
        self._serve()
        if self._notices and (self._held is None or not self._camera_turn):  # they take turns: neither starves
            self._camera_turn = True
            return Request(obstacles=self._take_edits())
        self._camera_turn = False
        if self._held is None:
            return NOTHING
        self._asker, request = self._held
        self._held = None
        return request

    def answer(self, ok: bool, text: str = "") -> None:
        """Tell whoever asked what the tick made of the request of the last poll; without one, do nothing.

        `text` is the reason of a refusal, or a remark.
        """
        if self._camera_turn:
            self._camera_refusal = "" if ok else text or "refused"
        self._answer_asker(ok, text)

    def close(self) -> None:
        """Hang up on every peer and remove the socket."""
        for peer in list(self._peers.values()):
            self._drop(peer, "")
        self._epoll.close()
        self._listener.close()
        with suppress(OSError):
            os.unlink(self.path)

    # -- peers ---------------------------------------------------------------------------------------------------

    def _serve(self) -> None:
        """Accept at most one peer and read at most one message."""
        self._credit = min(self._credit + BYTES_PER_SLOT, BYTES_PER_SLOT)
        ready = {fd for fd, _ in self._epoll.poll(0.0, PEERS_MAX + 1)}
        if not ready:
            return
        if self._listener.fileno() in ready:
            ready.remove(self._listener.fileno())
            self._accept()
        speakers = [self._peers[fd] for fd in ready if fd in self._peers]
        if speakers and self._held is None and self._credit > 0:
            self._read(min(speakers, key=lambda peer: peer.slot))  # longest unheard first: nobody starves

    def _accept(self) -> None:
        try:
            link, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE) and self._peers:  # who waits gets that of who says nothing
                self._make_room()
            return
        link.setblocking(False)
        _, uid = trust.peer(link)
        if uid not in self._admitted:
            self.counts["foreign_user"] += 1
            link.close()
            return
        if len(self._peers) >= PEERS_MAX and (wait := self._make_room()) > 0.0:
            self.counts["too_many"] += 1
            self._send(link, {"ok": False, "error": f"{PEERS_MAX} peers are connected already", "room_in_s": wait})
            link.close()
            return
        self._admit(link)

    def _admit(self, link: socket.socket) -> None:
        self._peers[link.fileno()] = _Peer(link, self._slot)
        self._epoll.register(link, select.EPOLLIN)

    def _make_room(self) -> float:
        """Drop the peer that has been silent longest, if long enough: a forgotten terminal must not keep `stop` out.

        Return how long [s] it may yet be silent before it must go, 0 when it went.
        """
        peer = min(self._peers.values(), key=lambda peer: peer.slot)
        left = IDLE - (self._slot - peer.slot) * self._period
        if left <= 0.0:
            self._drop(peer, "idle")
        return max(left, 0.0)

    def _read(self, peer: _Peer) -> None:
        peer.slot = self._slot
        try:
            size = peer.link.recv_into(self._buffer, 0, socket.MSG_TRUNC)  # MSG_TRUNC: the size it really had
        except BlockingIOError:
            return
        except OSError:
            size = 0
        self._credit -= min(size, MESSAGE_MAX)
        if size == 0:  # end of the connection, or an empty message
            self._drop(peer, "")
            return
        try:
            if size > MESSAGE_MAX:
                raise RequestError(f"a message of {size} bytes, at most {MESSAGE_MAX} are taken")
            message = messages.decode(memoryview(self._buffer)[:size])
        except RtctlError as error:
            self.counts["malformed"] += 1
            self._reply(peer, {"ok": False, "error": str(error)})
            self._drop(peer, "")
            return
        try:
            self._take(peer, message)
        except RtctlError as error:  # well-formed but out of the question: the peer may go on talking
            self.counts["refused"] += 1
            self._reply(peer, {"ok": False, "error": str(error)})

    def _take(self, peer: _Peer, message: messages.Message | messages.CloudFrame) -> None:
        """Answer `message` or hold it for the tick. Raises RequestError."""
        match message:
            case messages.Status():
                self._reply_raw(peer, self._status_reply())
            case messages.World():
                self._reply_raw(peer, self._encoded(self._world))
            case messages.ObstaclesMessage() | messages.CloudFrame(header=messages.CloudMessage(feed=True)):
                notices = messages.notices_of(message, time.monotonic())
                self._queue(notices)
                self._reply(peer, {"ok": True, "accepted": len(notices), "refused": self._camera_refusal})
            case _:
                request = messages.request_of(message, self._bounds, self._orientation, time.monotonic())
                for edit in request.obstacles:  # a camera is believed: what it sees may have come into contact
                    if why := self._misplaced(edit):
                        raise RequestError(f"obstacle {edit.name}: {why}")
                    self._forget(edit.name)  # newer than what a camera said before
                self._held = _Held(peer, request)

    def _drop(self, peer: _Peer, count: str) -> None:
        """Close a connection; closing also takes it out of the epoll set."""
        if count:
            self.counts[count] += 1
        self._peers.pop(peer.link.fileno(), None)
        peer.link.close()

    # -- a camera's news -----------------------------------------------------------------------------------------

    def _queue(self, notices: list[Notice]) -> None:
        """Let the newest notice of each name wait for its slot. Raises RequestError when too many names wait."""
        if len(self._notices.keys() | {notice.name for notice in notices}) > NOTICES_MAX:
            raise RequestError(f"more than {NOTICES_MAX} obstacles wait to be taken over")
        for notice in notices:
            self._notices[notice.name] = (notice, self._slot)

    def _forget(self, name: str) -> None:
        """Drop what waits about `name`, or about all."""
        if name == "*":
            self._notices.clear()
        self._notices.pop(name, None)

    def _take_edits(self) -> tuple[ObstacleEdit, ...]:
        """Return the next few edits, or one cloud, each older by the slots that it waited."""
        names = list(self._notices)[:EDITS_PER_SLOT]
        heavy = next((k for k, name in enumerate(names) if self._notices[name][0].steps), len(names))
        taken = [self._notices.pop(name) for name in names[: max(heavy, 1)]]
        return tuple(notice.edit((self._slot - slot) * self._period) for notice, slot in taken)

    # -- replies -------------------------------------------------------------------------------------------------

    def _answer_asker(self, ok: bool, text: str) -> None:
        if self._asker is None:
            return
        peer, self._asker = self._asker, None
        self._snapshot_slot = -1  # whoever asks next sees the consequence, not the time before it
        reply: Json = {"ok": ok, "slot": self._slot}
        if text:
            reply["text" if ok else "error"] = text
        elif not ok:
            reply["error"] = "refused"
        self._reply(peer, reply)

    def _status_reply(self) -> bytes:
        """Return the encoded snapshot, renewed when it is older than STATUS_AGE."""
        if self._snapshot_slot < 0 or (self._slot - self._snapshot_slot) * self._period >= STATUS_AGE:
            self._snapshot, self._snapshot_slot = self._encoded(self._status), self._slot
        return self._snapshot

    def _encoded(self, report: StatusFn) -> bytes:
        try:
            return msgspec.json.encode({"ok": True, **report()}, enc_hook=_plain)
        except Exception as error:  # a report that fails must not stop the arm
            self.counts["status_failed"] += 1
            return msgspec.json.encode({"ok": False, "error": f"no status: {error}"})

    def _orientation(self) -> list[float]:
        """Return the tip's present orientation, for a goal that holds it."""
        wxyz = [float(c) for c in self._status().get("wxyz", ())]
        if len(wxyz) != 4 or not all(map(math.isfinite, wxyz)):
            raise RequestError("goal.hold: the tip's orientation is not known yet")
        return wxyz

    def _reply(self, peer: _Peer, reply: Json) -> None:
        self._reply_raw(peer, msgspec.json.encode(reply))

    def _reply_raw(self, peer: _Peer, data: bytes) -> None:
        """Send or drop the peer: a reader that lets its queue run full is not waited for."""
        try:
            peer.link.send(data)
        except OSError as error:
            self._drop(peer, "slow_reader" if error.errno == errno.EAGAIN else "")

    @staticmethod
    def _send(link: socket.socket, reply: Json) -> None:
        with suppress(OSError):
            link.send(msgspec.json.encode(reply))


def _plain(value: Array | np.generic) -> object:
    """Return an array or numpy scalar as JSON has it."""
    return value.tolist()
