"""From a grid's cells to jobs: one per dataset, encoder and policy, shared between cells, and which are done already.

A run is identified by its recipe (what it computes) and the content of its dataset, not by its path or who made it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import chain, count
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import settings_of, words_of
from vd4rl_pomdp.core.registry import of_other_code
from vd4rl_pomdp.core.tasks import FRAME_SIZE, SET_QUALITIES, TASKS
from vd4rl_pomdp.corruptions import corruption_settings
from vd4rl_pomdp.data.folder import PLAN, PROVENANCE, read_plan, shard_files, shard_paths, task_and_quality
from vd4rl_pomdp.data.format import read_attributes, read_frame_size
from vd4rl_pomdp.data.shards import differing
from vd4rl_pomdp.data.store import open_store
from vd4rl_pomdp.nn.encoder_folder import CONFIG, encoder_hash
from vd4rl_pomdp.runs import CONFIG_FILE, TIMING_FILE
from vd4rl_pomdp.runs.files import content_hash, files_below, groups, read_json
from vd4rl_pomdp.runs.results import Result, read_records, read_results
from vd4rl_pomdp.studies.navigation.pictures import source_fingerprint
from vd4rl_pomdp.sweeps.grid import GridCell
from vd4rl_pomdp.sweeps.stages import COMMANDS, STAGES, collection_of, recipe_of, recorded, stage_settings

DATA = "data"  # default folder of the datasets, below the sweep's folder
_DOWNLOADED = "84px"  # subfolder that holds the shards of a downloaded dataset
_LONGEST = 160  # maximum bytes of settings in a folder's name (file systems allow 255 in all)
_IN_NAMES = {
    "collect": ("task", "quality"),
    "pretrain": ("method", "corruption"),
    "finetune": ("algorithm",),
    "navigation_collect": ("maze",),
    "navigation_train": ("method",),
}
"""Settings that have a fixed place in a folder's name."""


@dataclass(frozen=True)
class DataSet:
    """A dataset that cells of a grid need: already on disk, or to be collected there."""

    name: str
    folder: Path
    section: str
    """Section of the grid, i.e. the command that collects it."""
    wanted: Mapping[str, Any]  # collection settings by name

    @property
    def foreign(self) -> bool:
        """Whether the folder holds shards that were not collected by this package, e.g. downloaded or imported ones."""
        collected = (self.folder / PLAN).exists() and "format" not in read_plan(self.folder)
        return not collected and bool(shard_files(self.folder))

    @property
    def there(self) -> bool:
        return (self.folder / PROVENANCE).is_file() or self.foreign

    @cached_property
    def fingerprint(self) -> str:
        """Content hash; the first call on a new dataset decodes all of it."""
        return open_store(self.folder).fingerprint

    def check(self) -> None:
        """Raise UserError unless the folder holds this dataset or it can be collected there."""
        if self.foreign:  # shards that nothing here collected
            shards = shard_paths(self.folder)
            if self.section != "collect":
                return
            task, _ = task_and_quality(self.folder, [read_attributes(shard) for shard in shards])
            wanted = self.wanted["task"], self.wanted.get("frame_size") or FRAME_SIZE
            for has, asked in zip((task, read_frame_size(shards)), wanted, strict=True):
                if has not in (None, asked):
                    what = f"frames of {has}x{has} pixels" if isinstance(has, int) else f"a dataset of {has}"
                    raise UserError(f"{self.folder}: holds {what}, the grid says {asked}; choose another --data")
        elif (self.folder / PLAN).exists():
            stored = read_json(self.folder / PLAN)
            for name in differing(stored, self.wanted)[:1]:
                both = (values.get(name) for values in (stored, self.wanted))
                has, asked = (f"the default {name}" if v is None else f"{name} {v}" for v in both)
                raise UserError(
                    f"{self.folder}: holds a dataset of {has}, the grid says {asked}; choose another --data"
                )
        elif self.section == "collect":
            TASKS.named(self.wanted["task"])
            if self.wanted["quality"] not in SET_QUALITIES:
                raise UserError(
                    f"{self.folder}: holds no dataset, and the quality {self.wanted['quality']!r} cannot be collected: "
                    f"put the set there, or choose one of {', '.join(SET_QUALITIES)}"
                )

    def made(self, record: Mapping[str, Any]) -> bool:
        """Whether a run, given its config.json, was trained on this dataset."""
        if self.there:  # compare content: another machine's renderer may produce other pixels
            return record.get("inputs", {}).get("data") == self.fingerprint
        return self.alike(record)

    def alike(self, record: Mapping[str, Any]) -> bool:
        """Whether a run's dataset has the same collection settings; its content may still differ."""
        collection = record.get("collection") or {}
        return bool(collection) and not differing(collection, self.wanted)


def set_of(cell: GridCell, root: Path) -> DataSet:
    """The dataset of a cell, below `root`."""
    section, wanted = cell.chain[0], collection_of(cell)
    for name in _IN_NAMES[section]:
        if wanted[name] in ("", ".", "..") or "/" in wanted[name]:
            raise UserError(f"the grid's {section} has the {name} {wanted[name]!r}, which is no name of a folder")
    place = "/".join(wanted[name] for name in _IN_NAMES[section])
    name = place + _extras(cell, section)
    inner = root / name / _DOWNLOADED
    return DataSet(name, inner if inner.is_dir() else root / name, section, wanted)


def runs_below(out: Path) -> Iterator[Result]:
    """Every run below a folder, without its rows; UserError for a damaged record."""
    for path in files_below(out, CONFIG_FILE):
        record = read_json(path)
        if "stage" in record and isinstance(record.get("config"), dict) and "seed" in record["config"]:
            yield read_records(path.parent)


def runs_kept(folders: Iterable[Path]) -> list[Result]:
    """Every run in some results folders; UserError for a folder without results."""
    return with_collections([run for folder in folders for run in read_results(folder)])


def with_collections(runs: Iterable[Result]) -> list[Result]:
    """Fill in missing collection settings of runs from other runs on the same content. Keeps the order."""
    collections = {run.data: run.record["collection"] for run in runs if run.data and run.record.get("collection")}
    return [
        replace(run, files=run.files | {"config": run.record | {"collection": collections[run.data]}})
        if run.data in collections and not run.record.get("collection")
        else run
        for run in runs
    ]


@dataclass(frozen=True)
class Job:
    """One command of a sweep."""

    name: str  # folder of its result below the sweep's folder, or "data/" and the dataset's name
    section: str
    """Section of the grid, i.e. its stage."""
    folder: Path
    words: list[str]  # its command line after `vd4rl-pomdp`
    needs: list[str] = field(default_factory=list)  # names of the jobs that must finish first
    done: bool = False
    """Marks as done a job whose folder cannot show it: a row kept elsewhere, or a dataset not collected here."""
    settings: dict[str, str] = field(default_factory=dict)
    """Its settings and those of the stages before it, as text."""
    recipe: str = ""  # recipe hash of a training; empty for a dataset
    content: str = ""  # fingerprint of the dataset of a run already in its folder; empty if there was none

    @property
    def finished(self) -> bool:
        """Whether the result is complete now. A run with another recipe or dataset content does not count."""
        if self.done or self.section not in STAGES:
            return self.done or (self.folder / PROVENANCE).is_file()
        if not (self.folder / TIMING_FILE).is_file():
            return False
        run = read_records(self.folder)
        return run.recipe == self.recipe and self.content in ("", run.data)

    @property
    def begun(self) -> bool:
        return (self.folder / (CONFIG_FILE if self.section in STAGES else PLAN)).is_file()


def training_job(
    cell: GridCell, section: str, name: str, out: Path, data: Path, before: list[Job], values: Mapping[str, Any]
) -> Job:
    """The job of a cell's training in `out`, after the jobs `before` it; `values` are its settings and theirs."""
    places = {"data": data} | ({"encoder": before[-1].folder / "encoder"} if section == "finetune" else {})
    words = [*COMMANDS[section], *words_of(stage_settings(cell, section) | places | {"out": out})]
    needs, settings = [job.name for job in before], _words_by_name(values)
    return Job(name, section, out, words, needs, settings=settings, recipe=recipe_of(cell, section))


def plan_jobs(
    cells: Iterable[GridCell], out: Path, data: Path, kept: Iterable[Result] = (), others: Iterable[Job] = ()
) -> tuple[list[Job], list[str]]:
    """Jobs of some cells in dependency order, and warnings about finished ones. Writes nothing.

    Jobs that only finished jobs would need are left out.

    Args:
        cells: cells that passed `check_cells`.
        out: the sweep's folder.
        data: folder of the datasets.
        kept: runs known only by their rows; their folders are elsewhere.
        others: jobs of other grids in `out`, started or not.

    Raises:
        UserError: a folder holds a different dataset.
    """
    planner = _Planner(out, data, kept, others)
    for cell in cells:
        planner.add(cell)
    jobs = planner.needed()
    return jobs, list(planner.warnings(jobs))


class _Planner:
    """Collects jobs, without duplicates, by what they make."""

    def __init__(self, out: Path, data: Path, kept: Iterable[Result], others: Iterable[Job]) -> None:
        self._out, self._data = out, data
        here = list(runs_below(out))
        self._here, self._kept = (groups(runs, lambda run: run.recipe) for runs in (here, kept))
        self._folders = {run.path for run in here}
        self._names = {job.name: job.recipe for job in others}  # recipe by name, for names already taken
        self._jobs: dict[tuple[str, str, str], Job] = {}
        self._sets: dict[str, DataSet] = {}
        self._requested: set[str] = set()  # names of jobs that end a cell's chain
        self._of_other_code: Counter[str] = Counter()
        self._of_other_content: Counter[str] = Counter()
        self._on_other_encoders = 0
        self._on_missing: Counter[str] = Counter()  # runs here by dataset job that is not there

    def add(self, cell: GridCell) -> None:
        data = set_of(cell, self._data)
        if data.name not in self._sets:
            data.check()
            self._of_other_code.update(of_other_code(read_plan(data.folder), data.wanted))
        known, data = data, self._sets.setdefault(data.name, data)
        for setting in differing(data.wanted, known.wanted)[:1]:
            both = " and ".join(str(one.wanted.get(setting)) for one in (data, known))
            raise UserError(
                f"{data.folder}: the grid asks for {setting} {both} in one dataset: set {setting} in its section "
                f"{data.section}, so that the folders' names differ"
            )
        words = [*COMMANDS[data.section], *words_of(stage_settings(cell, data.section)), "--out", str(data.folder)]
        settings = _words_by_name(data.wanted)
        job = Job(f"{DATA}/{data.name}", data.section, data.folder, words, done=data.foreign, settings=settings)
        before = [self._jobs.setdefault((data.section, "", data.name), job)]
        values: dict[str, Any] = {}
        for section in cell.chain[1:]:
            # A policy's folder name also depends on the encoder's settings.
            values |= recorded(cell, section)
            before.append(self._training(cell, section, data, values, before))
        self._request(before[-1], data)

    def _training(self, cell: GridCell, section: str, data: DataSet, values: dict[str, Any], before: list[Job]) -> Job:
        own = recipe_of(cell, section)
        key = (section, own, data.name)
        if key in self._jobs:
            return self._jobs[key]
        run = _found(self._here, own, data)
        if run is not None:
            self._of_other_code.update(of_other_code(run.record, values))
            if not data.there:
                self._on_missing[before[0].name] += 1
            encoder = before[-1].folder / "encoder"
            if section == "finetune" and (encoder / CONFIG).is_file():
                self._on_other_encoders += run.record.get("inputs", {}).get("encoder") != encoder_hash(encoder)
            name, content = run.path.relative_to(self._out).as_posix(), run.data
        else:
            name, content = self._free(_run_folder(cell, section, data.name, values), own), ""
        self._names[name] = own
        job = training_job(cell, section, name, self._out / name, data.folder, before, values)
        self._jobs[key] = replace(job, content=content)
        return self._jobs[key]

    def _free(self, name: str, own: str) -> str:
        """A job name that no other run has in this plan, another grid's plan or an earlier sweep."""
        further = f"{name}~{own[:6]}"  # same recipe, but the dataset's content differs
        candidates = chain([name, further], (f"{further}.{number}" for number in count(2)))
        return next(
            one for one in candidates if self._out / one not in self._folders and self._names.get(one, own) == own
        )

    def _request(self, job: Job, data: DataSet) -> None:
        """Request a job for its own result, not as a dependency. A finished run among `kept` satisfies it."""
        if job.name in self._requested:
            return
        self._requested.add(job.name)
        run = _found(self._kept, job.recipe, data)
        if run is None and any(data.alike(other.record) for other in self._kept.get(job.recipe, ())):
            self._of_other_content[data.name] += 1
        if run is not None and run.finished:
            self._of_other_code.update(of_other_code(run.record, job.settings))
            self._jobs[job.section, job.recipe, data.name] = replace(job, done=True)

    def needed(self) -> list[Job]:
        """Finished jobs, requested jobs, and those that an unfinished one depends on."""
        found: list[Job] = []
        needed: set[str] = set()
        for job in reversed(self._jobs.values()):  # backwards: dependents come after their dependencies
            if job.name in needed and job.section in STAGES:
                job = replace(job, done=False)  # a kept row has no encoder to train on
            if not job.finished:
                if job.name not in needed | self._requested:
                    continue
                needed |= set(job.needs)
            found.append(job)
        return found[::-1]

    def warnings(self, jobs: list[Job]) -> Iterator[str]:
        """Reasons why runs do or do not count that a user may not expect, given the needed jobs."""
        for job in jobs:
            if number := self._on_missing[job.name]:
                yield (
                    f"{job.folder}: is missing and will be collected again, though {number} runs here were trained on "
                    "it: put it back; if the content differs they do not count"
                )
        for name, number in self._of_other_content.items():
            line = f"{number} kept runs are of a set collected alike, but with other content (from another machine?)"
            yield f"{name}: {line}: they do not count"
        for part, number in self._of_other_code.items():
            yield f"{part}: {number} sets or runs count, though its code has changed since they began"
        if number := self._on_other_encoders:
            yield f"{number} policies count that began with other encoders than their pretrainings' folders now hold"


def _found(runs: Mapping[str, list[Result]], own: str, data: DataSet) -> Result | None:
    """A run with this recipe and dataset, preferably a finished one. Exogenous images must match the current ones."""
    fitting = []
    for run in runs.get(own, ()):
        images = run.record.get("inputs", {}).get("exogenous")
        same = images is None or images == _images_in(run.record["config"]["exogenous"])
        if same and run.on_one_set and data.made(run.record):
            fitting.append(run)
    return max(fitting, key=lambda run: run.finished, default=None)


_images_in = cache(source_fingerprint)  # content hash of a maze run's exogenous images, cached


def _run_folder(cell: GridCell, section: str, data: str, values: dict[str, Any]) -> str:
    """A run's folder below the sweep's: TASK/QUALITY/CORRUPTION/METHOD,OTHER_SETTINGS/seedN/..."""
    if section == "navigation_train":
        return f"{data}/{values['method']}{_extras(cell, section)}/seed{cell.seed}"
    shared = f"{data}/{values['corruption']}/{values['method']}{_extras(cell, 'pretrain')}/seed{cell.seed}"
    if section == "pretrain":
        return f"{shared}/pretrain"
    return f"{shared}/finetune-{values['algorithm']}{_extras(cell, section)}"


def _extras(cell: GridCell, section: str) -> str:
    """Folder suffix of the other distinguishing settings: ",history=gru,max_k=1", or a hash if too long."""
    values = cell.sections[section]
    # Of what a [[where]] sets, a name shows what changes the data: a dataset is identified by it, and its corruption is
    # looked for in it.
    changes_data = values.keys() if section == cell.chain[0] else corruption_settings(values.get("corruption", "none"))
    shown = [*cell.named.get(section, ()), *(n for n in cell.overridden.get(section, ()) if n in changes_data)]
    words = (f",{name}={values[name]}" for name in dict.fromkeys(shown) if name not in _IN_NAMES[section])
    extras = "".join(words).replace("/", "_")
    return extras if len(extras.encode()) <= _LONGEST else f",{content_hash(extras)}"


def _words_by_name(values: Mapping[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in settings_of(values).items()}
