"""Verbs wait for what they cause: for a daemon that starts, a robot that arms, drives that clear their faults."""

import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtctl.app.queue import QUEUED, GoalQueue
from rtctl.cli import main
from rtctl.cli.offline import _missed
from rtctl.errors import EXIT_FAILED, EXIT_OK, EXIT_USAGE, LinkError, RequestError
from rtctl.hal.client import MESSAGE_MAX, Session, answers
from rtctl.hal.console import Console
from rtctl.hal.lobby import Lobby
from rtctl.hal.messages import Bounds, decode, request_of
from rtctl.types import Goal, ObstacleEdit, Request, State, Task, Verb

BOUNDS = Bounds((0.0, 0.0, 0.0), 1.0, 0.003, 0.015)
PATIENT = ("--reply", "60")  # [s]: a busy machine may take its time
Said = pytest.CaptureFixture[str]
GOAL = Goal(np.array([0.1, 0.2, 0.3]), np.array([1.0, 0.0, 0.0, 0.0]), Task.POSITION, 0.003, 0.015)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    return str(tmp_path / "rtctl-toy.sock")


class Toy:
    """A daemon whose answers are a function's, on a thread; each verb that it is told is written down."""

    def __init__(self, place: str, refusal: Callable[[Request], str], **how: Any) -> None:
        self.console = Console(place, 0.001, BOUNDS, **how)
        self.told: dict[str, Any] = {"state": "IDLE", "faults": [], "time_s": 0.0, "at_rest": True}
        self.console.publish(lambda: self.told)
        self.refusal, self.verbs, self.over = refusal, list[Verb](), threading.Event()
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        slot = 0
        while not self.over.is_set():
            request = self.console.poll(slot)
            if request.verb != Verb.NONE:
                self.verbs.append(request.verb)
            why = self.refusal(request)
            self.console.answer(not why, why)
            slot += 1
            self.over.wait(0.0005)

    def __enter__(self) -> "Toy":
        return self

    def end(self) -> None:
        if not self.over.is_set():
            self.over.set()
            self.thread.join()
            self.console.close()

    def __exit__(self, *_: object) -> None:
        self.end()


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.005)


# -- a daemon that starts --------------------------------------------------------------------------------------------


def test_a_daemon_that_starts_says_what_it_does_and_refuses_the_rest(place: str, capsys: Said) -> None:
    with Lobby(place, "toy") as lobby:
        lobby.tell("compiling", 12, 120)
        assert main(["status", *PATIENT]) == EXIT_OK
        assert "compiling, 12 of at most 120" in capsys.readouterr().out
        with Session(place) as session:
            reply = session.ask({"verb": "stop"})
            assert not reply["ok"]
            assert "no drive is enabled" in reply["error"]
            assert session.ask_raw(b"[[[")["ok"] is False
    assert not answers(place)


def test_arming_waits_for_a_daemon_that_starts_and_finds_the_one_that_takes_over(place: str, capsys: Said) -> None:
    codes: list[int] = []
    with Lobby(place, "toy") as lobby:
        arming = threading.Thread(target=lambda: codes.append(main(["arm", *PATIENT])))
        arming.start()
        lobby.tell("greeting the drives")
        with Session(place) as asking:
            assert asking.ask({"verb": "status"})["state"] == "STARTING"
        with Toy(place, lambda request: "", door=lobby.hand_over()) as toy:
            toy.told["state"] = "RUN"
            arming.join(60.0)
            assert toy.verbs == [Verb.ARM]
    assert codes == [EXIT_OK]
    assert capsys.readouterr().out == "arm: RUN\n"


def test_who_called_while_the_daemon_started_is_answered_by_the_one_that_takes_over(place: str) -> None:
    with Lobby(place, "toy") as lobby, Session(place, 60.0) as caller:
        assert caller.ask({"verb": "status"})["state"] == "STARTING"
        door = lobby.hand_over()
        replies: list[dict[str, Any]] = []
        asking = threading.Thread(target=lambda: replies.append(caller.ask({"verb": "status"})))
        asking.start()  # asked before anybody reads
        with Toy(place, lambda request: "", door=door):
            asking.join(60.0)
    assert [reply["state"] for reply in replies] == ["IDLE"]


def test_a_daemon_that_ends_while_it_starts_is_told_of(place: str, capsys: Said) -> None:
    codes: list[int] = []
    with Lobby(place, "toy"):
        arming = threading.Thread(target=lambda: codes.append(main(["arm", *PATIENT])))
        arming.start()
        time.sleep(0.3)
    arming.join(60.0)
    assert codes == [EXIT_FAILED]
    assert "daemon" in capsys.readouterr().err


def test_a_daemon_that_ends_in_the_middle_of_an_answer_leaves_no_connection_open(place: str, capsys: Said) -> None:
    def answer_nobody() -> None:
        peers = [door.accept()[0] for _ in range(2)]  # who looks whether it lives, and who asks
        peers[1].recv(MESSAGE_MAX)
        door.close()
        for peer in peers:
            peer.close()

    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as door:
        door.bind(place)
        door.listen()
        ending = threading.Thread(target=answer_nobody)
        ending.start()
        assert main(["arm", "--socket", place, *PATIENT]) == EXIT_FAILED  # an open socket is an error of the test
        ending.join(60.0)
    assert "daemon" in capsys.readouterr().err


def test_watching_goes_on_when_a_living_daemon_hangs_up(place: str) -> None:
    from rtctl.cli.operate import _Asker

    with ExitStack() as stack, Toy(place, lambda request: "") as toy:
        asker = stack.enter_context(closing(_Asker(place, 60.0)))
        assert asker.ask()["state"] == "IDLE"
        for peer in list(toy.console._peers.values()):  # as it does to make room for another
            with suppress(KeyError):
                toy.console._drop(peer, "idle")
        assert asker.ask()["state"] == "IDLE"
        toy.end()
        with pytest.raises(LinkError, match="the daemon has ended"):
            asker.ask()


# -- verbs -----------------------------------------------------------------------------------------------------------


def test_one_reset_is_enough_when_drives_must_clear_their_faults_first(place: str, capsys: Said) -> None:
    words = iter(["reset: drive faults are being cleared now: reset again"] * 2)
    with Toy(place, lambda request: next(words, "") if request.verb == Verb.RESET else "") as toy:
        assert main(["reset", *PATIENT]) == EXIT_OK
        assert toy.verbs == [Verb.RESET] * 3
    assert capsys.readouterr().out == "reset: IDLE\n"


@pytest.mark.parametrize(
    ("word", "told", "said"),
    [
        ("arm", {"state": "FAULT", "faults": ["drive_fault"]}, "arm: FAULT: drive_fault"),
        ("arm", {"state": "ARMED"}, "arm: ARMED still after 0.2 s"),
        ("arm", {"state": "IDLE", "vehicle": {"words": [[0.0, "PreArm: no GPS"]]}}, "arm: IDLE: PreArm: no GPS"),
        ("disarm", {"state": "STOPPING"}, "disarm: STOPPING still after 0.2 s"),
        ("disarm", {"state": "SAFE_STOP", "faults": ["contact"]}, "disarm: SAFE_STOP: contact"),
        ("stop", {"state": "SAFE_STOP", "at_rest": False}, "stop: SAFE_STOP still after 0.2 s"),
        ("reset", {"state": "FAULT", "faults": ["not_finite"]}, "reset: FAULT: not_finite"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_verb_that_does_not_come_to_its_end_says_why(
    place: str, word: str, told: dict[str, Any], said: str, capsys: Said
) -> None:
    with Toy(place, lambda request: "") as toy:
        toy.told |= told
        assert main([word, "--timeout", "0.2", *PATIENT]) == EXIT_FAILED
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"rtctl: {said}")


# -- goals while the robot arms --------------------------------------------------------------------------------------


@pytest.fixture
def queue() -> GoalQueue:
    queue = GoalQueue()
    assert queue.passed(Request(goal=GOAL), State.ARMED) == (Request(), QUEUED)
    assert queue.status()["queued"]
    return queue


def test_a_goal_waits_for_the_robot_to_run(queue: GoalQueue) -> None:
    assert queue.passed(Request(), State.ARMED) == (Request(), "")
    assert queue.passed(Request(), State.RUN) == (Request(goal=GOAL), "")
    queue.judged("goal: lies 0.100 m inside obstacle crate")
    assert queue.status() == {"queued": False, "queue_refusal": "goal: lies 0.100 m inside obstacle crate"}
    assert queue.passed(Request(), State.RUN) == (Request(), "")


def test_a_goal_that_waits_gives_way_to_stops_and_obstacles(queue: GoalQueue) -> None:
    crate = Request(obstacles=(ObstacleEdit("crate", None),))
    assert queue.passed(crate, State.RUN) == (crate, "")
    stop = Request(verb=Verb.STOP)
    assert queue.passed(stop, State.RUN) == (stop, "")
    assert queue.passed(Request(), State.SAFE_STOP) == (Request(), "")
    assert "ARMED to SAFE_STOP" in queue.status()["queue_refusal"]
    assert queue.passed(Request(), State.RUN) == (Request(), "")  # after a reset nothing moves by itself


def test_a_newer_goal_takes_the_place_of_one_that_waits(queue: GoalQueue) -> None:
    newer = GOAL._replace(tolerance=0.5)
    assert queue.passed(Request(goal=newer), State.RUN)[0].goal is newer
    assert queue.passed(Request(), State.RUN) == (Request(), "")


# -- runs of a simulation --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ({"arrived": True, "contacts": 0, "goals": [{"arrived": True}]}, ""),
        ({"arrived": False, "contacts": 0, "goals": []}, ""),
        ({"arrived": False, "contacts": 0, "goals": [{"arrived": True}, {"arrived": False}]}, "1 of 2 goals missed"),
        ({"arrived": True, "contacts": 7, "goals": [{"arrived": True}]}, "7 contacts"),
    ],
)
def test_a_simulation_fails_by_a_goal_that_was_missed_or_a_touch(result: dict[str, Any], words: str) -> None:
    assert _missed(result) == words


@pytest.mark.parametrize(("now", "taken"), [(9.9, True), (10.0, True), (10.5, False)])
def test_a_request_whose_caller_has_given_up_is_refused(now: float, taken: bool) -> None:
    message = decode(b'{"verb": "arm", "by_s": 10.0}')
    if taken:
        assert request_of(message, BOUNDS, lambda: (1.0, 0.0, 0.0, 0.0), now).verb == Verb.ARM
        return
    with pytest.raises(RequestError, match=r"too late: the caller waited until 0\.5 s ago"):
        request_of(message, BOUNDS, lambda: (1.0, 0.0, 0.0, 0.0), now)


@pytest.mark.parametrize(
    ("verb", "state", "advice"),
    [
        ("park", "IDLE", "rtctl arm comes first"),
        ("float", "IDLE", "rtctl arm comes first"),
        ("hold", "SAFE_STOP", "rtctl reset leaves it"),
        ("arm", "FAULT", "rtctl reset leaves it"),
        ("disarm", "IDLE", ""),
    ],
)
def test_who_is_refused_for_the_state_is_told_what_comes_first(
    place: str, capsys: Said, verb: str, state: str, advice: str
) -> None:
    with Toy(place, lambda request: f"{verb}: not possible in state {state}" if request.verb != Verb.NONE else ""):
        assert main([verb, *PATIENT]) == EXIT_FAILED
    said = capsys.readouterr().err
    assert f"{verb}: not possible in state {state}" in said
    assert advice in said
    assert advice or said.strip().endswith(state)


# ---- a gripper


def test_grip_waits_until_the_gripper_is_there_or_holds_something(place: str, capsys: Said):
    toy: Toy

    def closing(request: Request) -> str:
        if request.grip is not None:
            if request.grip.force > 60.0:
                return "grip: gripper: got 61 N, wanted at most 60"
            toy.told["grippers"] = [{"name": "gripper", "state": "moving", "closed": 0.2, "force_N": 0.0}]
            threading.Timer(
                0.3, lambda: toy.told["grippers"][0].update(state="gripping", closed=0.6, force_N=19.0)
            ).start()
        return ""

    with Toy(place, closing) as toy:
        toy.told["state"] = "RUN"
        assert main(["grip", "1", "--force", "20", "--socket", place, *PATIENT]) == EXIT_OK
        assert capsys.readouterr().out == "grip: gripper gripping at 0.60, 19.0 N\n"
        assert main(["grip", "1", "--force", "61", "--socket", place, *PATIENT]) == EXIT_FAILED
        assert capsys.readouterr().err == "rtctl: refused: grip: gripper: got 61 N, wanted at most 60\n"
        assert main(["grip", "2", "--socket", place, *PATIENT]) == EXIT_USAGE
        assert "grip.closed: got 2.0, wanted" in capsys.readouterr().err
