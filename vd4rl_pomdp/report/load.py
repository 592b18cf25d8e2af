"""Runs as a report looks at them: one typed record each, from which the frame of runs and that of evaluations are made.

A number of a table goes this way: rows of `episodes.csv` (`runs.results`), a `Run`, `runs_frame` or
`episodes_frame`, a group-by in `report.tables`.

Variants of a method are told by the settings that differ among its runs, in words that stand beside the method's name:
runs are seeds of one experiment only if they agree in everything but seed, folders, device and logging. A fine-tuning
run has its own config, its encoder's, and the data of both.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import LABELS, LATER, settings_of
from vd4rl_pomdp.core.reading import damaged
from vd4rl_pomdp.corruptions import corruption_settings
from vd4rl_pomdp.data.reference import Reference, summarise
from vd4rl_pomdp.runs import REFERENCE_FILE
from vd4rl_pomdp.runs.critic import CONVERGED
from vd4rl_pomdp.runs.episodes import COLUMNS
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.results import DAMAGED, Result, find_results

SETTING = ("task", "quality", "corruption")
"""Columns of what methods are compared in."""
CONDITION = (*SETTING, "algorithm", "method", "variant")
"""What all seeds of an experiment share: the columns that tell it from others."""
IDENTITY = (*CONDITION, "seed")
"""Columns that tell a run's rows from all others of a report: what its files name it by, and its variant."""
PROBES = ("probe_pose", "probe_velocity")
"""Errors of linear probes of an encoder."""
CRITIC = {"critic_value": "value", "critic_moved": "moved", "data_value": "data"}
"""What a run's critic came to (see `critic_of`): columns, and what critic.json calls them."""
COSTS = ("pretrain_seconds", "finetune_seconds")
ACTION_ERRORS = ("path_error", "action_error")
"""Of a policy, on the data's rows and in closed loop."""
CONTROL = {"return": "return_mean", "share_above_80": "share_above_80", "action_error": "action_error"}
"""Columns that tell of the last evaluation, also as `clean_` under no corruption, and what `summarise` calls them."""
MISSING = "missing"
STATE = "state"
"""The method that sees the simulator's state, whatever a setting hides."""
END_TO_END = ("bc", "drq_bc")
"""References that bring their own algorithm."""
TOLD_STATES = ("integrator", "supervised_picture", "supervised", "supervised+a")
"""Methods whose encoders are trained on the simulator's states, those of the episodes that a probe holds out, too."""
REFERENCES = ("random", "bc", "drq_bc", *TOLD_STATES, STATE)
"""Methods that are references, floors and ceilings: last in a table."""

Settings = dict[str, str]
"""Values as words, by the name that is shown beside them."""
Parts = tuple[str, str]
"""What differs among all runs of a method, and of the data among those of one setting."""

_UNSET = "unset"
PRESETS = ("preset", "pretraining preset")
DATA = ("data", "pretraining data")
"""Names of the sets' fingerprints."""
OF_CORRUPTION = "corruption "
"""What the names of a corruption's settings begin with: other parts may have options of the same names."""
ENCODER_SEED = "pretraining seed"
"""The seed of a run's encoder, where the run's own is another: its seeds share what they were pretrained with."""


def _words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


PLAIN = {
    **{"history": "method", "random_histories": "0", "history_window": "0", "readout": "state"},
    **{"pose_noise": "0", "velocity_noise": "0"},
    **{name: _words(value) for name, value in LATER.items()},
}
"""Values that add nothing to a method: what has them goes by the method's name, and others are its variants."""


class Choice:
    """What a report is about: everything, unless a subclass says otherwise."""

    def among(self, results: list[Result]) -> list[Result]:
        """The chosen ones of the runs that were found, in their order."""
        return results

    def asks(self, row: Row) -> bool:
        """Whether a run that is not there, told by its labels, is missed."""
        return True

    @property
    def wanted(self) -> Sequence[Row]:
        """Labels of the policies that are asked for, where it is told."""
        return ()


ALL = Choice()


def without_options(row: Mapping[str, Any], names: Iterable[str]) -> tuple[Any, ...]:
    """Some labels of a run or gap, without what tells a corruption's options apart."""
    return tuple(row[name].partition(",")[0] if name == "corruption" else row[name] for name in names)


@dataclass(frozen=True)
class Run:
    """A run of any stage, finished or not."""

    result: Result
    """Its files."""
    labels: Row
    """Values of `options.LABELS`; the task is empty until the run has opened its data. The corruption is followed
    by its options where other runs have others of the same name, "patch, patch_size 48": that is another setting."""
    settings: Settings
    """All settings in which runs of its method may differ, in words."""
    reference: Reference
    """What its policy is held against."""
    measures: dict[str, float | None]
    """Of its encoder, critic and costs: action_loss, PROBES, CRITIC, COSTS; None where it is not known."""
    parts: Parts = ("", "")
    """Its settings that differ from those of other runs of its method, by the runs it is compared with."""

    @property
    def path(self) -> Path:
        """Its folder, or the results folder that tells of it."""
        return self.result.path

    @property
    def record(self) -> Row:
        """config.json: stage, config, versions, git_commit, command, inputs."""
        return self.result.record

    @property
    def stage(self) -> str:
        """What it does: "pretrain", "finetune" or "navigation"."""
        return self.record["stage"]

    @property
    def method(self) -> str:
        """Its method, without its variant."""
        return self.labels["method"]

    @property
    def set_name(self) -> str:
        """Task and quality."""
        return f"{self.labels['task']} {self.labels['quality']}"

    @property
    def variant(self) -> str:
        """Its settings that differ from those of other runs of its method: "max_k 1"; empty if none does."""
        return ", ".join(filter(None, self.parts))

    @cached_property
    def named(self) -> Row:
        """Values of IDENTITY."""
        return {name: self.variant if name == "variant" else self.labels[name] for name in IDENTITY}

    def of(self, names: Iterable[str]) -> tuple[Any, ...]:
        """Values of some columns of IDENTITY."""
        return tuple(self.named[name] for name in names)

    @property
    def end_to_end(self) -> bool:
        """Whether its encoder was trained with the policy."""
        return bool(self.result.encoder.get("end_to_end")) or self.method in END_TO_END

    @cached_property
    def rows(self) -> list[Row]:
        """Evaluation rows under the corruption of training."""
        return [row for row in self.result.rows if row["evaluated_under"] == row["corruption"]]

    @cached_property
    def last(self) -> list[Row]:
        """Rows of its last evaluation, under the corruption of training."""
        end = max((row["step"] for row in self.rows), default=None)
        return [row for row in self.rows if row["step"] == end]

    @cached_property
    def last_clean(self) -> list[Row]:
        """Rows of its last evaluation under no corruption, whatever it was trained under; empty if there was none."""
        end = {row["step"] for row in self.last}
        return [row for row in self.result.rows if row["step"] in end and row["evaluated_under"] == "none"]

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end, as one that diverged has not."""
        return self.result.finished and self.result.diverged is None

    @property
    def evaluated(self) -> bool:
        """Whether it has come to its end, and its policy was evaluated: what is compared."""
        return self.finished and bool(self.rows)

    @property
    def converged(self) -> bool | None:
        """Whether its critic did, by `CONVERGED`; True for an algorithm without one, None if it is not recorded."""
        told = self.result.files.get("critic", {} if self.labels["algorithm"] == "bc" else None)
        if told == {} and "gamma" not in self.record["config"]:  # what discounts returns has a critic
            return True
        moved = self.measures["critic_moved"]
        return None if moved is None else abs(moved) < CONVERGED

    @property
    def progress(self) -> str:
        """How far it is: "finished", "diverged at update 20 of 40", or "unfinished at 20 of 40 updates"."""
        if self.finished:
            return "finished"
        unit = "updates" if self.stage == "finetune" else "steps"
        last = self.record["config"].get(unit, "?")
        if self.result.diverged is not None:
            return f"diverged at {unit[:-1]} {self.result.diverged.get('step', self.result.step)} of {last}"
        return f"unfinished at {self.result.step} of {last} {unit}"


def label(row: Mapping[str, Any]) -> str:
    """A method's name in tables and figures, with the algorithm where it is not TD3+BC, and its variant."""
    algorithm = "" if row["method"] in END_TO_END or row["algorithm"] == "td3_bc" else row["algorithm"]
    return ", ".join(filter(None, (row["method"], algorithm, row["variant"])))


def setting(row: Mapping[str, Any]) -> str:
    """Task, quality and corruption in words."""
    return f"{row['task']} {row['quality']}, {row['corruption']}"


def title(run: Run) -> str:
    """A run's stage, method and setting, all but its seed."""
    return f"{run.stage} {label(run.named)}, {setting(run.labels)}"


def labels(table: pd.DataFrame) -> pd.Series:
    """`label` of every row."""
    return pd.Series([label(row) for row in table.to_dict("records")], table.index, dtype=object)


def load_runs(paths: Sequence[Path | str], but: Path | None = None, choice: Choice = ALL) -> list[Run]:
    """The chosen runs at or below the paths, of run folders and results folders; `but` as in `find_results`.

    Raises:
        UserError: there is no run, two have the same identity, or a file of one is damaged.
    """
    runs = _told_apart([_load(result) for result in choice.among(find_results(paths, but))])
    seen: dict[tuple[Any, ...], Path] = {}
    for run in runs:
        other = seen.setdefault(run.of(IDENTITY), run.path) if run.rows else run.path
        if other is not run.path:
            raise UserError(f"{run.path} and {other}: two runs of one method, setting and seed; report one of them")
    return runs


def _load(result: Result) -> Run:
    """A run of its files; raises UserError for files that are valid JSON, but not what a run writes."""
    with damaged(result.place, *DAMAGED):
        probe, stored = result.files.get("probe", {}), result.files.get("reference")
        critic = result.files.get("critic", {})
        told = {
            "action_loss": result.encoder.get("action_loss"),
            **{name: probe.get(name) for name in PROBES},
            **{name: critic.get(key) for name, key in CRITIC.items()},
            "pretrain_seconds": result.files.get("pretrain_timing", {}).get("seconds"),
            "finetune_seconds": result.files["timing"]["seconds"] if result.finished else None,
        }
        if wrong := [value for value in told.values() if value is not None and not isinstance(value, int | float)]:
            raise TypeError(f"{wrong[0]!r} is no number")
        reference = Reference() if stored is None else Reference.parse(result.path / REFERENCE_FILE, stored)
        return Run(result, result.labels, read_settings(result.record, result.card), reference, told)


def _told_apart(runs: list[Run]) -> list[Run]:
    """Runs with their `parts`, and with the options in which others of their corruption's name differ beside it."""
    sets, names = [run.set_name for run in runs], [run.labels["corruption"] for run in runs]
    stages = [(run.stage, run.labels["algorithm"]) for run in runs]
    methods = [(*stage, run.method) for stage, run in zip(stages, runs, strict=True)]
    # All runs are alike in what hides pixels: a corruption has one name, whatever learns under it.
    hiding = without_sets([of_corruption(run.settings) for run in runs], sets, [""] * len(runs))
    own = without_sets([without(run.settings, of_corruption(run.settings)) for run in runs], sets, stages)
    options = differences(
        [{name.removeprefix(OF_CORRUPTION): value for name, value in one.items()} for one in hiding], names
    )
    corruptions = [
        name if name == "none" else ", ".join(filter(None, (name, told)))
        for name, told in zip(names, options, strict=True)
    ]
    of_methods = differences([without(one, DATA) for one in own], methods)
    # Two sets always differ in their fingerprints; only two contents of one set make another experiment.
    data = [{name: one[name] for name in DATA if name in one} for one in own]
    places = list(zip(methods, sets, corruptions, strict=True))
    for alike in (places, list(zip(places, of_methods, strict=True))):
        for mine in groups(range(len(runs)), alike.__getitem__).values():
            if a_set_a_seed([runs[i] for i in mine]):
                for i in mine:
                    data[i][DATA[0]] = "one a seed"
    of_data = differences(data, places)
    return [
        replace(run, labels=run.labels | {"corruption": corruption}, parts=(of_method, of_set))
        for run, corruption, of_method, of_set in zip(runs, corruptions, of_methods, of_data, strict=True)
    ]


def read_settings(record: Mapping[str, Any], card: Mapping[str, Any]) -> Settings:
    """All settings behind a run, those of a corruption with OF_CORRUPTION before their names.

    Args:
        record: its config.json.
        card: its encoder's card, empty for a pretraining run or where there is none.
    """
    own, hiding = settings_of(record["config"]), dict(card.get("corruption", {}))
    if record["stage"] == "pretrain":
        hiding = {name: own[name] for name in corruption_settings(str(own.get("corruption"))) if name in own}
        own = without(own, hiding)
    before = {name: card[name] for name in ("steps", "preset") if name in card} | (card.get("settings") or {})
    found = own | {(f"pretraining {k}" if k in own else k): v for k, v in without(before, hiding).items()}
    found |= {OF_CORRUPTION + name: value for name, value in hiding.items()}
    found |= {"format": record["format"]} if "format" in record else {}
    words = {name: _words(value) for name, value in found.items() if name not in ("method", "task", "quality")}
    if card.get("seed", record["config"]["seed"]) != record["config"]["seed"]:
        words[ENCODER_SEED] = str(card["seed"])
    data, first = record.get("inputs", {}).get("data"), card.get("data")
    prints = zip(DATA, (data, "the same" if data and first == data else first), strict=True)
    return words | {name: value[:8] for name, value in prints if value}


def of_corruption(settings: Settings) -> Settings:
    """Those of some settings that are a corruption's."""
    return {name: value for name, value in settings.items() if name.startswith(OF_CORRUPTION)}


def without(settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Settings but those of some names."""
    return {name: value for name, value in settings.items() if name not in names}


def without_sets(settings: Sequence[Settings], sets: Sequence[str], alike: Sequence[Hashable]) -> list[Settings]:
    """Settings but those that go by the set, such as a budget: runs on one set agree in them, and the sets differ.

    Args:
        settings: of every run.
        sets: task and quality of every run.
        alike: what runs share that are looked at together.
    """
    # A task's own budget is no ablation: as a variant it would make two methods of one, and gaps on every other task.
    kept = [dict(one) for one in settings]
    for places in groups(range(len(settings)), alike.__getitem__).values():
        for name in {name for i in places for name in settings[i]} - {ENCODER_SEED, *DATA}:
            having = groups((i for i in places if name in settings[i]), sets.__getitem__)
            values = [{settings[i][name] for i in mine} for mine in having.values()]
            if all(len(found) == 1 for found in values) and len(set().union(*values)) > 1:
                for i in places:
                    kept[i].pop(name, None)
    return kept


def differences(settings: Sequence[Settings], alike: Sequence[Hashable]) -> list[str]:
    """What differs of each run's settings among those that are alike, in words; nothing where none are recorded."""
    words = [""] * len(settings)
    for places in groups((i for i, own in enumerate(settings) if own), alike.__getitem__).values():
        for i, told in zip(places, _differences([settings[i] for i in places]), strict=True):
            words[i] = told
    return words


def _differences(settings: Sequence[Settings]) -> list[str]:
    """What differs among some settings: "max_k 1, steps 20"; nothing for a value that adds nothing.

    ENCODER_SEED is told even where it does not differ: no other name says that seeds share an encoder. A preset is
    named in place of the settings that it decides.
    """
    names = [name for name in dict.fromkeys(name for one in settings for name in one) if name != ENCODER_SEED]
    columns = {name: [one.get(name, PLAIN[name] if name in LATER else _UNSET) for one in settings] for name in names}
    columns = {name: column for name, column in columns.items() if len(set(column)) > 1}
    # An option of a chosen part is not there without the part: naming the part says it all.
    everywhere = [name for name, column in columns.items() if _UNSET not in column]
    columns = {name: column for name, column in columns.items() if not _decided(name, columns, everywhere)}
    presets: list[str] = []
    for name in PRESETS:
        if name in columns and not _decided(name, columns, presets):
            presets.append(name)
    columns = {name: column for name, column in columns.items() if not _decided(name, columns, presets)}
    told = [{name: column[i] for name, column in columns.items()} for i in range(len(settings))]
    for own, one in zip(told, settings, strict=True):
        own |= {name: value for name, value in one.items() if name == ENCODER_SEED}
    return [", ".join(f"{name} {value}" for name, value in own.items() if value != PLAIN.get(name)) for own in told]


def _decided(name: str, columns: Mapping[str, list[str]], by: Sequence[str]) -> bool:
    """Whether a setting has the same value wherever others, of which it is none, have the same."""
    deciding = list(zip(*(columns[other] for other in by), strict=True)) or [()] * len(columns[name])
    return name not in by and len(set(zip(deciding, columns[name], strict=True))) == len(set(deciding))


def a_set_a_seed(runs: Sequence[Run]) -> bool:
    """Whether each of two or more training seeds has a set of its own, collected alike but for the collection's seed.

    Then sets vary as seeds do, and runs on them are seeds of one method. Two contents for one training seed, or of one
    collection, make other experiments.
    """
    plans = [run.record.get("collection") or {} for run in runs]
    contents = [run.record.get("inputs", {}).get("data") for run in runs]
    seeds = [run.labels["seed"] for run in runs]
    found = set(zip(seeds, contents, [plan.get("seed") for plan in plans], strict=True))
    if not all(plans) or len(found) < 2 or any(len(set(column)) < len(found) for column in zip(*found, strict=True)):
        return False
    drawn = [(plan.get("rendered_by") or {}).get("canary") for plan in plans]
    told = [without(plan, ("seed", "rendered_by")) | {"drawn": one} for plan, one in zip(plans, drawn, strict=True)]
    return all(one == told[0] for one in told)


def episodes_frame(runs: Iterable[Run]) -> pd.DataFrame:
    """One row for every evaluation episode: `id` and IDENTITY of its run, and the columns of `episodes.csv`.

    `as_trained` tells those under the corruption of training.
    """
    rows = [
        row | run.named | {"id": run.result.id, "as_trained": row["evaluated_under"] == row["corruption"]}
        for run in runs
        for row in run.result.rows
    ]
    columns = ["id", *IDENTITY, *(name for name in COLUMNS if name not in IDENTITY), "as_trained"]
    return pd.DataFrame(rows, columns=columns).astype({"as_trained": bool})


def runs_frame(runs: Iterable[Run]) -> pd.DataFrame:
    """One row for every finished and evaluated run: encoder, scores, control, costs and provenance; None is unknown."""
    table = pd.DataFrame([_run_row(run) for run in runs if run.evaluated], columns=[*IDENTITY, *_RUN])
    return table.astype({name: float for name in _RUN if name not in _WORDS})


_RUN = (
    *("id", "action_loss", *PROBES, *ACTION_ERRORS, "score", "return", "best_score", "best_step"),
    *("data_return", "share_above_80", *(f"clean_{name}" for name in CONTROL)),
    *(*CRITIC, "converged", *COSTS, "git_commit", "machine", "state"),
)
_WORDS = ("id", "converged", "git_commit", "machine", "state")


def _run_row(run: Run) -> Row:
    by_step = groups(run.rows, lambda row: int(row["step"]))
    scores = {step: np.mean([row["score"] for row in rows]) for step, rows in by_step.items()}
    best = max(scores, key=scores.__getitem__)
    row: Row = {"id": run.result.id, "state": run.progress, "machine": run.result.machine}
    row |= {"git_commit": run.result.commit, "data_return": run.reference.data_return, "converged": run.converged}
    row |= {"score": scores[max(scores)], "best_score": scores[best], "best_step": best}
    row |= run.named | run.measures | {"path_error": run.reference.path_error}
    for prefix, episodes in (("", run.last), ("clean_", run.last_clean)):
        summed = summarise(episodes, run.reference) if episodes else {}
        row |= {prefix + name: summed.get(key) for name, key in CONTROL.items()}
    return row


def find_gaps(runs: list[Run], choice: Choice = ALL) -> list[Row]:
    """One row for each run that is missing or unfinished: CONDITION, seed and `state`.

    Expected in a setting are all methods of the report with all their variants, each with every seed that any other
    run has in that setting, and what the choice wants there.
    """
    grid = [run for run in runs if run.stage == "finetune" and run.labels["task"]]
    rows = []
    for place, here in groups(grid, lambda run: run.of(SETTING)).items():
        there = {run.of((*CONDITION, "seed")): run for run in sorted(here, key=attrgetter("evaluated"))}
        seeds = sorted({run.labels["seed"] for run in here})
        for method, mine in groups(grid, lambda run: run.of(("algorithm", "method"))).items():
            for variant in _expected(mine, place):
                # A seed on the encoder of its own is one of the method, not of the variant that shares it.
                own = {seed for seed in seeds if f"{ENCODER_SEED} {seed}" in variant.split(", ")}
                for seed in (seed for seed in seeds if seed not in own):
                    run = there.get((*place, *method, variant, seed))
                    if run is None or not run.evaluated:
                        state = MISSING if run is None or run.finished else run.progress
                        values = (*place, *method, variant)
                        rows.append(dict(zip(CONDITION, values, strict=True)) | {"seed": seed, "state": state})
    rows = [row for row in rows if choice.asks(row)]
    known = {without_options(row, LABELS) for row in (*(run.labels for run in grid), *rows)}
    settings = {without_options(run.labels, SETTING): run.labels["corruption"] for run in grid}
    for row in choice.wanted:  # what was never begun, in settings of any run
        if without_options(row, LABELS) not in known and without_options(row, SETTING) in settings:
            named = {name: row.get(name, "") for name in CONDITION}
            named["corruption"] = settings[without_options(row, SETTING)]
            rows.append(named | {"seed": row["seed"], "state": MISSING})
    return rows


def _expected(mine: list[Run], setting: tuple[str, ...]) -> Iterator[str]:
    """Variants of a method that are expected in a setting: those of all settings that share a variant with it.

    Where each setting has variants of its own, such as a budget for every task, nothing is missing; nor is `state`
    where other pixels of the same set are hidden. Those by data are expected where they are found.
    """
    by_setting = groups(mine, lambda run: run.of(SETTING))
    here = by_setting.get(setting, [])
    if not here and mine[0].method == STATE and any(there[:2] == setting[:2] for there in by_setting):
        return
    own = {run.parts[0] for run in here}
    shared = [there for there in by_setting.values() if not own or own & {run.parts[0] for run in there}]
    for variant in dict.fromkeys(run.parts[0] for there in shared for run in there):
        for data in dict.fromkeys(run.parts[1] for run in here if run.parts[0] == variant) or [""]:
            yield ", ".join(filter(None, (variant, data)))


def gaps_in_words(gaps: Iterable[Row]) -> str:
    """Gaps of one condition: "seeds 1, 2 missing; seed 3 unfinished at 20 of 40 updates"."""
    by_state = groups(sorted(gaps, key=lambda row: row["state"]), lambda row: str(row["state"]))
    told = {state: [str(row["seed"]) for row in members] for state, members in by_state.items()}
    return "; ".join(f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)} {state}" for state, seeds in told.items())
