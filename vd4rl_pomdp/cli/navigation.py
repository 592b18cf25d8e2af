"""`vd4rl-pomdp navigation`: data, training, grids and reports of the mazes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command, run_stages
from vd4rl_pomdp.cli.parsing import parse, parse_stage, with_presets


def _collect(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.navigation.collect import collect
    from vd4rl_pomdp.navigation.config import PRESETS, MazeCollectConfig

    config = with_presets(MazeCollectConfig, PRESETS, words, program)
    print(f"{len(collect(config))} shards in {config.out}")


def _train(words: Arguments, program: str) -> None:
    from pretrain.navigation.config import NavigationConfig
    from pretrain.navigation.train import train

    run = train(parse_stage(NavigationConfig, words, program))
    print(f"results: {run.path / 'results.json'}")


def _policy(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.navigation.first_person import FirstPersonConfig, train_first_person

    config = parse(FirstPersonConfig, words, program)
    card = train_first_person(config).card
    print(f"{config.out}: {card['goals_in_20_episodes']} goals in 20 episodes")


@dataclass(frozen=True)
class NavigationReportCommand:
    """Write the paper's navigation tables and figures about finished runs."""

    runs: tyro.conf.Positional[list[Path]]
    """Run folders, folders that contain some, or a folder that holds an earlier report's rows.csv."""
    out: Path = Path("navigation-report")
    """Folder of the report."""
    pictures: bool = True
    """Also draw sample observations, which needs OpenGL."""


def _report(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.navigation.report import write_report
    from vd4rl_pomdp.navigation.samples import sample_observations

    command = parse(NavigationReportCommand, words, program)
    samples = sample_observations if command.pictures else None
    print(f"report: {write_report(command.runs, command.out, samples)}")


@dataclass(frozen=True)
class GridCommand:
    """Train all runs of a grid, seed by seed; finished runs are skipped, a cut one goes on."""

    grid: str = "evidence"
    """evidence: all objectives at K=15, and K=1 comparisons; options: self-prediction, noise; paper: every table."""
    mazes: list[str] = field(default_factory=lambda: ["no_curtain", "three_curtains"])
    """Mazes."""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    """Training seeds."""
    preset: str = "cpu"
    """paper, cpu or smoke."""
    data: Path = Path("data")
    """Folder of the mazes' sets, DATA/MAZE."""
    out: Path = Path("runs/navigation")
    """Folder of the runs."""
    dry_run: bool = False
    """Print the commands only."""


def _grid(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.experiments.navigation.grid import grid_commands
    from vd4rl_pomdp.runs.outputs import refuse_kept

    command = parse(GridCommand, words, program)
    refuse_kept(command.out)
    where = (tuple(command.mazes), tuple(command.seeds), command.preset, command.data, command.out)
    for stage in grid_commands(command.grid, *where):
        run_stages([stage], command.dry_run)


COMMANDS = {
    "collect": Command("a maze's data, with true states", _collect),
    "train": Command("an objective on a maze, beside a state probe", _train),
    "policy": Command("train the first-person policy (PPO) that ships", _policy),
    "grid": Command("the runs behind the tables, one after the other", _grid),
    "report": Command("the paper's tables and figures about runs", _report),
}
