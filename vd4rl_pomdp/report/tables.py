"""The tables of a report: group-bys of the frames of runs and of evaluations. Every figure shows one of them.

The columns CONDITION, which all seeds of an experiment share, come first. Unknown values are missing.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import combinations

import numpy as np
import pandas as pd

from vd4rl_pomdp.report import load, stats
from vd4rl_pomdp.report.load import CONDITION, COSTS, IDENTITY, SETTING, gaps_in_words, labels
from vd4rl_pomdp.runs.files import Row

SCORE = "Score = return / 10 or the task's own divisor"  # explanation of scores on tables and pages
SERIES = CONDITION[2:]  # columns shared by a method's runs on all tasks
THRESHOLDS = 101  # number of scores at which a performance profile is computed
MANY = 2_000  # bootstrap samples per interval in a profile or matrix, which have many
AGGREGATES = ("iqm", "median", "mean", "optimality_gap")
POINTS = 200  # maximum points of a loss curve
ENDS = ("", "_low", "_high")


def evaluations(episodes: pd.DataFrame) -> pd.DataFrame:
    """One row per evaluation of a run as trained: IDENTITY, step, `score`, and `scores` of its episodes.

    `score` is the mean over the evaluation's episodes, as seeds are the replicates.
    """
    by_step = episodes[episodes["as_trained"]].groupby([*IDENTITY, "step"], sort=False)["score"]
    return by_step.agg(score="mean", scores=list).reset_index()


def summary(evaluated: pd.DataFrame, gaps: pd.DataFrame, unranked: Collection[tuple[str, ...]] = ()) -> pd.DataFrame:
    """Scores of every condition, mean over seeds with 95% interval: of the last evaluation, and of the best one.

    Of evaluations of finished runs and the `gaps` of `find_gaps`. Within a setting (task, quality, corruption), rows
    are sorted by score, or by name if the setting is `unranked`. `absent` counts seeds that are missing, unfinished or
    diverged, and `missing` names them. A condition without finished seeds has no numbers.
    """
    rows = {condition: _scores(seeds) for condition, seeds in evaluated.groupby(list(CONDITION), sort=False)}
    absent = {
        condition: {"absent": len(seeds), "missing": gaps_in_words(seeds.to_dict("records"))}
        for condition, seeds in gaps.groupby(list(CONDITION), sort=False)
    }
    nothing: Row = {"seeds": 0, "episodes": 0, "absent": 0, "missing": ""}
    found = [
        dict(zip(CONDITION, condition, strict=True)) | nothing | rows.get(condition, {}) | absent.get(condition, {})
        for condition in dict.fromkeys([*rows, *absent])
    ]
    columns = [*CONDITION, "step", "score", "low", "high", "seeds", "episodes", "few_seeds"]
    columns += ["best_step", "best_score", "best_low", "best_high", "absent", "missing"]
    table = pd.DataFrame(found, columns=columns)
    return _ranked(table, "score", unranked)


def _ranked(table: pd.DataFrame, by: str, unranked: Collection[tuple[str, ...]]) -> pd.DataFrame:
    """Sort by setting, then by a column, highest first, or by name where the setting is `unranked`."""
    places = table[list(SETTING)].itertuples(index=False, name=None)
    # If a gate fails, sorting by score would suggest a ranking of methods.
    by_name = pd.Series([place in unranked for place in places], table.index, dtype=bool)
    return _ordered(table, -table[by].astype(float).mask(by_name, 0.0), labels(table))


def _scores(rows: pd.DataFrame) -> Row:
    means = rows.groupby("step")["score"].mean()
    found: Row = {}
    for prefix, step in (("", means.index.max()), ("best_", means.idxmax())):
        seeds = rows.loc[rows["step"] == step, "scores"]
        found |= {f"{prefix}step": step} | mean_and_ends(stats.by_episode(list(seeds)), prefix)
        if not prefix:
            found |= {"seeds": len(seeds), "episodes": sum(map(len, seeds)), "few_seeds": len(seeds) < stats.FEW_SEEDS}
    return found


def mean_and_ends(scores: np.ndarray, prefix: str = "", suffix: str = "") -> Row:
    """Mean of (seeds, episodes) scores, and the ends of its interval."""
    low, high = stats.mean_interval(scores) or (None, None)
    values = {"score": float(scores.mean()), "low": low, "high": high}
    return {f"{prefix}{name}{suffix}": value for name, value in values.items()}


def _ordered(table: pd.DataFrame, *keys: pd.Series) -> pd.DataFrame:
    """Sort by setting, then references last, then by some keys; unknown values last."""
    columns = [table[name] for name in SETTING if name in table] + [table["method"].isin(load.REFERENCES), *keys]
    order = pd.concat(columns, axis=1, ignore_index=True).pipe(
        lambda frame: frame.sort_values(list(frame), kind="stable")
    )
    return table.loc[order.index].reset_index(drop=True)


def curves(evaluated: pd.DataFrame) -> pd.DataFrame:
    """Mean and range over seeds at every evaluation."""
    by_step = evaluated.groupby([*CONDITION, "step"])["score"]
    return by_step.agg(score="mean", low="min", high="max", seeds="size").reset_index()


def final_scores(evaluated: pd.DataFrame) -> pd.DataFrame:
    """Last evaluations of every condition, one row per seed."""
    return evaluated[evaluated["step"] == evaluated.groupby(list(CONDITION), sort=False)["step"].transform("max")]


def _strata(finals: pd.DataFrame) -> list[np.ndarray]:
    """Final score of every seed, one array per task and quality."""
    return [seeds.to_numpy() for _, seeds in finals.groupby(["task", "quality"], sort=False)["score"]]


def aggregate(evaluated: pd.DataFrame, gaps: pd.DataFrame) -> pd.DataFrame:
    """AGGREGATES over the tasks and qualities of every method and corruption, with stratified 95% intervals.

    `of_tasks` is the number of tasks and qualities under the corruption. A row with fewer `tasks` is not comparable and
    goes below the others. `seeds` is the minimum over tasks. A method without runs has no numbers.
    """
    finals = final_scores(evaluated)
    everything = pd.concat([finals[list(CONDITION)], gaps[list(CONDITION)]])
    of_tasks = everything.drop_duplicates(list(SETTING)).groupby("corruption").size()
    rows = []
    measured = dict(list(finals.groupby(list(SERIES), sort=False)))
    for series in everything.groupby(list(SERIES), sort=False).groups:
        row = dict(zip(SERIES, series, strict=True)) | {"tasks": 0, "of_tasks": of_tasks[series[0]], "seeds": 0}
        if series in measured:
            strata = _strata(measured[series])
            scores, chosen = np.concatenate(strata), stats.aggregates(strata)
            # Fixed seed: equal rows give a byte-identical page.
            intervals = stats.bootstrap_intervals(strata, chosen, np.random.default_rng(0))
            for name, statistic in chosen.items():
                values = (float(statistic(scores)), *(intervals[name] or (None, None)))
                row |= {f"{name}{end}": value for end, value in zip(ENDS, values, strict=True)}
            row |= {"tasks": len(strata), "seeds": min(map(len, strata))}
        rows.append(row)
    numbers = [f"{name}{end}" for name in AGGREGATES for end in ENDS]
    table = pd.DataFrame(rows, columns=[*SERIES, *numbers, "tasks", "of_tasks", "seeds"])
    return _ordered(table, table["tasks"] < table["of_tasks"], -table["iqm"].astype(float))


def improvement(evaluated: pd.DataFrame) -> pd.DataFrame:
    """Probability that a run of one method beats one of another on the same task, averaged over common tasks.

    Has a stratified 95% interval. If a method has a single seed on some task, there is neither probability nor
    interval, only `wins` out of `pairs` of runs, which are always given. Ties count half.
    """
    rows: list[Row] = []
    finals = final_scores(evaluated)
    for corruption, members in finals.assign(label=labels(finals)).groupby("corruption", sort=False):
        final = {
            name: {task: seeds.to_numpy() for task, seeds in mine.groupby(["task", "quality"], sort=False)["score"]}
            for name, mine in members.groupby("label", sort=False)
        }
        for name, other in combinations(final, 2):
            if common := [task for task in final[name] if task in final[other]]:
                both = [(final[name][task], final[other][task]) for task in common]
                strata, others = [one for one, _ in both], [another for _, another in both]
                found = stats.improvement_interval(strata, others, np.random.default_rng(0), MANY)
                pairs = [len(a) * len(b) for a, b in both]
                chances = [stats.probability_of_improvement([a], [b]) for a, b in both]
                low, high = found or (None, None)
                row: Row = {"probability": float(np.mean(chances)) if found else None, "low": low, "high": high}
                row |= {"wins": float(np.dot(chances, pairs)), "pairs": sum(pairs), "tasks": len(pairs)}
                row["seeds"] = min(len(seeds) for pair in both for seeds in pair)
                chance, low, high = (None if row[k] is None else 1 - row[k] for k in ("probability", "high", "low"))
                turned = {"probability": chance, "low": low, "high": high, "wins": row["pairs"] - row["wins"]}
                rows.append({"corruption": corruption, "method": name, "other": other} | row)
                rows.append({"corruption": corruption, "method": other, "other": name} | row | turned)
    columns = ["corruption", "method", "other", "probability", "low", "high", "wins", "pairs", "tasks", "seeds"]
    return pd.DataFrame(rows, columns=columns)


def profiles(evaluated: pd.DataFrame) -> pd.DataFrame:
    """Fraction of runs (all tasks and seeds of a method) whose final score is above each threshold, with 95% bands.

    Thresholds range from 0 (or the lowest score, if negative) to 100 (or 0, if no score is positive). `of_tasks` is the
    number of tasks and qualities under the corruption: methods with fewer `tasks` are not comparable to the others.
    """
    finals = final_scores(evaluated)
    of_tasks = finals.drop_duplicates(list(SETTING)).groupby("corruption").size()
    top = 100 if (finals["score"] > 0).any() or not (finals["score"] < 0).any() else 0
    thresholds = np.linspace(min(0.0, finals["score"].min()), top, THRESHOLDS)
    parts = []
    for (corruption, _), members in finals.assign(label=labels(finals)).groupby(["corruption", "label"], sort=False):
        strata = _strata(members)
        share, band = stats.performance_profile(strata, thresholds, np.random.default_rng(0), MANY)
        low, high = (np.nan, np.nan) if band is None else band
        names = {"corruption": corruption, "method": members["label"].iloc[0], "runs": len(members)}
        names |= {"tasks": len(strata), "of_tasks": of_tasks[corruption]}
        parts.append(pd.DataFrame(names | {"threshold": thresholds, "share": share, "low": low, "high": high}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def all_runs(runs: pd.DataFrame, gaps: pd.DataFrame) -> pd.DataFrame:
    """The frame of runs, plus rows with a state but no numbers for missing and unfinished runs."""
    table = pd.DataFrame(runs.to_dict("records") + gaps.to_dict("records"), columns=runs.columns)
    return _ordered(table, -table["score"].astype(float))


def representations(table: pd.DataFrame, unranked: Collection[tuple[str, ...]] = ()) -> pd.DataFrame:
    """Means over the finished seeds of every condition in a table of runs: encoder, return, costs; and its gaps.

    A mean is missing if any seed lacks the value. Sorted as in `summary`.
    """
    means = _means(table[table["score"].notna()], ["action_loss", *load.PROBES, "return", *COSTS])
    gaps = [
        (*condition, gaps_in_words(seeds[seeds["score"].isna()].to_dict("records")))
        for condition, seeds in table.groupby(list(CONDITION), sort=False)
    ]
    found = pd.DataFrame(gaps, columns=[*CONDITION, "missing"]).merge(means, how="left", on=list(CONDITION))
    return _ranked(found.fillna({"seeds": 0}), "return", unranked)


def _means(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    """Means of some columns by condition, missing if any seed lacks the value, and the number of `seeds`."""
    grouped = table.groupby(list(CONDITION), sort=False)
    means = grouped[names].agg(lambda column: column.astype(float).mean(skipna=False))
    return means.assign(seeds=grouped.size()).reset_index()


def costs(table: pd.DataFrame) -> pd.DataFrame:
    """Mean, minimum and maximum seconds of both stages by method, over all finished runs, and their machines."""
    finished = table[table["score"].notna()]
    grouped = finished.assign(method=labels(finished)).groupby("method", sort=False)
    ends = (("", "mean"), ("_min", "min"), ("_max", "max"))
    spans = {f"{cost}{end}": (cost, how) for cost in COSTS for end, how in ends}
    machines = ("machine", lambda names: "; ".join(sorted({*names} - {""})))
    return grouped.agg(runs=("seed", "size"), **spans, machines=machines).reset_index()


def control(table: pd.DataFrame, unranked: Collection[tuple[str, ...]] = ()) -> pd.DataFrame:
    """Control performance of every condition and of its data: means over the finished seeds.

    Return, fraction of episodes above 80% of the data's return, and closed-loop action error are from the last
    evaluation: as trained, and under no corruption (`clean_`). Sorted as in `summary`.
    """
    names = ["data_return", *load.CONTROL, *(f"clean_{name}" for name in load.CONTROL), "path_error"]
    found = _means(table[table["score"].notna()], names)
    return _ranked(found, "return", unranked)


def elsewhere(episodes: pd.DataFrame) -> pd.DataFrame:
    """Scores of finished runs' last policies under other corruptions than in training, but none: mean over seeds."""
    last = episodes["step"] == episodes.groupby("id")["step"].transform("max")
    others = episodes[last & ~episodes["as_trained"] & (episodes["evaluated_under"] != "none")]
    rows = []
    for named, runs in others.groupby([*CONDITION, "evaluated_under"], sort=False):
        seeds = list(runs.groupby("seed", sort=False)["score"].agg(list))
        row = dict(zip((*CONDITION, "evaluated_under"), named, strict=True))
        rows.append(row | mean_and_ends(stats.by_episode(seeds)) | {"seeds": len(seeds), "episodes": len(runs)})
    columns = [*CONDITION, "evaluated_under", "score", "low", "high", "seeds", "episodes"]
    return pd.DataFrame(rows, columns=columns)


def critics(table: pd.DataFrame) -> pd.DataFrame:
    """Critic values of every condition and the data's own discounted return: means over finished seeds.

    `critic_moved` is the mean absolute drift, `converged` the number of converged critics; both are missing if any seed
    lacks the value. Algorithms without a critic have no row.
    """
    known = table["critic_value"].notna() | table["converged"].isna()
    mine = table[table["score"].notna() & known]
    found = _means(mine.assign(critic_moved=mine["critic_moved"].abs()), [*load.CRITIC, "converged"])
    return _ordered(found.assign(converged=found["converged"] * found["seeds"]))


def losses(curves: list[tuple[Row, list[tuple[int, float]]]]) -> pd.DataFrame:
    """Mean action loss over pretraining runs of every condition, at up to POINTS steps that all runs logged.

    `curves` are IDENTITY of each finished pretraining, and its losses by step.
    """
    rows = [named | {"step": step, "action_loss": loss} for named, curve in curves for step, loss in curve]
    parts = [pd.DataFrame(columns=[*CONDITION, "step", "action_loss", "seeds"])]
    for condition, part in pd.DataFrame(rows, columns=[*IDENTITY, "step", "action_loss"]).groupby(list(CONDITION)):
        wide = part.pivot_table("action_loss", "step", "seed").dropna()
        chosen = wide.iloc[np.linspace(0, len(wide) - 1, min(len(wide), POINTS)).round().astype(int)]
        named = dict(zip(CONDITION, condition, strict=True))
        means = {"step": chosen.index, "action_loss": chosen.mean(axis=1).to_numpy(), "seeds": wide.shape[1]}
        parts.append(pd.DataFrame(named | means))
    return pd.concat(parts[1:] or parts, ignore_index=True)
