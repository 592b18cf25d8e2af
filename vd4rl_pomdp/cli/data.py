"""`vd4rl-pomdp data`: collect, download, describe and check sets."""

from __future__ import annotations

import itertools
import shlex
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.parsing import command, show
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.parsing import parse, parse_stage
from vd4rl_pomdp.sweeps.own_file import program_here

REPLAY_TOLERANCE = 1e-6
"""Largest difference between a stored and a replayed reward; on the machine that collected it is 0."""


def collect(words: list[str], program: str) -> None:
    """Render a set."""
    from vd4rl_pomdp.data.collect import CollectConfig, collect

    config = parse(CollectConfig, words, program)
    shards = collect(config)
    print(f"{len(shards)} shards in {config.out}, described in {config.out / 'card.md'}")
    print(f"check them with `{program_here()} data check {shlex.quote(str(config.out))}`")


@command
def download(
    task: tuple[str, ...],
    quality: tuple[str, ...],
    out: Path = Path("data/vd4rl"),
    endpoint: str | None = None,
    verify: bool = False,
) -> None:
    """Fetch published V-D4RL 84-pixel sets: checked by SHA-256, resumable, each unique file once.

    Args:
        task: walker_walk, cheetah_run or humanoid_walk, or several.
        quality: random, medium_replay, medium, medium_expert or expert, or several: all of every task are fetched.
        out: Folder to keep sets in, as OUT/TASK/QUALITY/84px.
        endpoint: The mirror's address; default: HF_ENDPOINT, else https://huggingface.co.
        verify: Compute the SHA-256 of files that are already there, too.
    """
    from vd4rl_pomdp.data.download import check_published, download

    check_published(task, quality)  # all of them, before hours of downloading the first
    for one, level in itertools.product(task, quality):
        shards = download(one, level, out, endpoint, verify)
        folder = shards[0].parent
        check = f"{program_here()} data check {shlex.quote(str(folder))}"
        print(f"{len(shards)} shards in {folder}; check them with `{check}`")


@command
def import_set(
    format: tyro.conf.Positional[str],
    source: tyro.conf.Positional[str],
    out: tyro.conf.Positional[Path],
    task: str | None = None,
    quality: str | None = None,
    size: int | None = None,
    picture: str | None = None,
    clip_actions: bool = False,
) -> None:
    """Write a set of another format as one of this package's; the same command resumes a cut import.

    Args:
        format: The format's name, as `vd4rl-pomdp list` shows them.
        source: Path or name of the set.
        out: Folder of the new set.
        task: Its task, where the source does not tell; without one of that name here the set trains encoders alone.
        quality: What to call the behaviour that made the data.
        size: Height and width to which pictures are resized, by area; default: their own.
        picture: Which observation holds the pictures, where there are several.
        clip_actions: Clip actions that lie outside the source's bounds instead of refusing them.
    """
    from vd4rl_pomdp.data.transfer import import_set

    shards = import_set(format, source, out, task, quality, size, picture, clip_actions)
    print(f"{len(shards)} shards in {out}, described in {out / 'card.md'}")


@command
def export_set(
    format: tyro.conf.Positional[str],
    set: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    size: int | None = None,
) -> None:
    """Write a set in another format, whole or not at all; what the format cannot keep is said.

    Args:
        format: The format's name, as `vd4rl-pomdp list` shows them.
        set: Folder of shards.
        out: Folder to write.
        size: Height and width to which frames are resized, by area; default: their own.
    """
    from vd4rl_pomdp.data.transfer import export_set

    export_set(format, set, out, size)
    print(f"exported to {out}")


@command
def card(set: tyro.conf.Positional[Path]) -> None:
    """Write a set's data card, card.md and card.png, into its folder; `data collect` does so itself.

    Args:
        set: Folder of shards.
    """
    from vd4rl_pomdp.data.card import write_card

    print(f"card: {write_card(set)}")


def view(words: list[str], program: str) -> None:
    """Write a page to browse episodes."""
    from vd4rl_pomdp.report.browse import ViewConfig, write_view

    print(f"page: {write_view(parse_stage(ViewConfig, words, program))}")


@command
def check(set: tyro.conf.Positional[Path], json: bool = False) -> None:
    """Validate a set: format, episodes, checksums, and that its actions replay to its rewards.

    Args:
        set: Folder of shards.
        json: Print one JSON object.
    """
    from vd4rl_pomdp.data.check import check_dataset

    result = check_dataset(set)
    show(result, json)
    error = result["replay_max_error"]
    if error is not None and error > REPLAY_TOLERANCE:
        raise UserError(
            f"{set}: stored actions do not replay to what is stored (largest difference {error}, where "
            f"{REPLAY_TOLERANCE} would be rounding)"
        )


@command
def parity(set: tyro.conf.Positional[Path | None] = None, json: bool = False) -> None:
    """Compare rendered canary frames with golden ones, and a data set's background with the environment's.

    Args:
        set: A data set, whose background decides; without one the canaries do.
        json: Print one JSON object.
    """
    from vd4rl_pomdp.data.parity import check_parity

    result = check_parity(set)
    show(result, json)
    if not result["equal"] and set:
        raise UserError(f"the environment shows another background than {set}: see `background` above")
    if not result["equal"]:
        raise UserError(
            f"{result['render']['gl_renderer']} draws other pixels than the golden frames' software renderer did: name "
            "a set, to see whether they are its own"
        )
