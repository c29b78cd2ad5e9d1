"""One tick: feedback and requests in, torque and a record out. Pure: no clock, socket, file or randomness.

Equal inputs give equal bits, which is what makes replay, lockstep simulation and Monte-Carlo the same thing. The
block diagram is `tick`; each block is a function below it or a module beside it.
"""

import math
from collections.abc import Sequence

import numpy as np

from rtctl.arm import diagnosis, escape
from rtctl.arm.constants import REVIEW
from rtctl.arm.escape import Escape
from rtctl.arm.estimator import joint_start, start
from rtctl.arm.faults import FAULTS
from rtctl.arm.flat import model_in, parameters_of, shapes_of, table_of
from rtctl.arm.gripper import DRIVEN, gripped, refused, silent, unasked
from rtctl.arm.hot import MEASURED_POSTURE, fresh, record_of
from rtctl.arm.memory import Memory
from rtctl.arm.model import Model
from rtctl.arm.payload import with_payload
from rtctl.arm.record import record_dtype, with_grippers
from rtctl.arm.robot import Robot
from rtctl.arm.servo_level import (
    ATTENTION,
    CHOSEN,
    DECIDED,
    MEASURED,
    MISSED_MAX,
    MODEL,
    MOVED,
    REQUEST,
    START,
    WORLD,
    Asked,
    act,
    asking,
    held,
    limited,
    servo,
    surroundings,
)
from rtctl.arm.supervision import hold_at, supervise, with_advice, with_goal
from rtctl.arm.target import DIAGNOSE, START_SPEED_SCALE, WORDS, leads, pursues
from rtctl.arm.task import between, point_of
from rtctl.arm.terms import KEEP
from rtctl.control.firas import rooms_of
from rtctl.kernel import compile_for
from rtctl.kernel.rotations import exp3, quat_of
from rtctl.types import (
    F64,
    TOOL_Z,
    Command,
    Drive,
    Feedback,
    Goal,
    Hold,
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

SIGMA_MIN = 0  # its place in the parameters, see `flat.parameters_of`
ZERO = np.zeros(3)
DRIVES = tuple(Drive(i) for i in range(5))  # an enumeration looks its numbers up slowly


def tick(robot: Robot, memory: Memory, feedback: Feedback, request: Request) -> tuple[Memory, Command, Record]:
    """Return (memory, command, record) of one servo period.

    feedback: the drives' replies of this slot; request: what operators and sensors sent since the previous tick.
    """
    f = feedback if type(feedback.link) is int else feedback._replace(link=int(feedback.link))
    asked = request.verb or request.goal is not None or request.advice is not None or request.payload is not None
    bits, verb, m = REQUEST if asked else 0, int(request.verb), memory
    blocked_by, refusal = memory.blocked_by, ""
    if request.obstacles:
        m, bits = _perceived(robot, memory, feedback, request), bits | WORLD
        refusal = m.refusal
    if request.drive is not None:
        m, refusal = _driven(robot, m, request.drive, refusal)
    arm, model, parameters, placed, shapes, ends = robot.arm, m.model, m.parameters, m.placed, m.shapes, m.ends
    bodies = placed.obstacles.mesh, placed.obstacles.clouds
    hot, table, raw, flags = servo(arm, m.hot, parameters, m.table, shapes, bodies, ends, f, asking(START, bits, verb))
    if flags & MODEL:
        model, parameters = _evaluated(robot, hot, model)
        bits |= WORLD if flags & MOVED else 0
        hot, table, raw, flags = servo(
            arm, hot, parameters, table, shapes, bodies, ends, f, asking(MEASURED, bits, verb)
        )
    if flags & ATTENTION:
        m = Memory(hot, robot.n, refusal, blocked_by, model, parameters, placed, table, shapes, ends, m.grippers)
        m, chosen = _decided(robot, m, feedback, request)
        hot, table, blocked_by, refusal, ends = m.hot, m.table, m.blocked_by, m.refusal, m.ends
        model, parameters = m.model, m.parameters
        hot, table, raw, flags = servo(
            arm, hot, parameters, table, shapes, bodies, ends, f, asking(DECIDED, bits | chosen, verb)
        )
    if not robot.carry:
        model = model._replace(q=record_of(hot)["q"][0, : robot.n])  # the points have not moved either
    blocked_by = () if flags & WORDS else blocked_by
    m = Memory(hot, robot.n, refusal, blocked_by, model, parameters, placed, table, shapes, ends, memory.grippers)
    record = np.frombuffer(raw, record_dtype(robot.n, robot.slots))
    if flags & DIAGNOSE:
        m = _diagnosed(robot, m, memory, record)
    command = _command(DRIVES[record["command"].item()], hot, robot.n)
    if robot.grippers or request.grip is not None:
        m, command, record = _gripped(robot, m, (feedback, request), command, record)
    record.flags.writeable = False
    return m, command, record


def _driven(robot: Robot, m: Memory, drive: Sequence[float], refusal: str) -> tuple[Memory, str]:
    """Return the memory of an arm that another law drives in this tick, and why its torque was refused."""
    if len(drive) != robot.n or not all(map(math.isfinite, drive)):
        return m, refusal or f"drive: got {drive}, wanted {robot.n} finite torques [Nm]"
    return m._replace(driven=True, drive=np.array(drive, np.float64)), refusal


def _command(drive: Drive, hot: F64, n: int) -> Command:
    """Return what goes to the drives of n joints."""
    h = record_of(hot)
    if drive != Drive.HOLD:
        return Command(drive, h["sent"][0, 0, :n])
    off = (h["lost"][0] >> np.arange(n) & 1).astype(np.bool_) & (h["own_t"][0, :n] == 0.0)
    p, v, kp, kd, t = (h[name][0, :n] for name in ("own_p", "own_v", "own_kp", "own_kd", "own_t"))
    return Command(drive, t, Hold(p, v, kp, kd, off))


def _gripped(
    robot: Robot, m: Memory, came: tuple[Feedback, Request], command: Command, record: Record
) -> tuple[Memory, Command, Record]:
    """Return memory, command and record with the grippers in them, or with the reason why they are not moved."""
    feedback, request = came
    why = "" if request.grip is None else refused(robot.grippers, request.grip, command.drive in DRIVEN)
    asked, elapsed = None if why else request.grip, robot.dt * (1 + min(feedback.missed, MISSED_MAX))
    seen = feedback.grippers if feedback.grippers.shape[1] == len(robot.grippers) else silent(len(robot.grippers))
    memory, command = gripped(robot.grippers, m.grippers, seen, asked, command, elapsed)
    m = m._replace(grippers=memory, refusal=why or m.refusal)
    return m, command, with_grippers(record, seen, memory) if robot.grippers else record


def initial(robot: Robot, feedback: Feedback) -> Memory:
    """Return the memory before the first tick: IDLE, at rest where the feedback says the arm is."""
    q, zero = feedback.q.copy(), np.zeros(robot.n)
    model = robot.body.evaluate(q, zero, robot.points, robot.own)
    table = obstacle_table.empty(
        robot.slots, robot.meshes, robot.safety.creep, robot.safety.feed_timeout, rooms_of(robot.avoid)
    )
    table = obstacle_table.with_static(table, robot.obstacles)
    far = np.full(robot.slots, np.inf)
    parameters = parameters_of(model, int(robot.axes), TOOL_Z, robot.motion)
    shapes, places = (
        shapes_of(table.obstacles, table.moving, table.creep, table.stale),
        table_of(table.obstacles, table.age, far, far),
    )
    ends, grippers = np.zeros(3 * len(robot.points.radius) + len(robot.own.pairs)), unasked(len(robot.grippers))
    return Memory(fresh(), robot.n, "", (), model, parameters, table, places, shapes, ends, grippers)._replace(
        tick=-1,
        state=State.IDLE,
        since=-1,
        good=np.full(len(FAULTS), 1 << 30),
        clear_until=-1,
        joints=joint_start(q, robot.joint_P),
        tip=start(model.x, model.R, robot.tip_design),
        task=robot.axes,
        axis=TOOL_Z,
        evaluated=True,
        q_previous=q,
        hold=hold_at(model.x, model.R, robot.axes),
        escape=Escape(),
        q_rest=q,
        blocker=-1,
        nearest=np.inf,
        speed_scale=START_SPEED_SCALE,
    )


def _evaluated(robot: Robot, hot: F64, model: Model) -> tuple[Model, F64]:
    """Return the model at the joints of a hot record if one is due, and the parameters of its task."""
    h, n = record_of(hot)[0], robot.n
    if h["evaluated"]:
        model = robot.body.evaluate(h["q"][:n], h["qd"][:n], robot.points, robot.own, h["payload"].tolist())
    parameters = parameters_of(model, int(h["task"]), h["axis"], robot.motion)
    if not h["task"]:  # the joints lead: no task is singular, and the log holds numbers
        parameters[SIGMA_MIN] = 0.0
    return model, parameters


def _perceived(robot: Robot, m: Memory, feedback: Feedback, request: Request) -> Memory:
    """Obstacles: extrapolated to this slot, then replaced by what was seen; and why that was refused.

    That the links of the goal's posture keep the clearance was measured among other ones, unless all that is new moves.
    """
    elapsed = robot.dt * (1 + min(feedback.missed, MISSED_MAX))
    table, refusal = obstacle_table.edited(obstacle_table.advanced(m.world, elapsed), request.obstacles)
    m = m._replace(world=table, refusal=refusal)
    rests = any(e.shape is not None and not (e.shape.velocity.any() or e.shape.omega.any()) for e in request.obstacles)
    return m._replace(has_posture=1) if rests and m.has_posture == MEASURED_POSTURE else m


def _decided(robot: Robot, m: Memory, feedback: Feedback, request: Request) -> tuple[Memory, int]:
    """Return the memory after what is rare: the supervisor's events, a new goal, the side of an escape (CHOSEN)."""
    m = supervise(robot, with_payload(robot, m, request), feedback, request, m.present)
    m = with_advice(robot, with_goal(robot, m, request), request)
    if pursues(record_of(m.hot)[0]) and m.escape.phase == escape.Phase.CHOOSING:
        return _with_side(robot, m), CHOSEN
    return m, 0


def _with_side(robot: Robot, m: Memory) -> Memory:
    """Return the memory with the choice of the side of an escape a tick further."""
    goal = m.goal
    assert goal is not None
    to = goal._replace(position=point_of(goal, m.tip.x))
    return m._replace(
        escape=escape.chosen(
            m.escape,
            m.model,
            m.tip.x,
            to,
            m.world.obstacles,
            robot.base,
            robot.reach,
            robot.avoid.rho0,
            robot.motion.epsilon,
        )
    )


def _diagnosed(robot: Robot, m: Memory, before: Memory, record: Record) -> Memory:
    """Level of competence: what holds an arm that rests or creeps; written into the record, too."""
    m = _blocked(robot, m, before, record)
    h = record_of(m.hot)[0]
    record["status"], record["blocker"], record["holders"] = h["status"], h["blocker"], h["blockers"]
    record["escape"] = h["escape_phase"]
    return m


def _blocked(robot: Robot, m: Memory, before: Memory, record: Record) -> Memory:
    goal, still = m.goal, m.still
    assert goal is not None
    if leads(record_of(m.hot)[0]):
        found = diagnosis.blockers(_balance(robot, m, record))
        return _with_blockers(robot, m, found)._replace(status=found.status)
    error = record["error"].item()
    stall, waited = round(robot.stop.stall / robot.dt), _waited(robot, before)
    circles = robot.escape and m.escape.phase == escape.Phase.NONE
    if circles and still == round(escape.STALL / robot.dt):
        begun = _caught(robot, m, record, goal, error)
        if begun.status == Status.ESCAPING or not waited:
            return begun
        m = m._replace(escape=begun.escape)
    if not _waited(robot, m):
        return _with_status(m, Status.MOVING)
    if waited and m.tick % round(REVIEW / robot.dt):
        return m
    if circles and still < stall:  # it creeps
        begun = _caught(robot, m, record, goal, error)
        if begun.status == Status.ESCAPING:
            return begun
    found = diagnosis.blockers(_balance(robot, m, record))
    told = _with_blockers(robot, m, found)._replace(status=found.status)
    if still < stall and told.blocked_by == (diagnosis.UNKNOWN,):
        return m if waited else _with_status(m, Status.MOVING)  # slow, and nothing new is in its way
    return told


def _balance(robot: Robot, m: Memory, record: Record) -> diagnosis.Balance:
    return diagnosis.balance(robot, m, record["tau_limits"][0].copy(), record["tau_wanted"][0].copy())


def _waited(robot: Robot, m: Memory) -> bool:
    """Return whether the arm has been at rest, or got no nearer to its goal, for long enough to ask what holds it."""
    return bool(max(m.still * robot.dt, m.stall_timer) >= robot.stop.stall - 0.5 * robot.dt)


def _with_status(m: Memory, status: Status) -> Memory:
    return m if m.status == status else m._replace(status=status, blocker=-1, blockers=0, blocked_by=())


def _with_blockers(robot: Robot, m: Memory, found: diagnosis.Blockers) -> Memory:
    return m._replace(blocker=found.main, blockers=found.mask, blocked_by=diagnosis.names(robot, m, found))


def _caught(robot: Robot, m: Memory, record: Record, goal: Goal, error: float) -> Memory:
    """Return the memory of an arm that has just come to rest: where obstacles hold it, with an escape begun."""
    found = diagnosis.blockers(_balance(robot, m, record))
    by_obstacles = found.status in (Status.LOCAL_MINIMUM, Status.SHADOWED) and found.main >= 0
    rho0 = float(diagnosis.influences(robot, m)[found.main]) if by_obstacles else robot.avoid.rho0
    near = {Status.LOCAL_MINIMUM: rho0, Status.SHADOWED: 2.0 * rho0}
    if not found.mask or error < near.get(found.status, np.inf):
        return _with_status(m, Status.MOVING)
    begun = escape.begun(m.escape, error, escape.push_of(m.model, m.tau_obstacles, goal))
    if begun.phase == escape.Phase.GIVEN_UP:
        return _with_status(m, Status.MOVING)._replace(escape=begun)
    return _with_blockers(robot, m, found)._replace(escape=begun, status=Status.ESCAPING)


def _meshes_at(robot: Robot, position: np.ndarray, wxyz: np.ndarray) -> list[Shape]:
    names, zero = robot.meshes.names[:1], np.zeros(4)
    return [Shape("mesh", "mesh", zero, position, wxyz, zero[:3], zero[:3], mesh=name) for name in names]


def _resting(robot: Robot) -> Feedback:
    """Return what drives say of an arm that rests at home."""
    n = robot.n
    zero = np.zeros(n)
    return Feedback(
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


def compile_part(robot: Robot, part: int) -> None:
    """Compile one of two parts of the servo level that take about as long, so that two processes share the work.

    1: the second half of a tick, of which the law is the most. 0: what turns its torques into commands, which that half
    comes to last.
    """
    feedback = _resting(robot)
    memory = initial(robot, feedback)
    m = record_of(memory.hot)[0]
    model, space = model_in(memory.parameters, robot.n, len(robot.points.radius))
    around = surroundings(memory.table, memory.shapes, (memory.placed.obstacles.mesh, memory.placed.obstacles.clouds))
    if part == 1:
        compile_for(act, robot.arm, m, model, space, around, feedback, Asked(0, 0, 0), memory.ends)
        return
    compile_for(limited, robot.arm.constants[0], m, feedback, model, space.Jbar, np.zeros((KEEP + 1, robot.n)))
    compile_for(held, robot.arm.constants[0], m, feedback, model, space.Jbar, around)


def warm(robot: Robot) -> None:
    """Run the tick through every kind of work once, so that nothing is compiled or loaded while the arm moves."""
    feedback = _resting(robot)
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
        tick(robot, beside, feedback, Request(obstacles=edits[:1]))  # and when others are told
    _warm_competence(robot, moving, feedback)
    quat_of(exp3(between(TOOL_Z, -TOOL_Z)))  # of a goal that names a direction
    stopping = m._replace(state=State.SAFE_STOP, reaction=Severity.SS1)
    tick(robot, stopping, feedback, Request())
    tick(robot._replace(brakeless=True), stopping, feedback, Request())


def _warm_competence(robot: Robot, moving: Memory, feedback: Feedback) -> None:
    """Let the arm rest short of a goal: what is asked then, and the steps of an escape."""
    goal = Goal(moving.tip.x + 0.2, quat_of(moving.tip.R), Task.POSE, 1e-3, 1e-2)
    resting = moving._replace(goal=goal)
    for seconds in (escape.STALL, robot.stop.stall):
        tick(robot, resting._replace(still=round(seconds / robot.dt) - 1), feedback, Request())
    stalled = escape.begun(Escape(), 1.0, np.array([0.0, 1.0, 0.0]))
    for phase in (escape.Phase.CHOOSING, escape.Phase.FIRST):
        tick(robot, resting._replace(escape=stalled._replace(phase=phase)), feedback, Request())
