"""Bad files, made from valid ones: every file that a command reads, damaged in every way that its format allows."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bad_input_damage import ANY, BY_SUFFIX, JSON, Damage, each_place
from bad_input_flags import ENCODER, MAZE, NAVIGATED, RUN, SET, SMOKE, STUDY, Case
from bad_input_world import CUT

ROWS = ["reports/results/runs.jsonl", "reports/results/episodes.csv"]
READERS: list[tuple[str, list[str], list[str]]] = [
    ("data check", [SET], [f"{SET}/0_walker_walk_random.hdf5"]),
    ("data card", [SET], [f"{SET}/1_walker_walk_random.hdf5", f"{SET}/provenance.json"]),
    (
        "data collect",
        ["--task", "walker_walk", "--quality", "random", "--episodes", "4", "--episodes-per-shard", "2", "--out", SET],
        [f"{SET}/collection.json"],
    ),
    (
        "data collect",
        ["--task", "walker_walk", "--quality", "medium", "--actor", "actor.safetensors", "--out", "new"],
        ["actor.safetensors"],
    ),
    ("policy export", ["runs/policy", "--out", "new"], ["runs/policy/config.json", "runs/policy/curve.csv"]),
    ("policy export", ["runs/policy", "--out", "new"], ["runs/policy/snapshots/00010000.safetensors"]),
    ("pretrain", ["--data", SET, "--out", "new", *SMOKE], [f"{SET}/1_walker_walk_random.hdf5"]),
    (
        "finetune",
        ["--encoder", ENCODER, "--data", SET, "--out", "new", *SMOKE, "--workers", "1"],
        [f"{ENCODER}/config.json", f"{ENCODER}/model.safetensors"],
    ),
    ("hub push", [ENCODER, "lab/encoder"], [f"{ENCODER}/config.json", f"{ENCODER}/model.safetensors"]),
    ("hub push", [SET, "datasets/lab/set"], [f"{SET}/0_walker_walk_random.hdf5"]),
    *(
        (command, [*words, "--out", folder], [f"{folder}/config.json", f"{folder}/metrics.jsonl"])
        for command, (folder, words) in CUT.items()
    ),
    (
        "finetune",
        [*CUT["finetune"][1], "--out", "runs-cut/finetuning"],
        [f"runs-cut/finetuning/{name}" for name in ("episodes.csv", "features.npy", "features.json")],
    ),
    (
        "evaluate",
        [RUN, "--episodes", "1", "--workers", "1"],
        [
            f"{RUN}/{name}"
            for name in (
                *("config.json", "labels.json", "episodes.csv", "encoder/config.json", "encoder/model.safetensors"),
                *("policy/config.json", "policy/model.safetensors", "reference.json"),
            )
        ],
    ),
    (
        "report",
        ["runs", "--out", "new"],
        [
            f"{RUN}/{name}"
            for name in (
                *("config.json", "metrics.jsonl", "timing.json", "probe.json", "film.npz", "episodes.csv"),
                *("encoder/config.json", "pretrain_timing.json", "reference.json"),
            )
        ],
    ),
    ("report", ["runs", "reports/theory", "--out", "new"], ["reports/theory/theory.json"]),
    ("report", ["runs-cut/finetuning", "--out", "new"], ["runs-cut/finetuning/labels.json"]),
    ("report", ["reports/results", "--out", "new"], ROWS),
    ("report compare", ["runs", "reports/results", "--out", "new"], ROWS),
    ("results add", ["runs", "--out", "reports/results"], ROWS),
    ("navigation train", ["--data", MAZE, "--out", "new", *SMOKE], [f"{MAZE}/0_no_curtain.hdf5"]),
    (
        "navigation report",
        [NAVIGATED, "--out", "new", "--no-pictures"],
        [
            f"{NAVIGATED}/{name}"
            for name in ("config.json", "results.json", "timing.json", "machine.json", "trajectory.csv")
        ],
    ),
    (
        "navigation report",
        ["reports/navigation", "--out", "new", "--no-pictures"],
        ["reports/navigation/runs.jsonl"],
    ),
    ("sweep run", ["grid.toml", "--out", "new", "--testing", "--dry-run"], ["grid.toml"]),
    ("sweep status", ["swept"], ["swept/sweep/plans/mine.json", "swept/sweep/attempts.jsonl"]),
    ("sweep retry", ["swept"], ["swept/sweep/plans/mine.json"]),
    (
        "data table",
        ["--out", "reports/sets", "--tasks", "walker_walk", "--qualities", "random"],
        [f"reports/sets/{name}" for name in ("returns.csv", "costs.csv", "actors.json")],
    ),
    (
        "control-study",
        ["--out", "reports/control", *STUDY],
        ["reports/control/runs.csv", "reports/control/episodes.csv"],
    ),
]
"""Command, words that read some files, and those files."""

_LOG = "the log decides nothing, and a kill may cut it"
FINE: dict[str, str] = {
    "data table | */returns.csv | missing": "its episodes are played anew",
    "data table | */returns.csv | a dangling link": "its episodes are played anew",
    "data table | */costs.csv | missing": "they are measured anew",
    "data table | */costs.csv | a dangling link": "they are measured anew",
    **{f"data table | */costs.csv | {kind}": "the last column is a commit" for kind in ("a word*", "nan", "inf")},
    **{
        f"data table | */actors.json | {kind}": "sets whose actors are not known are played anew"
        for kind in ("missing", "a dangling link", "no key")
    },
    **{f"control-study | */runs.csv | {kind}": "the last column is a commit" for kind in ("a word*", "nan", "inf")},
    **{
        f"control-study | */episodes.csv | {kind}": "a run without its episodes is run anew"
        for kind in ("missing", "a dangling link")
    },
    "report | runs-cut/finetuning/labels.json | *": "a run that has rows is named by them",
    **{
        f"evaluate | {RUN}/config.json | {kind}": "where it tells no length, whole episodes are played"
        for kind in ("missing", "a dangling link", "no key")
    },
    "report | */timing.json | missing": "a run that is not finished has none",
    "report | */timing.json | a dangling link": "a run that is not finished has none",
    "report | */probe.json | missing": "a set without states gives none",
    "report | */probe.json | a dangling link": "a set without states gives none",
    "report | */probe.json | no key": "a set without states gives none",
    "* | */reference.json | missing": "earlier versions kept none",
    "* | */reference.json | a dangling link": "likewise",
    "* | */episodes.csv | without a column": "the last one is the action error, which earlier versions did not know",
    "report | */pretrain_timing.json | missing": "an encoder of other origin has none",
    "report | */pretrain_timing.json | a dangling link": "likewise",
    "report | */pretrain_timing.json | no key": "what it does not say is left out of the report",
    **{
        f"report | runs/finetuned/encoder/config.json | {kind}": "the rows name their run; the rest is left out"
        for kind in ("missing", "a dangling link")
    },
    **{
        f"navigation report | */trajectory.csv | {kind}": "without pictures nothing reads it, it is copied as it is"
        for kind in ("empty", "truncated", "garbage", *("without *", "a short row", "a word*", "nan", "inf", "an*"))
    },
    "report | */theory.json | missing": "the report goes without its section",
    "report | */theory.json | a dangling link": "likewise",
    **{
        f"finetune | */features.npy | {kind}": "features that are not what was written are made anew"
        for kind in ("missing", "empty", "truncated", "garbage", "a dangling link", "another *", "objects", "nan")
    },
    **{f"finetune | */features.json | {kind}": "likewise" for kind in ("missing", "a dangling link", "no key")},
    "report | */film.npz | missing": "the report goes without",
    "report | */film.npz | a dangling link": "the report goes without",
    "policy export | */snapshots/* | missing": "a run keeps what snapshots it has",
    "policy export | */snapshots/* | a dangling link": "likewise",
    "policy export | */config.json | *seed*": "nothing reads it, and an export takes longer than the limit",
    "policy train | target_entropy | below": "an entropy may be negative",
    "policy train | stop_at | below": "a return may be",
    "demo | out | a foreign folder": "a folder of runs may hold other things",
    "sweep run | data | missing": "its sets are collected there",
    "sweep run | data | an empty folder": "likewise",
    "sweep run | data | a foreign folder": "likewise",
    "sweep run | grid.toml | truncated": "what is left may be a grid",
    "sweep status | */attempts.jsonl | *": "a line that is not whole is left out; folders say what is finished",
    "sweep run | out | a foreign folder": "a folder of runs may hold other things",
    "evaluate | out | a dangling link": "the link's target is made, as by any program",
    "* | data/*.hdf5 | missing": "a set of fewer shards is a set",
    "data card | */provenance.json | no key": "what it does not say is left out of the card",
    "* | */metrics.jsonl | missing": _LOG,
    "* | */metrics.jsonl | empty": _LOG,
    "* | */metrics.jsonl | truncated": _LOG,
    "* | */metrics.jsonl | a dangling link": _LOG,
}
"""Patterns of titles that are no bad input, and why."""


def file_cases(world: Path) -> Iterator[Case]:
    """Every file that a command reads, damaged in every way; `world` holds the valid ones."""
    for command, words, files in READERS:
        for file in files:
            path = Path(file)
            for kind, damage in {**ANY, **BY_SUFFIX[path.suffix]}.items():
                yield Case(command, file, kind, [*command.split(), *words], partial(damage, path))
            if path.suffix == ".json":
                for kind, damage in each_place(json.loads((world / file).read_text())):
                    yield Case(command, file, kind, [*command.split(), *words], partial(damage, path), may_pass=True)
    for command in CUT:
        yield from _checkpoint_cases(command, world)
    yield from _lock_cases()


def _lock_cases() -> Iterator[Case]:
    """What may lie in a run where its lock and its owner's name will be: no lock stays shut without an owner."""
    folder, words = CUT["pretrain"]
    for name in (".lock", ".owner.json"):
        path = Path(folder, name)
        for kind, damage in {**ANY, **(JSON if path.suffix else {})}.items():
            if kind not in ("missing", "truncated"):
                line = ["pretrain", *words, "--out", folder]
                yield Case("pretrain", str(path), kind, line, partial(_made_then, damage, path), may_pass=True)


def _made_then(damage: Damage, path: Path) -> None:
    path.touch()
    damage(path)


def _checkpoint_cases(command: str, world: Path) -> Iterator[Case]:
    """The newest checkpoint of a cut run, damaged beside an older one, damaged alone, and of another run."""
    folder, more = CUT[command]
    words = [*command.split(), *more, "--out", folder]
    step = max(int(path.name) for path in (world / folder / "checkpoints").iterdir())
    for name in ("manifest.json", "state.json", "state.safetensors"):
        path = Path(folder, "checkpoints", str(step), name)
        for kind, damage in ANY.items():
            goes_on = kind not in ("a folder", "a pipe")
            yield Case(command, str(path), f"{kind}, beside an older one", words, partial(damage, path), warns=goes_on)
        for kind, damage in (ANY | (JSON if name == "manifest.json" else {})).items():
            yield Case(command, str(path), f"{kind}, alone", words, partial(_alone, damage, path))
        of_keys = each_place(json.loads((world / path).read_text())) if path.suffix == ".json" else ()
        if name == "manifest.json":
            for kind, damage in of_keys:
                yield Case(command, str(path), f"{kind}, alone", words, partial(_alone, damage, path))
            continue
        for kind, damage in BY_SUFFIX[path.suffix].items():
            if kind not in ("nan", "inf"):  # with its hash a run has written it, and its end says that it diverged
                yield Case(command, str(path), f"{kind}, with its hash", words, partial(_signed, damage, path))
        for kind, damage in of_keys:
            title = f"{kind}, with its hash"
            yield Case(command, str(path), title, words, partial(_signed, damage, path), may_pass=True)


def _alone(damage: Damage, path: Path) -> None:
    """Damage a checkpoint and drop the older one."""
    for other in set(path.parents[1].iterdir()) - {path.parent}:
        shutil.rmtree(other)
    damage(path)


def _signed(damage: Damage, path: Path) -> None:
    """Damage a checkpoint as if another run had written it so."""
    damage(path)
    manifest = path.with_name("manifest.json")
    record = json.loads(manifest.read_text())
    record["sha256"][path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest.write_text(json.dumps(record))
