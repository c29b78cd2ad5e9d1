"""The report's page: figures and packed series put into a template that draws them."""

import base64
import html
import json
import math
import zlib
from functools import cache
from importlib.resources import files

import numpy as np

from rtctl.log.read.fields import unit_of
from rtctl.log.read.run import Run
from rtctl.log.view.report.bins import Histogram
from rtctl.log.view.report.gather import PARTS, XYZ, Gathered, Span
from rtctl.plain import Json
from rtctl.types import F64

LEVELS = 65534  # of a packed value between a series' smallest and largest; 65535 is no number
EVENTS_MAX = 2000  # shown; a log of a fault that flickers has more
SPANS_MAX = 3000
TIP_POINTS = 1500


def page(run: Run, g: Gathered) -> str:
    """Return the page's text."""
    pack = _Pack(g)
    data = {
        "duration": g.figures["duration_s"],
        "packed": base64.b64encode(zlib.compress(pack.bytes, 9)).decode(),
        **pack.index,
        "statuses": _spans(g.statuses),
        "states": _spans(g.states),
        "faults": _spans(g.faults),
        "cuts": _spans(g.cuts),
        "plots": plots(g),
        "tip": _tip(g),
        "ways": [w._replace(ticks=[])._asdict() | {"path": _thinned(w.path)} for w in g.obstacles],
        "spectrum": _spectrum(g),
        "histograms": {"lateness": _histogram(g.lateness), "compute": _histogram(g.compute)},
        "bus": {name: [_r(t), _r(load)] for name, (t, load) in g.bus.items() if len(t)},
    }
    text = _asset("page.html")
    for key, value in {
        "title": html.escape(f"{g.header.robot} {run.path.name}"),
        "style": _asset("page.css"),
        "head": _head(run, g),
        "events": _events(g),
        "config": html.escape(g.header.config or "none attached"),
        "details": _details(run, g),
        "data": json.dumps(_finite(data), allow_nan=False, separators=(",", ":")).replace("</", "<\\/"),
        "script": _asset("page.js"),
    }.items():
        text = text.replace("{{" + key + "}}", value, 1)
    return text


def _finite(value: object) -> object:
    """Return plain values with null for what JSON has no number for."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value


@cache
def _asset(name: str) -> str:
    return (files("rtctl.log.view.report") / name).read_text(encoding="utf-8")


class _Pack:
    """All series as 16-bit numbers, one behind the other, and where each is."""

    def __init__(self, g: Gathered) -> None:
        self.index: Json = {"time": _r(g.bins.time, 5), "series": {}}
        parts = []
        for k, name in enumerate(g.bins.names):
            low, high = g.bins.series(name)
            with np.errstate(invalid="ignore"):
                a, b = float(np.nanmin(low)), float(np.nanmax(high))
            scale = (b - a) / LEVELS or 1.0
            both = np.stack([low, high])
            code = np.where(np.isnan(both), 65535, np.round((both - a) / scale)).astype("<u2")
            parts.append(np.diff(code.astype(np.int32), prepend=0, axis=1).astype("<u2").tobytes())  # packs better
            self.index["series"][name] = [k, a, scale]
        self.bytes = b"".join(parts)


def plots(g: Gathered) -> list[Json]:
    """Return the plots in order: title, unit, series [(name, label, colour index, dashed)], limits."""
    have = set(g.bins.names)
    joints = g.header.joints
    found = []

    def plot(key: str, title: str, unit: str, series: list[tuple[str, str, int, bool]], **more: object) -> None:
        mine = [s for s in series if s[0] in have]
        if mine:
            found.append({"id": key, "title": title, "unit": unit, "series": mine, **more})

    for i, axis in enumerate(XYZ):
        plot(
            f"tip-{axis}",
            f"Tip {axis} and goal",
            "m",
            [(f"x.{axis}", "tip", i, False), (f"goal.{axis}", "goal", 7, True)],
            group="Tip",
        )
    plot("error", "Distance to the goal", "m", [("error", "error", 0, False)], log=True, group="Tip")
    plot("error-rot", "Angle to the goal", "rad", [("error_rot", "angle", 1, False)], log=True, group="Tip")
    v_max = g.limits.get("v_max")
    plot(
        "speed",
        "Speed of the tip",
        "m/s",
        [("speed", "speed", 0, False)],
        lines=[] if v_max is None else v_max.tolist(),
        group="Tip",
    )
    names = [n.removeprefix("rho.") for n in g.bins.names if n.startswith("rho.")]
    plot(
        "clearance",
        "Clearance by obstacle",
        "m",
        [(f"rho.{n}", n, i, False) for i, n in enumerate(names)],
        top=0.6,
        zero=True,
        group="Obstacles",
    )
    plot(
        "force",
        "Repulsion by obstacle",
        "N",
        [(f"force.{n}", n, i, False) for i, n in enumerate(names)],
        zero=True,
        group="Obstacles",
    )
    plot(
        "parts",
        "Torque by its purpose, norm over joints",
        "Nm",
        [(f"part.{p}", p, i, False) for i, p in enumerate(PARTS)],
        zero=True,
        group="Torque",
    )
    tau_max = g.limits.get("tau_max")
    for i, joint in enumerate(joints):
        lines = [] if tau_max is None or len(tau_max) <= i else [float(tau_max[i]), -float(tau_max[i])]
        series = [(f"tau_measured.{joint}", "measured", 7, False), (f"tau_sent.{joint}", "sent", i, False)]
        plot(f"tau-{i}", f"Torque of {joint}", "Nm", series, lines=lines, group="Torque", small=True)

    def each(field: str) -> list[tuple[str, str, int, bool]]:
        return [(f"{field}.{joint}", joint, i, False) for i, joint in enumerate(joints)]

    plot("q", "Joint positions", "rad", each("q"), group="Joints")
    plot("qd", "Joint speeds", "rad/s", each("qd"), group="Joints")
    plot("margin", "Margin to the joint limits", "rad", each("margin"), zero=True, group="Joints")
    plot(
        "sigma",
        "Mobility of the worst direction, smallest eigenvalue of J A⁻¹ Jᵀ",
        unit_of("sigma_min"),
        [("sigma_min", "sigma", 0, False)],
        log=True,
        group="Health",
    )
    plot(
        "innovation",
        "Innovation of the estimator",
        "sigma",
        [("innovation", "innovation", 0, False)],
        zero=True,
        group="Health",
    )
    plot(
        "late",
        "Lateness of wake-ups and time of a turn",
        "s",
        [("lateness", "lateness", 3, False), ("compute", "turn", 0, False)],
        zero=True,
        group="Health",
    )
    plot("age", "Age of the oldest reply", "s", [("age", "age", 0, False)], zero=True, group="Health")
    plot("missed", "Slots missed", "", [("missed", "missed", 3, False)], zero=True, group="Health")
    return found


def _r(values: F64, digits: int = 6) -> list[float | None]:
    return [float(f"{v:.{digits}g}") if math.isfinite(v) else None for v in values.tolist()]


def _spans(spans: list[Span]) -> list[list[float | str]]:
    return [[round(s.start, 4), round(s.stop, 4), s.name] for s in spans[:SPANS_MAX]]


def _thinned(path: list[list[float]], most: int = 200) -> list[list[float]]:
    step = max(1, len(path) // most)
    return path[::step] + ([path[-1]] if (len(path) - 1) % step else [])


def _tip(g: Gathered) -> Json:
    if not {"x.x", "x.y", "x.z"} <= set(g.bins.names):
        return {"path": [], "goals": []}
    step = max(1, len(g.bins.time) // TIP_POINTS)
    path = np.stack([np.mean(g.bins.series(f"x.{a}"), axis=0) for a in XYZ], axis=1)[::step]
    rows = [
        [round(t, 3), *(round(v, 4) for v in p)]
        for t, p in zip(g.bins.time[::step].tolist(), path.tolist(), strict=True)
    ]
    return {"path": [r for r in rows if all(math.isfinite(v) for v in r)], "goals": g.goals[:200]}


def _spectrum(g: Gathered) -> Json:
    if not g.spectrum.blocks:
        return {}
    rows = {joint: _r(a[1:], 4) for joint, a in zip(g.header.joints, g.spectrum.amplitude, strict=True)}
    return {"f": _r(g.spectrum.frequency[1:], 5), "rows": rows}


def _histogram(h: Histogram) -> Json:
    return {"edges": _r(h.edges, 4), "counts": h.counts.tolist()}


# ---- the parts that need no script


def reached(g: Gathered) -> int:
    """Return how many of the goals that were asked for were reached before the next one was asked."""
    starts = [span.start for span in g.statuses if span.name == "arrived"]
    until = [*g.asked[1:], np.inf]
    return sum(any(a <= t < b for t in starts) for a, b in zip(g.asked, until, strict=False))


def _head(run: Run, g: Gathered) -> str:
    f = g.figures
    sentinel = run.sentinel
    dropped = sum(d.get("count", 0) for d in run.dropouts if isinstance(d.get("count", 0), int))
    ended = str(sentinel.get("reason", "")) or "cut off: nothing says why"
    faults = sorted({s.name for s in g.faults})
    near = f["smallest_clearance_m"]
    lockstep = g.lateness.largest == 0.0
    missed = "no deadlines: lockstep" if lockstep else str(f["missed"])
    rows = [
        ("Duration", f"{f['duration_s']:.2f} s, {f['ticks']} ticks", False),
        ("Ended", ended, not sentinel),
        ("Faults", ", ".join(faults) or "none", bool(faults)),
        ("Dropouts", f"{dropped} entries" if dropped else "none", bool(dropped)),
        ("Slots missed", missed, f["missed"] > 0),
        ("Goals reached", f"{reached(g)} of {len(g.asked)}", False),
        ("Path of the tip", f"{f['path_m']:.2f} m", False),
        ("Top speed", f"{f['top_speed_m_s']:.3f} m/s", False),
        ("Clearance by spheres", "-" if near is None else f"{near * 1e3:.1f} mm", near is not None and near <= 0.0),
        ("Largest torque", f"{f['largest_torque_Nm']:.1f} Nm", False),
        ("Final error", f"{f['final_error_m'] * 1e3:.2f} mm", False),
        ("Turn, p99 / largest", f"{g.compute.quantile(0.99) * 1e6:.0f} / {g.compute.largest * 1e6:.0f} µs", False),
    ]
    cells = "".join(
        f'<div class="figure{" bad" if bad else ""}"><dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd></div>'
        for k, v, bad in rows
    )
    title = f"<h1>{html.escape(g.header.robot)}</h1><p class='file'>{html.escape(run.path.name)}</p>"
    return f"{title}<dl class='figures'>{cells}</dl>"


def _events(g: Gathered) -> str:
    rows = "".join(
        f'<tr class="{html.escape(name) if name in ("fault", "rejected", "state") else ""}" data-t="{t:.4f}">'
        f"<td>{t:.3f}</td><td>{html.escape(name.replace('_', ' '))}</td><td>{html.escape(detail)}</td></tr>"
        for t, name, detail in g.events[:EVENTS_MAX]
    )
    more = f"<p>{len(g.events) - EVENTS_MAX} more are in the log.</p>" if len(g.events) > EVENTS_MAX else ""
    return f"<table><thead><tr><th>s</th><th>what</th><th>detail</th></tr></thead><tbody>{rows}</tbody></table>{more}"


def _details(run: Run, g: Gathered) -> str:
    h = g.header
    rows = {
        "files": ", ".join(log.path.name for log in run.logs),
        "size": f"{run.size / 1e6:.2f} MB",
        "joints": ", ".join(h.joints),
        "servo": f"{1.0 / h.period:g} Hz",
        "config": h.config_sha256,
        "revision": h.revision or "-",
        **h.versions,
        **{name: value for name, value in h.extra.items() if name != "q_handshake"},
        **{name: str(count) + " messages" for name, count in ((t, run.count(t)) for t in run.topics) if count},
    }
    cells = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in rows.items())
    return f"<table>{cells}</table>"
