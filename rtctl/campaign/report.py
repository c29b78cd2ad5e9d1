"""A campaign as one page of HTML: rates with intervals, histograms, the worst runs with pictures and commands."""

import base64
import html
import math
import shlex
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

from matplotlib.figure import Figure

from rtctl.campaign.case import Case
from rtctl.campaign.pictures import drawn
from rtctl.campaign.rates import GROUPED, Group, groups, severity
from rtctl.errors import RtctlError
from rtctl.plain import Json

WORST = 20
BINS = 40
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 72em; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } th, td { padding: .3em .7em; text-align: left }
th { border-bottom: 2px solid #444 } td { border-bottom: 1px solid #ddd } td.n { text-align: right }
pre { background: #f3f3f3; padding: .5em; overflow-x: auto } img { max-width: 100% }
.bad { color: #b00020; font-weight: 600 } section { margin-top: 2.5em }
"""
_HEAD = (
    "runs",
    "arrived [95 %]",
    "failed [95 %]",
    "time to goal, median / p95 [s]",
    "of the certificate's, median",
    "to a first way, median / p95 [s]",
    "least clearance [mm]",
    "what held the others",
)


def text_table(rows: Sequence[Json]) -> str:
    """Return the figures by group as Markdown."""
    found = groups(rows)
    used = _used(found)
    lines = ["| " + " | ".join([*(GROUPED[i] for i in used), *_HEAD]) + " |"]
    lines.append("|" + "---|" * (len(used) + len(_HEAD)))
    lines += ["| " + " | ".join(_cells(g, used)) + " |" for g in found]
    return "\n".join(lines)


def _used(found: Sequence[Group]) -> list[int]:
    """Return which columns of the names say anything."""
    real = [g for g in found if g.name[0] != "all"] or list(found)
    used = [i for i in range(len(GROUPED)) if any(g.name[i] for g in real)]
    return used or [1]


def _cells(g: Group, used: list[int]) -> list[str]:
    name = [g.name[i] for i in used]
    if g.name[0] == "all":
        name[0] = "all"
    held = ", ".join(f"{n} {what}" for what, n in g.held) or "none"
    return [
        *name,
        str(g.arrived.of),
        str(g.arrived),
        str(g.failed),
        _pair(g.time),
        _number(g.slower),
        _pair(g.plan),
        _number(1e3 * g.clearance, 1),
        held,
    ]


def _number(value: float, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _pair(pair: tuple[float, float]) -> str:
    return f"{_number(pair[0])} / {_number(pair[1])}" if math.isfinite(pair[0]) else "-"


def page(folder: Path, about: Json, rows: Sequence[Json], cases: dict[str, Case], told: Callable[[int], None]) -> str:
    """Return the page; told: is told how many pictures are drawn.

    cases: of the worst runs, by their keys.
    """
    found = groups(rows)
    used = _used(found)
    head = "".join(f"<th>{html.escape(h)}</th>" for h in [*(GROUPED[i] for i in used), *_HEAD])
    body = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in _cells(g, used)) + "</tr>" for g in found)
    parts = [
        f"<title>Campaign {html.escape(folder.name)}</title><style>{_STYLE}</style>",
        f"<h1>Campaign {html.escape(folder.name)}</h1>",
        f"<p>{len(rows)} runs of code {about['code']}. Intervals: Wilson's score, 95 %. "
        "Clearances, contacts and arrivals are the simulator's own.</p>",
        f"<table><tr>{head}</tr>{body}</table>",
        f"<section><h2>How they are spread</h2><img alt='histograms' src='{_histograms(rows)}'></section>",
        f"<section><h2>The worst {min(WORST, len(rows))}</h2>",
    ]
    for k, row in enumerate(worst(rows)):
        parts.append(_entry(folder, row, cases.get(row["key"])))
        told(k + 1)
    return "<!doctype html><html lang='en'><meta charset='utf-8'>" + "".join(parts) + "</section></html>\n"


def worst(rows: Sequence[Json]) -> list[Json]:
    """Return the worst runs, the worst first."""
    return sorted(rows, key=severity)[:WORST]


def _entry(folder: Path, row: Json, case: Case | None) -> str:
    name = " ".join(str(row[k]) for k in ("robot", "set", "variant", "plant", "faults") if row[k])
    said = f"{row['status']} {row['diagnosis'] or ''}".strip()
    command = f"rtctl campaign play {shlex.quote(str(folder))} {row['key']}"
    facts = [
        f"outcome <b class='{'bad' if row['failures'] else ''}'>{html.escape(str(row['outcome']))}</b>",
        html.escape(row["failures"] or ""),
        f"says: {html.escape(said)}",
        f"{1e3 * (row['final_error_m'] or 0.0):.1f} mm, {row['final_error_rad'] or 0.0:.3f} rad from its goal",
        "" if row["min_clearance_m"] is None else f"least clearance {1e3 * row['min_clearance_m']:.1f} mm",
    ]
    return (
        f"<h3>{html.escape(name)}, seed {row['seed']}, {row['number']}</h3><p>{'; '.join(f for f in facts if f)}</p>"
        f"<pre>{html.escape(command)}</pre>{_picture(row, case)}"
    )


def _picture(row: Json, case: Case | None) -> str:
    if case is None:
        return "<p>No picture: this case is no more among those of the campaign.</p>"
    try:
        source, digest = drawn(case)
    except RtctlError as error:
        return f"<p>No picture: {html.escape(str(error))}</p>"
    other = row["digest"] and row["digest"] != digest and "<p class='bad'>Played again it went another way.</p>"
    return f"<img alt='the run from the side and from above' src='{source}'>{other or ''}"


def _histograms(rows: Sequence[Json]) -> str:
    shown = (
        ("time_to_goal_s", "time to goal [s]", 1.0),
        ("min_clearance_m", "least clearance [mm]", 1e3),
        ("final_error_m", "error of those that did not arrive [mm]", 1e3),
        ("told_after_s", "from standing to its diagnosis [s]", 1.0),
    )
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    for axes, (name, label, scale) in zip(figure.subplots(2, 2).flat, shown, strict=True):
        missed = name in ("final_error_m", "told_after_s")
        values = [
            scale * row[name] for row in rows if row[name] is not None and missed == (row["outcome"] != "arrived")
        ]
        axes.hist(values, bins=BINS, color="#0072B2")
        axes.set_xlabel(label)
        axes.set_ylabel("runs")
    out = BytesIO()
    figure.savefig(out, format="png", dpi=80)
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()
