"""Obstacles on their way into the tick: unions, ages, cameras, clouds in one message, meshes by name, logs of them."""

import json
import math
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim import camera as simulated
from firmware_sim.simulator import open_simulator
from rtctl import design as cfg
from rtctl.app.arm import misplaced
from rtctl.app.arm_link import first_feedback
from rtctl.app.sim import simulate
from rtctl.arm.law import prepared
from rtctl.arm.pipe import initial, tick
from rtctl.cli import main
from rtctl.errors import ConfigError, RequestError
from rtctl.hal import client, messages
from rtctl.hal.console import BYTES_PER_SLOT, Console
from rtctl.hal.messages import Bounds, Notice, cloud_message
from rtctl.log.header import meshes_of
from rtctl.log.read.inputs import inputs
from rtctl.log.read.reader import read
from rtctl.log.record.requests import decode_request, encode_request
from rtctl.spec.scenario import load_scenario
from rtctl.types import ObstacleEdit, Request, Shape, State
from rtctl.world import obstacle_table
from rtctl.world.primitives import CLOUD_POINTS
from tests.bodies import SURFACES, box, cloud_shape, known, mesh_shape, torus, write_obj, write_stl
from tests.lab import PANDA, PANDA_HOME, Standing, changed, robot, sphere

ORIGIN = np.zeros(3)
BOUNDS = Bounds((0.0, 0.0, 0.3), 1.2, 0.003, 0.015)


def put(table: obstacle_table.World, *shapes: Shape, age: float = 0.0, feed: bool = False) -> obstacle_table.World:
    table, refusal = obstacle_table.edited(table, tuple(ObstacleEdit(s.name, s, age, feed) for s in shapes))
    assert refusal == ""
    return table


def panda(folder: Path, **tables: list[dict[str, Any]]) -> Path:
    """Write the Panda's file with tables of obstacles and meshes; return its path."""
    text = changed(folder).read_text()
    for name, rows in tables.items():
        for row in rows:
            text += f"\n[[{name}]]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in row.items())
    (folder / "panda.toml").write_text(text)
    return folder / "panda.toml"


# ---- unions and sums


def test_parts_of_a_union_share_the_number_of_its_first_and_the_others_keep_their_own() -> None:
    a, b, c, d = (sphere(name, [1.0, 0.0, 0.0], 0.1) for name in "abcd")
    table = put(obstacle_table.empty(6), a._replace(group="u"), b, c._replace(group="u"), d._replace(group="v"))
    assert table.obstacles.group.tolist() == [0, 1, 0, 3, 4, 5]
    table, _ = obstacle_table.edited(table, (ObstacleEdit("a", None),))
    assert table.obstacles.group.tolist() == [0, 1, 2, 3, 4, 5]  # c is the first now
    table = put(table, b._replace(group="u"), d)
    assert table.obstacles.group.tolist() == [0, 1, 1, 3, 4, 5]


def test_of_a_union_the_nearest_part_acts_and_of_a_sum_all_do() -> None:
    """On the arm: a ball in a larger one adds nothing as a union, and as a sum what it would alone."""

    def torque(*shapes: Shape) -> np.ndarray:
        arm = Standing()
        arm.tick(Request(obstacles=tuple(ObstacleEdit(s.name, s) for s in shapes)))
        return np.asarray(arm.record[0]["tau_obstacles"])

    at = robot().body.evaluate(PANDA_HOME, np.zeros(7), robot().points).x + np.array([0.22, 0.0, 0.0])
    large, small = sphere("large", at, 0.1), sphere("small", at, 0.09)
    alone, other = torque(large), torque(small)
    assert np.abs(alone).max() > 1e-3
    assert np.abs(other).max() > 1e-4
    together = torque(large._replace(group="u"), small._replace(group="u"))
    assert np.array_equal(together, alone)
    assert np.allclose(torque(large, small), alone + other, atol=1e-12)


def scenario(folder: Path, text: str, robot_file: Path = PANDA) -> Path:
    path = folder / "s.toml"
    path.write_text(f'robot = "{robot_file}"\nduration_s = 0.4\n{text}')
    return path


PART = '[[obstacle]]\nname = "{}"\ntype = "sphere"\nradius_m = 0.1\nposition_m = [1.0, 0.0, 0.5]\n'


@pytest.mark.parametrize(
    ("second", "line"),
    [
        ('group = "u"\ncombine = "sum"', "combine: got sum, wanted union, as the rest of group u"),
        ('combine = "sum"', "combine: got sum, wanted a group beside it"),
        ('group = "u"\ncombine = "mean"', "combine: got 'mean', wanted one of"),
    ],
)
def test_groups_that_contradict_themselves_are_refused_by_a_line(tmp_path: Path, second: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scenario(scenario(tmp_path, PART.format("a") + 'group = "u"\n' + PART.format("b") + second + "\n"))
    assert f"obstacle[1].{line}" in str(caught.value)


# ---- age


def test_an_observation_widens_with_its_age_until_it_is_stale_and_not_beyond() -> None:
    table = obstacle_table.empty(4, creep=0.2, stale=0.5)
    table = put(table, sphere("ball", [1.0, 0.0, 0.0], 0.1, (0.0, 0.1, 0.0)), sphere("crate", [0.0, 2.0, 0.0], 0.1))
    table = put(table, sphere("fed", [0.0, 0.0, 3.0], 0.1), age=0.05, feed=True)
    assert table.obstacles.margin.tolist() == pytest.approx([0.0, 0.0, 0.01, 0.0])
    for _ in range(100):
        table = obstacle_table.advanced(table, 0.001)
    assert table.obstacles.margin.tolist() == pytest.approx([0.02, 0.0, 0.03, 0.0])
    assert obstacle_table.distance_from(table, ORIGIN)[2] == pytest.approx(2.9)  # where it was seen, margin or not
    for _ in range(1000):
        table = obstacle_table.advanced(table, 0.001)
    assert table.obstacles.margin.tolist() == pytest.approx([0.1, 0.0, 0.1, 0.0])
    assert obstacle_table.oldest(table) == pytest.approx(1.15)
    table = put(table, sphere("fed", [0.0, 0.0, 3.0], 0.1), feed=True)
    for _ in range(200):  # what is no longer needed is given back without a step
        table = obstacle_table.advanced(table, 0.001)
    assert table.obstacles.margin[2] == pytest.approx(0.1 - 0.25 * 0.2 * 0.2)
    table, _ = obstacle_table.edited(table, (ObstacleEdit("fed", None),))
    assert table.obstacles.margin[2] == 0.0


def test_the_field_sees_the_margin_and_contact_does_not() -> None:
    """A ball beside the tip, observed some time ago: repelled as if nearer; grown into the arm it is no contact."""
    arm = Standing(arm=prepared(robot()._replace(safety=robot().safety._replace(creep=0.3))))
    points = robot().points
    P = robot().body.evaluate(PANDA_HOME, np.zeros(7), points).P[: len(points.radius)]
    j = int(P[:, 0].argmax())
    ball = sphere("ball", P[j] + np.array([points.radius[j] + 0.1, 0.0, 0.0]), 0.06)  # 4 cm off
    seen = []
    for age in (0.0, 0.05, 0.1, 0.4):
        arm.tick(Request(obstacles=(ObstacleEdit("ball", ball, age, True),)))
        seen.append(float(arm.record[0]["rho"][0]))
        assert "contact" not in arm.present
    assert seen[0] - np.array(seen) == pytest.approx([0.0, 0.015, 0.03, 0.12], abs=1e-5)
    assert seen[-1] < 0.0
    assert arm.memory.rho[0] == pytest.approx(seen[0], abs=1e-5)


def test_what_a_camera_shows_must_be_shown_again_and_then_all_is_well() -> None:
    """At rest and seen by a feed: after 0.5 s of silence the arm holds; one more frame, and it goes on by itself."""
    arm, ball = Standing(), sphere("ball", [1.5, 0.0, 0.5], 0.1)
    frame = Request(obstacles=(ObstacleEdit("ball", ball, 0.0, True),))
    arm.tick(frame)
    for _ in range(499):
        arm.tick()
    assert "feed_stale" not in arm.present
    for _ in range(5):
        arm.tick()
    assert "feed_stale" in arm.present
    assert arm.memory.state == State.RUN  # SS2: brakes and holds, and an operator need not come
    arm.tick(frame)
    for _ in range(60):
        arm.tick()
    assert "feed_stale" not in arm.present
    silent = Standing()
    silent.tick(Request(obstacles=(ObstacleEdit("ball", ball),)))  # an operator's: nobody watches it
    for _ in range(600):
        silent.tick()
    assert not silent.present


@pytest.mark.parametrize("kind", ["mesh", "cloud"])
def test_a_body_that_appears_on_the_arm_is_a_contact_and_pushes_within_bounds(kind: str) -> None:
    arm = Standing(arm=robot()._replace(meshes=known(torus=torus())))
    x = robot().body.evaluate(PANDA_HOME, np.zeros(7), robot().points).x + np.array([0.13, 0.0, 0.0])
    ring = (torus().V / 1e-4).astype(np.int64)
    shape = mesh_shape("torus", x) if kind == "mesh" else cloud_shape(ring, 1e-4, 0.01, x)
    arm.tick(Request(obstacles=(ObstacleEdit(shape.name, shape),)))
    assert arm.record[0]["rho"][0] < 0.0
    arm.tick()
    assert "contact" in arm.present
    tau = arm.record[0]["tau_obstacles"]
    assert np.all(np.isfinite(tau))
    assert np.all(np.abs(tau) <= robot().tau_max)
    assert np.abs(tau).max() > 0.1


# ---- the control socket


@pytest.fixture
def console(tmp_path: Path) -> Iterator[Console]:
    c = Console(str(tmp_path / "run" / "arm.sock"), 0.001, BOUNDS)
    yield c
    c.close()


def cloud_of(count: int, **more: Any) -> bytes:
    steps = np.random.default_rng(count).integers(-3000, 3000, (count, 3)).astype("<i2")
    table = {"type": "cloud", "name": "bin", "position_m": [0.5, 0.0, 0.4], "point_radius_m": 0.01}
    return cloud_message({"set": table, "step_m": 1e-4, **more}, steps.tobytes())


def test_the_largest_cloud_is_one_message_and_reaches_the_tick(console: Console) -> None:
    """At 30 Hz the camera's credit lasts; a request of somebody else's is heard in between."""
    message = cloud_of(CLOUD_POINTS, feed=True, age_s=0.01)
    assert len(message) <= client.MESSAGE_MAX
    assert len(message) / BYTES_PER_SLOT < 1000 / 30
    table = obstacle_table.empty(8)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link, client.Session(console.path) as operator:
        link.setblocking(False)
        link.connect(console.path)
        taken, slot, verbs = 0, 0, 0
        for slot in range(330):
            if slot % 33 == 0:
                link.send(message)
            if slot % 33 == 1:
                operator._socket.send(b'{"verb": "stop"}')
            request = console.poll(slot)
            console.answer(True)
            verbs += request.verb != 0
            for edit in request.obstacles:
                table, refusal = obstacle_table.edited(table, (edit,))
                assert refusal == ""
                assert edit.feed
                assert 0.01 <= edit.age < 0.02
                taken += 1
        assert (taken, verbs) == (10, 10)
    steps = np.random.default_rng(CLOUD_POINTS).integers(-3000, 3000, (CLOUD_POINTS, 3))
    points = np.array([0.5, 0.0, 0.4]) + 1e-4 * steps
    assert obstacle_table.distance_from(table, ORIGIN)[0] == pytest.approx(
        np.linalg.norm(points, axis=1).min() - 0.01, abs=1e-12
    )


def test_one_cloud_at_a_time_goes_to_a_tick(console: Console) -> None:
    console._queue([Notice(n, None, 0.0, True, b"123456", 1e-3) for n in "abc"] + [Notice("d", None, 0.0)])
    sizes = [len(console.poll(slot).obstacles) for slot in range(5)]
    assert sizes == [1, 1, 1, 1, 0]


def test_a_stamp_counts_the_time_that_the_message_took() -> None:
    def told(**more: float) -> float:
        ball = {"type": "sphere", "name": "ball", "radius_m": 0.1, "position_m": [0.5, 0.0, 0.4]}
        message = messages.decode(json.dumps({"verb": "obstacles", "set": [ball], **more}).encode())
        assert isinstance(message, messages.ObstaclesMessage)
        return messages.notices_of(message, 100.0)[0].edit(0.002).age

    assert told(stamp_s=99.75) == pytest.approx(0.252)
    assert told(age_s=0.25) == pytest.approx(0.252)
    assert messages.notices_of(messages.decode(cloud_of(1, stamp_s=99.5)), 100.0)[0].age == pytest.approx(0.5)
    for more in ({"stamp_s": 100.001}, {"stamp_s": 80.0}, {"stamp_s": 99.9, "age_s": 0.1}):
        with pytest.raises(RequestError, match="stamp_s: got"):
            told(**more)


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (cloud_of(3)[:10], "request: got no JSON"),
        (cloud_of(3)[:40], "request: got no JSON"),
        (messages.CLOUD_MARK, "request: got no JSON"),
        (messages.CLOUD_MARK + b"\xff\xff\xff\xff{}", "request.set: got nothing"),
        (cloud_of(3, step_m=1.0), "step_m"),
        (cloud_of(3, more=1), "cloud.more: got an unknown name, wanted"),
        (
            cloud_of(3).replace(b'"position_m":[0.5,0.0,0.4]', b'"file":"/etc/shadow","x":1'),
            "cloud.set.x: got an unknown name",
        ),
        (b'{"verb":"cloud"}', "cloud.verb: got 'cloud', wanted"),
    ],
)
def test_a_cloud_that_is_not_whole_is_refused_by_a_line(message: bytes, line: str) -> None:
    with pytest.raises(RequestError, match=line) as caught:
        messages.decode(message)
    assert "\n" not in str(caught.value)


@given(st.binary(max_size=200), st.integers(0, 120))
def test_whatever_follows_the_mark_of_a_cloud_is_taken_or_refused(noise: bytes, at: int) -> None:
    message = bytearray(cloud_of(2))
    message[8 + at : 8 + at + len(noise)] = noise
    try:
        frame = messages.decode(bytes(message))
    except RequestError:
        return
    assert isinstance(frame, messages.CloudFrame)
    table, _ = obstacle_table.edited(obstacle_table.empty(2), messages.request_of(frame, BOUNDS, list).obstacles)
    assert np.isfinite(obstacle_table.distance_from(table, ORIGIN)[table.obstacles.active]).all()


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ({"type": "mesh", "file": "/etc/passwd"}, "obstacle.set.file: got '/etc/passwd', wanted mesh = the name"),
        ({"type": "mesh"}, "obstacle.set.mesh: got neither it nor file, wanted one of the two"),
        ({"type": "mesh", "mesh": "a", "scale": 2.0}, "obstacle.set.mesh: got a, wanted no scale or hull"),
        ({"type": "cloud", "point_radius_m": 0.1}, "a cloud comes as a binary message"),
        ({"type": "cloud", "point_radius_m": 0.1, "file": "x.npy"}, "a cloud comes as a binary message"),
    ],
)
def test_the_daemon_opens_no_file_that_a_peer_names(table: dict[str, Any], line: str) -> None:
    described = {"name": "it", "position_m": [0.5, 0.0, 0.4], **table}
    with pytest.raises(RequestError) as caught:
        messages.decode(json.dumps({"verb": "obstacle", "set": described}).encode())
    assert line in str(caught.value)


def test_a_mesh_is_told_by_the_name_that_the_config_gave_it(tmp_path: Path) -> None:
    write_stl(tmp_path / "it.stl", SURFACES["ell"])
    path = panda(tmp_path, mesh=[{"name": "ell", "file": "it.stl", "scale": 1.5}])
    arm = cfg.build(cfg.load(path), path)
    assert arm.meshes.names == ("ell",)
    told = messages.decode(
        json.dumps(
            {"verb": "obstacle", "set": {"type": "mesh", "name": "crate", "mesh": "ell", "position_m": [2.0, 0.0, 0.0]}}
        ).encode()
    )
    table, refusal = obstacle_table.edited(
        obstacle_table.empty(4, arm.meshes), messages.request_of(told, BOUNDS, list).obstacles
    )
    assert refusal == ""
    assert obstacle_table.distance_from(table, ORIGIN)[0] == pytest.approx(2.0 - 1.5 * 0.06, abs=1e-7)
    ghost = ObstacleEdit("crate", mesh_shape("ghost"))
    assert (
        obstacle_table.edited(table, (ghost,))[1]
        == "obstacle crate: mesh: got 'ghost', wanted one of the config's: ell"
    )


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        ({"mesh": [{"name": "a", "file": "no.stl"}]}, "mesh[0].file: got "),
        ({"mesh": [{"name": "a", "file": "a.obj"}] * 2}, "mesh[1].name: got a, wanted a name not used before"),
        (
            {"obstacle": [{"type": "mesh", "mesh": "b"}]},
            "obstacle[0].mesh: got b, wanted one of the config's [[mesh]]",
        ),
        ({"obstacle": [{"type": "mesh", "file": "b.obj"}]}, "obstacle[0].file: got "),
        ({"obstacle": [{"type": "cloud", "point_radius_m": 0.1}]}, "obstacle[0].file: got nothing"),
        ({"obstacle": [{"type": "cloud", "point_radius_m": 0.1, "file": "b.npy"}]}, "obstacle[0].file: got "),
    ],
)
def test_files_of_the_config_that_are_not_there_are_refused_by_a_line(
    tmp_path: Path, tables: dict[str, Any], line: str
) -> None:
    write_obj(tmp_path / "a.obj", box(0.1, 0.1, 0.1))
    for i, table in enumerate(tables.get("obstacle", ())):
        table |= {"name": f"o{i}", "position_m": [2.0, 0.0, 0.0]}
    path = panda(tmp_path, **tables)
    with pytest.raises(ConfigError) as caught:
        cfg.build(cfg.load(path), path)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_command_line_reads_a_clouds_file_and_sends_its_points(
    console: Console, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    points = np.random.default_rng(3).normal(size=(20_000, 3)) * 0.1
    np.save(tmp_path / "scan.npy", points)
    sent: list[bytes] = []

    def taken(session: client.Session, data: bytes) -> dict[str, Any]:
        sent.append(data)
        return {"ok": True}

    monkeypatch.setattr(client.Session, "ask_raw", taken)
    words = ["file=" + str(tmp_path / "scan.npy"), "point_radius_m=0.01", "position_m=1,0,0.5", "rpy_rad=0,0,1.5708"]
    assert main(["obstacle", "set", "bin", "cloud", *words, "--socket", console.path]) == 0
    assert "points of radius" in capsys.readouterr().out
    edits = messages.request_of(messages.decode(sent[0]), BOUNDS, list).obstacles
    table, refusal = obstacle_table.edited(obstacle_table.empty(2), edits)
    assert refusal == ""
    turned = points @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + np.array([1.0, 0.0, 0.5])
    true = float(np.linalg.norm(turned, axis=1).min() - 0.01)
    assert true - 0.06 < obstacle_table.distance_from(table, ORIGIN)[0] <= true + 1e-5


# ---- log and replay


def test_a_request_with_all_of_it_comes_out_of_the_log_as_it_went_in() -> None:
    shapes = (cloud_shape(np.array([[1, -2, 32767]]), 1e-4, 0.01), mesh_shape("ell"), sphere("b", [1.0, 0, 0], 0.1))
    edits = tuple(ObstacleEdit(s.name, s._replace(group="u"), 0.25, k == 0) for k, s in enumerate(shapes))
    _, request = decode_request(encode_request(7, Request(obstacles=edits)))
    for a, b in zip(edits, request.obstacles, strict=True):
        assert (a.name, a.age, a.feed) == (b.name, b.age, b.feed)
        assert a.shape is not None
        assert b.shape is not None
        for x, y in zip(a.shape, b.shape, strict=True):
            assert np.array_equal(x, y)
            assert type(x) is type(y)


BODIES = """
[[goal]]
at_s = 0.3
position_m = [0.5, 0.1, 0.5]
[[obstacle]]
name = "ring"
type = "mesh"
file = "ring.obj"
scale = 0.001
position_m = [0.6, 0.2, 0.5]
rpy_rad = [0.3, 0.2, 0.1]
group = "thing"
[[obstacle]]
name = "rod"
type = "capsule"
radius_m = 0.02
length_m = 0.3
position_m = [0.6, 0.2, 0.5]
group = "thing"
[[obstacle]]
name = "dust"
type = "cloud"
file = "dust.xyz"
point_radius_m = 0.01
position_m = [0.5, -0.3, 0.5]
velocity_m_s = [0.0, 0.05, 0.0]
omega_rad_s = [0.0, 0.0, 0.5]
"""


def test_a_run_past_meshes_clouds_and_unions_is_replayed_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cfg, "build", lambda config, path: robot())
    write_obj(tmp_path / "ring.obj", torus(0.1, 0.03), 0.001)
    np.savetxt(tmp_path / "dust.xyz", np.random.default_rng(4).normal(size=(300, 3)) * 0.03)
    figures = simulate(scenario(tmp_path, BODIES), log=tmp_path / "s.mcap")
    assert set(figures["min_clearance_m"]) == {"all", "ring", "rod", "dust"}
    log = read(tmp_path / "s.mcap")
    meshes = meshes_of(log.header)
    assert meshes.names == ("@ring",)
    arm = robot()._replace(meshes=meshes)
    q = np.frombuffer(bytes.fromhex(log.header.extra["q_handshake"]))
    memory, ticks, clouds = initial(arm, first_feedback(q)), 0, 0
    for logged in inputs([log]):
        memory, _, record = tick(arm, memory, logged.feedback, logged.request)
        assert record[0].tobytes() == logged.record.tobytes()
        clouds += any(e.shape is not None and e.shape.cloud for e in logged.request.obstacles)
        ticks += 1
    assert ticks == figures["ticks"]
    assert clouds > 10
    assert memory.rho[:3] == pytest.approx([figures["min_clearance_m"][n] for n in ("ring", "rod", "dust")], abs=0.15)


# ---- the other end of the wire


def test_the_plant_measures_a_mesh_and_a_cloud_as_the_shapes_they_stand_for(tmp_path: Path) -> None:
    """pybullet's triangles against its own box, its specks against its own ball, beside the arm at home."""
    write_obj(tmp_path / "box.obj", box(0.1, 0.05, 0.15))
    rng = np.random.default_rng(5)
    v = rng.normal(size=(9000, 3))
    np.save(tmp_path / "ball.npy", 0.08 * v / np.linalg.norm(v, axis=1)[:, None])
    pose = {"rpy_rad": [0.3, 0.7, -0.2]}
    specs = [
        {"name": "mesh", "type": "mesh", "file": str(tmp_path / "box.obj"), "position_m": [0.75, 0.1, 0.6], **pose},
        {"name": "box", "type": "box", "size_m": [0.2, 0.1, 0.3], "position_m": [0.75, 0.1, 0.6], **pose},
        {
            "name": "cloud",
            "type": "cloud",
            "file": str(tmp_path / "ball.npy"),
            "point_radius_m": 0.02,
            "position_m": [0.5, -0.3, 0.5],
            **pose,
        },
        {"name": "ball", "type": "sphere", "radius_m": 0.1, "position_m": [0.5, -0.3, 0.5]},
        {
            "name": "on",
            "type": "cloud",
            "file": str(tmp_path / "ball.npy"),
            "point_radius_m": 0.02,
            "position_m": [0.3, 0.0, 0.5],
        },
    ]
    simulator = open_simulator(PANDA, {"obstacle": specs})
    try:
        truth = simulator.truth()
        c = truth.clearance
        assert c["mesh"] == pytest.approx(c["box"], abs=1e-3)
        assert 0.02 < c["box"] < 0.4
        assert c["cloud"] == pytest.approx(c["ball"], abs=3e-3)
        assert c["on"] < 0.0
        assert truth.contacts == 1
        seen = {e.name: e.shape for e in simulator.obstacles()}
        table = put(obstacle_table.empty(8, known(**{"@mesh": box(0.1, 0.05, 0.15)})), *seen.values())
        rho = dict(zip(table.names, obstacle_table.distance_from(table, ORIGIN), strict=True))
        assert rho["mesh"] == pytest.approx(rho["box"], abs=1e-9)
        assert rho["cloud"] == pytest.approx(rho["ball"], abs=2e-3)
    finally:
        simulator.close()


def test_the_simulated_camera_sends_what_the_daemon_reads(tmp_path: Path) -> None:
    """Clouds as binary messages; a mesh by the config's name, one of a file of its own as the box that holds it."""
    write_stl(tmp_path / "ell.stl", SURFACES["ell"])
    np.save(tmp_path / "dust.npy", np.random.default_rng(6).normal(size=(500, 3)) * 0.05 + 0.2)
    path = panda(tmp_path, mesh=[{"name": "ell", "file": "ell.stl"}])
    specs = [
        {"name": "a", "type": "mesh", "mesh": "ell", "position_m": [1.0, 0.0, 0.5], "group": "g"},
        {"name": "b", "type": "mesh", "file": str(tmp_path / "ell.stl"), "position_m": [0.0, 1.0, 0.5]},
        {
            "name": "c",
            "type": "cloud",
            "file": str(tmp_path / "dust.npy"),
            "point_radius_m": 0.01,
            "position_m": [0.0, 0.0, 1.5],
            "omega_rad_s": [0.0, 0.0, 1.0],
        },
    ]
    simulator = open_simulator(path, {"obstacle": specs})
    sent: list[bytes] = []
    eye = simulated.Camera("nowhere", simulator.plant.solids)
    eye._connect = lambda: None  # type: ignore[method-assign]
    eye._socket = socket.socket()
    eye._send = lambda data: not sent.append(data)  # type: ignore[method-assign,func-returns-value]
    eye._read = lambda: None  # type: ignore[method-assign]
    for k in range(4):
        eye.tick(k * 20_000_000, 0)
    eye.close()
    truth = {e.name: e.shape for e in simulator.obstacles() if e.shape is not None}
    simulator.close()
    heard = [messages.decode(raw) for raw in sent]
    assert sum(isinstance(m, messages.CloudFrame) for m in heard) == 2  # of four frames at 50 Hz, at 30 Hz
    edits = [e for m in heard for e in messages.request_of(m, BOUNDS, list).obstacles]
    assert all(e.feed for e in edits)
    shapes = {e.name: e.shape for e in edits if e.shape is not None}
    assert (shapes["a"].type, shapes["a"].mesh, shapes["a"].group) == ("mesh", "ell", "g")
    assert shapes["b"].type == "box"
    assert shapes["b"].dims[:3] == pytest.approx(np.abs(SURFACES["ell"].V).max(axis=0), abs=1e-6)
    assert shapes["c"].cloud == truth["c"].cloud
    for key in ("position", "velocity", "omega", "dims"):
        assert np.allclose(getattr(shapes["c"], key), getattr(truth["c"], key), atol=1e-12), key
    assert math.isclose(shapes["c"].velocity[0], -0.2, abs_tol=0.05)  # its centre goes round the origin of its frame


def test_where_an_obstacle_would_lie_inside_the_arm_it_is_named():
    """By the distance of balls: centre to centre less both radii."""
    here, memory = robot(), Standing().memory
    P, radius = memory.model.P, here.points.radius
    for j in range(0, len(P), 7):
        others = np.linalg.norm(P - P[j], axis=1) - radius - 0.03
        deepest = int(others.argmin())
        told = misplaced(here, memory, ObstacleEdit("ball", sphere("ball", P[j], 0.03)))
        assert told.startswith(f"would lie {-others[deepest]:.3f} m inside {here.points.names[deepest]}")
    tip = float((np.linalg.norm(P - memory.tip.x, axis=1) - radius).min())
    beside = memory.tip.x + np.array([0.0, 0.0, -0.3])
    clear = float((np.linalg.norm(P - beside, axis=1) - radius).min())
    assert tip < 0.0 < clear
    near, touching = sphere("ball", beside, clear - 1e-6), sphere("ball", beside, clear + 1e-3)
    assert misplaced(here, memory, ObstacleEdit("ball", near)) == ""
    assert misplaced(here, memory, ObstacleEdit("ball", touching)).startswith("would lie 0.001")
    moved = sphere("ball", beside, 0.01, (0.0, 0.0, 3.0))
    assert misplaced(here, memory, ObstacleEdit("ball", moved, age=0.1)) != ""  # by now it has come to the tip
    assert misplaced(here, memory, ObstacleEdit("ball", None)) == ""
    blob = ObstacleEdit("ball", moved._replace(type="blob"))  # the tick says what is wrong with it
    assert misplaced(here, memory, blob) == ""
