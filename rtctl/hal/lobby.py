"""The control socket before there is a controller: it says what the start is doing, and refuses everything else.

A thread of its own, for compilation and a handshake hold the main one. It ends before the loop begins: the listening
socket and the callers are handed over to the console, so that nobody finds the door shut in between, and who has just
asked is answered. Standard library alone.
"""

import errno
import json
import os
import select
import socket
import stat
import threading
from contextlib import suppress
from types import TracebackType
from typing import NamedTuple, Self

from rtctl import trust
from rtctl.errors import ConfigError
from rtctl.hal.client import MESSAGE_MAX, answers
from rtctl.plain import Json
from rtctl.trust import TrustError

PEERS_MAX = 8
STARTING = "STARTING"


class Door(NamedTuple):
    """Where callers come in, and those who are in."""

    listener: socket.socket
    peers: tuple[socket.socket, ...] = ()  # admitted, non-blocking; what they asked last may wait to be read


class Lobby:
    """Answers callers while a daemon starts."""

    def __init__(self, path: str, robot: str) -> None:
        """Listen at `path` for the daemon of `robot`. Raises ConfigError when the place is unsafe or taken."""
        self.path, self.robot = path, robot
        self._doing, self._done, self._total = "loading the program", 0, 0
        self._listener: socket.socket | None = listen(path)
        self._bell, self._ear = socket.socketpair()
        self._peers: list[socket.socket] = []  # the thread's own until it has ended
        self._thread = threading.Thread(target=self._serve, args=(self._listener,), daemon=True)
        self._thread.start()

    def tell(self, doing: str, done: int = 0, total: int = 0) -> None:
        """Set what callers hear: what is being done, and how much of it is done, total 0: nobody knows."""
        self._doing, self._done, self._total = doing, done, total

    def hand_over(self) -> Door:
        """Return the listening socket and the callers, served no more. To be called once."""
        self._end()
        assert self._listener is not None
        door = Door(self._listener, tuple(self._peers))
        self._listener = None
        return door

    def close(self) -> None:
        """Remove the socket if it was not handed over."""
        if self._listener is None:
            return
        self._end()
        for link in (self._listener, *self._peers):
            link.close()
        self._listener = None
        with suppress(OSError):
            os.unlink(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _end(self) -> None:
        self._bell.close()
        self._thread.join()
        self._ear.close()

    def _serve(self, listener: socket.socket) -> None:
        peers = self._peers
        while True:
            ready = select.select([self._ear, listener, *peers], [], [])[0]
            if self._ear in ready:
                return
            if listener in ready:
                self._accept(listener, peers)
            for peer in [peer for peer in peers if peer in ready]:
                if not self._answer(peer):
                    peers.remove(peer)
                    peer.close()

    @staticmethod
    def _accept(listener: socket.socket, peers: list[socket.socket]) -> None:
        with suppress(OSError):
            link, _ = listener.accept()
            link.setblocking(False)
            if trust.peer(link)[1] not in trust.trusted_users():
                link.close()
                return
            if len(peers) >= PEERS_MAX:
                peers.pop(0).close()
            peers.append(link)

    def _answer(self, peer: socket.socket) -> bool:
        """Answer one message; return whether the caller is still there."""
        try:
            raw = peer.recv(MESSAGE_MAX)
            if raw:
                peer.send(json.dumps(self._reply(raw)).encode())
        except OSError:
            return False
        return bool(raw)

    def _reply(self, raw: bytes) -> Json:
        verb = None
        with suppress(ValueError, RecursionError, AttributeError):
            verb = json.loads(raw).get("verb")
        starting = {"doing": self._doing, "done": self._done, "of": self._total}
        words = self._doing + (f", {self._done} of at most {self._total}" if self._total else "")
        if verb == "status":
            told = {"state": STARTING, "status": "no_goal", "detail": words, "faults": [], "starting": starting}
            return {"ok": True, "robot": self.robot, **told}
        error = f"the daemon of {self.robot} is not ready yet: {words}; no drive is enabled"
        return {"ok": False, "error": error, "starting": starting}


def listen(path: str) -> socket.socket:
    """Return a listening socket at `path`, for its owner and group alone. Raises ConfigError."""
    _check_folder(path)
    label = f"console.socket {path}"
    if os.path.lexists(path):
        if not stat.S_ISSOCK(os.lstat(path).st_mode):
            raise ConfigError(label, "a file that is no socket", "a free path")
        if answers(path):
            raise ConfigError(label, "a socket on which another daemon listens", "a free path")
        os.unlink(path)  # left behind by a daemon that was killed
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    try:
        os.fchmod(listener.fileno(), 0o660)  # before it has a name, so that it is never open to others
        listener.bind(path)
        listener.listen(PEERS_MAX)
    except OSError as error:
        listener.close()
        why = "its path is too long for a socket" if error.errno is None else os.strerror(error.errno or errno.EIO)
        raise ConfigError(label, why, "a path a socket can be bound to") from None
    return listener


def _check_folder(path: str) -> None:
    """Make the folder with mode 0750, or refuse one where strangers could replace the socket."""
    folder, label = os.path.dirname(os.path.abspath(path)), f"console.socket {path}"
    try:
        trust.own_folder(folder)
    except OSError as error:
        raise ConfigError(label, f"folder {folder}: {error.strerror}", "a folder that exists or can be made") from None
    except TrustError as error:
        raise ConfigError(label, str(error), "a folder of this user or root that others cannot write to") from None
