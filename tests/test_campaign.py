"""Campaigns: nothing is lost and nothing is played twice, whoever dies; rates; scenes made small."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from scipy.stats import binomtest

from rtctl.campaign import rates
from rtctl.campaign.case import Case, Scene
from rtctl.campaign.case import code as code_of
from rtctl.campaign.engine import _client
from rtctl.campaign.minimise import ddmin, minimised
from rtctl.campaign.robots import grid, text_of
from rtctl.campaign.store import Store
from rtctl.cli import main
from rtctl.errors import UsageError

ROOT = Path(__file__).parents[1]
SOURCE = "tests.campaign_source:source"


def command(folder: Path, marks: Path, *more: str, count: int = 6) -> list[str]:
    marks.mkdir(exist_ok=True)
    return ["campaign", "run", SOURCE, "--count", str(count), "--out", str(folder), "--option", f"marks={marks}", *more]


def rows(folder: Path) -> dict[int, dict[str, Any]]:
    found = [row for part in (folder / "rows").glob("*.parquet") for row in pq.read_table(part).to_pylist()]
    assert len({row["key"] for row in found}) == len(found)
    return {row["number"]: row for row in found}


def plays(marks: Path) -> dict[int, int]:
    return {int(m.name): len(m.read_text().split()) for m in marks.iterdir() if m.name.isdigit()}


def await_(what: Callable[[], bool], process: "subprocess.Popen[bytes]") -> None:
    while not what():
        assert process.poll() is None
        time.sleep(0.05)


def test_two_workers_of_which_one_is_killed_give_what_one_process_gives(tmp_path: Path):
    here, there = tmp_path / "here", tmp_path / "there"
    count = 3
    assert main(command(here, tmp_path / "a", "--workers", "0", count=count)) == 0
    assert main(command(there, tmp_path / "b", "--workers", "2", "--option", "kill=1", count=count)) == 0
    one, two = rows(here), rows(there)
    assert (tmp_path / "b" / "killed").exists()
    assert set(one) == set(two) == set(range(count))
    assert [one[k]["digest"] for k in range(count)] == [two[k]["digest"] for k in range(count)]
    assert all(one[k]["digest"] for k in range(count))
    assert plays(tmp_path / "a") == dict.fromkeys(range(count), 1)


def test_a_campaign_beside_another_starts_without_a_word():
    """8787 is where Dask has a page by default; that another has it is a warning, which is an error here."""
    with socket.socket() as taken:
        with contextlib.suppress(OSError):  # somebody has it: just as well
            taken.bind(("127.0.0.1", 8787))
            taken.listen()
        with _client(1, "") as client:
            assert client.submit(int, 7).result(timeout=120) == 7


def test_a_killed_client_loses_nothing_and_nothing_is_played_twice(tmp_path: Path):
    out, marks = tmp_path / "out", tmp_path / "marks"
    words = command(out, marks, "--workers", "0", "--option", "stop=5", "--option", "fake=1")
    client = subprocess.Popen([sys.executable, "-m", "rtctl", *words], cwd=ROOT, env=os.environ | {"PYTHONPATH": "."})
    try:
        await_((marks / "stopped").exists, client)
    finally:
        client.send_signal(signal.SIGKILL)
        client.wait()
    with (out / "journal.jsonl").open("a") as journal:
        journal.write('{"key": "half a li')  # as far as the killed one came
    (marks / "go").touch()
    about = out / "campaign.json"  # the sources may change while a test runs
    about.write_text(json.dumps(json.loads(about.read_text()) | {"code": code_of()}))
    assert main(words) == 0
    assert set(rows(out)) == set(range(6))
    assert plays(marks) == {**dict.fromkeys(range(6), 1), 5: 2}  # the one it died in has no row before
    assert main(words) == 0
    assert plays(marks) == {**dict.fromkeys(range(6), 1), 5: 2}


def test_a_folder_takes_one_campaign_of_one_code_and_one_client(tmp_path: Path):
    store = Store(tmp_path, {"count": 1}, "code")
    store.add({"key": "k", "outcome": "arrived", "final_error_m": float("inf")})
    with pytest.raises(Exception, match="another client"):
        Store(tmp_path, {"count": 1}, "code")
    store.close()
    for asked, code, said in (({"count": 2}, "code", "another campaign"), ({"count": 1}, "other", "other code")):
        with pytest.raises(UsageError, match=said):
            Store(tmp_path, asked, code)
    again = Store(tmp_path, {"count": 1}, "other", other_code=True)
    assert again.rows["k"]["outcome"] == "arrived"
    assert again.rows["k"]["final_error_m"] is None
    again.close()


def test_a_grid_is_every_combination_and_is_refused_by_the_name_of_its_key(tmp_path: Path, capsys):
    names = [v.name for v in grid(["avoid.clearance_m=0.01,0.02", "loop.realtime=best-effort,required"])]
    assert len(names) == 4
    assert names[1] == "avoid.clearance_m=0.01 loop.realtime=required"
    text = text_of(ROOT / "configs" / "planar4.toml", grid(["avoid.clearance_m=0.01"])[0])
    assert '"clearance_m" = 0.01' in text.replace(": ", " = ") or "0.01" in text
    words = command(tmp_path / "out", tmp_path / "marks", "--grid", "avoid.clearence_m=0.01")
    assert main(words) == 78
    assert "clearance_m" in capsys.readouterr().err


@pytest.mark.parametrize(("hits", "of"), [(0, 7), (3, 7), (7, 7), (440, 1000), (1999, 2000)])
def test_the_interval_is_wilsons(hits: int, of: int):
    wanted = binomtest(hits, of).proportion_ci(0.95, "wilson")
    found = rates.wilson(hits, of)
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), abs=1e-12)


def test_ddmin_keeps_what_fails_together():
    calls = []

    def fails(items: list[int]) -> bool:
        calls.append(items)
        return {3, 11} <= set(items)

    assert ddmin(list(range(16)), fails) == [3, 11]
    assert ddmin([1, 2], lambda items: True) == []
    assert len(calls) < 60


class Fake:
    """Touches a ball `b` at 1.25 s."""

    def scene(self, case: Case) -> Scene:
        table = {"duration_s": 8.0, "obstacle": [{"name": n} for n in "abcde"], "fault": [{"kind": "x"}]}
        return Scene(table, ROOT)

    def play(self, case: Case, scene: Scene, config: Path) -> dict[str, Any]:
        hit = scene.table["duration_s"] > 1.25 and any(o["name"] == "b" for o in scene.table.get("obstacle", ()))
        return {"outcome": "contact" if hit else "arrived", "failures": "contact" if hit else ""}


fake = Fake()


def test_a_failing_scene_is_made_small():
    case = Case("tests.test_campaign:fake", "planar4", (ROOT / "configs" / "planar4.toml").read_text(), 0, 0)
    case = case._replace(config=case.config.replace("planar4.urdf", str(ROOT / "configs" / "planar4.urdf")))
    scene = minimised(case, {"outcome": "contact", "failures": "contact"}, lambda text: None)
    assert scene.table["obstacle"] == [{"name": "b"}]
    assert "fault" not in scene.table
    assert 1.25 < scene.table["duration_s"] < 1.7


def test_the_report_shows_rates_pictures_and_how_to_play_each_alone(tmp_path: Path, capsys):
    out, marks = tmp_path / "out", tmp_path / "marks"
    assert (
        main([*command(out, marks, "--workers", "0", "--json")[:4], "2", *command(out, marks)[5:], "--workers", "0"])
        == 0
    )
    capsys.readouterr()
    assert main(["campaign", "report", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"] == 2
    assert main(["campaign", "report", str(out)]) == 0
    text = (out / "report.html").read_text()
    keys = [row["key"] for row in rows(out).values()]
    assert all(f"rtctl campaign play {out} {key}" in text for key in keys)
    assert text.count("data:image/png") == 1 + 2
    assert "another way" not in text
    capsys.readouterr()
    assert main(["campaign", "play", str(out), keys[0]]) == 0
    assert json.loads(capsys.readouterr().out)["digest"] == rows(out)[0]["digest"]
