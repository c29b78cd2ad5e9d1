"""The state of a daemon as people read it, once or live."""

import math
import time
from collections.abc import Callable, Iterable

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from rtctl.plain import Json

STATE_STYLE = {
    "RUN": "bold white on green",
    "ARMED": "bold black on yellow",
    "STOPPING": "bold black on yellow",
    "SAFE_STOP": "bold white on red",
    "FAULT": "bold white on red",
}
STATUS_STYLE = {"arrived": "bold green", "moving": "cyan", "no_goal": "dim"}
NEAR, FAR = 0.03, 0.10  # [m] clearances shown in red and in yellow below
BASE_SCALE = 10.0  # a base's clearances are that much larger
BAR = 24  # characters for FULL
FULL = 0.3  # [m]
WIDTH = 96  # columns of a status that goes into a file or pipe


def show(status: Json) -> None:
    """Print one status."""
    _console().print(render(status))


def watch(ask: Callable[[], Json], period: float) -> None:
    """Keep showing what `ask` returns, each `period` [s]; on anything but a terminal one line a second."""
    console = _console()
    if not console.is_terminal:
        while True:
            print(line(ask()), flush=True)
            time.sleep(1.0)
    with Live(render(ask()), console=console, auto_refresh=False) as live:
        while True:
            time.sleep(period)
            live.update(render(ask()), refresh=True)


def line(status: Json) -> str:
    """Return a status as one line."""
    clearances = [d for d in (status.get("clearance_m") or {}).values() if d is not None]
    nearest = f"clearance {_mm(min(clearances))}" if clearances else "no obstacle near"
    words = [
        f"{status.get('time_s') or 0.0:8.2f} s",
        f"{status.get('state', '?'):9}",
        f"{status.get('status', '?'):13}",
    ]
    words += [
        f"{'base' if 'vehicle' in status else 'tip'} {_vector(status.get('x_m'))}",
        f"error {_mm(status.get('error_m'))}",
        nearest,
    ]
    words += [str(status.get("detail") or ""), *map(str, status.get("faults") or ())]
    return "  ".join(word for word in words if word)


def render(status: Json) -> RenderableType:
    """Return a status as a panel."""
    state, name = str(status.get("state", "?")), str(status.get("status", "?"))
    head = Text.assemble(
        (f" {state} ", STATE_STYLE.get(state, "bold reverse")),
        "  ",
        (name.replace("_", " "), STATUS_STYLE.get(name, "bold yellow")),
        (f"  {status.get('detail') or ''}", "dim"),
    )
    parts: list[RenderableType] = [head, Text(), _task(status)]
    clearances = status.get("clearance_m") or {}
    if clearances:
        parts += [Text(), _clearances(clearances, BASE_SCALE if "vehicle" in status else 1.0)]
    if "vehicle" in status:
        parts += [Text(), Text(f"vehicle {_vehicle(status['vehicle'])}")]
    else:
        parts += [Text(), Text(f"joints  {_joints(status.get('q_rad') or ())} deg")]
    for gripper in status.get("grippers") or ():
        held = f"{gripper['closed']:.2f} of closed, {gripper['force_N']:.1f} N"
        parts.append(Text(f"{gripper['name']} {gripper['state']} at {held}"))
    faults = status.get("faults") or ()
    parts.append(Text(f"faults  {', '.join(map(str, faults)) or 'none'}", style="bold red" if faults else "dim"))
    log = status.get("log")
    if log:
        parts.append(Text(f"log     {_log(log)}", style="dim"))
    title = f"rtctl {status.get('robot') or ''}".rstrip()
    return Panel(Group(*parts), title=title, title_align="left", padding=(0, 1))


def _task(status: Json) -> Table:
    goal = status.get("goal_m")
    error = f"{_mm(status.get('error_m'))}, {_degrees(status.get('error_rad'))}" if goal is not None else "-"
    lateness = status.get("lateness_s")
    loop = f"{status.get('tick', '?')}, missed {status.get('missed', '?')}"
    late = "-" if lateness is None else f"{lateness * 1e6:.0f} us late"
    table = Table.grid(padding=(0, 3))
    at = f"{_vector(status.get('x_m'))} m"
    if "vehicle" in status:
        at += (
            f", heading {math.degrees(status.get('yaw_rad') or 0.0):+.0f} deg, {status.get('speed_m_s') or 0.0:.2f} m/s"
        )
    table.add_row("base" if "vehicle" in status else "tip ", at, "time", f"{status.get('time_s') or 0.0:.2f} s")
    task = status.get("task") or ""
    aim = (
        "none"
        if goal is None
        else f"{_vector(goal)} m"
        if task in ("", "position", "pose")
        else f"{task} of {_vector(goal)} m"
    )
    heading = status.get("goal_heading_rad")
    aim += "" if heading is None else f", heading {math.degrees(heading):+.0f} deg"
    table.add_row("goal", aim, "tick", loop)
    table.add_row("error", error, "wake", late)
    return table


def _vehicle(vehicle: Json) -> str:
    """Return the autopilot's state: whose it is, and how fresh what it says."""
    words = ["armed" if vehicle.get("armed") else "disarmed", "ours" if vehicle.get("ours") else "not ours to command"]
    words += [] if vehicle.get("healthy") else ["position not usable"]
    ages = (("position", "position_age_s"), ("scan", "scan_age_s"), ("heartbeat", "heartbeat_age_s"))
    words += [f"{name} {vehicle[key]:.2f} s old" for name, key in ages if vehicle.get(key) is not None]
    return ", ".join(words)


def _clearances(clearances: dict[str, float | None], scale: float = 1.0) -> Table:
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="dim")
    table.add_column("obstacle")
    table.add_column("clearance", justify="right", min_width=10)
    table.add_column("", no_wrap=True)
    nearest = sorted(clearances.items(), key=lambda item: math.inf if item[1] is None else item[1])
    for name, distance in nearest:
        if distance is None:
            table.add_row(name, "far", "")
            continue
        style = "red" if distance < NEAR * scale else "yellow" if distance < FAR * scale else "green"
        bar = "█" * round(BAR * min(max(distance, 0.0), FULL * scale) / (FULL * scale))
        table.add_row(name, Text(_mm(distance), style=style), Text(bar, style=style))
    return table


def _log(log: object) -> str:
    return "  ".join(f"{key} {value}" for key, value in log.items()) if isinstance(log, dict) else str(log)


def _vector(values: Iterable[float] | None) -> str:
    return "-" if values is None else " ".join(f"{value:+.3f}" for value in values)


def _joints(values: Iterable[float]) -> str:
    return "  ".join(f"{math.degrees(value):+.1f}" for value in values) or "-"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value * 1e3:.1f} mm"


def _degrees(value: float | None) -> str:
    return "-" if value is None else f"{math.degrees(value):.2f} deg"


def _console() -> Console:
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDTH)
