"""What 3D viewers are given: schemas they can read, the arm and the rover among their obstacles, layouts that fit."""

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from rtctl.app.sim import simulate
from rtctl.arm.record import record_dtype
from rtctl.log import make_header, read
from rtctl.log.header import meshes_to_files
from rtctl.log.record.requests import encode_request
from rtctl.log.record.scene import Scene
from rtctl.types import Goal, LimitFlag, ObstacleEdit, Request, Severity, Shape, State, Task, Verb
from tests.arms import panda
from tests.base_lab import ROVER
from tests.bodies import SURFACES, known, sampled
from tests.lab import PANDA, ROOT, recorded, robot

ARM_SCENE = f"""
robot = "{PANDA}"
duration_s = 6.0
[[goal]]
at_s = 0.3
position_m = [0.45, 0.15, 0.50]
[[obstacle]]
name = "floor"
type = "plane"
position_m = [0.0, 0.0, -0.1]
"""
ROVER_SCENE = f"""
robot = "{ROVER}"
duration_s = 12.0
[[goal]]
at_s = 0.5
position_m = [40.0, 0.0, 0.0]
[[obstacle]]
name = "disc"
type = "cylinder"
radius_m = 2.0
length_m = 2.0
position_m = [20.0, 0.0, 0.0]
"""
AXES = np.eye(3)
MEANING = {"SS2": "brake", "SS1": "damp", "STO": "torque off"}


@pytest.fixture(scope="module")
def arm_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("arm")
    recorded(folder, ARM_SCENE)
    return folder / "run.mcap"


@pytest.fixture(scope="module")
def rover_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rover")
    (folder / "scene.toml").write_text(ROVER_SCENE)
    simulate(folder / "scene.toml", log=folder / "run.mcap")
    return folder / "run.mcap"


def decoded(log: Path, *topics: str) -> list[tuple[str, int, Any]]:
    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(c.topic, m.log_time, d) for _, c, m, d in reader.iter_decoded_messages(topics)]


# ---- JSON


def unreadable(schema: Any, place: str) -> Iterator[str]:
    """Yield what Foxglove's reader of JSON schemas refuses, by its documentation: then it leaves out the topic."""
    kind = schema.get("type")
    if kind == "object":
        if "properties" not in schema:
            yield f"{place}: an object without properties"
        for name, each in schema.get("properties", {}).items():
            yield from unreadable(each, f"{place}.{name}")
    elif kind == "array":
        if schema.get("items", {}).get("type") in (None, "array"):
            yield f"{place}: an array of {schema.get('items')}"
        else:
            yield from unreadable(schema["items"], f"{place}[]")
    elif kind not in ("boolean", "string", "number", "integer"):
        yield f"{place}: type {kind}"


def wrong(schema: Any, value: Any, place: str) -> Iterator[str]:
    """Yield where a value is not what its schema says."""
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float)}
    if not isinstance(value, kinds[schema["type"]]):
        yield f"{place}: {value!r}, wanted {schema['type']}"
    elif schema["type"] == "object":
        yield from (f"{place}: no {name}" for name in schema.get("required", ()) if name not in value)
        for name in schema["properties"].keys() & value.keys():
            yield from wrong(schema["properties"][name], value[name], f"{place}.{name}")
    elif schema["type"] == "array":
        for each in value:
            yield from wrong(schema["items"], each, f"{place}[]")
    elif schema.get("contentEncoding") == "base64":
        base64.b64decode(value, validate=True)


def schemas(log: Path) -> dict[str, Any]:
    with log.open("rb") as file:
        found = make_reader(file).get_summary()
    assert found is not None
    return {
        c.topic: json.loads(found.schemas[c.schema_id].data)
        for c in found.channels.values()
        if c.message_encoding == "json"
    }


def test_every_json_topic_has_a_schema_that_viewers_read_and_messages_that_are_as_it_says(arm_log: Path):
    about = schemas(arm_log)
    assert set(about) >= {"/event", "/request", "/checkpoint", "/log/dropout", "/log/sentinel", "/log/position"}
    assert [text for topic, schema in about.items() for text in unreadable(schema, topic)] == []
    with arm_log.open("rb") as file:
        messages = [(c.topic, json.loads(m.data)) for _, c, m in make_reader(file).iter_messages(list(about))]
    assert {topic for topic, _ in messages} >= {"/event", "/request", "/checkpoint", "/log/sentinel"}
    assert [text for topic, message in messages for text in wrong(about[topic], message, topic)] == []


def test_every_kind_of_request_is_as_its_schema_says(arm_log: Path):
    schema = schemas(arm_log)["/request"]
    z, q = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    cloud = Shape("c", "cloud", np.zeros(4), z, q, z, z, cloud=b"\x01\x02\x03\x04\x05\x06")
    for request in (
        Request(Verb.STOP),
        Request(goal=Goal(z, q, Task.POSITION, 0.01, 0.1)),
        Request(goal=Goal(z, q, Task.X | Task.DIRECTION, 0.01, 0.1, posture=np.zeros(7))),
        Request(obstacles=(ObstacleEdit("c", cloud, 0.1, True), ObstacleEdit("*", None))),
    ):
        assert list(wrong(schema, json.loads(encode_request(7, request)), "/request")) == []


# ---- 3D


def test_each_link_carries_the_spheres_that_the_law_keeps_clear(arm_log: Path):
    body, points = panda(), robot().points
    q = read(arm_log)["/tick"].q[0]
    pin.framesForwardKinematics(body.model, body.data, body.configuration(q))
    for _, _, scene in decoded(arm_log, "/scene")[:3]:  # in every message: a viewer that jumps sees the arm at once
        drawn = []
        for entity in (e for e in scene.entities if e.id.startswith("body ")):
            assert entity.frame_locked
            X = body.data.oMf[body.model.getFrameId(entity.frame_id)]
            drawn += [
                [*X.act(np.array([s.pose.position.x, s.pose.position.y, s.pose.position.z])), s.size.x]
                for s in entity.spheres
            ]
        joints = [body.data.oMi[int(link)] for link in points.link]
        wanted = [[*X.act(p), 2.0 * r] for X, p, r in zip(joints, points.local, points.radius, strict=True)]
        np.testing.assert_allclose(sorted(drawn), sorted(wanted), atol=1e-9)


def test_a_rovers_log_shows_it_where_it_was_with_its_goal_its_way_and_what_it_saw(rover_log: Path):
    ticks = read(rover_log)["/tick"]
    frames, scenes = decoded(rover_log, "/tf"), decoded(rover_log, "/scene")
    assert len(frames) == len(scenes) == pytest.approx(30.0e-9 * (ticks.time[-1] - ticks.time[0]), abs=2)
    for (_, stamp, frame), (_, _, scene) in list(zip(frames, scenes, strict=True))[::30]:
        row = ticks.time.searchsorted(stamp)
        (pose,) = frame.transforms
        turned = pin.Quaternion(*(getattr(pose.rotation, a) for a in "wxyz")).toRotationMatrix() @ AXES[0]
        assert (pose.parent_frame_id, pose.child_frame_id) == ("world", "base_link")
        np.testing.assert_allclose([pose.translation.x, pose.translation.y], ticks.x[row, :2], atol=1e-9)
        np.testing.assert_allclose(turned, [np.cos(ticks.heading[row]), np.sin(ticks.heading[row]), 0.0], atol=1e-9)
        drawn = {e.id: e for e in scene.entities}
        assert {"goal", "way", "scan", "speed", "body"} <= set(drawn)
        assert drawn["body"].frame_id == "base_link"
        assert len(drawn["body"].cylinders) > 0
        if ticks.tick[row] > 100:  # the goal came
            assert drawn["goal"].cylinders[0].pose.position.x == pytest.approx(40.0)
            corners = drawn["way"].lines[0].points
            assert corners[0].x == pytest.approx(ticks.x[row, 0])
            if np.isfinite(ticks.way_length[row]):  # none is known while it looks for one
                assert corners[-1].x == pytest.approx(40.0, abs=0.5)
    seen = [
        (s.pose.position.x, s.pose.position.y)
        for _, _, m in scenes
        for e in m.entities
        if e.id == "scan"
        for s in e.spheres
    ]
    away = np.abs(np.hypot(*(np.array(seen) - (20.0, 0.0)).T) - 2.0)
    assert len(seen) > 100
    assert np.quantile(away, 0.9) < 0.3  # the scan is up to 0.1 s old: it moved and turned since


def corners_of(cube: Any) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return centre (3,), axes as columns (3, 3) and half sizes (3,) [m] of a cube that is drawn."""
    pose = cube.pose
    R = pin.Quaternion(*(getattr(pose.orientation, a) for a in "wxyz")).toRotationMatrix()
    centre = np.array([pose.position.x, pose.position.y, pose.position.z])
    return centre, R, 0.5 * np.array([cube.size.x, cube.size.y, cube.size.z])


def held(points: np.ndarray[Any, Any], cubes: Any, slack: float = 1e-9) -> np.ndarray[Any, Any]:
    """Return which points (n, 3) lie in some cube."""
    found = np.zeros(len(points), bool)
    for centre, R, half in map(corners_of, cubes):
        found |= np.all(np.abs((points - centre) @ R) <= half + slack, axis=1)
    return found


def test_meshes_and_clouds_are_drawn_as_boxes_that_hold_them_and_little_else():
    rng, radius, step = np.random.default_rng(3), 0.01, 0.001
    turn = np.array([0.8, 0.0, 0.6, 0.0])
    R, at, z = pin.Quaternion(*turn).toRotationMatrix(), np.array([0.5, -0.2, 0.3]), np.zeros(3)
    ring = rng.uniform(0.0, 2.0 * np.pi, 3000)
    steps = np.round(np.column_stack([300 * np.cos(ring), 300 * np.sin(ring), rng.uniform(-20, 20, 3000)])).astype(
        "<i2"
    )
    cloud = Shape("ring", "cloud", np.array([radius, step, 0.0, 0.0]), at, turn, z, z, cloud=steps.tobytes())
    mesh = Shape("torus", "mesh", np.zeros(4), -at, turn, z, z, mesh="torus")
    header = make_header("panda", robot().joints, 8, 1e-3, files=meshes_to_files(known(torus=SURFACES["torus"])))
    scene = Scene(header)
    scene.request(encode_request(0, Request(obstacles=tuple(ObstacleEdit(s.name, s) for s in (cloud, mesh)))), 0.0)
    drawn = {e.id: e for e in SceneUpdate.FromString(scene.update(np.zeros((), record_dtype(7, 8)), 0)).entities}
    points, surface = at + steps * step @ R.T, -at + sampled(SURFACES["torus"], 3000, rng) @ R.T
    for axis in np.vstack([AXES, -AXES]):
        assert held(points + radius * axis, drawn["obstacle ring"].cubes).all()
    assert held(surface, drawn["obstacle torus"].cubes).all()
    for name, centre, size in (("ring", at, 0.32), ("torus", -at, 0.2)):
        cubes = drawn[f"obstacle {name}"].cubes
        assert 8 < len(cubes) <= 64
        assert not held(centre[None], cubes).any()  # the hole is seen
        assert all(np.abs((c - centre) @ R).max() <= size for c, _, _ in map(corners_of, cubes))


GOOD = {
    "type": "sphere",
    "dims": [0.1, 0, 0, 0],
    "position": [0, 0, 0],
    "wxyz": [1, 0, 0, 0],
    "velocity": [0, 0, 0],
    "omega": [0, 0, 0],
}


@pytest.mark.parametrize(
    "edit",
    [
        5,
        {"shape": 5},
        {"shape": {}},
        {"shape": GOOD, "age": "x"},
        {"shape": GOOD, "age": None},
        *(
            {"shape": {**GOOD, name: value}}
            for name in ("dims", "position", "wxyz", "velocity", "omega")
            for value in (None, "abc", [None] * 4, [0.0], [1e300] * 4)
        ),
    ],
)
def test_a_request_that_no_table_would_take_is_not_drawn_and_takes_no_slot(edit: Any):
    scene = Scene(make_header("panda", robot().joints, 8, 1e-3))
    bad = {**edit, "name": "bad"} if isinstance(edit, dict) else edit
    scene.request(json.dumps({"obstacles": [bad, {"name": "good", "shape": GOOD}]}).encode(), 0.0)
    drawn = SceneUpdate.FromString(scene.update(np.zeros((), record_dtype(7, 8)), 0)).entities
    assert [e.id for e in drawn if e.id.startswith("obstacle")] == ["obstacle good"]
    assert scene.name_of(0) == "good"


# ---- layouts


@pytest.mark.parametrize("name", ["foxglove.json", "foxglove_rover.json", "plotjuggler.xml"])
def test_layouts_show_what_logs_have(name: str, arm_log: Path, rover_log: Path):
    log = read(rover_log if "rover" in name else arm_log)
    text = (ROOT / "configs" / name).read_text()
    used = set(re.findall(r"/tick[./](\w+)", text))
    assert len(used) > 8
    assert used <= set(log["/tick"].fields)
    topics = set(re.findall(r'"(/\w+)(?:\.\w+)?"', text))
    assert topics <= set(log)
    if name.endswith(".json"):
        assert {"/scene", "/tf", "/log", "/event"} <= topics
        for path, label in re.findall(r'"value": "/tick\.(\w+)",\s*"label": "\w+: ([^"]+)"', text):
            kind = {"state": State, "severity": Severity, "cut": LimitFlag}[path]
            for number, words in (pair.split(" ", 1) for pair in label.split(", ")):
                member = kind(int(number))
                assert words == MEANING.get(member.name, member.name.lower().replace("_", " "))
