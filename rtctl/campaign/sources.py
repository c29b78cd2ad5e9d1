"""The sources of cases that rtctl brings: random scenes, and scenarios written in files."""

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from rtctl import design
from rtctl.arm.robot import Robot
from rtctl.campaign import scenes
from rtctl.campaign.case import Asked, Case, Scene, loads, options_within
from rtctl.campaign.play import simulated
from rtctl.campaign.robots import ready
from rtctl.design import Config
from rtctl.errors import ConfigError
from rtctl.plain import Json
from rtctl.spec.scenario import load_scenario, scenario_dict

ARMS = ("planar4", "puma560", "panda", "ur5", "openarm_e2e")


def numbered(source: str, asked: Asked) -> Iterator[Case]:
    """Yield the cases of a generator: for each seed, `count` scenes over all robots, robot by robot."""
    robots = asked.robots or ARMS
    for seed in asked.seeds:
        for j, robot in enumerate(robots):
            for number in range((asked.scenes - j - 1) // len(robots) + 1):
                yield Case(source, robot, "", seed, number)


@cache
def derived(name: str, path: Path) -> tuple[Robot, Config]:
    """Return a robot and its config, once a process."""
    config = design.load(path)
    return design.build(config, path), config


class Random:
    """Random scenes of `rtctl.campaign.scenes`."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        """Yield the cases."""
        options_within(asked, (), "random")
        yield from numbered("random", asked)

    def scene(self, case: Case) -> Scene:
        """Return the scene of a case."""
        path = ready(case.robot, case.plain_config).path
        robot, config = derived(case.robot, path)
        return Scene(scenes.scenario_of(robot, config, case.seed, case.number), path)

    def play(self, case: Case, scene: Scene, config: Path) -> Json:
        """Return the columns of a run."""
        return simulated(case, scene)


class Folder:
    """Scenario files: a folder's, or those that are named."""

    def cases(self, asked: Asked) -> Iterator[Case]:
        """Yield a case for each file and seed."""
        files = sorted(
            file
            for where in options_within(asked, ("files",), "folder")["files"].split("\n")
            for file in _files(Path(where))
        )
        for seed in asked.seeds:
            for number, file in enumerate(files):
                scenario = load_scenario(file)
                table = scenario_dict(scenario, file)
                body = json.dumps(
                    {"table": table | {"seed": table.get("seed", 0) + seed}, "where": str(file.resolve())}
                )
                for robot in asked.robots or (scenario.robot,):
                    yield Case("folder", robot, "", seed, number, file.stem, body=body)

    def scene(self, case: Case) -> Scene:
        """Return the scene of a case."""
        body = loads(case.body)
        return Scene(body["table"], Path(body["where"]))

    def play(self, case: Case, scene: Scene, config: Path) -> Json:
        """Return the columns of a run."""
        return simulated(case, scene)


def _files(where: Path) -> list[Path]:
    if where.is_file():
        return [where]
    files = sorted(where.glob("**/*.toml")) if where.is_dir() else []
    if not files:
        raise ConfigError(str(where), "no scenario", "a scenario file, or a folder that has some")
    return files


random, folder = Random(), Folder()
