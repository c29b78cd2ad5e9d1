"""`rtctl view`: what a page reads, draws and asks; who may connect; and the page itself in a browser."""

import hashlib
import http.client
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtctl.errors import LinkError
from rtctl.hal.console import Console
from rtctl.log import make_header, read_run
from rtctl.log.header import SCENE_FILE, scene_text
from rtctl.log.record import tap as taps
from rtctl.log.record.draw import rotation
from rtctl.log.record.recorder import blob_of
from rtctl.log.record.requests import encode_event, encode_request
from rtctl.log.record.ring import PRODUCER, PRODUCER_START, attach, create, process_start
from rtctl.log.record.scene import Scene
from rtctl.log.record.surroundings import Thing
from rtctl.log.record.tap import Tap
from rtctl.types import F64, ObstacleEdit, Request, Shape, State, Status, Verb
from rtctl.view import gate as gates
from rtctl.view.body import Body
from rtctl.view.follow import Live, Recorded, Seen, Story, _only
from rtctl.view.gate import Gate
from rtctl.view.known import known_obstacles
from rtctl.view.moment import STATES, STATUSES, Reader, scan_of
from rtctl.view.operator import LOCKED, Operator
from rtctl.view.page import Page
from rtctl.view.shapes import triangles
from rtctl.view.stage import Stage
from rtctl.view.words import AMBER, GREEN, RED, bars_html, chart_data, state_html
from rtctl.world.primitives import distance
from tests.lab import ROOT
from tests.test_console import BOUNDS, PERIOD
from tools import browser

GOLDEN = ROOT / "tests" / "golden" / "goals.mcap"
KINDS = st.sampled_from([1, 2, 3, 4, 5, 1, 1])


@pytest.fixture(scope="module")
def record() -> Recorded:
    return Recorded(read_run(GOLDEN))


def shape(kind: str, dims: list[float], name: str = "thing") -> Shape:
    wxyz = np.array([0.8, 0.0, 0.6, 0.0])
    still = np.zeros(3)
    return Shape(name, kind, np.array(dims), np.array([0.4, -0.2, 0.3]), wxyz, still, still)


# ---- the ring, looked into


@settings(max_examples=25)
@given(st.lists(st.tuples(KINDS, st.integers(0, 300)), max_size=60), st.integers(1, 9))
def test_a_tap_sees_what_a_consumer_takes(tmp_path_factory: pytest.TempPathFactory, puts: Any, every: int) -> None:
    producer = create(f"{time.monotonic_ns()}.ring", 65536, b"{}", [tmp_path_factory.mktemp("ring")])
    consumer, tap = attach(producer.path), Tap(producer.path)
    ticks: list[bytes] = []
    messages: list[tuple[int, bytes]] = []
    for number, (kind, size) in enumerate(puts):
        producer.put(kind, bytes([number]) * size, number)
        if number % every and number != len(puts) - 1:
            continue
        look, batch = tap.look(), consumer.take(1 << 30)
        assert not look.lost
        ticks = [bytes(p) for k, p in zip(batch.kind, batch.payload, strict=True) if k == 1]
        messages = [(k, bytes(p)) for k, p in zip(batch.kind, batch.payload, strict=True) if k in (4, 5)]
        assert look.tick == (ticks[-1] if ticks else b"")
        assert look.messages == messages
        consumer.release()
    tap.unmap()
    consumer.unmap()
    producer.unmap()


def test_a_tap_that_was_away_for_a_lap_says_so_and_goes_on(tmp_path: Path) -> None:
    producer = create("a.ring", 4096, b"{}", [tmp_path])
    consumer, tap = attach(producer.path), Tap(producer.path)
    for number in range(200):
        assert producer.put(4, str(number).encode() * 20, number)
        consumer.take(1 << 30)
        consumer.release()
    assert tap.look().lost
    producer.put(4, b"after", 0)
    look = tap.look()
    assert (look.lost, look.messages) == (False, [(4, b"after")])


def test_a_tap_changes_nothing_and_cannot(tmp_path: Path) -> None:
    producer = create("a.ring", 4096, b"{}", [tmp_path])
    producer.put(1, b"tick", 1)
    before = hashlib.sha256(producer.path.read_bytes()).digest()
    tap = Tap(producer.path)
    assert tap.look().tick == b"tick"
    with pytest.raises(TypeError, match="read-only memory"):
        tap.words[0] = 1
    assert hashlib.sha256(producer.path.read_bytes()).digest() == before


def test_only_rings_of_servos_that_live_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taps.rings, "SHM", tmp_path)
    monkeypatch.setattr(taps.tempfile, "gettempdir", lambda: str(tmp_path / "none"))
    one, two = (create(f"rtctl-{name}-x.ring", 4096, b"{}", [tmp_path]) for name in ("arm", "rover"))
    (tmp_path / "rtctl-odd.ring").write_bytes(b"no ring")
    assert set(taps.living()) == {one.path, two.path}
    assert taps.living("arm") == [one.path]
    one.finish()
    assert taps.living("arm") == []


# ---- words and numbers


def test_every_state_and_status_has_its_words() -> None:
    assert set(STATES) == {state.name for state in State}
    assert set(STATUSES) == {status.name.lower() for status in Status}


def test_a_moment_says_what_the_record_holds(record: Recorded) -> None:
    log = read_run(GOLDEN)["/tick"].array
    record.seek(1.2)
    record.step()
    m = record.story.moment
    assert m is not None
    row = log[np.abs(log["time"] - m.time).argmin()]
    assert (m.state, m.place.tolist(), m.error) == ("RUN", row["x"].tolist(), float(row["error"]))
    ratio = {name: abs(row["tau_sent"][k]) for k, name in enumerate(log.dtype.names and record._header.joints)}
    assert dict(m.torques)["panda_joint1"] == pytest.approx(ratio["panda_joint1"] / 87.0)
    found = dict(m.clearances)
    assert {"ball", "crate", "post"} >= set(found)
    assert min(found.values()) == pytest.approx(float(row["rho"].min()))


def test_back_and_forth_in_a_log_gives_the_same(record: Recorded) -> None:
    def at(time: float) -> tuple[Any, ...]:
        record.seek(time)
        record.step()
        m = record.story.moment
        assert m is not None
        return m.time, m.q.tolist(), {n: t.shape["position"] for n, (t, _) in record.story.things.items()}

    first = at(0.7)
    later = at(1.7)
    assert at(0.7) == first
    assert at(1.7) == later
    assert first[2]["ball"] != later[2]["ball"]


def test_a_page_that_rests_tells_and_sends_nothing_again(record: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    """What stands still would cost as much as what moves; a log that is paused was told anew with each frame."""
    page = Page(record, Operator(None), "127.0.0.1", 0)
    stage = page._stage
    try:
        record.seek(1.2)
        record.step()
        story, sent = record.story, list[object]()
        assert story.moment is not None
        now = story.moment.time
        monkeypatch.setattr(page._server.scene, "_queue_scene_message", sent.append)
        stage.draw(story)
        assert sent
        sent.clear()
        record.step()
        assert record.story is story
        stage.draw(story)
        assert [type(message).__name__ for message in sent if "Set" in type(message).__name__] == []
        ball = stage._things["ball"].frame
        place, told = ball.position.copy(), story.things
        stage._obstacles({name: thing for name, thing in told.items() if name != "ball"}, now)
        stage._obstacles(told, now)
        assert stage._things["ball"].frame is not ball
        assert stage._things["ball"].frame.position == pytest.approx(place, abs=1e-4)
    finally:
        page.close()


def test_the_story_before_a_look_comes_from_the_console() -> None:
    header = make_header("arm", ["a"], 8, 0.001)
    world = {
        "names": ["ball", "rod"],
        "slots": [2, 5],
        "meshes": ["", ""],
        "obstacles": {
            "kind": [0, 1],
            "R": [np.eye(3).tolist()] * 2,
            "p": [[1.0, 2.0, 3.0]] * 2,
            "v": [[0.0] * 3] * 2,
            "w": [[0.0] * 3] * 2,
            "dims": [[0.1, 0, 0, 0, 0], [0.05, 0.3, 0, 0, 0]],
        },
    }
    story = Story(header)
    story.know(known_obstacles(world), 4.0)
    story.message(5, encode_request(1, Request(obstacles=(ObstacleEdit("new", shape("box", [0.1, 0.1, 0.1, 0])),))))
    around = story._around
    assert [around.name_of(k) for k in range(6)] == ["new", "", "ball", "", "", "rod"]
    assert {name: t.shape["type"] for name, (t, _) in story.things.items()} == {
        "ball": "sphere",
        "rod": "capsule",
        "new": "box",
    }


def test_texts_of_a_log_are_no_markup(record: Recorded) -> None:
    record.seek(1.2)
    record.step()
    m = record.story.moment
    assert m is not None
    evil = "<script>alert(1)</script>"
    page = state_html(m._replace(state=evil, faults=((evil, evil),), status="limited"), evil, evil)
    page += bars_html(m._replace(clearances=((evil, 0.01),)), record.story.reader, {})
    assert "<script" not in page
    assert "&lt;script" in page


def test_a_bar_has_the_colour_of_the_obstacles_own_numbers(record: Recorded) -> None:
    """0.06 m: within the config's 0.1 m, beyond an influence of its own of 0.05 m, below a clearance of 0.07 m."""
    record.seek(1.2)
    record.step()
    story = record.story
    m = story.moment
    assert m is not None
    for numbers, colour in (
        ({}, AMBER),
        ({"influence": 0.05, "clearance": 0.01}, GREEN),
        ({"influence": 0.2, "clearance": 0.07}, RED),
    ):
        ball = Thing({"type": "sphere", **numbers}, 0.0, np.zeros((0, 6)))
        page = bars_html(m._replace(clearances=(("ball", 0.06),), torques=()), story.reader, {"ball": (ball, False)})
        assert [c for c in (AMBER, GREEN, RED) if c in page] == [colour]


def test_charts_have_as_many_values_as_times(record: Recorded) -> None:
    record.seek(1.7)
    record.step()
    for data in (*chart_data(record.story.chart), *chart_data(())):
        assert len({len(column) for column in data}) == 1
        assert (np.diff(data[0]) > 0.0).all()


# ---- bodies


def turned_arm(record: Recorded) -> tuple[Body, Reader, Scene]:
    """An arm on a base that stands askew, with points on its links; the recorder's own reading of it."""
    points = [[link, 0.1 * link, -0.05, 0.02 * link, 0.05] for link in range(8)]
    base = {"position": [0.3, -0.2, 0.1], "wxyz": [0.8, 0.0, 0.0, 0.6]}
    header = record._header._replace(files={SCENE_FILE: scene_text(points, (), base=base)})
    reader = Reader(header)
    return Body(header, reader.base, reader.points), reader, Scene(header)


def test_what_hangs_on_the_pages_joints_is_where_the_recorders_own_kinematics_have_it(record: Recorded) -> None:
    record.seek(1.5)
    record.step()
    m = record.story.moment
    assert m is not None
    body, reader, other = turned_arm(record)
    page = Page(record, Operator(None), "127.0.0.1", 0)
    try:
        page._server.scene.reset()
        stage = Stage(page._server, reader, body)
        stage.draw(record.story)
        nodes = page._server.scene._handle_from_node_name
        assert len(stage._spheres) == 8
        for k, sphere in enumerate(stage._spheres):
            place, path = np.array(sphere.position), sphere.name
            while path := path.rpartition("/")[0]:
                place = rotation(nodes[path].wxyz) @ place + nodes[path].position
            np.testing.assert_allclose(place, other._point({"q": m.q, "x": m.place}, k), atol=1e-4)
    finally:
        page.close()


def test_the_arm_drawn_is_where_the_recorders_own_kinematics_have_it(record: Recorded) -> None:
    """Two readings of a URDF: Pinocchio's, and the few lines that the recorder has for 3D viewers."""
    record.seek(1.5)
    record.step()
    m = record.story.moment
    assert m is not None
    body, _, other = turned_arm(record)
    body.move(m.q)
    assert len(body.points) == 8
    for k in range(len(body.points)):
        np.testing.assert_allclose(body.point(k), other._point({"q": m.q, "x": m.place}, k), atol=1e-9)
    assert {piece.joint for piece in body.pieces} >= set(range(1, 8))


@pytest.mark.parametrize(
    ("kind", "dims"),
    [
        ("sphere", [0.1, 0, 0, 0]),
        ("capsule", [0.05, 0.2, 0, 0]),
        ("cylinder", [0.1, 0.2, 0, 0]),
        ("cone", [0.1, 0.04, 0.15, 0]),
        ("cone", [0.1, 0.0, 0.15, 0]),
        ("box", [0.1, 0.2, 0.05, 0]),
        ("ellipsoid", [0.1, 0.2, 0.05, 0]),
        ("n_ellipsoid", [0.1, 0.2, 0.05, 4.0]),
        ("n_cylinder", [0.1, 0.1, 0.3, 4.0]),
    ],
)
def test_an_obstacle_is_drawn_where_the_controller_measures_it(kind: str, dims: list[float]) -> None:
    thing = shape(kind, dims)._replace(position=np.zeros(3), wxyz=np.array([1.0, 0.0, 0.0, 0.0]))
    told = {"type": kind, "dims": dims}
    body = triangles(told, np.zeros((0, 6)))
    shell = triangles(told, np.zeros((0, 6)), 0.08)
    assert body is not None
    assert shell is not None
    assert np.abs(distance(thing, body.vertices)[0]).max() < 1e-6
    away = distance(thing, shell.vertices)[0]
    assert away.min() > 0.05  # a shell of few facets, and a box whose corners are not rounded
    assert away.max() < 0.08 * 3**0.5 + 1e-6


# ---- asking


@contextmanager
def daemon(folder: Path, verdict: str = "") -> Iterator[tuple[str, list[Request]]]:
    """Yield the socket of a console that is served, and the requests that came through."""
    path, got, ended = str(folder / "run" / "arm.sock"), list[Request](), threading.Event()
    console = Console(path, PERIOD, BOUNDS)
    console.publish(lambda: {"wxyz": [1.0, 0.0, 0.0, 0.0]})

    def serve() -> None:
        slot = 0
        while not ended.wait(0.001):
            request = console.poll(slot)
            if request != Request():
                got.append(request)
            console.answer(not verdict, verdict)
            slot += 1

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield path, got
    finally:
        ended.set()
        thread.join()
        console.close()


def test_a_locked_page_asks_for_nothing_but_a_stop(tmp_path: Path) -> None:
    with daemon(tmp_path) as (path, got):
        operator = Operator(lambda: path)
        for answer in (operator.verb("arm"), operator.goal(np.ones(3), False), operator.clear("ball")):
            assert (answer.ok, answer.text) == (False, LOCKED)
        assert operator.verb("stop").ok
        operator.unlocked = True
        assert operator.verb("arm").ok
        assert operator.goal(np.array([0.4, 0.1, 0.5]), True).ok
        assert operator.obstacle(operator.new_name(), "box", 0.05, np.array([0.5, 0.0, 0.5])).ok
        assert [request.verb for request in got] == [Verb.STOP, Verb.ARM, Verb.NONE, Verb.NONE]
        assert got[2].goal is not None
        np.testing.assert_allclose(got[2].goal.position, [0.4, 0.1, 0.5])
        assert got[3].obstacles[0].shape is not None
        assert got[3].obstacles[0].shape.dims[:3].tolist() == [0.05, 0.05, 0.05]


def test_refusals_are_the_daemons_own_words(tmp_path: Path) -> None:
    with daemon(tmp_path, "the drives are not enabled") as (path, _):
        operator = Operator(lambda: path)
        operator.unlocked = True
        assert operator.verb("arm").text == "refused: the drives are not enabled"
        assert "wanted at most 1.200 m" in operator.goal(np.array([5.0, 0.0, 0.0]), False).text
    gone = Operator(lambda: (_ for _ in ()).throw(LinkError("no daemon is running")))
    assert gone.verb("stop").text == "no daemon is running"
    assert not Operator(None).verb("stop").ok


# ---- who may connect


@pytest.fixture
def behind() -> Iterator[int]:
    """Yield the port of a server that answers everything."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.1)
        ended = threading.Event()

        def serve() -> None:
            while not ended.is_set():
                try:
                    link, _ = server.accept()
                except TimeoutError:
                    continue
                with link:
                    link.recv(65536)
                    link.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\nConnection: close\r\n\r\npage")

        thread = threading.Thread(target=serve)
        thread.start()
        yield server.getsockname()[1]
        ended.set()
        thread.join()


def asked(gate: Gate, path: str = "/", **fields: str) -> tuple[int, bytes, str]:
    link = http.client.HTTPConnection("127.0.0.1", gate.port, timeout=10.0)
    link.request("GET", path, headers=fields)
    reply = link.getresponse()
    try:
        return reply.status, reply.read(), reply.headers.get("Set-Cookie", "")
    finally:
        link.close()


def test_this_user_may_and_other_sites_names_and_users_may_not(behind: int, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate("127.0.0.1", 0, behind)
    here = f"127.0.0.1:{gate.port}"
    try:
        assert asked(gate)[:2] == (200, b"page")
        assert asked(gate, Origin=f"http://{here}")[0] == 200
        assert asked(gate, Origin="http://evil.example")[0] == 403
        assert asked(gate, Host=f"evil.example:{gate.port}")[0] == 403
        assert asked(gate, Host=f"evil.example:{gate.port}", Origin=f"http://evil.example:{gate.port}")[0] == 403
        monkeypatch.setattr(gates, "owner_of", lambda peer, here: 4711)
        assert asked(gate)[:2] == (403, b"rtctl view: user 4711 of this machine may not connect\n")
    finally:
        gate.close()


def test_from_elsewhere_the_token_opens_and_a_cookie_keeps_open(behind: int) -> None:
    gate = Gate("0.0.0.0", 0, behind)
    try:
        assert len(gate.token) >= 32
        assert asked(gate)[0] == 403
        assert asked(gate, "/?token=guess")[0] == 403
        status, _, cookie = asked(gate, f"/?token={gate.token}")
        assert (status, "HttpOnly" in cookie, "SameSite=Strict" in cookie) == (303, True, True)
        assert asked(gate, Cookie=cookie.split(";")[0])[:2] == (200, b"page")
        assert asked(gate, Cookie="rtctl_view=guess")[0] == 403
    finally:
        gate.close()


def test_a_port_that_is_taken_is_told_in_a_line(behind: int) -> None:
    with pytest.raises(LinkError, match=f"--port {behind}"):
        Gate("127.0.0.1", behind, behind)


# ---- live, and in a browser


ONE = """<robot name="one"><link name="base"/><link name="arm"><visual><geometry><box size="0.1 0.1 0.6"/></geometry>
</visual></link><joint name="a" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint></robot>"""
CONFIG = "[robot]\njoints = [{tau_max_Nm = 10.0}]\n[avoid]\ninfluence_m = 0.1\n"


def ring_of(folder: Path) -> tuple[Any, Any]:
    """Return a producer whose ring holds an arm of one joint, and a record of it that runs."""
    header = make_header("one", ["a"], 4, 0.001, config=CONFIG, urdf=ONE)
    row = np.zeros(1, header.dtype)
    row["state"], row["status"], row["time"] = State.RUN, Status.MOVING, 0.5
    row["rho"], row["tau_sent"], row["goal"] = [[0.05, np.inf, np.inf, np.inf]], [[5.0]], [[0.0, 0.2, 0.02]]
    return create("rtctl-one-live.ring", 1 << 20, blob_of(header), [folder]), row[0]


def test_a_live_source_follows_the_ring_and_says_when_it_ends(tmp_path: Path) -> None:
    ring, row = ring_of(tmp_path)
    live = Live(ring=ring.path)
    assert live.story.moment is None
    event = encode_event(1, 0.5, "local_minimum", "crate")
    ring.put(5, encode_request(0, Request(obstacles=(ObstacleEdit("ball", shape("sphere", [0.1, 0, 0, 0])),))), 0)
    ring.put(1, row.tobytes(), 1)
    ring.put(4, event, 2)
    assert live.step() == ""
    m = live.story.moment
    assert m is not None
    assert (m.time, live.story.detail) == (0.5, "crate")
    assert m.clearances == (("ball", 0.05),)
    assert "ball" in live.story.things
    ring.finish()
    assert live.step() == "The run has ended."


def test_a_live_source_sees_that_who_ticked_was_killed(tmp_path: Path) -> None:
    ring, row = ring_of(tmp_path)
    with subprocess.Popen(["sleep", "600"]) as servo:
        ring.words[PRODUCER], ring.words[PRODUCER_START] = servo.pid, process_start(servo.pid)
        live = Live(ring=ring.path)
        ring.put(1, row.tobytes(), 1)
        assert live.step() == ""
        assert live.step() == ""  # it lives, though no tick came
        ring.put(1, row.tobytes(), 2)
        servo.kill()
        servo.wait()
        live.step()  # its last words
        assert live.step() == "The run has ended."


@pytest.mark.skipif(bool(browser.missing()), reason=browser.missing())
def test_the_page_in_a_browser_shows_and_commands(tmp_path: Path) -> None:
    ring, row = ring_of(tmp_path)
    live = Live(ring=ring.path)
    with daemon(tmp_path) as (path, got):
        page, ended = Page(live, Operator(lambda: path), "127.0.0.1", 0), threading.Event()
        thread = threading.Thread(target=page.run, args=(ended.is_set,))
        thread.start()
        try:
            ring.put(1, row.tobytes(), 1)
            with browser.Browser(browser.DRAWS) as chrome:
                used(chrome, page)
            assert [request.verb for request in got][:3] == [Verb.STOP, Verb.ARM, Verb.NONE]
            goal = got[2].goal
            assert goal is not None
            np.testing.assert_allclose(goal.position[:2], [0.0, 0.2], atol=1e-3)  # along the arrow that was taken
            assert 0.04 < goal.position[2] < 0.2
            until = time.monotonic() + 60.0
            while page.operator.unlocked and time.monotonic() < until:  # nobody looks any more: it locks itself
                time.sleep(0.05)
            assert not page.operator.unlocked
        finally:
            ended.set()
            thread.join()
            page.close()


def on_screen(page: Page, place: F64, size: tuple[int, int]) -> tuple[int, int]:
    """Return the pixel of a place (3,) [m], by a pinhole camera of its own."""
    camera = next(iter(page._server.get_clients().values())).camera
    ahead = camera.look_at - camera.position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = place - camera.position
    scale = 0.5 * size[1] / np.tan(0.5 * camera.fov) / (seen @ ahead)
    return round(0.5 * size[0] + scale * (seen @ right)), round(0.5 * size[1] - scale * (seen @ np.cross(right, ahead)))


def used(chrome: browser.Browser, page: Page) -> None:
    """Stop, unlock, arm and drag the goal as a person would, and read what the page says."""
    size = 1000, 500
    chrome.wide(*size)
    chrome.go(page.gate.url)
    chrome.wait("document.body.innerText.includes('Torque, share')")
    text = chrome.run("return document.body.innerText")
    assert "RUN" in text
    assert "Not an emergency stop" in text
    press = "[...document.querySelectorAll('button')].find(b => b.innerText.trim() == '{}')"
    chrome.run(f"{press.format('Stop')}.click()")
    chrome.wait("document.body.innerText.includes('stop: accepted')")
    assert not chrome.run(f"return {press.format('Arm')}")
    unlock = "document.querySelector('input[type=checkbox]:not([id^=mantine])')"  # those are viser's own
    # pressed again where it was not taken: a page that is drawn anew meanwhile loses a click
    chrome.wait(f"{press.format('Arm')} || ({unlock}.checked || {unlock}.click(), false)")
    chrome.run(f"{press.format('Arm')}.click()")
    chrome.wait("document.body.innerText.includes('arm: accepted')")
    chrome.drawn()
    goal, up = np.array([0.0, 0.2, 0.02]), np.array([0.0, 0.0, 0.08])
    chrome.pull(on_screen(page, goal + up, size), on_screen(page, goal + 2.0 * up, size))
    chrome.wait("document.body.innerText.includes('goal 0.000 0.200')")


def test_a_map_is_where_the_scan_was_when_it_was_taken() -> None:
    """A base that drives and turns beside a post: each scan is older than its record by another time."""
    seen = Seen()
    for k in range(40):
        age, t = 0.01 * (k % 12), 0.02 * k
        then = np.array([2.0 * (t - age), 0.3]), 0.1 + 0.5 * (t - age)
        way = np.array([3.0, 4.0]) - then[0]
        row = {
            "time": t,
            "x": np.array([2.0 * t, 0.3, 0.0]),
            "xd": np.array([2.0, 0.0, 0.0]),
            "heading": 0.1 + 0.5 * t,
            "yaw_rate": 0.5,
            "scan": np.array([np.nan, np.linalg.norm(way), np.inf]),
            "scan_start": np.arctan2(way[1], way[0]) - then[1] + 0.2,
            "scan_step": -0.2,
            "scan_age": age,
            "scan_offset": np.zeros(2),
        }
        seen.take(scan_of(row, float(row["heading"])))
    np.testing.assert_allclose(seen.places(), [[3.0, 4.0, 0.02]])


def test_a_page_without_viewers_sends_nothing(record: Recorded) -> None:
    page = Page(record, Operator(None), "127.0.0.1", 0)
    try:
        before = record.at
        page.step(0, 1.0)
        assert record.at == before
    finally:
        page.close()


def test_of_several_runs_one_is_named_by_what_tells_them_apart():
    panda, again, ur5 = (Path(f"/dev/shm/rtctl-{name}.ring") for name in ("panda-1-7", "panda-1-8", "ur5-1-9"))
    with pytest.raises(LinkError, match=r"by --robot NAME: panda, ur5$"):
        _only([ur5, panda], "")
    with pytest.raises(LinkError, match=rf"by --ring FILE: {panda}, {again}$"):
        _only([again, panda], "")
