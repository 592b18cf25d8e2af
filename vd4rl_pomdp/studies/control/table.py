"""What a control study says: a table for each setting, its gates, and whether memory and past actions pay."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from vd4rl_pomdp.core.errors import told_apart
from vd4rl_pomdp.report.gates import FAILED, STATE_SHARE
from vd4rl_pomdp.report.load import PROBES
from vd4rl_pomdp.report.stats import mean_and_error
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.studies.control.config import MEASURED, NO_MEMORY, SETTING, UNTRAINED

STANDARD_ERRORS = 2.0
"""Least difference that tells, in its standard errors over the seeds that both methods have."""
COLUMNS = ("method", "seeds", "return", "episodes", "good", "error: data", "in loop", "pose", "velocity")


@dataclass(frozen=True)
class SeedDifference:
    """How much more one method returns than another, seed by seed."""

    mean: float
    error: float
    """Standard error of the mean over seeds; infinite for one seed."""
    n: int

    @property
    def tells(self) -> bool:
        """Whether it is beyond two standard errors, as chance has it in 30% of cases with two seeds, 18% with three."""
        return abs(self.mean) > STANDARD_ERRORS * self.error

    def __str__(self) -> str:
        error = f" ± {self.error:.0f}" if math.isfinite(self.error) else ""
        return f"{self.mean:+.0f}{error} (n = {self.n})"


def summary(rows: list[Row]) -> Iterator[str]:
    """Lines about rows of runs.csv: for every setting its table, its gates, and what its seeds tell."""
    for _, members in groupby(sorted(rows, key=_setting), _setting):
        yield from _summary_of(list(members), rows)


def line_of(row: Row) -> str:
    """One run on one line."""
    value = {name: float(row[name]) for name in MEASURED}
    low, high, data = value["return_min"], value["return_max"], value["data_return"]
    return "; ".join(
        [
            f"{row['task']}, noise {row['action_noise']}, hidden {row['hidden_share']}",
            f"{name_of(row)}, seed {row['seed']}",
            f"returns {value['return']:.0f} ({low:.0f} to {high:.0f}) of the data's {data:.0f}",
            f"action error {value['error_on_data']:.3f} on the data, {value['error_in_loop']:.3f} in closed loop",
            f"probes {', '.join(f'{value[name]:.1f}' for name in PROBES)}",
            f"{value['seconds']:.0f} s",
        ]
    )


def difference(rows: list[Row], method: str, other: str) -> SeedDifference | None:
    """Return of `method` minus that of `other` over the seeds that both have; None if they share none."""
    mine, theirs = _returns(rows, method), _returns(rows, other)
    values = np.array([mine[seed] - theirs[seed] for seed in sorted(mine.keys() & theirs.keys())])
    if not len(values):
        return None
    error = values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else math.inf
    return SeedDifference(float(values.mean()), float(error), len(values))


def name_of(row: Row) -> str:
    """A row's method, and what else than whole histories' states is read of its memory."""
    told = {
        f"readout {row['readout']}": row["readout"] != "state",
        f"{row['random_histories']} random histories": row["random_histories"] != "0",
        f"last {row['history_window']} rows": row["history_window"] != "0",
    }
    return ", ".join([row["method"], *(text for text, is_told in told.items() if is_told)])


def _setting(row: Row) -> tuple[str, ...]:
    return tuple(row[name] for name in SETTING)


def _summary_of(rows: list[Row], every: list[Row]) -> Iterator[str]:
    first = rows[0]
    yield ""
    yield (
        f"{first['task']}, noise {first['action_noise']} on actions, {first['hidden_share']} of the coordinates hidden "
        f"({first['episodes']} episodes, {first['pretrain_steps']} steps, {first['updates']} updates); "
        f"the data returns {float(first['data_return']):.0f}"
    )
    passed = True
    for name, verdict, told in _gates(rows, every):
        yield f"gate, {name}: {told}, {'not measured' if verdict is None else 'reached' if verdict else 'missed'}"
        passed = passed and verdict is not False
    if not passed:
        yield f"{FAILED}: methods are listed by name"
    yield from _table(rows, _by_return(rows) if passed else sorted(_by_return(rows)))
    yield from _answers(rows) if passed else ()


def _table(rows: list[Row], methods: list[str]) -> Iterator[str]:
    table = [COLUMNS, *(_method_row(rows, method) for method in methods)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for cells in table:
        yield "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)).rstrip()


def _method_row(rows: list[Row], method: str) -> tuple[str, ...]:
    mine = [row for row in rows if name_of(row) == method]
    returns = mean_and_error([float(row["return"]) for row in mine])
    low, high = min(float(row["return_min"]) for row in mine), max(float(row["return_max"]) for row in mine)

    def mean(name: str) -> float:
        return float(np.mean([float(row[name]) for row in mine]))

    errors = (f"{mean(name):.3f}" for name in ("error_on_data", "error_in_loop"))
    probes = (f"{mean(name):.1f}" for name in PROBES)
    span, good = f"{low:.0f} to {high:.0f}", f"{100 * mean('good_share'):.0f}%"
    return (method, str(len(mine)), returns, span, good, *errors, *probes)


def _gates(rows: list[Row], every: list[Row]) -> Iterator[tuple[str, bool | None, str]]:
    """Name of each gate, whether it is reached (None: not measured), and the number."""
    whole = dict(zip(SETTING, _setting(rows[0]), strict=True)) | {"hidden_share": "0"}
    ceiling = list(_returns([row for row in every if _setting(row) == tuple(whole.values())], NO_MEMORY).values())
    share = float(np.mean(ceiling)) / float(rows[0]["data_return"]) if ceiling else math.nan
    shown, _ = told_apart(share, STATE_SHARE, 2)
    told = f"{shown} of the data's return (n = {len(ceiling)}), at least {STATE_SHARE}" if ceiling else "-"
    yield "nothing hidden and no memory", share >= STATE_SHARE if ceiling else None, told
    floor = _floor(rows)
    others = [name for name in _by_return(rows) if name != floor]
    if floor is not None and others:
        best = next((name for name in others if len(_returns(rows, name)) > 1), others[0])
        yield f"{best} minus {floor}", *_above_floor(difference(rows, best, floor))


def _above_floor(found: SeedDifference | None) -> tuple[bool | None, str]:
    """Whether the best method is above the floor (None: the seeds that both have are too few), and by how much."""
    if found is None or found.n == 1:
        return None, f"{found}, one seed has no standard error" if found else "-"
    return found.tells and found.mean > 0, f"{found}, at least {STANDARD_ERRORS:g} standard errors"


def _floor(rows: list[Row]) -> str | None:
    return next((name for name in (UNTRAINED, NO_MEMORY) if _returns(rows, name)), None)


def _answers(rows: list[Row]) -> Iterator[str]:
    """One sentence for every pair of methods that differ in memory alone, or in past actions alone."""
    remembering = (row for row in rows if row["method"] not in (NO_MEMORY, UNTRAINED) and row["readout"] != "frame")
    methods = {name_of(row): row["method"] for row in remembering}
    pairs = [("memory", name, NO_MEMORY) for name, method in methods.items() if not method.endswith("+a")]
    pairs += [
        ("past actions", name, name.replace("+a", "", 1)) for name, method in methods.items() if method.endswith("+a")
    ]
    for what, method, other in pairs:
        if (found := difference(rows, method, other)) is not None:
            verb = "pay" if what.endswith("s") else "pays"
            negated = f"{'do' if verb == 'pay' else 'does'} not pay"
            answer = f"{what} {verb if found.mean > 0 else negated}"
            said = answer if found.tells else f"the seeds do not tell whether {what} {verb}"
            yield f"{said}: {method} minus {other} is {found}"


def _returns(rows: list[Row], method: str) -> dict[str, float]:
    """Mean return by seed."""
    return {row["seed"]: float(row["return"]) for row in rows if name_of(row) == method}


def _by_return(rows: list[Row]) -> list[str]:
    """Methods, the one that returns most first."""
    names = dict.fromkeys(map(name_of, rows))
    return sorted(names, key=lambda name: -float(np.mean(list(_returns(rows, name).values()))))
