"""The control socket: what it lets through, what it refuses, and that nobody on it can delay the tick."""

import contextlib
import itertools
import json
import math
import os
import resource
import socket
import stat
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rtctl.errors import ConfigError, LinkError, RequestError
from rtctl.hal import client, console, messages
from rtctl.hal.console import Console
from rtctl.hal.messages import Bounds
from rtctl.types import ObstacleEdit, Request, Task, Verb

BOUNDS = Bounds(centre=(0.0, 0.0, 0.3), radius=1.2, tolerance=0.003, tolerance_rot=0.015)
PERIOD = 0.001
KEYS = ["verb", "position_m", "set", "clear", "name", "type", "wxyz"]
BALL = {"name": "ball", "type": "sphere", "radius_m": 0.1, "position_m": [0.4, 0.0, 0.5]}


class Daemon:
    """A console and the slots that pass over it."""

    def __init__(self, path: str) -> None:
        self.path, self.slot = path, 0
        self.console = Console(path, PERIOD, BOUNDS)

    def tick(self, ok: bool = True, text: str = "") -> Request:
        request = self.console.poll(self.slot)
        self.console.answer(ok, text)
        self.slot += 1
        return request

    def until(self, wanted: Callable[[Request], bool], slots: int = 40) -> Request:
        for _ in range(slots):
            if wanted(request := self.tick()):
                return request
        raise AssertionError(f"nothing such came in {slots} slots")

    def peer(self) -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link.settimeout(5.0)
        link.connect(self.path)
        return link


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    d = Daemon(str(tmp_path / "run" / "arm.sock"))
    yield d
    d.console.close()


def say(link: socket.socket, message: Any) -> None:
    link.send(message if isinstance(message, bytes) else json.dumps(message).encode())


def hear(link: socket.socket) -> Any:
    return json.loads(link.recv(1 << 17))


def round_trip(daemon: Daemon, message: Any, ok: bool = True, text: str = "") -> tuple[Any, list[Request]]:
    """Return the reply to `message` and the requests that came of it."""
    with daemon.peer() as link:
        say(link, message)
        requests = [daemon.tick(ok, text) for _ in range(30)]
        return hear(link), [r for r in requests if r != Request()]


# -- what goes through ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "verb"),
    [
        ("arm", Verb.ARM),
        ("disarm", Verb.DISARM),
        ("park", Verb.PARK),
        ("stop", Verb.STOP),
        ("reset", Verb.RESET),
        ("recover", Verb.RECOVER),
    ],
)
def test_each_verb_reaches_exactly_one_tick(daemon: Daemon, word: str, verb: Verb) -> None:
    reply, requests = round_trip(daemon, {"verb": word})
    assert [r.verb for r in requests] == [verb]
    assert reply["ok"] is True


def test_a_disarm_that_may_drop_the_arm_is_another_than_one_that_may_not(daemon: Daemon) -> None:
    assert [r.verb for r in round_trip(daemon, {"verb": "disarm", "drop": True})[1]] == [Verb.DROP]
    assert [r.verb for r in round_trip(daemon, {"verb": "disarm", "drop": False})[1]] == [Verb.DISARM]


def test_the_reply_carries_the_verdict_of_the_tick_that_got_the_request(daemon: Daemon) -> None:
    with daemon.peer() as link:
        say(link, {"verb": "arm"})
        while daemon.console.poll(daemon.slot).verb != Verb.ARM:
            daemon.slot += 1
        link.setblocking(False)
        with pytest.raises(BlockingIOError):  # no word before the tick has spoken
            link.recv(100)
        daemon.console.answer(False, "arm: not in FAULT")
        assert json.loads(link.recv(1000)) == {"ok": False, "slot": daemon.slot, "error": "arm: not in FAULT"}


def test_a_request_without_a_verdict_is_answered_as_refused(daemon: Daemon) -> None:
    with daemon.peer() as link:
        say(link, {"verb": "arm"})
        for slot in range(3):
            daemon.console.poll(slot)
        assert hear(link)["ok"] is False


def test_a_position_goal_leaves_the_orientation_free(daemon: Daemon) -> None:
    reply, (request,) = round_trip(daemon, {"verb": "goal", "position_m": [0.5, -0.1, 0.4]})
    goal = request.goal
    assert goal is not None
    assert goal.task == Task.POSITION
    assert goal.position.tolist() == [0.5, -0.1, 0.4]
    assert (goal.tolerance, goal.tolerance_rot) == (0.003, 0.015)
    assert reply["ok"] is True


def test_roll_pitch_yaw_turns_about_fixed_axes_x_then_y_then_z(daemon: Daemon) -> None:
    rpy = [0.3, -1.1, 2.5]
    _, (request,) = round_trip(daemon, {"verb": "goal", "position_m": [0.5, 0, 0.4], "rpy_rad": rpy})
    goal = request.goal
    assert goal is not None
    oracle = Rotation.from_euler("xyz", rpy)  # lower case: extrinsic
    got = Rotation.from_quat(goal.wxyz[[1, 2, 3, 0]])
    assert (oracle * got.inv()).magnitude() < 1e-12
    assert goal.task == Task.POSE


def test_hold_orientation_takes_the_one_of_the_last_estimate(daemon: Daemon) -> None:
    wxyz = np.array([0.5, -0.5, 0.5, 0.5])
    daemon.console.publish(lambda: {"wxyz": wxyz})
    _, (request,) = round_trip(daemon, {"verb": "goal", "position_m": [0.5, 0, 0.4], "hold": "orientation"})
    goal = request.goal
    assert goal is not None
    assert goal.task == Task.POSE
    np.testing.assert_array_equal(goal.wxyz, wxyz)


def test_hold_orientation_is_refused_while_no_estimate_exists(daemon: Daemon) -> None:
    reply, requests = round_trip(daemon, {"verb": "goal", "position_m": [0.5, 0, 0.4], "hold": "orientation"})
    assert reply["ok"] is False
    assert requests == []


def test_one_obstacle_comes_with_its_shape_velocity_and_age(daemon: Daemon) -> None:
    message = {"verb": "obstacle", "set": {**BALL, "velocity_m_s": [0, 0.2, 0]}, "age_s": 0.04}
    _, (request,) = round_trip(daemon, message)
    (edit,) = request.obstacles
    assert (edit.name, edit.age) == ("ball", 0.04)
    assert edit.shape is not None
    assert edit.shape.type == "sphere"
    assert edit.shape.dims[0] == 0.1
    assert edit.shape.position.tolist() == [0.4, 0.0, 0.5]
    assert edit.shape.velocity.tolist() == [0.0, 0.2, 0.0]


@pytest.mark.parametrize("name", ["ball", "*"])
def test_clearing_one_or_all_obstacles_comes_as_an_edit_without_a_shape(daemon: Daemon, name: str) -> None:
    _, (request,) = round_trip(daemon, {"verb": "obstacle", "clear": name})
    assert [(e.name, e.shape) for e in request.obstacles] == [(name, None)]


def test_a_full_camera_frame_is_spread_over_slots_and_ages_on_the_way(daemon: Daemon) -> None:
    frame = [{**BALL, "name": f"o{i}"} for i in range(messages.OBSTACLES_MAX)]
    with daemon.peer() as link:
        say(link, {"verb": "obstacles", "set": frame, "age_s": 0.01})
        got = [(daemon.slot, daemon.tick().obstacles) for _ in range(30)]
    first = next(slot for slot, edits in got if edits)
    assert max(len(edits) for _, edits in got) == console.EDITS_PER_SLOT
    assert [e.name for _, edits in got for e in edits] == [o["name"] for o in frame]
    for slot, edits in got:
        for edit in edits:
            assert edit.age == pytest.approx(0.01 + (slot - first) * PERIOD, abs=1e-12)


def test_a_camera_faster_than_the_slots_coalesces_to_the_newest(daemon: Daemon) -> None:
    with daemon.peer() as link:
        for x in range(20):  # more than is read at one message a slot
            frame = [{**BALL, "name": f"o{i}", "position_m": [x, 0, 0]} for i in range(8)]
            say(link, {"verb": "obstacles", "set": frame})
        edits = [e for _ in range(60) for e in daemon.tick().obstacles]
    last = {e.name: e.shape.position[0] for e in edits if e.shape is not None}
    assert last == {f"o{i}": 19.0 for i in range(8)}
    assert len(edits) < 20 * 8  # older sightings were overtaken


def test_a_stop_overtakes_a_waiting_camera_frame(daemon: Daemon) -> None:
    frame = [{**BALL, "name": f"o{i}"} for i in range(messages.OBSTACLES_MAX)]
    with daemon.peer() as camera, daemon.peer() as operator:
        say(camera, {"verb": "obstacles", "set": frame})
        daemon.until(lambda r: bool(r.obstacles))
        say(operator, {"verb": "stop"})
        daemon.until(lambda r: r.verb == Verb.STOP, slots=3)


def test_a_flood_of_verbs_does_not_starve_the_camera(daemon: Daemon) -> None:
    with daemon.peer() as camera, daemon.peer() as operator:
        say(camera, {"verb": "obstacles", "set": [BALL]})
        for _ in range(30):
            say(operator, {"verb": "reset"})
        daemon.until(lambda r: bool(r.obstacles), slots=10)


def test_clearing_all_drops_the_sightings_that_still_wait(daemon: Daemon) -> None:
    frame = [{**BALL, "name": f"o{i}"} for i in range(messages.OBSTACLES_MAX)]
    with daemon.peer() as camera, daemon.peer() as operator:
        say(camera, {"verb": "obstacles", "set": frame})
        daemon.until(lambda r: bool(r.obstacles))
        say(operator, {"verb": "obstacle", "clear": "*"})
        daemon.until(lambda r: any(e.name == "*" for e in r.obstacles))
        assert not any(daemon.tick().obstacles for _ in range(40))


def test_the_refusal_of_a_sighting_is_told_with_the_next_frame(daemon: Daemon) -> None:
    with daemon.peer() as camera:
        daemon.tick()
        say(camera, {"verb": "obstacles", "set": [BALL]})
        for _ in range(5):
            daemon.tick(False, "no slot is free")
        assert hear(camera) == {"ok": True, "accepted": 1, "refused": ""}
        say(camera, {"verb": "obstacles", "set": []})
        daemon.tick()
        assert hear(camera)["refused"] == "no slot is free"


# -- status ---------------------------------------------------------------------------------------------------------


def test_a_snapshot_is_made_only_when_asked_for_and_then_serves_everyone_for_20_ms(daemon: Daemon) -> None:
    calls: list[int] = []

    def status() -> dict[str, Any]:
        calls.append(daemon.slot)
        return {"state": "IDLE", "q_rad": np.zeros(2), "clearance_m": {"ball": math.inf}, "tick": np.int64(4)}

    daemon.console.publish(status)
    for _ in range(100):
        daemon.tick()
    assert calls == []
    wanted = {"ok": True, "state": "IDLE", "q_rad": [0.0, 0.0], "clearance_m": {"ball": None}, "tick": 4}
    with daemon.peer() as link:
        daemon.tick()  # accepted
        for _ in range(40):
            say(link, {"verb": "status"})
            daemon.tick()
            assert hear(link) == wanted
    assert [b - a for a, b in itertools.pairwise(calls)] == [20]


def test_after_a_request_the_next_status_is_a_fresh_one(daemon: Daemon) -> None:
    daemon.console.publish(lambda: {"tick": daemon.slot})
    with daemon.peer() as link:
        daemon.tick()
        say(link, {"verb": "status"})
        daemon.tick()
        before = hear(link)["tick"]
        say(link, {"verb": "reset"})
        daemon.tick()
        assert hear(link)["ok"] is True
        say(link, {"verb": "status"})
        daemon.tick()
        assert hear(link)["tick"] > before


def test_a_status_that_fails_is_an_error_reply_and_not_the_end_of_the_loop(daemon: Daemon) -> None:
    def broken() -> dict[str, Any]:
        raise ZeroDivisionError("in the report")

    daemon.console.publish(broken)
    reply, requests = round_trip(daemon, {"verb": "status"})
    assert (reply["ok"], requests) == (False, [])


# -- what is refused ------------------------------------------------------------------------------------------------

MALFORMED = {
    "no JSON": b"hello",
    "cut off": b'{"verb":"stop"',
    "trailing": b'{"verb":"stop"}{}',
    "not UTF-8": b'{"verb":"st\xffop"}',
    "unknown verb": b'{"verb":"dance"}',
    "no verb": b"{}",
    "unknown key": b'{"verb":"stop","now":true}',
    "a list": b'[{"verb":"stop"}]',
    "NaN": b'{"verb":"goal","position_m":[NaN,0,0.4]}',
    "infinity": b'{"verb":"goal","position_m":[Infinity,0,0.4]}',
    "1e999": b'{"verb":"goal","position_m":[1e999,0,0.4]}',
    "400 digits": b'{"verb":"goal","position_m":[' + b"9" * 400 + b",0,0.4]}",
    "a text for a number": b'{"verb":"goal","position_m":["0.5",0,0.4]}',
    "a truth for a number": b'{"verb":"goal","position_m":[true,0,0.4]}',
    "two coordinates": b'{"verb":"goal","position_m":[0.5,0.4]}',
    "a null": b'{"verb":"goal","position_m":[null,0,0.4]}',
    "nested lists": b"[" * 60_000,
    "nested objects": b'{"verb":' * 8_000,
    "nested below a key": b'{"verb":"goal","position_m":' + b"[" * 60_000,
    "65 obstacles": json.dumps({"verb": "obstacles", "set": [{**BALL, "name": f"o{i}"} for i in range(65)]}).encode(),
    "a negative radius": json.dumps({"verb": "obstacle", "set": {**BALL, "radius_m": -1}}).encode(),
    "an unknown shape": json.dumps({"verb": "obstacle", "set": {**BALL, "type": "torus"}}).encode(),
    "an obstacle nowhere": b'{"verb":"obstacle","set":{"name":"b","type":"sphere","radius_m":0.1}}',
    "a timetable": json.dumps({"verb": "obstacle", "set": {**BALL, "appears_s": 3.0}}).encode(),
    "a name with a blank": json.dumps({"verb": "obstacle", "set": {**BALL, "name": "a b"}}).encode(),
    "an age from the future": json.dumps({"verb": "obstacle", "set": BALL, "age_s": -1}).encode(),
    "65537 bytes": b'{"verb":"stop"}' + b" " * (65_537 - 15),
    "100 kB": b" " * 100_000,
}


@pytest.mark.parametrize("raw", MALFORMED.values(), ids=MALFORMED.keys())
def test_a_malformed_message_is_answered_with_an_error_and_the_peer_is_hung_up_on(daemon: Daemon, raw: bytes) -> None:
    with daemon.peer() as link:
        say(link, raw)
        assert all(daemon.tick() == Request() for _ in range(20))
        reply = hear(link)
        assert reply["ok"] is False
        assert reply["error"]
        assert link.recv(1) == b""
    assert round_trip(daemon, {"verb": "stop"})[1][0].verb == Verb.STOP  # the next one is served


IMPOSSIBLE = {
    "out of reach": {"verb": "goal", "position_m": [0.9, 0.9, 0.4]},
    "a quaternion of length 0": {"verb": "goal", "position_m": [0.5, 0, 0.4], "wxyz": [0, 0, 0, 0]},
    "a quaternion of length 2": {"verb": "goal", "position_m": [0.5, 0, 0.4], "wxyz": [1, 1, 1, 1]},
    "two orientations": {"verb": "goal", "position_m": [0.5, 0, 0.4], "wxyz": [1, 0, 0, 0], "rpy_rad": [0, 0, 0]},
    "hold and turn": {"verb": "goal", "position_m": [0.5, 0, 0.4], "wxyz": [1, 0, 0, 0], "hold": "orientation"},
    "set and clear": {"verb": "obstacle", "set": BALL, "clear": "ball"},
    "neither": {"verb": "obstacle"},
}


@pytest.mark.parametrize("message", IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_an_impossible_request_is_refused_before_the_tick_and_the_peer_may_go_on(daemon: Daemon, message: Any) -> None:
    with daemon.peer() as link:
        say(link, message)
        assert all(daemon.tick() == Request() for _ in range(20))
        assert hear(link)["ok"] is False
        say(link, {"verb": "stop"})
        daemon.until(lambda r: r.verb == Verb.STOP)
        assert hear(link)["ok"] is True


@pytest.mark.parametrize("size", [65_535, 65_536])
def test_a_message_up_to_64_kib_is_taken(daemon: Daemon, size: int) -> None:
    raw = b'{"verb":"stop"}'
    assert round_trip(daemon, raw + b" " * (size - len(raw)))[1][0].verb == Verb.STOP


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    raw=st.binary(max_size=300)
    | st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=8) | st.sampled_from(["stop", "goal", "obstacle"]),
        lambda x: st.lists(x, max_size=4) | st.dictionaries(st.sampled_from(KEYS), x, max_size=4),
        max_leaves=12,
    ).map(lambda x: json.dumps(x).encode())
)
def test_whatever_bytes_come_the_loop_goes_on_and_only_finite_numbers_pass(daemon: Daemon, raw: bytes) -> None:
    with daemon.peer() as link:
        say(link, raw)
        requests = [daemon.tick() for _ in range(3)]
    for request in requests:
        numbers = [] if request.goal is None else [*request.goal.position, *request.goal.wxyz]
        for edit in request.obstacles:
            if edit.shape is not None:
                numbers += [*edit.shape.dims, *edit.shape.position, *edit.shape.wxyz, edit.age]
        assert np.isfinite(numbers).all()
    daemon.tick()  # hears of the end


# -- nobody delays the tick -----------------------------------------------------------------------------------------


def count_calls(work: Callable[[], object]) -> Counter[str]:
    """Return how often `work` called each built-in method; the system calls of sockets are among them."""
    calls: Counter[str] = Counter()

    def profile(_frame: FrameType, event: str, target: Any) -> None:
        if event == "c_call":
            calls[getattr(target, "__name__", "?")] += 1

    sys.setprofile(profile)
    try:
        work()
    finally:
        sys.setprofile(None)
    return calls


class Flood:
    """A thread that keeps sending the worst it can while the test polls."""

    def __init__(self, path: str, payload: bytes, connections: int, read: bool) -> None:
        self.path, self.payload, self.connections, self.read = path, payload, connections, read
        self.links: list[socket.socket] = []
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self.over.is_set():
            while len(self.links) < self.connections:
                link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                link.setblocking(False)
                if link.connect_ex(self.path) != 0:
                    link.close()
                    break
                self.links.append(link)
            for link in list(self.links):
                try:
                    link.send(self.payload)
                    if self.read:
                        link.recv(1 << 17)
                except BlockingIOError:
                    continue
                except OSError:
                    link.close()
                    self.links.remove(link)
            self.over.wait(0.001)

    def __enter__(self) -> None:
        self.thread.start()

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.thread.join()
        for link in self.links:
            link.close()


FLOODS = {
    "verbs": b'{"verb":"reset"}',
    "status": b'{"verb":"status"}',
    "rubbish": b"\x00" * 64,
    "oversize": b" " * 70_000,
    "large": b" " * 65_000,
    "camera": json.dumps({"verb": "obstacles", "set": [{**BALL, "name": f"o{i}"} for i in range(64)]}).encode(),
}


@pytest.mark.parametrize("read", [True, False], ids=["reading", "not reading"])
@pytest.mark.parametrize("payload", FLOODS.values(), ids=FLOODS.keys())
def test_a_flood_costs_a_poll_no_wait_and_a_bounded_number_of_system_calls(
    daemon: Daemon, payload: bytes, read: bool
) -> None:
    worst: Counter[str] = Counter()
    daemon.console.publish(lambda: {"text": "x" * 30_000})  # replies that fill a reader's queue soon
    with Flood(daemon.path, payload, 20, read):
        for _ in range(300):
            worst |= count_calls(daemon.tick)  # union: the largest count of each
    assert worst["poll"] == 1
    assert worst["accept"] <= 1
    assert worst["recv_into"] <= 1
    assert worst["send"] <= 2  # one reply, and one "too many" to a newcomer
    assert worst["close"] <= 3
    assert len(daemon.console._peers) <= console.PEERS_MAX


def test_a_poll_never_gives_up_the_processor(daemon: Daemon) -> None:
    links = [daemon.peer() for _ in range(console.PEERS_MAX)]
    for _ in links:
        daemon.tick()
    for link in links:  # everything waits already: whatever a poll does, it can do at once
        for _ in range(20):
            say(link, {"verb": "status"})
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw
    for _ in range(200):
        daemon.tick()
    assert resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw == before
    for link in links:
        link.close()


def test_large_messages_wait_their_turn_so_that_most_slots_are_free_of_them(daemon: Daemon) -> None:
    with daemon.peer() as one, daemon.peer() as two:
        for link in (one, two):
            say(link, b'{"verb":"reset"}' + b" " * 65_500)
        slots = [slot for slot in range(30) if daemon.tick().verb == Verb.RESET]
    assert slots[1] - slots[0] >= 7  # 64 KiB at 8 KiB a slot


def test_a_reader_that_does_not_read_is_dropped_and_nobody_else(daemon: Daemon) -> None:
    daemon.console.publish(lambda: {"text": "x" * 30_000})
    with daemon.peer() as sleeper, daemon.peer() as other:
        for _ in range(60):
            with contextlib.suppress(OSError):
                say(sleeper, {"verb": "status"})
            daemon.tick()
        assert daemon.console.counts["slow_reader"] == 1
        say(other, {"verb": "stop"})
        daemon.until(lambda r: r.verb == Verb.STOP)


def test_a_thousand_connections_leave_eight_seats_and_a_door_for_the_operator(daemon: Daemon) -> None:
    links: list[socket.socket] = []
    for _ in range(1000):
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link.setblocking(False)
        if link.connect_ex(daemon.path) == 0:
            links.append(link)
        else:
            link.close()  # the kernel's queue is full: the caller's own problem
        daemon.tick()
        assert len(daemon.console._peers) <= console.PEERS_MAX
    # after a second of silence they have to make room for somebody who has something to say
    for _ in range(int(console.IDLE / PERIOD)):
        daemon.tick()
    with daemon.peer() as operator:
        say(operator, {"verb": "stop"})
        daemon.until(lambda r: r.verb == Verb.STOP)
    for link in links:
        link.close()


def test_a_ninth_peer_is_told_so_while_the_eight_are_busy(daemon: Daemon) -> None:
    links = [daemon.peer() for _ in range(console.PEERS_MAX)]
    for _ in links:
        daemon.tick()
    with daemon.peer() as ninth:
        daemon.tick()
        told = hear(ninth)
        assert "8 peers" in told["error"]
        assert told["room_in_s"] == pytest.approx(console.IDLE, abs=0.1)
        assert ninth.recv(1) == b""
    for link in links:
        link.close()


def test_a_caller_waits_until_one_of_a_silent_crowd_must_make_room(daemon: Daemon) -> None:
    links = [daemon.peer() for _ in range(console.PEERS_MAX)]
    for _ in links:
        daemon.tick()
    asked, over = list[Verb](), threading.Event()

    def serve() -> None:
        while not over.is_set():
            request = daemon.tick()
            asked.append(request.verb)
            over.wait(0.0005)

    serving = threading.Thread(target=serve)
    serving.start()
    try:
        assert client.ask(daemon.path, {"verb": "stop"}, timeout=60.0)["ok"]
    finally:
        over.set()
        serving.join(60.0)
    assert Verb.STOP in asked
    for link in links:
        link.close()


def test_who_calls_when_no_descriptor_is_left_gets_that_of_a_silent_peer(daemon: Daemon) -> None:
    with daemon.peer(), daemon.peer() as caller:
        daemon.tick()
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
        try:
            for _ in range(int(console.IDLE / PERIOD) + 10):
                daemon.tick()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert daemon.console.counts["idle"] == 1
        say(caller, {"verb": "stop"})
        daemon.until(lambda r: r.verb == Verb.STOP)


def test_a_peer_that_vanishes_after_its_request_does_no_harm(daemon: Daemon) -> None:
    with daemon.peer() as link:
        say(link, {"verb": "stop"})
    daemon.until(lambda r: r.verb == Verb.STOP)  # said is said
    for _ in range(5):
        daemon.tick()
    assert daemon.console._peers == {}


# -- who may, and where ---------------------------------------------------------------------------------------------


def test_another_user_is_hung_up_on_unheard(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daemon.console, "_admitted", frozenset({os.getuid() + 4711}))
    with daemon.peer() as link:
        say(link, {"verb": "stop"})
        assert all(daemon.tick() == Request() for _ in range(5))
        with pytest.raises(ConnectionResetError):  # what it said was never read
            link.recv(100)
    assert daemon.console.counts["foreign_user"] == 1


def test_socket_and_folder_are_closed_to_others(daemon: Daemon) -> None:
    assert stat.S_IMODE(os.stat(daemon.path).st_mode) == 0o660 & ~_umask()
    assert stat.S_IMODE(os.stat(os.path.dirname(daemon.path)).st_mode) == 0o750 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_folder_that_everybody_may_write_to_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o1777)
    with pytest.raises(ConfigError, match="others cannot write"):
        Console(str(folder / "arm.sock"), PERIOD, BOUNDS)


def test_a_second_console_is_refused_while_the_first_lives(daemon: Daemon) -> None:
    with pytest.raises(ConfigError, match="another daemon"):
        Console(daemon.path, PERIOD, BOUNDS)


def test_a_socket_left_behind_by_a_killed_daemon_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "arm.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(path))
        dead.listen()
    assert path.is_socket()
    Console(str(path), PERIOD, BOUNDS).close()
    assert not path.exists()


def test_a_file_in_the_place_of_the_socket_is_kept_and_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.sock"
    path.write_text("precious")
    with pytest.raises(ConfigError, match="no socket"):
        Console(str(path), PERIOD, BOUNDS)
    assert path.read_text() == "precious"


# -- the client -----------------------------------------------------------------------------------------------------


@pytest.fixture
def served(daemon: Daemon) -> Iterator[Daemon]:
    """A daemon whose slots pass by themselves."""
    over = threading.Event()

    def run() -> None:
        while not over.is_set():
            request = daemon.console.poll(daemon.slot)
            daemon.console.answer(request.verb != Verb.ARM, "not now" if request.verb == Verb.ARM else "")
            daemon.slot += 1
            over.wait(0.0005)

    thread = threading.Thread(target=run)
    thread.start()
    yield daemon
    over.set()
    thread.join()


def test_ask_returns_the_daemons_words(served: Daemon) -> None:
    assert client.ask(served.path, {"verb": "reset"})["ok"] is True
    assert client.ask(served.path, {"verb": "arm"})["error"] == "not now"


def test_demand_raises_the_daemons_reason(served: Daemon) -> None:
    with pytest.raises(RequestError, match="not now"):
        client.demand(served.path, {"verb": "arm"})


def test_many_clients_at_once_all_get_their_answer(served: Daemon) -> None:
    replies: list[Any] = []
    threads = [
        threading.Thread(target=lambda: replies.append(client.ask(served.path, {"verb": "reset"}, 20.0)))
        for _ in range(20)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(replies) == 20


def test_a_missing_a_dead_and_a_mute_daemon_are_link_errors(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="no such socket"):
        client.ask(str(tmp_path / "none.sock"), {"verb": "stop"})
    path = str(tmp_path / "mute.sock")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as mute:
        mute.bind(path)
        mute.listen()
        with pytest.raises(LinkError, match="no answer"):
            client.ask(path, {"verb": "stop"}, timeout=0.05)
    with pytest.raises(LinkError, match="no daemon is listening"):
        client.ask(path, {"verb": "stop"})
    with pytest.raises(LinkError):
        client.ask("/" + "x" * 300, {"verb": "stop"})


BALL = {"name": "ball", "type": "sphere", "radius_m": 0.1, "position_m": [0.4, 0.0, 0.5]}


def test_an_obstacle_that_a_person_puts_where_none_can_be_is_refused_and_a_cameras_is_not(daemon: Daemon) -> None:
    judged: list[str] = []

    def misplaced(edit: ObstacleEdit) -> str:
        judged.append(edit.name)
        return "would lie 0.1 m inside link3" if edit.shape is not None else ""

    daemon.console.publish(dict, dict, misplaced)
    reply, requests = round_trip(daemon, {"verb": "obstacle", "set": BALL})
    assert (reply, requests) == ({"ok": False, "error": "obstacle ball: would lie 0.1 m inside link3"}, [])
    assert round_trip(daemon, {"verb": "obstacle", "clear": "ball"})[0]["ok"]
    _, requests = round_trip(daemon, {"verb": "obstacles", "set": [BALL]})
    assert [edit.name for request in requests for edit in request.obstacles] == ["ball"]
    assert judged == ["ball", "ball"]
