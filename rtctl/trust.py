"""Who may be believed: everything that this program shares with others on the machine is opened here.

A name in a shared folder says nothing about who made what lies there. So a file is opened first, without following
links, and then judged by its open descriptor: what it is, who owns it, who else may write it. A peer at a socket is
judged by the user id that the kernel gives for it. Nothing that another user wrote decides a path.
"""

import errno
import os
import pwd
import socket
import stat
import struct
from collections.abc import Container
from contextlib import suppress
from pathlib import Path

from rtctl.errors import RtctlError

_PEERCRED = struct.Struct("3i")  # pid, uid, gid
PLAIN = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-+")


class TrustError(RtctlError):
    """Something shared is not what its name says, or belongs to somebody who has no say here."""


def user_name(uid: int) -> str:
    """Return how people call a user: name and number, the number alone where there is no name."""
    with suppress(KeyError):
        return f"{pwd.getpwuid(uid).pw_name} ({uid})"
    return str(uid)


def user_id(text: str) -> int:
    """Return the id of a user who is named, or given by number. Raises TrustError where there is none."""
    if text.isascii() and text.isdecimal() and int(text) < 1 << 32:
        return int(text)
    try:
        return pwd.getpwnam(text).pw_uid
    except (KeyError, ValueError):
        raise TrustError(f"{text[:80]!r}: no user of this machine") from None


def trusted_users() -> frozenset[int]:
    """Return the user ids whose files and sockets count: this process's own, and root's."""
    return frozenset((0, os.geteuid()))


def open_file(path: Path | str, flags: int, users: Container[int] | None = None, private: bool = False) -> int:
    """Return the descriptor of an existing regular file of a trusted user that no other user can write.

    flags: O_RDONLY or O_RDWR. users: who may own it, by default this user and root. private: nobody else may read it
    either, which a secret wants. Raises TrustError when it is anything else, OSError when it cannot be opened.
    """
    try:
        descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)  # a FIFO must not hold us up
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise TrustError(f"{path}: a symbolic link, wanted the file itself") from None
        raise
    try:
        _judge(path, os.fstat(descriptor), trusted_users() if users is None else users, private)
    except TrustError:
        os.close(descriptor)
        raise
    return descriptor


def _judge(path: Path | str, found: os.stat_result, users: Container[int], private: bool) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise TrustError(f"{path}: no regular file")
    if found.st_uid not in users:
        raise TrustError(f"{path}: belongs to {user_name(found.st_uid)}, wanted {user_name(os.geteuid())} or root")
    if found.st_nlink != 1:
        raise TrustError(f"{path}: has {found.st_nlink} names, wanted one: another may be in a stranger's folder")
    forbidden = 0o077 if private else 0o022
    if found.st_mode & forbidden:
        what = "read or write" if private else "write"
        raise TrustError(f"{path}: mode {stat.S_IMODE(found.st_mode):04o} lets others {what} it")


def own_folder(path: Path | str, mode: int = 0o750) -> None:
    """Make a folder, or check that the one there is a trusted user's and that no stranger can put files in it.

    Raises TrustError, or OSError when it cannot be made.
    """
    with suppress(FileExistsError):
        os.mkdir(path, mode)
    found = os.lstat(path)
    if stat.S_ISLNK(found.st_mode):  # systemd links RuntimeDirectory names: whose link it is decides
        if found.st_uid not in trusted_users():
            raise TrustError(f"{path}: a symbolic link of {user_name(found.st_uid)}")
        found = os.stat(path)
    if not stat.S_ISDIR(found.st_mode):
        raise TrustError(f"{path}: no folder")
    if found.st_uid not in trusted_users():
        raise TrustError(f"{path}: belongs to {user_name(found.st_uid)}, wanted {user_name(os.geteuid())} or root")
    if found.st_mode & 0o002:
        raise TrustError(f"{path}: mode {stat.S_IMODE(found.st_mode):04o} lets everybody put files there")


def peer(link: socket.socket) -> tuple[int, int]:
    """Return process id and user id of whoever is at the other end of a Unix socket, as the kernel knows them."""
    pid, uid, _ = _PEERCRED.unpack(link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEERCRED.size))
    return int(pid), int(uid)


def folder_owner(path: Path | str) -> int:
    """Return who owns the folder that a path lies in, -1 where everybody may put files there or there is none.

    Only an owner can have put a socket into a folder that others cannot write.
    """
    try:
        found = os.stat(os.path.dirname(os.path.abspath(path)))
    except OSError:
        return -1
    return -1 if found.st_mode & 0o002 else found.st_uid


def plain_name(name: str) -> str:
    """Return a name that names one file in one folder and nothing else. Raises TrustError."""
    if not name or name.startswith(".") or not set(name) <= PLAIN:
        raise TrustError(f"{name[:80]!r}: no plain file name")
    return name
