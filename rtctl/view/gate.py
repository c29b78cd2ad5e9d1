"""What stands between a page's server and the network: who may connect at all.

The server behind it listens on the loopback alone. Every connection's first request is looked at here. From this
machine, a process of this user or of root may connect; from elsewhere, who knows the token, which the address carries
once and a cookie from then on. A page of another site may not: a browser tells who asks by `Origin`.
"""

import asyncio
import hmac
import ipaddress
import secrets
import threading
from contextlib import suppress
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

from rtctl.errors import LinkError
from rtctl.trust import trusted_users

HEAD_MAX = 16 * 1024  # [bytes] of a request's head
HEAD_TIME = 10.0  # [s] for it to come
COOKIE = "rtctl_view"
PIECE = 64 * 1024  # [bytes]
TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))


class Request(NamedTuple):
    """The head of a request, as far as it matters."""

    path: str
    host: str
    origin: str
    cookie: str


class Gate:
    """Listens at an address, and hands connections on to a port of the loopback."""

    def __init__(self, host: str, port: int, behind: int) -> None:
        """Begin to listen; port 0: any that is free. Raises LinkError."""
        self.host, self._behind = host, behind
        self.is_local = _is_loopback(host)
        self.token = "" if self.is_local else secrets.token_urlsafe(24)
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(asyncio.start_server(self._serve, host, port, limit=HEAD_MAX))
        except OSError as error:
            self._loop.close()
            raise LinkError(f"--host {host} --port {port}: {error.strerror or error}") from None
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Return the address that a browser is to open."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def close(self) -> None:
        """Stop listening and end all connections."""
        asyncio.run_coroutine_threadsafe(self._ended(), self._loop).result(10.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        self._loop.close()

    async def _ended(self) -> None:
        self._server.close()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        await asyncio.sleep(0.01)  # transports that were closed leave the loop in its next turns

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await self._judge(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.CancelledError):
            pass  # who hangs up, or says too much or nothing, gets no answer; nor does anybody when the gate closes
        finally:
            writer.close()

    async def _judge(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer a connection, or hand it on."""
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_TIME)
        request = parsed(head)
        why = self._refusal(request, writer)
        if why:
            await _reply(writer, "403 Forbidden", f"rtctl view: {why}\n")
        elif self.token and _token_of(request.path):
            cookie = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            await _reply(writer, "303 See Other", "", f"Location: /\r\nSet-Cookie: {cookie}\r\n")
        else:
            await self._hand_on(head, reader, writer)

    def _refusal(self, request: Request, writer: asyncio.StreamWriter) -> str:
        """Return why a connection may not be, '' where it may."""
        if request.origin and urlsplit(request.origin).netloc != request.host:
            return f"a page of {request.origin} may not connect"
        if self.is_local:
            if not _is_loopback(urlsplit(f"//{request.host}").hostname or ""):
                return f"asked for as {request.host}, wanted {self.host}"  # a name that was made to mean this machine
            owner = owner_of(writer.get_extra_info("peername"), writer.get_extra_info("sockname"))
            return "" if owner in trusted_users() else f"user {owner} of this machine may not connect"
        given = _token_of(request.path) or request.cookie
        return "" if hmac.compare_digest(given.encode(), self.token.encode()) else "the address lacks the right token"

    async def _hand_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner, outer = await asyncio.open_connection("127.0.0.1", self._behind)
        outer.write(head)
        ways = [asyncio.ensure_future(_copy(reader, outer)), asyncio.ensure_future(_copy(inner, writer))]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            outer.close()


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while piece := await source.read(PIECE):
            target.write(piece)
            await target.drain()


async def _reply(writer: asyncio.StreamWriter, status: str, text: str, more: str = "") -> None:
    body = text.encode()
    head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {len(body)}\r\n{more}"
    writer.write(f"{head}Connection: close\r\n\r\n".encode() + body)
    await writer.drain()


def parsed(head: bytes) -> Request:
    """Return what matters of a request's head."""
    lines = head.decode("latin-1").split("\r\n")
    words = lines[0].split(" ")
    fields = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines[1:])}
    try:
        kept = SimpleCookie(fields.get("cookie", "")).get(COOKIE)
    except CookieError:
        kept = None
    path = words[1] if len(words) > 1 else "/"
    return Request(path, fields.get("host", ""), fields.get("origin", ""), kept.value if kept is not None else "")


def _token_of(path: str) -> str:
    return next(iter(parse_qs(urlsplit(path).query).get("token", [])), "")


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def owner_of(peer: tuple[str, int], here: tuple[str, int]) -> int:
    """Return the user id of the process at the other end of a connection of this machine; -1 when it is not found."""
    wanted = (peer[1], here[1])
    for table in TABLES:
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            words = line.split()
            ports = tuple(int(address.rpartition(":")[2], 16) for address in words[1:3])
            if ports == wanted and words[3] == "01":  # established
                return int(words[7])
    return -1
