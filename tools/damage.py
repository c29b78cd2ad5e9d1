"""Logs that are cut and flipped at random, by the ten thousand: nothing that reads them raises anything but LogError.

    python -m tools.damage --files 10000 --seed 1

Exit status 0 when all of it was so. A file that was not is kept, and its number with the seed makes it again.
"""

import argparse
import random
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from rtctl.errors import EXIT_FAILED, EXIT_OK, LogError
from rtctl.log import Kind, McapSink, make_header, read, read_run
from rtctl.log.mcap.recovery import recover
from rtctl.log.read.examine import examine
from rtctl.log.read.follow import Tail
from rtctl.log.read.info import info
from rtctl.log.read.inputs import inputs
from rtctl.log.read.mend import mend
from rtctl.log.record.requests import encode_event, encode_request
from rtctl.log.view import export, mavlink
from rtctl.log.view.traffic import traffic
from rtctl.types import Request, Verb

FLIPS = 4  # bits at most


def healthy(folder: Path) -> list[bytes]:
    """Return the bytes of small logs: one of ours with every kind of entry, and it again cut off while written."""
    header = make_header("arm", ("a", "b"), 2, 1e-3, "x = 1\n", "<robot/>", files={"a.txt": "b"})._replace(links=("m",))
    sink = McapSink(folder / "seed.mcap", header)
    record = np.zeros((), header.dtype)
    for k in range(30):
        record["tick"], at = k, 1_000_000 * k
        sink.put(Kind.TICK, record.tobytes(), at)
        sink.put_many(Kind.CAN_RX, [bytes([k % 8, 0, 0, 0, 8, 0, 0, 0]) + bytes(8)] * 2, at)
        sink.put(Kind.MAV_RX, b"\xfe\x01\x00\x01\x01\x00\x00\x00\x00", at)
        sink.put(Kind.REQUEST, encode_request(k, Request(Verb.ARM)), at)
        if k % 10 == 0:
            sink.put(Kind.EVENT, encode_event(k, at * 1e-9, "fault", "bus off"), at)
            sink._drain()
            sink._segment.flush()
    raw = sink.close().read_bytes()
    return [raw, raw[: len(raw) * 2 // 3]]


def damaged(raw: bytes, rng: random.Random) -> bytes:
    """Return a copy with flipped bits, or cut off, or a stretch of it gone, doubled or overwritten."""
    data = bytearray(raw)
    for _ in range(rng.randint(1, FLIPS)):
        kind, at = rng.randrange(8), rng.randrange(len(data))
        length = rng.randrange(1, 64)
        if kind < 4:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 4:
            del data[at:]
        elif kind == 5:
            del data[at : at + length]
        elif kind == 6:
            data[at:at] = data[at : at + length]
        else:
            data[at : at + length] = rng.randbytes(length)
        if len(data) < 9:
            break
    return bytes(data)


def look(path: Path, out: Path) -> None:
    """Read a file in every way there is."""
    quiet: Callable[[int], None] = lambda n: None  # noqa: E731
    for work in (
        lambda: info(path),
        lambda: examine(path),
        lambda: [log[name].payloads for log in (read(path),) for name in log],
        lambda: read(path)["/tick"].array,
        lambda: list(inputs(read_run(path).logs)),
        lambda: traffic(read_run(path)),
        lambda: mavlink.listing(read_run(path)),
        lambda: export.to_tlog(read_run(path), out / "t.tlog", quiet),
        lambda: Tail(path).read_on(),
        lambda: mend(path, out / "mended.mcap"),
        lambda: recover(path.rename(path.with_name(path.name + ".open"))),
    ):
        try:
            work()
        except LogError:
            continue


def campaign(folder: Path, files: int, seed: int, say: Callable[[str], None] = lambda text: None) -> list[str]:
    """Return what went wrong with `files` damaged logs: the number of each, and its traceback."""
    seeds, wrong = healthy(folder), []
    path, out = folder / "damaged.mcap", folder / "out"
    out.mkdir(exist_ok=True)
    for number in range(files):
        path.write_bytes(damaged(seeds[number % len(seeds)], random.Random(f"{seed} {number}")))
        kept = path.read_bytes()
        try:
            look(path, out)
        except Exception:
            wrong.append(f"{seed} {number}: {traceback.format_exc(limit=-3)}")
            (folder / f"wrong.{number}.mcap").write_bytes(kept)
        for left in [*out.iterdir(), *folder.glob("damaged.mcap*")]:
            left.unlink()
        if number % 1000 == 999:
            say(f"{number + 1} files, {len(wrong)} gave a traceback")
    return wrong


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.damage", description="Damaged logs give no traceback.")
    parser.add_argument("--files", type=int, default=10_000, help="how many (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="%(default)s")
    args = parser.parse_args(argv)
    begun = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="rtctl-damage-"))
    wrong = campaign(folder, args.files, args.seed, print)
    print("\n".join(wrong))
    print(f"{args.files} files in {time.monotonic() - begun:.0f} s, {len(wrong)} gave a traceback, kept in {folder}")
    return EXIT_FAILED if wrong else EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
