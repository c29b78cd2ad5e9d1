"""The rows of a campaign on disk: a journal that takes each row as it comes, and Parquet that it is made into.

DIR/campaign.json       what was asked, of which code
DIR/journal.jsonl       rows since the last part, a line each: a killed client loses none
DIR/rows/part-*.parquet the rows before
"""

import fcntl
import json
import math
import os
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from rtctl.errors import RtctlError, UsageError
from rtctl.plain import Json

PART = 1000  # rows of a file
_TEXT, _REAL, _WHOLE, _TRUE = pa.string(), pa.float64(), pa.int64(), pa.bool_()
SCHEMA = pa.schema(
    [
        ("key", _TEXT),
        ("source", _TEXT),
        ("set", _TEXT),
        ("robot", _TEXT),
        ("seed", _WHOLE),
        ("number", _WHOLE),
        ("variant", _TEXT),
        ("plant", _TEXT),
        ("faults", _TEXT),
        ("outcome", _TEXT),
        ("arrived", _TRUE),
        ("failures", _TEXT),
        ("status", _TEXT),
        ("diagnosis", _TEXT),
        ("told_after_s", _REAL),
        ("stood_s", _REAL),
        ("time_to_goal_s", _REAL),
        ("reference_s", _REAL),
        ("plan_time_s", _REAL),
        ("duration_s", _REAL),
        ("final_error_m", _REAL),
        ("final_error_rad", _REAL),
        ("path_length_m", _REAL),
        ("line_deviation_m", _REAL),
        ("min_clearance_m", _REAL),
        ("min_self_clearance_m", _REAL),
        ("min_joint_margin_rad", _REAL),
        ("max_speed_m_s", _REAL),
        ("max_torque_ratio", _REAL),
        ("max_torque_rate_ratio", _REAL),
        ("max_joint_speed_ratio", _REAL),
        ("contacts", _WHOLE),
        ("finite", _TRUE),
        ("faults_seen", _TEXT),
        ("digest", _TEXT),
        ("detail", _TEXT),
        ("wall_s", _REAL),
        ("worker", _TEXT),
    ]
)
_REALS = tuple(field.name for field in SCHEMA if field.type == _REAL)


class Store:
    """A campaign's folder, for one client at a time."""

    def __init__(self, folder: Path, asked: Json | None = None, code: str = "", other_code: bool = False) -> None:
        """Open or begin a campaign; without `asked` it is only read.

        Raises UsageError for a folder of another campaign or of other code, RtctlError where a client is at work.
        """
        self.folder, self.journal, self.parts = folder, folder / "journal.jsonl", folder / "rows"
        self._lock: int | None = None
        self._file: Any = None
        about = folder / "campaign.json"
        if asked is None:
            if not about.is_file():
                raise UsageError(f"{folder}: no campaign.json, wanted the --out of a campaign")
            self.about: Json = json.loads(about.read_text(encoding="utf-8"))
            self.rows = self._read()
            return
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(folder / "lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise RtctlError(f"{folder}: another client works on this campaign, wanted another --out") from None
        self.about = {"asked": asked, "code": code}
        if about.is_file():
            try:
                self._compare(json.loads(about.read_text(encoding="utf-8")), other_code)
            except UsageError:
                os.close(self._lock)
                raise
        _whole(about, json.dumps(self.about, indent=1).encode())
        self.parts.mkdir(exist_ok=True)
        self.rows = self._read()
        self._pending = self._journalled()
        self._file = self.journal.open("r+b" if self.journal.exists() else "wb")
        self._trim()

    def _compare(self, old: Json, other_code: bool) -> None:
        if old["asked"] != self.about["asked"]:
            raise UsageError(f"{self.folder}: holds another campaign ({old['asked']}), wanted another --out")
        if old["code"] != self.about["code"] and not other_code:
            raise UsageError(
                f"{self.folder}: its rows are of other code ({old['code']}, now {self.about['code']}), "
                "wanted another --out, or --other-code to mix them"
            )

    def _trim(self) -> None:
        """Cut off the line that a killed client did not finish."""
        whole = self.journal.read_bytes()
        self._file.truncate(whole.rfind(b"\n") + 1)
        self._file.seek(0, os.SEEK_END)

    def _journalled(self) -> list[Json]:
        if not self.journal.exists():
            return []
        lines = self.journal.read_bytes().split(b"\n")[:-1]  # behind the last line break: not finished
        return [json.loads(line) for line in lines]

    def _read(self) -> dict[str, Json]:
        """Return all rows by their key."""
        rows: dict[str, Json] = {}
        for part in sorted(self.parts.glob("part-*.parquet")):
            rows |= {row["key"]: row for row in pq.read_table(part).to_pylist()}
        return rows | {row["key"]: row for row in self._journalled()}

    def add(self, row: Json) -> None:
        """Keep a row; when this returns, no end of this process loses it."""
        row = _plain(row)
        self.rows[row["key"]] = row
        self._pending.append(row)
        self._file.write(json.dumps(row).encode() + b"\n")
        self._file.flush()
        if len(self._pending) >= PART:
            self.compact()

    def compact(self) -> None:
        """Make the journal into a file of Parquet."""
        if not self._pending:
            return
        number = len(list(self.parts.glob("part-*.parquet")))
        table = pa.Table.from_pylist([{f.name: row.get(f.name) for f in SCHEMA} for row in self._pending], SCHEMA)
        target = self.parts / f"part-{number:05d}.parquet"
        part = target.with_suffix(".tmp")
        pq.write_table(table, part)
        with part.open("rb") as written:
            os.fsync(written.fileno())
        part.replace(target)  # from here on the journal's rows are there twice, by the same keys
        self._pending = []
        self._file.seek(0)
        self._file.truncate()

    def close(self) -> None:
        """Make all rows Parquet and let others at the folder."""
        if self._file is not None:
            self.compact()
            self._file.close()
        if self._lock is not None:
            os.close(self._lock)


def _plain(row: Json) -> Json:
    """Return a row as JSON and Parquet both hold it: what is no finite number is none."""
    out = {field.name: row.get(field.name) for field in SCHEMA}
    for name in _REALS:
        value = out[name]
        out[name] = None if value is None or not math.isfinite(value) else float(value)
    return out


def _whole(path: Path, data: bytes) -> None:
    part = path.with_suffix(".tmp")
    part.write_bytes(data)
    part.replace(path)
