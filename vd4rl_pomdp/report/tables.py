"""From evaluations to tables of scores by condition: everything a figure shows is in one of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.gaps import condition_of, in_words
from vd4rl_pomdp.report.grouping import groups
from vd4rl_pomdp.report.load import CONDITION, END_TO_END, SETTING, LoadedRun
from vd4rl_pomdp.runs.files import Row

TOLD_STATES = ("supervised", "supervised+a")
"""Methods whose encoders are trained on the simulator's states, those of the episodes that a probe holds out, too."""
REFERENCES = ("random", "bc", "drq_bc", *TOLD_STATES, "state")
"""Methods that are references, floors and ceilings: last in a table."""
LOOKS = (
    *("mik+a", "mik", "acro", "ah+a", "fj+a", "supervised+a", "random", "ah", "fj", "supervised", "state"),
    *("curl", "driml", "homer", "one_step_inverse", "no_history", "bc", "drq_bc"),
)
"""The package's methods in the order of their looks, which are the same in every report: the first differ in colour."""
SCORE = "Score = return / 10 or the task's own divisor"
"""What tables and pages say of their scores."""
SCORES_NOTE = f"{SCORE}. Mean over seeds, 95% t intervals over seeds and episodes."
"""What stands below a table of scores."""
_MEASURED = (
    *("step", "score", "low", "high", "seeds", "episodes", "few_seeds"),
    *("best_step", "best_score", "best_low", "best_high"),
)


def label(row: Row) -> str:
    """A method's name in tables and figures, with the algorithm where it is not TD3+BC, and its variant."""
    algorithm = "" if row["method"] in END_TO_END else _algorithm(row)
    return ", ".join(filter(None, (row["method"], algorithm, row["variant"])))


def setting(row: Row) -> str:
    """Task, quality and corruption in words."""
    return f"{row['task']} {row['quality']}, {row['corruption']}"


def with_algorithm(row: Row) -> str:
    """A setting in words, with the algorithm where it is not TD3+BC."""
    return ", ".join(filter(None, (setting(row), _algorithm(row))))


def _algorithm(row: Row) -> str:
    return "" if row["algorithm"] == "td3_bc" else row["algorithm"]


def evaluations(runs: Iterable[LoadedRun]) -> list[Row]:
    """One row for every evaluation of a run: CONDITION, seed, step, mean `score`, and the `scores` of its episodes."""
    table = []
    for run in runs:
        named = run.named
        for (step, *_), episodes in grouped(run.rows, ("step",)):
            scores = [row["score"] for row in episodes]
            table.append(named | {"step": step, "score": float(np.mean(scores)), "scores": scores})
    return table


def summary(rows: list[Row], gaps: list[Row], unranked: Collection[tuple[str, ...]] = ()) -> list[Row]:
    """Scores of every condition, mean over seeds with 95% interval: of the last evaluation, and of the best one.

    The highest score of a setting (task, quality, corruption) comes first, unless it is `unranked`: there names decide.
    `absent` counts its seeds that are missing, unfinished or diverged, `missing` names them; a condition without any
    finished seed has no numbers.

    Args:
        rows: evaluations of finished runs.
        gaps: of `find_gaps`.
        unranked: settings whose methods are not ranked.
    """
    absent = groups(gaps, condition_of)
    table = []
    for group, members in grouped(rows, CONDITION):
        condition = dict(zip(CONDITION, group, strict=True))
        table.append(condition | _scores(members) | _absent(absent.pop(group, [])))
    nothing = dict.fromkeys(_MEASURED) | {"seeds": 0, "episodes": 0}
    table += [
        dict(zip(CONDITION, group, strict=True)) | nothing | _absent(members) for group, members in absent.items()
    ]
    return sorted(table, key=lambda row: _summary_order(row, unranked))


def _absent(gaps: list[Row]) -> Row:
    return {"absent": len(gaps), "missing": in_words(gaps)}


def _scores(rows: list[Row]) -> Row:
    """Values of _MEASURED of one condition."""
    curve = _by_step(rows)
    final = max(curve)
    best = max(curve, key=lambda step: _seeds(curve[step]).mean())
    found: Row = {"step": final, "best_step": best}
    ends = {step: mean_and_ends(_by_episode(curve[step])) for step in {final, best}}
    for prefix, step in (("", final), ("best_", best)):
        found |= dict(zip((f"{prefix}score", f"{prefix}low", f"{prefix}high"), ends[step], strict=True))
    count = len(curve[final])
    found |= {"seeds": count, "episodes": sum(len(row["scores"]) for row in curve[final])}
    return {name: (found | {"few_seeds": count < stats.FEW_SEEDS})[name] for name in _MEASURED}


def mean_and_ends(scores: np.ndarray) -> tuple[float, float | None, float | None]:
    """Mean of (seeds, episodes) scores, and the ends of its interval."""
    return float(scores.mean()), *(stats.mean_interval(scores) or (None, None))


def curves(rows: list[Row]) -> list[Row]:
    """Mean over seeds, and their range, at every evaluation."""
    table = []
    for group, members in grouped(rows, CONDITION):
        for step, at_step in sorted(_by_step(members).items()):
            scores = _seeds(at_step)
            table.append(
                dict(zip(CONDITION, group, strict=True))
                | {"step": step, "score": float(scores.mean())}
                | {"low": float(scores.min()), "high": float(scores.max()), "seeds": len(scores)}
            )
    return table


def final_scores(rows: list[Row]) -> np.ndarray:
    """Score of every seed of one condition at its last evaluation, (n,)."""
    curve = _by_step(rows)
    return _seeds(curve[max(curve)])


def final_episodes(rows: list[Row]) -> np.ndarray:
    """The same episode by episode, (n, episodes)."""
    curve = _by_step(rows)
    return _by_episode(curve[max(curve)])


def table_order(row: Row) -> tuple:
    """By setting, references last, the highest score first, and rows without a score at the end."""
    place = tuple(row.get(name, "") for name in SETTING)
    score = row["iqm"] if "iqm" in row else row.get("score", row.get("return"))
    return *place, row["method"] in REFERENCES, np.inf if score is None else -float(score)


def _summary_order(row: Row, unranked: Collection[tuple[str, ...]]) -> tuple:
    """`table_order`, but by name where methods are not ranked."""
    *place, reference, score = table_order(row)
    return *place, reference, 0.0 if tuple(place) in unranked else score, label(row)


def grouped(rows: Iterable[Row], names: Sequence[str]) -> list[tuple[tuple, list[Row]]]:
    """Rows by their values in some columns, in the order in which these first come."""
    return list(groups(rows, lambda row: tuple(row[name] for name in names)).items())


def by_label(rows: Iterable[Row]) -> list[tuple[str, list[Row]]]:
    """Rows by their method's name in tables and figures, likewise."""
    return list(groups(rows, label).items())


def _by_step(rows: list[Row]) -> dict[int, list[Row]]:
    return {step[0]: members for step, members in grouped(rows, ("step",))}


def _seeds(rows: list[Row]) -> np.ndarray:
    """Score of every seed at one evaluation."""
    return np.array([row["score"] for row in rows])


def _by_episode(rows: list[Row]) -> np.ndarray:
    """The same episode by episode, (n, episodes)."""
    return stats.by_episode([row["scores"] for row in rows])
