"""Waiting for what a verb causes: for the daemon to be ready, for the robot to come to the state that was asked for."""

import argparse
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import NamedTuple

from rtctl.cli.parser import daemon_of
from rtctl.errors import EXIT_FAILED, EXIT_OK, LinkError, RequestError
from rtctl.hal.client import Session, accepted, answers
from rtctl.hal.lobby import STARTING
from rtctl.plain import Json

POLL = 0.05  # [s] between two looks at the status
PATIENCE = 3.0  # [s] for a daemon that was started beside to open its socket
START_TIME = 600.0  # [s] for a daemon to compile and to greet its vehicle
NOTE_AFTER = 0.5  # [s] of waiting after which it is said what for
NOTE_EVERY = 5.0  # [s]
CLEARING_TIME = 2.0  # [s] for drives to clear their faults after a reset
AUTOPILOT_TIME = 5.0  # [s] for an autopilot to disarm once the robot is IDLE
LEAVE = "; rtctl reset leaves it, once its cause is gone"
LEAVES = {"SAFE_STOP": LEAVE, "FAULT": LEAVE}
FIRST = {"IDLE": "; rtctl arm comes first", "STOPPING": "; it comes to rest now", **LEAVES}
MOVES = ("park", "float", "hold")  # verbs of an arm that is armed
AIMS = {
    "arm": "the robot is armed and holds",
    "recover": "the robot is armed and moves inward",
    "disarm": "it rests and the drives are off",
    "park": "it is parked and the drives are off",
    "stop": "it rests",
    "float": "a hand may move the arm",
    "hold": "the arm holds itself",
    "reset": "the stop or fault is left",
}


class End(NamedTuple):
    """How waiting ended."""

    done: bool
    words: str  # the state that was reached, or why it was not


class Notes:
    """Lines on stderr while one waits: the first soon, the same again seldom."""

    def __init__(self, verb: str) -> None:
        self._verb, self._said, self._at = verb, "", time.monotonic() - NOTE_EVERY + NOTE_AFTER

    def say(self, text: str, key: str) -> None:
        """Print `text` when `key` is new to it, or a while has passed."""
        now = time.monotonic()
        if now - self._at >= (NOTE_AFTER if key != self._said and self._said else NOTE_EVERY):
            self._said, self._at = key, now
            print(f"rtctl: {self._verb}: {text}", file=sys.stderr, flush=True)


def ready_session(arguments: argparse.Namespace, verb: str, patience: float = PATIENCE) -> Session:
    """Return a connection to a daemon that is ready to do what it is told; one that starts is waited for.

    Raises LinkError where there is none, or none that becomes ready.
    """
    notes, begun = Notes(verb), time.monotonic()
    path = daemon_of(arguments, patience)
    while not answers(path) and time.monotonic() - begun < patience:  # named by --socket, and not there yet
        time.sleep(POLL)
    while True:
        with ExitStack() as stack:
            session = stack.enter_context(Session(path, arguments.reply))
            doing = _doing(session)
            if not doing:
                stack.pop_all()  # open for the caller
                return session
        if time.monotonic() - begun > START_TIME:
            raise LinkError(f"{path}: the daemon is not ready after {START_TIME:g} s: {doing}")
        notes.say(f"waiting for the daemon, which starts: {doing}", doing.split(",")[0])
        time.sleep(POLL)
        if not answers(path):
            raise LinkError(f"{path}: the daemon ended while it started; it has said why where it was started")


def gripped(session: Session, message: Json, timeout: float) -> End:
    """Tell grippers where to go and wait until they are there or hold something. Raises RequestError, LinkError."""
    accepted(session.ask(message))
    begun, notes = time.monotonic(), Notes("grip")
    while True:
        time.sleep(POLL)
        found = [g for g in accepted(session.ask({"verb": "status"})).get("grippers", ()) if _meant(g, message)]
        words = "; ".join(f"{g['name']} {g['state']} at {g['closed']:.2f}, {g['force_N']:.1f} N" for g in found)
        if all(g["state"] in ("there", "gripping") for g in found):
            return End(True, words)
        if any(g["state"] in ("silent", "fault", "off") for g in found):
            return End(False, words)
        if time.monotonic() - begun > timeout:
            return End(False, f"{words} still after {timeout:g} s")
        notes.say(f"waiting until it is there or holds something (at most {timeout:g} s; --no-wait does not wait)", "")


def _meant(gripper: Json, message: Json) -> bool:
    return not message.get("name") or gripper["name"] == message["name"]


def _doing(session: Session) -> str:
    """Return what a daemon that starts is doing, '' for one that is ready."""
    try:
        status = session.ask({"verb": "status"})
    except LinkError as error:  # between its lobby and its loop nobody reads: it may answer too late
        if not answers(session.path):
            raise
        return str(error)
    return str(status.get("detail")) if status.get("state") == STARTING else ""


def perform(session: Session, message: Json, timeout: float) -> End:
    """Tell a verb and wait until what it causes has happened. Raises RequestError for a refusal, LinkError."""
    begun, verb = time.monotonic(), str(message["verb"])
    while True:
        try:
            accepted(session.ask(message))
            break
        except RequestError as error:  # the first reset has the drives clear their faults; a later one finds them gone
            if "being cleared" not in str(error) or time.monotonic() - begun > CLEARING_TIME:
                raise RequestError(f"{error}{hint(str(error), FIRST if verb in MOVES else LEAVES)}") from None
            time.sleep(POLL)
    return _awaited(session, verb, timeout)


def hint(refusal: str, known: Mapping[str, str] = FIRST) -> str:
    """Return what to do about a verb that a state does not allow, "" where nothing is known."""
    return known.get(refusal.rpartition("not possible in state ")[2], "")


def _awaited(session: Session, verb: str, timeout: float) -> End:
    begun, since, idle, notes = time.monotonic(), None, None, Notes(verb)
    while True:
        status = accepted(session.ask({"verb": "status"}))
        now = time.monotonic()
        since = float(status.get("time_s") or 0.0) if since is None else since
        idle = (now if idle is None else idle) if status.get("state") == "IDLE" else None
        end = _end(verb, status, since, 0.0 if idle is None else now - idle)
        if end is not None:
            return end
        if now - begun > timeout:
            return End(False, f"{status.get('state')} still after {timeout:g} s{_why(status, since)}")
        notes.say(f"waiting until {AIMS[verb]} (at most {timeout:g} s; --no-wait does not wait)", "")
        time.sleep(POLL)


def _end(verb: str, status: Json, since: float, idle: float) -> End | None:
    """Return how a verb ended, None while it goes on; since [s] robot time of telling it, idle [s] in IDLE."""
    state = str(status.get("state"))
    if verb in ("arm", "recover"):
        return (
            None if state == "ARMED" else End(state == "RUN", state + ("" if state == "RUN" else _why(status, since)))
        )
    if verb in ("float", "hold"):
        floats = status.get("status") == "floating"
        done = state == "RUN" and floats == (verb == "float")
        return End(done, ("floating" if floats else "holding") if done else state + _why(status, since))
    if verb == "stop":
        rests = bool(status.get("at_rest", True))
        if state == "SAFE_STOP":
            return End(True, "SAFE_STOP, at rest; rtctl reset leaves it") if rests else None
        return End(False, state + _why(status, since))
    if state == "IDLE":
        if verb == "disarm" and status.get("vehicle", {}).get("armed"):
            return (
                None
                if idle < AUTOPILOT_TIME
                else End(False, f"IDLE, but the autopilot stays armed{_why(status, since)}")
            )
        left = ", ".join(map(str, status.get("faults") or ()))
        return End(True, "IDLE" + (f"; still there: {left}" if left else ""))
    if verb == "reset" and state == "RUN":
        return End(True, "RUN: without brakes the arm goes on being held")
    on_its_way = verb == "park" and state == "RUN" and status.get("status") in ("no_goal", "moving", "arrived")
    return None if state == "STOPPING" or on_its_way else End(False, state + _why(status, since))


def _why(status: Json, since: float) -> str:
    """Return the vehicle's own words since then, or the faults in force, after a colon; '' without a reason."""
    words = [text for at, text in status.get("vehicle", {}).get("words", ()) if at >= since - 2.0 * POLL]
    words = words or [str(fault) for fault in status.get("faults") or ()]
    return f": {'; '.join(words)}" if words else ": without a reason" if status.get("state") != "RUN" else ""


def told(verb: str, end: End) -> int:
    """Print how a verb ended; return the exit code."""
    if end.done:
        print(f"{verb}: {end.words}")
        return EXIT_OK
    print(f"rtctl: {verb}: {end.words}", file=sys.stderr)
    return EXIT_FAILED
