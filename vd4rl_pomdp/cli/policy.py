"""`vd4rl-pomdp policy`: the state-based actors that collect data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command
from vd4rl_pomdp.cli.parsing import parse, with_presets
from vd4rl_pomdp.core.errors import UserError


def _train(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.policies.config import PolicyConfig, recipes
    from vd4rl_pomdp.policies.train import decisions_made, train_policy
    from vd4rl_pomdp.runs.progress import ProgressLine

    if not any(word.split("=")[0] in ("--task", "--help", "-h") for word in words):
        raise UserError("--task is missing: name one of dm_control's tasks; `vd4rl-pomdp list` shows all")
    config = with_presets(PolicyConfig, recipes(), words, program, flag="--task")
    done = decisions_made(config.out)
    with ProgressLine(f"train {config.task}", config.decisions, "decisions", done) as progress:
        files = train_policy(config, lambda decisions, mean: progress.reach(decisions, ret=mean))
    for quality, path in files.items():
        print(f"{quality}: {path}")


@dataclass(frozen=True)
class ExportCommand:
    """Choose a run's expert, medium and medium_replay actors and write them with their cards; it may still go on."""

    run: tyro.conf.Positional[Path]
    """Folder of a policy training run."""
    out: Path
    """Folder for the files."""


def _export(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.policies.export import export_run

    command = parse(ExportCommand, words, program)
    for quality, path in export_run(command.run, command.out).items():
        print(f"{quality}: {path}")


COMMANDS = {
    "train": Command("train the state-based actors that collect data", _train),
    "export": Command("choose a run's actors and write them with their cards", _export),
}
