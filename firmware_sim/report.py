"""What a run of the virtual robot showed, as one JSON file that is whole at every moment."""

import json
import time
from typing import Any

from firmware_sim.drive import NS
from firmware_sim.simulator import Simulator
from firmware_sim.writer import Writer

FLUSH_S = 0.5  # [s] of wall time between two writes


class Report:
    """Keeps minima and maxima over a run; has them written."""

    def __init__(self, simulator: Simulator, path: str | None, mode: str) -> None:
        self.simulator, self.mode = simulator, mode
        self.writer = Writer(path) if path is not None else None
        self.clearance: dict[str, float] = {}
        self.self_clearance = float("inf")
        self.max_speed = [0.0] * len(simulator.drives)
        self.extra: dict[str, Any] = {}
        self._next = 0.0

    def observe(self) -> None:
        """Measure this period's clearances and speeds."""
        truth = self.simulator.truth()
        for name, distance in truth.clearance.items():
            self.clearance[name] = min(distance, self.clearance.get(name, distance))
        self.self_clearance = min(self.self_clearance, truth.self_clearance)
        self.max_speed = [max(m, abs(float(v))) for m, v in zip(self.max_speed, truth.qd, strict=True)]

    def _trips(self) -> list[dict[str, Any]]:
        """Return every latched fault: when, why, how long after the last valid command, and when the joint stood."""
        found = []
        for joint, drive in zip(self.simulator.settings.joints, self.simulator.drives, strict=True):
            for trip in drive.trips:
                found.append(
                    {
                        "joint": joint.name,
                        "code": trip.code,
                        "time_s": trip.at / NS,
                        "last_command_s": trip.last_valid / NS,
                        "command_to_fault_s": (trip.at - trip.last_valid) / NS,
                        "command_to_rest_s": (trip.rest - trip.last_valid) / NS if trip.rest >= 0 else None,
                    }
                )
        return sorted(found, key=lambda t: (t["time_s"], t["joint"]))

    def data(self) -> dict[str, Any]:
        """Return the report as plain values."""
        s = self.simulator
        names = [j.name for j in s.settings.joints]
        trips = self._trips()
        rests = [t["command_to_rest_s"] for t in trips]
        return {
            "robot": s.settings.name,
            "mode": self.mode,
            "time_s": s.time,
            "scene_s": s.plant.scene_ns / NS,
            "min_clearance_m": {"all": min(self.clearance.values(), default=None), **self.clearance},
            "min_self_clearance_m": self.self_clearance if self.self_clearance < float("inf") else None,
            "contacts": len(s.plant.contacts),
            "contact_events": [c._asdict() for c in s.plant.contacts[:100]],
            "trips": trips,
            "watchdog_trips": sum(t["code"] == 0xD for t in trips),
            "stop_s": max(rests) if rests and None not in rests else None,
            "max_torque_Nm": dict(zip(names, s.max_torque, strict=True)),
            "max_speed_rad_s": dict(zip(names, self.max_speed, strict=True)),
            "states": {n: d.state.name for n, d in zip(names, s.drives, strict=True)},
            "rejected_frames": {n: d.rejected for n, d in zip(names, s.drives, strict=True)},
            "temperature_C": {n: round(d.temperature, 3) for n, d in zip(names, s.drives, strict=True)},
            "q_rad": list(s.plant.q),
            "tip_m": [float(v) for v in s.plant.tip_pose()[0]],
            "speed_rad_s": [float(v) for v in s.plant.qd],
            "torque_Nm": [float(d.torque) for d in s.drives],
            "brake": [bool(d.brake) for d in s.drives],
            **self.extra,
        }

    def flush(self) -> None:
        """Renew the file every FLUSH_S; never waits for the disk."""
        if self.writer is not None and time.monotonic() >= self._next:
            self._next = time.monotonic() + FLUSH_S
            self.writer.put(self._text())

    def close(self) -> None:
        """Write the final account."""
        if self.writer is not None:
            self.writer.close(self._text())
            self.writer = None

    def _text(self) -> bytes:
        return json.dumps(self.data(), indent=1, allow_nan=False).encode() + b"\n"
