"""JSON schemas of the messages that have no fixed size.

Foxglove draws a topic only where every object names its properties and every array the type of its items, which may not
be an array again. What a schema leaves out is allowed and comes as it was written.
"""

import json

from rtctl.plain import Json


def _is(kind: str, description: str = "", **more: object) -> Json:
    return {"type": kind, **more} | ({"description": description} if description else {})


def _list(items: Json, description: str = "") -> Json:
    return _is("array", description, items=items)


def _object(description: str = "", **properties: Json) -> Json:
    return _is("object", description, properties=properties)


_INTEGER, _NUMBER, _STRING = _is("integer"), _is("number"), _is("string")
_EVENT = _object(
    tick=_INTEGER,
    time=_is("number", "robot time [s]"),
    name=_is("string", "state, fault, rejected, or a status"),
    detail=_STRING,
    evidence=_object("of a fault: fields of the last ticks, oldest first"),
)
_GOAL = _object(
    position=_list(_NUMBER, "(3,) [m]"),
    wxyz=_list(_NUMBER, "(4,) unit quaternion"),
    task=_is("integer", "bits of types.Task: what of the tip's motion the goal constrains"),
    tolerance=_is("number", "[m]"),
    tolerance_rot=_is("number", "[rad]"),
    axis=_list(_NUMBER, "(3,) in the tip's frame"),
    posture=_list(_NUMBER, "(n,) [rad]"),
    velocity=_list(_NUMBER, "(3,) [m/s] of a goal that moves"),
    omega=_list(_NUMBER, "(3,) [rad/s]"),
    timeout=_is("number", "[s] for which it holds unless another comes"),
)
_SHAPE = _object(
    name=_STRING,
    type=_STRING,
    dims=_list(_NUMBER, "(4,) meaning by type"),
    position=_list(_NUMBER, "(3,) [m]"),
    wxyz=_list(_NUMBER, "(4,) unit quaternion"),
    velocity=_list(_NUMBER, "(3,) [m/s]"),
    omega=_list(_NUMBER, "(3,) [rad/s]"),
    group=_STRING,
    mesh=_STRING,
    influence=_is("number", "[m] of its own; the config's where it has none"),
    clearance=_is("number", "[m] likewise"),
    cloud=_is("string", "int16 steps of each point, little-endian", contentEncoding="base64"),
)
_REQUEST = _object(
    tick=_INTEGER,
    verb=_STRING,
    goal=_GOAL,
    advice=_object(
        posture=_list(_NUMBER, "(n,) [rad]"),
        leads=_is("boolean", "the joints head for it"),
        clear=_is("boolean", "the links in it keep the clearance"),
    ),
    drive=_list(_NUMBER, "(n,) [Nm] of another law"),
    obstacles=_list(_object(name=_STRING, age=_is("number", "[s]"), feed=_is("boolean"), shape=_SHAPE)),
)
_CHECKPOINT = _object(  # its `memory`, of the tick, is an array of all kinds of things
    tick=_INTEGER,
    layout=_is("string", "fields that the program kept: another version cannot use it"),
    counters=_list(_INTEGER, "of each joint's newest protected frame"),
    data=_is("string", "the arrays' bytes, one behind another", contentEncoding="base64"),
)
_DROPOUT = _object(count=_INTEGER, from_ns=_INTEGER, to_ns=_INTEGER)
_SENTINEL = _object(
    reason=_STRING,
    detail=_STRING,
    dropped=_INTEGER,
    malformed=_INTEGER,
    lost=_INTEGER,
    entries=_INTEGER,
)
_POSITION = _object(entries=_INTEGER)

_BY_NAME = {  # the required properties, the schema
    "rtctl.Event": ((), _EVENT),
    "rtctl.Request": (("tick", "verb"), _REQUEST),
    "rtctl.Checkpoint": (("tick",), _CHECKPOINT),
    "rtctl.Dropout": (("count",), _DROPOUT),
    "rtctl.Sentinel": (("reason",), _SENTINEL),
    "rtctl.Position": (("entries",), _POSITION),
}


def json_schema(name: str) -> bytes:
    """Return the text of a message's schema."""
    required, schema = _BY_NAME[name]
    return json.dumps({"title": name, **schema, "required": required}).encode()
