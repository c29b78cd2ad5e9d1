"""A vehicle whose MAVLink is MAVSDK's: the C++ stack packs and parses; modes, streams and wheels are written here anew.

Nothing of it is shared with the other double: another hand's idea of the same definitions. It runs by the wall clock,
the stack's threads do.
"""

import json
import math
import threading
import time
from typing import Any

from mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct_server import MavlinkDirectServer
from mavsdk.plugins.mavlink_direct_server.mavlink_direct_server import MavlinkMessage

GUIDED, HOLD, ARMED = 15, 4, 128
SET_MODE, ARM, INTERVAL, REQUEST = 176, 400, 511, 512
NAMES = {32: "LOCAL_POSITION_NED", 30: "ATTITUDE", 193: "EKF_STATUS_REPORT", 24: "GPS_RAW_INT"}
SENSOR = 195  # component of the range sensor
LAG = 0.3  # [s] of speed and yaw rate


class MavsdkVehicle:
    """Autopilot and range sensor as two components, each a stack of its own, on one line of bytes."""

    def __init__(self) -> None:
        self.mode, self.armed = HOLD, False
        self.x = self.y = self.yaw = self.v = self.w = 0.0  # north, east [m], clockwise from north [rad]
        self.asked = (0.0, 0.0)  # [m/s], [rad/s] clockwise
        self.heard: list[tuple[str, dict[str, Any]]] = []
        self.commands: list[tuple[int, dict[str, Any]]] = []
        self.intervals: dict[str, float] = {}
        self.dropped = 0  # set-points in another mode
        self._due: dict[str, float] = {}
        self._out: list[bytes] = []
        self._lock = threading.Lock()
        self._began = self._before = time.monotonic()
        self._stacks = [self._stack(1), self._stack(SENSOR)]
        self._pilot, self._sensor = (server for _, server in self._stacks)
        for command in (SET_MODE, ARM, INTERVAL, REQUEST):
            self._pilot.subscribe_command(command, self._command, command)
        for name in ("SET_POSITION_TARGET_LOCAL_NED", "TIMESYNC", "HEARTBEAT"):
            self._pilot.subscribe_message(name, self._message)

    def _stack(self, component: int) -> tuple[Any, Any]:
        stack = Mavsdk(Configuration.create_manual(1, component, False))
        stack.add_any_connection("raw://")
        stack.subscribe_raw_bytes_to_be_sent(self._send)
        return stack, MavlinkDirectServer(stack.server_component_by_id(component))

    def _send(self, data: bytes) -> None:
        if data[7:10] == b"\0\0\0" and data[15] == 0:  # the stack's own heartbeat, of no autopilot: ours says which
            return
        with self._lock:
            self._out.append(data)

    def exchange(self, packets: list[bytes]) -> list[bytes]:
        """Hear packets, let 20 ms of the wall clock pass, return what was said."""
        for packet in packets:
            self._stacks[0][0].pass_received_raw_bytes(packet)
        time.sleep(0.02)
        self._step()
        with self._lock:
            out, self._out = self._out, []
        return out

    def close(self) -> None:
        """End both stacks and their threads."""
        for stack, _ in self._stacks:
            stack.destroy()

    # -- hearing: called by the stack's threads ------------------------------------------------------------------

    def _command(self, message: Any, command: int) -> None:
        fields = json.loads(message.fields_json)
        self.commands.append((command, fields))
        result = 0
        if command == SET_MODE:
            self.mode = int(fields["param2"])
        elif command == ARM:
            self.armed = fields["param1"] == 1.0
        elif command == INTERVAL:
            name, period = NAMES.get(int(fields["param1"])), 1e-6 * fields["param2"]
            result = 0 if name is not None and period >= 0.025 - 1e-9 else 2
            if name is not None and result == 0:
                self.intervals[name] = period
        else:
            result = 3
        ack = {
            "command": command,
            "result": result,
            "progress": 0,
            "result_param2": 0,
            "target_system": message.system_id,
            "target_component": message.component_id,
        }
        self._say(self._pilot, "COMMAND_ACK", ack)
        if command in (SET_MODE, ARM):
            self._due["HEARTBEAT"] = 0.0

    def _message(self, message: Any, _: Any) -> None:
        fields = json.loads(message.fields_json)
        self.heard.append((message.message_name, fields))
        if message.message_name == "TIMESYNC" and fields["tc1"] == 0:
            now = round(1e9 * (time.monotonic() - self._began)) + 1
            self._say(
                self._pilot, "TIMESYNC", {"tc1": now, "ts1": fields["ts1"], "target_system": 0, "target_component": 0}
            )
        elif message.message_name == "SET_POSITION_TARGET_LOCAL_NED":
            if self.mode == GUIDED and self.armed and fields["coordinate_frame"] == 8:
                self.asked = (fields["vx"], fields["yaw_rate"])
            else:
                self.dropped += 1

    # -- acting and telling --------------------------------------------------------------------------------------

    def _step(self) -> None:
        now = time.monotonic()
        dt, self._before = now - self._before, now
        v, w = self.asked if self.mode == GUIDED and self.armed else (0.0, 0.0)
        gain = min(dt / LAG, 1.0)
        self.v, self.w = self.v + gain * (v - self.v), self.w + gain * (w - self.w)
        self.yaw = math.remainder(self.yaw + dt * self.w, 2.0 * math.pi)
        self.x, self.y = self.x + dt * self.v * math.cos(self.yaw), self.y + dt * self.v * math.sin(self.yaw)
        self._periodic(now)

    def _periodic(self, now: float) -> None:
        boot = round(1e3 * (now - self._began))
        north, east = self.v * math.cos(self.yaw), self.v * math.sin(self.yaw)
        told = {
            "HEARTBEAT": {
                "type": 10,
                "autopilot": 3,
                "base_mode": 1 | (ARMED if self.armed else 0),
                "custom_mode": self.mode,
                "system_status": 4,
                "mavlink_version": 3,
            },
            "LOCAL_POSITION_NED": {
                "time_boot_ms": boot,
                "x": self.x,
                "y": self.y,
                "z": 0.0,
                "vx": north,
                "vy": east,
                "vz": 0.0,
            },
            "ATTITUDE": {
                "time_boot_ms": boot,
                "roll": 0.0,
                "pitch": 0.0,
                "yaw": self.yaw,
                "rollspeed": 0.0,
                "pitchspeed": 0.0,
                "yawspeed": self.w,
            },
            "EKF_STATUS_REPORT": {
                "flags": 63,
                "velocity_variance": 0.1,
                "pos_horiz_variance": 0.1,
                "pos_vert_variance": 0.1,
                "compass_variance": 0.1,
                "terrain_alt_variance": 0.0,
            },
        }
        for name, fields in told.items():
            period = 1.0 if name == "HEARTBEAT" else self.intervals.get(name, 0.0)
            if period and now >= self._due.get(name, 0.0):
                self._due[name] = now + period
                self._say(self._pilot, name, fields)
        if now >= self._due.get("scan", 0.0):
            self._due["scan"] = now + 0.1
            scan = {
                "time_usec": round(1e6 * time.time()),
                "sensor_type": 0,
                "distances": [1201] * 72,
                "increment": 5,
                "min_distance": 20,
                "max_distance": 1200,
                "increment_f": 5.0,
                "angle_offset": 0.0,
                "frame": 12,
            }
            self._say(self._sensor, "OBSTACLE_DISTANCE", scan)

    def _say(self, server: Any, name: str, fields: dict[str, Any]) -> None:
        server.send_message(MavlinkMessage(message_name=name, fields_json=json.dumps(fields)))
