"""Results that outlive their run folders: one folder per experiment, small enough to commit.

    runs.jsonl           one JSON object per run: its id, and the contents of its small files by name
    episodes.csv         raw evaluation rows; the first column is the run's id
    certificates.json    whether a dataset under a corruption requires memory (`vd4rl-pomdp certify`), by a hash of the
                         dataset's content and the corruption; also stored in the dataset's folder

A report of a results folder equals one of the run folders, except for films. Both files are written whole, rows first.
Rows of runs missing from runs.jsonl come from an interrupted write and are ignored.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import LABELS, settings_of
from vd4rl_pomdp.core.reading import damaged, fits, parse_json, read_bytes
from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.runs import CONFIG_FILE, CRITIC_FILE, EPISODES_FILE, METRICS_FILE, RECORDS
from vd4rl_pomdp.runs.critic import KEYS, VALUE
from vd4rl_pomdp.runs.episodes import COLUMNS, EVALUATION_SEED, episodes_until, read_episodes
from vd4rl_pomdp.runs.files import (
    Row,
    content_hash,
    files_below,
    groups,
    read_json,
    replacing_file,
    write_csv,
    write_json,
)
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.outputs import owned, refuse_foreign
from vd4rl_pomdp.runs.provenance import CONTINUED
from vd4rl_pomdp.runs.run import identity, recipe, remedy

RUNS = "runs.jsonl"
FILES = {Path(file).stem: file for file in RECORDS} | {"encoder": f"encoder/{CONFIG_FILE}"}
"""A run's small files: key in runs.jsonl, and path in the run folder."""

CERTIFICATES = "certificates.json"
NOT_CERTIFIED = "not certified"
MEASURED = ("critic", "reference", "probe", "results")
"""FILES that hold a run's measures besides its rows."""
_HOLDS = {"data", "corruption", "name", "verdict", "why", "made", "measured", "budget"}
DAMAGED = "its files are damaged", "use another copy, or leave it out"
"""Message for a run whose files do not hold what a run writes."""
_ROUNDING = 1e-4  # tolerance of a score; scores and returns are stored with four decimals


@dataclass(frozen=True)
class Result:
    """One run, finished or not, from its own folder or a results folder."""

    id: str  # hash of what the run computes, see `runs.run.identity`
    path: Path  # its folder, or the results folder that lists it
    files: dict[str, dict[str, Any]]  # contents of those FILES that it has
    step: int  # last step in its metrics; 0 if there are none
    losses: list[tuple[int, float]]  # step and action loss over a pretraining
    rows: list[Row]  # evaluation rows, one per episode
    folder: bool = False  # whether `path` is its own folder

    @property
    def place(self) -> str:
        return str(self.path) if self.folder else f"{self.path}: run {self.id}"

    @property
    def record(self) -> dict[str, Any]:
        """config.json: stage, config, inputs, versions, git_commit, command."""
        return self.files["config"]

    @property
    def parts(self) -> list[dict[str, Any]]:
        """Hardware and `git_commit` of the run, and of each later part that was resumed elsewhere."""
        first = self.files.get("machine", {})
        return [first | {"git_commit": self.record.get("git_commit")}, *first.get(CONTINUED, [])]

    @property
    def machine(self) -> str:
        """Its GPU, or its processor and cores; "A then B" if it moved; empty if unknown."""
        known = [(part.get("gpu"), part.get("processor"), part.get("cores")) for part in self.parts]
        names = [gpu or (f"{name}, {cores} cores" if name and cores else name) for gpu, name, cores in known]
        return " then ".join(dict.fromkeys(str(one) for one in names if one))

    @property
    def commit(self) -> str:
        """Commit that computed it; "A then B" as in `machine`."""
        return " then ".join(dict.fromkeys(str(one) for part in self.parts if (one := part.get("git_commit"))))

    @property
    def encoder(self) -> dict[str, Any]:
        """Its encoder's record of the pretraining; empty without an encoder."""
        return self.files.get("encoder", {}).get("pretrain", {})

    @property
    def origin(self) -> dict[str, Any]:
        """Its encoder's record of its code, in earlier rows a separate part; empty without an encoder."""
        record = self.files.get("encoder", {})
        return record.get("origin", record)

    @property
    def card(self) -> dict[str, Any]:
        """Pretraining record of the encoder that it started from; empty for a pretraining run."""
        return self.encoder if self.record["stage"] == "finetune" else {}

    @property
    def labels(self) -> dict[str, Any]:
        """Values of LABELS; the task is empty until the run has opened its data."""
        return {name: self.files["labels"][name] for name in LABELS}

    @property
    def data(self) -> str:
        """Dataset fingerprint; empty if not recorded."""
        return self.record.get("inputs", {}).get("data", "")

    @cached_property
    def recipe(self) -> str:
        """Hash of what it computes, ignoring its data's content."""
        return recipe(self.record, self._settings_card)

    @cached_property
    def experiment(self) -> str:
        """Hash like `recipe`, the same for all seeds of an experiment."""
        return recipe(self.record, self._settings_card, seeds=False)

    @property
    def _settings_card(self) -> dict[str, Any]:
        return self.card if {"settings", "seed"} <= self.card.keys() else {}

    @property
    def on_one_set(self) -> bool:
        """Whether its encoder, if any, was pretrained on the run's own dataset, as in every grid."""
        return self.card.get("data") in (None, self.data)

    @property
    def certificate(self) -> str:
        """Id of the certificate for its dataset and corruption."""
        return certificate_id(self.data, self.encoder.get("corruption") or {})

    @property
    def measured(self) -> list[Row]:
        """Evaluation rows, or the measures of a navigation run."""
        return self.rows or self.files.get("results", {}).get("rows", [])

    def extends(self, other: Result) -> bool:
        """Whether its measures begin with another's. Later evaluations of one policy (`evaluate --keep`) only add."""
        return self.measured[: len(other.measured)] == other.measured

    def agrees(self, other: Result) -> bool:
        """Whether another copy has the same measures, as far as both have them."""
        both = [name for name in MEASURED if name in self.files and name in other.files]
        same = self.losses == other.losses and all(self.files[name] == other.files[name] for name in both)
        return same and (self.extends(other) or other.extends(self))

    @property
    def finished(self) -> bool:
        return "timing" in self.files

    @property
    def diverged(self) -> dict[str, Any] | None:
        """`step` and `message` of its divergence; None if it did not diverge."""
        return self.files.get("diverged")

    @property
    def ending(self) -> int:
        """Rank of its end: 0 none yet, 1 diverged, 2 finished."""
        return 2 if self.finished else int(self.diverged is not None)


def read_records(folder: Path) -> Result:
    """A run folder's small files, without metrics and rows; UserError for a damaged one."""
    files = {name: read_json(folder / place) for name, place in FILES.items() if (folder / place).exists()}
    if "encoder" in files and not isinstance(files["encoder"].get("pretrain"), dict):
        raise UserError(f"{folder / FILES['encoder']}: does not say how the encoder was pretrained; pretrain it again")
    return Result("", folder, files, 0, [], [], True)


def read_run(folder: Path | str) -> Result:
    """Everything in a run folder; UserError for damaged files."""
    folder = Path(folder)
    files = read_records(folder).files
    if "config" not in files:
        raise UserError(f"{folder}: is not a run (no {CONFIG_FILE}); name a folder that a training wrote")
    metrics, path = read_metrics(folder / METRICS_FILE), folder / EPISODES_FILE
    # a truncated last row is dropped only from unfinished runs
    found = read_episodes(path) if "timing" in files else episodes_until(path, sys.maxsize)
    rows = [{name: row[name] for name in COLUMNS} for row in found]
    step = max((int(row["step"]) for row in (*metrics, *rows)), default=0)
    with damaged(folder, *DAMAGED):
        losses = [(int(row["step"]), row["action_loss"]) for row in metrics if "action_loss" in row]
        pretraining = files["config"]["stage"] == "pretrain"
        run = Result("", folder, files, step, losses if pretraining else [], rows, True)
        _check(run)
        last, episodes = files.get("timing", {}).get("updates"), run.record["config"].get("eval_episodes")
        played = sum(row["step"] == last and row["evaluated_under"] == row["corruption"] for row in rows)
        if last is not None and episodes is not None and played < episodes:
            what = f"{played} of {episodes} episodes of the last evaluation"
            raise UserError(f"{path}: has {what}; {remedy(folder)}")
        if files.get("critic") == {} and any(VALUE in row for row in metrics):
            raise UserError(f"{folder / CRITIC_FILE}: has no critic, {METRICS_FILE} has one; {remedy(folder)}")
        known = rows[0] if rows else files.get("labels")
        if known is None:  # not begun: as far as its config says
            config = {"method": folder.name} | {name: run.encoder.get(name) for name in ("task", "quality")}
            config |= run.record["config"]
            known = {name: config.get(name) or "" for name in LABELS} | {"seed": config["seed"]}
        if missing := [name for name in LABELS if name not in known]:
            raise UserError(f"{folder / FILES['labels']}: has no {missing[0]!r}; {remedy(folder)}")
        files["labels"] = files.get("labels", {}) | {name: known[name] for name in LABELS}
        _check(run)  # also labels that config.json gives a run which has not begun
        return replace(run, id=_id(run))


def _id(run: Result) -> str:
    """Its identity. If a policy's encoder or data are not fully recorded, a hash of what is."""
    data = run.record.get("inputs", {}).get("data")
    if data and (run.record["stage"] != "finetune" or run._settings_card):
        return identity(run.record, run.card)
    return content_hash([run.record["stage"], settings_of(run.record["config"]), run.labels, run.card, data])


def _check(run: Result) -> None:
    """Check the types of a run's essential parts; raises KeyError, TypeError or AttributeError."""
    config, stage = run.record["config"], run.record["stage"]
    if not all(isinstance(part, dict) for part in (*run.files.values(), *run.parts, config, run.encoder)):
        raise TypeError("a part of it is not a JSON object")
    if "seed" not in config or not isinstance(stage, str):
        raise TypeError(f"its record holds no settings, or its stage is {stage!r}")
    texts = [part.get(name, {}) for part in (run.record, run.origin) for name in ("inputs", "plugins", "sources")]
    typed: list[tuple[dict[str, Any], dict[str, Any]]] = [
        (run.record, {"inputs": dict, "collection": dict | None, "command": str, "plugins": dict, "sources": dict}),
        (config, {"data": str | None}),
        (run.encoder, {"corruption": dict | None, "data": str, "settings": dict | None}),
        (run.files.get("labels", {}), dict.fromkeys(LABELS, str) | {"seed": int}),
        *((part, dict.fromkeys(part, str)) for part in texts),
    ]
    for part, kinds in typed:
        for name, kind in kinds.items():
            if name in part and not fits(part[name], kind):
                raise TypeError(f"its {name} is {part[name]!r}")
    numbers = [value for name in ("probe", "reference") for value in run.files.get(name, {}).values()]
    if any(isinstance(value, float) and not math.isfinite(value) for value in numbers):
        raise TypeError("its probe or reference is not finite")
    critic = run.files.get("critic", {})
    if critic.keys() - KEYS or any(not (fits(v, float | None) and math.isfinite(v or 0)) for v in critic.values()):
        raise TypeError(f"its {CRITIC_FILE} is {critic}")


def read_results(folder: Path | str) -> list[Result]:
    """All runs of a results folder; UserError if it is none or damaged."""
    folder = Path(folder)
    path, by_run = folder / RUNS, dict[str, list[Row]]()
    try:  # before the rows: they are written first, so a concurrent write cannot make rows look missing
        lines = read_bytes(path).decode().splitlines()
    except FileNotFoundError as error:
        raise UserError(f"{path.parent}: holds no {RUNS}, so it is not a results folder") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not UTF-8 ({error}); use another copy") from error
    if not lines:
        raise UserError(f"{path}: is empty; use another copy, or remove it")
    where = folder / EPISODES_FILE
    for row in read_episodes(where):
        if "id" not in row:
            raise UserError(f"{where}: has no column 'id'; it was not written beside {RUNS}")
        # hundreds of thousands of rows repeat a few dozen strings: intern them
        shared = {name: sys.intern(row[name]) if isinstance(row[name], str) else row[name] for name in COLUMNS}
        by_run.setdefault(row["id"], []).append(shared)
    runs: dict[str, Result] = {}
    for number, line in enumerate(lines, 1):
        with damaged(f"{path}: line {number}", *DAMAGED):
            record = parse_json(line)
            name, count = record["id"], int(record["episodes"])
            rows = by_run.get(name, [])
            if name in runs:
                raise UserError(f"{path}: names a run twice; remove one of the two lines")
            if len(rows) < count:
                raise UserError(f"{where}: has {len(rows)} of {count} rows of run {name}; use another copy")
            files = {key: record[key] for key in FILES if key in record}
            losses = [(int(step), float(loss)) for step, loss in record.get("losses", [])]
            # ignore rows that a later, interrupted write added
            runs[name] = Result(name, folder, files, int(record["step"]), losses, rows[:count])
            _check(runs[name])
    return list(runs.values())


def write_results(out: Path, runs: Iterable[Result]) -> None:
    """Write runs as a results folder, replacing its previous runs. Readers see each file whole."""
    runs = list(runs)
    with replacing_file(out / RUNS) as fresh:
        with fresh.open("w", encoding="utf-8") as file:
            for run in runs:
                files = {name: run.files[name] for name in FILES if name in run.files}
                record = {"id": run.id, **files, "step": run.step, "episodes": len(run.rows)}
                file.write(json.dumps(record | ({"losses": run.losses} if run.losses else {})) + "\n")
        # Inside the block: if the disk is full, both files stay unchanged.
        write_csv(out / EPISODES_FILE, ("id", *COLUMNS), ({"id": run.id} | row for run in runs for row in run.rows))


def find_results(paths: Sequence[Path | str], but: Path | None = None) -> list[Result]:
    """Every run at or below some paths, without duplicates, from run folders and results folders.

    Results folders nested in another one belong to other experiments and are read only if named themselves; the results
    folder `but` is skipped unless it is in `paths`. UserError if a path is missing, there is no run, two runs with one
    id have different rows or records, or a file is damaged.
    """
    if not paths:
        raise UserError("name at least one run folder, or a folder that contains some")
    named = [Path(path) for path in paths]
    if missing := [path for path in named if not path.exists()]:
        raise UserError(f"{missing[0]}: no such folder")
    files = dict.fromkeys(file for path in named for file in files_below(path, CONFIG_FILE))
    runs = [read_run(file.parent) for file in files if "stage" in read_json(file)]
    places: dict[Path, None] = {}
    for path in named:
        below = {file.parent for file in files_below(path, RUNS)}
        places |= dict.fromkeys(place for place in sorted(below) if below.isdisjoint(place.parents))
    for place in places:
        if but is None or place in named or place.resolve() != but.resolve():
            runs += read_results(place)
    if not runs:
        what = "no runs (a run is a folder with config.json and metrics.jsonl) and no results folder (which holds"
        raise UserError(f"{named[0]}: contains {what} {RUNS})")
    found: dict[str, Result] = {}
    for run in runs:
        other = found.setdefault(run.id, run)
        if other.ending and other.ending == run.ending and not run.agrees(other):
            raise UserError(
                f"{run.path} and {other.path}: two runs with the same method, setting and seed; name one of them"
            )
        found[run.id] = max(other, run, key=_completeness)
    return list(found.values())


def _completeness(run: Result) -> tuple[int, int, bool, int, int, int]:
    """Sort key of two copies of a run: a finished, then a diverged one; of those the one that was evaluated more; then
    a run folder, which alone is up to date while the run continues; then the one further along, or with more files."""
    played = len(run.measured)
    return run.ending, played if run.ending else 0, run.folder, played, run.step, len(run.files)


def add_results(paths: Sequence[Path | str], out: Path | str) -> str:
    """Append the runs at or below some paths to a results folder, and return a summary in words.

    Existing rows never change, except that an unfinished run is replaced by its finished or diverged version, and a
    diverged one by its finished version. Later evaluations of a run that is there are added to it. UserError as in
    `find_results`, or if `out` holds something else or is in use.
    """
    out = Path(out)
    refuse_foreign(out, "results", RUNS, "README.md", "grid.toml")  # page and grid may exist before the first run
    found = find_results(paths, out)
    with owned(out):
        there = _stored(out)
        ended = [run for run in found if run.ending]
        fresh = {run.id: run for run in ended if run.id not in there or run.ending > there[run.id].ending}
        again = [run for run in ended if run.id not in fresh]
        same = [run for run in again if run.agrees(there[run.id])]
        # rows only: a copy's other records, such as its commit, do not replace those there
        longer = {run.id: replace(there[run.id], rows=run.rows) for run in same if not there[run.id].extends(run)}
        if fresh or longer:
            write_results(out, (there | fresh | longer).values())
        known, certified = certificates_of(found, map(Path, paths)), _certificates(out / CERTIFICATES)
        keep_certificates(out, {name: one for name, one in known.items() if name not in certified})
    counts = {
        f"run{'s' * (len(fresh) != 1)} added": len(fresh) or "0",
        "there already": len(same) - len(longer),
        "there already, with later evaluations added": len(longer),
        "there already with other rows or records, which stay (remove their lines to replace them)": (
            len(again) - len(same)
        ),
        "unfinished and left out": len(found) - len(ended),
        f"certificates unlike those there, which stay (remove those from {CERTIFICATES} to replace them)": sum(
            certified.get(name, one) != one for name, one in known.items()
        ),
    }
    return ", ".join(f"{number} {what}" for what, number in counts.items() if number)


def certificate_id(data: str, corruption: Mapping[str, Any]) -> str:
    """Id of a certificate: hash of the dataset's fingerprint and the corruption's settings."""
    return content_hash([data, dict(corruption)])


def _rank(certificate: Row) -> tuple[int, int, str]:
    """Of several certificates the one of the largest budget counts, then the newest."""
    budget = certificate.get("budget", {})
    return budget.get("updates", 0), budget.get("steps", 0), str(certificate["made"])


def _certificates(file: Path) -> dict[str, Row]:
    """Certificates of a file by id, none if it is missing; UserError if it is damaged."""
    found = read_json(file) if file.is_file() else {}
    for one in found.values():
        whole = isinstance(one, dict) and one.keys() >= _HOLDS and fits(one["measured"], dict)
        if not whole or not fits(one["budget"], dict) or not all(fits(size, int) for size in one["budget"].values()):
            raise UserError(f"{file}: is damaged; remove it, or write it again with `vd4rl-pomdp certify`")
    return found


def read_certificates(places: Iterable[Path], sets: Iterable[Path] = ()) -> dict[str, Row]:
    """All certificates at or below some folders, and in dataset folders, by id; of duplicates that of the largest
    budget, then the newest.

    UserError if a file is damaged.
    """
    found: dict[str, Row] = {}
    files = [file for place in places for file in files_below(place, CERTIFICATES)]
    for file in dict.fromkeys([*files, *(one / CERTIFICATES for one in sets)]):
        for name, one in _certificates(file).items():
            found[name] = max(found.get(name, one), one, key=_rank)
    return found


def keep_certificates(folder: Path, certificates: dict[str, Row]) -> None:
    """Add certificates to a folder's file, replacing those with the same id and no larger budget."""
    file = folder / CERTIFICATES
    there = _certificates(file)
    merged = there | {name: max(there.get(name, one), one, key=_rank) for name, one in certificates.items()}
    if merged != there:
        write_json(file, merged)


def certificate_in_words(certificate: Row) -> str:
    """The verdict and its reason."""
    return f"{certificate['verdict']} ({certificate['why']})"


def certificates_of(runs: Sequence[Result], places: Iterable[Path]) -> dict[str, Row]:
    """Certificates that apply to some runs, by id: found as by `read_certificates`, and in runs' dataset folders."""
    sets = {Path(run.record["config"].get("data") or "-") for run in runs if run.folder}
    there = sorted(one for one in sets if os.access(one / CERTIFICATES, os.R_OK))  # others' datasets may be closed
    known = read_certificates(places, there)
    return {name: known[name] for name in dict.fromkeys(run.certificate for run in runs) if name in known}


def _stored(out: Path) -> dict[str, Result]:
    """The runs of a results folder by id; empty before the first one."""
    return {run.id: run for run in read_results(out)} if (out / RUNS).exists() else {}


def verify_results(folder: Path | str) -> tuple[list[Result], list[str]]:
    """The runs of a results folder, and a sentence for each contradiction with their own records.

    Ids must match the recorded settings, seed, data and format. Episodes must be exactly those that the settings ask
    for, with the run's labels; environment seeds must match episode numbers, and scores their returns. Seeds must
    differ in some return.
    """
    runs = read_results(folder)
    wrong = [f"run {run.id}: {problem}" for run in runs for problem in _contradictions(run)]
    stored = Counter(row["id"] for row in read_episodes(Path(folder) / EPISODES_FILE))
    for name, count in (stored - Counter({run.id: len(run.rows) for run in runs})).items():
        wrong.append(f"run {name}: {count} rows more than {RUNS} says")
    seen: dict[tuple[Any, ...], Result] = {}
    for run in runs:
        returns = tuple(row["return"] for row in run.rows)
        if len(set(returns)) > max(3, len(returns) // 2):  # with few possible returns, equal ones are no surprise
            alike = tuple(value for name, value in run.labels.items() if name != "seed")
            other = seen.setdefault((run.experiment, alike, returns), run)
            if other.labels["seed"] != run.labels["seed"]:
                wrong.append(f"run {run.id}: all its returns are those of run {other.id}, another seed")
    return runs, wrong


def _contradictions(run: Result) -> Iterator[str]:
    with damaged(run.place, *DAMAGED):
        if (computed := _id(run)) != run.id:
            yield f"its record computes {computed}"
        config, card = run.record["config"], run.encoder
        trained = {name: value for name, value in card.items() if name != "seed"} | card.get("corruption", {})
        known = {name: value for name, value in ((trained if run.card else {}) | config).items() if name in LABELS}
        for name, value in known.items():
            labelled = [(run.labels, "its labels have"), *((row, "an episode has") for row in run.rows)]
            wrong = [(row[name], whose) for row, whose in labelled if value is not None and row[name] != value]
            if wrong:
                yield f"{wrong[0][1]} the {name} {wrong[0][0]}, its record {value} ({len(wrong)} such)"
        # not steps: an encoder may be an intermediate checkpoint of a longer training
        for name in sorted(trained.keys() & card.get("settings", {}).keys() - {"steps", "corruption"}):
            if trained[name] != card["settings"][name]:
                yield f"its encoder says {name} {trained[name]}, its settings {card['settings'][name]}"
        reference, task = run.files.get("reference", {}), _shipped(run)
        data: Any = run.files.get("critic", {}).get("data")
        mean: Any = reference.get("mean_reward")
        plan = run.record.get("collection") or {}
        if {"task", "quality"} <= plan.keys():
            noise = f"_noise{plan['action_noise']:g}" if plan.get("action_noise") else ""
            for name, made in (("task", plan["task"]), ("quality", plan["quality"] + noise)):
                if run.labels[name] != made:
                    yield f"its labels have the {name} {run.labels[name]}, its data were collected as {made}"
            # a set of shorter episodes is one for tests, whose evaluations are shorter, too
            total: Any = reference.get("data_return")
            n = task.decisions if task else 0
            whole = n > 0 and config.get("eval_length", n) >= n and None not in (mean, total)
            if whole and abs(total - mean * n) > n * 2e-6:
                yield f"its data return {total}, but {n} times the mean reward {mean} is {n * mean:.4f}"
        gamma = config.get("gamma", 1)
        if None not in (data, mean) and gamma < 1 and abs(data - mean / (1 - gamma)) > _ROUNDING:
            yield f"its critic.json has data value {data}, but mean reward {mean} gives {mean / (1 - gamma):.4f}"
        yield from _astray(run)


def _astray(run: Result) -> Iterator[str]:
    """What is wrong with a run's episodes: missing or extra ones, and inconsistent values."""
    config, own = run.record["config"], run.labels["corruption"]
    by_place = groups(run.rows, lambda row: (row["step"], row["evaluated_under"]))
    played = {place: [row["episode"] for row in rows] for place, rows in by_place.items()}
    # `evaluate --keep` may add any number of episodes under other corruptions at the end
    wanted = {place: len(numbers) for place, numbers in played.items()}
    if {"updates", "eval_every", "eval_episodes"} <= config.keys():  # not recorded by earlier runs
        last, count, every = config["updates"], config["eval_episodes"], config["eval_every"]
        ended = {run.step, run.files["timing"].get("updates")} if run.finished else {last}
        if ended != {last}:
            yield f"it ends with update {(ended - {last}).pop()}, its record with {last}"
        # an unfinished run may have been interrupted during its newest evaluation
        end = last if run.finished else (run.diverged or {"step": run.step})["step"] - 1
        judged = [(step, under) for step, under in played if run.finished or step <= end]
        wanted |= {(step, under): 0 for step, under in judged if step != last or under == own}
        due = range(every, end + 1, every)
        some = {*due[: len(played) + 1], *(step for step, _ in played if step in due)}  # the record may ask for any
        wanted |= {(step, own): count for step in {*some, *[last] * run.finished}}
        if run.finished and config.get("eval_clean") and own != "none" and count:
            wanted[last, "none"] = config.get("eval_clean_episodes") or count
    for (step, under), count in sorted(wanted.items()):
        numbers = played.get((step, under), [])
        if len(numbers) != count or numbers != list(range(count)):
            yield f"at step {step} under {under} it has the episodes {numbers}, its record {count}, from 0 on"
    task, reference, shipped = TASKS.get(run.labels["task"]), run.files.get("reference", {}), _shipped(run)
    longest = min(config.get("eval_length", math.inf), task.decisions if task else math.inf)
    shortest, right = (longest, longest) if shipped else (1, f"within 1 and {longest}")
    most = shipped.action_repeat if shipped else math.inf
    divisor = task.score_divisor if task else math.nan
    known = reference.get("actor") is not None if "mean_reward" in reference else None  # earlier runs do not record it
    wrong = {
        "environment seeds are not those of their numbers": [
            row["episode_seed"] != row["episode"] + EVALUATION_SEED for row in run.rows
        ],
        f"lengths are not {right}": [not shortest <= row["length"] <= longest for row in run.rows],
        f"returns are not within 0 and {most} per decision": [
            bool(shipped) and not 0 <= row["return"] <= most * row["length"] for row in run.rows
        ],
        f"scores are not their returns / {divisor:g}": [
            abs(row["score"] - row["return"] / divisor) > _ROUNDING for row in run.rows
        ],
        "action errors are missing, or present without an actor": [
            (row["action_error"] is None) is known for row in run.rows
        ],
    }
    yield from (f"{sum(found)} {what}" for what, found in wrong.items() if any(found))


def _shipped(run: Result) -> DMCTask | None:
    """The run's task if this package ships it: such tasks never end early, and their rewards are within 0 and 1."""
    name = run.labels["task"]
    task = TASKS.get(name)
    return task if isinstance(task, DMCTask) and not TASKS.origin(name) else None


def refuse_loss(runs: Sequence[Result], out: Path) -> None:
    """Raise UserError if writing runs as the results folder `out` would lose finished or diverged runs, or rows."""
    there = [run for run in _stored(out).values() if run.ending]
    written = {run.id: run for run in runs if run.ending}
    if lost := [run for run in there if run.id not in written]:
        what = "name the folder among those to report, remove it, or choose another --out"
        raise UserError(f"{out}: holds the results of {len(lost)} runs that would be lost; {what}")
    for run in there:
        other = written[run.id]
        if other.ending <= run.ending and not (other.extends(run) and other.agrees(run)):
            what = f"other rows or records of run {run.id}"
            raise UserError(f"{out}: holds {what}, which would be lost; choose another --out")
