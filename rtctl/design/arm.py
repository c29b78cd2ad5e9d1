"""A checked config into the derived `Robot`: URDF, field gains, zones, noises; conversion to SI happens here alone."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtctl.arm.encoders import SHARE
from rtctl.arm.estimator import Design, EstimatorParams, JointParams
from rtctl.arm.faults import SafetyParams
from rtctl.arm.field import (
    SUM,
    TASK,
    FieldParams,
    LimitParams,
    eta_of,
    field_buffers,
    field_params,
    limit_params,
    rho_num_of,
)
from rtctl.arm.gripper import Gripper
from rtctl.arm.law import prepared
from rtctl.arm.osc import MotionParams
from rtctl.arm.points import Coverage, Points, no_points
from rtctl.arm.rigid_body import RigidBody
from rtctl.arm.robot import Robot, StopParams
from rtctl.arm.self_collision import Own, nothing
from rtctl.control.firas import rooms_of
from rtctl.design import points as psp
from rtctl.design.assets import Assets, load_assets, placed
from rtctl.design.extremes import extremes, tool_of
from rtctl.design.filters import SLOW, design, design_joint, lateness, tip_params
from rtctl.design.pairs import watched
from rtctl.design.refusals import refuse_axes, refuse_contact, refuse_inertia, refuse_limits, refuse_torque
from rtctl.errors import ConfigError
from rtctl.kernel.rotations import R_of
from rtctl.protocol import mit
from rtctl.spec import rules
from rtctl.spec.goal import task_of
from rtctl.spec.obstacles import Obstacle, quaternion, refuse_rooms, shape_of
from rtctl.spec.read import name_place
from rtctl.spec.robot import Config, GripperTable
from rtctl.spec.urdf import package_folders, urdf_file
from rtctl.types import F64, Shape

NOTICEABLE = 0.002  # of the rating: an external torque that is less is what rounding of torques leaves
PROMPT = 0.01  # [s] of servo and model period together: up to there, what a model is behind is less than that rounding
FRICTION = 2.0  # times the torque that a drive may be wrong by: that much may hold a joint
VELOCITY_SHARE = 0.2  # of qd_max by which a joint's positions and its speed may disagree
OWN_RATE = 150.0  # [1/s] of the drives' own position loops at most: they turn at 10 kHz or more, the virtual ones at 2
OWN_DAMPING = 1.4  # of those loops, twice the damping ratio
P_BITS, V_BITS, T_BITS = 16, 12, 12  # of an MIT reply


def gripper_of(table: GripperTable) -> Gripper:
    """Return a gripper in the units of its drive."""
    lever = table.travel_m / abs(table.closed_rad - table.open_rad)
    return Gripper(
        name=table.name,
        open=table.open_rad,
        closed=table.closed_rad,
        lever=lever,
        torque=table.force_max_N * lever,
        speed=table.speed_m_s / lever,
        kp=table.kp_Nm_rad,
        kd=table.kd_Nms_rad,
    )


def build(config: Config, path: str | Path) -> Robot:
    """Return the robot of a checked config; `path` is its file, against which a relative URDF is looked for.

    Raises ConfigError where URDF and config contradict each other or the points leave a link uncovered.
    """
    source, joints = str(path), config.robot.joints
    body = rigid_body(config, Path(path))
    refuse_inertia(config, Path(path))
    refuse_limits(config, body, source)
    home = np.array(config.robot.home_rad)
    found = extremes(config, body)
    refuse_torque(config, found, source)
    refuse_axes(config, body, source)
    points, coverage, own = _geometry(config, body, home, source)
    assets = load_assets(config.mesh, config.obstacle, Path(path))
    obstacles = tuple(loaded_shape(o, assets) for o in config.obstacle)
    refuse_contact(obstacles, assets, body, points, home, source)
    avoid = _obstacle_field(config, points, source)._replace(overhang=coverage.overhang)
    refuse_rooms(config.obstacle, rooms_of(avoid), source)
    rest = config.motion.posture.q_rest_rad
    tau_rated = np.array([j.tau_max_Nm for j in joints])
    robot = Robot(
        name=config.robot.name,
        n=len(joints),
        joints=tuple(j.name for j in joints),
        links=body.links,
        slots=config.avoid.obstacles_max,
        dt=1.0 / config.loop.servo_hz,
        model_dt=1.0 / config.loop.model_hz,
        q_min=np.array([j.q_min_rad for j in joints]),
        q_max=np.array([j.q_max_rad for j in joints]),
        qd_max=np.array([j.qd_max_rad_s for j in joints]),
        tau_max=config.safety.torque_ratio * tau_rated,
        tau_rated=tau_rated,
        tau_rate=np.array([j.tau_rate_Nm_s for j in joints]),
        grippers=tuple(map(gripper_of, config.gripper)),
        payload_max=config.robot.payload_max_kg,
        friction_max=config.safety.friction_ratio * tau_rated,
        noticeable=NOTICEABLE * tau_rated * _behind(config.loop.servo_hz, config.loop.model_hz),
        viscous=np.array([j.friction_Nms_rad + j.friction.viscous_Nms_rad for j in joints]),
        viscous_told=np.array([j.friction.viscous_Nms_rad for j in joints]),
        coulomb=np.array([j.friction.coulomb_Nm for j in joints]),
        collision=config.safety.collision_ratio * tau_rated,
        collision_hard=config.safety.collision_hard_ratio * tau_rated,
        tau_lsb=np.array([2.0 * s.t_max / (2**T_BITS - 1) for s in rules.scales(config)]),
        braking=np.array([j.qd_max_rad_s for j in joints]) / config.avoid.joint_braking_s,
        home=home,
        q_rest=home.copy() if rest is None else np.array(rest),
        base=np.array(config.robot.base_pose.position_m),
        reach=_reach(config, body),
        body=body,
        points=points,
        coverage=coverage,
        own=own,
        obstacles=obstacles,
        meshes=assets.meshes,
        motion=_motion(config),
        avoid=avoid,
        postures=config.avoid.posture == "auto",
        plans=config.avoid.plan == "auto",
        escape=config.avoid.escape,
        self_avoid=_self_field(config),
        limit=_limit(config),
        **_filters(config, body, home)._asdict(),
        carry=config.estimator.carry,
        safety=_safety(config, tau_rated),
        stop=StopParams(
            damping=config.safety.stop_damping * found.inertia_home,
            decay=config.safety.stop_damping,
            kp=np.minimum(mit.KP_MAX, OWN_RATE**2 * found.inertia_free),
            kd=np.minimum(mit.KD_MAX, OWN_DAMPING * OWN_RATE * found.inertia_free),
            time=config.safety.stop_s,
            frames=config.safety.stop_frames,
            stall=config.safety.stall_s,
        ),
        scratch=field_buffers(config.avoid.obstacles_max, len(points.link), len(joints)),
        tolerance=config.motion.tolerance_m,
        tolerance_rot=config.motion.tolerance_rad,
        park=None if config.robot.park_rad is None else np.array(config.robot.park_rad),
        park_on_exit=config.robot.park_on_exit,
        urdf=str(urdf_file(config.robot.urdf, Path(path))),
        brakeless=not all(rules.brakes(config)),
        axes=task_of(config.motion.axes),
    )
    return prepared(robot)


def _behind(servo_hz: float, model_hz: float) -> float:
    """Return by how much more the torque of a load seems to be another because the model of a moving arm is old.

    It is carried along, and what is left grows as the square of its age.
    """
    return max(1.0, ((1.0 / servo_hz + 1.0 / model_hz) / PROMPT) ** 2)


def rigid_body(config: Config, path: Path) -> RigidBody:
    """Return the rigid body; complaints about the URDF are turned to name the key of the config."""
    urdf = urdf_file(config.robot.urdf, path)
    base = config.robot.base_pose
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R_of(quaternion(base.rpy_rad, base.wxyz)), base.position_m
    names = [j.name for j in config.robot.joints]
    armature = np.array([j.armature_kg_m2 for j in config.robot.joints])
    try:
        tip, tool = config.robot.tip_frame, tool_of(config)
        return RigidBody.from_urdf(urdf, names, tip, X, armature, package_folders(urdf), tool)
    except ConfigError as error:
        what = error.place.rpartition(": ")[2]
        if what == "joint" and error.got in names:
            key = f"robot.joints[{names.index(str(error.got))}].name"
        else:
            key = "robot.tip_frame" if what == "tip_frame" else "robot.urdf"
        raise ConfigError(name_place(str(path), key), error.got, f"{error.wanted} ({urdf.name})") from None


def _geometry(config: Config, body: RigidBody, home: F64, source: str) -> tuple[Points, Coverage, Own]:
    """Return PSPs, how well they cover the links, and the pairs of links that are watched."""
    listed = config.avoid.points
    try:
        if isinstance(listed, str):
            points, coverage = psp.place(body, config.avoid.overhang_m)
        else:
            points, coverage = psp.given(body, [(p.link, np.array(p.position_m), p.radius_m) for p in listed])
    except ConfigError as error:  # its place is the key alone
        raise ConfigError(name_place(source, error.place), error.got, error.wanted) from None
    if isinstance(listed, str) and coverage.protrusion >= config.avoid.clearance_m:
        place = name_place(source, "avoid.clearance_m")
        wanted = f"more than the {coverage.protrusion:.3g} that the links protrude from their points"
        raise ConfigError(place, config.avoid.clearance_m, wanted)
    q_min, q_max = (np.array([getattr(j, key) for j in config.robot.joints]) for key in ("q_min_rad", "q_max_rad"))
    if config.avoid.self_collision:
        # beyond the influence by what stops a link before it, and a little, that none comes there between evaluations
        reach = config.avoid.self_influence_m + 0.02 + rules.braking_distance(config)
        own = watched(body, q_min, q_max, home, config.avoid.self_clearance_m, reach)
    else:
        own = nothing()
    return points, coverage, own


def loaded_shape(obstacle: Obstacle, assets: Assets) -> Shape:
    """Return the obstacle as the controller takes it, a cloud with its points."""
    shape = shape_of(obstacle)
    return placed(shape, assets.clouds[obstacle.name]) if obstacle.name in assets.clouds else shape


def _reach(config: Config, body: RigidBody) -> float:
    """Return the sum [m] of the distances between neighbouring joints up to the tip: a bound that no posture passes."""
    model = body.model
    frame = model.frames[model.getFrameId(config.robot.tip_frame)]
    total, joint = float(np.linalg.norm(frame.placement.translation)), frame.parentJoint
    base = np.array(config.robot.base_pose.position_m)
    while joint != 0:
        t, parent = np.array(model.jointPlacements[joint].translation), model.parents[joint]
        total += float(np.linalg.norm(t - base if parent == 0 else t))
        joint = parent
    return total


def _motion(c: Config) -> MotionParams:
    m, p = c.motion, c.motion.posture
    return MotionParams(
        k_p=m.stiffness,
        k_v=2.0 * m.damping_ratio * float(np.sqrt(m.stiffness)),
        v_max=m.v_max_m_s,
        a_max=m.a_max_m_s2,
        w_max=m.w_max_rad_s,
        alpha_max=m.alpha_max_rad_s2,
        k_q=p.stiffness,
        d_q=p.damping,
        qdd_posture=p.damping * p.speed_ratio * np.array([j.qd_max_rad_s for j in c.robot.joints]),
        epsilon=m.singular_1_kg,
        length=m.length_m,
        speed_margin=m.joint_speed_ratio,
    )


def _obstacle_field(c: Config, points: Points, source: str) -> FieldParams:
    """Return the field of obstacles, the paper's own forms if asked for.

    Raises ConfigError for a clearance that the rate cannot hold where all points of a link are added.
    """
    a, v, dt = c.avoid, c.motion.v_max_m_s, 1.0 / c.loop.servo_hz
    forms = (SUM if a.superposition == "sum" else 0) | (TASK if a.inertia == "task" else 0)
    added = int(np.bincount(points.link).max()) if forms & SUM else 1
    rho_num = rho_num_of(added * eta_of(v, a.influence_m, a.clearance_m), dt)
    if rho_num >= a.clearance_m:
        why = f"more than rho_num = {rho_num:.3g} of the {added} points of a link together, of this speed and servo_hz"
        raise ConfigError(name_place(source, "avoid.clearance_m"), a.clearance_m, f'{why}; or superposition = "blend"')
    m_max = 1.0 / c.motion.singular_1_kg
    return field_params(
        v, a.influence_m, a.clearance_m, dt, a.damping_ratio, a.lookahead_s, m_max, forms=forms, added=added
    )


def _self_field(c: Config) -> FieldParams:
    a, dt, m_max = c.avoid, 1.0 / c.loop.servo_hz, 1.0 / c.motion.singular_1_kg
    v = c.motion.v_max_m_s
    return field_params(v, a.self_influence_m, a.self_clearance_m, dt, a.damping_ratio, a.lookahead_s, m_max)


def _limit(c: Config) -> LimitParams:
    n, dt = len(c.robot.joints), 1.0 / c.loop.servo_hz
    speed = np.array([rules.joint_speed(c, i) for i in range(n)])
    zone, clearance = np.full(n, c.avoid.joint_influence_rad), np.full(n, c.avoid.joint_clearance_rad)
    return limit_params(speed, zone, clearance, dt, c.avoid.damping_ratio)


class Filters(NamedTuple):
    """The filters of a `Robot`, named as its fields."""

    estimator: EstimatorParams
    tip_design: Design
    joint_filter: JointParams
    joint_P: F64  # (n, 2, 2)


def _filters(c: Config, body: RigidBody, home: F64) -> Filters:
    """Return the filters' noises and steady states: quantisation of the drives, seen at the tip through J at home."""
    e, n, dt = c.estimator, body.n, 1.0 / c.loop.servo_hz
    scales = rules.scales(c)
    # a quantised value is uniform within its step: standard deviation step/sqrt(12)
    lsb_p = np.array([2.0 * s.p_max / (2**P_BITS - 1) for s in scales])
    lsb_v = np.array([2.0 * s.v_max / (2**V_BITS - 1) for s in scales])
    joint_filter = JointParams(
        sigma_qdd=np.full(n, e.joint_acceleration_rad_s2),
        r_q=np.hypot(lsb_p / np.sqrt(12.0), e.position_noise_rad),
        r_qd=np.hypot(lsb_v / np.sqrt(12.0), e.velocity_noise_rad_s),
        has_qd=e.joint_velocity,
        as_then=dt > SLOW,
    )
    kinds, of = np.unique(np.stack(joint_filter[:3], axis=1), axis=0, return_inverse=True)  # equal drives, one design
    P = design_joint(joint_filter._replace(sigma_qdd=kinds[:, 0], r_q=kinds[:, 1], r_qd=kinds[:, 2]), dt, dt)
    J = body.evaluate(home, np.zeros(n), no_points()).J
    late = lateness(joint_filter, dt, 1.0 / c.loop.model_hz)
    tip = tip_params(J, P.measured[of.ravel()], e.acceleration_m_s2, e.acceleration_rad_s2, late)
    ratio = max(1, round(c.loop.servo_hz / c.loop.model_hz))
    # joints are predicted to now, so a pose has no age
    return Filters(tip, design(tip, dt, ratio, 0.0), joint_filter, P.now[of.ravel()])


def _safety(c: Config, tau_rated: F64) -> SafetyParams:
    s, period = c.safety, 1000.0 / c.loop.servo_hz  # [ms]
    return SafetyParams(
        stale_periods=int(s.stale_hold_ms / period + 1e-9),
        lost_periods=int(s.stale_stop_ms / period + 1e-9),
        torque_tolerance=s.torque_error_ratio * tau_rated,
        friction=FRICTION * s.torque_error_ratio * tau_rated,
        velocity_tolerance=_velocity_tolerance(c),
        speed_tolerance=s.speed_ratio,
        limit_tolerance=s.limit_excess_rad,
        innovation_max=c.estimator.innovation_sigma,
        feed_timeout=s.obstacle_stale_s,
        creep=c.avoid.obstacle_speed_m_s,
    )


def _velocity_tolerance(c: Config) -> F64:
    """Return the bound (n,) [rad/s] of positions against speed: a share of qd_max, and what rounding leaves."""
    if not c.estimator.joint_velocity:
        return np.full(len(c.robot.joints), np.finfo(np.float64).max)  # they report no speed worth comparing
    step = np.array([2.0 * s.p_max / (2**P_BITS - 1) for s in rules.scales(c)])
    noise = np.hypot(step, c.estimator.position_noise_rad) * c.loop.servo_hz
    qd_max = np.array([j.qd_max_rad_s for j in c.robot.joints])
    bound: F64 = VELOCITY_SHARE * qd_max + 2.0 * SHARE * noise
    return bound
