"""The link to an autopilot: MAVLink 2 bytes in, `BaseFeedback` out; commands in, bytes out. One thread, no waiting."""

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from rtctl.errors import AbsentError, StoppedError
from rtctl.hal.mavlink.hearing import Hearing
from rtctl.hal.mavlink.keys import Keys
from rtctl.hal.mavlink.message import Message, dialect
from rtctl.hal.mavlink.stacks import ONLY, STACKS, STREAMS, MavSpec
from rtctl.hal.mavlink.steering import STILL, Steering
from rtctl.hal.mavlink.talk import Order, Talk, request, stream
from rtctl.hal.mavlink.view import View, local_of
from rtctl.hal.mavlink.wire import Wire
from rtctl.protocol.mavlink_budget import QUICK
from rtctl.rover.signals import BaseCommand, BaseFeedback

HEARTBEAT = 1.0  # [s] between ours
TIMESYNC = 0.5  # [s]
SILENT = 1.0  # [s] without a position from a vehicle that is there: its streams are asked for anew
TIMESYNC_FAST = 0.1  # [s] until clocks are agreed
EVENTS_MAX = 200  # lines kept
BACKLOG = 100_000  # frames of the handshake that are kept for the log
SETTLE, FRESH = 2.0, 0.1  # [s] for the state of now after the handshake; what counts as that
PROGRESS = 5.0  # [s] between two lines on what is waited for
ORIGIN = 3.0  # [s] between two questions for the origin, while it is not known
ASKING = 8.0  # [s] after which settings that the vehicle does not tell are waited for no more


class MavLink:
    """One vehicle behind one wire."""

    def __init__(self, spec: MavSpec, wire: Wire, keys: Keys) -> None:
        self.spec, self.wire, self.keys = spec, wire, keys
        self.stack = STACKS[spec.autopilot]
        self.events: deque[str] = deque(maxlen=EVENTS_MAX)  # what people should read: refusals, texts of the vehicle
        self.view = View(self.events.append, spec.sensors, spec.autopilot)
        self.talk = Talk()
        self.hearing = Hearing(spec, wire, keys, self.view, self.talk, self.events.append)
        self.received: list[bytes] = []  # frames of this cycle as they came
        self._mav = dialect.MAVLink(None, srcSystem=spec.system, srcComponent=spec.component)
        self.steering = Steering(self.stack, spec.every, self.view, self.talk, self._mav, self.events.append)
        self._heartbeat_due = self._sync_due = -math.inf
        self._reboots = 0
        self._subscribed = math.inf  # [s] when streams were asked for
        self._backlog: deque[bytes] = deque(maxlen=BACKLOG)  # of the handshake, until the loop's first read
        self._origin_asked = math.inf  # [s]

    @property
    def vehicle(self) -> tuple[int, int] | None:
        """Its (system, component), once it was heard."""
        return self.hearing.vehicle

    @property
    def counts(self) -> dict[str, int]:
        """How much else came, by what it was."""
        return self.hearing.counts

    # -- reading -------------------------------------------------------------------------------------------------

    def read(self, slot: int, missed: int, lateness: float, compute: float) -> BaseFeedback:
        """Return what is known of the vehicle at this slot; the loop's first has all packets since the start."""
        self.hearing.drain()
        self.received = self.hearing.frames
        if slot < 0:
            self._backlog.extend(self.received)
        elif self._backlog:
            self.received = [*self._backlog, *self.received]
            self._backlog.clear()
        now, v = self.wire.now(), self.view
        v.ranging.next()
        scan, seen = v.ranging.scan, v.ranging
        sensor = seen.specs[scan.sensor]
        silent = now - v.position_at > SILENT and now - v.heartbeat_at < HEARTBEAT + 1.0
        if v.reboots != self._reboots or (silent and self.talk.idle and self._subscribed < now - SILENT):
            self._reboots = v.reboots
            self._subscribe()
        elif v.origin is None and self.talk.idle and now - self._origin_asked > ORIGIN:
            self._ask_for_origin(now)
        return BaseFeedback(
            slot=slot,
            missed=missed,
            position=v.position,
            velocity=v.velocity,
            yaw=v.yaw,
            yaw_rate=v.yaw_rate,
            position_age=now - v.position_at,
            attitude_age=now - v.attitude_at,
            fresh=v.fresh,
            reset=v.reset,
            scan=scan.ranges,
            scan_start=scan.start,
            scan_step=scan.step,
            scan_reach=scan.reach,
            scan_age=now - scan.at,
            scans=seen.fresh,
            sensor=scan.sensor,
            scan_offset=np.array(sensor.offset),
            scan_wrong=seen.wrong,
            known_age=now - seen.known_at,
            beams=seen.beams_now(now),
            beam_reach=seen.beam_reach,
            heartbeat_age=now - v.heartbeat_at,
            uplink_age=0.0 if math.isnan(v.uplink_at) else now - v.uplink_at,
            fix_lost=v.fix_lost,
            quality=v.quality,
            ours=v.mode == self.stack.ours,
            mode=max(v.mode, 0),
            armed=v.armed,
            reboots=v.reboots,
            healthy=v.healthy,
            word=int(self.steering.word),
            lost=self.hearing.lost,
            refused=self.hearing.refused,
            link=self.wire.flags(),
            lateness=lateness,
            compute=compute,
        )

    # -- writing -------------------------------------------------------------------------------------------------

    def write(self, command: BaseCommand) -> list[bytes]:
        """Send what the command asks for and what the conversation needs; return the frames that went out."""
        now = self.wire.now()
        messages = self._housekeeping(now)
        if self.vehicle is not None:
            messages += self.steering.messages(command, self.vehicle, now)
            due = self.talk.due(now)
            if due is not None:
                messages.append(self._command(*due))
        packets = [self.keys.signed(bytes(m.pack(self._mav)), m.crc_extra) for m in messages]
        went = self.wire.send(packets)
        self.keys.keep()
        return went

    def _housekeeping(self, now: float) -> list[Message]:
        messages: list[Message] = []
        if now >= self._heartbeat_due:
            self._heartbeat_due = now + HEARTBEAT - 0.5 * self.spec.period
            messages.append(self._mav.heartbeat_encode(18, 8, 0, 0, 4))  # onboard controller, no autopilot, active
        if now >= self._sync_due and self.vehicle is not None:
            self._sync_due = now + (TIMESYNC if len(self.view.asked) or self._synced() else TIMESYNC_FAST)
            stamp = max(1, round(now * 1e9))
            self.view.asked.append(stamp)
            messages.append(self._mav.timesync_encode(0, stamp))
        return messages

    def _synced(self) -> bool:
        return not math.isnan(self.view.clock.offset)

    def _command(self, order: Order, confirmation: int) -> Message:
        assert self.vehicle is not None
        sender, parameters = self._mav, order.parameters
        message: Message = sender.command_long_encode(*self.vehicle, order.command, confirmation, *parameters)
        return message

    # -- the start -----------------------------------------------------------------------------------------------

    def handshake(
        self, say: Callable[[str], None] | None = None, ended: Callable[[], bool] = lambda: False
    ) -> BaseFeedback:
        """Find the vehicle, ask for its streams and settings, and wait for what is not there yet.

        say: is told what is waited for. ended: whether to give up. Nothing is armed and no mode is changed here.
        Raises HandshakeError for what a file can cure, AbsentError after `timeout`, StoppedError.
        """
        begun = self.wire.now()
        told, names = begun, list(self.stack.parameters)
        asked, asked_at, subscribed = 0, begun, False
        while True:
            feedback = self.read(-1, 0, 0.0, 0.0)
            now = self.wire.now()
            if self.vehicle is not None and not subscribed:
                self._subscribe()
                subscribed, asked_at = True, now
            self.write(STILL)
            if subscribed and asked < 2 * len(names) and now >= asked_at:
                asked, asked_at = asked + 1, now + 0.1  # a parameter takes about that long
                self._ask_parameter(names[(asked - 1) % len(names)])
            missing = self._missing(feedback, subscribed)
            settled = asked >= 2 * len(names) and (self.talk.idle or now - begun > ASKING)
            if missing is None and settled:
                break
            if ended():
                raise StoppedError(f"{self.spec.place}: stopped while it waited for the vehicle")
            if missing is not None and now - begun > self.spec.timeout:
                raise AbsentError(f"{self.spec.place}: link.url: got {missing[0]}, wanted {missing[1]}")
            if missing is not None and say is not None and now - told >= PROGRESS:
                told = now
                say(f"waiting since {now - begun:.0f} s: {missing[0]}, wanted {missing[1]}{self._last_words()}")
            self.wire.rest(self.spec.period)
        self._report()
        return feedback

    def settle(self) -> None:
        """Take all that came since the handshake, so that the loop begins with the state of now.

        A socket that nobody reads keeps what came first: what is of now may have to be waited for.
        """
        until = self.wire.now() + SETTLE
        while True:
            f = self.read(-1, 0, 0.0, 0.0)
            self.write(STILL)
            if f.position_age < FRESH or self.wire.now() > until:
                break
            if not self.received:
                self.wire.rest(self.spec.period)
        self.view.uplink_at = math.nan  # nothing was asked meanwhile

    def _last_words(self) -> str:
        return f" ({self.events[-1]})" if self.events else ""

    def _ask_parameter(self, name: str) -> None:
        assert self.vehicle is not None
        if name not in self.view.parameters:
            self._send(self._mav.param_request_read_encode(*self.vehicle, name.encode(), -1))

    def _send(self, message: Message) -> None:
        self.wire.send([self.keys.signed(bytes(message.pack(self._mav)), message.crc_extra)])

    def _subscribe(self) -> None:
        """Ask for every stream, anew after the autopilot started anew."""
        self._subscribed = self.wire.now()
        left_out = ONLY[self.spec.autopilot]
        for name, (message, rate) in STREAMS.items():
            if name not in left_out:
                self.talk.drop((name,))
                self.talk.give(stream(name, message, min(rate, self.spec.quick if name in QUICK else rate)))
        self.talk.drop(("AUTOPILOT_VERSION",))
        self.talk.give(request("AUTOPILOT_VERSION", 148))
        self._ask_for_origin(self._subscribed)

    def _ask_for_origin(self, now: float) -> None:
        """Ask where on Earth (0, 0) is; an autopilot without a position refuses, so it is asked again."""
        self._origin_asked = now
        self.talk.drop(("GPS_GLOBAL_ORIGIN",))
        self.talk.give(request("GPS_GLOBAL_ORIGIN", 49))

    def _missing(self, f: BaseFeedback, found: bool) -> tuple[str, str] | None:
        """Return (what came, what was wanted) of the first thing that a start needs."""
        if not found:
            heard = ", ".join(f"{n} {what}" for what, n in sorted(self.counts.items())) or "silence"
            return heard, f"the heartbeat of an {self.spec.autopilot} rover"
        if not (f.position_age < 1.0 and f.attitude_age < 1.0):
            return "no position or attitude", "LOCAL_POSITION_NED or ODOMETRY, and ATTITUDE"
        if self.spec.scan and not f.known_age < 1.0:
            return "no range sensor's OBSTACLE_DISTANCE or DISTANCE_SENSOR", 'a range sensor, or avoid.scan = "off"'
        return None

    def _report(self) -> None:
        """Tell what was granted, and which settings of the vehicle may fight or fail to stop us."""
        rates = ", ".join(f"{name} {rate:g} Hz" for name, rate in self.talk.rates.items())
        self.events.append(f"vehicle {self.vehicle}, {rates or 'no stream was granted'}")
        p = self.view.parameters
        self.events.append("parameters: " + (", ".join(f"{k} = {v:g}" for k, v in p.items()) or "none was answered"))
        if p.get("AVOID_ENABLE", 0.0) or p.get("OA_TYPE", 0.0):
            self.events.append("the autopilot's own avoidance is on: it acts on our velocities and can fight ours")
        if p.get("FS_GCS_ENABLE", 1.0) == 0.0:
            self.events.append("FS_GCS_ENABLE = 0: the autopilot does not stop by itself when this program is gone")

    def local(self, latitude: float, longitude: float) -> tuple[float, float] | None:
        """Return (east, north) [m] of a place [deg]; None while the vehicle's origin is not known."""
        origin = self.view.home if self.view.relative_to_home else self.view.origin
        return None if origin is None else local_of(origin, latitude, longitude, self.spec.autopilot)

    def close(self) -> None:
        """Keep the timestamps and close the wire."""
        self.keys.keep(last=True)
        self.wire.close()
