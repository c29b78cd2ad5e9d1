"""The first half of the servo level: from the drives' feedback to the state of the arm, and the faults that it shows.

    plausible feedback -> joint filter -> tip filter -> (model, when it is due) -> correction -> detection and latch

m is the memory's record (`memory.HOT`) of this tick, c the robot's constants (`law.prepared`); both are written and
read in place, as the fields of an object would be.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from rtctl.arm.detection import BEYOND, STIRS, notice
from rtctl.arm.estimator import EstimatorParams, correct_by_pose, correct_by_twist, filter_joints, predict_tip
from rtctl.arm.faults import AUTOMATIC, FAULTS, Bounds, Counters, Evidence, counted, detect, jumped
from rtctl.arm.model import Model
from rtctl.arm.target import target_of
from rtctl.control.faults import latch_with
from rtctl.kernel import kernel
from rtctl.kernel.reductions import greater, largest
from rtctl.types import B1, F64, Cut, Feedback, State
from rtctl.world.primitives import Obstacles

REST_SPEED = 0.03  # [rad/s] a joint slower than this rests (encoders of MIT drives resolve 0.005)

# numbers of the enumerations, as compiled code reads them
_ARMED, _RUN, _STOPPING, _SAFE_STOP = (int(s) for s in (State.ARMED, State.RUN, State.STOPPING, State.SAFE_STOP))
_NON_FINITE, _FAULTS = int(Cut.NON_FINITE), len(FAULTS)


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
def drives_torque(m: Any) -> bool:
    """Return whether the state wants torque from the drives."""
    if m.state == _SAFE_STOP:
        return bool(m.off == 0)
    return bool(m.state == _ARMED or m.state == _RUN or m.state == _STOPPING)


@kernel
def plausible_feedback(c: Any, m: Any, f: Feedback) -> tuple[Feedback, bool]:
    """Return the feedback with silence in place of positions that no joint can have reached, and whether any is.

    A joint that goes on reporting such positions stays silent: the filter that damps it must not see the jump.
    """
    n = f.q.shape[0]
    q, age, replies, implausible = f.q.copy(), f.age.copy(), f.replies.copy(), False
    if drives_torque(m) and m.state != _ARMED:
        elapsed, before = c.dt * (1 + f.missed), m.age_previous[:n]
        odd = jumped(f.q, f.age, f.replies, m.q_previous[:n], before, c.qd_max[:n], elapsed, c.dt)
        for i in range(n):
            if odd[i]:
                implausible = True
                q[i], age[i], replies[i] = m.q_previous[i], min(before[i] + elapsed, c.safety_lost_periods * c.dt), 0
    return (
        Feedback(f.slot, f.missed, q, f.qd, f.tau, age, replies, f.drive, f.link, f.lateness, f.compute),
        implausible,
    )


@kernel
def _estimator(c: Any) -> EstimatorParams:
    return EstimatorParams(
        c.estimator_sigma_a,
        c.estimator_sigma_alpha,
        c.estimator_r_v,
        c.estimator_r_omega,
        c.estimator_r_x,
        c.estimator_r_rot,
    )


@kernel
def predict(c: Any, m: Any, f: Feedback, model: Model, elapsed: float) -> bool:
    """Advance joints and tip to this slot; return whether the model must be evaluated, or its task space."""
    n = f.q.shape[0]
    qdd = m.qdd[:n].copy()
    q, qd, P, surprise = filter_joints(
        m.q[:n].copy(),
        m.qd[:n].copy(),
        m.P[:n].copy(),
        qdd,
        f.q,
        f.qd,
        f.age,
        f.replies,
        elapsed,
        c.joint_sigma_qdd[:n].copy(),
        c.joint_r_q[:n].copy(),
        c.joint_r_qd[:n].copy(),
        c.joint_has_qd != 0.0,
    )
    m.q[:n], m.qd[:n], m.P[:n] = q, qd, P
    m.innovation = largest(surprise)
    if c.carry != 0.0:
        m.x[:], m.xd[:], m.P_tip[:], m.R[:], m.omega[:], m.P_rot[:] = predict_tip(
            m.x.copy(),
            m.xd.copy(),
            m.P_tip.copy(),
            m.R.copy(),
            m.omega.copy(),
            m.P_rot.copy(),
            model.J,
            model.Jdqd,
            qdd,
            elapsed,
            _estimator(c),
        )
    phase = m.phase + c.dt / c.model_dt
    m.evaluated = 1 if phase > 0.0 else 0
    m.phase = phase - 1.0 if phase > 0.0 else phase
    target = target_of(m, m.has_goal != 0)
    changed = target.task != m.task
    for i in range(3):
        changed = changed or target.axis[i] != m.axis[i]
    m.task = target.task
    m.axis[:] = target.axis
    return bool(changed or m.evaluated != 0)


@kernel
def correct(c: Any, m: Any, model: Model) -> None:
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
    x, xd, P, R, omega, P_rot, innovation = correct_by_twist(
        m.x.copy(), m.xd.copy(), m.P_tip.copy(), m.R.copy(), m.omega.copy(), m.P_rot.copy(), twist, p
    )
    innovation = greater(innovation, m.innovation)
    if m.evaluated != 0:  # evaluated at the state of this slot: its age is zero
        x, xd, P, R, omega, P_rot, other = correct_by_pose(x, xd, P, R, omega, P_rot, model.x, model.R, p)
        innovation = greater(innovation, other)
    m.x[:], m.xd[:], m.P_tip[:], m.R[:], m.omega[:], m.P_rot[:] = x, xd, P, R, omega, P_rot
    m.innovation = innovation


@kernel
def detect_faults(c: Any, m: Any, f: Feedback, A: F64, around: Surroundings, implausible: bool) -> None:
    """Write the faults that are present and in force, and what the detectors keep; f: plausible feedback."""
    n = f.q.shape[0]
    powered = drives_torque(m)
    active = powered and m.state != _ARMED
    watch, age, feed_age, seen = notice(
        m.watch[:, :n].copy(),
        active,
        f.q,
        f.qd,
        f.tau,
        f.age,
        f.replies,
        f.drive,
        m.sent[:, :n].copy(),
        m.q_previous[:n].copy(),
        m.age_previous[:n].copy(),
        m.qdd[:n].copy(),
        A,
        around.rho,
        around.goal_rho,
        around.age,
        around.moving,
        c.safety_torque_tolerance[:n].copy(),
        c.safety_friction[:n].copy(),
        c.safety_velocity_tolerance[:n].copy(),
        c.safety_limit_tolerance,
        c.safety_speed_tolerance,
        REST_SPEED,
        c.q_min[:n].copy(),
        c.q_max[:n].copy(),
        c.qd_max[:n].copy(),
        c.dt * (1 + f.missed),
        c.dt,
    )
    lost = m.cut & _NON_FINITE != 0 or not math.isfinite(m.innovation)
    evidence = Evidence(
        seen,
        age,
        feed_age,
        f.missed,
        active,
        powered,
        implausible,
        m.slew_follows_echo != 0,
        m.recovering != 0,
        lost,
        m.has_goal != 0,
        m.innovation,
    )
    k = m.counters
    counters = counted(
        f.link, evidence, Counters(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7]), c.safety_innovation_max
    )
    bounds = Bounds(c.safety_stale_periods, c.safety_lost_periods, c.safety_feed_timeout)
    m.present = detect(f.link, evidence, counters, bounds, c.dt)
    for i in range(8):
        k[i] = counters[i]
    m.in_force, m.good[:_FAULTS] = latch_with(m.present, m.in_force, m.good[:_FAULTS].copy(), AUTOMATIC)
    m.q_previous[:n], m.age_previous[:n], m.watch[:, :n] = f.q, f.age, watch
    m.outside = 1 if seen & BEYOND else 0
    m.recovering = m.recovering & m.outside
    m.rest = 0 if seen & STIRS else m.rest + 1
