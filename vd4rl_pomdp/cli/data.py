"""`vd4rl-pomdp data`: collect, download, describe and check sets."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command
from vd4rl_pomdp.cli.parsing import parse, show
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.sweeps.own_file import program_here

REPLAY_TOLERANCE = 1e-6
"""Largest difference between a stored and a replayed reward; on the machine that collected it is 0."""


def _check_of(folder: Path) -> str:
    return f"{program_here()} data check {shlex.quote(str(folder))}"


def _collect(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.collect import CollectConfig, collect

    config = parse(CollectConfig, words, program)
    shards = collect(config)
    print(f"{len(shards)} shards in {config.out}, described in {config.out / 'card.md'}")
    print(f"check them with `{_check_of(config.out)}`")


@dataclass(frozen=True)
class DownloadCommand:
    """Fetch published V-D4RL 84-pixel sets: checked by SHA-256, resumable, each unique file once."""

    task: str
    """walker_walk, cheetah_run or humanoid_walk."""
    quality: str
    """random, medium_replay, medium, medium_expert or expert."""
    out: Path = Path("data/vd4rl")
    """Folder to keep sets in, as OUT/TASK/QUALITY/84px."""
    endpoint: str | None = None
    """The mirror's address; default: HF_ENDPOINT, else https://huggingface.co."""
    verify: bool = False
    """Compute the SHA-256 of files that are already there, too."""


def _download(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.download import download

    command = parse(DownloadCommand, words, program)
    shards = download(command.task, command.quality, command.out, command.endpoint, command.verify)
    print(f"{len(shards)} shards in {shards[0].parent}; check them with `{_check_of(shards[0].parent)}`")


@dataclass(frozen=True)
class CardCommand:
    """Write a set's data card, card.md and card.png, into its folder; `data collect` does so itself."""

    path: tyro.conf.Positional[Path]
    """Folder of shards."""


def _card(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.card import write_card

    print(f"card: {write_card(parse(CardCommand, words, program).path)}")


def _names(table: str) -> list[str]:
    """Names in a table of the module `tasks`, which is imported here because it needs numpy, slow to load."""
    from vd4rl_pomdp.core import tasks

    return list(getattr(tasks, table))


@dataclass(frozen=True)
class TableCommand:
    """Tabulate all sets: returns of their 200 episodes, played by physics alone, and what collecting them costs."""

    out: Path = Path("results/datasets")
    """Folder of the table; sets that are in it already, by the same actors, are not played again."""
    tasks: list[str] = field(default_factory=lambda: _names("TASKS"))
    """Tasks."""
    qualities: list[str] = field(default_factory=lambda: _names("SET_QUALITIES"))
    """Qualities; one whose actor does not ship is left out."""
    timed_episodes: int = 4
    """Episodes of the short rendered collection that is timed for each task."""
    workers: int = 0
    """Processes that play; 0 uses every core."""


def _table(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.table import tabulate

    command = parse(TableCommand, words, program)
    rows = tabulate(command.out, command.tasks, command.qualities, command.timed_episodes, command.workers)
    for row in rows:
        print("  ".join(f"{value!s:<14}" for value in row.values()).rstrip())
    print(f"table: {command.out / 'sets.csv'}")


@dataclass(frozen=True)
class CheckCommand:
    """Validate a set: format, episodes, checksums, and that its actions replay to its rewards."""

    path: tyro.conf.Positional[Path]
    """Folder of shards."""
    json: bool = False
    """Print one JSON object."""


def _check(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.check import check_dataset

    command = parse(CheckCommand, words, program)
    result = check_dataset(command.path)
    show(result, command.json)
    error = result["replay_max_error"]
    if error is not None and error > REPLAY_TOLERANCE:
        raise UserError(
            f"{command.path}: stored actions do not replay to what is stored (largest difference {error}, where "
            f"{REPLAY_TOLERANCE} would be rounding)"
        )


@dataclass(frozen=True)
class ParityCommand:
    """Compare rendered canary frames with golden ones, and a data set's background with the environment's."""

    path: tyro.conf.Positional[Path | None] = None
    """A data set, whose background decides; without one the canaries do."""
    json: bool = False
    """Print one JSON object."""


def _parity(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.data.parity import check_parity

    command = parse(ParityCommand, words, program)
    result = check_parity(command.path)
    show(result, command.json)
    if not result["equal"] and command.path:
        raise UserError(f"the environment shows another background than {command.path}: see `background` above")
    if not result["equal"]:
        raise UserError(
            f"{result['render']['gl_renderer']} draws other pixels than the golden frames' software renderer did: name "
            "a set, to see whether they are its own"
        )


COMMANDS = {
    "collect": Command("render a set in V-D4RL's format from the shipped actors", _collect),
    "download": Command("fetch a published V-D4RL set", _download),
    "card": Command("describe a set: returns, origin, film strip", _card),
    "table": Command("tabulate the returns and the cost of all sets", _table),
    "check": Command("validate a set and replay its actions", _check),
    "parity": Command("compare rendered pixels with the data's", _parity),
}
