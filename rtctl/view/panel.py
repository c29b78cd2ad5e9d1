"""The part of a page with words, buttons, bars and charts."""

import numpy as np
import viser
from viser import uplot

from rtctl.types import F64
from rtctl.view.follow import Recorded, Story
from rtctl.view.handles import Handles
from rtctl.view.moment import Reader
from rtctl.view.operator import Answer, Operator, beside
from rtctl.view.stage import Shown, Stage
from rtctl.view.words import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    RED,
    STYLE,
    bars_html,
    chart_data,
    events_html,
    note_html,
    state_html,
)

WARNING = (
    "<b>Not an emergency stop.</b> Stop here goes through this browser, the network and the daemon. "
    "Keep the hardware emergency stop in reach."
)
LOOK = """<style>
canvas[data-engine^="three"] { background: linear-gradient(#f3f5f8, #dde2ea) }
@media (max-width: 36em) {
  .mantine-Paper-root[style*="position: fixed"] { width: 100% !important; max-height: 50% !important }
  .mantine-Paper-root[style*="position: fixed"] [style*="width: 20em"] { width: 100% !important }
}
</style>"""  # on a phone the panel is the lower half of the page
SPEEDS = {"0.1 ×": 0.1, "0.25 ×": 0.25, "1 ×": 1.0, "4 ×": 4.0, "10 ×": 10.0}
VERBS = ("Arm", "Hold", "Float", "Disarm", "Reset")  # of an arm
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
        self.gui.add_html(LOOK)
        self._state = self.gui.add_html("")
        if record is None:
            self._operate()
        else:
            self._playback(record)
        with self.gui.add_folder(
            "Clearance" if self.reader.is_base else "Clearance and torque", expand_by_default=True
        ):
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
            verbs = ("Arm", "Hold", "Disarm", "Reset") if self.reader.is_base else VERBS
            self._verbs = gui.add_button_group("", verbs, visible=False)
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
        self.put("_answer", note_html("Drag the arrows at the goal." if wanted else "Read-only.", GREY))

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
        self.put("_answer", note_html(answer.text, GREEN if answer.ok else RED))

    def _playback(self, record: Recorded) -> None:
        first, last = record.span
        self._playing = True
        with self.gui.add_folder("Time", expand_by_default=True):
            self._slider = self.gui.add_slider("t [s]", first, max(last, first + 0.01), 0.01, first)
            self._slider.on_update(lambda event: record.seek(float(self._slider.value)) if event.client else None)
            play = self.gui.add_button_group("", ("Play", "Pause", "Start"))
            self._speed = self.gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 ×")

            @play.on_click
            def _(event: object) -> None:
                self._playing = play.value != "Pause"
                if play.value == "Start":
                    record.seek(first)

    def play(self, elapsed: float) -> None:
        """Go on in a log by what has elapsed [s]."""
        if self.record is None or not self._playing:
            return
        self.record.seek(self.record.at + elapsed * SPEEDS[self._speed.value])

    def _choices(self) -> None:
        with self.gui.add_folder("Show", expand_by_default=False):
            if self.reader.is_base:
                look = self.gui.add_button_group("Look at", ("Rover", "Trip"))

                @look.on_click
                def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
                    if event.client is not None:
                        self.stage.face(event.client, look.value == "Trip")

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
            self.put("_state", note_html(remark or "Waiting for the first tick.", AMBER))
            return
        self.put("_state", state_html(m, story.detail, remark))
        self.put("_bars", bars_html(m, self.reader, story.things))
        self.put("_events", events_html(story.said))
        if self.record is not None:
            self._slider.value = round(float(self.record.at), 2)  # type: ignore[misc]
        elif self.operator.unlocked and m.goal is not None:
            self.handles.put("goal", m.goal)
        for chart, data in zip(self._charts, chart_data(story.chart, self.reader.is_base), strict=True):
            chart.data = data


def _charts(gui: viser.GuiApi, reader: Reader) -> tuple[viser.GuiUplotHandle, ...]:
    unit, size = ("m", 5.0) if reader.is_base else ("mm", 2e3)
    lengths = _lines((f"to goal [{unit}]", BLUE), (f"clearance [{unit}]", AMBER))
    shares = _lines(("speed [m/s]", GREEN), *(() if reader.is_base else (("largest torque, share", RED),)))
    tops = size * reader.influence, max(1.0, reader.v_max)
    return tuple(
        gui.add_uplot(
            data,
            series,
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, 1.1 * top))},
            height=150,
            padding=(12, 8, 0, 0),
        )
        for data, series, top in zip(chart_data((), reader.is_base), (lengths, shares), tops, strict=True)
    )


def _lines(*lines: tuple[str, str]) -> tuple[uplot.Series, ...]:
    """Return the lines of a chart over time, each with a label and a colour."""
    named = (uplot.Series(label=label, stroke=colour, width=1.5) for label, colour in lines)
    return (uplot.Series(label="t [s]"), *named)
