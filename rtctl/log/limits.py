"""What is believed of a file that anybody may have written: the bounds of every count and size in it, in one place.

A reader compares with them before it allocates. They stand well above what writers make (chunks of 0.25 to 4 MiB, some
30 topics, records of a few kilobytes), and low enough that a hostile file costs a reader less than half a GiB.
"""

CHUNK = 64 << 20  # [bytes] of an uncompressed chunk
UNPACKED = 64 << 20  # [bytes] of the chunks that are unpacked for one piece of a topic
HELD = 256 << 20  # [bytes] of a topic that are held at once, whatever the size of the file; more by EXPANSION
EXPANSION = 100  # times the file's size; our own logs unpack to 3 to 20 times theirs
HEADER = 16 << 20  # [bytes] of the header's JSON
TICK = 1 << 20  # [bytes] of a tick's record
NAMES = 1024  # joints, buses or links of a header
SLOTS = 65536  # of obstacles
PERIOD = 1e3  # [s] of the servo
ARCHIVE = 64 << 20  # [bytes] of all meshes of a log, unpacked
MEMBERS = 1024  # files of an archive
HEAD = 32 << 20  # [bytes] of a file's start in which its session is looked for
SPAN_BINS = 1_000_000  # of a histogram over the time that a log says it lasts


def held(size: int) -> int:
    """Return the most [bytes] that are held of a topic of a file of `size` [bytes]."""
    return max(HELD, EXPANSION * size)
