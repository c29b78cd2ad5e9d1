"""Which whole turn an encoder stands in: after a power cycle some come back 2 pi off."""

from typing import NamedTuple

from rtctl.errors import HandshakeError
from rtctl.hal.can.link import JointSpec
from rtctl.protocol.mounting import TURN, drive_angle, joint_angle

BEYOND = 0.3  # [rad] outside its limits that a joint may stand, and still be known by the nearest whole turn


class Position(NamedTuple):
    """Whole turns that an encoder is off, and what people are told."""

    turns: int
    told: str


def position(joint: JointSpec, p: float, place: str, recover: bool) -> Position:
    """Return the whole turns at which a drive's reading p [rad] is within the joint's limits.

    With `recover` a joint may stand outside them. Raises HandshakeError, which names `place`, where no turn or more
    than one would do, and where the encoder would leave its range within the limits.
    """
    q = _angle(joint, p, 0)
    inside = _within(joint, p, 0.0)
    if not joint.wraps:
        hint = f"; {_angle(joint, p, inside[0]):.4f} rad, a whole turn away, is: wrap = true" if inside else ""
        if joint.q_min <= q <= joint.q_max:
            return Position(0, "")
        if not recover:
            wanted = f"{joint.q_min:g} to {joint.q_max:g} rad, or recover{hint}"
            raise HandshakeError(place, f"{q:.4f} rad", wanted)
        return Position(0, f"stands at {q:.4f} rad, not within its limits{hint}" if hint else "")
    found = inside or _within(joint, p, BEYOND if recover else 0.0)
    limits = f"within {joint.q_min:g} to {joint.q_max:g} rad"
    if len(found) > 1:
        got = f"a reading of {p:.4f} rad, which is {_angles(joint, p, found, ' or ')}"
        raise HandshakeError(place, got, f"one angle {limits}: bring the joint where only one is, or wrap = false")
    if not found:
        near = sorted(_turns(joint), key=lambda k: _distance(joint, _angle(joint, p, k)))[:2]
        got = f"a reading of {p:.4f} rad, which is {_angles(joint, p, near, ' or ')}"
        raise HandshakeError(place, got, f"one angle {limits}")
    return _turned(joint, p, found[0], place)


def _turned(joint: JointSpec, p: float, turns: int, place: str) -> Position:
    """Return the only possible number of turns; refuse one at which the reading saturates within the limits."""
    if turns == 0:
        return Position(0, "")
    mounting = joint.mounting._replace(turns=turns)
    reads = max((drive_angle(q, mounting) for q in (joint.q_min, joint.q_max)), key=abs)
    if abs(reads) > joint.scale.p_max:
        got = f"an encoder {_so_many(turns)} off, which at a joint limit would read {reads:.4f} rad"
        raise HandshakeError(place, got, f"within PMAX = {joint.scale.p_max:g}: switch the drive off and on again")
    q = joint_angle(p, mounting)
    return Position(turns, f"its encoder came back {_so_many(turns)} off: it reads {p:.4f} rad, taken as {q:.4f} rad")


def _angle(joint: JointSpec, p: float, turns: int) -> float:
    return joint_angle(p, joint.mounting._replace(turns=turns))


def _within(joint: JointSpec, p: float, slack: float) -> list[int]:
    """Return all whole turns at which the joint is within its limits, or outside by at most `slack` [rad]."""
    return [k for k in _turns(joint) if _distance(joint, _angle(joint, p, k)) <= slack]


def _turns(joint: JointSpec) -> range:
    """Return the turns that a reading can be off."""
    most = int(2.0 * joint.scale.p_max / TURN) + 2
    return range(-most, most + 1)


def _distance(joint: JointSpec, q: float) -> float:
    return max(joint.q_min - q, q - joint.q_max, 0.0)


def _angles(joint: JointSpec, p: float, turns: list[int], between: str) -> str:
    return between.join(f"{_angle(joint, p, k):.4f}" for k in turns) + " rad"


def _so_many(turns: int) -> str:
    return f"{turns:+d} turn{'s' if abs(turns) != 1 else ''}"
