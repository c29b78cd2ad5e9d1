"""A scenario played to a running controller, over its control socket, and told while it happens."""

import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from rtctl.hal.client import Session, accepted
from rtctl.spec.scenario import Scenario, TimedGoal
from tools.outcome import Given
from tools.pair import POLL, DemoError

GOAL_KEYS = ("position_m", "axes", "wxyz", "rpy_rad", "hold", "direction", "tool_axis", "tolerance_m", "tolerance_rad")
STUCK_S = 60.0  # [s] of wall time in which the controller's must go on
RESET_S = 0.5  # [s] from a reset to the next attempt to arm
PROGRESS = 1.0  # [s] of the scenario between two lines
WAKING = ("IDLE", "ARMED")
EVENT = re.compile(r"^ *(\d+\.\d+) s  (\w+)(?:: (.*))?$")  # a line of the controller's about what happened

Say = Callable[[str, str], None]  # style, text


class Played(NamedTuple):
    """How a scenario went: slots are those of the controller's grid."""

    began: int  # the arm was told to wake: the scenario's 0
    given: list[Given]
    end: int  # the last goal's time is over
    ended: str  # why it was over early, '' when it was not
    log: str


def play(
    console: str, scenario: Scenario, say: Say, events: Callable[[], Sequence[str]] = tuple, deadlines: bool = True
) -> Played:
    """Arm the controller behind the control socket `console`, put the scenario's goals to it at their times, disarm.

    A scenario's time is the controller's since it was told to arm; that is when the drives' obstacles begin to move.
    `say` takes (style, text) lines; `events` returns the lines that the controller has printed since the last call;
    `deadlines`: how many slots were missed is told.
    Raises RtctlError when the controller does not arm, stops answering or its time stands still.
    """
    with Session(console, STUCK_S) as session:
        return _Player(session, scenario, say, events, deadlines).play()


class _Player:
    """Owns nothing; remembers where in the scenario it is."""

    def __init__(
        self,
        session: Session,
        scenario: Scenario,
        say: Say,
        events: Callable[[], Sequence[str]],
        deadlines: bool = True,
    ) -> None:
        self.session, self.scenario, self.say, self.events = session, scenario, say, events
        self.deadlines = deadlines
        self.pending = list(enumerate(scenario.goal, start=1))
        self.given: list[Given] = []
        self.period = 0.0  # [s]
        self.began = 0  # slot
        self.skipped = 0  # slots missed before it
        self.arrived = False  # at the goal in force
        self.faults: Counter[str] = Counter()
        self.moved = (-1, time.monotonic())  # slot, and when it was new

    def play(self) -> Played:
        """Return how it went."""
        status = self.look()
        while status["tick"] < 1:
            time.sleep(POLL)
            status = self.look()
        self.period = status["time_s"] / status["tick"]
        self.skipped = status["missed"]
        self.began = self.arm()
        shown, ended = -PROGRESS, ""
        while True:
            status = self.look()
            now = self.now(status)
            if status["state"] not in (*WAKING, "RUN"):
                ended = ", ".join([status["state"], *status["faults"]])
                break
            if now >= shown + PROGRESS:
                self.progress(now, status)
                shown = now
            if self.pending and now >= self.pending[0][1].at_s and status["state"] == "RUN":
                self.put(*self.pending.pop(0))
            if now >= self.scenario.duration_s:
                break
            time.sleep(POLL)
        end = self.slot(status)
        if not ended:
            accepted(self.session.ask({"verb": "disarm"}))
            self.reach("IDLE")
        for detail, count in self.faults.items():
            if count > 1:
                self.say("aside", f"{count} times: fault: {detail}")
        return Played(self.began, self.given, end, ended, status["log"]["path"])

    def arm(self) -> int:
        """Wake the arm; return the slot. A fault that was latched while nothing moved is reset once.

        Raises RequestError with the controller's reason.
        """
        reply = self.session.ask({"verb": "arm"})
        if not reply.get("ok"):
            self.say("aside", f"refused: {reply.get('error')}; resetting")
            self.session.ask({"verb": "reset"})
            time.sleep(RESET_S)
            reply = self.session.ask({"verb": "arm"})
        return int(accepted(reply)["slot"])

    def look(self) -> dict[str, Any]:
        """Return the status, after telling what has happened until then."""
        status = accepted(self.session.ask({"verb": "status"}))
        slot = self.slot(status)
        if slot != self.moved[0]:
            self.moved = (slot, time.monotonic())
        elif time.monotonic() - self.moved[1] > STUCK_S:
            raise DemoError(f"the controller's time has stood still for {STUCK_S:g} s")
        for line in self.events():
            self.tell(line)
        return status

    def slot(self, status: Mapping[str, Any]) -> int:
        """Return the slot of the grid that a status was made in."""
        return int(status["tick"]) + int(status["missed"])

    def now(self, status: Mapping[str, Any]) -> float:
        """Return the scenario's time [s] of a status."""
        return (self.slot(status) - self.began) * self.period

    def reach(self, state: str) -> None:
        """Wait for a state, or for one that it cannot be reached from."""
        while True:
            status = self.look()
            if status["state"] in (state, "SAFE_STOP", "FAULT"):
                return
            time.sleep(POLL)

    def put(self, number: int, goal: TimedGoal) -> None:
        """Put a goal to the controller."""
        message: dict[str, Any] = {"verb": "goal"}
        place = goal.position_m or (0.0, 0.0, 0.0)
        for key in GOAL_KEYS:
            value = getattr(goal, key)
            if value is not None:
                message[key] = list(value) if isinstance(value, tuple) else value
        status = self.look()
        reply = self.session.ask(message)
        refusal = "" if reply.get("ok") else str(reply.get("error", "without a reason"))
        slot = int(reply.get("slot", self.slot(status)))
        self.given.append(Given(number, place, slot, refusal))
        where = ", ".join(f"{c:.3g}" for c in place)
        text = f"goal {number} of {len(self.scenario.goal)}: ({where}) m{_manner(goal)}"
        text += f" refused: {refusal}" if refusal else ""
        self.line((slot - self.began) * self.period, "fault" if refusal else "goal", text)
        self.arrived = self.arrived and bool(refusal)

    def tell(self, line: str) -> None:
        """Say what a line of the controller's says."""
        found = EVENT.match(line)
        if not found:
            if line.strip():
                self.say("state", line.rstrip())
            return
        at, name, detail = float(found[1]) - self.began * self.period, found[2], found[3] or ""
        number = next((g.number for g in reversed(self.given) if not g.refusal), 0)
        match name:
            case "state":
                self.line(at, "fault" if detail in ("SAFE_STOP", "FAULT") else "state", f"state {detail}")
            case "arrived":
                self.arrived = True
                self.line(at, "arrived", f"goal {number}: arrived")
            case "moving":
                if self.arrived:
                    self.line(at, "aside", f"goal {number}: gives way to an obstacle")
                self.arrived = False
            case "rejected":
                pass  # said where it was asked for
            case "fault":
                self.faults[detail] += 1
                if self.faults[detail] == 1:  # a late machine repeats itself; how often is told at the end
                    self.line(at, "fault", f"fault: {detail}")
            case _:
                self.line(at, "aside", f"goal {number}: {name.replace('_', ' ')}{detail and ' '}{detail}")

    def line(self, at: float, style: str, text: str) -> None:
        """Say one line with its time [s]."""
        self.say(style, f"{at:7.2f} s  {text}")

    def progress(self, now: float, status: Mapping[str, Any]) -> None:
        """Say how things stand."""
        number = next((str(g.number) for g in reversed(self.given) if not g.refusal), "-")
        error = status["error_m"]
        away = "        -" if error is None else f"{error * 1e3:6.1f} mm"
        near = min(status["clearance_m"].items(), key=lambda item: item[1], default=None)
        nearest = "-" if near is None else f"{near[1] * 1e3:4.0f} mm {near[0]}"
        missed = f"  missed {status['missed'] - self.skipped:4}" if self.deadlines else ""
        self.say(
            "",
            f"{now:7.2f} s  {status['state']:8}  goal {number:>2}  error {away}  "
            f"speed {status['speed_m_s']:.2f} m/s{missed}  nearest {nearest}",
        )


def _manner(goal: TimedGoal) -> str:
    """Return what a goal asks of the orientation."""
    if goal.hold:
        return ", orientation kept"
    return ", with an orientation" if goal.wxyz is not None or goal.rpy_rad is not None else ""
