"""The rover's autopilot as the loop sees it."""

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path

from rtctl.app.vehicle import Say, never
from rtctl.design.rover import key_of
from rtctl.hal.mavlink.keys import Keys
from rtctl.hal.mavlink.link import MavLink
from rtctl.hal.mavlink.ranging import ANY, ANY_BEAM, SensorSpec
from rtctl.hal.mavlink.stacks import MavSpec
from rtctl.hal.mavlink.wire import Wire, open_wire
from rtctl.rover.signals import BaseFeedback
from rtctl.spec.base import BaseConfig, streams

SIMULATED_WAIT = 120.0  # [s] of simulated time
EPOCH = 1_790_000_000 * 10**9  # [ns] Unix time at which simulations begin


class RoverLink(MavLink):
    """A MAVLink that greets its vehicle, as every vehicle's link does."""

    counters = ()  # frames are made of more than the commands: they are not made again

    @property
    def said(self) -> deque[str]:
        """What the vehicle told people."""
        return self.events

    def greet(self, lockstep: bool, say: Say | None = None, ended: Callable[[], bool] = never) -> BaseFeedback:
        """Return the feedback that the handshake leaves. Raises HandshakeError, AbsentError, StoppedError."""
        return self.handshake(say, ended)

    def wait_replies(self, timeout: float) -> bool:
        """Return at once: an autopilot sends when it wants to."""
        return True


def open_link(config: BaseConfig, path: Path, wire: Wire | None = None) -> RoverLink:
    """Return the opened link of a checked config; a simulator's `wire` brings its own clock. Raises RtctlError.

    A real vehicle is waited for unless `handshake_s` bounds it; a simulated one for SIMULATED_WAIT.
    """
    c = config.link
    key, line = key_of(config, path), streams(config)
    state = None if c.state_file is None else Path(c.state_file)
    if state is not None and not state.is_absolute():
        state = path.parent / state
    spec = MavSpec(
        place=str(path),
        autopilot=c.autopilot,
        system=c.system_id,
        component=c.component_id,
        vehicle=c.vehicle_id,
        period=1.0 / config.loop.servo_hz,
        timeout=c.handshake_s or (math.inf if wire is None else SIMULATED_WAIT),
        scan=config.avoid.scan == "required",
        sensors=sensors_of(config),
        quick=math.inf if line is None else line.quick,
        every=1 if line is None else line.every,
    )
    if wire is None:
        return RoverLink(spec, open_wire(c.url), Keys(key, state, c.signing_link_id))
    simulated = wire
    return RoverLink(spec, wire, Keys(key, state, c.signing_link_id, lambda: EPOCH + round(1e9 * simulated.now())))


def sensors_of(config: BaseConfig) -> tuple[SensorSpec, ...]:
    """Return the range sensors that are listened to: those of the config, or whoever speaks first."""
    return tuple(
        SensorSpec(s.name, s.system, s.component, s.message, s.yaw_rad, s.offset_m, s.frame, s.min_m, s.max_m)
        for s in config.sensor
    ) or (ANY, ANY_BEAM)
