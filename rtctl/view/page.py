"""The page: its server, and the loop that keeps it up to date. A process of its own; the servo never waits for it."""

import io
import time
from collections.abc import Callable
from contextlib import redirect_stdout

import viser

from rtctl.errors import LogError
from rtctl.view.body import Body
from rtctl.view.follow import Recorded, Source, Story
from rtctl.view.gate import Gate
from rtctl.view.operator import Operator
from rtctl.view.panel import Panel
from rtctl.view.stage import Stage

HZ = 30.0  # of the 3D part while somebody looks
PANEL = 6  # frames from one panel to the next
ALONE = 0.25  # [s] between looks at the ring while nobody looks


class Page:
    """A source, shown to whoever opens the address."""

    def __init__(self, source: Source, operator: Operator, host: str, port: int) -> None:
        """Begin to serve. Raises LinkError when host and port cannot be had, LogError for what cannot be drawn."""
        self.source, self.operator = source, operator
        with redirect_stdout(io.StringIO()):  # it prints the address behind the gate, which is nobody's to open
            self._server = viser.ViserServer(host="127.0.0.1", port=0, label="rtctl", verbose=False)
        self.gate = Gate(host, port, self._server.get_port())
        self._server.on_client_connect(lambda client: self._stage.face(client))
        self._record = source if isinstance(source, Recorded) else None
        self._begin(source.story)

    def _begin(self, story: Story) -> None:
        """Furnish the page for a story's robot."""
        self._server.scene.reset()
        self._server.gui.reset()
        self._server.scene.configure_default_lights(cast_shadow=False)  # a machine without a graphics card shall follow
        self._story = story
        body = None if story.reader.is_base else _body(story, self.source)
        self._stage = Stage(self._server, story.reader, body)
        self._panel = Panel(self._server, self._stage, self.operator, story, self._record)

    def when_seen(self, tell: Callable[[], None]) -> None:
        """Tell once, when the first viewer has come."""
        told: list[bool] = []

        @self._server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            if not told:
                told.append(True)
                tell()

    def run(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Serve until `ended`, or a KeyboardInterrupt."""
        frame, last = 0, time.monotonic()
        while not ended():
            now = time.monotonic()
            self.step(frame, now - last)
            last, frame = now, frame + 1
            pause = 1.0 / HZ if self._server.get_clients() else ALONE
            time.sleep(max(0.001, pause - (time.monotonic() - now)))

    def step(self, frame: int, elapsed: float) -> None:
        """Show what there is now; elapsed [s] since the last frame."""
        if self._server.get_clients():
            self._panel.play(elapsed)
        remark = self.source.step()
        story = self.source.story
        if story is not self._story:
            if story.header is not self._story.header:
                self._begin(story)
            self._story = story
        if not self._server.get_clients():
            self._panel.lock()  # whoever unlocked it looks no more
            return
        with self._server.atomic():
            self._stage.draw(story)
            if frame % PANEL == 0:
                self._panel.show(story, remark)

    def close(self) -> None:
        """Stop serving."""
        self.gate.close()
        with redirect_stdout(io.StringIO()):
            self._server.stop()


def _body(story: Story, source: Source) -> Body:
    reader = story.reader
    try:
        return Body(story.header, reader.base, reader.points, source.folder)
    except (ValueError, RuntimeError) as error:  # the loader's own words
        raise LogError(f"the robot of {story.header.robot} cannot be drawn: {error}") from None
