"""Following a log: over its files, and to viewers, judged by another reader and another client."""

import json
import struct
import threading
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader
from websockets.sync.client import connect

from rtctl.cli import main
from rtctl.cli.relay import LAG, TOPICS, Relay
from rtctl.log import Kind, make_header
from rtctl.log.entry import Batch
from rtctl.log.read.follow import Tail
from rtctl.log.record.writer import Options, Session
from tests.lab import recorded

HEADER = make_header("arm", ("a", "b"), 2, 1e-3, config="x = 1\n", urdf="<robot/>")
SCENE = """
robot = "{robot}"
duration_s = 1.5
[[goal]]
at_s = 0.3
position_m = [0.45, 0.15, 0.50]
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = 0.05
position_m = [0.4, -0.4, 0.3]
"""


def events(first: int, count: int) -> Batch:
    numbers = list(range(first, first + count))
    told = [json.dumps({"tick": n, "time": 0.001 * n, "name": "said", "detail": str(n)}).encode() for n in numbers]
    return Batch([Kind.EVENT] * count, numbers, numbers, numbers, told)


def test_a_run_is_followed_from_file_to_file_until_it_ends(tmp_path: Path) -> None:
    session = Session(HEADER, Options(tmp_path, "arm")._replace(segment_bytes=1))
    followed = Tail(next(tmp_path.glob("*.open")))
    said: list[str] = []
    for k in range(3):
        session.write(events(1 + 10 * k, 10))
        session._synced = 0.0
        session.poll()  # the file is full, the next one begins
        for _ in range(2):
            new = followed.read_on()
            said += [each["detail"] for each in new.events]
            assert not new.ended
    assert said == [str(n) for n in range(1, 31)]
    session.close({"reason": "closed"}, 30)
    assert followed.read_on().ended["reason"] == "closed"


def test_a_follower_waits_for_a_file_that_is_not_there_yet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(HEADER, Options(tmp_path, "arm")._replace(segment_bytes=1))
    followed = Tail(next(tmp_path.glob("*.open")))
    session.write(events(1, 10))
    session._synced = 0.0
    with monkeypatch.context() as patch:
        patch.setattr(session, "open", lambda: None)
        session.poll()
    assert len(followed.read_on().events) == 10
    for _ in range(3):
        new = followed.read_on()
        assert not new.events
        assert not new.ended
    session.open()
    session.write(events(11, 5))
    session.flush()
    assert [each["detail"] for each in followed.read_on().events] == [str(n) for n in range(11, 16)]
    session.close({"reason": "closed"}, 15)


@pytest.mark.parametrize("after", ["../arm.001.mcap", "/etc/passwd", "", 7])
def test_the_name_of_the_next_file_is_one_of_this_folder(tmp_path: Path, after: object) -> None:
    session = Session(HEADER, Options(tmp_path, "arm"))
    followed = Tail(next(tmp_path.glob("*.open")))
    session.finish({"reason": "segment full", "next": after})
    assert followed.read_on().ended["reason"] == "segment full"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.lab import PANDA

    folder = tmp_path_factory.mktemp("arm")
    recorded(folder, SCENE.format(robot=PANDA))
    return folder / "run.mcap"


def test_a_viewer_gets_what_the_log_draws(log: Path) -> None:
    with log.open("rb") as file:
        found = [(c.topic, s, m) for s, c, m in make_reader(file).iter_messages(topics=list(TOPICS))]
    wanted = {(topic, message.log_time, message.data) for topic, _, message in found}
    schemas = {topic: known for topic, known, _ in found if known is not None}
    followed = Tail(log, TOPICS)
    relay = Relay(followed, "127.0.0.1", 0)
    got: set[tuple[str, int, bytes]] = set()
    enough = threading.Event()

    def send() -> None:
        """Send the log again and again: a viewer that comes late sees what comes then."""
        messages = followed.read_on().messages
        while not enough.is_set():
            relay.add(messages, time.monotonic())
            while relay.waits and not enough.is_set():
                relay.send(time.monotonic())
                time.sleep(0.002)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        with connect(relay.url, subprotocols=["foxglove.sdk.v1"], max_size=None) as viewer:  # type: ignore[list-item]
            topics: dict[int, str] = {}
            while not {topic for topic, _, _ in got} >= {"/tf", "/scene"}:
                data = viewer.recv(timeout=60)
                if isinstance(data, bytes):
                    opcode, number, at = struct.unpack_from("<BIQ", data)
                    assert opcode == 1
                    got.add((topics[number], at, data[13:]))
                    continue
                told = json.loads(data)
                for channel in told.get("channels", ()) if told["op"] == "advertise" else ():
                    assert channel["encoding"] == "protobuf"
                    assert channel["schemaName"] == schemas[channel["topic"]].name
                    topics[channel["id"]] = channel["topic"]
                    each = {"id": channel["id"], "channelId": channel["id"]}
                    viewer.send(json.dumps({"op": "subscribe", "subscriptions": [each]}))
    finally:
        enough.set()
        sender.join()
        relay.close()
    assert got <= wanted


def test_what_is_drawn_comes_as_evenly_as_it_was_recorded(log: Path) -> None:
    followed = Tail(log, TOPICS)
    relay = Relay(followed, "127.0.0.1", 0)
    messages, begin, gone = followed.read_on().messages, 1e6, []
    relay.add(messages, begin)
    try:
        for step in range(400):
            now = begin + 0.005 * step
            gone += [(now - begin, m.time * 1e-9) for m in relay._due(now)]
    finally:
        relay.close()
    first = messages[0].time * 1e-9
    assert len(gone) == len([m for m in messages if m.time * 1e-9 - first + LAG <= 0.005 * 399])
    assert all(-1e-6 <= at - (sent - first) - LAG < 0.006 for at, sent in gone)


def test_who_joins_a_run_late_sees_what_is_new(log: Path, tmp_path: Path) -> None:
    """A file that is still written: what is in it already is no story to be told from its beginning."""
    growing = tmp_path / "run.mcap.open"
    growing.write_bytes(log.read_bytes())
    followed = Tail(growing, TOPICS)
    relay = Relay(followed, "127.0.0.1", 0)
    messages, begin, gone = followed.read_on().messages, 1e6, []
    newest = messages[-1].time
    later = [m._replace(time=newest + round(1e9 * (0.03 * (k + 1)))) for k, m in enumerate(messages[:8])]
    try:
        relay.add([m._replace(time=m.time - round(60e9)) for m in messages] + messages[-1:], begin)
        for step in range(400):
            now = begin + 0.005 * step
            if step == 50:
                relay.add(later, now)
            gone += [(now - begin, m) for m in relay._due(now)]
    finally:
        relay.close()
    assert [m for _, m in gone] == [messages[-1], *later]
    assert all(-1e-6 <= sent - LAG - 1e-9 * (m.time - newest) < 0.006 for sent, m in gone)


def test_a_hole_in_a_finished_log_is_not_waited_for(log: Path) -> None:
    followed = Tail(log, TOPICS)
    relay = Relay(followed, "127.0.0.1", 0)
    messages, begin, gone = followed.read_on().messages[:6], 1e6, 0
    holed = [m._replace(time=m.time + k // 3 * round(3.6e12)) for k, m in enumerate(messages)]
    last = messages[-1]._replace(time=(1 << 63) - 1)  # as the reader gives times that mean nothing
    relay.add([*holed, last], begin)
    try:
        for step in range(600):
            gone += len(list(relay._due(begin + 0.005 * step)))
    finally:
        relay.close()
    assert gone == 7


@pytest.mark.parametrize("words", [["--port", "9000"], ["--host", "0.0.0.0"]])
def test_where_nothing_listens_an_address_is_refused(log: Path, capsys: pytest.CaptureFixture[str], words: list[str]):
    assert main(["log", "tail", str(log), *words]) == 2
    assert "wanted --foxglove beside it" in capsys.readouterr().err


def test_the_command_names_the_address_and_ends_with_the_log(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", "tail", str(log), "--foxglove", "--port", "0"]) == 0
    out, err = capsys.readouterr()
    assert "ws://127.0.0.1:" in err
    assert out.splitlines()[-1].startswith("ended: ")


def test_a_port_that_is_taken_is_told(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    relay = Relay(Tail(log, TOPICS), "127.0.0.1", 0)
    try:
        taken = relay.url.rpartition(":")[2]
        assert main(["log", "tail", str(log), "--foxglove", "--port", taken]) == 2
    finally:
        relay.close()
    assert f"127.0.0.1:{taken}" in capsys.readouterr().err
