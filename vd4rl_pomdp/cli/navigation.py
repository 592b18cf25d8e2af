"""Commands of the navigation study."""

from __future__ import annotations

from pathlib import Path

import tyro

from vd4rl_pomdp.cli.parsing import command, parse, parse_stage
from vd4rl_pomdp.cli.report import named
from vd4rl_pomdp.runs import NAVIGATION_FILE
from vd4rl_pomdp.studies.navigation import collect as mazes
from vd4rl_pomdp.studies.navigation import train as objectives
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.report import write_report


def collect(words: list[str], program: str) -> None:
    """Collect a maze's data."""
    config = parse_stage(mazes.MazeCollectConfig, words, program)
    print(f"shards in {config.out}: {len(mazes.collect(config))}")


def train(words: list[str], program: str) -> None:
    """Train an objective on a maze."""
    run = objectives.train(parse_stage(NavigationConfig, words, program))
    print(f"results: {run.path / NAVIGATION_FILE}")


def policy(words: list[str], program: str) -> None:
    """Train the policy that collects the first-person maze's data."""
    from vd4rl_pomdp.studies.navigation.drivers import FirstPersonConfig, train_first_person  # an extra

    config = parse(FirstPersonConfig, words, program)
    card = train_first_person(config).card
    print(f"{config.out}: {card['goals_in_20_episodes']} goals in 20 episodes")


@command
def report(
    runs: tyro.conf.Positional[list[Path]], out: Path = Path("navigation-report"), pictures: bool = True
) -> None:
    """Write the paper's navigation tables and figures for finished runs.

    Args:
        runs: Run folders, results folders, or folders that contain some.
        out: Folder of the report.
        pictures: Also draw sample observations, which needs OpenGL.
    """
    print(f"report: {write_report(named(runs), out, mazes.sample_observations if pictures else None)}")
