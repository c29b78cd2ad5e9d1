"""One tick: feedback and requests in, torque and a record out. Pure: no clock, socket, file or randomness.

Equal inputs give equal bits, which is what makes replay, lockstep simulation and Monte-Carlo the same thing. The
block diagram is `tick`; each block is a function below it or a module beside it.
"""

import numpy as np

from rtctl.arm import diagnosis, encoders, escape, progress
from rtctl.arm.escape import Escape
from rtctl.arm.estimator import held, joint_start, joint_step, start, tip_step, update_pose
from rtctl.arm.faults import FAULTS, Counters, severity
from rtctl.arm.law import LOAD, Law, evaluate_law
from rtctl.arm.limits import Permitted, command_torque
from rtctl.arm.memory import Memory
from rtctl.arm.model import Model
from rtctl.arm.osc import OperationalSpace, operational_space
from rtctl.arm.progress import Progress
from rtctl.arm.record import Tail, make_record
from rtctl.arm.robot import Robot
from rtctl.arm.session import (
    REST_HOLD,
    believed,
    detected,
    drives_torque,
    free_of_goals,
    held_here,
    hold_at,
    supervised,
    with_goal,
)
from rtctl.arm.task import between, point_of, selected, selection, task_error, wholly_placed
from rtctl.kernel import reductions
from rtctl.kernel.rotations import exp3, quat_of
from rtctl.types import (
    F64,
    TOOL_Z,
    Command,
    Drive,
    Feedback,
    Goal,
    ObstacleEdit,
    Record,
    Request,
    Severity,
    Shape,
    State,
    Status,
    Task,
    Verb,
)
from rtctl.world import obstacle_table, primitives

BRAKING = (State.STOPPING, State.SAFE_STOP)
ZERO = np.zeros(3)
START_PACE = 0.1  # fraction of qd_max that joints may have while ARMED, and beyond their limits
START_TIME = 0.5  # [s] about, in which they are given the rest
REVIEW = 0.5  # [s] between two diagnoses of an arm that rests
MISSED_MAX = 10  # slots that estimates coast through; more is a fault


def tick(robot: Robot, memory: Memory, feedback: Feedback, request: Request) -> tuple[Memory, Command, Record]:
    """Return (memory, command, record) of one servo period.

    feedback: the drives' replies of this slot; request: what operators and sensors sent since the previous tick.
    """
    m = memory._replace(tick=memory.tick + 1, verdict="")
    elapsed = robot.dt * (1 + min(feedback.missed, MISSED_MAX))
    credible, jumped = believed(robot, m, feedback)
    m = _estimated(robot, m, credible, elapsed)
    m = _perceived(robot, m, request, elapsed)
    m, present = detected(robot, m, credible, jumped)
    m = supervised(robot, m, feedback, request, present)
    m = with_goal(robot, m, request)
    m, law = _law(robot, m)
    m, command, permitted = _commanded(robot, m, feedback, law)
    pursued = m.goal if m.goal is not None and m.state == State.RUN else m.hold
    p = progress.progress(pursued, m.tip)
    m = _diagnosed(robot, m, law, permitted, p)
    return m, command, _record(robot, m, feedback, request.verb, law, p, permitted, command)


def initial(robot: Robot, feedback: Feedback) -> Memory:
    """Return the memory before the first tick: IDLE, at rest where the feedback says the arm is."""
    q, zero = feedback.q.copy(), np.zeros(robot.n)
    model = robot.body.evaluate(q, zero, robot.points, robot.own)
    joints, tip = joint_start(q, robot.joint_P), start(model.x, model.R, robot.tip_design)
    table = obstacle_table.empty(robot.slots, robot.meshes, robot.safety.creep, robot.safety.feed_timeout)
    table = obstacle_table.with_static(table, robot.obstacles)
    space = _space(robot, robot.axes, TOOL_Z, model)
    far = np.full(robot.slots, np.inf)
    return Memory(
        tick=-1, state=State.IDLE, since=-1, reaction=Severity.NONE, off=False, in_force=0,
        good=np.full(len(FAULTS), 1 << 30), counters=Counters(), clear_until=-1, recovering=False, outside=False,
        leaving=False, done=False, verdict="", joints=joints, tip=tip, innovation=0.0, model=model, space=space,
        task=robot.axes, axis=TOOL_Z, evaluated=True, phase=0.0, qdd=zero, q_previous=q, age_previous=zero,
        watch=encoders.fresh(robot.n), rest=0,
        goal=None, hold=hold_at(model.x, model.R, robot.axes), holders=0, held=(), escape=Escape(), tau_obstacles=zero,
        q_rest=q, v_ref=ZERO, w_ref=ZERO, goal_rho=far, status=Status.NO_GOAL, blocker=-1, still=0,
        nearest=np.inf, idle=0.0, world=table,
        rho=far, sent=np.zeros((4, robot.n)), cut=0, pulled=False, pace=START_PACE,
    )  # fmt: skip


def _space(robot: Robot, task: Task, axis: F64, model: Model) -> OperationalSpace:
    S = selection(int(task), axis, model.R)
    return operational_space(model.J, model.A_inv, model.Lambda_inv, S, robot.motion)


def _estimated(robot: Robot, m: Memory, feedback: Feedback, elapsed: float) -> Memory:
    """Joint and tip state at this slot, `elapsed` [s] after the previous; the model anew when an evaluation is due."""
    joints, surprise = joint_step(
        m.joints, m.qdd, feedback.q, feedback.qd, feedback.age, feedback.replies, elapsed, robot.joint_filter
    )
    phase = m.phase + robot.dt / robot.model_dt
    target = m.goal if m.goal is not None else m.hold
    task, axis = target.task, target.axis
    changed = task != m.task or (axis is not m.axis and bool((axis != m.axis).any()))
    due = phase > 0.0
    model = robot.body.evaluate(joints.q, joints.qd, robot.points, robot.own) if due else m.model
    space = _space(robot, task, axis, model) if due or changed else m.space
    tip, innovation = tip_step(m.tip, m.model.J, m.model.Jdqd, m.qdd, model.J, joints.qd, elapsed, robot.estimator)
    innovation = max(innovation, reductions.largest(surprise))
    if not robot.carry:
        tip = held(tip, model.x, model.R, model.J, joints.qd) if due else m.tip
        model, innovation = model._replace(q=joints.q), reductions.largest(surprise)  # the points have not moved either
    elif due:  # evaluated at the state of this slot: its age is zero
        tip, other = update_pose(tip, model.x, model.R, 0.0, robot.estimator)
        innovation = max(innovation, other)
    return m._replace(
        joints=joints, tip=tip, innovation=innovation, model=model, space=space, task=task,
        axis=axis, evaluated=due, phase=phase - 1.0 if due else phase,
    )  # fmt: skip


def _perceived(robot: Robot, m: Memory, request: Request, elapsed: float) -> Memory:
    """Obstacles: extrapolated by `elapsed` [s], then replaced by what was seen."""
    table, verdict = obstacle_table.advanced(m.world, elapsed), m.verdict
    if request.obstacles:
        table, verdict = obstacle_table.edited(table, request.obstacles)
    rho, goal = m.goal_rho, m.goal
    if goal is not None and (table is not m.world or not wholly_placed(goal)):
        rho = obstacle_table.distance_from(table, point_of(goal, m.tip.x))
    return m._replace(world=table, verdict=verdict, goal_rho=rho)


def _law(robot: Robot, m: Memory) -> tuple[Memory, Law]:
    """Choose what the tip does, then evaluate the law for it."""
    braking = m.state in BRAKING or severity(m.in_force) >= Severity.SS2
    pursuing = m.goal is not None and m.state == State.RUN and not braking
    m = m._replace(pace=_pace(robot, m))
    slow = braking and max(np.abs(m.v_ref).max(), np.abs(m.w_ref).max()) < 1e-3
    if braking and not slow:
        m = held_here(robot, m)  # the hold begins where the braking ends
    m = _escaping(robot, m) if pursuing else m
    target = m.goal if pursuing and m.goal is not None else m.hold
    hasten = not braking or slow  # while braking the references only fall to zero
    e, e_rot = ZERO, ZERO
    if hasten:
        e, e_rot = task_error(int(target.task), target.axis, target.position, target.wxyz, m.tip.x, m.tip.R)
        if target.task != m.task:  # a goal of this tick: `space` is still that of the one before
            e, e_rot = selected(int(m.task), m.axis, m.tip.R, e, e_rot)
    if pursuing and m.escape.active:
        e = escape.way(m.escape, escape.push_of(m.model, m.tau_obstacles, target), robot.motion)
    law = evaluate_law(
        robot, m.model, m.space, m.world.obstacles, m.joints.q, m.joints.qd, m.tip.xd, m.tip.omega, e, e_rot,
        m.v_ref, m.w_ref, _posture(robot, m) if pursuing else m.q_rest, m.pace,
    )  # fmt: skip
    seen = law.rho + m.world.obstacles.margin  # where it is, not where it might be: no contact by growing old
    return m._replace(v_ref=law.v_ref, w_ref=law.w_ref, rho=seen, tau_obstacles=law.tau_obstacles), law


def _escaping(robot: Robot, m: Memory) -> Memory:
    """Return the memory with the escape from a local minimum a tick further."""
    s, goal = m.escape, m.goal
    if goal is None or s.phase == escape.Phase.NONE:
        return m
    to = point_of(goal, m.tip.x)
    if s.phase == escape.Phase.CHOOSING:
        s = escape.chosen(
            s, m.model, m.tip.x, goal._replace(position=to), m.world.obstacles, robot.base, robot.reach,
            robot.avoid.rho0, robot.motion.epsilon,
        )  # fmt: skip
        return m._replace(escape=s)
    v, _ = selected(int(goal.task), goal.axis, m.tip.R, m.tip.xd, m.tip.omega)
    push = escape.push_of(m.model, m.tau_obstacles, goal)
    return m._replace(
        escape=escape.advanced(s, to - m.tip.x, push, reductions.norm(v) < progress.STILL_SPEED, robot.dt)
    )


def _posture(robot: Robot, m: Memory) -> F64:
    """Return the posture (n,) [rad] of the null space on the way to the goal."""
    return robot.q_rest if m.goal is None or m.goal.posture is None else m.goal.posture


def _pace(robot: Robot, m: Memory) -> float:
    """Return the fraction of their speed that joints may have: an arm that wakes inside a field leaves it slowly."""
    return START_PACE if m.state == State.ARMED or m.recovering else min(1.0, m.pace + robot.dt / START_TIME)


def _commanded(robot: Robot, m: Memory, feedback: Feedback, law: Law) -> tuple[Memory, Command, Permitted]:
    """Turn the law's torque into what the drives are asked for, through the permitter."""
    drive, keep = law.drive, law.keep
    if m.state == State.SAFE_STOP and m.reaction >= Severity.SS1:  # damp -D qd + g, then torque off
        over = (m.tick - m.since) * robot.dt >= robot.stop.time or m.rest * robot.dt >= REST_HOLD
        m = m._replace(off=m.off or over)
        fresh = feedback.age <= robot.safety.lost_periods * robot.dt  # a velocity that old damps nothing
        drive, keep = np.zeros(robot.n), m.model.g - robot.stop.damping * m.joints.qd * fresh
    asked = _asked_of_drives(m, feedback)
    moving = asked == Drive.TORQUE and m.state != State.ARMED  # in ARMED brakes may still hold the arm
    rows, cut, scale, off = command_torque(
        drive, keep, m.joints.qd, m.sent, feedback.tau, feedback.age, robot.tau_max, robot.tau_rate, robot.tau_lsb,
        robot.stop.damping, m.model.A_inv, m.model.h, m.model.g, robot.viscous, robot.dt, asked == Drive.TORQUE, moving,
    )  # fmt: skip
    sent = rows[1:5]
    permitted = Permitted(rows[0], sent[0], cut, scale)
    m = m._replace(sent=sent, qdd=rows[5], cut=cut | law.cut, pulled=off)
    return m, Command(asked, sent[0]), permitted


def _asked_of_drives(m: Memory, feedback: Feedback) -> Drive:
    if drives_torque(m):
        enabled = m.state != State.ARMED or reductions.all_equal(feedback.drive, 1)
        return Drive.TORQUE if enabled else Drive.ENABLE
    if m.tick < m.clear_until and bool((feedback.drive > 1).any()):
        return Drive.CLEAR
    return Drive.DISABLE


def _diagnosed(robot: Robot, m: Memory, law: Law, permitted: Permitted, p: Progress) -> Memory:
    """Level of competence: what the arm is doing about its goal, and once it rests or creeps, what holds it."""
    goal = m.goal
    if goal is None or m.state != State.RUN:
        return m if m.status == Status.NO_GOAL else free_of_goals(m)
    if progress.arrived(p, goal):
        return _with_status(m, Status.ARRIVED)._replace(escape=Escape(), still=m.still + 1)
    if m.escape.active or m.escape.phase == escape.Phase.CHOOSING:
        return m._replace(status=Status.ESCAPING, still=0)  # held by what it circulates
    still = m.still + 1 if progress.at_rest(p) else 0
    stall, waited = round(robot.stop.stall / robot.dt), _waited(robot, m)
    m = _approached(robot, m, p)._replace(still=still)
    circles = robot.escape and m.escape.phase == escape.Phase.NONE
    if circles and still == round(escape.STALL / robot.dt):
        begun = _caught(robot, m, law, permitted, goal, p.error)
        if begun.status == Status.ESCAPING or not waited:
            return begun
        m = m._replace(escape=begun.escape)
    if not _waited(robot, m):
        return _with_status(m, Status.MOVING)
    if waited and m.tick % round(REVIEW / robot.dt):
        return m
    if circles and still < stall:  # it creeps
        begun = _caught(robot, m, law, permitted, goal, p.error)
        if begun.status == Status.ESCAPING:
            return begun
    found = diagnosis.held(diagnosis.balance(robot, m, law, permitted.tau_wanted))
    told = _with_held(robot, m, law, found)._replace(status=found.status)
    if still < stall and told.held == (diagnosis.UNKNOWN,):
        return m if waited else _with_status(m, Status.MOVING)  # slow, and nothing new is in its way
    return told


def _waited(robot: Robot, m: Memory) -> bool:
    """Return whether the arm has been at rest, or got no nearer to its goal, for long enough to ask what holds it."""
    return max(m.still * robot.dt, m.idle) >= robot.stop.stall - 0.5 * robot.dt


def _approached(robot: Robot, m: Memory, p: Progress) -> Memory:
    """Return the memory with how near the goal has been, and for how long it has not come nearer."""
    left = progress.time_left(p, robot.motion.v_max, robot.motion.w_max)
    idle = progress.idle(m.idle, p, left, m.nearest, robot.dt, robot.stop.stall)
    return m._replace(nearest=min(left, m.nearest), idle=idle)


def _with_status(m: Memory, status: Status) -> Memory:
    return m if m.status == status else m._replace(status=status, blocker=-1, holders=0, held=())


def _with_held(robot: Robot, m: Memory, law: Law, found: diagnosis.Held) -> Memory:
    return m._replace(blocker=found.main, holders=found.mask, held=diagnosis.names(robot, m, law, found))


def _caught(robot: Robot, m: Memory, law: Law, permitted: Permitted, goal: Goal, error: float) -> Memory:
    """Return the memory of an arm that has just come to rest: where obstacles hold it, with an escape begun."""
    found = diagnosis.held(diagnosis.balance(robot, m, law, permitted.tau_wanted))
    near = {Status.LOCAL_MINIMUM: robot.avoid.rho0, Status.SHADOWED: 2.0 * robot.avoid.rho0}
    if not found.mask or error < near.get(found.status, np.inf):
        return _with_status(m, Status.MOVING)
    begun = escape.begun(m.escape, error, escape.push_of(m.model, law.tau_obstacles, goal))
    if begun.phase == escape.Phase.GIVEN_UP:
        return _with_status(m, Status.MOVING)._replace(escape=begun)
    return _with_held(robot, m, law, found)._replace(escape=begun, status=Status.ESCAPING)


def _record(
    robot: Robot, m: Memory, feedback: Feedback, verb: Verb, law: Law, p: Progress, permitted: Permitted, out: Command
) -> Record:
    """Write everything that came in and went out into one struct."""
    goal = m.goal if m.goal is not None else m.hold
    return make_record(
        robot.n, robot.slots, m.tick, feedback.slot * robot.dt, feedback, verb, m.tip, m.innovation, goal, law.F,
        (p.error, p.error_rot, m.space.sigma_min), law.seen, law.nearest,
        law.torques[: LOAD + 1], permitted.tau_wanted, out.tau,
        Tail(
            out.drive, m.cut, m.state, m.status, m.blocker, m.holders, m.escape.phase, m.reaction, m.in_force,
            m.evaluated,
        ),
    )  # fmt: skip


def _meshes_at(robot: Robot, position: np.ndarray, wxyz: np.ndarray) -> list[Shape]:
    names, zero = robot.meshes.names[:1], np.zeros(4)
    return [Shape("mesh", "mesh", zero, position, wxyz, zero[:3], zero[:3], mesh=name) for name in names]


def warm(robot: Robot) -> None:
    """Run the tick through every kind of work once, so that nothing is compiled or loaded while the arm moves."""
    n = robot.n
    zero = np.zeros(n)
    feedback = Feedback(
        0,
        0,
        robot.home.copy(),
        zero,
        zero,
        np.full(n, robot.dt),
        np.ones(n, np.int64),
        np.ones(n, np.int64),
        0,
        0.0,
        0.0,
    )
    m = initial(robot, feedback)
    far = np.array([0.0, 0.0, 50.0])
    wxyz = np.array([1.0, 0.0, 0.0, 0.0])
    edits = tuple(
        ObstacleEdit(kind, Shape(kind, kind, np.array([0.1, 0.1, 0.1, 2.0]), far, wxyz, np.ones(3), np.ones(3)))
        for kind in primitives.TYPES
        if kind not in ("mesh", "cloud")
    )
    many = Shape("cloud", "cloud", np.array([0.1, 1e-3, 0.0, 0.0]), far, wxyz, np.ones(3), np.ones(3), cloud=bytes(600))
    edits += tuple(ObstacleEdit(s.name, s) for s in (many, *_meshes_at(robot, far, wxyz)))
    for task in (Task.POSE, Task.POSITION | Task.DIRECTION):
        goal = Goal(m.tip.x, quat_of(m.tip.R), task, 1e-3, 1e-2)
        moving = m._replace(state=State.RUN, goal=goal, in_force=0)
        beside, _, _ = tick(robot, moving, feedback, Request(obstacles=edits))
        tick(robot, beside, feedback, Request(goal=goal, verb=Verb.RESET))  # the obstacles move on by themselves
    _warm_competence(robot, moving, feedback)
    quat_of(exp3(between(TOOL_Z, -TOOL_Z)))  # of a goal that names a direction
    stopping = m._replace(state=State.SAFE_STOP, reaction=Severity.SS1)
    tick(robot, stopping, feedback, Request())


def _warm_competence(robot: Robot, moving: Memory, feedback: Feedback) -> None:
    """Let the arm rest short of a goal: what is asked then, and the steps of an escape."""
    goal = Goal(moving.tip.x + 0.2, quat_of(moving.tip.R), Task.POSE, 1e-3, 1e-2)
    resting = moving._replace(goal=goal)
    for seconds in (escape.STALL, robot.stop.stall):
        tick(robot, resting._replace(still=round(seconds / robot.dt) - 1), feedback, Request())
    stalled = escape.begun(Escape(), 1.0, np.array([0.0, 1.0, 0.0]))
    for phase in (escape.Phase.CHOOSING, escape.Phase.FIRST):
        tick(robot, resting._replace(escape=stalled._replace(phase=phase)), feedback, Request())
