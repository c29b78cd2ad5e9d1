"""Logs: written as MCAP so that nothing is lost, read as arrays.

    tick = rtctl.log.read("run.mcap")["/tick"]
    tick.q          # (N, n) [rad]  positions that the drives replied
    tick.tau_sent   # (N, n) [Nm]   torque that was sent, after the limits
    tick.x          # (N, 3) [m]    tip position, world frame
    tick.rho        # (N, K) [m]    distance to each obstacle slot
    tick.time       # (N,) [ns]     log_time; `tick.field("time")` is robot time [s]

`rtctl.log.read.fields.FIELDS` has the unit and meaning of every field, `rtctl log plot FILE --list` prints them.
`read_run` reads all segments of a run as one; docs/read_a_log.py is an example.
"""

from rtctl.log.entry import Kind
from rtctl.log.header import Header, make_header
from rtctl.log.read.reader import Log, read, segments
from rtctl.log.read.run import Run, read_run
from rtctl.log.read.topic import Topic
from rtctl.log.record.writer import McapSink

__all__ = ["Header", "Kind", "Log", "McapSink", "Run", "Topic", "make_header", "read", "read_run", "segments"]
