"""What every shipped scenario and world does, frozen: its digest to the bit, its figures within what processors differ.

    python -m tools.digests                                  # play them all: the same, or what differs
    python -m tools.digests trap u                           # only these
    python -m tools.digests --record --reason "why they may change" [NAME ...]

A digest is of the bytes of all commands. It holds on the kind of processor it was recorded on; elsewhere the figures
must agree within FIGURES. The reason of each recording is kept beside its figures in tests/golden/digests.json.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rtctl.app.sim import simulate
from tools.golden import GOLDEN, cpu

ROOT = Path(__file__).resolve().parent.parent
FILE = GOLDEN / "digests.json"
FIGURES = {  # name -> by how much another processor's last bits may move it
    "arrived": 0.0,
    "contacts": 0.0,
    "time_to_goal_s": 0.05,
    "final_error_m": 5e-4,
    "max_speed_m_s": 5e-3,
    "min_clearance_m": 5e-4,
}


def scenarios() -> dict[str, Path]:
    """Return the shipped scenario files by name."""
    configs = ROOT / "configs"
    files = [configs / "demo.toml", *configs.glob("scenarios/*.toml"), *configs.glob("worlds/*.toml")]
    return {path.stem: path for path in sorted(files)}


def played(path: Path) -> dict[str, Any]:
    """Return the digest and the compared figures of a scenario, played anew."""
    found = simulate(path)
    figures = {name: found[name] for name in FIGURES}
    figures["min_clearance_m"] = found["min_clearance_m"]["all"]
    return {"digest": found["digest"], "ticks": found["ticks"], "figures": figures}


def differences(known: dict[str, Any], now: dict[str, Any], same_cpu: bool) -> list[str]:
    """Return what differs, in words: the digest where the processor is the same, else figures beyond their bound."""
    if known["digest"] == now["digest"]:
        return []
    found = [f"digest {now['digest'][:12]}, was {known['digest'][:12]}"] if same_cpu else []
    for name, bound in FIGURES.items():
        a, b = known["figures"][name], now["figures"][name]
        if (a is None) != (b is None) or (a is not None and abs(float(a) - float(b)) > bound):
            found.append(f"{name} {b}, was {a} (within {bound} elsewhere)")
    return found


def main(arguments: list[str] | None = None) -> int:
    """Compare or record; exit code 1 when a scenario does something else than it did."""
    parser = argparse.ArgumentParser(
        prog="tools.digests", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--record", action="store_true", help="keep what is found")
    parser.add_argument("--reason", default="", help="why it may change; wanted for --record")
    parser.add_argument("names", nargs="*", help="scenarios; default: all")
    chosen = parser.parse_args(arguments)
    known = scenarios()
    odd = [name for name in chosen.names if name not in known]
    if odd or (chosen.record and not chosen.reason.strip()):
        print(
            f"digests: got {odd[0] if odd else 'no --reason'}, wanted {', '.join(known) if odd else 'one'}",
            file=sys.stderr,
        )
        return 2
    frozen: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}
    bad = 0
    for name in chosen.names or list(known):
        now = played(known[name])
        if chosen.record:
            frozen[name] = {**now, "cpu": cpu(), "reason": chosen.reason.strip()}
            FILE.write_text(json.dumps(dict(sorted(frozen.items())), indent=2) + "\n", encoding="utf-8")
            print(f"{name}: {now['digest'][:12]} {now['figures']}", flush=True)
            continue
        if name not in frozen:
            found = ["not recorded yet"]
        else:
            found = differences(frozen[name], now, frozen[name]["cpu"] == cpu())
        bad += bool(found)
        print(f"{'BAD' if found else 'ok '} {name}: {'; '.join(found) or now['digest'][:12]}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
