"""Tables shown on a report's page: their columns, and how they are split."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import pandas as pd

from vd4rl_pomdp.report import tables
from vd4rl_pomdp.report.claims import tally
from vd4rl_pomdp.report.figures import seeds_note
from vd4rl_pomdp.report.load import COSTS, PROBES, TOLD_STATES, label, setting
from vd4rl_pomdp.report.render import Block, Columns, block, texts
from vd4rl_pomdp.report.stats import FEW_SEEDS, number, with_interval
from vd4rl_pomdp.runs.files import Row

MARK = "summary"
"""The table that every report has; its file identifies a report's folder."""
WIDEST = 6
"""Maximum methods side by side in a matrix; further ones go below."""


class Shown(NamedTuple):
    """A table as displayed."""

    table: pd.DataFrame
    """Texts, as in the LaTeX file."""
    blocks: list[Block]
    words: int
    """Number of text columns at the left; the others hold numbers."""


def with_algorithm(row: Row) -> str:
    """A setting in words, with the algorithm unless it is TD3+BC."""
    return setting(row) + ("" if row["algorithm"] == "td3_bc" else f", {row['algorithm']}")


def _count(row: Row) -> str:
    return f"{int(row['seeds'])}" + "†" * (0 < row["seeds"] < FEW_SEEDS)


def _span(row: Row, cost: str) -> str:
    """Mean, minimum and maximum of seconds."""
    low, high = row[f"{cost}_min"], row[f"{cost}_max"]
    return number(row[cost], 0) + (f" ({low:.0f} – {high:.0f})" if low < high else "")


def _chance(row: Row) -> str:
    """A probability with its interval, or the number of wins if a single seed allows no probability."""
    if pd.isna(row["probability"]):
        return f"{row['wins']:g} of {row['pairs']}"
    few = "†" if row["seeds"] < FEW_SEEDS else ""
    return with_interval(row["probability"], row["low"], row["high"], 2) + few


def claim_of(row: Row) -> str:
    """A claim, with its family."""
    return row["claim"] + (f" ({row['family']})" if row["family"] else "")


def _p(row: Row) -> str:
    """A p value, and the one adjusted for its family."""
    if pd.isna(row["p"]):
        return number(None)
    told = "" if pd.isna(row["adjusted_p"]) else f" ({row['adjusted_p']:.3f})"
    return f"{row['p']:.3f}{told}"


def _smallest(row: Row) -> str:
    """The smallest detectable difference, also as a percentage of the data's return."""
    share = "" if pd.isna(row["smallest_share"]) else f" ({100 * row['smallest_share']:.0f}%)"
    return number(row["smallest"], 0) + share


SHOWN: dict[str, Columns] = {
    "gates": {
        "setting": with_algorithm,
        "verdict": "verdict",
        "memory": "memory",
        "data's return": ("data_return", 0),
        "state": ("state_share", 2),
        "acro, none": ("acro_share", 2),
        "its bar": lambda row: f"{number(row['acro_bar'], 2)} ({row['bar_from']})",
        "best": ("best_share", 2),
        "best – random": ("above_random", "low", "high", 0),
    },
    "claims": {
        "claim": claim_of,
        "setting": setting,
        "verdict": lambda row: row["verdict"] or "–",
        "left": lambda row: f"{row['left']}: {row['left_return']:.0f} (n = {row['left_seeds']})",
        "right": lambda row: f"{row['right']}: {row['right_return']:.0f} (n = {row['right_seeds']})",
        "difference": ("difference", "low", "high", 0),
        "p (Holm)": _p,
        "would be found": _smallest,
        "played clean": ("clean_difference", "clean_low", "clean_high", 0),
    },
    "lead": {
        "setting": with_algorithm,
        "difference": label,
        "pretraining": lambda row: f"{row['steps']:,} x {row['stacks']}",
        "% of the data's return": ("difference", "low", "high", 1),
        "seeds": lambda row: f"{row['left_seeds']}, {row['right_seeds']}",
    },
    MARK: {
        "setting": setting,
        "method": label,
        "last evaluation": ("score", "low", "high", 1),
        "at update": ("step", 0),
        "best evaluation": ("best_score", "best_low", "best_high", 1),
        "its update": ("best_step", 0),
        "seeds": _count,
        "episodes": "episodes",
        "not there": "missing",
    },
    "aggregate": {
        "corruption": "corruption",
        "method": label,
        **{
            name.replace("_", " ").replace("iqm", "IQM"): (name, f"{name}_low", f"{name}_high", 1)
            for name in tables.AGGREGATES
        },
        "tasks": lambda row: f"{row['tasks']} of {row['of_tasks']}",
        "seeds": _count,
    },
    "improvement": {"corruption": "corruption", "row beats column": "method", "other": "other", "chance": _chance},
    "representations": {
        "setting": setting,
        "method": label,
        "action loss": ("action_loss", 3),
        "pose, %": (PROBES[0], 1),
        "velocity, %": (PROBES[1], 1),
        "return": ("return", 0),
        "seeds": ("seeds", 0),
        "not there": "missing",
    },
    "control": {
        "setting": setting,
        "method": label,
        "data's return": ("data_return", 0),
        "return": ("return", 0),
        "return, clean": ("clean_return", 0),
        "above 80%": ("share_above_80", 2),
        "above 80%, clean": ("clean_share_above_80", 2),
        "error on path": ("path_error", 4),
        "in loop": ("action_error", 4),
        "in loop, clean": ("clean_action_error", 4),
        "seeds": ("seeds", 0),
    },
    "elsewhere": {
        "setting": setting,
        "method": label,
        "played under": "evaluated_under",
        "score": ("score", "low", "high", 1),
        "seeds": _count,
        "episodes": "episodes",
    },
    "critics": {
        "setting": setting,
        "method": label,
        "critic's value": ("critic_value", 1),
        "data's discounted return": ("data_value", 1),
        "moved, %": lambda row: number(100 * row["critic_moved"]),
        "converged": lambda row: (
            "not recorded" if pd.isna(row["converged"]) else f"{row['converged']:.0f} of {row['seeds']}"
        ),
    },
    "costs": {
        "method": "method",
        "machines": lambda row: row["machines"] or "not recorded",
        "pretraining, s": lambda row: _span(row, COSTS[0]),
        "fine-tuning, s": lambda row: _span(row, COSTS[1]),
        "runs": "runs",
    },
}
"""Columns of the page's tables. All tables except WHOLE are split by the values of their first column."""
WORDS = {"gates": 3, "claims": 4, "lead": 3, "elsewhere": 2, "costs": 2}
"""Number of text columns at the left, if not 1."""
WHOLE = ("gates", "costs")


def shown_tables(made: dict[str, pd.DataFrame]) -> dict[str, Shown]:
    """The page's tables, by the base name of their files."""
    found = {}
    for name, columns in SHOWN.items():
        rows, words = made[name], WORDS.get(name, 1)
        if name == "control" and rows["data_return"].isna().all() and rows["clean_return"].isna().all():
            rows = rows.iloc[:0]  # only the return as trained is known
        if name == "critics" and rows["critic_value"].isna().all():
            rows = rows.iloc[:0]
        table = texts(rows, columns)
        found[name] = Shown(table, list(_blocks(name, table, rows, words)), words)
    return found


def _blocks(name: str, table: pd.DataFrame, rows: pd.DataFrame, words: int) -> Iterator[Block]:
    """Split a table by its first column; comparisons of two methods become a matrix."""
    if name in WHOLE:
        note = seeds_note(rows["runs"], "run") if name == "costs" else ""
        yield from [block("", table, words, note)] if len(table) else []
        return
    for heading, part in table.groupby(table.columns[0], sort=False):
        mine, shown = rows.loc[part.index], part.drop(columns=table.columns[0])
        if name == "claims":
            yield block(str(heading), shown, words, tally(mine.to_dict("records")))
        elif name == "improvement":
            order = list(dict.fromkeys(shown["row beats column"]))
            matrix = shown.pivot(index="row beats column", columns="other", values="chance")
            matrix = matrix.reindex(index=order, columns=order).fillna("no common task")
            for one in order:
                matrix.loc[one, one] = ""
            for start in range(0, len(order), WIDEST):
                columns = matrix.iloc[:, start : start + WIDEST].reset_index().rename_axis(columns=None)
                yield block(str(heading), columns, words, seeds_note(mine["seeds"]))
        else:
            note = seeds_note(mine["seeds"])
            told = [method for method in dict.fromkeys(mine["method"]) if method in TOLD_STATES]
            if name == "representations" and told:
                # A linear probe trivially reads out what the encoder was trained to predict.
                names = " and ".join(told)
                note += f" {names}: trained on the states of all episodes, those that the probe holds out, too, but for"
                note += " --hold-out."
            if name == MARK:
                note += f" Memory: {mine['memory'].iloc[0]}."
            if "not there" in shown and not shown["not there"].any():
                shown = shown.drop(columns="not there")
            yield block(str(heading), shown, words, note)


NOTES = {
    MARK: f"{tables.SCORE}. Mean over seeds, 95% t intervals over seeds and episodes.",
    "aggregate": "Over all tasks and seeds, 95% stratified bootstrap intervals.",
    "improvement": "Probability that a run of the row's method ends above one of the column's.",
}
