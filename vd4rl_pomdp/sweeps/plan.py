"""From a grid's cells to jobs: one for every set, encoder and policy, whoever shares it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import chain, count, pairwise
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import words_of
from vd4rl_pomdp.core.registry import of_other_code
from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.data.folder import PLAN, PROVENANCE, read_plan
from vd4rl_pomdp.data.shards import differing
from vd4rl_pomdp.nn.encoder_folder import CONFIG, encoder_hash
from vd4rl_pomdp.runs import CONFIG_FILE, TIMING_FILE
from vd4rl_pomdp.sweeps.found import FoundRun, FoundRuns, run_at
from vd4rl_pomdp.sweeps.grid import GridCell
from vd4rl_pomdp.sweeps.naming import run_folder
from vd4rl_pomdp.sweeps.sets import DataSet, content_of, set_of
from vd4rl_pomdp.sweeps.stages import COMMANDS, STAGES, recipe_of, recorded, told

DATA = "data"
"""Folder of the sets in a sweep's, unless another is named."""


@dataclass(frozen=True)
class Job:
    """One command of a sweep."""

    name: str
    """What it makes: a folder below the sweep's, or data/ and a set's name."""
    section: str
    """Which stage it is."""
    folder: Path
    words: tuple[str, ...]
    """Its command line, after `vd4rl-pomdp`."""
    needs: tuple[str, ...] = ()
    """Names of the jobs that come before it."""
    done: bool = False
    """Whether nothing is to do, although its folder does not tell: a kept row, or a set that was not collected here."""
    settings: tuple[tuple[str, str], ...] = ()
    """Settings that its cost depends on."""
    recipe: str = ""
    """What a training computes; empty for a set."""
    content: str = ""
    """Fingerprint of the set of the run that was found in its folder; empty where none was."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do now.

        A run of another recipe, or on another set, that came into the folder does not count.
        """
        if self.done or self.section not in STAGES:
            return self.done or (self.folder / PROVENANCE).is_file()
        return (self.folder / TIMING_FILE).is_file() and self._made(run_at(self.folder))

    def _made(self, run: FoundRun) -> bool:
        """Whether a run is its own; on which set that of a folder that was free must be, the command tells.

        Another driver may have called the set otherwise, or have a copy of it.
        """
        if run.recipe != self.recipe:
            return False
        if self.content:
            return run.data == self.content
        told, own = run.record["config"].get("data"), dict(pairwise(self.words))["--data"]
        return told == own or (run.data != "" and run.data == content_of(Path(own)))

    @property
    def begun(self) -> bool:
        """Whether something of it is there."""
        mark = CONFIG_FILE if self.section in STAGES else PLAN
        return (self.folder / mark).is_file()


class JobPlanner:
    """Makes the jobs of a grid, looking at what is there."""

    def __init__(self, out: Path, data: Path, kept: FoundRuns, here: FoundRuns, others: Iterable[Job] = ()) -> None:
        """Nothing is written.

        Args:
            out: the sweep's folder.
            data: folder of the sets.
            kept: runs whose rows are kept, their folders being elsewhere.
            here: runs below `out`.
            others: jobs of other grids in `out`, begun or not.
        """
        self._out, self._data, self._kept, self._here = out, data, kept, here
        self._jobs: dict[tuple[str, str, str], Job] = {}
        self._sets: dict[str, DataSet] = {}
        self._taken: set[str] = set()
        self._asked: set[str] = set()
        """Names of the jobs that are the last of a cell."""
        self._of_others = {job.name: job.recipe for job in others}
        self.of_other_content: Counter[str] = Counter()
        """Kept runs that do not count, by set: theirs was collected alike, and its content is another."""

        self.changed_since: Counter[str] = Counter()
        """Runs that count, though the file of a part of one's own has changed since, by part."""

        self.on_other_encoders = 0
        """Policies that count, though the encoder that their pretraining's folder holds now is another than theirs."""

    def plan(self, cells: Iterable[GridCell]) -> list[Job]:
        """The jobs of some cells, each after those it needs; what only finished jobs would need is left out.

        Args:
            cells: those that `check_cells` lets pass.

        Raises:
            UserError: a folder holds another set, or cells want two sets in one.
        """
        for cell in cells:
            self._add(cell)
        return self._needed()

    def _add(self, cell: GridCell) -> None:
        data = self._set(cell)
        values: dict[str, Any] = {}
        before = [self._collection(cell, data)]
        for section in cell.chain[1:]:
            values |= recorded(cell, section)
            before.append(self._training(cell, section, data, values, before))
        self._ask(before[-1], data)

    def _set(self, cell: GridCell) -> DataSet:
        found = set_of(cell, self._data)
        if found.name not in self._sets:
            found.check()
            self.changed_since.update(of_other_code(read_plan(found.folder), found.wanted))
        data = self._sets.setdefault(found.name, found)
        if others := differing(data.wanted, found.wanted):
            raise UserError(f"{found.name} is asked for with two values of {others[0]}: make it an axis or a block's")
        return data

    def _collection(self, cell: GridCell, data: DataSet) -> Job:
        words = (*COMMANDS[data.section], *words_of(told(cell, data.section)), "--out", str(data.folder))
        job = Job(
            f"{DATA}/{data.name}", data.section, data.folder, words, done=data.foreign, settings=cost_of(data.wanted)
        )
        return self._jobs.setdefault((data.section, "", data.name), job)

    def _training(self, cell: GridCell, section: str, data: DataSet, values: dict[str, Any], before: list[Job]) -> Job:
        recipe = recipe_of(cell, section)
        key = (section, recipe, data.name)
        if key in self._jobs:
            return self._jobs[key]
        run = self._here.of(recipe, data)
        if run is not None:
            self.changed_since.update(of_other_code(run.record, values))
            self.on_other_encoders += section == "finetune" and _is_on_another(run, before[-1].folder / "encoder")
            name, content = run.folder.relative_to(self._out).as_posix(), run.data
        else:
            name, content = self._free(run_folder(cell, section, data.name, values), recipe), ""
        self._taken.add(name)
        folder = self._out / name
        places = {"data": data.folder} | ({"encoder": before[-1].folder / "encoder"} if section == "finetune" else {})
        words = (*COMMANDS[section], *words_of(told(cell, section) | places | {"out": folder}))
        needs = tuple(job.name for job in before)
        costs = cost_of(values)
        self._jobs[key] = Job(name, section, folder, words, needs, settings=costs, recipe=recipe, content=content)
        return self._jobs[key]

    def _ask(self, job: Job, data: DataSet) -> None:
        """Want a job for itself, not for those that need it; a kept row is as good."""
        if job.name in self._asked:
            return
        self._asked.add(job.name)
        kept = self._kept.of(job.recipe, data)
        if kept is None and self._kept.alike(job.recipe, data):
            self.of_other_content[data.name] += 1
        if kept is not None and kept.seconds is not None:
            self.changed_since.update(of_other_code(kept.record, dict(job.settings)))
            self._jobs[job.section, job.recipe, data.name] = replace(job, done=True)

    def _needed(self) -> list[Job]:
        """The finished jobs, those that were asked for, and those that an unfinished one needs."""
        found: list[Job] = []
        needed: set[str] = set()
        for job in reversed(self._jobs.values()):
            if job.name in needed and job.section in STAGES:
                job = replace(job, done=False)  # a kept row is no encoder to train on
            if not job.finished:
                if job.name not in needed | self._asked:
                    continue
                needed |= set(job.needs)
            found.append(job)
        return found[::-1]

    def _free(self, name: str, recipe: str) -> str:
        """A name that no other run has, be it in the plan, in another grid's, or from an earlier sweep."""
        own = f"{name}~{recipe[:6]}"  # further runs of one recipe are on sets of other content
        names = chain([name, own], (f"{own}.{number}" for number in count(2)))
        return next(name for name in names if name not in self._taken and not self._of_another(name, recipe))

    def _of_another(self, name: str, recipe: str) -> bool:
        return self._out / name in self._here or self._of_others.get(name, recipe) != recipe


def _is_on_another(run: FoundRun, encoder: Path) -> bool:
    """Whether a fine-tuning began with another encoder than the one that lies in a folder, if one does."""
    return (encoder / CONFIG).is_file() and run.record.get("inputs", {}).get("encoder") != encoder_hash(encoder)


def cost_of(values: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Settings that a job's cost depends on, in order, their values as words."""
    return tuple(sorted((name, str(value)) for name, value in settings_of(values).items()))
