"""The outcome of a simulated scenario as people read it."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rtctl.plain import Json

WIDTH = 96  # columns of a summary that goes into a file or pipe
STATUSES_SHOWN = 24
# key of the result, words, factor, unit, digits
FIGURES = (
    ("path_length_m", "path of the tip", 1.0, "m", 3),
    ("line_deviation_m", "off the straight line", 1e3, "mm", 2),
    ("max_speed_m_s", "top speed", 1.0, "m/s", 3),
    ("min_self_clearance_m", "clearance of the arm to itself", 1e3, "mm", 1),
    ("min_joint_margin_rad", "margin to a joint limit", 1.0, "rad", 3),
    ("max_torque_ratio", "torque, of the limit", 100.0, "%", 0),
    ("max_torque_rate_ratio", "torque rate, of the limit", 100.0, "%", 0),
    ("max_joint_speed_ratio", "joint speed, of the limit", 100.0, "%", 0),
)


def show(result: Json, scenario: str, log: str) -> None:
    """Print the tables of a result of `simulate`."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=WIDTH)
    console.print(_headline(result, scenario))
    for table in (_goals(result), _clearances(result), _figures(result), _statuses(result)):
        if table.row_count:
            console.print()
            console.print(table)
    console.print()
    factor = result.get("realtime_factor")
    pace = "" if factor is None else f", {factor:.1f} x real time"
    console.print(f"{result.get('ticks', 0)} ticks, {result.get('missed', 0)} missed{pace}", style="dim")
    console.print(f"digest {result.get('digest', '-')}", style="dim", soft_wrap=True)
    if log:
        console.print(f"log {log}", style="dim", soft_wrap=True)


def _headline(result: Json, scenario: str) -> Text:
    arrived, contacts = bool(result.get("arrived")), int(result.get("contacts") or 0)
    faults = result.get("faults") or ()
    return Text.assemble(
        (scenario, "bold"),
        ":  ",
        ("arrived", "bold green") if arrived else ("NOT ARRIVED", "bold red"),
        ",  ",
        (f"{contacts} contacts", "bold red" if contacts else "green"),
        f",  ends in {result.get('mode_final', '?')},  ",
        (f"faults: {', '.join(map(str, faults))}", "bold red") if faults else ("no faults", "green"),
    )


def _table(*columns: str) -> Table:
    table = Table(box=None, padding=(0, 2), pad_edge=False, header_style="dim")
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i == 0 else "right")
    return table


def _goals(result: Json) -> Table:
    table = _table("goal at", "reached after", "error", "rotation", "off the line")
    rows = result.get("goals") or ()
    if not rows and result.get("final_error_m") is not None:
        rows = [
            {**result, "at_s": None, "error_m": result["final_error_m"], "error_rad": result.get("final_error_rad")}
        ]
    for row in rows:
        table.add_row(
            _figure(row.get("at_s"), 1.0, "s", 2),
            _figure(row.get("time_to_goal_s"), 1.0, "s", 2) if row.get("arrived") else Text("not reached", style="red"),
            _figure(row.get("error_m"), 1e3, "mm", 2),
            _figure(row.get("error_rad"), 1.0, "rad", 4),
            _figure(row.get("line_deviation_m"), 1e3, "mm", 2),
        )
    return table


def _clearances(result: Json) -> Table:
    table = _table("obstacle", "smallest clearance, by the simulator")
    found = result.get("min_clearance_m") or {}
    for name, distance in found.items():
        if name != "all":
            touched = distance is not None and distance <= 0.0
            table.add_row(name, Text(_figure(distance, 1e3, "mm", 1), style="bold red" if touched else ""))
    return table


def _figures(result: Json) -> Table:
    table = _table("over the run", "")
    for key, words, factor, unit, digits in FIGURES:
        if key in result:
            table.add_row(words, _figure(result[key], factor, unit, digits))
    return table


def _statuses(result: Json) -> Table:
    table = Table(box=None, padding=(0, 2), pad_edge=False, header_style="dim")
    table.add_column("at", justify="right")
    table.add_column("status")
    table.add_column("")
    statuses = result.get("statuses") or ()
    for at, name, detail in statuses[:STATUSES_SHOWN]:
        table.add_row(_figure(at, 1.0, "s", 2), str(name), str(detail or ""))
    if len(statuses) > STATUSES_SHOWN:
        table.add_row("", f"and {len(statuses) - STATUSES_SHOWN} more", "")
    return table


def _figure(value: float | None, factor: float, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value * factor:.{digits}f} {unit}"
