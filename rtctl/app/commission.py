"""`rtctl commission`: how each drive is mounted on its joint, found by hand and by a small torque, one joint at a time.

First all drives are off and the operator moves a joint by hand: does its reading follow, in which direction, and where
is its zero. Then, with the operator's yes for each, a joint gets gravity's torque and a little more.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from rtctl.app.push import Bench, Push
from rtctl.errors import RtctlError
from rtctl.hal.can.link import LinkSpec
from rtctl.protocol.mounting import STRAIGHT, TURN, Mounting, joint_angle
from rtctl.spec.robot import Config, Joint
from rtctl.types import F64

FOLLOWS = 0.1  # [rad] by which a joint must be moved by hand, to tell its direction from noise
SAME = 0.02  # [rad] that a zero may differ from the file's and still be it: a hand places a joint no better
QUIT, SKIP, YES = ("q", "quit"), ("s", "skip"), ("y", "yes")


class Operator(Protocol):
    """Who stands beside the arm."""

    def say(self, text: str) -> None: ...
    def ask(self, text: str) -> str: ...


class Known(NamedTuple):
    """The arm's geometry, as far as commissioning needs it."""

    axes: F64  # (n, 3) of the joints, in the world, at home
    gravity: "Gravity"


class Gravity(Protocol):
    """Torque that holds the arm at q (n,) [rad]: (n,) [Nm]."""

    def __call__(self, q: F64) -> F64: ...


class Keys(NamedTuple):
    """What a robot file says of a joint's mounting."""

    direction: int
    zero_rad: float
    wrap: bool

    @property
    def mounting(self) -> Mounting:
        """The same for the codec, no turn off."""
        return Mounting(self.direction, self.zero_rad)


def geometry(config: Config, path: Path) -> Known:
    """Return axes and gravity of a config's arm; `path` is its file. Raises ConfigError."""
    from rtctl.arm.points import no_points
    from rtctl.design.arm import rigid_body  # the rigid-body library takes its time

    body = rigid_body(config, path)
    still, points = np.zeros(body.n), no_points()
    home = body.evaluate(np.array(config.robot.home_rad), still, points)
    return Known(home.J[3:].T.copy(), lambda q: body.evaluate(q, still, points).g.copy())


def keys_of(joint: Joint) -> Keys:
    """Return what the file says."""
    return Keys(joint.direction, joint.zero_rad, joint.wrap)


def straight(spec: LinkSpec) -> LinkSpec:
    """Return the link in the drives' own coordinates, within which they may stand anywhere."""
    joints = (j._replace(mounting=STRAIGHT, wraps=False, q_min=-math.inf, q_max=math.inf) for j in spec.joints)
    return spec._replace(joints=tuple(joints))


def by_hand(config: Config, known: Known, bench: Bench, operator: Operator, chosen: Sequence[int]) -> list[Keys]:
    """Return the keys of all joints: those of the chosen ones as found by moving them by hand, drives disabled."""
    found = [keys_of(joint) for joint in config.robot.joints]
    operator.say("All drives are off. An arm without brakes must lie or be held. Answers: Enter, a number; skip, quit.")
    for i in chosen:
        joint = config.robot.joints[i]
        x, y, z = (f"{value + 0.0:.2g}" for value in np.round(known.axes[i], 2))
        operator.say(f"\n{joint.name} (id {joint.can_id}); with the arm at home its axis points along {x} {y} {z}")
        direction = _direction(config, i, bench, operator)
        if direction is not None:
            found[i] = _zero(joint, i, direction, bench, operator)
    return found


def by_torque(
    config: Config, known: Known, bench: Bench, operator: Operator, chosen: Sequence[int], found: Sequence[Keys]
) -> list[str]:
    """Push the chosen joints by a small torque each, after the operator's yes; return those that went the wrong way."""
    wrong = []
    for i in chosen:
        joint, keys = config.robot.joints[i], found[i]
        while True:
            q = np.array([_angle(keys_, p) for keys_, p in zip(found, bench.readings(), strict=True)])
            gravity = float(known.gravity(q)[i])
            most = bench.share * joint.tau_max_Nm
            text = (
                f"\n{joint.name}: gravity's {gravity:.3g} Nm and up to {most:.3g} Nm more, in its positive direction, "
            )
            if not _yes(operator, text + "until it has moved a little. Stand clear. yes?"):
                operator.say(f"{joint.name}: not tested")
                break
            push = bench.push(i, keys.mounting, gravity, most)
            operator.say(f"{joint.name}: {push.told}")
            if push.contradicts:
                wrong.append(joint.name)
            if push.verdict != Push.SILENT:
                break
    return wrong


def changes(config: Config, found: Sequence[Keys]) -> dict[str, dict[str, int | float | bool]]:
    """Return the keys of each joint that must be changed in the file, by the joint's name."""
    out: dict[str, dict[str, int | float | bool]] = {}
    for joint, keys in zip(config.robot.joints, found, strict=True):
        before = keys_of(joint)._asdict()
        fresh = {key: value for key, value in keys._asdict().items() if value != before[key]}
        if fresh:
            out[joint.name] = fresh
    return out


def _direction(config: Config, i: int, bench: Bench, operator: Operator) -> int | None:
    """Return the direction of a joint that was moved by hand in its positive one; None: it is left as it is."""
    joint = config.robot.joints[i]
    while True:
        before = bench.readings()
        text = f"{joint.name} reads {before[i]:.4f} rad. Turn it by hand in its positive direction, by 0.2 rad or so: "
        if _answer(operator, text) in SKIP:
            return None
        moved = bench.readings() - before
        others = [
            f"{other.name} (id {other.can_id}) moved by {moved[k]:.3f} rad"
            for k, other in enumerate(config.robot.joints)
            if k != i and abs(moved[k]) > FOLLOWS
        ]
        if abs(moved[i]) > FOLLOWS and not others:
            direction = 1 if moved[i] > 0.0 else -1
            agrees = "as the file says" if direction == joint.direction else "the other way round than the file says"
            operator.say(f"it follows, by {moved[i]:+.3f} rad: direction = {direction}, {agrees}")
            return direction
        instead = f"; {', '.join(others)}: is can_id right?" if others else ""
        operator.say(f"{joint.name} moved by {moved[i]:.3f} rad, wanted more than {FOLLOWS:g}{instead}")


def _zero(joint: Joint, i: int, direction: int, bench: Bench, operator: Operator) -> Keys:
    """Return the keys of a joint after the operator has brought it to an angle that he knows."""
    while True:
        text = f"Bring {joint.name} to an angle that you know, and type it [rad] (Enter: 0; a number and deg): "
        answer = _answer(operator, text)
        if answer in SKIP:
            return keys_of(joint)._replace(direction=direction)
        q = angle(answer)
        if q is None:
            operator.say(f"got {answer!r}, wanted a number, or a number and deg")
            continue
        if not joint.q_min_rad - FOLLOWS <= q <= joint.q_max_rad + FOLLOWS:
            operator.say(f"got {q:.4f} rad, wanted one within {joint.q_min_rad:g} to {joint.q_max_rad:g}")
            continue
        keys = mounted(joint, direction, float(bench.readings()[i]) - direction * q)
        operator.say(_said(keys, joint))
        return keys


def mounted(joint: Joint, direction: int, reads: float) -> Keys:
    """Return the keys of a joint whose drive reads so much [rad] where the joint is at 0.

    A zero that is the file's but for whole turns stays, and so does one within half a turn. Else, where the joint's
    range says in which turn it is, the zero is taken to within half a turn and the encoder to lose whole turns.
    """
    told, clear = keys_of(joint), joint.q_max_rad - joint.q_min_rad < TURN
    off = round((reads - told.zero_rad) / TURN) if clear and direction == told.direction else 0
    if abs(reads - told.zero_rad - TURN * off) <= SAME:
        return Keys(direction, told.zero_rad, told.wrap or off != 0)
    turns = round(reads / TURN) if clear else 0
    return Keys(direction, round(reads - TURN * turns, 4) + 0.0, told.wrap or turns != 0)


def _said(keys: Keys, joint: Joint) -> str:
    same = " (as the file says)" if keys.zero_rad == joint.zero_rad else f" (the file says {joint.zero_rad:g})"
    wrap = ", wrap = true: it is whole turns off now" if keys.wrap and not joint.wrap else ""
    return f"zero_rad = {keys.zero_rad:g}{same}{wrap}"


def _angle(keys: Keys, p: float) -> float:
    """Return the joint angle of a reading, the turn nearest to zero where whole turns are lost."""
    q = joint_angle(p, keys.mounting)
    return q - TURN * round(q / TURN) if keys.wrap else q


def angle(text: str) -> float | None:
    """Return the angle [rad] that a person has typed, '' is 0; None for what is none."""
    number, unit = (text[:-3].strip(), math.pi / 180.0) if text.endswith("deg") else (text, 1.0)
    try:
        value = float(number or 0.0) * unit
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _answer(operator: Operator, text: str) -> str:
    """Return an answer without blanks around it. Raises RtctlError where the operator has had enough."""
    answer = operator.ask(text).strip().lower()
    if answer in QUIT:
        raise RtctlError("commission: ended by the operator; nothing was written")
    return answer


def _yes(operator: Operator, text: str) -> bool:
    return _answer(operator, f"{text} ") in YES
