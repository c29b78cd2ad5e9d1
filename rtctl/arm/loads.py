"""What the arm carries beside its own weight, in the memory of the servo level; the equations are `disturbance`'s.

m, c: as in `sensing`.
"""

import math

import numpy as np

from rtctl.arm.collision import watch_contact
from rtctl.arm.disturbance import (
    FOLLOWING,
    RESTING,
    STICKING,
    beyond,
    carried,
    observed,
    rounding,
    settled,
    slow_part,
    within,
)
from rtctl.arm.faults import BIT, DISTRUST
from rtctl.arm.friction import GUIDED, SLIDING, rubbing, smoothing, speeds_of
from rtctl.arm.model import Model
from rtctl.arm.sensing import drives_torque
from rtctl.arm.target import parking_progress, target_of
from rtctl.arm.task import task_error
from rtctl.kernel import kernel
from rtctl.kernel.reductions import largest, norm
from rtctl.types import F64, Feedback, RecordRow, Severity, State

UNFELT = 2.0  # times what is noticeable: a hand that pushes a joint less than that does not move it
GENTLE = 0.4  # of the damping of a stop: an arm that is let go comes to rest within half a second
FINE, FINE_ROT = 1e-3, 5e-3  # [m], [rad] a goal's tolerance below them does not make the arm push on

# numbers of the enumerations, as compiled code reads them
_ARMED, _RUN, _SAFE_STOP, _SS1 = int(State.ARMED), int(State.RUN), int(State.SAFE_STOP), int(Severity.SS1)
_STRUCK = BIT["collision_hard"]


@kernel
def observe(c: RecordRow, m: RecordRow, f: Feedback, model: Model, Jbar: F64, elapsed: float) -> None:
    """Observe what pushes the joints while the arm is free to move; f: plausible, `elapsed` [s] after the last one."""
    n = f.q.shape[0]
    qd = f.qd.copy()
    if not drives_torque(m) or m.state == _ARMED:  # brakes may hold it: nothing is to be learnt
        m.external[:n], m.lasting[:n], m.external_moving[:n], m.qd_measured[:n] = 0.0, 0.0, 0.0, qd
        m.noticed, m.settled, m.touches, m.contact_level = 0, 0, 0, 0
        m.track[:n], m.unsure[:n], m.expected[:n], m.steady[:n] = 0.0, 0.0, 0.0, 0.0
        return
    load, resting, silent, rubs = np.empty(n), True, False, known_friction(c, m, model, Jbar)
    for i in range(n):
        if not (f.replies[i] > 0 and np.isfinite(qd[i])):
            qd[i], silent = m.qd_measured[i], True
        load[i] = model.h[i] + model.g[i] + c.viscous[i] * m.qd[i] + rubs[i]
        resting = resting and abs(qd[i]) < RESTING
    # the speed measured now ends the period in which the command before the last one was applied
    before, tau = m.qd_measured[:n].copy(), m.sent[1, :n].copy()
    external = observed(m.external[:n].copy(), model.A, qd, before, load, tau, elapsed)
    m.external[:n], m.qd_measured[:n] = external, qd
    watch_contact(c, m, qd, model, elapsed)
    follow = 1.0 - math.exp(-FOLLOWING * elapsed)
    drift = 1.0 - math.exp(-STICKING * elapsed)
    for i in range(n):
        moved = f.replies[i] > 0 and f.q[i] != m.q_previous[i]
        m.external_moving[i] += (follow if moved else drift) * (external[i] - m.external_moving[i])
    if _damped(c, m) and not silent:
        bound = carried(model.J, c.payload_max, c.friction_max[:n].copy())
        m.lasting[:n] = slow_part(m.lasting[:n].copy(), external, bound, elapsed)
    if m.state != _RUN:
        return  # any other stop goes on with what was known
    m.settled = 1 if m.floating == 0 and settled(m.settled != 0, resting, _error(c, m, n)) else 0
    bound = carried(model.J, c.payload_max, c.friction_max[:n].copy())
    if m.floating != 0:  # what a hand does is not learnt: the weight found before, where the tip is now
        m.lasting[:n] = within(m.float_weight * model.J[2] + m.float_rest[:n], bound)
    elif m.settled == 0 or m.noticed == 0:
        m.lasting[:n] = slow_part(m.lasting[:n].copy(), external, bound, elapsed)
    least = c.noticeable[:n].copy()
    unsure = largest(smoothing(c.coulomb[:n].copy(), model.A_inv, c.dt)) > SLIDING  # not all that is told is given
    if m.noticed == 0 and (unsure or beyond(m.lasting[:n].copy(), rounding(model.A, c.joint_r_qd[:n].copy(), least))):
        m.noticed = 1


@kernel
def known_friction(c: RecordRow, m: RecordRow, model: Model, Jbar: F64) -> F64:
    """Return the dry friction (n,) [Nm] that the file tells of, as it is counted; Jbar (n, 6).

    While the law drives the arm it is counted as it was given, at the speeds asked for: what a joint rubs less than
    that, or the other way, is external to it as untold friction is. At the speeds measured it would turn with each of
    their signs, and what is learnt of that comes late: friction that is not there would shake the arm by itself. A
    damped or a guided arm is asked for nothing: there it brakes what moves.
    """
    n = model.q.shape[0]
    coulomb, qd = c.coulomb[:n].copy(), m.qd[:n].copy()
    if not (m.floating != 0 or (m.state == _SAFE_STOP and m.reaction >= _SS1)):
        qd = speeds_of(Jbar, m.v_before.copy(), m.w_before.copy())
    return rubbing(coulomb, np.zeros(n), qd, smoothing(coulomb, model.A_inv, c.dt))


@kernel
def _damped(c: RecordRow, m: RecordRow) -> bool:
    """Return whether the arm is being damped, and what lasts is learnt on.

    A brake that closes in motion, or whatever else stops the arm, jerks it: what the observer took of that to last
    would drive the arm for as long as it is damped. Not where a measurement lies, nor against what was struck; nor
    while a joint is silent, whose braking would be taken for a load.
    """
    trusted = m.in_force & (DISTRUST | _STRUCK) == 0
    return bool(m.state == _SAFE_STOP and m.reaction >= _SS1 and m.off == 0 and c.brakeless == 0.0 and trusted)


@kernel
def _error(c: RecordRow, m: RecordRow, n: int) -> float:
    """Return how far the tip is from where it shall be, in tolerances."""
    if m.parking != 0:
        away: float = parking_progress(m, n).error_rot / max(m.goal_tolerance_rot, FINE_ROT)
        return away
    target = target_of(m, m.has_goal != 0)
    e, e_rot = task_error(target.task, target.axis, target.position, target.wxyz, m.x.copy(), m.R.copy())
    near = max(target.tolerance if target.tolerance > 0.0 else c.tolerance, FINE)
    near_rot = max(target.tolerance_rot if target.tolerance_rot > 0.0 else c.tolerance_rot, FINE_ROT)
    return max(norm(e) / near, norm(e_rot) / near_rot)


@kernel
def pushed(c: RecordRow, m: RecordRow, model: Model, Jbar: F64) -> tuple[F64, F64]:
    """Return what the law carries as if it were gravity, and what a hand does to an arm that floats, (n,) [Nm].

    Carried is what lasts, and known friction. An arm that floats is taken to be held by all that is external to it and
    driven by the hand: where no guard acts one is the other, and the hand moves the arm; where one acts it gives
    against the hand what keeps the bound. A touch lighter than UNFELT moves nothing, and what moves comes to rest: else
    what is not known of the load would set an arm without friction in motion.
    """
    n = model.q.shape[0]
    lasting = m.lasting[:n].copy() if m.noticed != 0 else np.zeros(n)
    coulomb, viscous = c.coulomb[:n].copy(), c.viscous_told[:n].copy()
    smooth = smoothing(coulomb, model.A_inv, c.dt)
    if m.floating != 0:
        external, hand = m.external[:n].copy(), np.empty(n)
        for i in range(n):
            felt, zone = external[i] - lasting[i], UNFELT * c.noticeable[i]
            hand[i] = felt - min(max(felt, -zone), zone) - GENTLE * c.stop_damping[i] * m.qd[i]
        return external - GUIDED * rubbing(coulomb, viscous, m.qd[:n].copy(), smooth), hand
    asked = speeds_of(Jbar, m.v_ref.copy(), m.w_ref.copy())
    return lasting - rubbing(coulomb, viscous, asked, smooth), np.zeros(n)


@kernel
def loaded(model: Model, torque: F64, q: F64) -> Model:
    """Return the model that carries an external torque (n,) [Nm] as gravity, its points those of q (n,) [rad]."""
    return Model(
        q,
        model.qd,
        model.A,
        model.A_inv,
        model.h,
        model.g - torque,
        model.x,
        model.R,
        model.J,
        model.Jdqd,
        model.P,
        model.Jp,
        model.B,
        model.Lambda_inv,
        model.own_rho,
        model.own_row,
    )
