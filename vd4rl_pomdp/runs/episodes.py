"""A run's `episodes.csv`: raw rows, one an evaluation episode, which are the result."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import read_bytes, regular
from vd4rl_pomdp.core.settings import LABELS
from vd4rl_pomdp.runs.files import appending, write_csv

ADDED = ("evaluated_under", "action_error")
"""Columns that files of earlier versions lack."""
COLUMNS = (*LABELS, "step", "episode", "episode_seed", "return", "length", "score", *ADDED)


def begin_episodes(path: Path) -> None:
    """Make an `episodes.csv` without rows, unless there is one, so that a path that cannot be written is known early.

    Raises:
        UserError: the file cannot be written, is of another kind, or is damaged; it stays as it is.
    """
    append_episodes(path, [])


def append_episodes(path: Path, rows: list[dict[str, Any]]) -> None:
    """Append rows to an `episodes.csv`, writing its header first; another kind of file raises UserError untouched.

    A file of an earlier version gets the columns that it lacks, with what `read_episodes` says of its rows.
    """
    header = _completed(path, read_episodes(path))
    with appending(path) as file:
        writer = csv.DictWriter(file, header or COLUMNS, lineterminator="\n")
        if not os.fstat(file.fileno()).st_size:  # asked while nobody else can write it
            writer.writeheader()
        writer.writerows(rows)


def _completed(path: Path, rows: list[dict[str, Any]]) -> list[str]:
    """Columns of a file, none if it has no header yet, after those that it lacks were added to it."""
    header = _header(path)
    lacking = [name for name in ADDED if name not in header]
    if header and lacking:
        write_csv(path, header := [*header, *lacking], rows)
    return header


def _header(path: Path) -> list[str]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return next(csv.reader(file), [])


def read_episodes(path: Path) -> list[dict[str, Any]]:
    """Rows of an `episodes.csv`, numbers parsed, none if there is no file or it is empty.

    Rows of an earlier version were evaluated under their `corruption`, and have no action error.

    Raises:
        UserError: the file was not written by this package, or is damaged.
    """
    if not regular(path).is_file() or path.stat().st_size == 0:
        return []
    with _whole(path):
        text = read_bytes(path).decode()
        if not text.endswith("\n"):
            raise ValueError("the last line has no end")
        return _parse(path, io.StringIO(text, newline=""))


@contextmanager
def _whole(path: Path) -> Iterator[None]:
    """Whatever a damaged table leads to becomes a sentence."""
    try:
        yield
    except UserError:
        raise
    except (ValueError, TypeError, csv.Error) as error:
        raise UserError(f"{path}: a row is not whole ({error}); remove it") from error


def _parse(path: Path, lines: Iterable[str]) -> list[dict[str, Any]]:
    """Rows of an `episodes.csv`, numbers parsed; raises ValueError, TypeError or csv.Error for a damaged one."""
    reader = csv.DictReader(lines)
    missing = [name for name in COLUMNS if name not in (*(reader.fieldnames or []), *ADDED)]
    if missing:
        raise UserError(f"{path}: has no column {missing[0]!r}; it was not written by this package")
    whole = ("seed", "step", "episode", "episode_seed", "length")
    return [row | {k: int(row[k]) for k in whole} | _scores(path, row) | _added(row) for row in reader]


def _added(row: dict[str, str]) -> dict[str, Any]:
    """The columns that files of earlier versions lack, parsed."""
    if None in row:
        raise ValueError("it has more cells than there are columns")
    under, text = row.get("evaluated_under", row["corruption"]), row.get("action_error", "")
    if not under or text is None:
        raise ValueError("its end is missing")
    error = float(text) if text else None
    if error is not None and not math.isfinite(error):
        raise ValueError(f"its action error is {error}")
    return {"evaluated_under": under, "action_error": error}


def _scores(path: Path, row: dict[str, str]) -> dict[str, float]:
    scores = {name: float(row[name]) for name in ("return", "score")}
    for name, value in scores.items():
        if not math.isfinite(value):
            raise UserError(
                f"{path}: the {name} of seed {row['seed']}, step {row['step']}, episode {row['episode']} is {value}; "
                "its policy has diverged: train it again with a lower --learning-rate, or leave the run out"
            )
    return scores


def drop_episodes_after(path: Path, step: int) -> None:
    """Forget evaluations that a cut run made after its last checkpoint, and a last line that is not whole."""
    if not path.exists():
        return
    if kept := episodes_until(path, step):
        write_csv(path, tuple(dict.fromkeys((*COLUMNS, *kept[0]))), kept)  # columns of one's own stay
    else:
        path.unlink()


def episodes_until(path: Path, step: int) -> list[dict[str, Any]]:
    """Rows of the evaluations up to a step, none if there is no file; a last line that is not whole is left out."""
    if not path.exists():
        return []
    with _whole(path):
        whole = read_bytes(path).decode().rpartition("\n")[0]
        return [row for row in _parse(path, io.StringIO(whole, newline="")) if row["step"] <= step] if whole else []
