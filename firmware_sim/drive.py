"""One joint drive, as its firmware behaves: the last protection between a controller and the arm.

    DISABLED --enable--> ENABLED --(watchdog, over-speed, over-temperature, injected)--> FAULT --clear--> DISABLED
        ^--------disable----'

The drive trusts nothing it is told. It knows no clock and no socket: `receive` takes a frame and returns the reply,
`sense` takes the encoder, `actuate` advances time by dt and returns what the joint gets. Rules, in one place:

 1. The reply is packed before the command is taken: it tells of the world the command did not know.
 2. Every well-formed frame on the drive's id gets exactly one reply, also a rejected one.
 3. Only a valid command (CRC right, counter fresh) changes torque or feeds the watchdog.
 4. Torque = clamp to min(TMAX, rated torque) times the thermal derating, then slew; replies echo the torque applied.
 5. Without a valid command for W (register TIMEOUT) while enabled: fault 0xD, latched. Only `clear` leaves a fault, to
    DISABLED, and never while the cause lasts.
 6. In FAULT the windings brake the joint (drag D |qd|, bounded) until the holding brake closes: when slow or after 1 s.
    DISABLED drives nothing and its brake is closed. The brake opens 0.1 s after the first torque command that follows
    enable, so nothing sags while the arm is being enabled.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from firmware_sim import codec

NS = 1_000_000_000

# Each bound with its reason. Torque [Nm], speed [rad/s], time [ns], temperature [degC].
DRAG_SPEED = 0.1  # [rad/s] speed at which winding drag reaches rated torque: a sagging arm creeps, it does not fall
BRAKE_SPEED = 0.1  # [rad/s] below it the brake may close: holding brakes are not made to stop masses
BRAKE_RELEASE_NS = NS // 10  # from the first torque command to an open brake: the motor takes the load over meanwhile
BRAKE_LATEST_NS = NS  # a brake that wears is better than an arm that falls for longer than 1 s
BRAKE_HOLD = 1.5  # holding torque over rated torque
OVER_SPEED = 1.5  # trip over the joint's permitted speed: past it the controller has lost the joint
SLEW_MARGIN = 1.25  # over the configured torque rate: quantisation adds up to one LSB to a legal step
STALE_COUNTER = 128  # a counter further ahead than half its range is an old frame that comes late
REST_SPEED = 0.01  # [rad/s] counted as standing still in reports

AMBIENT = 25.0
RISE_RATED = 80.0  # winding temperature rise at continuous torque, class F winding
CONTINUOUS = 0.6  # continuous over rated torque
WINDING_S = 60.0  # first-order time constant
DERATE_FROM, TRIP_AT = 100.0, 120.0  # torque limit falls from 1 to DERATE_TO between them, then the drive trips
DERATE_TO = 0.5
MOS_SHARE = 0.5  # the power stage sees half the winding's rise


class State(IntEnum):
    """Drive states; the error nibble is 0, 1, or the latched fault's code."""

    DISABLED = 0
    ENABLED = 1
    FAULT = 2


class Fault(IntEnum):
    """Error nibbles a drive reports."""

    OVER_VOLTAGE = 0x8
    UNDER_VOLTAGE = 0x9
    OVER_CURRENT = 0xA
    MOS_HOT = 0xB
    COIL_HOT = 0xC
    COMMUNICATION = 0xD
    OVERLOAD = 0xE  # also over-speed and a sensor that reads nonsense: the protocol has no nibble of their own


class Rating(NamedTuple):
    """What a drive was built and commissioned for; all finite and positive."""

    motor: int  # CAN id
    scale: codec.Scale
    torque: float  # [Nm] rated peak torque of the joint
    torque_rate: float  # [Nm/s] the controller's permitted rate
    speed: float  # [rad/s] the controller's permitted speed
    slew_window_ns: int  # one command period: torque rate is judged over it
    timeout: int  # register TIMEOUT as commissioned, 50 us a count; 0 = off, as the makers ship it
    baud: int = 4
    e2e: bool = False  # 12-byte frames with counter and CRC
    release_ns: int = BRAKE_RELEASE_NS  # of the holding brake, 0 for a drive without one to wait for
    reply: int = -1  # CAN id of its replies; -1: motor + 0x10


class Actuation(NamedTuple):
    """What the joint gets: a driven torque [Nm] and a bound on torque that only opposes motion [Nm]."""

    torque: float
    drag: float


@dataclass
class Trip:
    """One latched fault, for reports; times [ns] since power-on, -1 = not yet."""

    code: int
    at: int
    last_valid: int  # newest valid command before it
    rest: int = -1  # when the joint stood still


class Drive:
    """One joint drive; owns its registers, state, latches and temperatures."""

    def __init__(self, rating: Rating) -> None:
        self.rating = rating
        self.flash: dict[int, float] = {
            codec.MST_ID: rating.motor + 0x10 if rating.reply < 0 else rating.reply,
            codec.ESC_ID: rating.motor,
            codec.TIMEOUT: rating.timeout,
            codec.CTRL_MODE: 1,
            codec.PMAX: rating.scale.p,
            codec.VMAX: rating.scale.v,
            codec.TMAX: rating.scale.t,
            codec.BAUD: rating.baud,
        }
        self.flash_writes = 0
        self.zero = 0.0  # [rad] encoder offset
        self.q, self.qd = 0.0, 0.0  # as the encoder reads
        self.temperature = AMBIENT
        self.uptime_ns = 0
        self.last_valid_ns = 0  # of the newest valid command, for reports
        self.trips: list[Trip] = []
        self.rejected = 0  # frames refused: length, CRC, counter
        self.boot()

    def boot(self) -> None:
        """Start as after power-on: registers from flash, disabled, brake closed, counters at their beginning."""
        self.registers = dict(self.flash)
        self.scale = codec.Scale(*(self.registers[r] for r in (codec.PMAX, codec.VMAX, codec.TMAX)))
        self.timeout_ns = int(self.registers[codec.TIMEOUT]) * codec.TIMEOUT_NS
        self.state = State.DISABLED
        self.fault = 0
        self.watchdog_tripped = False
        self.brake = True
        self.release_ns = -1  # since the first torque command after enable, -1 = none yet
        self.command = codec.Command(0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.torque = 0.0  # [Nm] applied
        self.strength = 1.0  # of the motor: less than it is told when a fault makes it so
        self.flags = 0  # clamped, slewed, derated of the last actuation
        self.silence_ns = 0
        self.fault_age_ns = 0
        self.counter_in = -1  # newest accepted, -1 = none yet
        self.counter_out = 0
        self.slew = self.rating.torque_rate * SLEW_MARGIN
        self.slew_bound = self.slew * self.rating.slew_window_ns / NS
        self.slew_budget = self.slew_bound
        self.over_speed = min(OVER_SPEED * self.rating.speed, self.scale.v)

    # ---- the wire

    def receive(self, data: bytes) -> bytes | None:
        """Take one frame on the drive's own id; return the reply's payload, None for a frame of a wrong length."""
        if len(data) != (12 if self.rating.e2e else 8):
            self.rejected += 1
            return None
        reply = self.reply()
        if self._fresh(data):
            torque_wanted = not self.rating.e2e or bool(data[9] & codec.TORQUE_WANTED)
            self._take(codec.decode_command(data, self.scale), torque_wanted)
        else:
            self.rejected += 1
        return reply

    def register(self, data: bytes) -> bytes | None:
        """Take one register frame meant for this drive; return the reply, None where a drive stays silent."""
        if len(data) != (12 if self.rating.e2e else 8) or (
            self.rating.e2e and not codec.intact(data, codec.REGISTER_ID)
        ):
            self.rejected += 1
            return None
        operation, number, raw = codec.decode_register(data)[1:]
        if operation == codec.REFRESH:
            return self.reply()
        if operation == codec.SAVE:
            if self.registers != self.flash and self.state is State.DISABLED:
                self.flash = dict(self.registers)
                self.flash_writes += 1
            return self._sealed(codec.encode_register(self.rating.motor, codec.SAVE, 1, bytes(4)))
        if operation not in (codec.READ, codec.WRITE) or number not in self.registers:
            return None
        if operation == codec.WRITE:
            self._write(number, codec.register_value(number, raw))
        value = codec.register_bytes(number, self.registers[number])  # a refused write answers with what stands
        return self._sealed(codec.encode_register(self.rating.motor, operation, number, value))

    def reply(self) -> bytes:
        """Return the state reply: error nibble, encoder, the torque applied, temperatures."""
        err = self.fault if self.state is State.FAULT else int(self.state)
        mos = AMBIENT + MOS_SHARE * (self.temperature - AMBIENT)
        temps = (int(mos), int(self.temperature))
        return self._sealed(codec.encode_state(self.rating.motor, err, self.q, self.qd, self.torque, temps, self.scale))

    def _sealed(self, data: bytes) -> bytes:
        """Add counter, status and CRC where the link is protected."""
        if not self.rating.e2e:
            return data
        status = (codec.WATCHDOG if self.watchdog_tripped else 0) | self.flags | (codec.BRAKE if self.brake else 0)
        self.counter_out = self.counter_out + 1 & 0xFF
        return codec.protect(data, self.counter_out, status, int(self.registers[codec.MST_ID]))

    def _fresh(self, data: bytes) -> bool:
        """Tell whether a command is intact and new; a drive that is not enabled takes up any new counter."""
        if not self.rating.e2e:
            return True
        if not codec.intact(data, self.rating.motor):
            return False
        ahead = data[8] - self.counter_in & 0xFF
        known = self.counter_in >= 0
        if known and (ahead == 0 or (ahead >= STALE_COUNTER and self.state is State.ENABLED)):
            return False
        self.counter_in = data[8]
        return True

    def _take(self, command: codec.Command, torque_wanted: bool) -> None:
        """Act on a valid command according to the state."""
        if command.special == codec.DISABLE:
            if self.state is State.ENABLED:
                self._off(State.DISABLED)
        elif command.special == codec.CLEAR:
            if self.state is State.FAULT and self.temperature < DERATE_FROM:
                self.fault, self.watchdog_tripped, self.fault_age_ns = 0, False, 0
                self._off(State.DISABLED)
        elif command.special == codec.ENABLE:
            if self.state is State.DISABLED:
                self._off(State.ENABLED)
            if self.brake:  # keeps an idle drive alive, never a torque
                self.silence_ns, self.last_valid_ns = 0, self.uptime_ns
        elif command.special == codec.ZERO:
            if self.state is State.DISABLED:
                self.zero += self.q
                self.q = 0.0
        elif self.state is State.ENABLED:
            self.command = command if torque_wanted else codec.Command(0, 0.0, 0.0, 0.0, 0.0, 0.0)
            self.silence_ns, self.last_valid_ns = 0, self.uptime_ns
            if torque_wanted and self.release_ns < 0:
                self.release_ns = 0

    def _off(self, state: State) -> None:
        """Enter a state without torque, brake closed, old command forgotten."""
        self.state, self.brake, self.torque, self.flags = state, True, 0.0, 0
        self.command = codec.Command(0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.slew_budget = self.slew_bound
        self.release_ns = -1

    def _write(self, number: int, value: float) -> None:
        """Write a register if the drive is disabled and the value is one it can work with."""
        if self.state is not State.DISABLED or not math.isfinite(value) or value < 0.0:
            return
        if number in codec.FLOAT_REGISTERS and not 0.1 <= value <= 1000.0:
            return
        if number == codec.CTRL_MODE and value != 1:
            return  # this drive has the MIT mode only
        if number in (codec.MST_ID, codec.ESC_ID, codec.BAUD):
            return  # changing an id or the bit rate on a live bus loses the drive: service tool only
        self.registers[number] = value
        self.scale = codec.Scale(*(self.registers[r] for r in (codec.PMAX, codec.VMAX, codec.TMAX)))
        self.timeout_ns = int(self.registers[codec.TIMEOUT]) * codec.TIMEOUT_NS
        self.over_speed = min(OVER_SPEED * self.rating.speed, self.scale.v)

    # ---- the joint

    def sense(self, q: float, qd: float) -> None:
        """Take the true joint position [rad] and speed [rad/s].

        The reply's 16 bits quantise position and its 12 speed: the encoder sits on the motor, before the gear, so its
        own resolution is far finer than the wire's.
        """
        if not (math.isfinite(q) and math.isfinite(qd)):
            self.trip(Fault.OVERLOAD)
            return
        self.q, self.qd = q - self.zero, qd

    def trip(self, code: int) -> None:
        """Latch a fault; the first one stays until cleared."""
        if self.state is State.FAULT:
            return
        braked = self.brake
        self._off(State.FAULT)
        self.brake = braked  # a moving joint is dragged to rest before its brake closes
        self.fault, self.fault_age_ns = int(code), 0
        self.trips.append(Trip(self.fault, self.uptime_ns, self.last_valid_ns))

    def actuate(self, dt_ns: int) -> Actuation:
        """Advance the drive by dt and return what the joint gets meanwhile."""
        dt = dt_ns / NS
        self._protect()
        drag = 0.0
        if self.state is State.ENABLED and self.release_ns >= 0:
            self.brake = self.brake and self.release_ns < self.rating.release_ns
            self.torque = self._limited(dt)
        elif self.state is State.FAULT and not self.brake:
            self.brake = abs(self.qd) < BRAKE_SPEED or self.fault_age_ns >= BRAKE_LATEST_NS
            drag = min(self.rating.torque * abs(self.qd) / DRAG_SPEED, self.rating.torque)
            self.torque = -math.copysign(drag, self.qd)
        else:
            self.torque = 0.0
        if self.brake:
            drag = BRAKE_HOLD * self.rating.torque
            self.torque = self.torque if self.release_ns >= 0 else 0.0  # the motor builds up against the brake
        self._clockwork(dt_ns, dt)
        return Actuation(0.0 if drag else self.torque, drag)

    def _protect(self) -> None:
        """Trip on silence, speed and heat, in that order; over-speed and heat count in any state."""
        if self.state is State.ENABLED and 0 < self.timeout_ns <= self.silence_ns:
            self.trip(Fault.COMMUNICATION)
            self.watchdog_tripped = True
        if abs(self.qd) > self.over_speed:
            self.trip(Fault.OVERLOAD)
        if self.temperature >= TRIP_AT:
            self.trip(Fault.COIL_HOT)

    def _limited(self, dt: float) -> float:
        """Return the wanted torque, clamped to TMAX, rating and derating, then slewed by at most slew x time passed."""
        c = self.command
        wanted = c.kp * (c.p - self.q) + c.kd * (c.v - self.qd) + c.t
        derate = self._derate()
        limit = min(self.scale.t, self.rating.torque) * derate
        self.flags = codec.DERATED if derate < 1.0 else 0
        if abs(wanted) > limit + self.scale.t / 4095.0:  # half an LSB over the limit is rounding, not a demand
            self.flags |= codec.CLAMPED
        wanted = min(max(wanted, -limit), limit) * self.strength
        self.slew_budget = min(self.slew_budget + self.slew * dt, self.slew_bound)
        change = wanted - self.torque
        if abs(change) > self.slew_budget:
            self.flags |= codec.SLEWED
            change = math.copysign(self.slew_budget, change)
        self.slew_budget -= abs(change)
        return self.torque + change

    def _derate(self) -> float:
        """Return the share of torque the winding's temperature still allows, linear between the two limits."""
        over = (self.temperature - DERATE_FROM) / (TRIP_AT - DERATE_FROM)
        return 1.0 - (1.0 - DERATE_TO) * min(max(over, 0.0), 1.0)

    def _clockwork(self, dt_ns: int, dt: float) -> None:
        """Advance timers and the winding: dT/dt = (rise (tau / tau_continuous)^2 - (T - ambient)) / time constant."""
        load = self.torque / (CONTINUOUS * self.rating.torque)
        self.temperature += dt / WINDING_S * (RISE_RATED * load * load - (self.temperature - AMBIENT))
        self.uptime_ns += dt_ns
        self.silence_ns += dt_ns
        self.fault_age_ns += dt_ns
        if self.release_ns >= 0:
            self.release_ns += dt_ns
        if self.trips and self.trips[-1].rest < 0 and abs(self.qd) < REST_SPEED:
            self.trips[-1].rest = self.uptime_ns
