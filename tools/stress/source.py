"""The stress set as a source of `rtctl campaign`: random scenes, watched and judged by pybullet.

rtctl campaign run tools.stress.source --robots panda --count 20 --out out/stress
"""

from collections.abc import Iterator
from pathlib import Path

from rtctl.campaign.case import Asked, Case, Scene, options_within
from rtctl.campaign.sources import Random, numbered
from rtctl.plain import Json
from tools.stress.judge import failures
from tools.stress.play import Seen, play, robot_at


class Stress(Random):
    """Random scenes, each run judged by the criteria of `judge`."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        """Yield the cases: for each seed, `--count` scenes over all robots."""
        options_within(asked, (), "tools.stress.source")
        yield from numbered("tools.stress.source", asked)

    def play(self, case: Case, scene: Scene, config: Path) -> Json:
        """Return the columns of a run."""
        seen = play(scene.table | {"robot": Path(case.robot).stem}, case.number, config)
        return columns(seen, failures(robot_at(config)[0], seen))


def columns(seen: Seen, broken: list[str]) -> Json:
    """Return what was seen of a run as the columns of its row."""
    return {
        "outcome": outcome(seen),
        "arrived": seen.arrived,
        "failures": "; ".join(broken),
        "status": seen.status,
        "diagnosis": seen.detail,
        "duration_s": seen.duration,
        "time_to_goal_s": seen.time_to_goal if seen.arrived else None,
        "final_error_m": seen.error,
        "min_clearance_m": seen.clearance,
        "min_self_clearance_m": seen.own,
        "min_joint_margin_rad": seen.margin,
        "max_torque_ratio": seen.torque,
        "max_torque_rate_ratio": seen.rate,
        "max_joint_speed_ratio": seen.joint_speed,
        "contacts": 0 if seen.contact is None else 1,
        "finite": seen.finite,
        "faults_seen": ", ".join(seen.faults),
        "digest": seen.digest,
    }


def outcome(seen: Seen) -> str:
    """Return one word for the end of a run."""
    if seen.contact is not None:
        return "contact"
    if seen.arrived:
        return "arrived"
    return "stopped" if seen.stopped else seen.status


source = Stress()
