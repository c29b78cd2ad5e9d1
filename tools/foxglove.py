"""Open a log in Foxglove's own core, in a headless browser, and take its picture.

    python -m tools.foxglove out/demo/logs/panda.mcap --at 26 --png docs/foxglove.png
    python -m tools.foxglove rover.mcap --layout configs/foxglove_rover.json --png /tmp/rover.png

The core is the last one that was published as a package (@foxglove/studio-base, MPL-2.0); npm brings it into --cache,
once. Prints the topics that Foxglove shows and the problems that it finds; exit code 1 when there are any.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from tools.browser import DRAWS, Browser, missing

PACKAGES = {"core": "@foxglove/studio-base@1.48.0", "react": "react@17.0.2", "dom": "react-dom@17.0.2"}
PAGE = """<!doctype html><meta charset="utf-8"><style>html,body,#root{height:100%;margin:0}</style><div id="root"></div>
<script>global = window; process = {env: {}}; FOXGLOVE_STUDIO_VERSION = "1.48.0";</script>
<script src="react/umd/react.production.min.js"></script><script>window.react = React</script>
<script src="dom/umd/react-dom.production.min.js"></script><script>window["react-dom"] = ReactDOM</script>
<script src="core/assets/index.js"></script>
<script>
(async () => {
  const data = await (await fetch("layout.json")).json();
  const now = new Date().toISOString(), id = "layout";
  const layouts = new Map([[id, {id, name: id, permission: "CREATOR_WRITE", baseline: {data, savedAt: now}}]]);
  const layoutStorage = {
    list: async () => [...layouts.values()], get: async (_, id) => layouts.get(id),
    put: async (_, layout) => { layouts.set(layout.id, layout); return layout; },
    delete: async (_, id) => { layouts.delete(id); }, importLayouts: async () => {},
  };
  const onboarding = {settingsTooltipShownForPanelTypes: ["3D"]};
  localStorage.setItem("studio.profile-data", JSON.stringify({currentLayoutId: id, onboarding}));
  const values = {colorScheme: "light", timezone: "UTC"};
  const appConfiguration = {
    get: key => values[key], set: async (key, value) => { values[key] = value; },
    addChangeListener() {}, removeChangeListener() {},
  };
  await initI18n();
  ReactDOM.render(React.createElement(App, {
    deepLinks: [location.href], dataSources: [new RemoteDataSourceFactory()], appConfiguration, layoutStorage,
    extensionLoaders: [], enableGlobalCss: true,
  }), document.getElementById("root"));
})();
</script>
"""


class Files(SimpleHTTPRequestHandler):
    """A folder over HTTP/1.1 with ranges, by which the core reads a log."""

    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing."""

    def end_headers(self) -> None:
        """Allow ranges."""
        self.send_header("Accept-Ranges", "bytes")
        super().end_headers()

    def do_GET(self) -> None:
        """Answer with a range of a file when one is asked for, else with all of it."""
        with suppress(BrokenPipeError, ConnectionResetError):  # the core hangs up when it has read enough
            self._answer()

    def _answer(self) -> None:
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        path = Path(self.translate_path(self.path))
        if asked is None or not path.is_file():
            super().do_GET()
            return
        size = path.stat().st_size
        first, last = int(asked[1]), min(int(asked[2] or size - 1), size - 1)
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
        self.send_header("Content-Length", str(last - first + 1))
        self.end_headers()
        with path.open("rb") as file:
            file.seek(first)
            self.wfile.write(file.read(last - first + 1))


def fetched(cache: Path) -> Path:
    """Return the folder that holds the packages; what is not there is brought by npm."""
    cache.mkdir(parents=True, exist_ok=True)
    for name, package in PACKAGES.items():
        if (cache / name / "package.json").exists():
            continue
        done = subprocess.run(["npm", "pack", package], cwd=cache, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"npm pack {package}: {done.stderr.strip()}")
        archive = cache / done.stdout.split()[-1]
        with tarfile.open(archive) as packed:
            packed.extractall(cache / f"{name}.new", filter="data")
        (cache / f"{name}.new" / "package").rename(cache / name)
        (cache / f"{name}.new").rmdir()
        archive.unlink()
    return cache


def look(site: Path, log: Path, layout: Path, at: float, wait: float, png: Path) -> tuple[list[str], list[str]]:
    """Return the topics and the problems that Foxglove shows `at` [s] into a log, and keep the picture."""
    for name, source in (("layout.json", layout), ("log.mcap", log)):
        (site / name).unlink(missing_ok=True)
        (site / name).symlink_to(source.resolve())
    (site / "index.html").write_text(PAGE)
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    begun = summary.statistics.message_start_time if summary and summary.statistics else 0
    moment = datetime.fromtimestamp(begun / 1e9 + at, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Files, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    root = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        with Browser(DRAWS) as browser:
            browser.resize(1760, 1000)
            browser.go(f"{root}/?ds=remote-file&time={moment}&ds.url={root}/log.mcap")
            browser.wait("document.body.innerText.includes('/tick')")
            time.sleep(wait)  # until it has read the log
            topics = re.findall(r"^/[\w/]+$", browser.run("return document.body.innerText"), re.M)
            tab = "[...document.querySelectorAll('button')].find(b => b.innerText.startsWith('Problems'))"
            browser.run(f"{tab}.click()")
            time.sleep(1.0)
            said = browser.run("return document.body.innerText")
            found = re.search(r"^Problems\n(?:\d+\n)?(.*?)^3D$", said, re.M | re.S)  # up to the first panel's title
            problems = [line for line in found[1].splitlines() if line] if found else ["the list was not found"]
            problems = [line for line in problems if line != "No problems found"]
            browser.run("document.querySelector('.MuiTabs-vertical [role=tab]').click()")  # the side bar goes
            time.sleep(3.0)
            browser.picture(png)
    finally:
        server.shutdown()
    return topics, problems


def main(argv: Sequence[str] | None = None) -> int:
    """Look at a log; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.foxglove", description="A log as Foxglove shows it.")
    parser.add_argument("log", type=Path)
    parser.add_argument("--layout", type=Path, default=Path("configs/foxglove.json"), help="(%(default)s)")
    parser.add_argument("--at", type=float, default=1.0, metavar="S", help="into the log (%(default)s)")
    parser.add_argument("--wait", type=float, default=40.0, metavar="S", help="until it has read it (%(default)s)")
    parser.add_argument("--png", type=Path, default=Path("out/foxglove.png"), help="(%(default)s)")
    parser.add_argument("--cache", type=Path, default=Path("out/foxglove"), help="for the packages (%(default)s)")
    arguments = parser.parse_args(argv)
    absent = [f"{path}: no such file" for path in (arguments.log, arguments.layout) if not path.is_file()]
    lacking = "; ".join(absent) or missing() or ("" if shutil.which("npm") else "npm: apt-get install -y npm")
    if lacking:
        print(f"foxglove: {lacking}", file=sys.stderr)
        return 1
    arguments.png.parent.mkdir(parents=True, exist_ok=True)
    site = fetched(arguments.cache)
    topics, problems = look(site, arguments.log, arguments.layout, arguments.at, arguments.wait, arguments.png)
    print(json.dumps({"topics": topics, "problems": problems, "png": str(arguments.png)}, indent=1))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
