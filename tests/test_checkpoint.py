"""Checkpoints: the whole memory to the bit, for its own robot alone; replays from them find what one in order finds."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from rtctl import design as cfg
from rtctl.app import arm as arm_vehicle
from rtctl.app import arm_log
from rtctl.app import replay as module
from rtctl.app.replay import Replay, replay
from rtctl.arm.escape import Escape, Phase
from rtctl.arm.memory import Memory
from rtctl.arm.pipe import tick
from rtctl.errors import LogError
from rtctl.log.read.run import read_run
from rtctl.log.record import checkpoint
from rtctl.log.record.checkpoint import decode_checkpoint, encode_checkpoint
from rtctl.types import Goal, ObstacleEdit, Request, Shape, State, Task
from tests.arms import PANDA_HOME
from tests.lab import PANDA, ROOT, Standing, at_rest, goal, healthy, recorded, robot, same, seen, sphere

PLANAR4 = ROOT / "configs" / "planar4.toml"
SCENE = f"""
robot = "{PANDA}"
duration_s = 1.3
[[goal]]
at_s = 0.3
position_m = [0.45, 0.15, 0.50]
[[obstacle]]
name = "ball"
type = "sphere"
radius_m = 0.05
position_m = [0.55, 0.4, 0.5]
velocity_m_s = [0.0, -0.1, 0.0]
"""
SPAN = 0.3  # [s] between checkpoints here


def busy() -> Memory:
    """Return a memory with something in every field that has room for it."""
    arm = Standing()
    arm.tick(Request(goal=goal(arm.memory, [0.5, 0.3, 0.5])))
    arm.tick(seen(sphere("ball", [0.5, 0.2, 0.5], 0.06, (0.0, -0.05, 0.0)), age=0.02))
    arm.ticks(20, qd=np.full(7, 0.05))
    aim = Goal(np.array([0.4, 0.1, 0.5]), np.array([1.0, 0.0, 0.0, 0.0]), Task.POSE, 1e-3, 1e-2, posture=PANDA_HOME)
    return arm.memory._replace(
        goal=aim,
        blocked_by=("ball at panda_link5",),
        blockers=1 << 63,
        escape=Escape(Phase.FIRST, hit=np.inf),
        innovation=np.nan,
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in several files, with a checkpoint every SPAN."""
    folder = tmp_path_factory.mktemp("checkpoints")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "PERIOD", SPAN)
        recorded(folder, SCENE)
    return folder / "run.mcap"


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the building of the robot."""
    monkeypatch.setattr(arm_log, "rebuilt", lambda run: (cfg.load(PANDA), robot()))
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda pid: {0, 1, 2})


def in_order(path: Path) -> Replay:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_at_once", lambda *given: None)
        return replay(read_run(path))


def equal(a: Replay, b: Replay) -> bool:
    return same(tuple(a._replace(seconds=0.0)), tuple(b._replace(seconds=0.0)))


# ---- the memory


def test_every_field_comes_back_to_the_bit_and_the_tick_goes_on_from_there():
    memory = busy()
    text = encode_checkpoint(memory, (3, 1, 4))
    assert text is not None
    found = decode_checkpoint(text, robot(), at_rest(robot(), PANDA_HOME))
    assert same(found.memory, memory)
    assert found.counters == (3, 1, 4)
    assert (type(found.memory.state), type(found.memory.task)) == (State, Task)
    feedback = healthy(PANDA_HOME, 40)
    assert same(tick(robot(), found.memory, feedback, Request()), tick(robot(), memory, feedback, Request()))


def test_none_is_made_while_a_cloud_is_known():
    cloud = Shape(
        "cloud",
        "cloud",
        np.array([0.01, 1e-3, 0, 0]),
        np.array([0.0, 0, 9]),
        np.array([1.0, 0, 0, 0]),
        np.zeros(3),
        np.zeros(3),
        cloud=bytes(600),
    )
    arm = Standing()
    arm.tick(Request(obstacles=(ObstacleEdit("cloud", cloud),)))
    assert encode_checkpoint(arm.memory, ()) is None


def test_one_of_another_robot_or_version_is_refused_by_name():
    text = encode_checkpoint(busy(), ())
    assert text is not None
    planar = robot(PLANAR4)
    with pytest.raises(ValueError, match="of this robot"):
        decode_checkpoint(text, planar, at_rest(planar, planar.home))
    body = json.loads(text)
    body["layout"] += ",more"
    with pytest.raises(ValueError, match="another version"):
        decode_checkpoint(json.dumps(body).encode(), robot(), at_rest(robot(), PANDA_HOME))


def places(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the way to every value of a JSON document."""
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [path, *(found for key, value in inner for found in places(value, (*path, key)))]


TEXT = json.loads(encode_checkpoint(busy(), (1,)) or b"")
PLACES = places(TEXT)[1:]
OTHER = st.sampled_from(
    [None, -1, 1 << 70, 0.5, "x", "<f8", "|O", [], [-1], [7], {}, {"a": "|O", "s": [2]}, {"x": "y"}]
)


@given(st.sampled_from(PLACES), OTHER)
def test_whatever_stands_in_a_checkpoint_it_is_taken_or_refused(place: tuple[Any, ...], other: Any):
    body = json.loads(json.dumps(TEXT))
    inner = body
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = other
    template = at_rest(robot(), PANDA_HOME)
    try:
        found = decode_checkpoint(json.dumps(body).encode(), robot(), template)
    except ValueError:
        return
    # what was taken fits: the tick can go on with it
    shapes = [np.shape(getattr(found.memory, name)) for name in ("good", "qdd", "sent", "rho", "encoder_monitors")]
    assert shapes == [np.shape(getattr(template, name)) for name in ("good", "qdd", "sent", "rho", "encoder_monitors")]


# ---- replay from them


@pytest.mark.usefixtures("built")
def test_spans_side_by_side_give_what_one_replay_in_order_gives(log: Path):
    run = read_run(log)
    assert run.count("/checkpoint") == 4
    done = replay(run)
    assert done.identical
    assert done.ticks == 1298
    assert equal(done, in_order(log))


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("at", [100, 899, 900, 1290])
def test_a_change_of_the_law_is_found_wherever_it_is(log: Path, monkeypatch: pytest.MonkeyPatch, at: int):
    law_tick = arm_vehicle.tick

    def nudged(arm: Any, memory: Any, *given: Any) -> Any:
        memory, command, record = law_tick(arm, memory, *given)
        if memory.tick == at:  # in what is remembered alone: it shows a tick later
            memory = memory._replace(joints=memory.joints._replace(q=memory.joints.q + 1e-12))
        return memory, command, record

    monkeypatch.setattr(arm_vehicle, "tick", nudged)
    done = replay(read_run(log))
    assert done.divergence is not None
    assert done.divergence.tick == at + 1
    assert equal(done, in_order(log))


@pytest.mark.usefixtures("built")
def test_a_checkpoint_that_is_not_what_the_ticks_lead_to_is_no_ground_to_stand_on(
    log: Path, monkeypatch: pytest.MonkeyPatch
):
    honest = module._marks

    def bent(run: Any) -> Any:
        marks = honest(run)
        body = json.loads(marks[1].text)
        body["counters"][2] ^= 1
        return [marks[0], marks[1]._replace(text=json.dumps(body).encode()), *marks[2:]]

    monkeypatch.setattr(module, "_marks", bent)
    done = replay(read_run(log))
    assert done.identical  # in order, without it
    assert done.ticks == 1298


@pytest.mark.usefixtures("built")
def test_a_log_that_lost_its_beginning_is_replayed_from_its_first_checkpoint(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    cut = tmp_path / "run.mcap"
    without_start(log, cut, int(read_run(log)["/tick"].time[150]))
    done = replay(read_run(cut))
    assert done.identical
    assert (done.ticks, done.time[0]) == (1298 - 300, pytest.approx(0.3))
    monkeypatch.setattr(module, "_marks", lambda run: [])
    with pytest.raises(LogError, match="begins with tick 150"):
        replay(read_run(cut))


def without_start(log: Path, cut: Path, start: int) -> None:
    """Write a log again without the messages before log_time `start` [ns]."""
    with log.open("rb") as source, cut.open("wb") as target:
        reader, writer = make_reader(source), Writer(target, compression=CompressionType.ZSTD)
        writer.start()
        found = reader.get_summary()
        assert found is not None
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        schemas = {k: writer.register_schema(s.name, s.encoding, s.data) for k, s in found.schemas.items()}
        ids = {
            k: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id], c.metadata)
            for k, c in found.channels.items()
        }
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if message.log_time >= start:
                writer.add_message(
                    ids[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                )
        writer.finish()
