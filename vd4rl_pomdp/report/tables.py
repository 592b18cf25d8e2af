"""From raw evaluation rows to tables: everything a figure shows is in one of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from vd4rl_pomdp.evaluation import summarise
from vd4rl_pomdp.report import stats
from vd4rl_pomdp.report.gaps import CONDITION, condition_of, in_words
from vd4rl_pomdp.report.load import IDENTITY, LoadedRun
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.tasks import SCORE_DIVISOR

SERIES = ("corruption", "algorithm", "method", "variant")
REFERENCES = ("random", "bc", "drq_bc", "supervised", "supervised+a", "state")
"""Methods that are references, floors and ceilings: last in a table."""
END_TO_END = ("bc", "drq_bc")
"""References that bring their own algorithm."""


def label(row: Row) -> str:
    """A method's name in tables and figures, with the algorithm where it is not TD3+BC, and its variant."""
    own = row["algorithm"] == "td3_bc" or row["method"] in END_TO_END
    return ", ".join(filter(None, (row["method"], "" if own else row["algorithm"], row["variant"])))


def representations(runs: list[LoadedRun], gaps: list[Row]) -> list[Row]:
    """One row for every evaluated run: its encoder's measures, its policy's score, and what both cost.

    Rows of missing or unfinished runs have a state but no numbers.
    """
    table = []
    for run in runs:
        if run.rows and run.finished:
            final = max(row["step"] for row in run.rows)
            score = float(np.mean([row["score"] for row in run.rows if row["step"] == final]))
            identity = dict(zip(IDENTITY, run.identity, strict=True))
            costs = {"finetune_seconds": run.seconds, "git_commit": run.record.get("git_commit", "")}
            scores = {"score": score, "return": score * SCORE_DIVISOR}
            table.append(identity | run.representation | scores | costs | {"state": run.progress})
    return sorted([*table, *(dict.fromkeys(_RUN) | gap for gap in gaps)], key=_table_order)


def control(runs: list[LoadedRun]) -> list[Row]:
    """What the policies of every condition do, beside the data they learned from: means over the finished seeds.

    Return, share of episodes above 80% of the data's return, and action error in closed loop are those of the last
    evaluation: as trained, and under no corruption (`clean_`). What no seed knows is None.
    """
    finished = [run for run in runs if run.rows and run.finished]
    measured = [dict(zip(IDENTITY, run.identity, strict=True)) | _control(run) for run in finished]
    table = [
        dict(zip(CONDITION, group, strict=True))
        | {name: _known_mean([row[name] for row in members]) for name in _CONTROL}
        | {"seeds": len(members)}
        for group, members in _grouped(measured, CONDITION)
    ]
    return sorted(table, key=_table_order)


def _control(run: LoadedRun) -> Row:
    """Values of _CONTROL of one run."""
    found: Row = {"data_return": run.reference.data_return, "path_error": run.reference.path_error}
    final = max(row["step"] for row in run.rows)
    for prefix, rows in (("", run.rows), ("clean_", run.clean)):
        last = [row for row in rows if row["step"] == final]
        summed = summarise(last, run.reference) if last else {}
        found |= {prefix + name: summed.get(key) for name, key in _EVALUATED.items()}
    return found


def _known_mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def improvement(rows: list[Row]) -> list[Row]:
    """Probability that a run of one method beats one of another on the same task, averaged over common tasks."""
    table = []
    for (corruption, *_), members in _grouped(rows, ("corruption",)):
        final: dict[str, dict[tuple, np.ndarray]] = {}
        for (task, quality, *_), group in _grouped(members, CONDITION):
            final.setdefault(label(group[0]), {})[task, quality] = _final_scores(group)
        for name, scores in final.items():
            for other, others in final.items():
                common = [task for task in scores if task in others]
                if name != other and common:
                    chances = [stats.probability_of_improvement(scores[t], others[t]) for t in common]
                    names = {"corruption": corruption, "method": name, "other": other}
                    table.append(names | {"probability": float(np.mean(chances)), "tasks": len(common)})
    return table


def profiles(rows: list[Row], thresholds: np.ndarray) -> list[Row]:
    """Share of runs (all tasks and seeds of a method) whose final score is above each threshold."""
    table = []
    for (corruption, *_), members in _grouped(rows, SERIES):
        strata = _strata(members)
        share = stats.performance_profile(np.concatenate(strata), thresholds)
        names = {"corruption": corruption, "method": label(members[0])}
        table += [names | {"threshold": float(t), "share": float(v)} for t, v in zip(thresholds, share, strict=True)]
    return table


def summary(rows: list[Row], gaps: list[Row], unranked: Collection[tuple[str, ...]] = ()) -> list[Row]:
    """Final score of every condition: mean over seeds, 95% interval, n seeds, n episodes, best evaluation's mean.

    The highest score of a setting (task, quality, corruption) comes first, unless it is `unranked`: there names decide.
    `missing` names its seeds that are missing or unfinished; a condition without any finished seed has no numbers.
    """
    absent: dict[tuple[str, ...], list[Row]] = {}
    for gap in gaps:
        absent.setdefault(condition_of(gap), []).append(gap)
    table = []
    for group, members in _grouped(rows, CONDITION):
        curve = _by_step(members)
        final = max(curve)
        scores = _per_seed(curve[final])
        interval = stats.bootstrap_interval([scores], stats.mean, np.random.default_rng(0))
        best = max(curve, key=lambda step: _per_seed(curve[step]).mean())
        table.append(
            dict(zip(CONDITION, group, strict=True))
            | {"step": final, "score": float(scores.mean())}
            | {"low": interval[0] if interval else None, "high": interval[1] if interval else None}
            | {"seeds": len(scores), "episodes": len(curve[final]), "few_seeds": len(scores) < stats.FEW_SEEDS}
            | {"best_score": float(_per_seed(curve[best]).mean()), "best_step": best}
            | {"missing": in_words(absent.pop(group, []))}
        )
    nothing = dict.fromkeys(_MEASURED) | {"seeds": 0, "episodes": 0}
    table += [
        dict(zip(CONDITION, group, strict=True)) | nothing | {"missing": in_words(members)}
        for group, members in absent.items()
    ]
    return sorted(table, key=lambda row: _summary_order(row, unranked))


def curves(rows: list[Row]) -> list[Row]:
    """Mean over seeds, and their range, at every evaluation."""
    table = []
    for group, members in _grouped(rows, CONDITION):
        for step, at_step in sorted(_by_step(members).items()):
            scores = _per_seed(at_step)
            table.append(
                dict(zip(CONDITION, group, strict=True))
                | {"step": step, "score": float(scores.mean())}
                | {"low": float(scores.min()), "high": float(scores.max()), "seeds": len(scores)}
            )
    return table


def aggregate(rows: list[Row], gaps: list[Row]) -> list[Row]:
    """IQM and optimality gap over tasks and qualities for every method and corruption, with stratified intervals.

    `of_tasks` is the number of tasks and qualities under the corruption: a row with fewer `tasks` cannot be compared
    with the others. A method that has not been run has no numbers.
    """
    everything = _grouped([*rows, *gaps], ("corruption",))
    of_tasks = {key[0]: len(_grouped(members, ("task", "quality"))) for key, members in everything}
    table, absent = [], dict.fromkeys(tuple(gap[name] for name in SERIES) for gap in gaps)
    for group, members in _grouped(rows, SERIES):
        absent.pop(group, None)
        strata = _strata(members)
        scores = np.concatenate(strata)
        interval = stats.bootstrap_interval(strata, stats.iqm, np.random.default_rng(0))
        table.append(
            dict(zip(SERIES, group, strict=True))
            | {"iqm": float(stats.iqm(scores)), "optimality_gap": float(stats.optimality_gap(scores))}
            | {"low": interval[0] if interval else None, "high": interval[1] if interval else None}
            | {"tasks": len(strata), "of_tasks": of_tasks[group[0]], "seeds": min(map(len, strata))}
        )
    nothing = dict.fromkeys(("iqm", "optimality_gap", "low", "high"))
    table += [
        dict(zip(SERIES, group, strict=True)) | nothing | {"tasks": 0, "of_tasks": of_tasks[group[0]], "seeds": 0}
        for group in absent
    ]
    return sorted(table, key=_table_order)


_RUN = (
    *(*IDENTITY, "action_loss", "probe_pose", "probe_velocity", "pretrain_seconds"),
    *("score", "return", "finetune_seconds", "git_commit", "state"),
)
_EVALUATED = {"return": "return_mean", "share_above_80": "share_above_80", "action_error": "action_error"}
"""Columns of `control` that tell of an evaluation, and what `summarise` calls them."""
_CONTROL = ("data_return", *_EVALUATED, *(f"clean_{name}" for name in _EVALUATED), "path_error")
_MEASURED = ("step", "score", "low", "high", "seeds", "episodes", "few_seeds", "best_score", "best_step")


def _table_order(row: Row) -> tuple:
    """By setting, references last, the highest score first, and rows without a score at the end."""
    setting = tuple(row.get(name, "") for name in ("task", "quality", "corruption"))
    score = row["iqm"] if "iqm" in row else row.get("score", row.get("return"))
    return *setting, row["method"] in REFERENCES, np.inf if score is None else -float(score)


def _summary_order(row: Row, unranked: Collection[tuple[str, ...]]) -> tuple:
    """`_table_order`, but by name where methods are not ranked."""
    *setting, reference, score = _table_order(row)
    return *setting, reference, 0.0 if tuple(setting) in unranked else score, label(row)


def _grouped(rows: list[Row], names: Iterable[str]) -> list[tuple[tuple, list[Row]]]:
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return list(groups.items())


def _by_step(rows: list[Row]) -> dict[int, list[Row]]:
    return {step[0]: members for step, members in _grouped(rows, ("step",))}


def _strata(rows: list[Row]) -> list[np.ndarray]:
    """Final score of every seed, one array a task and quality."""
    return [_final_scores(members) for _, members in _grouped(rows, ("task", "quality"))]


def _final_scores(rows: list[Row]) -> np.ndarray:
    curve = _by_step(rows)
    return _per_seed(curve[max(curve)])


def _per_seed(rows: list[Row]) -> np.ndarray:
    """Mean score of each seed's episodes."""
    return np.array([np.mean([row["score"] for row in members]) for _, members in _grouped(rows, ("seed",))])
