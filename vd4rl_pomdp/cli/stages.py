"""Commands of the experiment stages: pretrain, finetune, evaluate; and `list`."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

import vd4rl_pomdp.data.formats  # noqa: F401 (registers the formats)
from finetune.config import FinetuneConfig
from pretrain import train as pretraining
from pretrain.config import PretrainConfig
from vd4rl_pomdp.cli.parsing import chosen_by, command, parse, parse_stage, refuse_repeated, show
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_number
from vd4rl_pomdp.core.options import LABELS, Options, flat
from vd4rl_pomdp.core.registry import REGISTRIES
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.reference import Reference, summarise
from vd4rl_pomdp.nn.encoder_folder import read_record
from vd4rl_pomdp.runs import EPISODES_FILE
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes
from vd4rl_pomdp.runs.files import flatten, groups
from vd4rl_pomdp.runs.outputs import refuse_inside


def pretrain(words: list[str], program: str) -> None:
    """Train an encoder."""
    run = pretraining.pretrain(parse_stage(PretrainConfig, words, program))
    print(f"encoder: {run.path / 'encoder'}")


def finetune(words: list[str], program: str) -> None:
    """Train a policy, or a stack of several: WORDS + WORDS, or one per seed of `--seeds`."""
    from finetune.train import finetune_all  # loads OpenGL

    parts: list[list[str]] = [[]]
    for word in words:
        if word == "+":
            parts.append([])
        else:
            parts[-1].append(word)
    runs = [run for part in parts for run in _of_seeds(part)]
    configs = [parse_stage(FinetuneConfig, run, program) for run in runs]
    for done in finetune_all(configs, runs if len(runs) > 1 else None):
        print(f"episodes: {done.path / EPISODES_FILE}")


def _of_seeds(words: list[str]) -> list[list[str]]:
    """One list of words per seed of `--seeds`, with `--seed N --out OUT/seedN`; without the flag, the words as
    given."""
    reader = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in ("--seeds", "--seed", "--out"):
        reader.add_argument(flag, nargs="?", const="")
    given, rest = reader.parse_known_args(words)
    if given.seeds is None:
        return [words]
    refuse_repeated("--seeds", words)
    seeds = given.seeds.split(",")
    if not all(seed.isdecimal() for seed in seeds) or len(set(seeds)) < len(seeds):
        raise UserError(f"--seeds is {given.seeds!r}: give different whole numbers, as in --seeds 0,1,2")
    if given.seed is not None:
        raise UserError("--seed and --seeds are both given: leave one out")
    if not given.out:
        raise UserError("--seeds needs --out OUT: its runs are OUT/seed0 and so on")
    out = Path(os.path.expanduser(given.out))  # as `parse` does in --out=~/runs, which no shell expands
    return [[*rest, "--seed", seed, "--out", str(out / f"seed{seed}")] for seed in seeds]


@dataclass(frozen=True)
class Evaluation:
    """Evaluate a fine-tuned run again, as trained and uncorrupted, or under one --corruption (named before --help)."""

    run: tyro.conf.Positional[Path]
    """Folder of a fine-tuning run."""
    corruption: str | None = None
    """Corruption at evaluation; its options default to the run's own. Default: the training corruption, then none."""
    stages: tuple[Options, ...] = ()
    """Options of the corruption."""
    episodes: int = 10
    """Episodes per corruption."""
    parts: int = 1
    """Also report reward and action error for this many equal parts of an episode."""
    workers: int = 0
    """Worker processes; 0 uses every core."""
    out: Path | None = None
    """Append the raw rows to this CSV file."""
    keep: bool = False
    """Append the rows under the given corruption to the run's own episodes.csv, where reports find them."""
    json: bool = False
    """Print one JSON object."""


def evaluate(words: list[str], program: str) -> None:
    """Evaluate a fine-tuned run again, as trained and without corruption, or under a given corruption only."""
    from finetune.evaluation import another, by_part, evaluate_run, refuse_kept  # loads OpenGL

    name = chosen_by(words, ["corruption"]).get("corruption")

    def parsed(trained: dict[str, Any]) -> Evaluation:
        """Settings; options of the corruption that are not given default to those in training."""
        stages = CorruptionConfig.fill(trained | {"corruption": name}).stages if name else ()
        evaluation: Evaluation = parse(Evaluation, words, program, Evaluation(tyro.MISSING, name, stages))
        return evaluation

    config = parsed({})
    run, out, parts = config.run, config.out, config.parts
    refuse_number("parts", parts, 1)
    has_rows = bool(read_episodes(run / EPISODES_FILE))  # a folder without a run is rejected below
    trained = read_record(run / "encoder").pretrain.corruption if has_rows else {}
    config = parsed(trained)
    if out is not None:
        refuse_inside(out)
        if has_rows:
            append_episodes(out, [])  # fail before playing if the file cannot be written
    options = {option: value for stage in config.stages for option, value in flat(stage).items()}
    if config.keep and config.corruption is None:
        raise UserError("--keep needs --corruption: a run's own evaluations are kept already")
    if config.keep and has_rows:
        refuse_kept(run, another(trained, config.corruption or "", options)[1])
    rows, played = evaluate_run(run, config.corruption, config.episodes, config.workers, **options)
    if config.keep:
        refuse_kept(run, rows[0]["evaluated_under"])  # again: another process may have kept the same meanwhile
    for file in [*([out] if out else []), *([run / EPISODES_FILE] if config.keep else [])]:
        append_episodes(file, rows)
    reference = Reference.read(run)
    result: dict[str, Any] = {label: rows[0][label] for label in (*LABELS, "step")}
    result |= {"data_return": reference.data_return, "path_error": reference.path_error, "under": {}}
    for under, mine in groups(rows, lambda row: row["evaluated_under"]).items():
        result["under"][under] = summarise(mine, reference) | {"episodes": mine if config.json else len(mine)}
        if parts > 1:
            result["under"][under]["parts"] = by_part([e for e in played if e.evaluated_under == under], parts)
    if not config.json:
        result = {label: "unknown" if value is None else value for label, value in flatten(result).items()}
    show(result, config.json)


@command
def list_parts() -> None:
    """List methods, corruptions, algorithms, frame encoders, memories, tasks and formats, one line each."""
    for setting, registry in sorted(REGISTRIES.items()):
        print(f"{flag_of(setting)}   (entry point group {registry.group})")
        width = max(map(len, [*registry, *registry.broken]))
        for name, part in registry.items():
            origin = f"   [{registry.origin(name)}]" if registry.origin(name) else ""
            text = getattr(part, "summary", "") or getattr(part, "build", part).__doc__ or ""
            line = text.strip().partition("\n")[0].removesuffix(".")
            print(f"  {name:<{width}}  {line}{origin}".rstrip())
        for name, reason in registry.broken.items():
            print(f"  {name:<{width}}  cannot be loaded: {reason}")
        print()
