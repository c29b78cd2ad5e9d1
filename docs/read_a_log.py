"""Reading a log with Python: fields are numpy arrays, a row a tick.

rtctl sim configs/demo.toml --log run.mcap
python docs/read_a_log.py run.mcap
"""

import sys

import numpy as np

from rtctl.arm.faults import names
from rtctl.log import read, read_run
from rtctl.log.read.fields import FIELDS
from rtctl.types import Status


def main(path: str) -> None:
    """Print what a log says about its run."""
    log = read_run(path)  # all segments of the run; `read(path)` is one file
    tick = log["/tick"].load("q", "x", "error", "rho", "tau_sent", "status", "faults")  # one pass for all of these

    print(f"{log.header.robot}: {len(tick)} ticks, joints {', '.join(log.header.joints)}")
    for field in ("q", "x", "tau_sent"):
        values = getattr(tick, field)  # (N, ...) float64
        print(f"  {field:9} {values.shape!s:12} [{FIELDS[field].unit}] {FIELDS[field].text}")

    near = np.where(np.isfinite(tick.rho), tick.rho, np.inf).min(axis=1)  # (N,) [m] to the nearest obstacle
    k = int(near.argmin())
    print(f"closest to an obstacle: {near[k] * 1e3:.1f} mm at {tick.field('time')[k]:.3f} s")  # `field`: robot time
    print(f"largest torque of each joint [Nm]: {np.round(np.abs(tick.tau_sent).max(axis=0), 2).tolist()}")
    arrived = float((tick.status == Status.ARRIVED).mean())
    print(
        f"at its goal {100 * arrived:.0f} % of the time, faults: {', '.join(names(int(tick.faults.max()))) or 'none'}"
    )

    start = log.span[0]  # [ns] log_time
    part = read(path).window("/tick", start + 1_000_000_000, start + 2_000_000_000)  # reads only the chunks it needs
    print(f"between 1 s and 2 s the tip moved {np.linalg.norm(np.diff(part.x, axis=0), axis=1).sum():.3f} m")

    for event in log.events[:5]:
        print(f"  {event['time']:8.3f} s  {event['name']} {event['detail']}")
    bus = log["/can/can0"].array if "/can/can0" in log else None  # one row a frame, wire order
    if bus is not None:
        print(f"{len(bus)} CAN frames, {np.unique(bus['id']).size} identifiers")


if __name__ == "__main__":
    main(sys.argv[1])
