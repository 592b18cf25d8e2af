"""A run's `episodes.csv`: the raw results, one row per evaluation episode."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import LABELS
from vd4rl_pomdp.core.reading import damaged, read_bytes, regular
from vd4rl_pomdp.runs.files import Row, appending, write_csv

EVALUATION_SEED = 20_000
"""Evaluation episode i uses environment seed EVALUATION_SEED + i, for every method and training seed."""
_WHOLE = ("seed", "step", "episode", "episode_seed", "length")
COLUMNS = (
    *(*LABELS, "step", "episode", "episode_seed", "return", "length", "score"),
    *("evaluated_under", "action_error"),
)


def append_episodes(path: Path, rows: list[Row]) -> None:
    """Append rows to an `episodes.csv`, created with a header if needed. No rows: check that it is writable.

    UserError if it cannot be written, is of another kind, or is damaged; it is left unchanged.
    """
    there = read_episodes(path)
    with appending(path) as file:
        writer = csv.DictWriter(file, list(there[0]) if there else COLUMNS, lineterminator="\n")
        if not path.stat().st_size:  # checked under the file lock
            writer.writeheader()
        writer.writerows(rows)


def read_episodes(path: Path) -> list[Row]:
    """Rows of an `episodes.csv` with numbers parsed, others left as text; none if it is missing or empty.

    UserError if the file was not written by this package, or is damaged.
    """
    return _parse(path, read_bytes(path)) if regular(path).is_file() else []


def episodes_until(path: Path, step: int) -> list[Row]:
    """Rows of evaluations up to `step`; empty without a file. A truncated last line is skipped."""
    if not path.exists():
        return []
    whole, end, _ = read_bytes(path).rpartition(b"\n")
    return [row for row in _parse(path, whole + end) if row["step"] <= step]


def drop_episodes_after(path: Path, step: int) -> None:
    """Delete evaluations that an interrupted run made after its last checkpoint, and a truncated last line."""
    if kept := episodes_until(path, step):
        write_csv(path, list(kept[0]), kept)
    else:
        path.unlink(missing_ok=True)


def _parse(path: Path, content: bytes) -> list[Row]:
    if not content:
        return []
    with damaged(path, "a row is not whole", "remove that row"):
        if not content.endswith(b"\n"):
            raise ValueError("the last line has no end")
        reader = csv.DictReader(io.StringIO(content.decode(), newline=""))
        if missing := [name for name in COLUMNS if name not in (reader.fieldnames or [])]:
            raise UserError(f"{path}: has no column {missing[0]!r}; it was not written by this package")
        rows: list[Row] = []
        for row in reader:
            if None in row or None in row.values() or not row["evaluated_under"]:
                raise ValueError("a row has more or fewer cells than columns")
            numbers = {name: float(row[name]) for name in ("return", "score")}
            if bad := [name for name, value in numbers.items() if not math.isfinite(value)]:
                raise UserError(
                    f"{path}: the {bad[0]} of seed {row['seed']}, step {row['step']}, episode {row['episode']} is "
                    f"{numbers[bad[0]]}; its policy has diverged: train it again with a lower --learning-rate, or "
                    "leave the run out"
                )
            error = float(row["action_error"]) if row["action_error"] else None
            if error is not None and not math.isfinite(error):
                raise ValueError(f"its action error is {error}")
            rows.append(row | numbers | {name: int(row[name]) for name in _WHOLE} | {"action_error": error})
        return rows
