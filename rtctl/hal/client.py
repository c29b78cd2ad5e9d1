"""Asking a running daemon: one JSON object out, one back, over its control socket. Standard library alone."""

import errno
import json
import os
import socket
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from rtctl.errors import LinkError, RequestError, UsageError
from rtctl.plain import Json
from rtctl.trust import folder_owner, peer, trusted_users, user_name

MESSAGE_MAX = 64 * 1024  # bytes, both ways
SYSTEM = Path("/run/rtctl")  # RuntimeDirectory of the shipped unit: root makes it, for the user of the unit
LOOK = 0.1  # [s] between two looks for a daemon that starts
RETRY = 0.005  # [s] between two attempts when the daemon's queue of callers is full


def socket_folders() -> list[Path]:
    """Return the folders where daemons of this user or of the system put their control sockets, most specific first."""
    folders = []
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if runtime:
        folders.append(Path(runtime))
    folders.append(Path(f"/tmp/rtctl-{os.getuid()}"))
    folders.append(SYSTEM)
    return folders


def default_path(robot: str) -> str:
    """Return where the daemon of `robot` listens when its config names no socket."""
    service = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]  # set by systemd
    folder = Path(service) if service else socket_folders()[0]
    return str(folder / f"rtctl-{robot}.sock")


def find(robot: str = "", patience: float = 0.0) -> str:
    """Return the socket of `robot`, or of the only daemon there is; wait `patience` [s] for one that starts.

    Raises LinkError when there is none, UsageError when it takes a name to choose.
    """
    until = time.monotonic() + patience
    while True:
        alive = running()
        found = [path for path in alive if not robot or Path(path).name == f"rtctl-{robot}.sock"]
        if len(found) == 1:
            return found[0]
        if len(found) > 1:
            raise UsageError(f"got several daemons, wanted --robot NAME or --socket PATH of one: {', '.join(found)}")
        if time.monotonic() >= until:
            break
        time.sleep(LOOK)
    if alive:
        names = ", ".join(Path(path).stem.removeprefix("rtctl-") for path in alive)
        raise LinkError(f"--robot: got {robot}, of which no daemon is running, wanted one of {names}")
    looked = ", ".join(str(folder) for folder in socket_folders())
    whose = f"of {robot} " if robot else ""
    raise LinkError(f"no daemon {whose}is running (rtctl run CONFIG starts one): none answers in {looked}")


def running() -> list[str]:
    """Return the sockets of all daemons that answer and may be believed."""
    places = [place for folder in socket_folders() for place in (folder, *_subfolders(folder))]
    mine = [place for place in places if _listens_to_us(place)]
    found = sorted({str(path) for place in mine for path in place.glob("rtctl-*.sock") if path.is_socket()})
    return [path for path in found if answers(path)]


def _listens_to_us(folder: Path) -> bool:
    """Return whether only this user, root or the unit's own user can have put a socket into a folder."""
    owner = folder_owner(folder / "any")
    return owner in trusted_users() or (owner >= 0 and SYSTEM in (folder, *folder.parents))


def _check_peer(link: socket.socket, path: str) -> None:
    """Refuse a daemon that somebody else put where ours is looked for. Raises LinkError."""
    pid, uid = peer(link)
    if uid not in trusted_users() | {folder_owner(path)}:
        link.close()
        raise LinkError(
            f"{path}: process {pid} of user {user_name(uid)} answers there, wanted one of "
            f"{user_name(os.geteuid())}, root or the folder's owner"
        )


def answers(path: str) -> bool:
    """Return whether somebody listens at `path`; a socket file outlives a killed process."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) as probe:
        code = probe.connect_ex(path)
    return code in (0, errno.EAGAIN, errno.EACCES)  # queue full, or not for us to talk to: alive all the same


class Session:
    """A connection to the daemon that serves many questions."""

    def __init__(self, path: str, timeout: float = 2.0) -> None:
        """Connect within `timeout` [s]; it also bounds each answer. Raises LinkError."""
        self.path, self.timeout = path, timeout
        self._socket = _connect(path, timeout)

    def ask(self, message: Json) -> Json:
        """Return the daemon's reply. Raises LinkError when none comes, RequestError when `message` is too large."""
        try:
            timed = {"by_s": time.monotonic() + self.timeout, **message} if "verb" in message else message
            data = json.dumps(timed, allow_nan=False).encode()
        except ValueError as error:  # nan and infinity are not JSON
            raise RequestError(f"not a request: {error}") from None
        return self.ask_raw(data)

    def ask_raw(self, data: bytes) -> Json:
        """Return the daemon's reply to a message that is bytes already, as a cloud's is; raises as `ask`.

        A daemon with too many callers says when one of them must make room: that is waited for, within the timeout.
        """
        if len(data) > MESSAGE_MAX:
            raise RequestError(f"a request of {len(data)} bytes, at most {MESSAGE_MAX} are taken")
        until = time.monotonic() + self.timeout
        while True:
            reply = self._reply(data)
            wait = reply.get("room_in_s")
            if not isinstance(wait, float) or time.monotonic() + wait >= until:
                return reply
            self.close()
            time.sleep(max(wait, RETRY))
            self._socket = _connect(self.path, self.timeout)

    def _reply(self, data: bytes) -> Json:
        try:
            raw = self._exchange(data)
        except TimeoutError:
            raise LinkError(f"{self.path}: no answer within {self.timeout:g} s") from None
        except OSError as error:
            raise LinkError(f"{self.path}: {error.strerror}") from None
        if not raw:
            raise LinkError(f"{self.path}: the daemon closed the connection")
        try:
            reply = json.loads(raw)
        except ValueError:
            reply = None
        if not isinstance(reply, dict):
            raise LinkError(f"{self.path}: not a reply of rtctl: {raw[:60]!r}")
        return reply

    def _exchange(self, data: bytes) -> bytes:
        with suppress(BrokenPipeError):  # hung up on already: its reason may wait to be read
            self._socket.send(data)
        try:
            return self._socket.recv(MESSAGE_MAX)
        except ConnectionResetError:  # said before the last words that were sent; they come after it
            return self._socket.recv(MESSAGE_MAX)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def ask(path: str, message: Json, timeout: float = 2.0) -> Json:
    """Return the reply of the daemon at `path` to one `message`. Raises LinkError."""
    with Session(path, timeout) as session:
        return session.ask(message)


def demand(path: str, message: Json, timeout: float = 2.0) -> Json:
    """Return the reply to `message` if the daemon did it. Raises RequestError with the daemon's reason, LinkError."""
    return accepted(ask(path, message, timeout))


def accepted(reply: Json) -> Json:
    """Return `reply` if it says yes. Raises RequestError with the daemon's reason."""
    if reply.get("ok") is not True:
        raise RequestError(f"refused: {reply.get('error', 'without a reason')}")
    return reply


def _connect(path: str, timeout: float) -> socket.socket:
    """Connect, waiting while the daemon's queue of callers is full."""
    deadline = time.monotonic() + timeout
    while True:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
        link.setblocking(False)
        try:
            code = link.connect_ex(path)
        except OSError as error:  # a path too long for an address
            link.close()
            raise LinkError(f"{path}: {error}") from None
        if code == 0:
            _check_peer(link, path)
            link.settimeout(timeout)
            return link
        link.close()
        if code != errno.EAGAIN or time.monotonic() >= deadline:
            what = {errno.ENOENT: "no such socket", errno.ECONNREFUSED: "a socket on which no daemon is listening"}
            raise LinkError(f"{path}: got {what.get(code, os.strerror(code).lower())}, wanted that of a running daemon")
        time.sleep(RETRY)


def _subfolders(folder: Path) -> list[Path]:
    """Return the folders of the unit's instances below /run/rtctl; elsewhere sockets lie flat."""
    return [path for path in folder.glob("*") if path.is_dir()] if folder == SYSTEM else []
