"""The link to an autopilot: MAVLink 2 bytes in, `BaseFeedback` out; commands in, bytes out. One thread, no waiting.

Frames are judged (signature, ids, checksum) before anything parses them. Nothing the vehicle does not confirm is
believed: modes and arming are what its heartbeat says.
"""

import math
import os
import struct
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtctl.hal.mavlink.message import Message

os.environ["MAVLINK20"] = "1"  # before pymavlink is imported: it starts as MAVLink 1 otherwise
from pymavlink.dialects.v20 import ardupilotmega as dialect

from rtctl.errors import AbsentError, HandshakeError, StoppedError
from rtctl.hal.mavlink.keys import Keys
from rtctl.hal.mavlink.ranging import SensorSpec
from rtctl.hal.mavlink.talk import Order, Talk, request, stream
from rtctl.hal.mavlink.view import View, enu, local_of
from rtctl.hal.mavlink.wire import Address, Wire
from rtctl.protocol import signing
from rtctl.protocol.mavlink_budget import QUICK
from rtctl.rover.signals import Ask, BaseCommand, BaseFeedback, Word

HEARTBEAT = 1.0  # [s] between ours
TIMESYNC = 0.5  # [s]
SILENT = 1.0  # [s] without a position from a vehicle that is there: its streams are asked for anew
TIMESYNC_FAST = 0.1  # [s] until clocks are agreed
PRESTREAM = 1.3  # [s] of set-points before PX4 may be asked for OFFBOARD: it wants more than one
WINDOW = 64  # sequence numbers within which a late message is no loss
AUTOPILOT1 = 1  # component id of an autopilot
ARM, MODE = 400, 176
VELOCITY_YAW_RATE = 0x05C7  # of SET_POSITION_TARGET_LOCAL_NED: velocity and yaw rate count
VELOCITY = 0x0DC7  # velocity alone
LOCAL_NED, BODY_NED = 1, 8
EVENTS_MAX = 200  # lines kept
BACKLOG = 100_000  # frames of the handshake that are kept for the log
SETTLE, FRESH = 2.0, 0.1  # [s] for the state of now after the handshake; what counts as that
PROGRESS = 5.0  # [s] between two lines on what is waited for
ORIGIN = 3.0  # [s] between two questions for the origin, while it is not known
ASKING = 8.0  # [s] after which settings that the vehicle does not tell are waited for no more


class Stack(NamedTuple):
    """How one autopilot wants to be spoken to."""

    autopilot: int  # MAV_AUTOPILOT
    ours: int  # custom_mode in which it takes our set-points
    enter: tuple[float, float]  # its main and sub mode, for DO_SET_MODE
    hold: tuple[float, float]
    world: bool  # takes a world velocity
    prestream: float  # [s] of set-points before the mode
    parameters: tuple[str, ...]  # reported at connect: what may fight or stop us


STACKS = {
    "ardupilot": Stack(
        3,
        15,
        (15.0, 0.0),
        (4.0, 0.0),
        False,
        0.0,
        ("AVOID_ENABLE", "OA_TYPE", "PRX1_TYPE", "FS_GCS_ENABLE", "MAV_GCS_SYSID", "SYSID_MYGCS"),
    ),
    "px4": Stack(12, 6 << 16, (6.0, 0.0), (4.0, 3.0), True, PRESTREAM, ("COM_OF_LOSS_T", "COM_OBL_RC_ACT")),
}
STREAMS = {  # name -> (message id, Hz)
    "LOCAL_POSITION_NED": (32, 50.0), "ATTITUDE": (30, 50.0), "ODOMETRY": (331, 50.0), "OBSTACLE_DISTANCE": (330, 10.0),
    "DISTANCE_SENSOR": (132, 10.0), "EKF_STATUS_REPORT": (193, 10.0), "ESTIMATOR_STATUS": (230, 10.0),
    "GPS_RAW_INT": (24, 5.0), "GLOBAL_POSITION_INT": (33, 2.0), "HOME_POSITION": (242, 1.0),
}  # fmt: skip
ONLY = {  # left out
    "ardupilot": ("ODOMETRY", "ESTIMATOR_STATUS", "OBSTACLE_DISTANCE"),
    "px4": ("EKF_STATUS_REPORT", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "HOME_POSITION"),
}
ROVERS = (10, 11)  # MAV_TYPE: ground rover, surface boat


class MavSpec(NamedTuple):
    """What the link needs to know."""

    place: str  # named in refusals
    autopilot: str
    system: int
    component: int
    vehicle: int | None
    period: float  # [s]
    timeout: float  # [s] that the handshake waits for what is not there yet; infinite: for ever
    scan: bool  # a scan is required
    sensors: tuple[SensorSpec, ...]
    quick: float = math.inf  # [Hz] of position and attitude, where the line bears no more
    every: int = 1  # period in which a set-point goes out


class MavLink:
    """One vehicle behind one wire."""

    def __init__(self, spec: MavSpec, wire: Wire, keys: Keys) -> None:
        self.spec, self.wire, self.keys = spec, wire, keys
        self.stack = STACKS[spec.autopilot]
        self.events: deque[str] = deque(maxlen=EVENTS_MAX)  # what people should read: refusals, texts of the vehicle
        self.view = View(self.events.append, spec.sensors, spec.autopilot)
        self.talk = Talk()
        self.received: list[bytes] = []  # frames of this cycle as they came
        self.vehicle: tuple[int, int] | None = None  # pinned (system, component)
        self.counts: dict[str, int] = {}
        self._mav = dialect.MAVLink(None, srcSystem=spec.system, srcComponent=spec.component)
        self._rest: dict[Address, bytes] = {}
        self._seen: deque[int] = deque(maxlen=WINDOW)
        self._newest = -1  # sequence number, unwrapped
        self._refused = self._lost = 0
        self._heartbeat_due = self._sync_due = -math.inf
        self._ask, self._asked_at = Ask.SILENCE, 0.0
        self._setpoints_since = -1.0
        self._turn = 0  # periods since set-points are streamed
        self._word = Word.PENDING
        self._reboots = 0
        self._subscribed = math.inf  # [s] when streams were asked for
        self._backlog: deque[bytes] = deque(maxlen=BACKLOG)  # of the handshake, until the loop's first read
        self._origin_asked = math.inf  # [s]
        self._strangers: set[tuple[int, int]] = set()

    # -- reading -------------------------------------------------------------------------------------------------

    def read(self, slot: int, missed: int, lateness: float, compute: float) -> BaseFeedback:
        """Return what is known of the vehicle at this slot; the loop's first has all packets since the start."""
        self._drain()
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
            word=int(self._word),
            lost=self._lost,
            refused=self._refused,
            link=self.wire.flags(),
            lateness=lateness,
            compute=compute,
        )

    def _drain(self) -> None:
        self.view.cycle()
        self.received, self._refused, self._lost = [], 0, 0
        now = self.wire.now()
        for data, address in self.wire.receive():
            frames, rest, junk = signing.split(self._rest.pop(address, b"") + data)
            self._rest = {address: rest[-signing.LONGEST :]} if rest else {}
            self._count("junk", junk)
            for frame in frames:
                self.received.append(frame.raw)
                self._judge(frame, address, now)

    def _judge(self, frame: signing.Frame, address: Address, now: float) -> None:
        """Let a frame through that is signed (if it must be), the vehicle's, known and whole."""
        verdict = self.keys.judge(frame)
        if verdict == signing.Verdict.GOOD and frame.message not in dialect.mavlink_map:
            verdict = signing.Verdict.UNKNOWN
        if verdict != signing.Verdict.GOOD:
            self._refused += verdict != signing.Verdict.UNKNOWN
            self._count(verdict.name.lower(), 1)
            return
        try:
            message = self._mav.decode(bytearray(frame.raw))
        except (dialect.MAVError, struct.error, ValueError, TypeError):
            self._refused += 1
            self._count("damaged", 1)
            return
        source = (frame.system, frame.component)
        if self.vehicle is None:
            self._discover(message, source, address)
        if self.vehicle is None or source != self.vehicle:
            if self.vehicle is None or not self.view.sensed(message, source, self.vehicle[0], now):
                self._count("of others", 1)
            return
        if address is not None:
            self.wire.pin(address)
        self._sequence(frame.sequence)
        if message.get_type() == "COMMAND_ACK":
            self._acknowledged(message, now)
            return
        if self.view.sensed(message, source, source[0], now):
            return
        self.view.take(message, now)

    def _acknowledged(self, message: Message, now: float) -> None:
        """Take a COMMAND_ACK that is for us."""
        for_us = message.target_system in (0, self.spec.system) and message.target_component in (0, self.spec.component)
        if for_us and self.talk.answer(int(message.command), int(message.result), now):
            self.view.answered(now)

    def _discover(self, message: Message, source: tuple[int, int], address: Address) -> None:
        """Pin the vehicle by its heartbeat; others are passed over, and told of once.

        HandshakeError when the one that the config names by its id is another kind than it says: a file can cure that.
        """
        spec = self.spec
        if message.get_type() != "HEARTBEAT" or message.autopilot == 8 or source[1] != AUTOPILOT1:
            return
        if spec.vehicle is not None and source[0] != spec.vehicle:
            return
        if message.autopilot != self.stack.autopilot:
            names = {stack.autopilot: name for name, stack in STACKS.items()}
            got = names.get(message.autopilot, f"autopilot type {message.autopilot}")
            if spec.vehicle is not None:
                raise HandshakeError(f"{spec.place}: link.autopilot", f"a heartbeat of {got}", spec.autopilot)
            self._pass_over(source, got)
            return
        if message.type not in ROVERS:
            self._pass_over(source, f"a vehicle of MAV_TYPE {message.type}")
            return
        self.vehicle = source
        if address is not None:
            self.wire.pin(address)

    def _pass_over(self, source: tuple[int, int], what: str) -> None:
        if source not in self._strangers:
            self._strangers.add(source)
            self.events.append(f"{source} is {what}: passed over, an {self.spec.autopilot} rover is waited for")

    def _sequence(self, sequence: int) -> None:
        """Count messages that did not come within a window of later ones; one that is late is no loss."""
        if self._newest < 0:
            self._newest = sequence
            self._seen.extend(range(sequence - WINDOW + 1, sequence + 1))
            return
        ahead = (sequence - self._newest + 128) % 256 - 128
        at = self._newest + ahead
        if ahead <= 0:
            if at not in self._seen and ahead > -WINDOW:
                self._seen.append(at)
                self._lost = max(self._lost - 1, 0)
            return
        self._lost += ahead - 1
        self._newest = at
        self._seen.append(at)

    def _count(self, what: str, by: int) -> None:
        if by:
            self.counts[what] = self.counts.get(what, 0) + by

    # -- writing -------------------------------------------------------------------------------------------------

    def write(self, command: BaseCommand) -> list[bytes]:
        """Send what the command asks for and what the conversation needs; return the frames that went out."""
        now = self.wire.now()
        messages = self._housekeeping(now)
        if self.vehicle is not None:
            messages += self._steer(command, now)
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

    def _steer(self, command: BaseCommand, now: float) -> list[Message]:
        """Follow what is asked of the autopilot: its mode, its arming, and set-points while the mode is ours."""
        if command.ask != self._ask:
            self._turned(command.ask, now)
        ours = self.view.mode == self.stack.ours
        if self._ask == Ask.ENGAGE:
            self._engage(ours, now)
        streams = self._ask in (Ask.DRIVE, Ask.HOLD) and ours
        if self._ask == Ask.ENGAGE:
            streams = ours or self.stack.prestream > 0.0
        if not streams:
            self._setpoints_since = -1.0
            return []
        if self._setpoints_since < 0.0:
            self._setpoints_since, self._turn = now, 0
        self._turn += 1
        if (self._turn - 1) % self.spec.every:
            return []
        return [self._setpoint(command if self._ask == Ask.DRIVE else command._replace(v=0.0, w=0.0, velocity=_ZERO))]

    def _turned(self, ask: Ask, now: float) -> None:
        """Forget what was asked before, and ask anew."""
        self.talk.drop(("mode", "arm", "hold", "disarm"))
        self._ask, self._asked_at, self._word = ask, now, Word.PENDING
        if ask == Ask.HOLD:
            self.talk.give(Order("hold", MODE, (1.0, *self.stack.hold, 0.0, 0.0, 0.0, 0.0)), first=True)
        elif ask == Ask.DISARM:
            self.talk.give(Order("disarm", ARM, (0.0,) * 7), first=True)

    def _engage(self, ours: bool, now: float) -> None:
        """Mode first, then arming; each asked once, repeated by `Talk`, and ended by a refusal."""
        answers = self.talk.answers
        for name in ("mode", "arm"):
            word = answers.get(name, Word.PENDING)
            if word not in (Word.PENDING, Word.ACCEPTED):
                if self._word == Word.PENDING:
                    self.events.append(
                        f"{'arming' if name == 'arm' else 'our mode'}: {word.name.lower().replace('_', ' ')}"
                    )
                self._word = word
                return
        streamed = self._setpoints_since >= 0.0 and now - self._setpoints_since >= self.stack.prestream
        if (
            not ours
            and "mode" not in answers
            and not self.talk.holds("mode")
            and (streamed or not self.stack.prestream)
        ):
            self.talk.give(Order("mode", MODE, (1.0, *self.stack.enter, 0.0, 0.0, 0.0, 0.0)), first=True)
        if ours and not self.view.armed and "arm" not in answers and not self.talk.holds("arm"):
            self.talk.give(Order("arm", ARM, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)), first=True)
        if ours and self.view.armed:
            self._word = Word.ACCEPTED

    def _setpoint(self, command: BaseCommand) -> Message:
        """Return SET_POSITION_TARGET_LOCAL_NED: forward speed and yaw rate, or for PX4 a velocity in the world."""
        assert self.vehicle is not None
        numbers = (command.v, command.w, float(command.velocity[0]), float(command.velocity[1]))
        if not all(map(math.isfinite, numbers)):
            numbers = (0.0, 0.0, 0.0, 0.0)  # a NaN has aborted an autopilot; the tick's own checks have failed by now
        v, w, east, north = numbers
        if self.stack.world:
            frame, mask = LOCAL_NED, VELOCITY
            vx, vy = enu(east, north)
            w = 0.0
        else:
            frame, mask = BODY_NED, VELOCITY_YAW_RATE
            vx, vy = v, 0.0  # not vy: a skid-steer rover takes hypot(vx, vy) as forward speed
        boot = round(self.wire.now() * 1e3) & 0xFFFFFFFF
        message: Message = self._mav.set_position_target_local_ned_encode(
            boot, *self.vehicle, frame, mask, 0.0, 0.0, 0.0, vx, vy, 0.0, 0.0, 0.0, 0.0, 0.0, -w
        )
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
            self.write(_IDLE)
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
            self.write(_IDLE)
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


_ZERO = np.zeros(2)
_IDLE = BaseCommand(Ask.SILENCE, 0.0, 0.0, _ZERO)
