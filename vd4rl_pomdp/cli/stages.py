"""The stages of an experiment; the demo runs them all: pretrain, finetune, evaluate, demo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command, run_stage
from vd4rl_pomdp.cli.parsing import parse, parse_stage, show
from vd4rl_pomdp.runs import EPISODES_FILE


def _pretrain(words: Arguments, program: str) -> None:
    from pretrain.config import PretrainConfig
    from pretrain.train import pretrain

    run = pretrain(parse_stage(PretrainConfig, words, program))
    print(f"encoder: {run.path / 'encoder'}")


def _finetune(words: Arguments, program: str) -> None:
    from finetune.config import FinetuneConfig
    from finetune.train import finetune

    run = finetune(parse_stage(FinetuneConfig, words, program))
    print(f"episodes: {run.path / EPISODES_FILE}")


@dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate a fine-tuned run again, as it was trained and under no corruption, or under a given one alone."""

    run: tyro.conf.Positional[Path]
    """A fine-tuning run's folder."""
    corruption: str | None = None
    """Corruption at evaluation, with the run's own options (a patch's size) where it reads them; default: the one that
    it was trained under, and then none, which takes as long again."""
    episodes: int = 10
    """Episodes under each corruption."""
    parts: int = 1
    """Also tell reward and action error in so many equal parts of the episodes: when a policy loses its way."""
    workers: int = 0
    """Processes; 0 uses every core."""
    out: Path | None = None
    """Append the raw rows to this CSV file."""
    json: bool = False
    """Print one JSON object."""


def _evaluate(words: Arguments, program: str) -> None:
    from finetune.evaluation import by_part, evaluate_run
    from vd4rl_pomdp.core.errors import refuse_number
    from vd4rl_pomdp.core.settings import LABELS
    from vd4rl_pomdp.data.reference import Reference, summarise
    from vd4rl_pomdp.runs.episodes import append_episodes, begin_episodes
    from vd4rl_pomdp.runs.files import flatten
    from vd4rl_pomdp.runs.outputs import refuse_inside

    command = parse(EvaluateCommand, words, program)
    refuse_number("parts", command.parts, 1)
    if command.out is not None:
        refuse_inside(command.out)
        begin_episodes(command.out)  # before any episode is played
    rows, episodes = evaluate_run(command.run, command.corruption, command.episodes, command.workers)
    if command.out is not None:
        append_episodes(command.out, rows)
    reference = Reference.read(command.run)
    labels = {k: rows[0][k] for k in (*LABELS, "step")}
    known = {"data_return": reference.data_return, "path_error": reference.path_error}
    under: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(row["evaluated_under"] for row in rows):
        mine = [row for row in rows if row["evaluated_under"] == name]
        under[name] = summarise(mine, reference) | {"episodes": mine if command.json else len(mine)}
        if command.parts > 1:
            under[name]["parts"] = by_part([e for e in episodes if e.evaluated_under == name], command.parts)
    result = labels | known | {"under": under}
    told = {name: "unknown" if value is None else value for name, value in flatten(result).items()}
    show(result if command.json else told, command.json)


@dataclass(frozen=True)
class DemoCommand:
    """Every stage, in minutes: three methods on a small walker_walk set, two in a maze; a table, a report, a film."""

    out: Path = Path("runs/demo")
    """Folder of the demo's data and runs; re-run the same command to resume."""
    jobs: int = 0
    """Commands at a time; 0: as many as the GPUs take, or one a core, up to 4."""
    preset: str = "cpu"
    """cpu: minutes; smoke: only that every stage runs."""


def _demo(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.cli.demo import demo
    from vd4rl_pomdp.cli.sweeps import carry_out

    command = parse(DemoCommand, words, program)
    demo(command.out, command.jobs, command.preset, carry_out, run_stage)


DEMO = Command("every stage on a small set, in minutes", _demo)
COMMANDS = {
    "pretrain": Command("train an encoder", _pretrain),
    "finetune": Command("train a policy on a frozen encoder, by TD3+BC or another algorithm", _finetune),
    "evaluate": Command("evaluate a fine-tuned run again", _evaluate),
}
