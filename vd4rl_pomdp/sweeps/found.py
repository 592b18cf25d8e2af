"""Runs that are there already, by what they compute: below a sweep's folder, and in rows that were kept."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.nn.encoder_folder import CONFIG
from vd4rl_pomdp.runs import CONFIG_FILE, TIMING_FILE
from vd4rl_pomdp.runs.files import Row, files_below, read_json
from vd4rl_pomdp.runs.identity import recipe
from vd4rl_pomdp.runs.results import Result, read_results
from vd4rl_pomdp.sweeps.sets import DataSet


@dataclass(frozen=True)
class FoundRun:
    """A run, as far as a sweep looks into it."""

    folder: Path
    record: Row
    """Its config.json."""
    card: Row
    """What its encoder says of its pretraining, empty where it has none."""
    seconds: float | None
    """Wall-clock time; None while it is unfinished."""
    encoder_seconds: float | None = None
    """Wall-clock time of its encoder's pretraining, as far as a fine-tuning tells."""

    @property
    def recipe(self) -> str:
        """What it computes, but for its data's content."""
        return recipe(self.record, self.card if self.record["stage"] == "finetune" else {})

    @property
    def data(self) -> str:
        """Fingerprint of its set, empty where it tells none."""
        return self.record.get("inputs", {}).get("data", "")

    @property
    def on_one_set(self) -> bool:
        """Whether its encoder, if it was given one, was pretrained on its own data, as a grid's are."""
        return self.card.get("data") in (None, self.data)

    @property
    def settings(self) -> dict[str, Any]:
        """Its settings and its encoder's, without the seed: what its cost depends on, beside the machine."""
        return self.card.get("settings", {}) | settings_of(self.record["config"])


class FoundRuns:
    """Runs by what they compute."""

    def __init__(self, runs: Iterable[FoundRun]) -> None:
        self.runs = list(runs)
        self._by_recipe: dict[str, list[FoundRun]] = {}
        for run in self.runs:
            self._by_recipe.setdefault(run.recipe, []).append(run)
        self._folders = {run.folder for run in self.runs}
        self._images: dict[str, str] = {}
        """Content of the folders of images that were looked at."""

    def of(self, name: str, data: DataSet) -> FoundRun | None:
        """The run of a recipe on a set, a finished one if there is one; images that it adds are those of now."""
        fitting = [
            run
            for run in self._by_recipe.get(name, ())
            if run.on_one_set and data.made(run.record) and self._adds_the_same(run.record)
        ]
        return max(fitting, key=lambda run: run.seconds is not None, default=None)

    def _adds_the_same(self, record: Row) -> bool:
        """Whether the images that a run in a maze added, if it did, are still in their folder."""
        from vd4rl_pomdp.studies.navigation.pictures import source_fingerprint

        told, source = record.get("inputs", {}).get("exogenous"), record["config"].get("exogenous")
        if told is not None and source not in self._images:
            self._images[source] = source_fingerprint(source)
        return told in (None, self._images.get(source))

    def alike(self, name: str, data: DataSet) -> bool:
        """Whether there is a run of a recipe on a set that was collected as this one is."""
        return any(data.alike(run.record) for run in self._by_recipe.get(name, ()))

    def __contains__(self, folder: Path) -> bool:
        return folder in self._folders


def runs_kept(folders: Iterable[Path]) -> list[FoundRun]:
    """Every run of some results folders; UserError for a folder that is none."""
    return found_in([run for folder in folders for run in read_results(folder)])


def found_in(results: Iterable[Result]) -> list[FoundRun]:
    """Some runs, in their order.

    Early ones do not record how their set was collected: as another run on the same content says.
    """
    runs = [_kept(run) for run in results]
    told = {run.data: run.record["collection"] for run in runs if run.data and run.record.get("collection")}
    return [
        replace(run, record=run.record | {"collection": run.record.get("collection") or told.get(run.data)})
        for run in runs
    ]


def _kept(run: Result) -> FoundRun:
    seconds = (run.files.get(name, {}).get("seconds") for name in ("timing", "pretrain_timing"))
    return FoundRun(run.path, run.record, _whole(run.card), *seconds)


def runs_below(out: Path) -> Iterator[FoundRun]:
    """Every run below a folder; UserError for a damaged record."""
    for path in files_below(out, CONFIG_FILE):
        record = read_json(path)
        if "stage" in record and isinstance(record.get("config"), dict) and "seed" in record["config"]:
            yield _found(path.parent, record)


def run_at(folder: Path) -> FoundRun:
    """The run of a folder that holds one; UserError for a damaged record."""
    return _found(folder, read_json(folder / CONFIG_FILE))


def _found(folder: Path, record: Row) -> FoundRun:
    timing, encoder = folder / TIMING_FILE, folder / "encoder" / CONFIG
    seconds = read_json(timing).get("seconds") if timing.exists() else None
    card = read_json(encoder).get("pretrain") if encoder.exists() else None
    return FoundRun(folder, record, _whole(card), seconds)


def _whole(card: Any) -> Row:
    """What an encoder says of its pretraining, nothing if it is of an early version, which no plan asks for."""
    return card if isinstance(card, dict) and {"settings", "seed"} <= card.keys() else {}
