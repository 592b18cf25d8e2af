"""Commands of the navigation study."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from vd4rl_pomdp.cli.later import Later
from vd4rl_pomdp.cli.parsing import command, parse, parse_stage
from vd4rl_pomdp.runs import NAVIGATION_FILE

if TYPE_CHECKING:
    from vd4rl_pomdp.studies.navigation import collect as mazes
    from vd4rl_pomdp.studies.navigation import config, drivers
    from vd4rl_pomdp.studies.navigation import report as reporting
    from vd4rl_pomdp.studies.navigation import train as objectives
else:
    mazes = Later("vd4rl_pomdp.studies.navigation.collect")
    config = Later("vd4rl_pomdp.studies.navigation.config")
    drivers = Later("vd4rl_pomdp.studies.navigation.drivers")
    reporting = Later("vd4rl_pomdp.studies.navigation.report")
    objectives = Later("vd4rl_pomdp.studies.navigation.train")


def collect(words: list[str], program: str) -> None:
    """Collect a maze's data."""
    chosen = parse_stage(mazes.MazeCollectConfig, words, program)
    print(f"shards in {chosen.out}: {len(mazes.collect(chosen))}")


def train(words: list[str], program: str) -> None:
    """Train an objective on a maze."""
    run = objectives.train(parse_stage(config.NavigationConfig, words, program))
    print(f"results: {run.path / NAVIGATION_FILE}")


def policy(words: list[str], program: str) -> None:
    """Train the policy that collects the first-person maze's data."""
    chosen = parse(drivers.FirstPersonConfig, words, program)
    card = drivers.train_first_person(chosen).card
    print(f"{chosen.out}: {card['goals_in_20_episodes']} goals in 20 episodes")


@command
def report(
    runs: tyro.conf.Positional[list[Path]], out: Path = Path("navigation-report"), pictures: bool = True
) -> None:
    """Write the paper's navigation tables and figures for finished runs.

    Args:
        runs: One or more run folders, results folders, or folders that contain some.
        out: Folder of the report.
        pictures: Also draw sample observations, which needs OpenGL.
    """
    print(f"report: {reporting.write_report(runs, out, mazes.sample_observations if pictures else None)}")
