"""`rtctl run` of a base against the rover double, as two processes over UDP in real time."""

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress

import pytest

from rtctl import cli
from rtctl.errors import EXIT_OK, RequestError
from rtctl.hal.client import demand
from rtctl.log import read
from tests.base_lab import CONFIGS, ROVER
from tests.rig import PATIENCE, until


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Pair:
    """The double and, one after another, daemons that drive it."""

    def __init__(self, folder):
        self.folder, self.console, self.report = folder, str(folder / "console" / "s"), folder / "report.json"
        text = ROVER.read_text().replace("127.0.0.1:14550", f"127.0.0.1:{free_port()}")
        text = text.replace('directory = "logs"', f'directory = "{folder / "logs"}"')
        text = text.replace("disk_floor_MB = 500.0", "disk_floor_MB = 1.0")
        self.config = folder / "rover.toml"
        self.config.write_text(text + f'\n[console]\nsocket = "{self.console}"\n')
        self.processes = []
        scenario = CONFIGS / "worlds" / "disc.toml"
        self.double = self._start("firmware_sim", self.config, "--scenario", scenario, "--report", self.report)
        assert self.double.stdout.readline().startswith("rover ready on udp")

    def _start(self, *command):
        process = subprocess.Popen([sys.executable, "-m", *map(str, command)], stdout=subprocess.PIPE, text=True)
        self.processes.append(process)
        return process

    def daemon(self):
        process = self._start("rtctl", "run", self.config)
        for line in process.stdout:
            if line.startswith("rtctl: ready"):
                return process
        raise AssertionError(process.wait())

    def ask(self, verb, **keys):
        return demand(self.console, {"verb": verb, **keys}, 5.0)

    def until(self, condition):
        until(lambda: condition(self.ask("status")), lambda: self.ask("status"))

    def running(self):
        """Bring the base to RUN as a patient operator would: in real time a busy machine makes streams stale."""

        def runs(status):
            match status["state"]:
                case "SAFE_STOP" | "FAULT":
                    self.say("reset")
                case "IDLE":
                    self.say("arm")
            return status["state"] == "RUN"

        self.until(runs)

    def under_way(self):
        """Have the base on its way at more than 1 m/s."""

        def moves(status):
            if status["state"] != "RUN":
                self.running()
            elif status["goal_m"] is None:
                self.ask("goal", position_m=[15.0, -6.0, 0.0])
            return status["speed_m_s"] > 1.0

        self.until(moves)

    def say(self, verb):
        with suppress(RequestError):  # refused: the next look shows why
            self.ask(verb)

    def goal(self, *words):
        """Give a goal by the command line until it is reached; a stop on the way is reset and begun again."""

        def reached():
            self.running()
            return cli.main(["goal", *words, "--socket", self.console, "--wait", "--json"]) == EXIT_OK

        until(reached, lambda: self.ask("status"))

    def truth(self):
        return json.loads(self.report.read_text())

    def at_rest(self):
        """Wait until the double itself stands."""
        until(lambda: abs(self.truth()["v_m_s"]) < 0.05, lambda: self.truth())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self.processes:
            process.kill()
            process.wait()
            process.stdout.close()


def test_a_base_is_armed_driven_by_metres_and_degrees_and_let_go_at_rest(tmp_path, capsys):
    with Pair(tmp_path) as pair:
        daemon = pair.daemon()
        assert not pair.truth()["armed"]
        pair.goal("3", "0.5", "0")
        pair.goal("--latlon", "-35.363262", "149.165281", "--heading", "1.5")  # 4 m east of the origin, to the north
        assert sum(json.loads(line)["arrived"] for line in capsys.readouterr().out.splitlines()) == 2
        assert abs(pair.ask("status")["x_m"][0] - 4.0) < 0.4
        assert pair.ask("status")["goal_heading_rad"] == pytest.approx(1.5)
        assert abs(pair.truth()["yaw_rad"] - 1.5) < 0.15
        assert cli.main(["goal", "1", "0", "0", "--rpy", "0", "0", "1", "--socket", pair.console]) != EXIT_OK
        assert "orientation" in capsys.readouterr().err
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(PATIENCE) == EXIT_OK
        until(lambda: not pair.truth()["armed"], pair.truth)
        pair.at_rest()
        assert (pair.truth()["contacts"], pair.truth()["aborted"]) == (0, "")
        (path,) = (tmp_path / "logs").glob("*.mcap")
        log = read(path)
        assert log.complete
        assert len(log["/mavlink/vehicle/rx"]) > 300
        assert len(log["/tick"]) == log["/tick"].array["tick"][-1] + 1


def test_a_daemon_that_is_killed_leaves_a_vehicle_that_stops_by_itself(tmp_path):
    with Pair(tmp_path) as pair:
        daemon = pair.daemon()
        pair.under_way()
        os.kill(daemon.pid, signal.SIGKILL)
        pair.at_rest()
        assert pair.truth()["contacts"] == 0
