"""`vd4rl-pomdp navigation`: data, training and reports of the mazes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command
from vd4rl_pomdp.cli.parsing import parse, parse_stage, with_presets
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs import NAVIGATION_FILE

if TYPE_CHECKING:
    import numpy as np


def _collect(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.studies.navigation.collect import PRESETS, MazeCollectConfig, collect

    config = with_presets(MazeCollectConfig, PRESETS, words, program)
    print(f"{len(collect(config))} shards in {config.out}")


def _train(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.studies.navigation.config import NavigationConfig
    from vd4rl_pomdp.studies.navigation.train import train

    run = train(parse_stage(NavigationConfig, words, program))
    print(f"results: {run.path / NAVIGATION_FILE}")


def _policy(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.studies.navigation.drivers import FirstPersonConfig, train_first_person

    config = parse(FirstPersonConfig, words, program)
    card = train_first_person(config).card
    print(f"{config.out}: {card['goals_in_20_episodes']} goals in 20 episodes")


@dataclass(frozen=True)
class NavigationReportCommand:
    """Write the paper's navigation tables and figures about finished runs."""

    runs: tyro.conf.Positional[list[Path]]
    """Run folders, results folders, or folders that contain some."""
    out: Path = Path("navigation-report")
    """Folder of the report."""
    pictures: bool = True
    """Also draw sample observations, which needs OpenGL."""


def _report(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.studies.navigation.report import write_report

    command = parse(NavigationReportCommand, words, program)
    samples = _samples if command.pictures else None
    print(f"report: {write_report(command.runs, command.out, samples)}")


def _samples() -> Mapping[str, np.ndarray]:
    """The sample observations; UserError that names the flag to do without where nothing can be drawn."""
    from vd4rl_pomdp.studies.navigation.collect import sample_observations

    try:
        return sample_observations()
    except UserError as error:
        raise type(error)(f"{error}; --no-pictures leaves the sample observations out") from error


COMMANDS = {
    "collect": Command("a maze's data, with true states", _collect),
    "train": Command("an objective on a maze, beside a state probe", _train),
    "policy": Command("train the first-person policy (PPO) that ships", _policy),
    "report": Command("the paper's tables and figures about runs", _report),
}
