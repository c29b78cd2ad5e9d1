"""A source of cases for tests: brief random scenes of a small arm, each of which leaves a mark when it is played."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

from rtctl.campaign.case import Asked, Case, Scene, loads
from rtctl.campaign.play import simulated
from rtctl.campaign.sources import Random
from rtctl.plain import Json

BRIEF = 0.15  # [s]


class Marked(Random):
    """`kill`: the first worker that takes this number dies of it; `stop`: the case that waits for a file `go`;
    `fake`: nothing is simulated."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        for seed in asked.seeds:
            for number in range(asked.scenes):
                yield Case("tests.campaign_source:source", "planar4", "", seed, number, body=json.dumps(asked.options))

    def scene(self, case: Case) -> Scene:
        if "fake" in loads(case.body):
            return Scene({}, Path("scenario.toml"))
        scene = super().scene(case)
        return scene._replace(table=scene.table | {"duration_s": BRIEF})

    def play(self, case: Case, scene: Scene, config: Path) -> Json:
        options = loads(case.body)
        marks = Path(options["marks"])
        with (marks / f"{case.number}").open("a") as mark:
            mark.write("played\n")
        if options.get("kill") == str(case.number) and not (marks / "killed").exists():
            (marks / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if options.get("stop") == str(case.number) and not (marks / "go").exists():
            (marks / "stopped").touch()
            signal.pause()
        if "fake" in options:
            return {"outcome": "arrived", "arrived": True, "failures": "", "digest": case.key}
        return simulated(case, scene)


source = Marked()
