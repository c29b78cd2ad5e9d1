"""The part of a page with words, buttons, bars and charts."""

import html
from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from rtctl.types import F64
from rtctl.view.follow import Recorded, Sample, Story
from rtctl.view.moment import Moment, Reader
from rtctl.view.operator import Answer, Operator, beside
from rtctl.view.stage import Handles, Shown, Stage

COLOURS = {"RUN": "#1b8a3c", "ARMED": "#b7791f", "STOPPING": "#b7791f", "SAFE_STOP": "#c0272d", "FAULT": "#c0272d"}
GREEN, AMBER, RED, GREY = "#1b8a3c", "#c98a12", "#c0272d", "#8a8f98"
WARNING = (
    "<b>Not an emergency stop.</b> Stop here goes through this browser, the network and the daemon. "
    "Keep the hardware emergency stop in reach."
)
STYLE = "font: 13px/1.45 system-ui, sans-serif; color: #23262b; padding: 0 2px; overflow-wrap: anywhere"
FEW = 6  # obstacles with a bar
SIZES = {"sphere": 0.05, "box": 0.06}  # [m] radius and half side of what a page adds


class Panel:
    """Shows a story, and asks the operator's questions."""

    def __init__(
        self, server: viser.ViserServer, stage: Stage, operator: Operator, story: Story, record: Recorded | None = None
    ) -> None:
        self.gui, self.stage, self.operator, self.reader, self.record = (
            server.gui,
            stage,
            operator,
            story.reader,
            record,
        )
        self._story = story
        self._own: dict[str, tuple[str, float]] = {}  # obstacles of this page: type and size
        self._told: dict[str, float] = {}  # when a place that is dragged was last sent [s]
        self.handles = Handles(server, self.reader.is_base, self._dragged)
        self._texts: dict[str, str] = {}
        self.gui.set_panel_label(f"rtctl {story.header.robot}")
        self.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(30, 80, 160))
        self._state = self.gui.add_html("")
        if record is None:
            self._operate()
        else:
            self._playback(record)
        with self.gui.add_folder("Clearance and torque", expand_by_default=True):
            self._bars = self.gui.add_html("")
        with self.gui.add_folder("Last 30 s", expand_by_default=True):
            self._charts = _charts(self.gui, self.reader)
        self._choices()
        with self.gui.add_folder("Events", expand_by_default=False):
            self._events = self.gui.add_html("")

    # -- what people do ------------------------------------------------------------------------------------------

    def _operate(self) -> None:
        gui, operator = self.gui, self.operator
        stop = gui.add_button("Stop", color="red", hint="Brake now and stay stopped. Needs no unlocking.")
        stop.on_click(lambda event: self._say(event.client, operator.verb("stop")))
        gui.add_html(f'<div style="{STYLE}; color:#6b2b2b; font-size:12px">{WARNING}</div>')
        with gui.add_folder("Operate", expand_by_default=True):
            self._lock = gui.add_checkbox(
                "Unlock", False, hint="Read-only until this is set. For all who see this page."
            )
            self._lock.on_update(lambda event: self._unlock(bool(self._lock.value)))
            self._verbs = gui.add_button_group("", ("Arm", "Hold", "Disarm", "Reset"), visible=False)
            self._verbs.on_click(lambda event: self._say(event.client, self._verb(str(self._verbs.value))))
            self._keeps = gui.add_checkbox(
                "Keep orientation", False, hint="A goal by hand keeps the tip's orientation."
            )
            self._keeps.visible = False
            self._adds = gui.add_button_group("Obstacle", ("+ Sphere", "+ Box", "Clear"), visible=False)
            self._adds.on_click(lambda event: self._say(event.client, self._obstacle(str(self._adds.value))))
            self._answer = gui.add_html("")

    def _unlock(self, wanted: bool) -> None:
        self.operator.unlocked = wanted
        self._verbs.visible = self._adds.visible = wanted
        self._keeps.visible = wanted and not self.reader.is_base
        m = self._story.moment
        if wanted and m is not None:
            self.handles.put("goal", m.place if m.goal is None else m.goal)
            for name in self._own:
                thing = self._story.things.get(name)
                if thing is not None:
                    self.handles.put(name, np.array(thing[0].shape["position"]))
        else:
            for name in self.handles.names():
                self.handles.remove(name)
        self.put("_answer", _note("Drag the arrows at the goal." if wanted else "Read-only.", GREY))

    def lock(self) -> None:
        """Lock the page: nobody looks any more."""
        if self.operator.unlocked:
            self._lock.value = False  # type: ignore[misc] # viser's own property, which mypy does not follow
            self._unlock(False)

    def _verb(self, name: str) -> Answer:
        m = self._story.moment
        if name != "Hold":
            return self.operator.verb(name.lower())
        return self.operator.hold(m.place, self.reader.is_base) if m is not None else Answer(False, "nothing seen yet")

    def _obstacle(self, what: str) -> Answer:
        m = self._story.moment
        if m is None:
            return Answer(False, "nothing seen yet")
        if what == "Clear":
            answer = Answer(True, "no obstacle of this page is there")
            for name in list(self._own):
                answer = self.operator.clear(name)
                if answer.ok:
                    self.handles.remove(name)
                    del self._own[name]
            return answer
        kind, name = what.removeprefix("+ ").lower(), self.operator.new_name()
        place = beside(m.place, m.heading if self.reader.is_base else None)
        size = SIZES[kind] * (4.0 if self.reader.is_base else 1.0)
        answer = self.operator.obstacle(name, kind, size, place)
        if answer.ok:
            self._own[name] = (kind, size)
            self.handles.put(name, place)
        return answer

    def _dragged(self, name: str, place: F64, ended: bool) -> None:
        """Send where something was dragged to: an obstacle on its way, too, a goal at the end."""
        m = self._story.moment
        now = m.time if m is not None else 0.0
        if name == "goal":
            if ended:
                self._show(self.operator.goal(place, bool(self._keeps.value) and not self.reader.is_base))
            return
        if name in self._own and (ended or abs(now - self._told.get(name, -1e9)) >= 0.2):
            self._told[name] = now
            self._show(self.operator.obstacle(name, *self._own[name], place))

    def _say(self, client: viser.ClientHandle | None, answer: Answer) -> None:
        self._show(answer)
        if client is not None and not answer.ok:
            client.add_notification("Refused", answer.text, auto_close_seconds=8.0, color="red")

    def _show(self, answer: Answer) -> None:
        self.put("_answer", _note(answer.text, GREEN if answer.ok else RED))

    def _playback(self, record: Recorded) -> None:
        first, last = record.span
        self._playing = True
        with self.gui.add_folder("Time", expand_by_default=True):
            self._slider = self.gui.add_slider("t [s]", first, max(last, first + 0.01), 0.01, first)
            self._slider.on_update(lambda event: record.seek(float(self._slider.value)) if event.client else None)
            play = self.gui.add_button_group("", ("Play", "Pause", "Start"))
            self._speed = self.gui.add_dropdown("Speed", ("0.1", "0.25", "1", "4"), initial_value="1")

            @play.on_click
            def _(event: object) -> None:
                self._playing = play.value != "Pause"
                if play.value == "Start":
                    record.seek(first)

    def play(self, elapsed: float) -> None:
        """Go on in a log by what has elapsed [s]."""
        if self.record is None or not self._playing:
            return
        self.record.seek(self.record.at + elapsed * float(self._speed.value))

    def _choices(self) -> None:
        with self.gui.add_folder("Show", expand_by_default=False):
            start = self.stage.shown
            boxes = {
                "meshes": self.gui.add_checkbox("Robot", start.meshes),
                "spheres": self.gui.add_checkbox("Protected spheres", start.spheres),
                "influence": self.gui.add_checkbox("Influence of obstacles", start.influence),
                "forces": self.gui.add_checkbox("Forces", start.forces),
                "trail": self.gui.add_checkbox("Ways", start.trail),
            }
            for box in boxes.values():
                box.on_update(lambda event: self.stage.choose(Shown(**{k: bool(b.value) for k, b in boxes.items()})))

    # -- what people read ----------------------------------------------------------------------------------------

    def put(self, name: str, text: str) -> None:
        """Set the text of a part, unless it is there already."""
        if self._texts.get(name) != text:
            self._texts[name] = text
            getattr(self, name).content = text

    def show(self, story: Story, remark: str) -> None:
        """Show a story; remark: what is to be said beside it."""
        self._story, m = story, story.moment
        if m is None:
            self.put("_state", _note(remark or "Waiting for the first tick.", AMBER))
            return
        self.put("_state", state_html(m, story.detail, remark))
        self.put("_bars", bars_html(m, self.reader))
        self.put("_events", _events_html(story.said))
        if self.record is not None:
            self._slider.value = round(float(self.record.at), 2)  # type: ignore[misc]
        elif self.operator.unlocked and m.goal is not None:
            self.handles.put("goal", m.goal)
        for chart, data in zip(self._charts, chart_data(story.chart), strict=True):
            chart.data = data


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
        lines.append(f"<div style='color:{GREY}'>{1e3 * m.error:.1f} mm to the goal, {m.speed:.2f} m/s</div>")
    for name, text in m.faults:
        lines.append(f"<div style='color:{RED}'><b>{html.escape(name)}</b>: {html.escape(text)}</div>")
    if remark:
        lines.append(f"<div style='color:{AMBER}; font-weight:600'>{html.escape(remark)}</div>")
    return f'<div style="{STYLE}; padding-bottom:6px">{"".join(lines)}</div>'


def bars_html(m: Moment, reader: Reader) -> str:
    """Return clearances by obstacle and torques by joint as bars."""
    full, near = 2.0 * reader.influence, max(reader.clearance, 1e-3)
    rows = []
    for name, d in m.clearances[:FEW]:
        colour = RED if d < near else AMBER if d < reader.influence else GREEN
        rows.append(_bar(name, d / full, f"{1e3 * d:.0f} mm", colour))
    if not m.clearances:
        rows.append(f"<div style='color:{GREY}'>No obstacle near.</div>")
    if m.torques:
        rows.append(f"<div style='color:{GREY}; margin-top:6px'>Torque, share of the joint's rated</div>")
    for name, share in m.torques:
        rows.append(_bar(name, share, f"{100 * share:.0f} %", RED if share > 0.9 else AMBER if share > 0.7 else GREEN))
    note = f"<div style='color:{GREY}'>Clearance by the controller's spheres</div>"
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


def _note(text: str, colour: str) -> str:
    return f'<div style="{STYLE}; color:{colour}">{html.escape(text)}</div>'


def _events_html(said: Sequence[tuple[float, str]]) -> str:
    rows = "".join(
        f"<div><span style='color:{GREY}'>{t:.2f} s</span> {html.escape(text)}</div>" for t, text in reversed(said)
    )
    return f'<div style="{STYLE}; font-size:12px">{rows or "None yet."}</div>'


def chart_data(chart: Sequence[Sample]) -> tuple[tuple[F64, ...], ...]:
    """Return what the two charts draw: time [s], then error and clearance [mm]; time, then speed and torque."""
    rows = np.array(list(chart) or [Sample(0.0, np.nan, np.nan, np.nan, np.nan)], np.float64)
    t = rows[:, 0]
    return (t, 1e3 * rows[:, 1], 1e3 * rows[:, 2]), (t, rows[:, 3], rows[:, 4])


def _charts(gui: viser.GuiApi, reader: Reader) -> tuple[viser.GuiUplotHandle, ...]:
    first, second = chart_data(())
    reach = 2e3 * reader.influence
    return (
        gui.add_uplot(
            first,
            (
                uplot.Series(label="t [s]"),
                uplot.Series(label="to goal [mm]", stroke="#1e50a0", width=1.5),
                uplot.Series(label="clearance [mm]", stroke="#c98a12", width=1.5),
            ),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, reach))},
            height=150,
        ),
        gui.add_uplot(
            second,
            (
                uplot.Series(label="t [s]"),
                uplot.Series(label="speed [m/s]", stroke="#1b8a3c", width=1.5),
                uplot.Series(label="torque ratio" if not reader.is_base else "-", stroke="#c0272d", width=1.5),
            ),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, max(1.0, 1.2 * reader.v_max)))},
            height=150,
        ),
    )
