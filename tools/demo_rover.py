"""A rover goes round what its range sensor sees: four worlds, each with controller and rover as two processes.

    python -m tools.demo_rover
    python -m tools.demo_rover --worlds wall u --config configs/rover_px4.toml --out /tmp/rover

Exit status 0 when every goal was reached, nothing was touched and no fault came. The table's last columns are what an
autopilot's own avoidance (ArduPilot BendyRuler, skid-steer, 2 m/s) needed in the same worlds.
"""

import argparse
import json
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from rtctl.errors import EXIT_FAILED, EXIT_OK, RtctlError
from rtctl.hal.client import Session, accepted
from rtctl.log import read
from rtctl.log.view.tlog import export_tlog
from rtctl.spec.scenario import Scenario, load_scenario

WORLDS = {"disc": (22.8, 2.47), "three": (26.5, 2.52), "wall": (25.8, 2.66), "u": (32.1, 2.57)}  # [s], [m]
WORLD_FILES = Path("configs/worlds")
READY = 180.0  # [s]: the first time compiles
INK = {"seen": "0.55", "way": "#1f77b4", "there": "0.2"}


class Run(NamedTuple):
    """What became of one world."""

    world: str
    time: float | None  # [s] to the goal
    clearance: float  # [m]
    contacts: int
    faults: list[str]
    track: np.ndarray[Any, np.dtype[np.float64]]  # (n, 5) t, x, y, yaw, v
    scenario: Scenario
    log: Path
    packets: int  # in the .tlog


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    args = _arguments(argv)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # nor does this leave rover or controller behind
    console = Console(highlight=False)
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    runs = []
    try:
        for world in args.worlds:
            console.print(f"[bold]{world}[/]: rover and controller as two processes, MAVLink 2 over UDP, real time")
            runs.append(_play(world, Path(args.config), out, console))
    except RtctlError as error:
        print(f"demo: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("demo: interrupted; both processes were ended", file=sys.stderr)
        return 130
    console.print(_table(runs))
    plot = out / "rover.png"
    draw(runs, plot)
    console.print("its: the autopilot's own avoidance in the same world\n", style="dim")
    for name, files in (("plot", [plot]), ("log", [run.log for run in runs]), ("tlogs", [out / "*.tlog"])):
        for file in files:
            console.print(f"{name:6}{file}", soft_wrap=True, highlight=False)
    fine = all(run.time is not None and not run.contacts and not run.faults for run in runs)
    reached, contacts = sum(run.time is not None for run in runs), sum(run.contacts for run in runs)
    verdict = f"{'PASS' if fine else 'FAIL'}  {reached} of {len(runs)} goals reached, {contacts} contacts"
    console.print(f"\n{verdict}", style="bold green" if fine else "bold red", highlight=False)
    return EXIT_OK if fine else EXIT_FAILED


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.demo_rover", description="A rover goes round obstacles.")
    parser.add_argument("--worlds", nargs="+", choices=tuple(WORLDS), default=tuple(WORLDS), metavar="WORLD")
    parser.add_argument("--config", default="configs/rover.toml", help="robot file (%(default)s)")
    parser.add_argument("--out", default="out/demo-rover", metavar="DIR", help="for logs and plot (%(default)s)")
    return parser.parse_args(argv)


def _play(world: str, source: Path, out: Path, console: Console) -> Run:
    """Play one world with two processes; both are ended whatever happens."""
    scenario_file = WORLD_FILES / f"{world}.toml"
    scenario = load_scenario(scenario_file)
    with tempfile.TemporaryDirectory(prefix="rtctl-demo-") as folder:
        config, report, control = Path(folder) / source.name, Path(folder) / "report.json", f"{folder}/console/s"
        config.write_text(_changed(source.read_text(encoding="utf-8"), out / "logs", control), encoding="utf-8")
        commands = [
            ["firmware_sim", str(config), "--scenario", str(scenario_file), "--report", str(report)],
            ["rtctl", "run", str(config)],
        ]
        logs = [(out / f"{world}.{name}.txt").open("w", encoding="utf-8") for name in ("rover", "rtctl")]
        processes = []
        try:
            for command, log in zip(commands, logs, strict=True):
                processes.append(subprocess.Popen([sys.executable, "-m", *command], stdout=log, stderr=log))
            with _session(control, processes[1], Path(logs[1].name)) as session:
                taken = _drive(session, scenario, console)
                status = accepted(session.ask({"verb": "status"}))
            processes[1].terminate()
            processes[1].wait(20.0)
            processes[0].terminate()
            processes[0].wait(10.0)
        finally:
            for process in processes:
                process.kill()
                process.wait()
            for log in logs:
                log.close()
        truth = json.loads(report.read_text(encoding="utf-8"))
    log_file = Path(str(status["log"]["path"]).removesuffix(".open"))
    faults = sorted({e["detail"] for e in read(log_file).events if e.get("name") == "fault"})
    packets = export_tlog(log_file, out / f"{world}.tlog")
    clearance = min(truth["min_clearance_m"].values())
    return Run(
        world, taken, clearance, truth["contacts"], faults, np.array(truth["track"]), scenario, log_file, packets
    )


def _changed(text: str, logs: Path, control: str) -> str:
    """Return a robot file with a port, log directory and control socket of this run's own."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    lines = [f'url = "udpin:127.0.0.1:{port}"' if line.startswith("url =") else line for line in text.splitlines()]
    lines = [f'directory = "{logs.resolve()}"' if line.startswith("directory =") else line for line in lines]
    return "\n".join([*lines, "", "[console]", f'socket = "{control}"', ""])


def _session(control: str, daemon: "subprocess.Popen[bytes]", text: Path) -> Session:
    """Return a session with the daemon once it is ready. Raises RtctlError with its last word."""
    until = time.monotonic() + READY
    while "rtctl: ready" not in text.read_text(encoding="utf-8"):
        if daemon.poll() is not None or time.monotonic() > until:
            raise RtctlError(f"the controller did not start: {text.read_text(encoding='utf-8').strip()[-300:]}")
        time.sleep(0.1)
    return Session(control, 5.0)


def _drive(session: Session, scenario: Scenario, console: Console) -> float | None:
    """Arm, give the goal, and return the time [s] until the status says arrived, None when it does not."""
    accepted(session.ask({"verb": "arm"}))
    while accepted(session.ask({"verb": "status"}))["state"] != "RUN":
        time.sleep(0.05)
    goal = scenario.goal[0]
    accepted(session.ask({"verb": "goal", "position_m": goal.position_m}))
    begun, said = time.monotonic(), 0.0
    while (passed := time.monotonic() - begun) < scenario.duration_s:
        status = accepted(session.ask({"verb": "status"}))
        if status["status"] == "arrived":
            return passed
        if status["state"] != "RUN":
            return None
        if passed - said >= 5.0:
            said = passed
            x, y, _ = status["x_m"]
            seen = status["clearance_m"].get("scan")
            near = f"{seen:.2f} m to what it sees" if seen is not None else "nothing near"
            console.print(
                f"  {passed:5.1f} s  at {x:+6.2f} {y:+6.2f} m, {status['speed_m_s']:.2f} m/s, "
                f"way {status['way_m'] or 0.0:.1f} m, {near}",
                style="dim",
            )
        time.sleep(0.05)
    return None


def _table(runs: Sequence[Run]) -> Table:
    """Return what fits 80 columns: times to the goal, least distances between hull and obstacle, and both of theirs."""
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim")
    for name in ("world", "time", "clearance", "contacts", "faults", "packets", "its own", "its clearance"):
        table.add_column(name, justify="left" if name in ("world", "faults") else "right")
    for run in runs:
        time_, clear = WORLDS[run.world]
        reached = f"{run.time:.1f} s" if run.time is not None else "NOT REACHED"
        table.add_row(
            run.world,
            reached,
            f"{run.clearance:.2f} m",
            str(run.contacts),
            ", ".join(run.faults) or "none",
            str(run.packets),
            f"{time_:.1f} s",
            f"{clear:.2f} m",
        )
    return table


def draw(runs: Sequence[Run], path: Path) -> None:
    """Draw where the rover went in each world, coloured by its speed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle, Rectangle

    figure, axes = plt.subplots(len(runs), 1, figsize=(9.0, 0.6 + 3.1 * len(runs)), squeeze=False, layout="constrained")
    lines = None
    for run, axis in zip(runs, axes[:, 0], strict=True):
        for o in run.scenario.obstacle:
            x, y, _ = o.position_m or (0.0, 0.0, 0.0)
            if hasattr(o, "size_m"):
                a, b, _ = o.size_m
                axis.add_patch(Rectangle((x - a / 2, y - b / 2), a, b, color=INK["seen"]))
            else:
                axis.add_patch(Circle((x, y), getattr(o, "radius_m", 0.1), color=INK["seen"]))
        t = run.track
        points = t[:, None, 1:3]
        lines = LineCollection(np.concatenate([points[:-1], points[1:]], axis=1).tolist(), array=t[:-1, 4], lw=2.5)
        lines.set_clim(0.0, 2.0)
        axis.add_collection(lines)
        goal = run.scenario.goal[0].position_m or (0.0, 0.0, 0.0)
        axis.plot(0.0, 0.0, "o", color=INK["there"], ms=6)
        axis.plot(goal[0], goal[1], "*", color="#d62728", ms=13)
        axis.axhline(0.0, color="0.85", lw=0.8, zorder=0)
        axis.set_aspect("equal")
        axis.set_xlim(-2.0, goal[0] + 2.0)
        axis.set_ylim(-10.0, 10.0)
        reached = f"{run.time:.1f} s" if run.time is not None else "not reached"
        axis.set_title(f"{run.world}: {reached}, nearest {run.clearance:.2f} m", loc="left", fontsize=11)
        axis.set_ylabel("north [m]")
    axes[-1, 0].set_xlabel("east [m]")
    if lines is not None:
        figure.colorbar(lines, ax=axes[:, 0].tolist(), label="speed [m/s]", shrink=0.5, aspect=30)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
