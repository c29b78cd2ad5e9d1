"""Golden logs: short runs whose every bit is kept under tests/golden, so that no change to the law goes unnoticed.

    python -m tools.golden                                    # replay them all: identical, or where they differ first
    python -m tools.golden --record --reason "why the bits may change"      # after a change that was meant
    python -m tools.golden --record only-this --reason "..."

Bits hold on the kind of processor that they were recorded on: libraries choose their code, and hence the last bit of a
sine, by what it can do. Elsewhere nothing may differ by more than ELSEWHERE.

A golden log holds what went into each tick, all that came out, config, URDF and meshes. The reason of the newest
recording of each is kept in tests/golden/index.json.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard

from rtctl.app.replay import Replay, replay
from rtctl.errors import LogError, RtctlError
from rtctl.log import schema
from rtctl.log.mcap.rows import Encoded, message
from rtctl.log.mcap.segment import begin
from rtctl.log.read.run import Run, read_run

GOLDEN = Path(__file__).resolve().parent.parent / "tests" / "golden"
INDEX = GOLDEN / "index.json"
KEPT = (schema.TICK, schema.REQUEST, schema.EVENT)  # topics: what replay reads, and what people do
FEATURES = {"fma", "avx2", "avx512f", "avx512dq"}
ELSEWHERE = (
    1e-6  # by which another processor's sines and sums may differ, in units of the field; on the same one no bit
)
LEVEL = 19  # of zstd: written once, kept for good


class Verdict(NamedTuple):
    """What the replay of one golden log found."""

    name: str
    good: bool
    text: str


def scenarios() -> dict[str, Path]:
    """Return the scenario files by name."""
    return {path.stem: path for path in sorted(GOLDEN.glob("*.toml")) if "[[goal]]" in path.read_text(encoding="utf-8")}


def log_of(name: str) -> Path:
    """Return the golden log of a scenario."""
    return GOLDEN / f"{name}.mcap"


def condensed(run: Run, path: Path) -> int:
    """Write the topics that are kept of a run as one chunk, packed hard; return the bytes of the file."""
    from rtctl.log.schema import channels

    header = run.header
    wanted = [c for c in channels(header) if c.topic in KEPT]
    rows: list[tuple[int, int, int, bytes]] = []
    for channel in wanted:
        if channel.topic in run.topics:
            topic = run[channel.topic]
            for time, number, payload in zip(topic.time.tolist(), topic.sequence.tolist(), topic.payloads, strict=True):
                rows.append((time, channel.id, number, payload))
    rows.sort(key=lambda row: row[:2])
    pieces = [message(channel, number, time, payload) for time, channel, number, payload in rows]
    sizes = np.array([len(piece) for piece in pieces], np.int64)
    number_of, sequence, time_of = (np.array([row[i] for row in rows], np.int64) for i in (1, 2, 0))
    more = {"segment": "0", "session": path.stem, "clock_offset_ns": "0"}
    plain = header._replace(versions={}, revision="")  # kept in the index: the file changes with the law alone
    segment = begin(path, plain, tuple(wanted), 0, more)
    segment.compressor = zstandard.ZstdCompressor(level=LEVEL)
    stamps = time_of.astype(np.uint64)
    segment.add(Encoded(b"".join(pieces), number_of, sequence, stamps, np.cumsum(sizes) - sizes))
    segment.finish()
    return path.stat().st_size


def record(name: str, reason: str) -> str:
    """Play a scenario anew and keep its log; return a line about it."""
    from rtctl.app.sim import simulate

    with tempfile.TemporaryDirectory(prefix="rtctl-golden-") as folder:
        source = Path(folder) / f"{name}.mcap"
        figures = simulate(scenarios()[name], log=source)
        log_of(name).unlink(missing_ok=True)
        run = read_run(source)
        size = condensed(run, log_of(name))
        versions = {**run.header.versions, "revision": run.header.revision}
    kept = read_index()
    kept[name] = {
        "reason": reason,
        "digest": figures["digest"],
        "ticks": figures["ticks"],
        "cpu": cpu(),
        "versions": {k: v for k, v in versions.items() if k not in ("kernel",)},
    }
    INDEX.write_text(json.dumps(dict(sorted(kept.items())), indent=2) + "\n", encoding="utf-8")
    return f"{name}: {figures['ticks']} ticks, {size / 1e3:.0f} kB, digest {figures['digest'][:12]}"


def read_index() -> dict[str, Any]:
    """Return what is known of each golden log."""
    return dict(json.loads(INDEX.read_text(encoding="utf-8"))) if INDEX.exists() else {}


def cpu() -> str:
    """Return the processor's name and those of its features that mathematical libraries choose their code by."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    known = {
        key: next((x.partition(": ")[2] for x in lines if x.startswith(key)), "") for key in ("model name", "flags")
    }
    features = sorted(FEATURES & set(known["flags"].split()))
    return f"{known['model name'] or 'unknown'} ({' '.join(features)})"


def check(name: str) -> Verdict:
    """Replay one golden log."""
    known = read_index().get(name)
    if known is None or not log_of(name).exists():
        return Verdict(name, False, f"not recorded yet: python -m tools.golden --record {name} --reason ...")
    try:
        done = replay(read_run(log_of(name)))
    except (LogError, RtctlError) as error:
        return Verdict(name, False, str(error))
    if done.identical and done.digest != known["digest"]:
        return Verdict(name, False, f"digest of the command frames {done.digest[:12]}, wanted {known['digest'][:12]}")
    if done.identical:
        return Verdict(name, True, f"{done.ticks} ticks identical, digest {done.digest[:12]}")
    largest = float(np.max([x.largest for x in done.differences]))  # NaN stays NaN
    if cpu() != known["cpu"] and largest <= ELSEWHERE:
        return Verdict(name, True, f"within {largest:.1g} of what {known['cpu']} found; this is {cpu()}")
    return Verdict(name, False, _difference(done, known))


def _difference(done: Replay, known: dict[str, Any]) -> str:
    d = done.divergence
    assert d is not None
    fields = ", ".join(
        f"{x.field} in {x.ticks} ticks by up to {x.largest:.3g} {x.unit}".rstrip() for x in done.differences
    )
    other = f" Recorded on {known['cpu']}, this is {cpu()}." if cpu() != known["cpu"] else ""
    return (
        f"tick {d.tick}, {d.joint or 'no joint'}, field {d.field}, size {d.size}: was {d.logged}, is {d.replayed}. "
        f"All in all: {fields}.{other} If the change is meant: python -m tools.golden --record --reason '...'"
    )


def main(arguments: list[str] | None = None) -> int:
    """Check, or record; exit code 1 when a golden log does not replay."""
    parser = argparse.ArgumentParser(
        prog="tools.golden", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--record", action="store_true", help="play the scenarios and keep their logs")
    parser.add_argument("--reason", default="", help="why the bits may change; wanted for --record")
    parser.add_argument("names", nargs="*", help="scenarios of tests/golden; default: all")
    chosen = parser.parse_args(arguments)
    known = scenarios()
    odd = [name for name in chosen.names if name not in known]
    if odd or (chosen.record and not chosen.reason.strip()):
        print(
            f"golden: got {odd[0] if odd else 'no --reason'}, wanted {', '.join(known) if odd else 'one'}",
            file=sys.stderr,
        )
        return 2
    names = chosen.names or list(known)
    if chosen.record:
        for name in names:
            print(record(name, chosen.reason.strip()), flush=True)
        return 0
    verdicts = [check(name) for name in names]
    for verdict in verdicts:
        print(f"{'ok ' if verdict.good else 'BAD'} {verdict.name}: {verdict.text}")
    return 0 if all(v.good for v in verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
