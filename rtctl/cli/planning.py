"""What `rtctl plan` does: sub-goals printed for `rtctl goals`, or followed on a running robot."""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from rtctl import design as cfg
from rtctl.app.plan import plan
from rtctl.app.stream import ArmStatus, GoalStream
from rtctl.arm.robot import Robot
from rtctl.arm.task import turns
from rtctl.cli.goals import send
from rtctl.cli.parser import daemon_of
from rtctl.control.firas import rooms_of
from rtctl.design.arm import loaded_shape
from rtctl.design.assets import Assets, load_assets
from rtctl.errors import EXIT_FAILED, EXIT_OK, RequestError, UsageError
from rtctl.hal.client import Session, accepted
from rtctl.plain import Json
from rtctl.spec.obstacles import orientation_contradiction, quaternion
from rtctl.spec.scenario import load_scenario
from rtctl.types import F64, Goal, ObstacleEdit, Task
from rtctl.world import obstacle_table
from rtctl.world.primitives import CLOUD, Obstacles, obstacles_empty

POLL = 0.02  # [s] between two looks at the status


def run(arguments: argparse.Namespace) -> int:
    """Plan, print or follow; return the exit code. Raises RtctlError."""
    offline = arguments.start is not None or arguments.scenario is not None
    if arguments.run and offline:
        raise UsageError("--run: got --from or --scenario beside it, wanted neither: it starts where the robot is")
    if arguments.seed < 0:
        raise UsageError(f"--seed: got {arguments.seed}, wanted 0 or more")
    config = cfg.load(arguments.config)
    robot = cfg.build(config, arguments.config)
    goal = _goal(arguments, robot)
    if not offline:
        return _with_daemon(arguments, robot, goal)
    q, obstacles = _described(arguments, robot)
    begun = time.monotonic()
    goals = plan(robot, q, goal, obstacles, arguments.seed, within=arguments.within)
    _print(goals, time.monotonic() - begun)
    return EXIT_OK


def _goal(arguments: argparse.Namespace, robot: Robot) -> Goal:
    if found := orientation_contradiction(arguments.rpy, arguments.wxyz):
        raise UsageError(f"--{found[0]}: got {found[1]}, wanted {found[2]}")
    oriented = arguments.rpy is not None or arguments.wxyz is not None
    return Goal(
        np.array(arguments.to),
        quaternion(arguments.rpy, arguments.wxyz),
        Task.POSE if oriented else Task.POSITION,
        robot.tolerance,
        robot.tolerance_rot,
    )


def _described(arguments: argparse.Namespace, robot: Robot) -> tuple[F64, Obstacles]:
    """Return the start posture (n,) and the obstacles of the options and the files."""
    start, assets, edits = arguments.start, Assets(robot.meshes, {}), tuple[ObstacleEdit, ...]()
    if arguments.scenario is not None:
        scenario = load_scenario(arguments.scenario)
        assets = load_assets((), scenario.obstacle, Path(arguments.scenario), robot.meshes)
        edits = tuple(ObstacleEdit(o.name, loaded_shape(o, assets)) for o in scenario.obstacle if o.appears_s == 0.0)
        start = start if start is not None else scenario.start_q_rad
    empty = obstacle_table.empty(robot.slots, assets.meshes, of_all=rooms_of(robot.avoid))
    table = obstacle_table.with_static(empty, robot.obstacles)
    table, refusal = obstacle_table.edited(table, edits)
    if refusal:
        raise RequestError(f"{arguments.scenario}: {refusal}")
    q = robot.home if start is None else np.array(start, np.float64)
    if len(q) != robot.n:
        raise UsageError(f"--from: got {len(q)} angles, wanted {robot.n}, one a joint of {robot.name}")
    if ((q < robot.q_min) | (q > robot.q_max)).any():
        raise UsageError(f"--from: got {q.tolist()}, wanted angles within the joint limits")
    return q, table.obstacles


def _with_daemon(arguments: argparse.Namespace, robot: Robot, goal: Goal) -> int:
    """Plan from where the running robot is; follow the plan if asked to."""
    if not arguments.socket and not arguments.robot:
        arguments.robot = robot.name
    with Session(daemon_of(arguments), arguments.reply) as session:

        def planned(q: F64, seed: int) -> list[Goal]:
            known = obstacles_told(accepted(session.ask({"verb": "world"})), robot)
            return plan(robot, q, goal, known, seed, within=arguments.within)

        status = accepted(session.ask({"verb": "status"}))
        if len(status["q_rad"]) != robot.n:
            raise RequestError(f"the daemon's robot has {len(status['q_rad'])} joints, that of the config {robot.n}")
        begun = time.monotonic()
        q = np.array(status["q_rad"])
        if not arguments.run:
            _print(planned(q, arguments.seed), time.monotonic() - begun)
            return EXIT_OK
        if status["state"] != "RUN":
            raise RequestError(f"plan --run: not possible in state {status['state']}: arm first")
        stream = GoalStream(planned, q, arguments.seed)
        return _follow(session, stream, arguments)


def _follow(session: Session, stream: GoalStream, arguments: argparse.Namespace) -> int:
    begun, elapsed, status = time.monotonic(), 0.0, Json()
    while not stream.over:
        status = accepted(session.ask({"verb": "status"}))
        elapsed = time.monotonic() - begun
        if status["state"] != "RUN":
            stream.over = str(status["state"])
        elif elapsed > arguments.timeout:
            stream.over = f"{status['status']} {status['detail']} after {arguments.timeout:g} s"
        else:
            _step(session, stream, status)
            time.sleep(POLL)
    arrived = stream.over == "arrived"
    if arguments.json:
        outcome = {"arrived": arrived, "why": stream.over, "time_s": elapsed, "replans": stream.replans}
        print(json.dumps({**outcome, "error_m": status["error_m"]}))
    else:
        print(f"{'arrived' if arrived else 'NOT REACHED: ' + stream.over}  {elapsed:.2f} s")
    return EXIT_OK if arrived else EXIT_FAILED


def _step(session: Session, stream: GoalStream, status: Json) -> None:
    """Give the sub-goal that is due, and tell of new plans."""
    seen = ArmStatus(status["status"], status["detail"], np.array(status["x_m"]), np.array(status["q_rad"]))
    goal = stream.next(seen)
    for text in stream.events:
        print(f"plan: {text}", file=sys.stderr, flush=True)
    stream.events.clear()
    if goal is not None:
        send(session, {"verb": "goal", **message_of(goal)})


def obstacles_told(reply: Json, robot: Robot) -> Obstacles:
    """Return the obstacles of a daemon's answer to `world`. Raises RequestError for those that it cannot tell of."""
    known, rows = obstacles_empty(robot.slots, robot.meshes), reply["obstacles"]
    count = len(reply["names"])
    if not count:
        return known
    for key, value in rows.items():
        getattr(known, key)[:count] = value
    known.active[:count] = True
    for k, (name, mesh) in enumerate(zip(reply["names"], reply["meshes"], strict=True)):
        if known.kind[k] == CLOUD:
            raise RequestError(f"plan: obstacle {name} is a cloud, whose points no daemon tells: plan with --scenario")
        if mesh and mesh not in robot.meshes.names:
            raise RequestError(f"plan: obstacle {name} is the mesh {mesh}, which the config does not have")
        if mesh:
            known.dims[k, 3] = robot.meshes.start(mesh)
    return known


def message_of(goal: Goal) -> Json:
    """Return a goal, no direction, as the control socket and the lines of `rtctl goals` have it."""
    message: Json = {"position_m": goal.position.tolist()}
    axes = [axis for i, axis in enumerate("xyz") if int(goal.task) >> i & 1]
    if len(axes) < 3:
        message["axes"] = axes
    if turns(goal.task):
        message["wxyz"] = goal.wxyz.tolist()
    if goal.posture is not None:
        message["posture_rad"] = goal.posture.tolist()
    return {**message, "tolerance_m": goal.tolerance, "tolerance_rad": goal.tolerance_rot}


def _print(goals: list[Goal], took: float) -> None:
    for goal in goals:
        print(json.dumps(message_of(goal)))
    print(f"plan: {len(goals)} sub-goals in {took:.1f} s", file=sys.stderr)
