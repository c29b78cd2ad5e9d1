"""What other users of the machine leave lying about is not believed, whatever its name says."""

import json
import os
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from rtctl import trust
from rtctl.errors import LinkError
from rtctl.hal import client
from rtctl.log.record import recorder, ring
from rtctl.trust import TrustError
from tests.strangers import STRANGER, stranger

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="takes another user: run as root")


def made(path: Path, mode: int = 0o600, owner: int | None = None) -> Path:
    path.write_bytes(b"x")
    path.chmod(mode)
    if owner is not None:
        os.chown(path, owner, owner)
    return path


def test_a_file_of_ones_own_is_opened(tmp_path):
    os.close(trust.open_file(made(tmp_path / "file"), os.O_RDWR, private=True))


@pytest.mark.parametrize(("mode", "private"), [(0o666, False), (0o620, False), (0o644, True), (0o640, True)])
def test_a_file_that_others_may_write_or_a_secret_that_they_may_read_is_refused(tmp_path, mode, private):
    with pytest.raises(TrustError, match=f"mode {mode:04o}"):
        trust.open_file(made(tmp_path / "file", mode), os.O_RDONLY, private=private)


def test_links_folders_and_pipes_are_no_files(tmp_path):
    target = made(tmp_path / "target")
    (tmp_path / "soft").symlink_to(target)
    with pytest.raises(TrustError, match="symbolic link"):
        trust.open_file(tmp_path / "soft", os.O_RDONLY)
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(TrustError, match="no regular file"):
        trust.open_file(tmp_path / "pipe", os.O_RDONLY)
    os.link(target, tmp_path / "hard")
    with pytest.raises(TrustError, match="2 names"):
        trust.open_file(target, os.O_RDONLY)


@needs_root
def test_a_file_of_another_user_is_refused_by_the_owner_of_what_was_opened(tmp_path):
    with pytest.raises(TrustError, match=rf"belongs to .*{STRANGER}"):
        trust.open_file(made(tmp_path / "file", owner=STRANGER), os.O_RDONLY)


def test_folders_where_everybody_may_put_files_are_refused(tmp_path):
    trust.own_folder(tmp_path / "mine")
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o750
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o1777)
    with pytest.raises(TrustError, match="lets everybody"):
        trust.own_folder(tmp_path / "open")
    assert trust.folder_owner(tmp_path / "open" / "x.sock") == -1
    with pytest.raises(TrustError, match="no folder"):
        trust.own_folder(made(tmp_path / "file"))


@pytest.mark.parametrize("name", ["../up", "a/b", "", ".", "..", ".hidden", "a\0b", "a b", "\u202e"])
def test_a_name_that_leads_elsewhere_is_no_plain_name(name):
    with pytest.raises(TrustError):
        trust.plain_name(name)


# -- rings that others left


def forged(folder: Path, logs: Path, **changes: object) -> Path:
    """Leave a ring of a producer that is gone, whose header says what a hostile one might."""
    said = {"directory": str(logs), "stem": "run", "segment_s": "60.0", "segment_bytes": "1000000", "floor_bytes": "0"}
    said |= {key: str(value) for key, value in changes.items() if key in said}
    blob = changes.get("blob", json.dumps({"header": {}, "options": list(said.values())}).encode())
    assert isinstance(blob, bytes)
    left = ring.create("rtctl-forged-1.ring", 4096, blob, (folder,))
    left.words[ring.PRODUCER_START] = 1  # nobody's
    left.unmap()
    return folder / "rtctl-forged-1.ring"


@pytest.mark.parametrize(
    "changes",
    [
        {"stem": "../../escaped"},
        {"stem": "/tmp/escaped"},
        {"floor_bytes": 1 << 60},
        {"segment_s": "nan"},
        {"segment_s": "-1"},
        {"segment_bytes": "0"},
        {"blob": b"not json"},
        {"blob": b"[1, 2]"},
        {"blob": json.dumps({"options": 5}).encode()},
        {"blob": json.dumps({"options": [None] * 5}).encode()},
        {"blob": b"[" * 2000},
    ],
    ids=str,
)
def test_a_ring_with_a_hostile_header_is_left_alone_and_stops_nobody(tmp_path, changes):
    logs, shared = tmp_path / "logs", tmp_path / "shm"
    logs.mkdir()
    shared.mkdir()
    kept = made(logs / "yesterday.000.mcap")
    left = forged(shared, logs, **changes)
    assert recorder.rescue(logs, (shared,)) == []
    assert left.exists()
    assert kept.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logs", "shm"]


@needs_root
def test_a_ring_of_another_user_is_not_rescued(tmp_path):
    logs, shared = tmp_path / "logs", tmp_path / "shm"
    logs.mkdir()
    shared.mkdir()
    left = forged(shared, logs)
    os.chown(left, STRANGER, STRANGER)
    assert recorder.rescue(logs, (shared,)) == []
    assert left.exists()
    with pytest.raises(TrustError, match="belongs to"):
        ring.attach(left)


# -- a daemon that somebody else put there


def impostor(path: Path) -> Callable[[Callable[[], None]], None]:
    """Return what another user does who answers at a socket of ours."""

    def act(ready: Callable[[], None]) -> None:
        os.umask(0)
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
            link.bind(str(path))
            link.listen(4)
            ready()
            while True:
                one, _ = link.accept()
                one.recv(65536)
                one.send(b'{"ok": true}')

    return act


@pytest.fixture
def shared_tmp() -> Iterator[Path]:
    """A folder where everybody may put files, reachable by every user."""
    folder = Path(f"/tmp/rtctl-test-{os.getpid()}-{time.monotonic_ns()}")
    folder.mkdir()
    folder.chmod(0o1777)
    yield folder
    for path in [*folder.rglob("*")][::-1]:
        with suppress(OSError):
            path.rmdir() if path.is_dir() else path.unlink()
    folder.rmdir()


@needs_root
def test_stop_is_not_said_to_another_users_socket(shared_tmp, monkeypatch):
    mine = shared_tmp / "rtctl-0"
    mine.mkdir()
    os.chown(mine, STRANGER, STRANGER)  # a stranger made the folder that this user looks in
    monkeypatch.setattr(client, "socket_folders", lambda: [mine])
    with stranger(impostor(mine / "rtctl-panda.sock")), pytest.raises(LinkError, match="no daemon is running"):
        client.find()


@needs_root
def test_a_socket_in_a_folder_of_everybodys_answers_only_for_this_user_or_root(shared_tmp):
    path = shared_tmp / "rtctl-panda.sock"
    with stranger(impostor(path)), pytest.raises(LinkError, match=rf"of user .*{STRANGER}.* answers there"):
        client.ask(str(path), {"verb": "stop"})


def test_a_daemon_of_ones_own_is_asked(tmp_path):
    path = tmp_path / "rtctl-panda.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen(1)
        assert client.answers(str(path))
        client.Session(str(path)).close()


def test_every_line_of_the_threat_model_names_tests_that_are_there():
    root = Path(__file__).resolve().parent.parent
    rows = [row for row in (root / "docs" / "trust.md").read_text().splitlines() if row.startswith("| ")]
    lines = [row for row in rows if not row.endswith("| held by |")]
    assert len(lines) > 15
    for line in lines:
        named = re.findall(r"`(tests/\w+\.py)`", line)
        assert named, line
        assert [name for name in named if not (root / name).is_file()] == []
