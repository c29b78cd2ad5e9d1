"""The first half of the servo level: from the drives' feedback to the state of the arm, and the faults that it shows.

    plausible feedback -> joint filter -> tip filter -> (model, when it is due) -> correction -> detection and latch

m is the memory's record (`hot.HOT`) of this tick, c the robot's constants (`law.prepared`); both are written and
read in place, as the fields of an object would be.
"""

import math
from typing import NamedTuple

import numpy as np

from rtctl.arm import collision
from rtctl.arm.detection import (
    BEYOND,
    GOAL_OLD,
    STIRS,
    STRUCK,
    TOUCHED,
    UNEXPLAINED,
    Clearances,
    JointBounds,
    Tolerances,
    encoder_flags,
    examine_feedback,
)
from rtctl.arm.disturbance import BANDWIDTH, LASTING, RESTING
from rtctl.arm.encoders import MONITORS, EncoderBounds, ExpectedMotion, PreviousPositions
from rtctl.arm.estimator import (
    EstimatorParams,
    JointEstimate,
    JointParams,
    TipEstimate,
    joint_step,
    predict_by_model,
    update_pose,
    update_velocity,
)
from rtctl.arm.faults import AUTOMATIC, FAULTS, Bounds, Counters, Evidence, counted, detect, implausible_positions
from rtctl.arm.model import Model
from rtctl.arm.stream import stale
from rtctl.arm.target import leads, target_of
from rtctl.control.faults import latch_with
from rtctl.kernel import kernel
from rtctl.kernel.reductions import greater, largest
from rtctl.types import B1, F64, Feedback, LimitFlag, RecordRow, State
from rtctl.world.primitives import Obstacles

GUIDED_SURPRISE = 4.0  # times the bound of the innovation, of an arm that a hand may jerk
REST_SPEED = 0.03  # [rad/s] a joint slower than this rests (encoders of MIT drives resolve 0.005)

# numbers of the enumerations, as compiled code reads them
_ARMED, _RUN, _STOPPING, _SAFE_STOP = (int(s) for s in (State.ARMED, State.RUN, State.STOPPING, State.SAFE_STOP))
_NON_FINITE, _FAULTS = int(LimitFlag.NON_FINITE), len(FAULTS)


class Surroundings(NamedTuple):
    """The obstacles as the servo level sees them."""

    obstacles: Obstacles
    moving: B1  # (K,) whether the age of its observation matters
    age: F64  # (K,) [s] since each was observed
    rho: F64  # (K,) [m] from the arm to each, of the previous tick
    goal_rho: F64  # (K,) [m] from the goal to each
    creep: float  # [m/s] speed that obstacles may have beside the one that is told
    stale: float  # [s] age at which an observation is too old


@kernel
def drives_torque(m: RecordRow) -> bool:
    """Return whether the state wants torque from the drives."""
    if m.state == _SAFE_STOP or m.state == _STOPPING:
        return bool(m.off == 0)
    return bool(m.state == _ARMED or m.state == _RUN)


@kernel
def plausible_feedback(c: RecordRow, m: RecordRow, f: Feedback) -> tuple[Feedback, bool]:
    """Return the feedback with silence in place of positions that no joint can have reached, and whether any is.

    A joint that goes on reporting such positions stays silent: the filter that damps it must not see the jump. So does
    one whose position a stop has found to be untrue.
    """
    n = f.q.shape[0]
    q, age, replies, implausible = f.q.copy(), f.age.copy(), f.replies.copy(), False
    if drives_torque(m) and m.state != _ARMED:
        elapsed, before = c.dt * (1 + f.missed), m.age_previous[:n]
        found = implausible_positions(f.q, f.age, f.replies, m.q_previous[:n], before, c.qd_max[:n], elapsed, c.dt)
        for i in range(n):
            if found[i] and m.own_phase != 0:  # it may be as fast as that: a joint that is let go is not bound
                apart = max(elapsed + before[i] - f.age[i], c.dt)
                found[i] = abs(f.q[i] - m.q_previous[i] - f.qd[i] * apart) > 0.05
            if found[i] or m.no_position >> i & 1:
                implausible = implausible or found[i]
                q[i], age[i], replies[i] = m.q_previous[i], min(before[i] + elapsed, c.safety_lost_periods * c.dt), 0
    return (
        Feedback(f.slot, f.missed, q, f.qd, f.tau, age, replies, f.drive, f.link, f.lateness, f.compute, f.grippers),
        implausible,
    )


@kernel
def _estimator(c: RecordRow) -> EstimatorParams:
    return EstimatorParams(
        c.estimator_sigma_a,
        c.estimator_sigma_alpha,
        c.estimator_r_v,
        c.estimator_r_omega,
        c.estimator_r_x,
        c.estimator_r_rot,
        c.estimator_late_x,
        c.estimator_late_rot,
    )


@kernel
def _joint_filter(c: RecordRow, n: int) -> JointParams:
    return JointParams(
        c.joint_sigma_qdd[:n].copy(),
        c.joint_r_q[:n].copy(),
        c.joint_r_qd[:n].copy(),
        c.joint_has_qd != 0.0,
        c.joint_as_then != 0.0,
    )


@kernel
def _joints(m: RecordRow, n: int) -> JointEstimate:
    return JointEstimate(m.q[:n].copy(), m.qd[:n].copy(), m.P[:n].copy())


@kernel
def _tip(m: RecordRow) -> TipEstimate:
    return TipEstimate(m.x.copy(), m.xd.copy(), m.P_tip.copy(), m.R.copy(), m.omega.copy(), m.P_rot.copy())


@kernel
def _put_tip(m: RecordRow, tip: TipEstimate) -> None:
    m.x[:], m.xd[:], m.P_tip[:], m.R[:], m.omega[:], m.P_rot[:] = tip.x, tip.xd, tip.P, tip.R, tip.omega, tip.P_rot


@kernel
def _stick(c: RecordRow, m: RecordRow, model: Model, qdd: F64) -> None:
    """Take from predicted accelerations (n,) [rad/s2] of joints that stand what friction that nobody told of may hold.

    The torque on a joint that sticks grows and the joint does not move. What is external to it follows as it is
    observed, and that late: of a light wrist it is tens of rad/s2 that never come.
    """
    if m.noticed == 0:
        return
    for i in range(qdd.shape[0]):
        if abs(m.qd_measured[i]) < RESTING:
            held = c.friction_max[i] / model.A[i, i]
            qdd[i] -= min(max(qdd[i], -held), held)


@kernel
def predict(c: RecordRow, m: RecordRow, f: Feedback, model: Model, elapsed: float) -> bool:
    """Advance joints and tip to this slot; return whether the model must be evaluated, or its task space."""
    n = f.q.shape[0]
    qdd = m.qdd[:n].copy()
    _stick(c, m, model, qdd)
    joints, surprise = joint_step(_joints(m, n), qdd, f.q, f.qd, f.age, f.replies, elapsed, _joint_filter(c, n))
    m.q[:n], m.qd[:n], m.P[:n] = joints.q, joints.qd, joints.P
    for i in range(n):
        if m.no_position >> i & 1:  # predicted alone: it falls no further than its stops
            q = min(max(m.q[i], c.q_min[i]), c.q_max[i])
            m.q[i], m.qd[i] = q, m.qd[i] if q == m.q[i] else 0.0
    m.innovation = largest(surprise)
    if c.carry != 0.0:
        _put_tip(m, predict_by_model(_tip(m), model.J, model.Jdqd, qdd, elapsed, _estimator(c)))
    phase = m.phase + c.dt / c.model_dt
    m.evaluated = 1 if phase > 0.0 else 0
    m.phase = phase - 1.0 if phase > 0.0 else phase
    target = target_of(m, m.has_goal != 0)
    task = 0 if leads(m) else target.task  # all of the motion is the joints'
    changed = task != m.task
    for i in range(3):
        changed = changed or target.axis[i] != m.axis[i]
    m.task = task
    m.axis[:] = target.axis
    return bool(changed or m.evaluated != 0)


@kernel
def correct(c: RecordRow, m: RecordRow, model: Model) -> None:
    """Correct the tip by the twist J qd and, where the model was evaluated, by its pose."""
    n = model.q.shape[0]
    twist = np.zeros(6)
    for i in range(6):
        for j in range(n):
            twist[i] += model.J[i, j] * m.qd[j]
    if c.carry == 0.0:
        if m.evaluated != 0:
            m.x[:], m.xd[:], m.R[:], m.omega[:] = model.x, twist[:3], model.R, twist[3:]
        return
    p = _estimator(c)
    tip, innovation = update_velocity(_tip(m), twist[:3], twist[3:], p)
    innovation = greater(innovation, m.innovation)
    if m.evaluated != 0:  # evaluated at the state of this slot: its age is zero
        tip, other = update_pose(tip, model.x, model.R, 0.0, p)
        innovation = greater(innovation, other)
    _put_tip(m, tip)
    m.innovation = innovation


@kernel
def _monitored(c: RecordRow, m: RecordRow, f: Feedback, model: Model) -> tuple[F64, int]:
    """Return the monitors of the encoders after this tick, and their flags."""
    n, qdd, held = f.q.shape[0], m.qdd.copy(), c.safety_friction[: f.q.shape[0]].copy()
    if m.noticed != 0:  # one that stands still is held by what is external to it and was not while it moved
        for i in range(n):
            qdd[i] = (m.external_moving[i] - m.external[i]) / model.A[i, i]
            held[i] += m.unsure[i]  # of that, what a payload takes to be accelerated by the other joints
    return encoder_flags(
        m.encoder_monitors[:, :n].copy(),
        f,
        PreviousPositions(m.q_previous[:n].copy(), m.age_previous[:n].copy(), c.dt * (1 + f.missed)),
        ExpectedMotion(qdd[:n], model.A),
        EncoderBounds(held, c.safety_velocity_tolerance[:n].copy()),
        c.dt,
    )


@kernel
def _surprise(c: RecordRow, m: RecordRow, model: Model) -> float:
    """Return by how much more than its noise alone the arm may surprise its filters: 1 where nothing is unknown.

    The observer follows a torque that changes within 1/BANDWIDTH. What is behind is as large as half of what has not
    come to last yet, and no more than what an unknown payload takes: on a light joint a large acceleration.
    """
    if m.floating != 0:
        return GUIDED_SURPRISE
    most = 0.0
    for i in range(model.q.shape[0] if m.noticed != 0 else 0):
        behind = min(abs(m.external[i] - m.lasting[i]) * LASTING / BANDWIDTH, m.unsure[i])
        most = max(most, behind / (model.A[i, i] * c.joint_sigma_qdd[i]))
    return 1.0 + most


@kernel
def detect_faults(
    c: RecordRow, m: RecordRow, f: Feedback, model: Model, around: Surroundings, implausible: bool
) -> None:
    """Write the faults that are present and in force, and what the detectors keep; f: plausible feedback."""
    n = f.q.shape[0]
    powered = drives_torque(m)
    active = powered and m.state != _ARMED
    found = examine_feedback(
        f,
        m.sent[:, :n].copy(),
        Clearances(around.rho, around.goal_rho, around.age, around.moving),
        JointBounds(c.q_min[:n].copy(), c.q_max[:n].copy(), c.qd_max[:n].copy()),
        Tolerances(
            c.safety_torque_tolerance[:n].copy(), c.safety_limit_tolerance, c.safety_speed_tolerance, REST_SPEED
        ),
    )
    monitors, flags = np.zeros((MONITORS, n)), found.flags
    if active:
        monitors, more = _monitored(c, m, f, model)
        flags |= more
    if m.contact_level != collision.NO:
        flags |= UNEXPLAINED if m.contact_level == collision.UNEXPLAINED else TOUCHED
        flags |= STRUCK if m.contact_level == collision.STRUCK else 0
    flags |= GOAL_OLD if stale(c, m) else 0
    evidence = Evidence(
        flags,
        found.age,
        found.feed_age,
        f.missed,
        active,
        powered,
        implausible,
        m.slew_follows_echo != 0,
        m.recovering != 0,
        m.limit_flags & _NON_FINITE != 0 or not math.isfinite(m.innovation),
        m.has_goal != 0,
        m.innovation,
    )
    k, surprising = m.counters, c.safety_innovation_max * _surprise(c, m, model)
    counters = counted(f.link, evidence, Counters(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7], k[8]), surprising)
    bounds = Bounds(c.safety_stale_periods, c.safety_lost_periods, c.safety_feed_timeout)
    m.present = detect(f.link, evidence, counters, bounds, c.dt)
    for i in range(9):
        k[i] = counters[i]
    m.in_force, m.good[:_FAULTS] = latch_with(m.present, m.in_force, m.good[:_FAULTS].copy(), AUTOMATIC)
    m.q_previous[:n], m.age_previous[:n], m.encoder_monitors[:, :n] = f.q, f.age, monitors
    m.outside = 1 if flags & BEYOND else 0
    m.recovering = m.recovering & m.outside
    m.rest = 0 if flags & STIRS else m.rest + 1
