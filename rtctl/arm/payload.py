"""A payload that an operator tells of: into the model from this tick on, without a jump of the torque."""

import numpy as np

from rtctl.arm.flat import parameters_of
from rtctl.arm.hot import record_of
from rtctl.arm.memory import Memory
from rtctl.arm.robot import Robot
from rtctl.arm.sensing import drives_torque
from rtctl.types import Payload, Request

SURPRISE = 1.5  # times the weight that was told may come or go while it is taken up or put down


def with_payload(robot: Robot, m: Memory, request: Request) -> Memory:
    """Return the memory with the request's payload, or with the reason why it was refused.

    What was carried untold until now, and what seems to push the arm, are counted from the new model on: the torque
    stays as it was, and the observer learns whether the payload is there already.
    """
    payload = request.payload
    if payload is None:
        return m
    model = robot.body.evaluate(m.model.q, m.model.qd, robot.points, robot.own, payload)
    if refusal := _refusal(robot, payload, model.g):
        return m._replace(refusal=f"payload: {refusal}")
    h, more = record_of(m.hot)[0], model.g - m.model.g
    parameters = parameters_of(model, int(h["task"]), h["axis"], robot.motion)
    m = m._replace(model=model, parameters=parameters, payload=np.array(payload))
    if not drives_torque(h):
        return m
    lasting = m.lasting if m.noticed else np.zeros(robot.n)
    return m._replace(
        noticed=True,
        settled=False,
        lasting=lasting + more,
        external=m.external + more,
        external_moving=m.external_moving + more,
        track=m.track + more,
        expected=np.maximum(m.expected, SURPRISE * np.abs(more)),
    )


def _refusal(robot: Robot, payload: Payload, g: np.ndarray) -> str:
    if not 0.0 <= payload.mass <= robot.payload_max:
        return f"got {payload.mass:g} kg, wanted at most payload_max_kg = {robot.payload_max:g}"
    over = np.abs(g) / robot.tau_max
    i = int(over.argmax())
    if over[i] >= 1.0:
        return f"{robot.joints[i]} would carry {abs(g[i]):.3g} Nm, wanted at most {robot.tau_max[i]:.4g}"
    return ""
