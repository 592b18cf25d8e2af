"""The stages of an experiment, and the commands that run several: pretrain, finetune, evaluate, sweep, demo."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command, run_stage, run_stages
from vd4rl_pomdp.cli.parsing import parse, parse_stage, show

if TYPE_CHECKING:
    from finetune.config import FinetuneConfig
    from pretrain.config import PretrainConfig


def _pretrain_config(words: Arguments, program: str) -> PretrainConfig:
    from pretrain.config import PretrainConfig

    return parse_stage(PretrainConfig, words, program)


def _pretrain(words: Arguments, program: str) -> None:
    from pretrain.train import pretrain

    run = pretrain(_pretrain_config(words, program))
    print(f"encoder: {run.path / 'encoder'}")


def _finetune_config(words: Arguments, program: str) -> FinetuneConfig:
    from finetune.config import FinetuneConfig

    return parse_stage(FinetuneConfig, words, program)


def _finetune(words: Arguments, program: str) -> None:
    from finetune.train import finetune

    run = finetune(_finetune_config(words, program))
    print(f"episodes: {run.path / 'episodes.csv'}")


@dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate a fine-tuned run again, as it was trained and under no corruption, or under a given one alone."""

    run: tyro.conf.Positional[Path]
    """A fine-tuning run's folder."""
    corruption: str | None = None
    """Corruption at evaluation; default: the one it was trained under, and then none, which takes as long again."""
    episodes: int = 10
    """Episodes under each corruption."""
    workers: int = 0
    """Processes; 0 uses every core."""
    out: Path | None = None
    """Append the raw rows to this CSV file."""
    json: bool = False
    """Print one JSON object."""


def _evaluate(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.evaluation import append_episodes, begin_episodes, evaluate_run, summarise
    from vd4rl_pomdp.reference import Reference
    from vd4rl_pomdp.runs.files import flatten
    from vd4rl_pomdp.runs.outputs import refuse_inside

    command = parse(EvaluateCommand, words, program)
    if command.out is not None:
        refuse_inside(command.out)
        begin_episodes(command.out)  # before any episode is played
    rows = evaluate_run(command.run, command.corruption, command.episodes, command.workers)
    if command.out is not None:
        append_episodes(command.out, rows)
    reference = Reference.read(command.run)
    labels = {k: rows[0][k] for k in ("method", "task", "quality", "corruption", "algorithm", "seed", "step")}
    known = {"data_return": reference.data_return, "path_error": reference.path_error}
    under = {}
    for name in dict.fromkeys(row["evaluated_under"] for row in rows):
        mine = [row for row in rows if row["evaluated_under"] == name]
        under[name] = summarise(mine, reference) | {"episodes": mine if command.json else len(mine)}
    result = labels | known | {"under": under}
    told = {name: "unknown" if value is None else value for name, value in flatten(result).items()}
    show(result if command.json else told, command.json)


@dataclass(frozen=True)
class SweepCommand:
    """Run methods x seeds through pretraining and fine-tuning, one after the other; finished runs are skipped."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the runs: OUT/METHOD/CORRUPTION/seedN/{pretrain,finetune-ALGORITHM}."""
    methods: list[str] = field(default_factory=lambda: ["mik+a", "acro", "random"])
    """Pretraining methods."""
    corruptions: list[str] = field(default_factory=lambda: ["patch+zero_frames"])
    """Corruptions."""
    algorithms: list[str] = field(default_factory=lambda: ["td3_bc"])
    """Fine-tuning algorithms."""
    seeds: list[int] = field(default_factory=lambda: [0])
    """Training seeds."""
    preset: str = "paper"
    """paper, cpu or smoke."""
    pretrain: str = ""
    """More flags for every pretraining, with an equals sign: --pretrain="--steps 1000 --shift 0"."""
    finetune: str = ""
    """More flags for every fine-tuning, likewise."""
    dry_run: bool = False
    """Print the commands only, one line a run, which other machines or a cluster's queue can take in any order."""


def _sweep(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.runs.outputs import refuse_kept
    from vd4rl_pomdp.runs.sweep import sweep_runs

    command = parse(SweepCommand, words, program)
    runs = list(sweep_runs(command))
    _check(runs)
    refuse_kept(command.out)
    for run in runs:
        run_stages(run, command.dry_run)


def _check(runs: list[list[Arguments]]) -> None:
    """Raise UserError for settings that a stage would refuse, before the first run and not hours later."""
    from finetune.train import check_end_to_end
    from pretrain.objectives import METHODS
    from pretrain.train import check_config

    for (_, *first), *others in runs:
        config = _pretrain_config(first, "vd4rl-pomdp pretrain")
        check_config(config)
        for _, *words in others:
            finetuning = _finetune_config(words, "vd4rl-pomdp finetune")
            if algorithm := METHODS.named(config.method).end_to_end:
                check_end_to_end(finetuning, algorithm)


@dataclass(frozen=True)
class DemoCommand:
    """Every stage on a small walker_walk set with real rendering, in minutes, ending with a table and a report."""

    out: Path = Path("runs/demo")
    """Folder of the demo's data and runs; the same command continues where it was cut."""
    workers: int = 0
    """Processes; 0 uses every core."""
    preset: str = "cpu"
    """cpu: minutes; smoke: only that every stage runs."""


def _demo(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.demo import demo

    command = parse(DemoCommand, words, program)
    demo(command.out, command.workers, command.preset, run_stage)


DEMO = Command("every stage on a small set, in minutes", _demo)
COMMANDS = {
    "pretrain": Command("train an encoder", _pretrain),
    "finetune": Command("train a policy on a frozen encoder, by TD3+BC or another algorithm", _finetune),
    "evaluate": Command("evaluate a fine-tuned run again", _evaluate),
}
SWEEP = Command("methods x corruptions x seeds", _sweep)
