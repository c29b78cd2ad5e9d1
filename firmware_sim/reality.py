"""What a real arm has and its model does not: payload, wrong masses, friction, weak motors, brakes that slip or lack.

All of it is the plant's, the drives' and the bus's alone: the controller is told nothing. `[plant]` in a scenario, or a
file for `python -m firmware_sim --plant FILE`. Where it says nothing the arm is as described; brakes are ideal where
the robot file says that there are any.
"""

import math
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from firmware_sim.bullet import IS_THERE
from firmware_sim.settings import Settings, SettingsError

ENGINES = ("bullet", "mujoco")
IDEAL = -1.0  # a brake that holds whatever comes


class Reality(NamedTuple):
    """How the plant differs from the robot's description; a tuple has one value a joint."""

    payload_kg: float  # rigidly at payload_link
    payload_com: tuple[float, ...]  # (3,) [m] in that link's frame
    payload_link: str  # '' the tip's
    mass_error: dict[str, float]  # link -> fraction added to its mass; '' all others
    inertia_error: dict[str, float]  # the same of its inertia tensor
    urdf_dynamics: bool  # the URDF's own damping and friction act, too
    coulomb: tuple[float, ...]  # [Nm] friction of a joint that slides; by default as the robot file says
    static: tuple[float, ...]  # [Nm] of one that sticks, at least coulomb
    viscous: tuple[float, ...]  # [Nms/rad] beside the robot file's
    torque_gain: tuple[float, ...]  # of the torque a drive believes to give, what the joint gets
    brake: tuple[float, ...]  # [Nm] of a holding brake, IDEAL, 0 none
    encoder_zero: tuple[float, ...]  # [rad] the drive reads direction * q + zero; by default as the robot file says
    encoder_direction: tuple[float, ...]  # 1 or -1
    reply_loss: float  # share of replies that never arrive
    reply_late: float  # share of replies that arrive a period late
    talkers: tuple[int, ...]  # CAN ids on which somebody else sends a frame every period
    gripper_thing: float  # share of its way at which a gripper meets something, above 1 nothing
    engine: str  # that moves the arm, one of ENGINES
    model: str  # an MJCF file that stands for the robot file's URDF, '' for none


KEYS = (
    "payload_kg", "payload_com_m", "payload_link", "mass_error", "inertia_error", "urdf_dynamics", "coulomb_Nm",
    "static_Nm", "viscous_Nms_rad", "torque_gain", "brake", "encoder_zero_rad", "encoder_direction", "reply_loss",
    "reply_late", "talker_ids", "gripper_thing", "engine", "model",
)  # fmt: skip


def reality_of(table: dict[str, Any], settings: Settings) -> Reality:
    """Return what `[plant]` says. Raises SettingsError for what makes no sense, with the key."""
    unknown = sorted(set(table) - set(KEYS))
    if unknown:
        raise SettingsError(f"plant.{unknown[0]}: unknown, wanted one of {', '.join(KEYS)}")
    n = len(settings.joints)
    engine, model = _text(table, "engine") or ENGINES[0 if IS_THERE else 1], _text(table, "model")
    if engine not in ENGINES:
        raise SettingsError(f"plant.engine: got {engine!r}, wanted one of {', '.join(ENGINES)}")
    if engine == "bullet" and not IS_THERE:
        raise SettingsError('plant.engine: got "bullet", but pybullet is not installed; wanted "mujoco"')
    if model and engine != "mujoco":
        raise SettingsError(f'plant.model: an MJCF needs engine = "mujoco", which is "{engine}"')
    coulomb = _each(table, "coulomb_Nm", n, [j.coulomb for j in settings.joints], _within(0.0, 1000.0))
    return Reality(
        payload_kg=_one(table, "payload_kg", 0.0, _within(0.0, 200.0)),
        payload_com=_each(table, "payload_com_m", 3, 0.0, _within(-10.0, 10.0)),
        payload_link=_text(table, "payload_link"),
        mass_error=_by_link(table, "mass_error"),
        inertia_error=_by_link(table, "inertia_error"),
        urdf_dynamics=_flag(table, "urdf_dynamics"),
        coulomb=coulomb,
        static=tuple(map(max, _each(table, "static_Nm", n, 0.0, _within(0.0, 1000.0)), coulomb)),
        viscous=_each(table, "viscous_Nms_rad", n, 0.0, _within(0.0, 1000.0)),
        torque_gain=_each(table, "torque_gain", n, 1.0, _within(0.0, 2.0)),
        brake=_each(table, "brake", n, ["ideal" if j.brake else "none" for j in settings.joints], _brake),
        encoder_zero=_each(table, "encoder_zero_rad", n, [j.zero for j in settings.joints], _within(-100.0, 100.0)),
        encoder_direction=_each(table, "encoder_direction", n, [j.direction for j in settings.joints], _direction),
        reply_loss=_one(table, "reply_loss", 0.0, _within(0.0, 1.0)),
        reply_late=_one(table, "reply_late", 0.0, _within(0.0, 1.0)),
        talkers=_ids(table, "talker_ids"),
        gripper_thing=_one(table, "gripper_thing", 2.0, _within(0.0, 2.0)),
        engine=engine,
        model=model,
    )


def plant_table(path: str | Path) -> dict[str, Any]:
    """Return the `[plant]` of a file, which may be a scenario or hold nothing else. Raises SettingsError."""
    try:
        with Path(path).open("rb") as file:
            whole = tomllib.load(file)
    except (OSError, ValueError) as error:
        raise SettingsError(f"{path}: {error}") from error
    table = whole.get("plant", whole)
    if not isinstance(table, dict):
        raise SettingsError(f"{path}: plant: got {table!r}, wanted a table")
    return table


def _one(table: dict[str, Any], key: str, default: Any, read: Callable[[Any, str], float]) -> float:
    return read(table.get(key, default), f"plant.{key}")


def _each(
    table: dict[str, Any], key: str, n: int, default: Any, read: Callable[[Any, str], float]
) -> tuple[float, ...]:
    """Return n numbers of a key that gives them all, or one for all of them."""
    value = table.get(key, default)
    values = tuple(value) if isinstance(value, list | tuple) else (value,) * n
    if len(values) != n:
        raise SettingsError(f"plant.{key}: got {len(values)} values, wanted one or {n}")
    return tuple(read(v, f"plant.{key}") for v in values)


def _within(low: float, high: float) -> Callable[[Any, str], float]:
    def read(value: Any, place: str) -> float:
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not (good and low <= value <= high):
            raise SettingsError(f"{place}: got {value!r}, wanted a number from {low:g} to {high:g}")
        return float(value)

    return read


def _brake(value: Any, place: str) -> float:
    if value in ("none", "ideal"):
        return 0.0 if value == "none" else IDEAL
    try:
        return _within(1e-3, 1000.0)(value, place)
    except SettingsError as error:
        raise SettingsError(f'{error}: the Nm at which it slips; or "none", or "ideal"') from None


def _direction(value: Any, place: str) -> float:
    if value not in (1, -1) or isinstance(value, bool):
        raise SettingsError(f"{place}: got {value!r}, wanted 1 or -1")
    return float(value)


def _by_link(table: dict[str, Any], key: str) -> dict[str, float]:
    value, read = table.get(key, 0.0), _within(-0.9, 10.0)
    if isinstance(value, dict):
        return {str(k): read(v, f"plant.{key}.{k}") for k, v in value.items()}
    return {"": read(value, f"plant.{key}")}


def _text(table: dict[str, Any], key: str) -> str:
    value = table.get(key, "")
    if not isinstance(value, str):
        raise SettingsError(f"plant.{key}: got {value!r}, wanted a name")
    return value


def _flag(table: dict[str, Any], key: str) -> bool:
    value = table.get(key, False)
    if not isinstance(value, bool):
        raise SettingsError(f"plant.{key}: got {value!r}, wanted true or false")
    return value


def _ids(table: dict[str, Any], key: str) -> tuple[int, ...]:
    value = table.get(key, ())
    good = isinstance(value, list | tuple) and all(type(v) is int and 0 <= v <= 0x7FF for v in value)
    if not good or len(value) > 8:
        raise SettingsError(f"plant.{key}: got {value!r}, wanted at most 8 CAN ids from 0 to 0x7FF")
    return tuple(value)


def braked(reality: Reality) -> Sequence[bool]:
    """Return which joints have a holding brake at all."""
    return [b != 0.0 for b in reality.brake]
