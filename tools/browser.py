"""A headless Chromium driven over WebDriver's own HTTP: no more than looking at a page needs."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any, Self

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
)
DRAWS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL without a graphics card
SCRIPT = 120_000  # [ms] a page that draws in software answers late
HELP = "apt-get install -y --no-install-recommends chromium chromium-driver"
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # of the WebDriver standard

DRAWN = """(() => {
  const scene = document.querySelector("canvas[data-engine]"), small = document.createElement("canvas");
  if (!scene) return false;
  small.width = small.height = 16;
  const pen = small.getContext("2d");
  pen.drawImage(scene, 0, 0, 16, 16);
  return pen.getImageData(0, 0, 16, 16).data.some((value, at) => at % 4 === 3 && value > 0);
})()"""  # whether the scene's canvas holds anything


def missing() -> str:
    """Return why there is no browser, '' when there is one."""
    lacking = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return f"{' and '.join(lacking)} not installed: {HELP}" if lacking else ""


class Browser:
    """One session; everything it leaves goes with it."""

    def __init__(self, flags: tuple[str, ...] = ("--disable-gpu",)) -> None:
        self._flags = (*FLAGS, *flags)

    def __enter__(self) -> Self:
        self._folder = tempfile.TemporaryDirectory(prefix="rtctl-browser-", ignore_cleanup_errors=True)
        log = Path(self._folder.name) / "driver.log"
        self._output = log.open("wb")
        self._driver = subprocess.Popen(
            ["chromedriver", "--port=0"], stdout=self._output, stderr=subprocess.STDOUT, env={**os.environ, "LANG": "C"}
        )
        port = self._port(log)
        self._base = f"http://127.0.0.1:{port}/session"
        options = {
            "binary": shutil.which("chromium"),
            "args": [*self._flags, f"--user-data-dir={self._folder.name}/profile"],
        }
        logs = {"browser": "ALL"}
        wait = {"script": SCRIPT}
        wanted = {"alwaysMatch": {"goog:chromeOptions": options, "goog:loggingPrefs": logs, "timeouts": wait}}
        self._session = self._call("POST", "", {"capabilities": wanted})["sessionId"]
        return self

    def _port(self, log: Path) -> int:
        until = time.monotonic() + 60.0
        while time.monotonic() < until:
            text = log.read_text(errors="replace")
            if "started successfully on port" in text:
                return int(text.rsplit("on port", 1)[1].split()[0].rstrip("."))
            time.sleep(0.05)
        raise AssertionError(f"chromedriver did not start: {log.read_text(errors='replace')}")

    def __exit__(self, *what: object) -> None:
        try:
            self._call("DELETE", f"/{self._session}")
        finally:
            self._driver.terminate()
            self._driver.wait(20)
            self._output.close()
            self._folder.cleanup()

    def _call(self, method: str, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._base + path, data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=120) as answer:
                return json.loads(answer.read())["value"]
        except urllib.error.HTTPError as error:
            text = error.read().decode(errors="replace")
            error.close()
            raise AssertionError(f"{method} {path}: {text[:600]}") from None

    def _ask(self, method: str, path: str, body: Any = None) -> Any:
        return self._call(method, f"/{self._session}{path}", body)

    def open(self, page: Path) -> None:
        """Open a file and wait until it says that it is ready."""
        self.go(page.as_uri())
        self.wait("document.body.dataset.ready === '1'")

    def go(self, url: str) -> None:
        """Open an address."""
        self._ask("POST", "/url", {"url": url})

    def phone(self, width: int, height: int) -> None:
        """Lay the page out as on a phone: a headless window cannot be that narrow."""
        self._layout(width, height, 2, True)

    def wide(self, width: int, height: int) -> None:
        """Give the page itself a size; `resize` gives it to the window around it."""
        self._layout(width, height, 1, False)

    def _layout(self, width: int, height: int, scale: int, mobile: bool) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": mobile}
        self._ask("POST", "/goog/cdp/execute", {"cmd": "Emulation.setDeviceMetricsOverride", "params": metrics})

    def resize(self, width: int, height: int) -> None:
        """Give the window a size."""
        self._ask("POST", "/goog/cdp/execute", {"cmd": "Emulation.clearDeviceMetricsOverride", "params": {}})
        self._ask("POST", "/window/rect", {"width": width, "height": height})

    def run(self, script: str) -> Any:
        """Return what a script returns."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": []})

    def wait(self, condition: str) -> None:
        """Wait until an expression is true."""
        until = time.monotonic() + 60.0
        while not self.run(f"return {condition}"):
            assert time.monotonic() < until, (condition, self.console())
            time.sleep(0.05)

    def click(self, selector: str) -> None:
        """Click an element as a person would: it must be there, visible and not covered."""
        found = self._ask("POST", "/element", {"using": "css selector", "value": selector})[ELEMENT]
        self.run(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'center'}})")
        self._ask("POST", f"/element/{found}/click", {})

    def drag(self, selector: str, start: float, stop: float) -> None:
        """Drag across an element, between two fractions of its width."""
        box = f"document.querySelector({json.dumps(selector)})"
        self.run(f"{box}.scrollIntoView({{block: 'center'}})")
        x, y, w, h = self.run(f"const r = {box}.getBoundingClientRect(); return [r.x, r.y, r.width, r.height]")
        at = [round(x + f * w) for f in (start, (start + stop) / 2, stop)]
        steps: list[dict[str, Any]] = [{"type": "pointerMove", "duration": 0, "x": at[0], "y": round(y + h / 2)}]
        steps.append({"type": "pointerDown", "button": 0})
        steps += [{"type": "pointerMove", "duration": 30, "x": each, "y": round(y + h / 2)} for each in at[1:]]
        steps.append({"type": "pointerUp", "button": 0})
        pointer = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": steps}
        self._ask("POST", "/actions", {"actions": [pointer]})

    def pull(self, start: tuple[int, int], stop: tuple[int, int]) -> None:
        """Drag from one pixel of the page to another, slowly enough for a page that is drawn in software."""
        steps: list[dict[str, Any]] = [{"type": "pointerMove", "duration": 0, "x": start[0], "y": start[1]}]
        steps += [{"type": "pause", "duration": 500}, {"type": "pointerDown", "button": 0}]
        for k in range(1, 6):
            x, y = (round(a + (b - a) * k / 5) for a, b in zip(start, stop, strict=True))
            steps += [{"type": "pointerMove", "duration": 100, "x": x, "y": y}, {"type": "pause", "duration": 200}]
        steps.append({"type": "pointerUp", "button": 0})
        pointer = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": steps}
        self._ask("POST", "/actions", {"actions": [pointer]})

    def drawn(self) -> None:
        """Wait until the page's 3D scene has been drawn, and drawn anew."""
        self.wait(DRAWN)
        self.run("return new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def console(self) -> list[str]:
        """Return the errors of the page since the last call."""
        found = self._ask("POST", "/se/log", {"type": "browser"})
        return [entry["message"] for entry in found if entry["level"] in ("SEVERE", "WARNING")]

    def picture(self, path: Path) -> None:
        """Keep what is on the screen."""
        try:
            shot = self._ask("GET", "/screenshot")
        except AssertionError:  # it gives a page ten seconds, which is too few for one that is drawn in software
            wanted = {"cmd": "Page.captureScreenshot", "params": {"format": "png"}}
            shot = self._ask("POST", "/goog/cdp/execute", wanted)["data"]
        path.write_bytes(base64.b64decode(shot))
