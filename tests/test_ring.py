"""The ring between servo and recorder: in order, complete or counted, across processes and kills."""

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtctl.errors import LinkError
from rtctl.log.record import ring as rings
from rtctl.log.record.ring import Consumer, Producer, attach, create
from rtctl.types import Frames

Make = Callable[..., tuple[Producer, Consumer]]
ALL = 1 << 30


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    opened: list[Producer | Consumer] = []

    def both(capacity: int = 4096) -> tuple[Producer, Consumer]:
        producer = create(f"{len(opened)}.ring", capacity, b"blob", [tmp_path])
        consumer = attach(producer.path)
        opened.extend((producer, consumer))
        return producer, consumer

    yield both
    for ring in opened:
        ring.unmap()


def taken(consumer: Consumer) -> list[bytes]:
    return [bytes(payload) for payload in consumer.take(ALL).payload]


def test_what_is_put_is_taken(make: Make) -> None:
    producer, consumer = make()
    assert producer.put(1, b"first", 10)
    assert producer.put(4, b"", 11)
    batch = consumer.take(ALL)
    assert (batch.kind, batch.time, batch.number) == ([1, 4], [10, 11], [1, 2])
    assert [bytes(p) for p in batch.payload] == [b"first", b""]
    assert taken(consumer) == []
    assert consumer.blob == b"blob"


def test_both_directions_of_a_bus_share_a_sequence_and_other_kinds_have_their_own(make: Make) -> None:
    producer, consumer = make()
    for kind in (2, 3, 1, 3, 2 | 1 << 8, 1):
        producer.put(kind, b"x", 0)
    assert consumer.take(ALL).sequence == [1, 2, 1, 3, 1, 2]


def test_a_full_ring_refuses_the_newest_counts_it_and_leaves_a_hole_in_the_numbers(make: Make) -> None:
    producer, consumer = make(4096)
    results = [producer.put(1, bytes([i]) * 1000, i) for i in range(6)]
    assert results == [True, True, True, False, False, False]
    assert producer.counts().dropped == 3
    assert taken(consumer) == [bytes([i]) * 1000 for i in range(3)]
    consumer.release()
    assert producer.put(1, b"after", 7)
    batch = consumer.take(ALL)
    assert (batch.number, batch.sequence) == ([7], [7])


def test_nothing_is_freed_before_it_is_released(make: Make) -> None:
    producer, consumer = make(4096)
    while producer.put(1, b"a" * 100, 0):
        pass
    assert consumer.take(ALL).number
    assert not producer.put(1, b"b" * 100, 0)
    consumer.release()
    assert producer.put(1, b"b" * 100, 0)


def test_an_entry_larger_than_the_ring_is_refused_and_the_next_one_fits(make: Make) -> None:
    producer, consumer = make(4096)
    assert not producer.put(1, bytes(5000), 0)
    assert producer.put(1, b"small", 0)
    assert taken(consumer) == [b"small"]


def test_several_entries_are_published_together_and_partly_refused(make: Make) -> None:
    producer, consumer = make(4096)
    assert producer.put_many(2, [b"one", b"two", b"three"], 5)
    assert not producer.put_many(2, [bytes(3000), bytes(3000)], 6)
    batch = consumer.take(ALL)
    assert batch.sequence == [1, 2, 3, 4]
    assert producer.counts().dropped == 1


def test_frames_in_one_piece_are_entries_of_their_own(make: Make) -> None:
    producer, consumer = make(4096)
    frames = [bytes([k]) * 72 for k in range(7)]
    producer.put(1, b"before", 4)
    assert producer.put_many(2, Frames(b"".join(frames), 72), 5)
    assert producer.put_many(3, frames[:2], 6)
    batch = consumer.take(ALL)
    assert batch.kind == [1] + [2] * 7 + [3] * 2
    assert batch.number == list(range(1, 11))
    assert batch.time == [4] + [5] * 7 + [6] * 2
    assert batch.sequence == [1, *range(1, 10)]
    assert [bytes(p) for p in batch.payload] == [b"before", *frames, *frames[:2]]


def test_frames_in_one_piece_that_do_not_fit_are_counted_one_by_one(make: Make) -> None:
    producer, consumer = make(4096)
    many = Frames(bytes(16 * 100), 16)
    assert [producer.put_many(2, many, 0) for _ in range(3)] == [True, True, False]
    assert producer.counts().dropped == 100
    assert len(taken(consumer)) == 200
    consumer.release()
    assert producer.put_many(2, many, 0)  # over the end of the area
    assert (producer.counts().number, consumer.take(ALL).number) == (400, list(range(301, 401)))


@given(st.lists(st.tuples(st.integers(0, 1500), st.sampled_from(["keep", "take", "release"])), max_size=120))
def test_any_interleaving_delivers_every_accepted_entry_once_and_in_order(steps: list[tuple[int, str]]) -> None:
    producer = create(f"test-{os.getpid()}.ring", 4096, b"", [rings.SHM if rings.SHM.is_dir() else Path("/tmp")])
    consumer = attach(producer.path)
    producer.path.unlink()
    accepted, seen = [], []
    for number, (size, action) in enumerate(steps):
        payload = number.to_bytes(4, "little") * (size // 4)
        if producer.put(1, payload, number):
            accepted.append(payload)
        if action != "keep":
            seen += taken(consumer)
        if action == "release":
            consumer.release()
    seen += taken(consumer)
    assert seen == accepted
    assert len(accepted) + producer.counts().dropped == len(steps)
    producer.unmap()
    consumer.unmap()


def test_each_side_writes_to_cache_lines_of_its_own() -> None:
    producer = {rings.HEAD_AT, rings.NUMBER, rings.DROPPED, rings.HEARTBEAT, rings.CLOSED}
    consumer = {rings.TAIL, rings.CONSUMED, rings.READY, rings.DEGRADED, rings.SEGMENT, rings.FINISHED}
    assert not {word // 8 for word in producer} & {word // 8 for word in consumer}
    assert len({rings.HEAD_AT // 8, rings.TAIL // 8, rings.DROPPED // 8, rings.HEARTBEAT // 8}) == 4


def test_on_a_processor_that_reorders_stores_the_ring_fences_them(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    producer, consumer = make()
    assert producer._fence is not None
    producer.put(1, b"payload", 0)
    assert taken(consumer) == [b"payload"]
    consumer.release()
    assert producer.counts().backlog == 0


def test_an_entry_that_makes_no_sense_ends_the_taking_but_not_the_consumer(make: Make) -> None:
    producer, consumer = make()
    producer.put(1, b"good", 0)
    producer.put(1, b"bad", 0)
    at = producer.data_at + 40  # the second entry's length
    producer.map[at : at + 4] = b"\xf0\xff\xff\x7f"
    assert taken(consumer) == [b"good"]
    assert consumer.corrupt
    assert consumer.drained


@pytest.mark.parametrize("content", [b"", b"x" * 100, bytes(8192), b"RTCTRNG2" + b"\xff" * 9000])
def test_a_file_that_is_no_ring_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(LinkError):
        attach(path)


def test_the_ring_goes_to_the_next_folder_when_one_does_not_take_it(tmp_path: Path) -> None:
    producer = create("a.ring", 4096, b"", [tmp_path / "absent", tmp_path])
    assert producer.path == tmp_path / "a.ring"
    producer.unmap()
    with pytest.raises(LinkError, match="no room"):
        create("a.ring", 4096, b"", [tmp_path / "absent"])
    with pytest.raises(ValueError, match="power of two"):
        create("b.ring", 5000, b"", [tmp_path])


CONSUMER = """
import sys, hashlib
from pathlib import Path
from rtctl.log.record import ring as rings
consumer = rings.attach(Path(sys.argv[1]))
digest, count = hashlib.sha256(), 0
while True:
    closed = consumer.words[rings.CLOSED]
    batch = consumer.take(8192)
    for payload in batch.payload:
        digest.update(payload)
    count += len(batch.payload)
    consumer.release()
    if closed and not batch.payload and consumer.drained:
        break
print(digest.hexdigest(), count)
"""


def test_another_process_sees_every_byte_while_the_ring_wraps(tmp_path: Path) -> None:
    producer = create("a.ring", 1 << 16, b"", [tmp_path])
    command = [sys.executable, "-c", CONSUMER, str(producer.path)]
    digest, count = hashlib.sha256(), 0
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for number in range(20000):
            payload = number.to_bytes(4, "little") * (number % 53)
            if producer.put(1, payload, number):
                digest.update(payload)
                count += 1
        producer.finish()
        out, _ = process.communicate(timeout=60)
    assert count + producer.counts().dropped == 20000
    assert out.split() == [digest.hexdigest(), str(count)]
    producer.unmap()


PRODUCER = """
import sys, os
from pathlib import Path
from rtctl.log.record import ring as rings
producer = rings.create("a.ring", 1 << 20, b"", [Path(sys.argv[1])])
number = 0
while True:
    producer.put(1, number.to_bytes(8, "little"), number)
    number += 1
    os.write(1, number.to_bytes(8, "little"))
"""


def test_every_entry_that_a_killed_producer_had_put_is_there(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PRODUCER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        acknowledged = process.stdout.read(8 * 3000)
        process.send_signal(signal.SIGKILL)
        acknowledged += process.stdout.read()
    consumer = attach(tmp_path / "a.ring")
    found = [int.from_bytes(payload, "little") for payload in taken(consumer)]
    assert found == list(range(len(found)))
    assert len(found) >= int.from_bytes(acknowledged[-8:], "little")
    assert not consumer.producer_alive()
    consumer.unmap()
