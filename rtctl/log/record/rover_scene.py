"""What a mobile base and its surroundings look like, for 3D viewers: footprint, way, scan, goal, speed, obstacles."""

import math

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from rtctl.log.header import Header
from rtctl.log.record import draw
from rtctl.log.record.scene import BODY
from rtctl.log.record.surroundings import Drawing
from rtctl.types import RecordRow

BASE_LINK = "base_link"
TALL = 0.2  # [m] of what is flat: footprint and goal
SPEED = 1.0  # [s] length of the arrow for 1 m/s
SLOWEST = 0.02  # [m/s] that gets an arrow


class BaseScene(Drawing):
    """A base among its obstacles; gives the two messages of a moment."""

    drawn = ("time", "x", "heading", "goal", "v_world", "way", "scan_start", "scan_step")

    def __init__(self, header: Header) -> None:
        super().__init__(header)
        self.points = [[float(v) for v in p] for p in self.about.get("points", ()) if len(p) == 3]

    def frames(self, record: RecordRow, ns: int) -> bytes:
        """Return foxglove.FrameTransforms of the estimated pose at log_time `ns`."""
        message = FrameTransforms()
        X = np.eye(4)
        c, s = math.cos(record["heading"]), math.sin(record["heading"])
        X[:2, :2], X[:3, 3] = [[c, -s], [s, c]], record["x"]
        draw.frame(message, ns, draw.WORLD, BASE_LINK, X)
        data: bytes = message.SerializeToString(deterministic=True)
        return data

    def own(self, message: SceneUpdate, record: RecordRow, ns: int) -> None:
        """Add the goal, the way there, what the scan saw and the speed."""
        x, goal = record["x"], draw.entity_of(message, "goal", ns)
        draw.disc(goal, record["goal"], 0.1, TALL, draw.GREEN)
        way = np.zeros((1 + min(max(0, int(record["corners"])), len(record["way"])), 3))
        way[0], way[1:, :2] = x, record["way"][: len(way) - 1]
        draw.strip(draw.entity_of(message, "way", ns), way, 0.03, draw.GREEN)
        self._seen(draw.entity_of(message, "scan", ns), record)
        speed, entity = float(np.hypot(*record["v_world"])), draw.entity_of(message, "speed", ns)
        if speed > SLOWEST:
            draw.arrow(entity, x, np.append(record["v_world"] / speed, 0.0), SPEED * speed, draw.RED, 0.04)

    def body(self, message: SceneUpdate) -> None:
        """Add the footprint's points."""
        body = draw.entity_of(message, "body", 0, BASE_LINK)
        for x, y, radius in self.points:
            draw.disc(body, (x, y, 0.5 * TALL), radius, TALL, BODY)

    @staticmethod
    def _seen(entity: SceneEntity, record: RecordRow) -> None:
        """Add where the scan met something, from the pose of now: it is younger than a turn of the sensor."""
        ranges = record["scan"]
        sectors = np.flatnonzero(np.isfinite(ranges) & (ranges > 0.0))
        angles = record["heading"] + record["scan_start"] + sectors * record["scan_step"]
        met = record["x"][:2] + ranges[sectors, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        for px, py in met.tolist():
            draw.ball(entity, (px, py, 0.5 * TALL), 0.04, draw.WHITE)
