"""The base's robot file: every number bounded, every contradiction refused with its place, and what check tells."""

import json
import tomllib
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from rtctl import cli, design
from rtctl.design.rover import build, report
from rtctl.errors import EXIT_CONFIG, EXIT_OK, ConfigError
from rtctl.spec.base import BaseConfig, load, streams
from rtctl.spec.read import convert
from rtctl.spec.rules import refuse
from tests.base_lab import CONFIGS, ROVER, ROVER_PX4
from tests.config_leaves import alternatives, bounds, dotted, leaves, specimen

TABLE = tomllib.loads(ROVER.read_text())
SPECIMEN = specimen(inspect.type_info(BaseConfig))


def edited(*edits: tuple[str, Any]) -> dict[str, Any]:
    table = json.loads(json.dumps(TABLE))
    for path, value in edits:
        *way, last = path.split(".")
        inside = table
        for key in way:
            inside = inside[key]
        if value is None:
            inside.pop(last, None)
        else:
            inside[last] = value
    return table


def written(table: dict[str, Any], path) -> None:
    """Write a table of tables as TOML."""
    lines = []
    for name, inside in table.items():
        tables = inside if isinstance(inside, list) else [inside]
        for one in tables:
            lines.append(f"[[{name}]]" if isinstance(inside, list) else f"[{name}]")
            lines += [f"{key} = {json.dumps(value)}" for key, value in one.items()]
    path.write_text("\n".join(lines) + "\n")


# fmt: off
CONTRADICTIONS = [  # (edits, place, word of the reason)
    ([("base.footprint_m", [[1, 1], [-1, 1], [-1, -1]])], "base.footprint_m", "one of them"),
    ([("base.radius_m", None)], "base.footprint_m", "one of them"),
    ([("base.radius_m", None), ("base.footprint_m", [[1, 1], [2, 1], [2, 2]])],
     "base.footprint_m", "around the origin"),
    ([("base.wheels", "ackermann")], "base.turn_radius_m", "on the spot"),
    ([("base.turn_radius_m", 2.0)], "base.turn_radius_m", "0: skid"),
    ([("base.wheels", "holonomic")], "base.wheels", "no sideways speed"),
    ([("link.url", "udp:127.0.0.1:1")], "link.url", "udpin:HOST:PORT"),
    ([("link.url", "udpin:127.0.0.1")], "link.url", "port 1 to 65535"),
    ([("link.url", "tcp:localhost:99999")], "link.url", "port 1 to 65535"),
    ([("link.url", "serial:/dev/ttyACM0")], "link.url", "BAUD"),
    ([("link.signing", "required")], "link.key_file", "file of the key"),
    ([("link.key_file", "k")], "link.signing", "required"),
    ([("link.signing", "required"), ("link.key_file", "k")], "link.state_file", "replays"),
    ([("link.system_id", 1), ("link.component_id", 1)], "link.component_id", "autopilot"),
    ([("loop.plan_hz", 50.0), ("loop.servo_hz", 20.0)], "loop.plan_hz", "servo_hz"),
    ([("safety.heartbeat_hold_s", 4.0)], "safety.heartbeat_hold_s", "less than heartbeat_stop_s"),
    ([("safety.heartbeat_hold_s", 0.5)], "safety.heartbeat_hold_s", "once a second"),
    ([("safety.stale_hold_ms", 30.0)], "safety.stale_hold_ms", "2 servo periods"),
    ([("safety.stale_hold_ms", 2000.0)], "safety.stale_hold_ms", "stale_stop_ms"),
    ([("avoid.clearance_m", 1.5)], "avoid.clearance_m", "influence_m"),
    ([("avoid.stop_m", 0.6)], "avoid.stop_m", "clearance_m"),
    ([("avoid.clearance_m", 3.4), ("avoid.influence_m", 5.0)], "avoid.clearance_m", "footprint"),
    ([("avoid.clearance_m", 0.06), ("avoid.stop_m", 0.03), ("avoid.influence_m", 0.25)],
     "avoid.clearance_m", "rho_num"),
    ([("avoid.range_m", 4.0)], "avoid.range_m", "way to rest"),
    ([("obstacle", [{"name": "m", "type": "sphere", "radius_m": 1.0, "position_m": [9.0, 0.0, 0.0],
                     "velocity_m_s": [1.0, 0.0, 0.0]}])], "obstacle[0].name", "at rest"),
]
# fmt: on


IDS = [f"{i}-{c[1]}" for i, c in enumerate(CONTRADICTIONS)]


@pytest.mark.parametrize(("edits", "place", "reason"), CONTRADICTIONS, ids=IDS)
def test_contradictions_name_the_key_to_change(edits, place, reason, tmp_path):
    path = tmp_path / "base.toml"
    written(edited(*edits), path)
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert caught.value.place == f"{path}: {place}"
    assert reason in str(caught.value)


def test_every_number_has_both_bounds_and_refuses_what_is_no_number():
    seen = 0
    for leaf in leaves(inspect.type_info(BaseConfig), SPECIMEN):
        for option in alternatives(leaf.node):
            if not isinstance(option, inspect.FloatType | inspect.IntType):
                continue
            low, high = bounds(option)
            wrong = [low - abs(low) - 1, high + abs(high) + 1]
            wrong += [float("nan"), float("inf"), -float("inf")] if isinstance(option, inspect.FloatType) else []
            for value in wrong:
                with pytest.raises(ConfigError):
                    convert(_with(SPECIMEN, leaf.path, value), BaseConfig, "f")
            seen += 1
            assert dotted(leaf.path)
    assert seen > 60


def _with(value, path, new):
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = _with(copy[path[0]], path[1:], new)
    return copy


def test_unknown_and_missing_keys_are_refused():
    for edit in (("base.radiusm", 0.5), ("motion.v_max_m_s", None), ("avoid.scan", None), ("link.signing", None)):
        with pytest.raises(ConfigError):
            convert(edited(edit), BaseConfig, "f")
    with pytest.raises(ConfigError, match=r"base\.reverse"):  # no default switches a protection off
        convert(edited(("base.reverse", None)), BaseConfig, "f")


def test_the_shipped_files_pass_and_check_tells_what_follows_from_them(capsys, tmp_path):
    for path in (ROVER, ROVER_PX4):
        assert cli.main(["check", str(path), "--json"]) == EXIT_OK
        report = json.loads(capsys.readouterr().out)
        rows = {row["name"]: row for row in report["rows"]}
        assert rows["signing"]["verdict"] == "warn"
        assert rows["way to rest"]["value"] == pytest.approx(2.0 * 0.83 + 4.0 / 3.0)
        assert rows["gap that is passed"]["value"] == pytest.approx(2.0 * (0.5 + 0.6 + 0.35 / 2**0.5) + 0.35)
    assert cli.main(["run", str(ROVER), "--lockstep"]) == 2
    assert "rtctl sim" in capsys.readouterr().err
    bad = tmp_path / "bad.toml"
    bad.write_text(ROVER.read_text().replace("v_max_m_s = 2.0", "v_max_m_s = 200.0"))
    for command in ("check", "run"):
        assert cli.main([command, str(bad)]) == EXIT_CONFIG
        last = capsys.readouterr().err.splitlines()[-1]  # `run` says before that it starts
        assert last.startswith(f"rtctl: {bad}: motion.v_max_m_s: got 200.0, wanted")


@pytest.mark.parametrize(
    ("baud", "signed", "fine"),
    [(9600, False, False), (19200, False, False), (57600, False, True), (57600, True, True), (115200, True, True)],
)
def test_a_serial_line_bears_what_is_asked_of_it_or_is_refused(baud, signed, fine, tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    edits = [("link.url", f"serial:/dev/ttyAMA0:{baud}")]
    edits += [("link.signing", "required"), ("link.key_file", str(key)), ("link.state_file", "s")] if signed else []
    path = tmp_path / "base.toml"
    written(edited(*edits), path)
    if not fine:
        with pytest.raises(ConfigError, match=r"link.url: .* a faster line"):
            load(path)
        return
    config = load(path)
    line = streams(config)
    assert line is not None
    around, most = 12 + 13 * signed, 0.8 * baud / 10
    scan, quick = 10 * (around + 167), 2 * min(line.quick, 40.0) * (around + 28)
    assert scan + quick + 10 * (around + 26) < most  # what the vehicle says in a second, from the messages' definitions
    assert 50.0 / line.every * (around + 53) < most
    names = [row.name for row in report(config, build(config, path)).rows]
    assert names.count("line") == 2
    assert line.quick >= 10.0


def test_a_footprint_of_corners_becomes_points_that_cover_its_outline(tmp_path):
    path = tmp_path / "base.toml"
    corners = [[0.6, 0.3], [-0.4, 0.3], [-0.4, -0.3], [0.6, -0.3]]
    written(edited(("base.radius_m", None), ("base.footprint_m", corners)), path)
    base = build(load(path), path)
    assert base.margins.hull == pytest.approx((0.36 + 0.09) ** 0.5)
    for at in ([0.6, 0.0], [0.1, 0.3], [-0.4, -0.3]):
        gap = ((base.points - at) ** 2).sum(axis=1) ** 0.5
        assert gap.min() <= 0.05 + 1e-9


def test_the_schema_is_the_shipped_one_and_an_arms_file_is_no_bases():
    assert json.loads((CONFIGS / "schema_base.json").read_text()) == design.json_schema(BaseConfig)
    assert not design.is_base(CONFIGS / "panda.toml")
    assert design.is_base(ROVER)
    arms = msgspec.toml.decode((CONFIGS / "panda.toml").read_bytes())
    arms["robot"]["kind"] = "base"
    checked = convert(arms, design.Config, "f")
    with pytest.raises(ConfigError, match=r"robot\.kind: got base, wanted arm"):
        refuse(checked, "f")
