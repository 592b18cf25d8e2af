"""Runs as a report looks at them: what their files tell, and in what they differ from one another."""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report.grouping import groups
from vd4rl_pomdp.report.variants import (
    DATA,
    OF_CORRUPTION,
    Parts,
    Settings,
    differences,
    of_corruption,
    of_sets,
    read_settings,
    without,
)
from vd4rl_pomdp.runs import FILM_FILE, REFERENCE_FILE
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.runs.results import Result, find_results, whole_files

SETTING = ("task", "quality", "corruption")
"""Columns of what methods are compared in."""
CONDITION = (*SETTING, "algorithm", "method", "variant")
"""What all seeds of an experiment share: the columns that tell it from others."""
IDENTITY = (*CONDITION, "seed")
"""Columns that tell a run's rows from all others of a report: what its files name it by, and its variant."""
PROBES = ("probe_pose", "probe_velocity")
"""Errors of linear probes of an encoder."""
END_TO_END = ("bc", "drq_bc")
"""References that bring their own algorithm."""
FILM = {"clean": 4, "corrupted": 4, "return": 1}
"""Arrays of a film and their axes."""


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


def without_options(row: Row, names: Iterable[str]) -> tuple[Any, ...]:
    """Some labels of a run or gap, without what tells a corruption's options apart."""
    return tuple(row[name].partition(",")[0] if name == "corruption" else row[name] for name in names)


@dataclass(frozen=True)
class LoadedRun:
    """A run of any stage, finished or not."""

    result: Result
    """Its files."""
    labels: dict[str, Any]
    """Values of `settings.LABELS`; the task is empty until the run has opened its data. The corruption is followed
    by its options where other runs have others of the same name, "patch, patch_size 48": that is another setting."""
    settings: Settings
    """All settings in which runs of its method may differ, in words."""
    rows: list[Row]
    """Evaluation rows under the corruption of training."""
    others: list[Row]
    """Evaluation rows under other corruptions: under none, if it was trained under one."""
    seconds: float | None
    """Wall-clock time; None while the run is unfinished."""
    representation: dict[str, float | None]
    """Measures of its encoder: action_loss, PROBES, pretrain_seconds."""
    reference: Reference
    """What its policy is held against."""
    of_set: Settings = field(default_factory=dict)
    """Its settings that go by the set, such as a budget; they make no variants."""
    parts: Parts = ("", "")
    """Its settings that differ from those of other runs of its method, by the runs it is compared with."""

    @property
    def path(self) -> Path:
        """Its folder, or the results folder that tells of it."""
        return self.result.path

    @property
    def record(self) -> dict[str, Any]:
        """config.json: stage, config, versions, git_commit, command, inputs."""
        return self.result.record

    @property
    def stage(self) -> str:
        """What it does: "pretrain", "finetune" or "navigation"."""
        return self.result.record["stage"]

    @property
    def set_name(self) -> str:
        """Task and quality."""
        return f"{self.labels['task']} {self.labels['quality']}"

    @property
    def variant(self) -> str:
        """Its settings that differ from those of other runs of its method: "max_k 1"; empty if none does."""
        return ", ".join(filter(None, self.parts))

    @property
    def named(self) -> dict[str, Any]:
        """Its labels and its variant."""
        return self.labels | {"variant": self.variant}

    @property
    def identity(self) -> tuple[str, ...]:
        """Values of IDENTITY."""
        return tuple(str(self.named[name]) for name in IDENTITY)

    @property
    def end_to_end(self) -> bool:
        """Whether its encoder was trained with the policy; what early versions did not record, the method tells."""
        return bool(self.result.encoder.get("end_to_end")) or self.labels["method"] in END_TO_END

    @property
    def last(self) -> list[Row]:
        """Rows of its last evaluation, under the corruption of training."""
        return self._at_end(self.rows)

    @property
    def last_clean(self) -> list[Row]:
        """Rows of its last evaluation under no corruption, whatever it was trained under; empty if there was none."""
        return [row for row in self._at_end([*self.rows, *self.others]) if row["evaluated_under"] == "none"]

    def _at_end(self, rows: list[Row]) -> list[Row]:
        end = max((row["step"] for row in self.rows), default=None)
        return [row for row in rows if row["step"] == end]

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end, as one that diverged has not."""
        return self.result.finished and self.result.diverged is None

    @property
    def evaluated(self) -> bool:
        """Whether it has come to its end, and its policy was evaluated: what is compared."""
        return self.finished and bool(self.rows)

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

    def film(self) -> dict[str, np.ndarray]:
        """Pictures of an evaluation episode, for a run that kept them; raises UserError for a damaged file."""
        path = self.path / FILM_FILE
        try:
            with np.load(io.BytesIO(read_bytes(path))) as file:
                film = dict(file)
            if [film[name].ndim for name in FILM] != list(FILM.values()):
                raise ValueError("its arrays have other shapes")
            return film
        except UserError:
            raise
        except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
            raise UserError(f"{path}: cannot be read ({error}); remove it, and the report goes without") from error


def load_runs(paths: Sequence[Path | str], but: Path | None = None, choice: Choice = ALL) -> list[LoadedRun]:
    """The chosen runs at or below the paths, of run folders and results folders; `but` as in `find_results`.

    Raises:
        UserError: there is no run, two have the same identity, or a file of one is damaged.
    """
    read = [_load(result) for result in choice.among(find_results(paths, but))]
    loaded = [replace(run, of_set=own) for run, own in zip(read, _of_sets(read), strict=True)]
    told = zip(loaded, _corruptions(loaded), strict=True)
    runs = [replace(run, labels=run.labels | {"corruption": words}) for run, words in told]
    named = [replace(run, parts=parts) for run, parts in zip(runs, compare(runs), strict=True)]
    _refuse_twins(named)
    return named


def _corruptions(runs: list[LoadedRun]) -> list[str]:
    """What hides pixels from each run, in words; an option that early runs do not record is not told apart."""
    options = sorted({name for run in runs for name in of_corruption(run.settings)})
    settings = [{name.removeprefix(OF_CORRUPTION): own.get(name, "") for name in options} for own in _settings(runs)]
    words = _differences(runs, settings, lambda run: run.labels["corruption"])
    names = [str(run.labels["corruption"]) for run in runs]
    return [
        name if name == "none" else ", ".join(filter(None, (name, told)))
        for name, told in zip(names, words, strict=True)
    ]


def compare(runs: list[LoadedRun], brief: bool = True) -> list[Parts]:
    """The settings in which each run differs from others of its stage, method and algorithm."""
    settings = _settings(runs)
    methods = [without(own, {*of_corruption(own), *DATA}) for own in settings]
    data = [{name: own[name] for name in DATA if name in own} for own in settings]
    of_methods = _differences(runs, methods, _method, brief)
    of_data = _differences(runs, data, lambda run: (*_method(run), run.set_name, run.labels["corruption"]))
    return list(zip(of_methods, of_data, strict=True))


def _differences(
    runs: list[LoadedRun], settings: list[Settings], alike: Callable[[LoadedRun], Any], brief: bool = True
) -> list[str]:
    """What differs of some settings among the runs that are alike, run by run."""
    words = [""] * len(runs)
    for members in groups(range(len(runs)), lambda number: alike(runs[number])).values():
        for number, told in zip(members, differences([settings[i] for i in members], brief), strict=True):
            words[number] = told
    return words


def _settings(runs: list[LoadedRun]) -> list[Settings]:
    """The runs' settings, without what goes by the set."""
    return [without(run.settings, run.of_set) for run in runs]


def _of_sets(runs: list[LoadedRun]) -> list[Settings]:
    """Each run's settings that go by its set.

    A corruption's options do if they do in all runs, since it has one name whatever learns under it; other settings if
    they do in all runs of one stage and algorithm.
    """
    options = _by_set(runs, [of_corruption(run.settings) for run in runs])
    others = {
        _kind(members[0]): _by_set(members, [without(run.settings, of_corruption(run.settings)) for run in members])
        for members in groups(runs, _kind).values()
    }
    found = (options[run.set_name] | others[_kind(run)][run.set_name] for run in runs)
    return [dict(sorted(own.items())) for own in found]


def _by_set(runs: list[LoadedRun], settings: list[Settings]) -> dict[str, Settings]:
    return of_sets(settings, [run.set_name for run in runs])


def _kind(run: LoadedRun) -> tuple[str, str]:
    return run.stage, str(run.labels["algorithm"])


def _method(run: LoadedRun) -> tuple[str, str, str]:
    return *_kind(run), str(run.labels["method"])


def _load(result: Result) -> LoadedRun:
    """A run of its files; raises UserError for files that are valid JSON, but not what a run writes."""
    with whole_files(result.place):
        return LoadedRun(
            result=result,
            labels=result.labels,
            settings=read_settings(result.record, result.card),
            rows=[row for row in result.rows if row["evaluated_under"] == row["corruption"]],
            others=[row for row in result.rows if row["evaluated_under"] != row["corruption"]],
            seconds=_number(result.files["timing"]["seconds"]) if result.finished else None,
            representation=_representation(result),
            reference=_reference(result),
        )


def _reference(result: Result) -> Reference:
    stored = result.files.get("reference")
    return Reference() if stored is None else Reference.parse(result.path / REFERENCE_FILE, stored)


def _representation(result: Result) -> dict[str, float | None]:
    probe, timing = (result.files.get(name, {}) for name in ("probe", "pretrain_timing"))
    return {
        "action_loss": _number(result.encoder.get("action_loss")),
        **{name: _number(probe.get(name)) for name in PROBES},
        "pretrain_seconds": _number(timing.get("seconds")),
    }


def _number(value: Any) -> float | None:
    if value is not None and not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return value


def _refuse_twins(runs: list[LoadedRun]) -> None:
    """Raise UserError for two evaluated runs with the same identity."""
    seen: dict[tuple[str, ...], Path] = {}
    for run in runs:
        if not run.rows:
            continue
        if run.identity in seen:
            raise UserError(
                f"{run.path} and {seen[run.identity]}: two runs of one method, setting and seed; report one of them"
            )
        seen[run.identity] = run.path
