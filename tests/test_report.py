"""The report as people see it: one file, no network, legible and usable in a browser at desk and in hand."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest

from rtctl.cli import main
from rtctl.log import Kind, McapSink, make_header, read
from rtctl.log.record.requests import encode_event
from rtctl.log.view.plot import envelope
from rtctl.log.view.report.bins import Bins, Histogram, Spectrum
from rtctl.log.view.report.gather import Span
from rtctl.log.view.report.page import reached
from tests.lab import ROOT
from tools.browser import Browser, missing

GOLDEN = ROOT / "tests" / "golden" / "goals.mcap"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "goals.html"
    assert main(["log", "report", str(GOLDEN), "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if why := missing():
        assert os.environ.get("CI") != "true", why
        pytest.skip(why)
    with Browser() as session:
        yield session


def test_the_page_is_one_file_that_asks_the_network_for_nothing(page: Path):
    text = page.read_text(encoding="utf-8")
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!#)[^"']+""", text)
    assert not re.findall(r"(?:@import|url\(|fetch\(|XMLHttpRequest|import\()", text)
    assert len(text) < 1_500_000


def test_the_head_card_says_what_the_log_says(page: Path):
    text = page.read_text(encoding="utf-8")
    for words in (
        "<h1>panda</h1>",
        f"{len(read(GOLDEN)['/tick'])} ticks",
        "<dt>Dropouts</dt><dd>none</dd>",
        "<dt>Ended</dt>",
        "<dt>Slots missed</dt><dd>no deadlines: lockstep</dd>",
        "<dt>Goals reached</dt><dd>0 of 3</dd>",
    ):
        assert words in text, words
    assert "name = &quot;panda&quot;" in text  # the config


def test_a_goal_is_reached_once_however_often_the_tip_comes_back():
    spans = [Span(0.0, 1.0, "moving"), *(Span(t, t + 0.1, "arrived") for t in (1.0, 1.5, 2.5, 7.0))]
    assert reached(SimpleNamespace(asked=[0.5, 2.0, 4.0, 6.0], statuses=spans)) == 3
    assert reached(SimpleNamespace(asked=[], statuses=spans)) == 0


def painted(browser: Browser, selector: str) -> int:
    """Return how many different colours a canvas shows."""
    return int(
        browser.run(
            f"const c = document.querySelector('{selector}');"
            "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, s = new Set();"
            "for (let i = 0; i < d.length; i += 16) s.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return s.size"
        )
    )


def test_clicking_through_it_at_desktop_width(page: Path, browser: Browser, tmp_path: Path):
    browser.resize(1400, 1000)
    browser.open(page)
    assert browser.console() == []
    assert browser.run("return document.documentElement.scrollWidth <= window.innerWidth")
    sections = browser.run("return [...document.querySelectorAll('nav a')].map(a => a.textContent)")
    assert sections == ["Overview", "Tip", "Obstacles", "Torque", "Joints", "Health", "Timing", "Events", "Parameters"]
    for name in ("overview", "group-tip", "group-obstacles", "group-torque", "group-joints", "group-health", "events"):
        browser.click(f'nav a[href="#{name}"]')
        top = browser.run(f"return document.getElementById('{name}').getBoundingClientRect().top")
        assert top < 900, name
    assert painted(browser, "#scene") > 20
    for button in ("top", "front", "side", "iso"):
        before = browser.run("return document.getElementById('scene').toDataURL()")
        browser.click(f'[data-view="{button}"]')
        browser.wait(f"document.getElementById('scene').toDataURL() !== '{before}'")
    span = browser.run("return report.view.b - report.view.a")
    browser.drag("#plot-error canvas", 0.4, 0.6)
    browser.wait(f"Math.abs((report.view.b - report.view.a) / {span} - 0.22) < 0.06")
    assert painted(browser, "#plot-error canvas") > 10
    browser.click("#reset")
    browser.wait(f"Math.abs(report.view.b - report.view.a - {span}) < 1e-9")
    browser.click("#plot-clearance .legend button")
    assert browser.run("return document.querySelector('#plot-clearance .legend button').className") == "off"
    browser.click("tr[data-t]:nth-of-type(3)")
    browser.wait(f"report.view.b - report.view.a < {0.9 * span}")
    browser.click("#reset")
    browser.click("summary")
    assert browser.run("return document.querySelector('details').open")
    assert browser.console() == []
    browser.picture(tmp_path / "desktop.png")
    assert np.ptp(matplotlib.image.imread(tmp_path / "desktop.png")) > 0.5


def test_on_a_phone_nothing_is_wider_than_the_screen_and_every_plot_is_drawn(page: Path, browser: Browser):
    browser.phone(390, 844)
    browser.open(page)
    assert browser.run("return window.innerWidth") == 390
    assert browser.run("return document.documentElement.scrollWidth") == 390
    for key in browser.run("return [...document.querySelectorAll('#plots figure')].map(f => f.id)"):
        browser.run(f"document.getElementById('{key}').scrollIntoView({{block: 'center'}})")
        browser.wait(f"(() => {{ const c = document.querySelector('#{key} canvas'); return c.width > 500; }})()")
        assert painted(browser, f"#{key} canvas") > 5, key
        box = browser.run(
            f"const r = document.querySelector('#{key}').getBoundingClientRect(); return [r.left, r.right]"
        )
        assert box[0] >= 0
        assert box[1] <= 390
    assert browser.console() == []


def test_the_drawn_values_are_the_logged_ones(page: Path, browser: Browser):
    browser.resize(1400, 1000)
    browser.open(page)
    tick = read(GOLDEN)["/tick"]
    for name, values in (("error", tick.error), ("x.y", tick.x[:, 1]), ("tau_sent.panda_joint2", tick.tau_sent[:, 1])):
        low, high = (np.array(v, float) for v in browser.run(f"return report.series['{name}'].map(a => [...a])"))
        resolution = np.ptp(values) / 65534
        assert len(low) == len(values)  # fewer ticks than bins: nothing is left out
        np.testing.assert_allclose(low, values, atol=resolution)
        np.testing.assert_allclose(high, values, atol=resolution)


@pytest.mark.parametrize("total", [1, 7, 2400, 2401, 100_003])
def test_bins_keep_every_extreme_however_the_log_comes_in_pieces(total: int):
    rng = np.random.default_rng(total)
    values, time = rng.normal(size=total), np.arange(total) * 1e-3
    values[rng.integers(0, total, total // 50)] = np.nan
    values[total // 2] = np.inf
    bins, at = Bins(total, 200), 0
    while at < total:
        size = int(rng.integers(1, 5000))
        bins.begin(at, time[at : at + size])
        bins.add("v", values[at : at + size])
        at += size
    low, high = bins.series("v") if total > 1 else (np.full(1, np.nan), np.full(1, np.nan))
    owner = np.arange(total) * bins.count // total
    for b in range(bins.count):
        mine = values[(owner == b) & np.isfinite(values)]
        if len(mine):
            assert (low[b], high[b]) == (mine.min(), mine.max())
        else:
            assert np.isnan(low[b])
    assert np.all(np.diff(bins.time) > 0)


def test_a_line_in_the_spectrum_is_where_and_as_strong_as_it_was():
    spectrum = Spectrum(2, 1000.0)
    t = np.arange(20_480) / 1000.0
    noise = np.random.default_rng(0).normal(size=len(t))
    spectrum.add(np.stack([2.0 * np.sin(2 * np.pi * 125.0 * t), noise], axis=1))
    step = spectrum.frequency[1]
    assert spectrum.frequency[spectrum.amplitude[0].argmax()] == pytest.approx(125.0, abs=step)
    power = (spectrum.amplitude**2).sum(axis=1) * step  # Parseval: the variance
    np.testing.assert_allclose(power, [2.0, noise.var()], rtol=0.03)


def test_quantiles_of_a_histogram_are_those_of_the_values_to_a_bin():
    values = np.random.default_rng(1).lognormal(np.log(5e-5), 0.7, 20_000)
    histogram = Histogram()
    for part in np.array_split(values, 7):
        histogram.add(part)
    for p in (0.5, 0.99):
        assert histogram.quantile(p) == pytest.approx(np.quantile(values, p), rel=0.25)
    assert histogram.quantile(1.0) == histogram.largest == values.max()


def test_an_envelope_keeps_each_spike():
    values = np.zeros(100_000)
    values[[17, 50_000, 99_999]] = 1.0, -2.0, 3.0
    time, drawn = envelope(np.arange(100_000.0), values, 500)
    assert len(time) == 1000
    assert sorted(drawn[drawn != 0.0]) == [-2.0, 1.0, 3.0]


def test_a_fault_and_a_dropout_are_red_and_markup_in_a_name_stays_text(tmp_path: Path):
    header = make_header("<b>arm", ("a", "b"), 2, 1e-3)
    sink = McapSink(tmp_path / "odd.mcap", header)
    record = np.zeros((), header.dtype)
    record["faults"], record["rho"] = 1, np.inf
    for k in range(5):
        record["tick"], record["slot"], record["time"] = k, k, k * 1e-3
        sink.put(Kind.TICK, record.tobytes(), k * 1_000_000)
    sink.put(Kind.EVENT, encode_event(4, 0.004, "fault", "</script><script>alert(1)"), 4_000_000)
    sink.close()
    assert main(["log", "report", str(tmp_path / "odd.mcap")]) == 0
    text = (tmp_path / "odd.html").read_text()
    assert '<div class="figure bad"><dt>Faults</dt><dd>feedback_stale</dd>' in text
    assert "&lt;b&gt;arm" in text
    assert "<b>arm" not in text
    assert "<script>alert" not in text


def test_the_sheet_for_the_readme_is_a_picture_of_the_same_run(tmp_path: Path):
    assert (
        main(["log", "report", str(GOLDEN), "--out", str(tmp_path / "r.html"), "--png", str(tmp_path / "r.png")]) == 0
    )
    assert (tmp_path / "r.png").stat().st_size < 200_000
    image = matplotlib.image.imread(tmp_path / "r.png")
    assert min(image.shape[:2]) > 600
    assert len(np.unique((image[::3, ::3, :3] * 255).astype(int).reshape(-1, 3), axis=0)) > 30
