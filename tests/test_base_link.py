"""The conversation with the autopilot, byte by byte as another implementation reads it, and the wires it goes over.

What a frame means is read by pamoja-mavlink (Rust); what comes to us is put together by it too.
"""

import math
import os
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pamoja import mavlink as pamoja

from firmware_sim import rover
from firmware_sim.rover_serve import open_port
from rtctl.app.rover_link import open_link
from rtctl.errors import EXIT_FAILED, AbsentError, HandshakeError, LinkError, StoppedError
from rtctl.hal.mavlink.message import dialect
from rtctl.hal.mavlink.talk import Order, Talk, Word, stream
from rtctl.hal.mavlink.view import Clock, local_of
from rtctl.hal.mavlink.wire import InProcess, Udp, open_wire
from rtctl.log import read
from rtctl.log.record.writer import McapSink
from rtctl.log.view.tlog import export_tlog
from rtctl.rover.signals import Ask, BaseCommand
from rtctl.spec.base import load
from rtctl.types import Link, State, Verb
from tests.base_lab import ROVER, ROVER_PX4, BaseLab

TIMESYNC = pamoja.Dialect()  # it knows no TIMESYNC: checked by its seed alone
TIMESYNC.add(111, 34)


def fields(raw: bytes) -> dict[str, Any]:
    """Return a frame's fields, its message id and addresses, as the other implementation reads them."""
    frame = pamoja.MavlinkFrame.parse_known(raw, TIMESYNC)
    header, values = frame.header, {}
    if frame.message_id != 111:
        schema = pamoja.schema_for(frame.message_id)
        values = pamoja.to_dict(pamoja.MavlinkMessage.decode(schema, frame.payload), schema)
    return values | {"id": frame.message_id, "from": (header.system_id, header.component_id), "version": frame.version}


def said(lab: BaseLab, message: int) -> list[dict[str, Any]]:
    return [f for f in map(fields, lab.sent) if f["id"] == message]


def theirs(name: str, sequence: int = 0, system: int = 1, component: int = 1, **values) -> bytes:
    """Return a message of the vehicle that the other implementation puts together."""
    header = pamoja.MavlinkHeader(system, component, sequence)
    return pamoja.from_dict(pamoja.schema_for(name), values).to_frame(header).bytes


def bare(message: int, extra: int, layout: str, *values, component: int = 1) -> bytes:
    """Return a message of the vehicle that the other implementation frames, its fields laid out by hand."""
    header = pamoja.MavlinkHeader(1, component, 0)
    return pamoja.MavlinkFrame.raw(header, message, extra, struct.pack(layout, *values)).bytes


def obstacle_distance(cells, increment, increment_f, offset, frame, component=195, low=5) -> bytes:
    fields = (0, *cells, low, 1200, 0, increment, increment_f, offset, frame)
    return bare(330, 23, "<Q72HHHBBffB", *fields, component=component)


def distance_sensor(orientation, current) -> bytes:
    return bare(132, 85, "<IHHHBBBB", 0, 20, 800, current, 0, 0, orientation, 0)


def odometry(usec, x, y, q, vx, reset) -> bytes:
    nothing = [0.0] * 42
    return bare(331, 91, "<Q3f4f3f3f42fBBBBb", usec, x, y, 0, *q, vx, 0, 0, 0, 0, 0, *nothing, 1, 12, reset, 2, 100)


def fed(lab: BaseLab, *packets: bytes):
    """Let packets arrive, and only those; return the feedback."""
    lab.link.wire._waiting = list(packets)
    return lab.link.read(lab.slot, 0, 0.0, 0.0)


def test_our_heartbeat_is_an_onboard_controllers_once_a_second_whatever_the_state():
    lab = BaseLab()
    beats = []
    for _ in range(250):
        lab.tick()
        beats += said(lab, 0)
    assert len(beats) == 5
    for beat in beats:
        assert beat["version"] == 2
        assert beat["from"] == (245, 191)
        expected = {
            "type": 18,
            "autopilot": 8,
            "base_mode": 0,
            "custom_mode": 0,
            "system_status": 4,
            "mavlink_version": 3,
        }
        assert {key: beat[key] for key in expected} == expected


def test_ardupilot_gets_forward_speed_and_yaw_rate_in_the_body_frame():
    lab = BaseLab().armed()
    lab.link.write(BaseCommand(Ask.DRIVE, 1.25, 0.5, np.array([3.0, 4.0])))
    point = said(lab, 84)[0]
    assert point["coordinate_frame"] == 8
    assert point["type_mask"] in (0x05C7, 0x05E7)
    assert (point["target_system"], point["target_component"]) == (1, 1)  # pinned, never a broadcast
    assert (point["vx"], point["vy"]) == (1.25, 0.0)
    assert point["yaw_rate"] == -0.5  # NED turns the other way


def test_px4_gets_a_velocity_in_the_world_and_a_stream_of_them_before_the_mode():
    lab = BaseLab(ROVER_PX4)
    lab.tick(Verb.ARM)
    first: dict[Any, int] = {}
    for k in range(200):
        for f in map(fields, lab.sent):
            what = (f["id"], f.get("command"))
            first.setdefault(what, k)
        if lab.m.state == State.RUN:
            break
        lab.tick()
    assert lab.m.state == State.RUN
    assert (first[76, 176.0] - first[84, None]) * lab.base.dt > 1.0
    assert first[76, 400.0] > first[76, 176.0]
    lab.link.write(BaseCommand(Ask.DRIVE, 9.0, 9.0, np.array([0.3, -0.4])))
    point = said(lab, 84)[0]
    assert (point["coordinate_frame"], point["type_mask"]) == (1, 0x0DC7)
    np.testing.assert_allclose(
        (point["vx"], point["vy"], point["yaw_rate"]), (-0.4, 0.3, 0.0), rtol=1e-6
    )  # north, east


def test_a_number_that_is_not_finite_never_reaches_the_wire():
    lab = BaseLab().armed()
    lab.link.write(BaseCommand(Ask.DRIVE, math.nan, 0.5, np.zeros(2)))
    point = said(lab, 84)[0]
    assert (point["vx"], point["yaw_rate"]) == (0.0, 0.0)
    assert lab.rover.autopilot.aborted == ""


def test_nothing_arms_before_rtctl_arm_and_mode_and_arming_are_acknowledged_commands():
    lab = BaseLab()
    lab.run(2.0)
    assert not lab.rover.autopilot.armed
    assert lab.rover.autopilot.mode == 4
    lab.tick(Verb.ARM)
    orders = []
    for _ in range(20):
        orders += said(lab, 76)
        lab.tick()
    assert [(o["command"], o["param1"], o["param2"], o["confirmation"]) for o in orders] == [
        (176.0, 1.0, 15.0, 0.0),
        (400.0, 1.0, 0.0, 0.0),
    ]
    assert lab.m.state == State.RUN


def test_a_rate_that_is_denied_falls_back_to_the_next_and_what_is_not_known_is_left():
    lab = BaseLab()
    assert lab.link.talk.rates["LOCAL_POSITION_NED"] == lab.link.talk.rates["ATTITUDE"] == 40.0
    assert "OBSTACLE_DISTANCE" not in lab.link.talk.rates  # no autopilot of this kind sends it
    assert "DISTANCE_SENSOR" not in lab.link.talk.rates
    talk, asked = Talk(), []
    talk.give(stream("x", 32, 50.0))
    while (due := talk.due(0.0)) is not None:
        asked.append(round(1e6 / due[0].parameters[1]))
        talk.answer(511, 2, 0.0)  # denied
    assert asked == [50, 40, 25, 20, 10]
    assert talk.answers["x"] == Word.DENIED


def test_an_acknowledgement_is_matched_by_command_waits_while_in_progress_and_retries_when_busy():
    talk = Talk()
    talk.give(Order("arm", 400, (1.0,) * 7))
    assert talk.due(0.0) == (Order("arm", 400, (1.0,) * 7), 0)
    talk.answer(176, 0, 0.1)  # of another command
    talk.answer(400, 5, 0.2)  # in progress
    assert talk.due(3.0) is None
    talk.answer(400, 1, 3.0)  # temporarily rejected
    assert talk.due(3.1) is None
    assert (talk.due(3.6) or [None])[0] == Order("arm", 400, (1.0,) * 7)
    talk.give(Order("next", 176, (1.0,) * 7))
    assert talk.due(3.7) is None  # one in flight at a time
    talk.answer(400, 0, 3.8)
    assert talk.answers == {"arm": Word.ACCEPTED}
    assert (talk.due(3.9) or [None])[0] == Order("next", 176, (1.0,) * 7)


def test_other_systems_and_components_are_not_believed_nor_are_damaged_or_unknown_frames():
    lab = BaseLab()
    before = lab.link.read(0, 0, 0.0, 0.0)
    lab.link.counts.clear()
    good = {"time_boot_ms": 90_000, "x": 5.0, "y": 6.0}
    broken = bytearray(theirs("LOCAL_POSITION_NED", **good))
    broken[12] ^= 1
    strange = pamoja.MavlinkFrame.raw(pamoja.MavlinkHeader(1, 1, 0), 54321, 7, b"abc").bytes
    f = fed(
        lab,
        theirs("LOCAL_POSITION_NED", system=2, **good),
        theirs("LOCAL_POSITION_NED", component=2, **good),
        theirs("HEARTBEAT", component=190, type=6, autopilot=8, custom_mode=15, base_mode=128),
        bytes(broken),
        strange,
        b"\xfd\x01",
    )
    np.testing.assert_array_equal(f.position, before.position)
    assert f.mode == before.mode
    assert f.refused == 1  # the damaged one
    assert lab.link.counts["of others"] == 3
    assert lab.link.counts["unknown"] == 1
    f = fed(lab, theirs("LOCAL_POSITION_NED", **good))  # even behind the rest of a cut frame
    lab.link.wire._waiting = [theirs("LOCAL_POSITION_NED", time_boot_ms=90_020, x=5.0, y=6.0)]
    f = lab.link.read(0, 0, 0.0, 0.0)
    np.testing.assert_array_equal(f.position, (6.0, 5.0))  # east, north


def test_attitude_and_odometry_turn_to_east_north_and_counter_clockwise():
    lab = BaseLab()
    f = fed(lab, theirs("ATTITUDE", time_boot_ms=90_000, yaw=math.radians(90.0), yawspeed=0.2))
    assert f.yaw == pytest.approx(0.0, abs=1e-6)  # east
    assert f.yaw_rate == pytest.approx(-0.2)
    half = math.radians(30.0) / 2.0  # heading 30 deg east of north
    q = [math.cos(half), 0.0, 0.0, math.sin(half)]
    f = fed(lab, odometry(90_000_000, 1.0, 2.0, q, 2.0, 7))
    np.testing.assert_allclose(f.position, (2.0, 1.0))
    np.testing.assert_allclose(
        f.velocity, (2.0 * math.sin(math.radians(30)), 2.0 * math.cos(math.radians(30))), rtol=1e-6
    )
    assert f.reset == 7


def test_messages_that_overtake_each_other_are_put_right_and_not_counted_as_lost():
    lab = BaseLab()
    fed(lab, theirs("ATTITUDE", 0, time_boot_ms=90_000))
    f = fed(
        lab,
        theirs("LOCAL_POSITION_NED", 1, time_boot_ms=90_000, x=1.0),
        theirs("LOCAL_POSITION_NED", 3, time_boot_ms=90_040, x=3.0),
        theirs("LOCAL_POSITION_NED", 2, time_boot_ms=90_020, x=2.0),
        theirs("LOCAL_POSITION_NED", 3, time_boot_ms=90_040, x=9.0),  # twice
    )
    assert f.position[1] == 3.0
    assert f.fresh == 2
    assert f.lost == 0
    assert f.reboots == 0
    assert fed(lab, theirs("ATTITUDE", 9, time_boot_ms=90_100)).lost == 5
    assert fed(lab, theirs("ATTITUDE", (9 + 256 - 3) % 256, time_boot_ms=90_060)).lost == 0  # long gone, late


def test_obstacle_distance_honours_increment_offset_frame_and_its_marks():
    lab = BaseLab()
    cells = [65535] * 72
    cells[0], cells[1], cells[2], cells[3] = 300, 1201, 65535, 450
    f = fed(lab, obstacle_distance(cells, 3, 7.5, 30.0, 12))
    assert f.scans == 1
    np.testing.assert_allclose(f.scan[:5], (3.0, np.inf, -1.0, 4.5, -1.0))
    assert math.degrees(f.scan_start) == pytest.approx(-30.0)  # clockwise on the wire
    assert math.degrees(f.scan_step) == pytest.approx(-7.5)  # increment_f wins
    f = fed(lab, theirs("ATTITUDE", time_boot_ms=90_000, yaw=math.radians(100.0)))
    f = fed(lab, obstacle_distance(cells, 3, 0.0, 30.0, 0))
    # north aligned: sector 0 lies 30 deg east of north, 70 deg to the left of a nose at 100
    assert math.degrees(f.scan_start) == pytest.approx(70.0)
    assert math.degrees(f.scan_step) == pytest.approx(-3.0)


def test_single_distance_sensors_are_sectors_and_grow_stale():
    lab = BaseLab()
    f = fed(
        lab,
        distance_sensor(2, 250),
        distance_sensor(6, 800),  # nothing in range
        distance_sensor(25, 100),  # looks down
    )
    np.testing.assert_allclose(f.beams, (-1, -1, 2.5, -1, -1, -1, np.inf, -1))
    for _ in range(30):
        f = fed(lab)
        lab.link.wire.send([])
    assert (f.beams == -1.0).all()


def test_clocks_are_agreed_by_the_shortest_round_trip_and_anew_after_a_jump():
    clock = Clock()
    assert clock.ours(5.0, 100.0) == 100.0  # not known: as it came
    for delay_up, delay_down in [(0.2, 0.01), (0.01, 0.01), (0.1, 0.3)]:
        clock.answer(100.0, 100.0 + delay_up - 90.0, 100.0 + delay_up + delay_down)
    assert clock.offset == pytest.approx(-90.0, abs=1e-9)
    assert clock.ours(11.0, 102.0) == pytest.approx(101.0)
    assert clock.ours(50.0, 102.0) == 102.0  # ahead of now: a clock that runs away is not believed
    clock.answer(200.0, 200.01 - 50.0, 200.02)
    assert clock.offset == pytest.approx(-50.0, abs=1e-9)


def test_latitude_and_longitude_fall_where_a_geodesic_puts_them():
    origin = (-35.363262, 149.165237)
    a, e2 = 6378137.0, 0.00669437999014  # WGS 84
    for lat, lon in [(-35.3623, 149.1662), (-35.3670, 149.1600)]:
        east, north = local_of(origin, lat, lon, "ardupilot")
        phi = math.radians(0.5 * (lat + origin[0]))
        w = 1.0 - e2 * math.sin(phi) ** 2
        north_true = math.radians(lat - origin[0]) * a * (1.0 - e2) / w**1.5
        east_true = math.radians(lon - origin[1]) * a * math.cos(phi) / math.sqrt(w)
        # both autopilots project on a sphere: what counts is their frame, within half a percent of the Earth's
        np.testing.assert_allclose((east, north), (east_true, north_true), rtol=5e-3)


def greeted(config: Path, double: Any, *tables: str, **given: Any):
    """Return the link of a config to a double, after its handshake."""
    link = open_link(load(config), config, InProcess(double.exchange, 0.02))
    return link, link.handshake(**given)


def test_a_wrong_autopilot_is_a_config_error_and_one_that_is_not_there_yet_is_none(tmp_path):
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(ROVER.read_text().replace('"ardupilot"', '"px4"'))
    with pytest.raises(HandshakeError, match=r"link.autopilot: got a heartbeat of ardupilot, wanted px4"):
        greeted(wrong, rover.open_rover(ROVER))
    timed = tmp_path / "timed.toml"
    timed.write_text(ROVER.read_text().replace('type = "mavlink"', 'type = "mavlink"\nhandshake_s = 5.0'))
    double = rover.open_rover(ROVER, inject=["silent@0.0"])
    with pytest.raises(
        AbsentError, match=r"link.url: got silence, wanted the heartbeat of an ardupilot rover"
    ) as caught:
        greeted(timed, double)
    assert caught.value.exit_code == EXIT_FAILED  # no file can cure it: a unit tries again


def test_a_cold_autopilot_is_waited_for_and_what_is_missing_is_told():
    told: list[str] = []
    double = rover.open_rover(ROVER, inject=["cold_start@0.0"])
    link, start = greeted(ROVER, double, say=told.append)
    assert 60.0 < link.wire.now() < 70.0
    assert start.position_age < 0.5
    assert any("no position or attitude" in text for text in told)
    for _ in range(300):
        link.read(-1, 0, 0.0, 0.0)
        link.write(BaseCommand(Ask.SILENCE, 0.0, 0.0, np.zeros(2)))
    assert link.view.origin == pytest.approx((-35.363262, 149.165237))  # asked for again: cold, it was refused
    late = rover.open_rover(ROVER, inject=["cold_start@0.0"])
    with pytest.raises(StoppedError):
        greeted(ROVER, late, ended=lambda: late.autopilot.time > 3.0)


def test_another_vehicle_that_is_heard_first_is_passed_over(tmp_path):
    any_id = tmp_path / "any.toml"
    any_id.write_text(ROVER.read_text().replace("vehicle_id = 1\n", ""))
    double = rover.open_rover(ROVER)
    copter = theirs("HEARTBEAT", system=7, type=2, autopilot=3, custom_mode=0, base_mode=1)
    link = open_link(load(any_id), any_id, InProcess(lambda packets: [copter, *double.exchange(packets)], 0.02))
    link.handshake()
    assert link.vehicle == (1, 1)
    assert any("passed over" in line for line in link.events)


def test_denied_streams_are_told_and_what_comes_unasked_is_driven_by():
    lab = BaseLab(inject=["rates_denied@0.0"])
    assert lab.link.talk.rates == {}
    assert any("no stream was granted" in line for line in lab.link.events)
    lab.armed()
    assert lab.arrive(8.0, 1.0)
    truth = lab.rover.truth()
    assert math.hypot(truth.x - 8.0, truth.y - 1.0) < 0.5


def test_the_first_read_of_the_loop_has_all_packets_since_the_start_and_the_state_of_now():
    lab = BaseLab()
    handshake = list(lab.link._backlog)
    assert len(handshake) > 100
    for _ in range(250):  # the recorder starts, say: nobody reads
        lab.link.wire._waiting += lab.rover.exchange([])
        lab.link.wire._cycles += 1
    lab.link.settle()
    f = lab.link.read(0, 0, 0.0, 0.0)
    assert lab.link.received[: len(handshake)] == handshake
    assert len(lab.link.received) > len(handshake) + 500
    assert f.position_age < 0.1
    assert f.uplink_age < 0.1  # nothing was asked meanwhile: that is no deaf vehicle
    assert not lab.link._backlog


def test_frames_refused_is_a_fault_that_disturbs_nothing_and_a_signed_link_takes_no_others(tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    signed = tmp_path / "signed.toml"
    keyed = f'signing = "required"\nkey_file = "{key}"\nstate_file = "{tmp_path / "stamps"}"'
    signed.write_text(ROVER.read_text().replace('signing = "off"', keyed))
    lab = BaseLab(signed).driving(seconds=1.0)
    assert all(pamoja.MavlinkFrame.parse_known(raw, TIMESYNC).signed for raw in lab.sent)
    heard = list(lab.link.received)
    stop = theirs("HEARTBEAT", type=10, autopilot=3, custom_mode=0, base_mode=1)  # a forger would take the mode
    lab.link.wire._waiting += [stop, *heard]
    lab.tick()
    assert "frames_refused" in lab.faults
    assert lab.m.state == State.RUN
    assert lab.m.last.ours
    assert lab.link.counts["unsigned"] == 1
    assert lab.link.counts["replayed"] == len(heard)
    assert lab.run(2.0, lambda: not lab.faults)


def test_no_bytes_make_the_link_raise_or_believe_a_number_that_is_none():
    lab = BaseLab().armed()
    random = np.random.default_rng(9)
    for k in range(400):
        data = bytearray(random.bytes(int(random.integers(0, 60))))
        if k % 2 and lab.link.received:
            data = bytearray(lab.link.received[int(random.integers(len(lab.link.received)))])
            data[int(random.integers(len(data)))] ^= int(random.integers(1, 256))
        if k % 5 == 0:  # whole, of the vehicle, and nonsense: every float of it NaN
            data = bytearray(theirs("LOCAL_POSITION_NED", time_boot_ms=100_000 + k, x=math.nan, vx=math.inf))
            data += theirs("ATTITUDE", time_boot_ms=100_000 + k, yaw=math.nan)
        lab.link.wire._waiting.append(bytes(data))
        lab.tick()
        f = lab.m.last
        assert np.isfinite([*f.position, *f.velocity, f.yaw, f.yaw_rate]).all()


def test_udp_is_pinned_to_the_vehicle_and_deaf_to_strangers():
    wire = Udp("127.0.0.1", 0, True)
    port = wire._socket.getsockname()
    vehicle, stranger = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    try:
        assert wire.send([b"nobody there"]) == []
        vehicle.sendto(b"a", port)
        time.sleep(0.02)
        (data, address), *_ = wire.receive()
        wire.pin(address)
        stranger.sendto(b"b", port)
        vehicle.sendto(b"c", port)
        time.sleep(0.02)
        assert [d for d, _ in wire.receive()] == [b"c"]
        assert (data, wire.foreign) == (b"a", 1)
        assert wire.send([b"hello"]) == [b"hello"]
        vehicle.settimeout(1.0)
        assert vehicle.recv(100) == b"hello"
        stranger.settimeout(0.05)
        with pytest.raises(TimeoutError):
            stranger.recv(100)
    finally:
        for each in (vehicle, stranger, wire):
            each.close()


def test_a_tcp_peer_that_closes_is_noticed_and_found_again_when_it_is_back():
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    wire = open_wire(f"tcp:127.0.0.1:{port}")
    peer, _ = server.accept()
    peer.sendall(b"\xfdhello")
    time.sleep(0.02)
    assert wire.receive() == [(b"\xfdhello", None)]
    peer.close()
    time.sleep(0.02)
    assert wire.receive() == []
    assert wire.flags() & Link.DOWN
    time.sleep(1.05)
    wire.receive()
    again, _ = server.accept()
    assert wire.send([b"x"]) == [b"x"]
    again.settimeout(1.0)
    assert again.recv(10) == b"x"
    for each in (again, server, wire):
        each.close()
    with pytest.raises(LinkError, match="cannot be opened"):
        open_wire(f"tcp:127.0.0.1:{port}")


def test_a_serial_line_carries_packets_both_ways(tmp_path):
    line = tmp_path / "tty"
    port = open_port(f"serial:{line}:115200")
    wire = open_wire(f"serial:{line}:115200")
    try:
        packet = theirs("ATTITUDE", time_boot_ms=1)
        port.receive(0.0)
        port.send([packet])
        wire.send([packet])
        back: list[bytes] = []
        deadline, got = time.monotonic() + 2.0, b""
        while time.monotonic() < deadline and not (got and back):
            got += b"".join(data for data, _ in wire.receive())
            back += port.receive(0.01)
        assert got == packet
        assert back == [packet]
        with pytest.raises(LinkError):
            open_wire(f"serial:{line}:115200")  # locked
    finally:
        wire.close()
        port.close()


def test_all_bytes_are_in_the_log_and_pymavlinks_own_reader_takes_the_tlog(tmp_path):
    sent: list[bytes] = []
    received: list[bytes] = []

    def relay(way, packets):
        (sent if way == "up" else received).extend(packets)
        return packets

    from rtctl.app.rover_log import header_of

    probe = BaseLab()
    sink = McapSink(tmp_path / "run.mcap", header_of(probe.config, Path(ROVER), probe.base, probe.start))
    lab = BaseLab(relay=relay, sink=sink)
    sent.clear()
    lab.armed().run(1.0)
    received = received[: len(received) - len(lab.link.wire._waiting)]
    sink.close("end")
    log = read(tmp_path / "run.mcap")
    assert len(log["/mavlink/vehicle/tx"]) == len(sent)
    assert len(log["/mavlink/vehicle/rx"]) == len(received)
    out = tmp_path / "run.tlog"
    assert export_tlog(tmp_path / "run.mcap", out) == len(sent) + len(received)
    script = (
        "from pymavlink import mavutil; import sys\n"
        "m = mavutil.mavlink_connection(sys.argv[1]); seen = []\n"
        "while (x := m.recv_msg()) is not None: seen.append((x.get_type(), x.get_srcSystem()))\n"
        "print(len(seen), sum(t == ('SET_POSITION_TARGET_LOCAL_NED', 245) for t in seen), "
        "sum(t == ('LOCAL_POSITION_NED', 1) for t in seen), sum(t[0] == 'BAD_DATA' for t in seen))"
    )
    environment = {**os.environ, "MAVLINK20": "1", "MAVLINK_DIALECT": "ardupilotmega"}
    command = [sys.executable, "-W", "ignore", "-c", script, str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    total, setpoints, positions, bad = map(int, done.stdout.split())
    assert total == len(sent) + len(received)
    assert setpoints == sum(int.from_bytes(raw[7:10], "little") == 84 for raw in sent) > 20
    assert positions == sum(int.from_bytes(raw[7:10], "little") == 32 for raw in received) > 20
    assert bad == 0
    assert dialect.WIRE_PROTOCOL_VERSION == "2.0"
