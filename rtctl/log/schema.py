"""Topics, schemas and the constant-size layouts of their messages.

A layout is a template of bytes that holds every tag and length, and a dtype that says where the values go; encoding
a thousand messages is then one copy of the template and one numpy assignment per field, decoding one view.
"""

import struct
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet

from rtctl.log.header import Header
from rtctl.log.json_schema import json_schema
from rtctl.types import I64, U8

TICK = "/tick"
JOINT_STATES = "/joint_states"
EVENT = "/event"
LOG = "/log"
TF = "/tf"
SCENE = "/scene"
REQUEST = "/request"
CHECKPOINT = "/checkpoint"
DROPOUT = "/log/dropout"
SENTINEL = "/log/sentinel"
POSITION = "/log/position"

MESSAGE = np.dtype(  # a message record of MCAP up to its data
    [("op", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)

# dtype format -> protobuf type, wire type (1 = 8 bytes, 5 = 4 bytes): only types of fixed width
_FIXED = {
    "<f8": (FieldDescriptorProto.TYPE_DOUBLE, 1),
    "<f4": (FieldDescriptorProto.TYPE_FLOAT, 5),
    "<u4": (FieldDescriptorProto.TYPE_FIXED32, 5),
    "<u8": (FieldDescriptorProto.TYPE_FIXED64, 1),
    "<i4": (FieldDescriptorProto.TYPE_SFIXED32, 5),
    "<i8": (FieldDescriptorProto.TYPE_SFIXED64, 1),
}

JOINT_STATE_MSG = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


class Layout(NamedTuple):
    """Messages of one constant size."""

    template: U8  # (size,) a message whose values are zero
    wire: np.dtype[np.void]  # the values, at their offsets in the message
    tags: I64  # offsets of the bytes that are not values


class Channel(NamedTuple):
    """One topic of a log as it is written."""

    id: int
    topic: str
    encoding: str
    schema: str  # name
    schema_encoding: str
    schema_data: bytes


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


class _Builder:
    """Grows a template and its dtype together."""

    def __init__(self) -> None:
        self.bytes = bytearray()
        self.names: list[str] = []
        self.formats: list[npt.DTypeLike] = []
        self.offsets: list[int] = []

    def literal(self, data: bytes) -> None:
        self.bytes += data

    def value(self, name: str, format: npt.DTypeLike) -> None:
        self.names.append(name)
        self.formats.append(format)
        self.offsets.append(len(self.bytes))
        self.bytes += bytes(np.dtype(format).itemsize)

    def align(self, size: int, origin: int) -> None:
        self.bytes += bytes(-(len(self.bytes) - origin) % size)

    def layout(self) -> Layout:
        wire = np.dtype(
            {"names": self.names, "formats": self.formats, "offsets": self.offsets, "itemsize": len(self.bytes)}
        )
        literal = np.ones(len(self.bytes), dtype=bool)
        for format, offset in zip(self.formats, self.offsets, strict=True):
            literal[offset : offset + np.dtype(format).itemsize] = False
        return Layout(np.frombuffer(bytes(self.bytes), np.uint8), wire, np.flatnonzero(literal))


def tick_layout(dtype: np.dtype[np.void]) -> Layout:
    """Return the layout of `rtctl.Tick`: field i of the record is protobuf field i + 1, arrays packed and flat.

    Zeros are written too, which proto3 allows, so that the size is constant.
    Raises ValueError for a field whose type has no fixed width.
    """
    builder = _Builder()
    for number, (name, base, shape) in enumerate(_fields(dtype), start=1):
        _, wire_type = _FIXED[base.str]
        if shape:
            size = base.itemsize * int(np.prod(shape))
            builder.literal(_varint(number << 3 | 2) + _varint(size))
        else:
            builder.literal(_varint(number << 3 | wire_type))
        builder.value(name, (base, shape))
    return builder.layout()


def tick_descriptor(dtype: np.dtype[np.void]) -> bytes:
    """Return the serialized FileDescriptorSet of `rtctl.Tick`."""
    message = DescriptorProto(name="Tick")
    for number, (name, base, shape) in enumerate(_fields(dtype), start=1):
        message.field.add(
            name=name,
            number=number,
            type=_FIXED[base.str][0],
            label=FieldDescriptorProto.LABEL_REPEATED if shape else FieldDescriptorProto.LABEL_OPTIONAL,
        )
    return _file("rtctl/tick.proto", message)


def _fields(dtype: np.dtype[np.void]) -> list[tuple[str, np.dtype[np.generic], tuple[int, ...]]]:
    fields = []
    for name in dtype.names or ():
        field = dtype[name]
        if field.base.str not in _FIXED:
            raise ValueError(f"field {name}: {field.base.str} has no fixed width in protobuf; known: {sorted(_FIXED)}")
        fields.append((name, field.base, field.shape))
    return fields


def _file(name: str, message: DescriptorProto) -> bytes:
    file = FileDescriptorProto(name=name, package="rtctl", syntax="proto3")
    file.message_type.append(message)
    data: bytes = FileDescriptorSet(file=[file]).SerializeToString()
    return data


_CAN = (  # name, protobuf type, bytes before the value, format
    ("stamp_ns", FieldDescriptorProto.TYPE_FIXED64, b"\x09", "<u8"),  # monotonic clock
    ("id", FieldDescriptorProto.TYPE_FIXED32, b"\x15", "<u4"),  # without the flag bits
    ("dlc", FieldDescriptorProto.TYPE_FIXED32, b"\x1d", "<u4"),  # bytes of data, not the code of CAN FD
    ("direction", FieldDescriptorProto.TYPE_ENUM, b"\x20", "u1"),
    ("is_extended", FieldDescriptorProto.TYPE_BOOL, b"\x28", "u1"),
    ("is_rtr", FieldDescriptorProto.TYPE_BOOL, b"\x30", "u1"),
    ("is_error", FieldDescriptorProto.TYPE_BOOL, b"\x38", "u1"),
    ("fd", FieldDescriptorProto.TYPE_BOOL, b"\x40", "u1"),
    ("brs", FieldDescriptorProto.TYPE_BOOL, b"\x48", "u1"),
    ("esi", FieldDescriptorProto.TYPE_BOOL, b"\x50", "u1"),
    ("data", FieldDescriptorProto.TYPE_BYTES, b"\x5a", "u1"),
)
RX, TX = 0, 1
CAN_DATA_AT = sum(len(tag) + np.dtype(format).itemsize for _, _, tag, format in _CAN)  # of a frame's first data byte


def can_layout(size: int) -> Layout:
    """Return the layout of an `rtctl.CanFrame` with `size` (0..64) bytes of data."""
    builder = _Builder()
    for name, _, tag, format in _CAN[:-1]:
        builder.literal(tag)
        builder.value(name, format)
    builder.literal(_CAN[-1][2] + _varint(size))
    builder.value("data", ("u1", (size,)))
    return builder.layout()


def can_descriptor() -> bytes:
    """Return the serialized FileDescriptorSet of `rtctl.CanFrame`."""
    message = DescriptorProto(name="CanFrame")
    direction = message.enum_type.add(name="Direction")
    direction.value.add(name="RX", number=RX)
    direction.value.add(name="TX", number=TX)
    for name, kind, tag, _ in _CAN:
        type_name = ".rtctl.CanFrame.Direction" if kind == FieldDescriptorProto.TYPE_ENUM else None
        label = FieldDescriptorProto.LABEL_OPTIONAL
        message.field.add(name=name, number=tag[0] >> 3, type=kind, label=label, type_name=type_name)
    return _file("rtctl/can_frame.proto", message)


def joint_state_layout(names: tuple[str, ...]) -> Layout:
    """Return the layout of a little-endian CDR `sensor_msgs/msg/JointState` of these joints."""
    builder = _Builder()
    builder.literal(b"\x00\x01\x00\x00")  # CDR, little endian; alignment counts from behind these
    builder.value("sec", "<i4")
    builder.value("nanosec", "<u4")
    _cdr_string(builder, "")
    builder.align(4, 4)
    builder.literal(len(names).to_bytes(4, "little"))
    for name in names:
        builder.align(4, 4)
        _cdr_string(builder, name)
    for field in ("position", "velocity", "effort"):
        builder.align(4, 4)
        builder.literal(len(names).to_bytes(4, "little"))
        if names:
            builder.align(8, 4)
        builder.value(field, ("<f8", (len(names),)))
    return builder.layout()


def _cdr_string(builder: _Builder, text: str) -> None:
    data = text.encode() + b"\0"
    builder.literal(len(data).to_bytes(4, "little") + data)


_JSON = (
    (EVENT, "rtctl.Event"),
    (REQUEST, "rtctl.Request"),
    (CHECKPOINT, "rtctl.Checkpoint"),
    (DROPOUT, "rtctl.Dropout"),
    (SENTINEL, "rtctl.Sentinel"),
    (POSITION, "rtctl.Position"),
)


def channels(header: Header) -> tuple[Channel, ...]:
    """Return the channels of a log, each with its schema; ids are 1, 2, 3 ..."""
    tick = tick_descriptor(header.dtype)
    can = can_descriptor()
    rows = [
        (TICK, "protobuf", "rtctl.Tick", "protobuf", tick),
        (JOINT_STATES, "cdr", "sensor_msgs/msg/JointState", "ros2msg", JOINT_STATE_MSG.encode()),
        *((topic, "json", name, "jsonschema", json_schema(name)) for topic, name in _JSON),
        (LOG, "protobuf", "foxglove.Log", "protobuf", descriptor_set(Log.DESCRIPTOR)),
        (TF, "protobuf", "foxglove.FrameTransforms", "protobuf", descriptor_set(FrameTransforms.DESCRIPTOR)),
        (SCENE, "protobuf", "foxglove.SceneUpdate", "protobuf", descriptor_set(SceneUpdate.DESCRIPTOR)),
    ]
    rows += [(can_topic(bus), "protobuf", "rtctl.CanFrame", "protobuf", can) for bus in header.buses]
    for link in header.links:
        packet = mavlink_descriptor()
        rows += [(mavlink_topic(link, way), "protobuf", MAVLINK, "protobuf", packet) for way in ("rx", "tx")]
    return tuple(Channel(number, *row) for number, row in enumerate(rows, start=1))


def descriptor_set(message: Descriptor) -> bytes:
    """Return the serialized FileDescriptorSet of a message with all the files it needs, each after its own needs."""
    found: dict[str, FileDescriptor] = {}

    def add(file: FileDescriptor) -> None:
        for need in file.dependencies:
            add(need)
        found.setdefault(file.name, file)

    add(message.file)
    files = FileDescriptorSet()
    for file in found.values():
        file.CopyToProto(files.file.add())
    data: bytes = files.SerializeToString()
    return data


def can_topic(bus: str) -> str:
    """Return the topic of a bus."""
    return f"/can/{bus}"


MAVLINK = "rtctl.MavlinkPacket"
_MAVLINK = (("stamp_ns", "FIXED64", "<u8"), ("id", "FIXED32", "<u4"), ("system", "FIXED32", "<u4"),
            ("component", "FIXED32", "<u4"), ("sequence", "FIXED32", "<u4"))  # fmt: skip
_MAVLINK_HEAD = struct.Struct("<BQBIBIBIBIB")  # tags and values of the above, then the tag of the packet's bytes


def mavlink_descriptor() -> bytes:
    """Return the serialized FileDescriptorSet of `rtctl.MavlinkPacket`: a packet's bytes, and what its header says."""
    message = DescriptorProto(name="MavlinkPacket")
    optional = FieldDescriptorProto.LABEL_OPTIONAL
    for number, (name, kind, _) in enumerate(_MAVLINK, start=1):
        message.field.add(name=name, number=number, type=getattr(FieldDescriptorProto, f"TYPE_{kind}"), label=optional)
    message.field.add(name="data", number=6, type=FieldDescriptorProto.TYPE_BYTES, label=optional)
    return _file("rtctl/mavlink_packet.proto", message)


def mavlink_message(raw: bytes, stamp: int) -> bytes:
    """Return an `rtctl.MavlinkPacket` of a packet that came or went at monotonic time `stamp` [ns]."""
    if raw[:1] == b"\xfd" and len(raw) >= 12:
        sequence, system, component, number = raw[4], raw[5], raw[6], int.from_bytes(raw[7:10], "little")
    elif raw[:1] == b"\xfe" and len(raw) >= 8:
        sequence, system, component, number = raw[2], raw[3], raw[4], raw[5]
    else:
        sequence = system = component = number = 0
    head = _MAVLINK_HEAD.pack(0x09, stamp, 0x15, number, 0x1D, system, 0x25, component, 0x2D, sequence, 0x32)
    return head + _varint(len(raw)) + raw


def mavlink_packet(data: bytes) -> bytes:
    """Return the packet's bytes in a message that `mavlink_message` made."""
    at = _MAVLINK_HEAD.size
    return data[at + (1 if data[at] < 0x80 else 2) :]


def mavlink_topic(link: str, way: str) -> str:
    """Return the topic of a link's direction, `rx` or `tx`."""
    return f"/mavlink/{link}/{way}"
