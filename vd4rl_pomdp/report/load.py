"""Loads runs for reports: one record per run, from which the frames of runs and of evaluations are built.

Variants of a method are named by the settings that differ among its runs, e.g. "max_k 1" in "acro, max_k 1". Runs are
seeds of one experiment only if they agree in everything except seed, folders, device and logging. A fine-tuning run's
settings include those of its encoder, and the data of both stages.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import LATER, settings_of
from vd4rl_pomdp.core.reading import damaged
from vd4rl_pomdp.corruptions import corruption_settings
from vd4rl_pomdp.data.reference import Reference, summarise
from vd4rl_pomdp.runs import REFERENCE_FILE
from vd4rl_pomdp.runs.critic import CONVERGED
from vd4rl_pomdp.runs.episodes import COLUMNS
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.results import DAMAGED, Result, find_results

SETTING = ("task", "quality", "corruption")  # columns of the setting in which methods are compared
CONDITION = (*SETTING, "algorithm", "method", "variant")
"""Columns shared by all seeds of an experiment, which identify it."""
IDENTITY = (*CONDITION, "seed")
"""Columns that identify a run within a report: the labels in its files, and its variant."""
PROBES = ("probe_pose", "probe_velocity")  # errors of an encoder's linear probes
CRITIC = {"critic_value": "value", "critic_moved": "moved", "data_value": "data"}
"""Convergence of a run's critic (see `critic_of`): column -> key in critic.json."""
COSTS = ("pretrain_seconds", "finetune_seconds")
ACTION_ERRORS = ("path_error", "action_error")
"""Errors of a policy's actions on the data's rows and in closed loop."""
CONTROL = {"return": "return_mean", "share_above_80": "share_above_80", "action_error": "action_error"}
"""Columns about the last evaluation, repeated with the prefix `clean_` for no corruption -> key in `summarise`."""
MISSING = "missing"
STATE = "state"  # the privileged method, which sees the simulator state whatever the setting hides
END_TO_END = ("bc", "drq_bc")  # baselines that are trained end to end by their own algorithm
TRAINED_ON_STATES = ("integrator", "supervised_picture", "supervised", "supervised+a")
"""Methods whose encoders are trained on simulator states, including those of the probes' held-out episodes."""
REFERENCES = ("random", "bc", "drq_bc", *TRAINED_ON_STATES, STATE)
"""Reference methods (lower and upper bounds), last in a table."""

Settings = dict[str, str]  # values as text, by displayed name
_UNSET = "unset"
PRESETS = ("preset", "pretraining preset")
DATA = ("data", "pretraining data")  # names of the datasets' fingerprints
OF_CORRUPTION = "corruption "
"""Prefix for the settings of a corruption, since other plug-ins may have options of the same name."""
ENCODER_SEED = "pretraining seed"
"""Seed of a run's encoder if it differs from the run's own: such runs share an encoder across seeds."""


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
"""Values that do not appear in a method's name; runs with other values are variants."""


class Choice:
    """Which runs a report covers: all of them, unless a subclass narrows it."""

    def among(self, results: list[Result]) -> list[Result]:
        return results

    wanted: Sequence[Row] = ()
    """The policies that are reported as missing if they do not exist, where known: LABELS, the `variant` by which to
    name one if none of its seeds was run, and the hash of its `experiment`."""


ALL = Choice()


def unusual(settings: Mapping[str, Any]) -> str:
    """The settings that are part of a method's name, unless they have their usual values: "history gru"."""
    words = {name: _words(settings[name]) for name in PLAIN if name in settings}
    return ", ".join(f"{name} {value}" for name, value in words.items() if value != PLAIN[name])


@dataclass(frozen=True)
class Run:
    """A run of any stage, finished or not."""

    result: Result  # its files
    labels: Row
    """Values of `options.LABELS`; the task is empty until the run has opened its data. If other runs use other options
    of the same corruption, the options are appended ("patch, patch_size 48"), as that is a different setting."""
    settings: Settings  # all settings, as text, in which runs of its method may differ
    reference: Reference  # what its policy is compared with: data and behaviour policy
    measures: dict[str, float | None]
    """Encoder, critic and cost measures: action_loss, PROBES, CRITIC, COSTS; None if unknown."""
    variant: str = ""
    """Settings that distinguish it from other runs of its method: "max_k 1"; empty if none do."""

    @property
    def record(self) -> Row:
        return self.result.record

    @property
    def stage(self) -> str:
        return self.record["stage"]

    @property
    def method(self) -> str:
        return self.labels["method"]

    @property
    def set_name(self) -> str:
        return f"{self.labels['task']} {self.labels['quality']}"

    @cached_property
    def named(self) -> Row:
        return {name: self.variant if name == "variant" else self.labels[name] for name in IDENTITY}

    def of(self, names: Iterable[str]) -> tuple[Any, ...]:
        return tuple(self.named[name] for name in names)

    @property
    def end_to_end(self) -> bool:
        return bool(self.result.encoder.get("end_to_end")) or self.method in END_TO_END

    @cached_property
    def played(self) -> list[Row]:
        """All evaluation rows by number of their episode, as differences pair episodes whatever a file's order."""
        return sorted(self.result.rows, key=itemgetter("episode"))

    @cached_property
    def rows(self) -> list[Row]:
        """Evaluation rows under the training corruption."""
        return [row for row in self.played if row["evaluated_under"] == row["corruption"]]

    @cached_property
    def last(self) -> list[Row]:
        """Rows of its last evaluation, under the training corruption."""
        end = max((row["step"] for row in self.rows), default=None)
        return [row for row in self.rows if row["step"] == end]

    @cached_property
    def last_clean(self) -> list[Row]:
        """Rows of its last evaluation under no corruption, whatever it was trained under; empty if there was none."""
        ends = {row["step"] for row in self.last}
        return [row for row in self.played if row["step"] in ends and row["evaluated_under"] == "none"]

    @property
    def finished(self) -> bool:
        return self.result.finished and self.result.diverged is None

    @property
    def evaluated(self) -> bool:
        """Whether it has finished and was evaluated, so that it can be compared."""
        return self.finished and bool(self.rows)

    @property
    def converged(self) -> bool | None:
        """Whether its critic converged, by `CONVERGED`; True for an algorithm without critic, None if not recorded."""
        critic = self.result.files.get("critic", {} if self.labels["algorithm"] == "bc" else None)
        if critic == {} and "gamma" not in self.record["config"]:  # algorithms with a discount have a critic
            return True
        moved = self.measures["critic_moved"]
        return None if moved is None else abs(moved) < CONVERGED

    @property
    def progress(self) -> str:
        """How far it got: "finished", "diverged at update 20 of 40" or "unfinished at 20 of 40 updates"."""
        if self.finished:
            return "finished"
        unit = "updates" if self.stage == "finetune" else "steps"
        last = self.record["config"].get(unit, "?")
        if self.result.diverged is not None:
            return f"diverged at {unit[:-1]} {self.result.diverged.get('step', self.result.step)} of {last}"
        return f"unfinished at {self.result.step} of {last} {unit}"


def label(row: Mapping[str, Any]) -> str:
    """A method's name in tables and figures, with the algorithm unless it is TD3+BC, and the variant."""
    algorithm = "" if row["method"] in END_TO_END or row["algorithm"] == "td3_bc" else row["algorithm"]
    return ", ".join(filter(None, (row["method"], algorithm, row["variant"])))


def setting(row: Mapping[str, Any]) -> str:
    """Task, quality and corruption in words."""
    return f"{row['task']} {row['quality']}, {row['corruption']}"


def title(run: Run) -> str:
    """A run's stage, method and setting, without the seed."""
    return f"{run.stage} {label(run.named)}, {setting(run.labels)}"


def labels(table: pd.DataFrame) -> pd.Series:
    """`label` of every row."""
    return pd.Series([label(row) for row in table.to_dict("records")], table.index, dtype=object)


def load_runs(paths: Sequence[Path | str], but: Path | None = None, choice: Choice = ALL) -> list[Run]:
    """The chosen runs at or below some run folders and results folders; `but` as in `find_results`.

    UserError if there is no run, two have the same identity, or a file of one is damaged.
    """
    runs = _distinguished([_load(result) for result in choice.among(find_results(paths, but))])
    seen: dict[tuple[Any, ...], Run] = {}
    for run in runs:
        if run.rows and (other := seen.setdefault(run.of(IDENTITY), run)) is not run:
            raise UserError(
                f"{run.result.place} and {other.result.place}: two runs with the same method, setting and seed; report "
                "one of them"
            )
    return runs


def _load(result: Result) -> Run:
    """Build a run from its files; UserError for files that are valid JSON but not what a run writes."""
    with damaged(result.place, *DAMAGED):
        probe, stored = result.files.get("probe", {}), result.files.get("reference")
        critic = result.files.get("critic", {})
        measures = {"action_loss": result.encoder.get("action_loss")} | {name: probe.get(name) for name in PROBES}
        measures |= {name: critic.get(key) for name, key in CRITIC.items()}
        measures["pretrain_seconds"] = result.files.get("pretrain_timing", {}).get("seconds")
        measures["finetune_seconds"] = result.files["timing"]["seconds"] if result.finished else None
        if wrong := [value for value in measures.values() if value is not None and not isinstance(value, int | float)]:
            raise TypeError(f"{wrong[0]!r} is not a number")
        reference = Reference() if stored is None else Reference.parse(result.path / REFERENCE_FILE, stored)
        return Run(result, result.labels, read_settings(result.record, result.card), reference, measures)


def _distinguished(runs: list[Run]) -> list[Run]:
    """Set each run's `variant`, and append to its corruption the options that differ among runs of that corruption."""
    sets, names = [run.set_name for run in runs], [run.labels["corruption"] for run in runs]
    stages = [(run.stage, run.labels["algorithm"]) for run in runs]
    methods = [(*stage, run.method) for stage, run in zip(stages, runs, strict=True)]
    # Corruption options are compared across all methods: equal corruptions must get equal names everywhere.
    hiding = without_sets([of_corruption(run.settings) for run in runs], sets, [""] * len(runs))
    own = without_sets([without(run.settings, of_corruption(run.settings)) for run in runs], sets, stages)
    options = [{name.removeprefix(OF_CORRUPTION): value for name, value in one.items()} for one in hiding]
    described = zip(names, differences(options, names), strict=True)
    corruptions = [name if name == "none" else ", ".join(filter(None, (name, what))) for name, what in described]
    of_methods = differences([without(one, DATA) for one in own], methods)
    # Different datasets always differ in fingerprint; only different contents of the same dataset matter.
    data = [{name: one[name] for name in DATA if name in one} for one in own]
    places = list(zip(methods, sets, corruptions, strict=True))
    for alike in (places, list(zip(places, of_methods, strict=True))):
        for mine in groups(range(len(runs)), alike.__getitem__).values():
            if a_set_a_seed([runs[i] for i in mine]):
                for i in mine:
                    data[i][DATA[0]] = "one a seed"
    of_data = differences(data, places)
    return [
        replace(run, labels=run.labels | {"corruption": corruption}, variant=", ".join(filter(None, parts)))
        for run, corruption, *parts in zip(runs, corruptions, of_methods, of_data, strict=True)
    ]


def read_settings(record: Mapping[str, Any], card: Mapping[str, Any]) -> Settings:
    """All settings of a run as text, with the prefix OF_CORRUPTION for those of its corruption.

    Of its config.json and its encoder's pretraining record, which a pretraining run has none of.
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
    """The settings that belong to a corruption."""
    return {name: value for name, value in settings.items() if name.startswith(OF_CORRUPTION)}


def without(settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Settings without some names."""
    return {name: value for name, value in settings.items() if name not in names}


def without_sets(settings: Sequence[Settings], sets: Sequence[str], alike: Sequence[Hashable]) -> list[Settings]:
    """Drop settings that only vary with the dataset (equal within each, not across), e.g. a budget per task.

    Of every run: its settings, its task and quality, and a key; runs of other keys are treated separately. PLAIN
    settings are part of a method's name and stay.
    """
    # A per-task budget is no ablation. As a variant it would split a method in two.
    kept = [dict(one) for one in settings]
    for places in groups(range(len(settings)), alike.__getitem__).values():
        table = pd.DataFrame([settings[i] for i in places]).drop(columns=[ENCODER_SEED, *DATA], errors="ignore")
        by_set = table.groupby([sets[i] for i in places]).nunique()
        dropped = [
            name for name in table if by_set[name].max() == 1 and table[name].nunique() > 1 and name not in PLAIN
        ]
        for i in places:
            kept[i] = without(kept[i], dropped)
    return kept


def differences(settings: Sequence[Settings], alike: Sequence[Hashable]) -> list[str]:
    """Per run, in words, the settings that differ within its group `alike`: "max_k 1, steps 20"; "" if none are known.

    Values in PLAIN are omitted. ENCODER_SEED is always shown, since nothing else reveals that seeds share an encoder.
    A preset replaces the settings that it determines.
    """
    words = [""] * len(settings)
    for places in groups((i for i, own in enumerate(settings) if own), alike.__getitem__).values():
        table = pd.DataFrame([settings[i] for i in places], places)
        shared = table.pop(ENCODER_SEED).dropna() if ENCODER_SEED in table else pd.Series()
        table = table.fillna({name: PLAIN[name] for name in LATER}).fillna(_UNSET)
        table = table.loc[:, table.nunique() > 1]
        # Options of a plug-in exist only with it, so naming the plug-in suffices.
        everywhere = [name for name in table if (table[name] != _UNSET).all()]
        table = table.drop(columns=[name for name in table if _decided(table, name, everywhere)])
        presets: list[str] = []
        for name in PRESETS:
            if name in table and not _decided(table, name, presets):
                presets.append(name)
        table = table.drop(columns=[name for name in table if _decided(table, name, presets)])
        for i, row in table.iterrows():
            own = dict(row) | ({ENCODER_SEED: shared[i]} if i in shared else {})
            words[i] = ", ".join(f"{name} {value}" for name, value in own.items() if value != PLAIN.get(name))
    return words


def _decided(table: pd.DataFrame, name: str, by: list[str]) -> bool:
    """Whether a setting is a function of others: equal wherever all of them are equal."""
    return bool(by) and name not in by and table.groupby(by)[name].nunique().max() == 1


def a_set_a_seed(runs: Sequence[Run]) -> bool:
    """Whether several training seeds each have their own dataset, alike except for the collection seed.

    Then datasets vary like seeds, and these runs count as seeds of one method. If one training seed has two contents,
    or one collection seed has, they are different experiments.
    """
    plans = [run.record.get("collection") or {} for run in runs]
    contents = [run.record.get("inputs", {}).get("data") for run in runs]
    seeds = [run.labels["seed"] for run in runs]
    found = set(zip(seeds, contents, [plan.get("seed") for plan in plans], strict=True))
    if not all(plans) or len(found) < 2 or any(len(set(column)) < len(found) for column in zip(*found, strict=True)):
        return False
    drawn = [(plan.get("rendered_by") or {}).get("canary") for plan in plans]
    compared = [without(plan, ("seed", "rendered_by")) | {"drawn": one} for plan, one in zip(plans, drawn, strict=True)]
    return all(one == compared[0] for one in compared)


def episodes_frame(runs: Iterable[Run]) -> pd.DataFrame:
    """One row per evaluation episode: `id` and IDENTITY of its run, and the columns of `episodes.csv`.

    `as_trained` marks episodes under the training corruption.
    """
    rows = []
    for run in runs:
        own = run.named | {"id": run.result.id}
        rows += [row | own | {"as_trained": row["evaluated_under"] == row["corruption"]} for row in run.played]
    columns = ["id", *IDENTITY, *(name for name in COLUMNS if name not in IDENTITY), "as_trained"]
    return pd.DataFrame(rows, columns=columns).astype({"as_trained": bool})


def runs_frame(runs: Iterable[Run]) -> pd.DataFrame:
    """One row per finished and evaluated run: encoder, scores, control, costs and provenance; None if unknown."""
    rows = []
    for run in (run for run in runs if run.evaluated):
        by_step = groups(run.rows, lambda row: int(row["step"]))
        scores = {step: np.mean([row["score"] for row in episodes]) for step, episodes in by_step.items()}
        best = max(scores, key=scores.__getitem__)
        row: Row = {"id": run.result.id, "state": run.progress, "machine": run.result.machine}
        row |= {"git_commit": run.result.commit, "data_return": run.reference.data_return, "converged": run.converged}
        row |= {"score": scores[max(scores)], "best_score": scores[best], "best_step": best}
        row |= run.named | run.measures | {"path_error": run.reference.path_error}
        for prefix, episodes in (("", run.last), ("clean_", run.last_clean)):
            summed = summarise(episodes, run.reference) if episodes else {}
            row |= {prefix + name: summed.get(key) for name, key in CONTROL.items()}
        rows.append(row)
    numbers = ["action_loss", *PROBES, *ACTION_ERRORS, "score", "return", "best_score", "best_step", "data_return"]
    numbers += ["share_above_80", *(f"clean_{name}" for name in CONTROL), *CRITIC]
    columns = [*IDENTITY, "id", *numbers, "converged", *COSTS, "git_commit", "machine", "state"]
    return pd.DataFrame(rows, columns=columns).astype(dict.fromkeys((*numbers, *COSTS), float))


def find_gaps(runs: list[Run], choice: Choice = ALL) -> list[Row]:
    """One row per missing or unfinished run: CONDITION, seed and `state`.

    In the settings of the report, the policies that the choice wants. If it names none: every condition of a setting,
    for every seed that any run has there.
    """
    policies = sorted(
        (run for run in runs if run.stage == "finetune" and run.labels["task"]), key=attrgetter("evaluated")
    )
    return _wanted(policies, choice.wanted) if choice.wanted else _unpaired(policies)


def _wanted(policies: list[Run], wanted: Iterable[Row]) -> list[Row]:
    settings = {_without_options(run.labels): run.of(SETTING) for run in policies}
    made = {(_without_options(run.labels), run.result.experiment, run.labels["seed"]): run for run in policies}
    others = {(place, experiment): run for (place, experiment, _), run in made.items()}
    rows = []
    for row in wanted:
        place, experiment = _without_options(row), row["experiment"]
        run = made.get((place, experiment, row["seed"]))
        if place in settings and not (run and run.evaluated):
            other = others.get((place, experiment))  # another seed of it
            named = other.named if other else row | dict(zip(SETTING, settings[place], strict=True))
            rows.append({name: named[name] for name in CONDITION} | {"seed": row["seed"], "state": _state(run)})
    return rows


def _without_options(row: Row) -> tuple[Any, ...]:
    """The setting of a run or gap, with the corruption's options cut off ("patch, patch_size 48" -> "patch")."""
    return tuple(row[name].partition(",")[0] if name == "corruption" else row[name] for name in SETTING)


def _state(run: Run | None) -> str:
    """Why a run has no results: "missing"."""
    if run is None:
        return MISSING
    return "not evaluated" if run.finished else run.progress


def _unpaired(policies: list[Run]) -> list[Row]:
    rows = []
    for here in groups(policies, lambda run: run.of(SETTING)).values():
        seeds = sorted({run.labels["seed"] for run in here})
        for condition, mine in groups(here, lambda run: run.of(CONDITION)).items():
            named = dict(zip(CONDITION, condition, strict=True))
            runs = {run.labels["seed"]: run for run in mine}
            for seed in seeds:
                run = runs.get(seed)
                # A variant with a shared encoder needs no run for the seed that trained the encoder.
                shared = f"{ENCODER_SEED} {seed}" in named["variant"].split(", ")
                if not shared and not (run and run.evaluated):
                    rows.append(named | {"seed": seed, "state": _state(run)})
    return rows


def gaps_in_words(gaps: Iterable[Row]) -> str:
    """Gaps of one condition: "seeds 1, 2 missing; seed 3 unfinished at 20 of 40 updates"."""
    by_state = groups(sorted(gaps, key=lambda row: row["state"]), lambda row: str(row["state"]))
    seeds_by_state = {state: [str(row["seed"]) for row in members] for state, members in by_state.items()}
    return "; ".join(
        f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)} {state}" for state, seeds in seeds_by_state.items()
    )
