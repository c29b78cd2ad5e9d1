"""A DBC of one robot's bus: its own identifiers and its drives' scales, so that any tool decodes the frames."""

from collections.abc import Sequence
from typing import NamedTuple

DBC = "drive.dbc"  # name of the attachment
_STATUS = (
    '0 "disabled" 1 "enabled" 8 "over_voltage" 9 "under_voltage" 10 "over_current" '
    '11 "driver_hot" 12 "coil_hot" 13 "communication_lost" 14 "overload"'
)
_TEMPERATURES = ((55, 8, "T_mos"), (63, 8, "T_rotor"))
_FLAGS = ("watchdog_tripped", "clamped", "slew_limited", "derated", "brake_closed")


class Joint(NamedTuple):
    """What a DBC needs to know of a joint's drive."""

    name: str
    can_id: int
    reply_id: int
    p_max: float  # [rad]
    v_max: float  # [rad/s]
    t_max: float  # [Nm]


def dbc_of(joints: Sequence[Joint], protected: bool, kp_max: float, kd_max: float) -> str:
    """Return the text of a DBC; its signals are the drives', not the joints' where a drive is mounted otherwise."""
    lines = ['VERSION "rtctl MIT-mode joint drives"', "", "NS_ :", "", "BS_:", "", "BU_: Controller Drive", ""]
    for j in joints:
        command = [
            _range(7, 16, "p", j.p_max, "rad", "Drive"),
            _range(23, 12, "v", j.v_max, "rad/s", "Drive"),
            _signal(27, 12, "kp", kp_max / 4095, 0.0, 0.0, kp_max, "Nm/rad", "Drive"),
            _signal(47, 12, "kd", kd_max / 4095, 0.0, 0.0, kd_max, "Nm s/rad", "Drive"),
            _range(51, 12, "t", j.t_max, "Nm", "Drive"),
        ]
        reply = [
            _signal(7, 4, "err", 1, 0, 0, 15, "", "Controller"),
            _signal(3, 4, "id", 1, 0, 0, 15, "", "Controller"),
            _range(15, 16, "p", j.p_max, "rad", "Controller"),
            _range(31, 12, "v", j.v_max, "rad/s", "Controller"),
            _range(35, 12, "t", j.t_max, "Nm", "Controller"),
            *(_signal(at, size, name, 1, 0, 0, 255, "degC", "Controller") for at, size, name in _TEMPERATURES),
        ]
        if protected:
            command += [_signal(72, 1, "torque_wanted", 1, 0, 0, 1, "", "Drive")]
            reply += [_signal(72 + i, 1, name, 1, 0, 0, 1, "", "Controller") for i, name in enumerate(_FLAGS)]
            for signals, node in ((command, "Drive"), (reply, "Controller")):
                signals.append(_signal(71, 8, "counter", 1, 0, 0, 255, "", node))
                signals.append(_signal(87, 16, "crc", 1, 0, 0, 65535, "", node))
        length = 12 if protected else 8
        lines += [f"BO_ {j.can_id} {j.name}_command: {length} Controller", *command, ""]
        lines += [f"BO_ {j.reply_id} {j.name}_reply: {length} Drive", *reply, ""]
    lines += [f"VAL_ {j.reply_id} err {_STATUS} ;" for j in joints]
    return "\n".join(lines) + "\n"


def _range(start: int, size: int, name: str, limit: float, unit: str, node: str) -> str:
    """Return a signal of `size` bits over [-limit, limit]."""
    return _signal(start, size, name, 2.0 * limit / (2**size - 1), -limit, -limit, limit, unit, node)


def _signal(
    start: int, size: int, name: str, factor: float, offset: float, low: float, high: float, unit: str, node: str
) -> str:
    return f' SG_ {name} : {start}|{size}@0+ ({factor!r},{offset:g}) [{low:g}|{high:g}] "{unit}" {node}'
