"""Sending goals and following them to their end."""

import argparse
import json
import math
import time
from collections.abc import Iterable
from typing import NamedTuple

from rtctl.cli.values import goal_messages, goes_on
from rtctl.cli.waiting import Notes, hint
from rtctl.errors import EXIT_FAILED, EXIT_OK, RequestError
from rtctl.hal.client import Session, accepted
from rtctl.plain import Json

POLL = 0.05  # [s] between two looks at the status
ARRIVED = "arrived"
PASSED = "passed"
STALE = "goal_stale"
MOVING_STATES = ("ARMED", "RUN")
WORDS = {  # what a status means, for one who waits no more
    "moving": "it is still on its way",
    "escaping": "it is still going round what blocks the way",
    "shadowed": "the goal lies within the influence of an obstacle",
    "local_minimum": "obstacles block the way: rtctl plan finds one around them",
    "saturated": "the torque limits hold the arm",
    "singular": "the arm cannot move that way from where it is",
    "limited": "joint limits hold the arm",
    "unreachable": "the goal is farther away than the arm is long",
    "blind": "where it would go has not been seen",
}


class Outcome(NamedTuple):
    """What became of a goal."""

    position: list[float] | None  # (3,) [m], None for an orientation alone
    arrived: bool
    why: str  # the status, state or refusal that ended it
    time: float  # [s]
    error: float  # [m] to the goal, nan where unknown
    error_rot: float  # [rad]

    def show(self, as_json: bool) -> None:
        """Print one line."""
        if as_json:
            print(json.dumps(self.as_dict()), flush=True)
            return
        where = " ".join(f"{c:+.3f}" for c in self.position) + " m" if self.position else "orientation"
        word = self.why if self.arrived else f"NOT REACHED: {self.why}"
        print(f"goal {where}  {word}  {self.time:.2f} s  {self._missed()}", flush=True)

    def as_dict(self) -> Json:
        """Return the outcome for --json; what is unknown is null."""
        known = {key: None if math.isnan(value) else value for key, value in self._errors().items()}
        return {"position_m": self.position, "arrived": self.arrived, "why": self.why, "time_s": self.time, **known}

    def _missed(self) -> str:
        if math.isnan(self.error):
            return _figure(self.error_rot, 1.0, "rad", 4)
        return _figure(self.error, 1e3, "mm", 2)

    def _errors(self) -> dict[str, float]:
        return {"error_m": self.error, "error_rad": self.error_rot}


def send(session: Session, message: Json) -> Json:
    """Return the daemon's reply. Raises RequestError with its reason."""
    try:
        return accepted(session.ask(message))
    except RequestError as error:
        raise RequestError(f"{error}{hint(str(error))}") from None


def send_and_wait(session: Session, message: Json, timeout: float) -> Outcome:
    """Return what became of a goal within `timeout` [s]. Raises RequestError when it is refused at once."""
    send(session, message)
    return awaited(session, message, timeout)


def awaited(session: Session, message: Json, timeout: float, near: float = 0.0) -> Outcome:
    """Return what became of the goal of `message` within `timeout` [s]; one that is `near` [m] counts as passed."""
    wanted, begin, notes = message.get("position_m"), time.monotonic(), Notes("goal")
    while True:
        status = accepted(session.ask({"verb": "status"}))  # made after the goal was taken: never of the one before
        elapsed = time.monotonic() - begin
        if status.get("queued") and elapsed <= timeout:  # the robot arms still
            notes.say("waiting until the robot is armed; the goal is queued", "queued")
            time.sleep(POLL)
            continue
        if wanted is None:  # given in degrees: where that is
            wanted = status.get("goal_m") or [math.nan] * 3
        why = _end(status, wanted)
        if not why and near and wanted and _known(status.get("error_m")) <= near:
            why = PASSED
        if not why and elapsed > timeout:
            name = str(status.get("status", "?"))
            detail = f" ({status['detail']})" if status.get("detail") else ""
            why = f"{name}{detail} after {timeout:g} s: {WORDS.get(name, 'the time is over')}"
        if why:
            errors = [_known(status.get(key)) for key in ("error_m", "error_rad")]
            return Outcome(wanted, why in (ARRIVED, PASSED), why, elapsed, *errors)
        notes.say(f"waiting until it is reached (at most {timeout:g} s; --no-wait does not wait)", "")
        time.sleep(POLL)


def run_stream(session: Session, lines: Iterable[str], source: str, arguments: argparse.Namespace) -> int:
    """Send the goals in `lines` one after another and return the exit code. Raises UsageError, RequestError."""
    failed, due = 0, time.monotonic()
    last: Json | None = None
    for at, message in goal_messages(lines, source):
        try:
            send(session, message)
            if arguments.rate:  # to the grid: goals that move are where they say at their time
                due = max(due + 1.0 / arguments.rate, time.monotonic() - 0.1)
                time.sleep(max(0.0, due - time.monotonic()))
                continue
            if goes_on(message):
                last = None
                continue
            outcome = awaited(session, message, arguments.timeout, arguments.near or 0.0)
            last = message
        except RequestError as error:
            if not arguments.keep_going:
                raise RequestError(f"{source}:{at}: {error}") from None
            outcome = Outcome(message.get("position_m"), False, str(error), 0.0, math.nan, math.nan)
        outcome.show(arguments.json)
        failed += not outcome.arrived
        if failed and not arguments.keep_going:
            return EXIT_FAILED
    if last is not None and arguments.near:  # it was passed; the last goal is there to arrive at
        outcome = awaited(session, last, arguments.timeout)
        outcome.show(arguments.json)
        failed += not outcome.arrived
    return EXIT_FAILED if failed else EXIT_OK


def _end(status: Json, wanted: list[float] | None) -> str:
    """Return why the goal is over, or nothing while it is pursued."""
    state = str(status.get("state"))
    if state not in MOVING_STATES:
        faults = ", ".join(map(str, status.get("faults") or ()))
        return f"{state}{': ' + faults if faults else ''}"
    if STALE in (status.get("faults") or ()):
        return f"{STALE}: no other goal came within its time-out"
    if status.get("queue_refusal"):
        return str(status["queue_refusal"])
    present = status.get("goal_m")
    if present is None or any(abs(a - b) > 1e-6 for a, b in zip(present, wanted or present, strict=True)):
        return "replaced by another goal"
    return ARRIVED if status.get("status") == ARRIVED else ""


def _known(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _figure(value: float, scale: float, unit: str, digits: int) -> str:
    return "" if math.isnan(value) else f"error {value * scale:.{digits}f} {unit}"
