"""Requests and events as JSON: the only inputs of a tick that have no fixed size. Floats round-trip to the bit."""

import base64

import msgspec
import numpy as np

from rtctl.plain import Json
from rtctl.types import F64, Advice, Goal, Grip, ObstacleEdit, Payload, Request, Shape, Task, Verb


def encode_request(tick: int, request: Request) -> bytes:
    """Return the JSON of what the tick of index `tick` was asked."""
    body: Json = {"tick": tick, "verb": request.verb.name.lower()}
    if request.goal is not None:
        body["goal"] = {k: _plain(v) for k, v in request.goal._asdict().items() if v is not None}
    if request.advice is not None:
        body["advice"] = {k: _plain(v) for k, v in request.advice._asdict().items()}
    if request.obstacles:
        body["obstacles"] = [
            {"name": e.name, "age": e.age, "feed": e.feed} | ({} if e.shape is None else {"shape": _shape(e.shape)})
            for e in request.obstacles
        ]
    if request.payload is not None:
        body["payload"] = tuple(request.payload)
    if request.grip is not None:
        body["grip"] = tuple(request.grip)
    if request.drive is not None:
        body["drive"] = request.drive
    return msgspec.json.encode(body)


def decode_request(data: bytes) -> tuple[int, Request]:
    """Return the tick index and the request of `encode_request`'s JSON. Raises ValueError."""
    try:
        body = msgspec.json.decode(data)
        goal, advice = body.get("goal"), body.get("advice")
        edits = tuple(
            ObstacleEdit(
                e["name"],
                None if e.get("shape") is None else _shape_of(e["shape"]),
                float(e["age"]),
                bool(e.get("feed", False)),  # logs of before there were feeds have none
            )
            for e in body.get("obstacles", ())
        )
        payload = None if body.get("payload") is None else Payload(*map(float, body["payload"]))
        asked = Request(
            Verb[body["verb"].upper()],
            None if goal is None else _goal(goal),
            edits,
            payload,
            None if advice is None else _advice(advice),
            _grip(body),
            None if body.get("drive") is None else tuple(map(float, body["drive"])),
        )
        return int(body["tick"]), asked
    except (msgspec.DecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"not a request: {error}") from None


def encode_event(tick: int, time: float, name: str, detail: str) -> bytes:
    """Return the JSON of an event at robot time `time` [s]."""
    return msgspec.json.encode({"tick": tick, "time": time, "name": name, "detail": detail})


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _shape(shape: Shape) -> Json:
    own = {"influence": shape.influence, "clearance": shape.clearance}
    return {k: _plain(v) for k, v in shape._asdict().items() if own.get(k, 1.0)}  # as before there were such


def _shape_of(body: Json) -> Shape:
    numbers = {k: np.array(body[k], np.float64) for k in ("dims", "position", "wxyz", "velocity", "omega")}
    return Shape(
        body["name"],
        body["type"],
        numbers["dims"],
        numbers["position"],
        numbers["wxyz"],
        numbers["velocity"],
        numbers["omega"],
        str(body.get("group", "")),  # logs of before there were such have none
        str(body.get("mesh", "")),
        base64.b64decode(body.get("cloud", ""), validate=True),  # as on the wire: 60 kB at most
        float(body.get("influence", 0.0)),
        float(body.get("clearance", 0.0)),
    )


def _advice(body: Json) -> Advice:
    return Advice(np.array(body["posture"], np.float64), bool(body["leads"]), bool(body["clear"]))


def _grip(body: Json) -> Grip | None:
    if body.get("grip") is None:
        return None
    closed, force, name = body["grip"]
    return Grip(float(closed), float(force), str(name))


def _goal(body: Json) -> Goal:
    return Goal(
        np.array(body["position"], np.float64),
        np.array(body["wxyz"], np.float64),
        Task(body["task"]),
        float(body["tolerance"]),
        float(body["tolerance_rot"]),
        np.array(body["axis"], np.float64),
        _array(body, "posture"),
        _array(body, "velocity"),  # logs of before there were streams have none
        _array(body, "omega"),
        None if body.get("timeout") is None else float(body["timeout"]),
    )


def _array(body: Json, key: str) -> F64 | None:
    return None if body.get(key) is None else np.array(body[key], np.float64)
