"""What a panel says, as HTML: state, diagnosis, faults, bars, events; and the numbers of its charts."""

import html
from collections.abc import Mapping, Sequence

import numpy as np

from rtctl.log.record.surroundings import Thing
from rtctl.types import F64
from rtctl.view.follow import Sample
from rtctl.view.moment import Moment, Reader, length

COLOURS = {"RUN": "#1b8a3c", "ARMED": "#b7791f", "STOPPING": "#b7791f", "SAFE_STOP": "#c0272d", "FAULT": "#c0272d"}
GREEN, AMBER, RED, GREY = "#1b8a3c", "#c98a12", "#c0272d", "#8a8f98"
BLUE = "#1e50a0"
STYLE = "font: 13px/1.45 system-ui, sans-serif; color: #23262b; padding: 0 12px; overflow-wrap: anywhere"
FEW = 6  # obstacles with a bar


def state_html(m: Moment, detail: str, remark: str) -> str:
    """Return state, diagnosis and faults in words."""
    colour = COLOURS.get(m.state, GREY)
    lines = [
        f'<span style="background:{colour}; color:white; font-weight:600; padding:2px 8px; border-radius:4px">'
        f"{html.escape(m.state)}</span> <span style='color:{GREY}'>{m.time:.1f} s</span>",
        f"<div style='font-size:15px; margin-top:6px'>{html.escape(m.says)}</div>",
    ]
    if detail and m.status not in ("no_goal", "moving", "arrived"):
        lines.append(f"<div>Held by: {html.escape(detail)}.</div>")
    if m.goal is not None:
        lines.append(f"<div style='color:{GREY}'>{length(m.error)} to the goal, {m.speed:.2f} m/s</div>")
    for name, text in m.faults:
        lines.append(f"<div style='color:{RED}'><b>{html.escape(name)}</b>: {html.escape(text)}</div>")
    if remark:
        lines.append(f"<div style='color:{AMBER}; font-weight:600'>{html.escape(remark)}</div>")
    return f'<div style="{STYLE}; padding-bottom:6px">{"".join(lines)}</div>'


def bars_html(m: Moment, reader: Reader, things: Mapping[str, tuple[Thing, bool]]) -> str:
    """Return clearances by obstacle and torques by joint as bars; things: `Story.things`."""
    rows = []
    for name, d in m.clearances[:FEW]:
        own = things[name][0].shape if name in things else {}
        influence = float(own.get("influence") or reader.influence)
        clearance = max(float(own.get("clearance") or reader.clearance), 1e-3)
        colour = RED if d < clearance else AMBER if d < influence else GREEN
        rows.append(_bar(name, d / (2.0 * influence), length(d), colour))
    if not m.clearances:
        rows.append(f"<div style='color:{GREY}'>No obstacle near.</div>")
    if m.torques:
        rows.append(f"<div style='color:{GREY}; margin-top:6px'>Torque, share of the joint's rated</div>")
    for name, share in m.torques:
        rows.append(_bar(name, share, f"{100 * share:.0f} %", RED if share > 0.9 else AMBER if share > 0.7 else GREEN))
    whose = "the rover's outline" if reader.is_base else "the controller's spheres"
    note = f"<div style='color:{GREY}'>Clearance by {whose}</div>"
    return f'<div style="{STYLE}; font-size:12px">{note}{"".join(rows)}</div>'


def _bar(name: str, share: float, text: str, colour: str) -> str:
    width = 100.0 * min(max(share, 0.0), 1.0)
    return (
        '<div style="display:flex; align-items:center; gap:6px; margin:2px 0">'
        '<span style="flex:0 0 38%; overflow:hidden; text-overflow:ellipsis; white-space:nowrap">'
        f"{html.escape(name)}</span>"
        '<span style="flex:1; background:#e6e8ec; border-radius:3px; height:9px">'
        f'<span style="display:block; width:{width:.0f}%; background:{colour}; border-radius:3px; height:9px"></span>'
        "</span>"
        f'<span style="flex:0 0 58px; text-align:right; font-variant-numeric:tabular-nums">{text}</span></div>'
    )


def note_html(text: str, colour: str) -> str:
    return f'<div style="{STYLE}; color:{colour}">{html.escape(text)}</div>'


def events_html(said: Sequence[tuple[float, str]]) -> str:
    rows = "".join(
        f"<div><span style='color:{GREY}'>{t:.2f} s</span> {html.escape(text)}</div>" for t, text in reversed(said)
    )
    return f'<div style="{STYLE}; font-size:12px">{rows or "None yet."}</div>'


def chart_data(chart: Sequence[Sample], is_base: bool = False) -> tuple[tuple[F64, ...], ...]:
    """Return what the two charts draw: time [s], then error and clearance [mm, of a base m]; time, speed and torque."""
    rows = np.array(list(chart) or [Sample(0.0, np.nan, np.nan, np.nan, np.nan)], np.float64)
    t = rows[:, 0]
    if is_base:
        return (t, rows[:, 1], rows[:, 2]), (t, rows[:, 3])
    return (t, 1e3 * rows[:, 1], 1e3 * rows[:, 2]), (t, rows[:, 3], rows[:, 4])
