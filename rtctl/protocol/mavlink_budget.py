"""What a conversation with an autopilot costs on a serial line: bytes a second each way, and the streams that fit.

A byte takes ten bits on the line. A MAVLink 2 frame has 12 bytes around its payload, 13 more when it is signed.
"""

from typing import NamedTuple

HEAD, SIGNATURE = 12, 13  # [B]
BITS = 10  # a byte, with its start and stop bit
MOST = 0.80  # of the line, each way
RATES = (50.0, 40.0, 25.0, 20.0, 10.0)  # [Hz] that streams are asked for in turn
FASTEST = 40.0  # [Hz] that an autopilot's scheduler grants
SETPOINT, COMMAND, BEAT, SYNC = 53, 33, 9, 16  # [B] of payload
SLOWEST_SETPOINTS = 10.0  # [Hz]
QUICK = ("LOCAL_POSITION_NED", "ATTITUDE", "ODOMETRY")  # streams that are asked for as often as the line lets them
PAYLOAD = {  # [B]
    "LOCAL_POSITION_NED": 28, "ATTITUDE": 28, "ODOMETRY": 233, "OBSTACLE_DISTANCE": 167, "DISTANCE_SENSOR": 39,
    "EKF_STATUS_REPORT": 26, "ESTIMATOR_STATUS": 42, "GPS_RAW_INT": 52, "GLOBAL_POSITION_INT": 28, "HOME_POSITION": 60,
}  # fmt: skip
SCANS = 10.0  # [Hz] of one range sensor


class Streams(NamedTuple):
    """How often what is sent on a line, and how much of it that takes."""

    quick: float  # [Hz] of position and attitude
    every: int  # servo period in which a set-point is sent
    received: float  # share of the line from the vehicle
    sent: float  # share of the line to the vehicle

    @property
    def fits(self) -> bool:
        """Return whether the line bears it."""
        return max(self.received, self.sent) <= MOST


def fitted(baud: int, servo_hz: float, slow: dict[str, float], quick: tuple[str, ...], signed: bool) -> Streams:
    """Return the fastest streams that a line of `baud` [bit/s] bears, the slowest when it bears none.

    slow: [Hz] of the streams that are not scaled, by name; quick: those that are.
    """
    around, line = HEAD + (SIGNATURE if signed else 0), baud / BITS

    def cost(payload: int, hz: float) -> float:
        return hz * (around + payload) / line

    fixed = sum(cost(PAYLOAD[name], hz) for name, hz in slow.items()) + cost(BEAT, 2.0) + cost(SYNC, 2.0)
    for rate in RATES:
        received = fixed + sum(cost(PAYLOAD[name], min(rate, FASTEST)) for name in quick)
        if received <= MOST:
            break
    every = 1
    while True:
        sent = cost(SETPOINT, servo_hz / every) + cost(BEAT, 1.0) + cost(SYNC, 2.0) + cost(COMMAND, 1.0)
        if sent <= MOST or servo_hz / (every + 1) < SLOWEST_SETPOINTS:
            return Streams(rate, every, received, sent)
        every += 1


def baud_of(url: str) -> int | None:
    """Return the speed [bit/s] of a serial link's url, None for one without."""
    scheme, _, rest = url.partition(":")
    speed = rest.rpartition(":")[2]
    return int(speed) if scheme == "serial" and speed.isdigit() and int(speed) > 0 else None
