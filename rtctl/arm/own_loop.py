"""Stops of an arm without brakes: each drive holds its joint by its own loop, and then lowers it.

    tau_i = kp (p - q) + kd (v - qd) + t        in the drive, on its own encoder, with no bus in it

p, v come to rest from where the joint was, t carries gravity and, by the model, the way to rest and the pull of joints
that fall (and damps, where the joint's speed is known). A joint whose encoder lies gets no term of it: one whose
position alone lies is damped, one of which nothing is true is let go, as is one whose drive has tripped. So is one that
flees while its drive itself says that it gives little of what it is told, as where a second master commands it: else
the model takes it for held, and what it does to its neighbours for their lie. The others go on holding: they keep the
rest from following.

Where something was a surprise and nobody knows which joint it was, an encoder that has repeated itself since before, or
that halted then, may be stuck: held by what it says, its joint would be driven by the difference to it for ever. It is
let go until it moves by its own account, which one that is true tells within a step of the encoder, and is held from
then on.

When all rest, the arm is lowered down the slope of its potential energy, qd ~ -g(q), until gravity moves it no more,
it lies on something, or its limits carry it; then kp and t fade, and torque is cut. m, c: as in `sensing`.
"""

import math

import numpy as np

from rtctl.arm.encoders import BEYOND, DISAGREE_TICKS, EQUAL, LAST, RESIDUAL, STUCK_TIME, STUCK_TRAVEL, TRAVEL, halted
from rtctl.arm.faults import BIT
from rtctl.arm.model import Model
from rtctl.arm.sensing import Surroundings
from rtctl.kernel import kernel
from rtctl.types import F64, Feedback, RecordRow, Severity, State
from rtctl.world.rooms import OWN_CLEARANCE, OWN_INFLUENCE

BRAKING, LOWERING, SINKING = 1, 2, 3  # phases; 0: the drives' loops are not used
HOLD_TIME = 1.0  # [s] in which the joints come to rest and are held before they are lowered
JOINT_SPEED, TIP_SPEED, LINK_SPEED = 0.2, 0.10, 0.12  # [rad/s], [m/s] of the tip, of any point, while it is lowered
GATHER = 0.4  # [s] to that speed
FLAT = 0.01  # of a joint's rating: gravity below it moves nothing worth lowering
PRESS = 0.1  # of a joint's rating, with which an arm that is lowered lies on what is in its way
LOWERED = 60.0  # [s] after which lowering ends, whatever is left
RESTS = 0.5  # [s] for which all joints must rest before torque is cut
AT_LIMIT, EDGE = 0.01, 0.005  # [rad] from a joint's limit: it is lowered no further; nothing takes it nearer
SINK_RATE, SINK_TIME, SINK_LATEST = 1.0, 4.0, 12.0  # [1/s], [s] with which kp and t fade at the end, until all rest
NOTICE = 0.1  # [s] after the onset of a stop, in which a joint that was let go has not come to its end
STEEPER = 2.0  # times the law's braking: a joint that comes near its limit comes to rest with more
SWEEPS = 20  # of the joints that fall: how fast, of what the others do
SPEED_LIE = 0.3  # [rad/s] by which a speed is untrue where something was a surprise: far beyond noise
FLEES = 0.2  # [rad/s] away from where it is held to be, and from the speed it shall have there
LITTLE = 0.25  # of the torque that a drive was told
JUMP = 0.1  # [rad] from where the joint is held to be: the position is untrue, the speed need not be

# numbers of the enumerations, as compiled code reads them
_STOPPING, _SAFE_STOP = int(State.STOPPING), int(State.SAFE_STOP)
_SS1, _CONTACT = int(Severity.SS1), BIT["contact"]
_TORQUE_UNTRUE = BIT["torque_mismatch"] | BIT["foreign_command"]  # a drive does not give what it was told
_SURPRISES = BIT["innovation"] | BIT["collision_hard"]  # they do not say which joint's measurements lie, if any does


@kernel
def holds_itself(c: RecordRow, m: RecordRow) -> bool:
    """Return whether this stop is one of the drives' own loops: of an arm that without brakes would fall."""
    if c.brakeless == 0.0:
        return False
    if m.state == _SAFE_STOP:
        return bool(m.reaction >= _SS1 and m.off == 0)
    return bool(m.state == _STOPPING and m.sinks != 0 and m.off == 0)


@kernel
def _disobeys(c: RecordRow, m: RecordRow, f: Feedback, i: int) -> bool:
    """Return whether joint i flees from where it is held while its drive says that it gives little of what it is told.

    What it was told lately is beyond the tolerance of an echo all the time: a drive that is a tick behind is none.
    """
    speed, tolerance = f.qd[i] - m.own_v[i], c.safety_torque_tolerance[i]
    if f.replies[i] == 0 or abs(speed) < FLEES or speed * (f.q[i] - m.own_p[i]) <= 0.0:
        return False
    least, most = m.sent[0, i], m.sent[0, i]
    for r in range(1, m.sent.shape[0]):
        least, most = min(least, m.sent[r, i]), max(most, m.sent[r, i])
    return bool((least > tolerance and f.tau[i] < LITTLE * least) or (most < -tolerance and f.tau[i] > LITTLE * most))


@kernel
def _speed_lies(m: RecordRow, i: int) -> bool:
    """Return whether the speed of joint i is not that of its positions."""
    monitors = m.encoder_monitors
    if m.in_force & _SURPRISES and abs(monitors[RESIDUAL, i]) > SPEED_LIE:
        return True  # it may have been this: a stop by such a speed cannot wait for all that evidence
    return bool(monitors[BEYOND, i] >= DISAGREE_TICKS)


@kernel
def _distrust(c: RecordRow, m: RecordRow, f: Feedback) -> None:
    """Note of which joints the encoder's position or speed is untrue, as long as the stop lasts; f: as it came.

    A joint that falls shakes the others when it comes to its end: what they do then says nothing of their encoders. Nor
    does a motion that is missed tell of one that is stuck, where it began with an untrue torque, or the speed of a
    joint that moves is untrue: what the model expects of all follows from these.
    """
    n, monitors = f.q.shape[0], m.encoder_monitors
    expected = m.own_untrue == 0
    for i in range(n):
        if _disobeys(c, m, f, i):
            m.lost = m.lost | 1 << i
        expected = expected and not (_speed_lies(m, i) and monitors[EQUAL, i] < STUCK_TIME)
    if m.lost != 0 and m.tick - m.own_since > NOTICE / c.dt:
        return
    for i in range(n):
        bit = 1 << i
        stuck = expected and monitors[EQUAL, i] >= STUCK_TIME and abs(monitors[TRAVEL, i]) > STUCK_TRAVEL
        if stuck or _speed_lies(m, i):
            m.no_position, m.no_speed = m.no_position | bit, m.no_speed | bit
        if f.replies[i] > 0 and not (math.isfinite(f.q[i]) and math.isfinite(f.qd[i])):
            m.no_position, m.no_speed = m.no_position | bit, m.no_speed | bit
        elif f.replies[i] > 0 and abs(f.q[i] - m.q[i]) > JUMP:  # it was not taken, see `sensing.plausible_feedback`
            m.no_position = m.no_position | bit


@kernel
def _begin(c: RecordRow, m: RecordRow, f: Feedback, n: int) -> None:
    m.own_phase, m.own_since = BRAKING, m.tick
    m.own_p[:n], m.own_v[:n], m.own_t[:n] = m.q[:n], m.qd[:n], m.sent[0, :n]
    m.own_kp[:n], m.own_kd[:n] = c.stop_kp[:n], c.stop_kd[:n]
    m.lost, m.own_untrue = 0, 1 if m.in_force & _TORQUE_UNTRUE and not m.in_force & _SURPRISES else 0
    for i in range(n):
        m.own_p[i] = min(max(m.own_p[i], c.q_min[i]), c.q_max[i])
        equal, last = m.encoder_monitors[EQUAL, i], m.encoder_monitors[LAST, i]
        repeats = equal >= STUCK_TIME or halted(equal, last, f.qd[i], c.joint_r_qd[i])
        if m.in_force & _SURPRISES and repeats:
            m.own_kp[i], m.own_kd[i], m.own_v[i] = 0.0, 0.0, 0.0


@kernel
def _slope(c: RecordRow, m: RecordRow, model: Model, g: F64) -> F64:
    """Return the speeds (n,) [rad/s] that lower the arm, zero where nothing does; g (n,) [Nm] gravity."""
    n, most = g.shape[0], 0.0
    u = np.zeros(n)
    for i in range(n):
        tau, held = c.tau_max[i], not m.lost >> i & 1 and m.own_kd[i] > 0.0
        low, high = m.own_p[i] <= c.q_min[i] + AT_LIMIT, m.own_p[i] >= c.q_max[i] - AT_LIMIT
        lies = m.own_kp[i] * (m.q[i] - m.own_p[i]) * (1.0 if g[i] > 0.0 else -1.0) > PRESS * tau  # on something
        if held and abs(g[i]) > FLAT * tau and not (lies or (low and g[i] > 0.0) or (high and g[i] < 0.0)):
            u[i] = -g[i]
            most = max(most, abs(g[i]) / JOINT_SPEED)
    if most == 0.0:
        return u
    u /= most
    fastest = 0.0
    for k in range(3):
        s = 0.0
        for i in range(n):
            s += model.J[k, i] * u[i]
        fastest += s * s
    share = min(1.0, TIP_SPEED / max(math.sqrt(fastest), 1e-9))
    for a in range(model.Jp.shape[0]):
        fastest = 0.0
        for k in range(3):
            s = 0.0
            for i in range(n):
                s += model.Jp[a, k, i] * u[i]
            fastest += s * s
        share = min(share, LINK_SPEED / max(math.sqrt(fastest), 1e-9))
    u *= share
    return u


@kernel
def _obstructed(c: RecordRow, m: RecordRow, around: Surroundings, u: F64) -> bool:
    """Return whether something that is known lies under the arm: lowered at u (n,) [rad/s] it comes no further."""
    if m.present & _CONTACT:
        return True
    power, near, room = 0.0, False, around.obstacles.room
    for k in range(around.rho.shape[0]):
        clearance = room[k, OWN_CLEARANCE] if room[k, OWN_INFLUENCE] != 0.0 else c.avoid_rho_min
        near |= around.rho[k] < 2.0 * clearance
    for i in range(u.shape[0]):
        power += m.tau_obstacles[i] * u[i]
    return bool(near and power < 0.0)


@kernel
def _ahead(c: RecordRow, m: RecordRow, i: int, way: float) -> float:
    """Return how far [rad] joint i may go the way of a speed."""
    return float(c.q_max[i] - EDGE - m.own_p[i] if way > 0.0 else m.own_p[i] - c.q_min[i] - EDGE)


@kernel
def _braking(c: RecordRow, m: RecordRow, i: int) -> float:
    """Return the deceleration [rad/s2] of joint i: as it decays, and enough to be at rest before its limit."""
    v = m.own_v[i]
    ahead = max(_ahead(c, m, i, v), 1e-3)
    rate = min(c.stop_decay * abs(v), c.braking[i])
    return float(max(rate, min(0.5 * v * v / ahead, STEEPER * c.braking[i])))


@kernel
def _inertial(c: RecordRow, m: RecordRow, model: Model, g: F64, qdd: F64) -> F64:
    """Return the torque (n,) [Nm] beside gravity's of joints held at accelerations qdd (n,) [rad/s2]: A qdd + h + B v.

    Those that are let go fall meanwhile: A_ll qdd_l = (t - g - h - B qd)_l - A_lh qdd_h, unless they are at their end.
    """
    n, qdd = g.shape[0], qdd.copy()
    for _ in range(SWEEPS if m.lost != 0 else 0):  # Gauss-Seidel: exact at once for one joint
        for i in range(n):
            if m.lost >> i & 1:
                net = m.own_t[i] - (g[i] + model.h[i] + c.viscous[i] * m.qd[i])
                for j in range(n):
                    net -= model.A[i, j] * qdd[j] if j != i else 0.0
                ends = (m.q[i] <= c.q_min[i] and net < 0.0) or (m.q[i] >= c.q_max[i] and net > 0.0)
                qdd[i] = 0.0 if ends else net / model.A[i, i]
    tau = model.h.copy()
    for i in range(n):
        tau[i] += c.viscous[i] * m.own_v[i]
        for j in range(n):
            tau[i] += model.A[i, j] * qdd[j]
    return tau


@kernel
def _go_on(c: RecordRow, m: RecordRow, model: Model, around: Surroundings, g: F64) -> None:
    """Move p, v of the joints on by a tick, and take the next phase when its time has come."""
    n, since = g.shape[0], (m.tick - m.own_since) * c.dt
    u = np.zeros(n)
    if m.own_phase == LOWERING:
        u = _slope(c, m, model, g)
        moves = False
        for i in range(n):
            moves = moves or u[i] != 0.0
        if moves and _obstructed(c, m, around, u):
            u[:] = 0.0  # it is held there
        elif not moves or since > LOWERED:
            m.own_phase, m.own_since = SINKING, m.tick
    elif m.own_phase == BRAKING and since >= HOLD_TIME:
        m.own_phase, m.own_since = LOWERING, m.tick
    for i in range(n):
        rate = JOINT_SPEED / GATHER if m.own_phase != BRAKING else _braking(c, m, i)
        most = max(_ahead(c, m, i, u[i]), 0.0) / GATHER  # it comes to its limit softly
        u[i] = min(max(u[i], -most), most)
        low, high = min(c.q_min[i] + EDGE, m.own_p[i]), max(c.q_max[i] - EDGE, m.own_p[i])
        m.own_v[i] += min(max(u[i] - m.own_v[i], -rate * c.dt), rate * c.dt)
        p = m.own_p[i] + m.own_v[i] * c.dt
        m.own_p[i] = min(max(p, low), high)
        if m.own_p[i] != p:
            m.own_v[i] = 0.0
    if m.own_phase == SINKING:
        fade, since = math.exp(-SINK_RATE * c.dt), (m.tick - m.own_since) * c.dt
        for i in range(n):
            m.own_kp[i], m.own_g[i] = fade * m.own_kp[i], fade * m.own_g[i]
        if since >= SINK_LATEST or (since >= SINK_TIME and m.rest * c.dt >= RESTS):
            m.off = 1


@kernel
def _let_go(c: RecordRow, m: RecordRow, f: Feedback) -> None:
    """Take the terms that are not to be trusted from the drives' loops, and give back what was; f: as it came."""
    for i in range(f.q.shape[0]):
        bit, off = 1 << i, f.drive[i] != 1
        if off or (m.no_speed | m.lost) & bit:
            m.lost = m.lost | bit
            m.own_kp[i], m.own_kd[i], m.own_v[i] = 0.0, 0.0, 0.0
            m.own_t[i] = 0.0 if off else m.own_t[i]
        elif m.no_position & bit:
            m.own_kp[i], m.own_kd[i], m.own_v[i] = 0.0, c.stop_kd[i], 0.0
        elif m.own_kd[i] < c.stop_kd[i] and m.encoder_monitors[EQUAL, i] == 0.0 and m.own_phase != SINKING:
            m.own_kp[i], m.own_kd[i] = c.stop_kp[i], c.stop_kd[i]
            m.own_p[i], m.own_v[i] = min(max(m.q[i], c.q_min[i]), c.q_max[i]), m.qd[i]


@kernel
def own_loop(c: RecordRow, m: RecordRow, f: Feedback, model: Model, around: Surroundings, g: F64) -> None:
    """Write what each drive is asked for in this tick, into own_p, own_v, own_kp, own_kd, own_t and the bits of lost.

    f: as it came; g (n,) [Nm]: what carries the arm, by the best that is known of its posture.
    """
    n = g.shape[0]
    if m.own_phase == 0:
        _begin(c, m, f, n)
    _distrust(c, m, f)
    if m.own_phase != SINKING:
        m.own_g[:n] = g
    _let_go(c, m, f)
    qdd = -m.own_v[:n]
    _go_on(c, m, model, around, g)
    for i in range(n):
        most = STEEPER * c.braking[i]
        qdd[i] = min(max((qdd[i] + m.own_v[i]) / c.dt, -most), most)
    inertial = _inertial(c, m, model, g, qdd)
    for i in range(n):
        step, heard = c.tau_rate[i] * c.dt, f.age[i] <= c.safety_lost_periods * c.dt
        t = m.own_g[i] + inertial[i]
        speed = f.qd[i] if m.no_position >> i & 1 else m.qd[i]  # estimated from positions as well
        if m.own_kd[i] == 0.0:  # it is let go; no torque at all is no step of a drive's: it drifts by less than that
            t = (0.25 if m.tick & 1 else -0.25) * c.tau_lsb[i]
        elif heard and f.replies[i] > 0:
            t -= c.stop_damping[i] * (speed - m.own_v[i])
        if not math.isfinite(t):
            t = 0.0
        t = min(max(t, -c.tau_max[i]), c.tau_max[i])
        m.own_t[i] += min(max(t - m.own_t[i], -step), step)


@kernel
def given(c: RecordRow, m: RecordRow, n: int) -> F64:
    """Return the torque (n,) [Nm] that the drives give by their own loops, as far as the state of the joints tells."""
    tau = np.zeros(n)
    for i in range(n):
        if not m.lost >> i & 1:
            t = m.own_kp[i] * (m.own_p[i] - m.q[i]) + m.own_kd[i] * (m.own_v[i] - m.qd[i]) + m.own_t[i]
            tau[i] = min(max(t, -c.tau_max[i]), c.tau_max[i])
    return tau
