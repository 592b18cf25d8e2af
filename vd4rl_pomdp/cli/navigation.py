"""Commands of the navigation study."""

from __future__ import annotations

from pathlib import Path

import tyro

from vd4rl_pomdp.cli.parsing import command, parse, parse_stage
from vd4rl_pomdp.runs import NAVIGATION_FILE


def collect(words: list[str], program: str) -> None:
    """Collect a maze's data."""
    from vd4rl_pomdp.studies.navigation import collect as mazes

    chosen = parse_stage(mazes.MazeCollectConfig, words, program)
    print(f"shards in {chosen.out}: {len(mazes.collect(chosen))}")


def train(words: list[str], program: str) -> None:
    """Train an objective on a maze."""
    from vd4rl_pomdp.studies.navigation import train as objectives
    from vd4rl_pomdp.studies.navigation.config import NavigationConfig

    run = objectives.train(parse_stage(NavigationConfig, words, program))
    print(f"results: {run.path / NAVIGATION_FILE}")


def policy(words: list[str], program: str) -> None:
    """Train the policy that collects the first-person maze's data."""
    from vd4rl_pomdp.studies.navigation.drivers import FirstPersonConfig, train_first_person

    chosen = parse(FirstPersonConfig, words, program)
    card = train_first_person(chosen).card
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
    from vd4rl_pomdp.studies.navigation.collect import sample_observations
    from vd4rl_pomdp.studies.navigation.report import write_report

    print(f"report: {write_report(runs, out, sample_observations if pictures else None)}")
