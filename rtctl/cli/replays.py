"""`rtctl log replay` and `rtctl log diff`: the same bits again, or where they differ."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from rtctl.cli.parser import Commands, command, log_file
from rtctl.cli.progress import bar
from rtctl.errors import EXIT_FAILED, EXIT_OK
from rtctl.plain import Json

if TYPE_CHECKING:
    from rtctl.app.replay import Replay
    from rtctl.log.read.run import Run

REPLAY_EXAMPLE = "rtctl log replay run.mcap\n  rtctl log replay run.mcap --config softer.toml --plot softer.png"
REPLAY_TEXT = """Run the pure tick once more on the inputs of a log, from the log alone: its config, URDF and meshes.

Exit code 0: every record and every command frame is the same to the bit. 1: it is not; the first difference is named
as tick, joint, field and size. With --config another config is asked what it would have commanded: exit code 0."""


def add(actions: Commands) -> None:
    """Add the two commands."""
    replay = command(
        actions, "replay", "run the controller again on a log: the same bits, or where not", REPLAY_EXAMPLE, _replay
    )
    replay.description = REPLAY_TEXT
    replay.add_argument("file", metavar="FILE", type=log_file)
    replay.add_argument("--config", metavar="CONFIG", default="", help="what if: the commands of this config instead")
    replay.add_argument(
        "--plot", metavar="PICTURE", default="", help="draw both torques and their difference (png, svg)"
    )
    replay.add_argument("--json", action="store_true", help="print one JSON object")
    diff = command(
        actions, "diff", "two runs side by side", "rtctl log diff before.mcap after.mcap --plot diff.png", _diff
    )
    diff.description = (
        "Two runs side by side: what each did, which fields differ, since when, by how much. Exit code 1 if any does."
    )
    diff.add_argument("a", metavar="A", type=log_file)
    diff.add_argument("b", metavar="B", type=log_file)
    diff.add_argument("--plot", metavar="PICTURE", default="", help="draw tip, error and torque of both (png, svg)")
    diff.add_argument("--json", action="store_true", help="print one JSON object")


def _replay(arguments: argparse.Namespace) -> int:
    from rtctl.app.replay import replay
    from rtctl.log import schema
    from rtctl.log.read.run import read_run

    run = read_run(arguments.file)
    other = Path(arguments.config) if arguments.config else None
    with bar("replaying", run.count(schema.TICK) or 1) as progress:
        done = replay(run, other, progress)
    if arguments.plot:
        from rtctl.log.view.plot import plot_pair

        labels = ("logged", "replayed" if other is None else other.name)
        shown = ("tau_sent", "Nm") if run.header.joints else ("v_world", "m/s")
        group = (*shown, done.logged, done.replayed)
        plot_pair(done.time, [group], labels, Path(arguments.plot), run.header.joints)
    if arguments.json:
        print(json.dumps(_as_dict(done, other)))
    else:
        print(_text(done, other, run))
    return EXIT_OK if done.identical or other is not None else EXIT_FAILED


def _as_dict(done: "Replay", other: Path | None) -> Json:
    import numpy as np

    gap = done.replayed - done.logged
    return {
        "identical": done.identical,
        "config": None if other is None else str(other),
        "ticks": done.ticks,
        "frames": done.frames,
        "digest": done.digest,
        "realtime_factor": round(done.speed, 3),
        "first_divergence": None if done.divergence is None else done.divergence._asdict(),
        "differences": [d._asdict() for d in done.differences],
        "ignored_fields": list(done.ignored),
        "max_torque_difference_Nm": np.abs(gap).max(axis=0).tolist(),
    }


def _text(done: "Replay", other: Path | None, run: "Run") -> str:
    import numpy as np

    from rtctl.cli.values import table

    lines = [f"{done.ticks} ticks, {done.frames} command frames, {done.speed:.1f} x real time"]
    if done.ignored:
        lines.append(f"not compared, only one side knows them: {', '.join(done.ignored)}")
    if done.divergence is None:
        return "\n".join([*lines, f"identical to the bit{f', digest {done.digest}' if done.digest else ''}"])
    d = done.divergence
    what = "first divergence" if other is None else f"{other} commands otherwise from"
    part = f", {d.joint}" if d.joint else ""
    lines += [
        f"{what}: tick {d.tick} ({d.time:.3f} s){part}, {d.field}: logged {d.logged}, replayed {d.replayed}, {d.size}"
    ]
    rows = [[x.field, str(x.ticks), str(x.first), f"{x.largest:.3g}", x.unit, str(x.at)] for x in done.differences]
    if rows:
        lines += ["", table(rows, ["field", "ticks", "first", "largest", "unit", "at tick"], frozenset((1, 2, 3, 5)))]
    if other is not None:
        gap = np.abs(done.replayed - done.logged)
        joints = [
            [name, f"{gap[:, j].max():.4g}", f"{gap[:, j].mean():.4g}", f"{done.time[gap[:, j].argmax()]:.3f}"]
            for j, name in enumerate(run.header.joints)
        ]
        lines += ["", table(joints, ["torque of", "largest Nm", "mean Nm", "at s"], frozenset((1, 2, 3)))]
        lines.append(
            "The inputs are the logged ones: this is what would have been sent then, not how the arm would have moved."
        )
    else:
        lines += ["", _blame(run)]
    return "\n".join(lines)


def _blame(run: "Run") -> str:
    """Return what is different about the program that wrote the log."""
    from rtctl.log.header import revision, versions

    now, then = {**versions(), "revision": revision()}, {**run.header.versions, "revision": run.header.revision}
    odd = [
        f"{key} {then[key] or '?'} -> {now.get(key) or '?'}"
        for key in then
        if key != "kernel" and then[key] != now.get(key)
    ]
    return f"since the log: {', '.join(odd)}" if odd else "versions are those of the log"


def _diff(arguments: argparse.Namespace) -> int:
    from rtctl.cli.values import table
    from rtctl.log.read.run import read_run
    from rtctl.log.view.diff import diff

    a, b = read_run(arguments.a), read_run(arguments.b)
    found = diff(a, b)
    if arguments.plot:
        from rtctl.log.view.plot import plot_pair

        groups = [
            ("x", "m", *found.tip),
            ("error", "m", *found.error),
            (*(("tau_sent", "Nm") if a.header.joints else ("v_world", "m/s")), *found.tau),
        ]
        plot_pair(found.time, groups, ("A", "B"), Path(arguments.plot))
    if arguments.json:
        summary = {key: [left, right] for key, left, right in found.summary}
        gaps = [g._asdict() for g in found.gaps]
        print(json.dumps({"identical": found.identical, "ticks": found.ticks, "summary": summary, "differences": gaps}))
        return EXIT_OK if found.identical else EXIT_FAILED
    print(table([list(row) for row in found.summary], ["", "A", "B"]))
    print()
    if found.identical:
        print(f"identical to the bit in all {found.ticks} ticks")
        return EXIT_OK
    rows = [
        [g.field, str(g.ticks), f"{g.first_s:.3f}", f"{g.largest:.3g}", g.unit, f"{g.at_s:.3f}"] for g in found.gaps
    ]
    print(
        table(rows, ["field", f"of {found.ticks} ticks", "since s", "largest", "unit", "at s"], frozenset((1, 2, 3, 5)))
    )
    return EXIT_FAILED
