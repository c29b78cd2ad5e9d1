"""Logs: written as MCAP so that nothing is lost, read as arrays: `rtctl.log.read(path)["/tick"].q`."""

from rtctl.log.entry import Kind
from rtctl.log.header import Header, make_header
from rtctl.log.reader import Log, read, segments
from rtctl.log.topic import Topic
from rtctl.log.writer import McapSink

__all__ = ["Header", "Kind", "Log", "McapSink", "Topic", "make_header", "read", "segments"]
