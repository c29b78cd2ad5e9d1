"""Contradictions that a file carries by itself; each is a ConfigError that names the key to change."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rtctl.control.firas import eta_of, rho_num_of
from rtctl.errors import ConfigError
from rtctl.protocol import e2e, mit
from rtctl.protocol.mit import Scale
from rtctl.spec.bus import LOAD_MAX, Load, cycle_load
from rtctl.spec.obstacles import orientation_contradiction, refuse_obstacles
from rtctl.spec.read import name_place
from rtctl.spec.robot import Config, GripperTable, Joint
from rtctl.spell import nearest


class Found(NamedTuple):
    """A contradiction: the key to change, what it holds and what it would have to hold."""

    path: str
    got: object
    wanted: str


def refuse(config: Config, source: str) -> None:
    """Raise ConfigError for the first contradiction between the keys of `config`."""
    for group in (_available, _names, _drives, _grippers, _tool, _rates, _distances, _slots, _postures, _link):
        for found in group(config):
            raise ConfigError(name_place(source, found.path), found.got, found.wanted)
    refuse_obstacles(config.obstacle, source)
    for i, o in enumerate(config.obstacle):
        if o.waypoints or any((*o.velocity_m_s, *o.omega_rad_s)) or o.appears_s > 0.0 or o.vanishes_s < 1e6:
            place = name_place(source, f"obstacle[{i}].name")
            raise ConfigError(place, f"{o.name}, which moves", "one at rest; moving obstacles belong in a scenario")


def reply_id(joint: Joint | GripperTable) -> int:
    """Return the identifier of the replies of a joint's drive, or a gripper's."""
    return joint.can_id + mit.REPLY_OFFSET if joint.reply_id is None else joint.reply_id


def scale_of(config: Config, drive: str) -> Scale | None:
    """Return the scales of a drive by name; [drives] goes before the catalogue. None when neither has it."""
    own = config.drives.get(drive)
    return Scale(own.p_max_rad, own.v_max_rad_s, own.t_max_Nm) if own else mit.DRIVES.get(drive)


def scales(config: Config) -> tuple[Scale, ...]:
    """Return the scales of each joint's drive; for a config that `load` let through."""
    found = [scale_of(config, joint.drive) for joint in config.robot.joints]
    return tuple(scale for scale in found if scale is not None)


def brakes(config: Config) -> tuple[bool, ...]:
    """Return which joints have a holding brake: as the joint says, else as its drive's type; the catalogue's: none."""
    own = config.drives
    return tuple((j.drive in own and own[j.drive].brake) if j.brake is None else j.brake for j in config.robot.joints)


def bus_load(config: Config) -> Load:
    """Return the load of the configured bus at worst-case stuffing."""
    payload = e2e.LENGTH if config.link.protocol == "mit+e2e" else mit.LENGTH
    rate = config.link.data_bitrate if config.link.fd else None
    return cycle_load(
        len(config.robot.joints) + len(config.gripper), payload, config.link.bitrate, rate, 1.0 / config.loop.servo_hz
    )


def braking_distance(config: Config) -> float:
    """Return v_max^2 / (2 a_max) [m]."""
    return config.motion.v_max_m_s**2 / (2.0 * config.motion.a_max_m_s2)


def joint_speed(config: Config, i: int) -> float:
    """Return the speed [rad/s] that joint i's limit potential is made to spend."""
    return min(config.robot.joints[i].qd_max_rad_s, config.avoid.joint_speed_rad_s)


def _available(c: Config) -> Iterator[Found]:
    if c.robot.kind != "arm":
        yield Found("robot.kind", c.robot.kind, "arm; a base has tables of its own")
    if c.link.type != "can":
        yield Found("link.type", c.link.type, "can: an arm's drives are on a bus")
    if c.link.protocol == "cia402":
        yield Found("link.protocol", c.link.protocol, "mit or mit+e2e; this version does not speak CiA 402")


def _names(c: Config) -> Iterator[Found]:
    joints = c.robot.joints
    columns: dict[str, list[str | int]] = {
        "name": [j.name for j in joints],
        "can_id": [j.can_id for j in joints],
        "reply_id": [reply_id(j) for j in joints],
    }
    for key, values in columns.items():
        for i, value in enumerate(values):
            if value in values[:i]:
                yield Found(f"robot.joints[{i}].{key}", value, f"one that joint {values.index(value)} does not have")
    for i, joint in enumerate(joints):
        if reply_id(joint) in columns["can_id"]:
            of = joints[columns["can_id"].index(reply_id(joint))].name
            yield Found(f"robot.joints[{i}].reply_id", reply_id(joint), f"another than can_id of {of}")
    found = orientation_contradiction(c.robot.base_pose.rpy_rad, c.robot.base_pose.wxyz)
    if found:
        yield Found(f"robot.base_pose.{found[0]}", found[1], found[2])


def _drives(c: Config) -> Iterator[Found]:
    known = [*c.drives, *mit.DRIVES]
    for i, joint in enumerate(c.robot.joints):
        at, scale = f"robot.joints[{i}].", scale_of(c, joint.drive)
        if scale is None:
            yield Found(at + "drive", joint.drive, f"{nearest(joint.drive, known)}; or a table [drives.{joint.drive}]")
            continue
        of = f"of drive {joint.drive}"
        if joint.q_min_rad >= joint.q_max_rad:
            yield Found(at + "q_min_rad", joint.q_min_rad, f"less than q_max_rad = {joint.q_max_rad:g}")
        if joint.tau_max_Nm > scale.t_max:
            yield Found(at + "tau_max_Nm", joint.tau_max_Nm, f"at most t_max = {scale.t_max:g} {of}")
        if joint.qd_max_rad_s > scale.v_max:
            yield Found(at + "qd_max_rad_s", joint.qd_max_rad_s, f"at most v_max = {scale.v_max:g} {of}")
        for key, q in (("q_min_rad", joint.q_min_rad), ("q_max_rad", joint.q_max_rad)):
            p = joint.direction * q + joint.zero_rad
            if abs(p) > scale.p_max:
                reads = f"; the drive reads {p:g} there" if p != q else ""
                yield Found(at + key, q, f"within p_max = +-{scale.p_max:g} {of}{reads}")


def _grippers(c: Config) -> Iterator[Found]:
    joints: list[Joint | GripperTable] = [*c.robot.joints, *c.gripper]
    for k, gripper in enumerate(c.gripper):
        at, others = f"gripper[{k}].", joints[: len(c.robot.joints) + k]
        taken = {id_: o.name for o in others for id_ in (o.can_id, reply_id(o))}
        for key, value in (("can_id", gripper.can_id), ("reply_id", reply_id(gripper))):
            if value in taken:
                yield Found(at + key, value, f"one that {taken[value]} does not have")
        if gripper.name in [o.name for o in others]:
            yield Found(at + "name", gripper.name, "one that no joint and no other gripper has")
        if c.link.protocol != "mit":
            yield Found("link.protocol", c.link.protocol, "mit: a gripper's drive speaks no other")
        scale = scale_of(c, gripper.drive)
        if scale is None:
            known = [*c.drives, *mit.DRIVES]
            wanted = f"{nearest(gripper.drive, known)}; or a table [drives.{gripper.drive}]"
            yield Found(at + "drive", gripper.drive, wanted)
            continue
        way = abs(gripper.closed_rad - gripper.open_rad)
        if way < 0.05:
            yield Found(at + "closed_rad", gripper.closed_rad, "at least 0.05 rad from open_rad")
            continue
        for key in ("open_rad", "closed_rad"):
            if abs(getattr(gripper, key)) > scale.p_max:
                yield Found(at + key, getattr(gripper, key), f"within +-{scale.p_max:g} rad of drive {gripper.drive}")
        most = scale.t_max * way / gripper.travel_m
        if gripper.force_max_N > most:
            yield Found(at + "force_max_N", gripper.force_max_N, f"at most {most:.4g}: t_max over the jaws' lever")


def _tool(c: Config) -> Iterator[Found]:
    if c.tool is None or c.tool.inertia_kg_m2 is None:
        return
    xx, xy, xz, yy, yz, zz = c.tool.inertia_kg_m2
    least, middle, largest = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
    if least < 0.0 or largest > (least + middle) * (1.0 + 1e-6) + 1e-12:
        got = f"principal moments {least:.3g}, {middle:.3g}, {largest:.3g}"
        yield Found("tool.inertia_kg_m2", got, "none negative, none more than the other two together: no body has them")


def _rates(c: Config) -> Iterator[Found]:
    period = 1000.0 / c.loop.servo_hz  # [ms]
    hold, stop, watchdog = c.safety.stale_hold_ms, c.safety.stale_stop_ms, c.safety.watchdog_ms
    if c.loop.model_hz > c.loop.servo_hz:
        yield Found("loop.model_hz", c.loop.model_hz, f"at most servo_hz = {c.loop.servo_hz:g}")
    if watchdog <= 3.0 * period:
        yield Found("safety.watchdog_ms", watchdog, f"more than 3 servo periods = {3.0 * period:g} ms, at most 100")
    if hold < 2.0 * period:
        yield Found(
            "safety.stale_hold_ms", hold, f"at least 2 servo periods = {2.0 * period:g} ms: one frame may be lost"
        )
    if hold >= stop:
        yield Found("safety.stale_hold_ms", hold, f"less than stale_stop_ms = {stop:g}")
    if stop > watchdog:
        yield Found(
            "safety.stale_stop_ms", stop, f"at most watchdog_ms = {watchdog:g}: by then drives stop by themselves"
        )


def _slots(c: Config) -> Iterator[Found]:
    if len(c.obstacle) > c.avoid.obstacles_max:
        wanted = f"at least the {len(c.obstacle)} of [[obstacle]]"
        yield Found("avoid.obstacles_max", c.avoid.obstacles_max, wanted)


def _distances(c: Config) -> Iterator[Found]:
    a, v, dt = c.avoid, c.motion.v_max_m_s, 1.0 / c.loop.servo_hz
    zones = [("", a.influence_m, a.clearance_m, v, "m"), ("self_", a.self_influence_m, a.self_clearance_m, v, "m")]
    zones += [
        ("joint_", a.joint_influence_rad, a.joint_clearance_rad, joint_speed(c, i), "rad")
        for i in range(len(c.robot.joints))
    ]
    axes = c.motion.axes
    for i, axis in enumerate(axes):
        if axis in axes[:i]:
            yield Found(f"motion.axes[{i}]", axis, "each axis once")
    for prefix, rho0, rho_min, speed, unit in zones:
        if rho_min >= rho0:
            key = f"avoid.{prefix}clearance_{unit}"
            yield Found(key, rho_min, f"less than {prefix}influence_{unit} = {rho0:g}")
            return
        rho_num = rho_num_of(eta_of(speed, rho0, rho_min), dt)
        if rho_num >= rho_min:
            why = f"more than rho_num = {rho_num:.3g} of this speed and servo_hz = {c.loop.servo_hz:g}"
            yield Found(f"avoid.{prefix}clearance_{unit}", rho_min, why)
    layer, braking = a.influence_m - a.clearance_m, braking_distance(c)
    if braking > layer:
        # the slewed reference cannot give up v_max within the layer: the motion task would push into the field
        why = f"clearance_m + v_max^2/(2 a_max) = {a.clearance_m + braking:.3g} at least"
        yield Found("avoid.influence_m", a.influence_m, why)


def _postures(c: Config) -> Iterator[Found]:
    joints, zone = c.robot.joints, c.avoid.joint_influence_rad
    postures: list[tuple[str, Sequence[float]]] = [("robot.home_rad", c.robot.home_rad)]
    if c.motion.posture.q_rest_rad is not None:
        postures.append(("motion.posture.q_rest_rad", c.motion.posture.q_rest_rad))
    if c.robot.park_rad is not None:
        postures.append(("robot.park_rad", c.robot.park_rad))
    for joint in joints:
        if joint.q_max_rad - joint.q_min_rad <= 2.0 * zone:
            span = joint.q_max_rad - joint.q_min_rad
            yield Found("avoid.joint_influence_rad", zone, f"less than half the range {span:.3g} of joint {joint.name}")
    for path, q in postures:
        if len(q) != len(joints):
            yield Found(path, f"{len(q)} values", f"one for each of {len(joints)} joints")
            return
        for i, joint in enumerate(joints):
            low, high = joint.q_min_rad, joint.q_max_rad
            if not low <= q[i] <= high:
                yield Found(f"{path}[{i}]", q[i], f"within the limits {low:g} to {high:g} of {joint.name}")
            if not low + zone <= q[i] <= high - zone:
                # a rest posture inside a limit zone pulls against the potential: the tip stays short for ever
                free = ", ".join(f"{_nearest(j, x, zone):.4g}" for j, x in zip(joints, q, strict=True))
                wanted = f"outside the limit zone: {low + zone:.4g} to {high - zone:.4g}; the nearest is [{free}]"
                yield Found(f"{path}[{i}]", q[i], wanted)


def _nearest(joint: Joint, q: float, zone: float) -> float:
    """Return the angle [rad] next to q that is in no limit zone."""
    return min(max(q, joint.q_min_rad + zone), joint.q_max_rad - zone)


def _link(c: Config) -> Iterator[Found]:
    link = c.link
    if link.protocol == "mit+e2e" and not link.fd:
        yield Found("link.fd", "false", "true: mit+e2e needs 12-byte frames")
    if link.fd and link.data_bitrate is None:
        yield Found("link.data_bitrate", "nothing", "the bit rate of the data phase")
    if not link.fd and link.data_bitrate is not None:
        yield Found("link.data_bitrate", link.data_bitrate, "nothing: fd = false has no data phase")
    if link.data_bitrate is not None and link.data_bitrate < link.bitrate:
        yield Found("link.data_bitrate", link.data_bitrate, f"at least bitrate = {link.bitrate}")
    load = bus_load(c)
    if load.ratio > LOAD_MAX:
        got = f"{c.loop.servo_hz:g} (worst-case bus load {100 * load.ratio:.0f} %)"
        limit = LOAD_MAX / load.cycle
        yield Found(
            "loop.servo_hz", got, f"at most {limit:.0f} for {len(c.robot.joints)} joints on this bus (80 % load)"
        )
