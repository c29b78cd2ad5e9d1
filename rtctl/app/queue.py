"""A goal told while the robot arms: it waits here, outside the tick, and is given to it in the first slot of RUN.

The log has the request in the tick that took it, so a replay knows nothing of the wait.
"""

from rtctl.plain import Json
from rtctl.types import Goal, Request, State, Verb

QUEUED = "queued until the robot is armed"


class GoalQueue:
    """Room for one goal: the newest."""

    def __init__(self) -> None:
        self._goal: Goal | None = None
        self._given = False  # whether the goal before the tick now came from here
        self.refusal = ""  # what became of the last goal that waited, '' while it waits and when it was taken

    def passed(self, request: Request, state: State) -> tuple[Request, str]:
        """Return what the tick gets in `state`, and the remark for a goal that was put aside, '' otherwise."""
        self._given = False
        if request.goal is not None:
            self.refusal = ""
            self._goal = request.goal if state == State.ARMED else None
            return (request._replace(goal=None), QUEUED) if state == State.ARMED else (request, "")
        if self._goal is None or state == State.ARMED:
            return request, ""
        if state != State.RUN:
            self._goal, self.refusal = None, f"goal: dropped, the robot went from ARMED to {state.name}"
        elif request.verb == Verb.NONE and not request.obstacles:
            goal, self._goal, self._given = self._goal, None, True
            return request._replace(goal=goal), ""
        return request, ""

    def judged(self, refusal: str) -> None:
        """Take the tick's word on the request of this slot: '' when nothing was refused."""
        if self._given:
            self.refusal = refusal

    def status(self) -> Json:
        """Return what `rtctl status` tells: whether a goal waits, and why the last one that did was not taken."""
        return {"queued": self._goal is not None, "queue_refusal": self.refusal}
