"""`vd4rl-pomdp data`: collect, download, describe and check datasets."""

from __future__ import annotations

import itertools
import shlex
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.parsing import command, parse, parse_stage, show
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.sweeps.options import program_name

REPLAY_TOLERANCE = 1e-6
"""Largest accepted difference between stored and replayed rewards; 0 on the machine that collected them."""


def collect(words: list[str], program: str) -> None:
    """Collect a dataset."""
    from vd4rl_pomdp.data import collect as collection

    config = parse(collection.CollectConfig, words, program)
    shards = collection.collect(config)
    print(f"shards in {config.out}: {len(shards)}, described in {config.out / 'card.md'}")
    print(f"check them with `{program_name()} data check {shlex.quote(str(config.out))}`")


@command
def download(
    task: tuple[str, ...],
    quality: tuple[str, ...],
    out: Path = Path("data/vd4rl"),
    endpoint: str | None = None,
    verify: bool = False,
) -> None:
    """Download published V-D4RL 84-pixel datasets: checked by SHA-256, resumable, each unique file once.

    Args:
        task: One or more of walker_walk, cheetah_run, humanoid_walk.
        quality: One or more of random, medium_replay, medium, medium_expert, expert, for every task.
        out: Folder for datasets: OUT/TASK/QUALITY/84px.
        endpoint: Address of a mirror; default: HF_ENDPOINT, else https://huggingface.co.
        verify: Also check the SHA-256 of files that exist already.
    """
    from vd4rl_pomdp.data import download as published

    published.check_published(task, quality)  # reject unknown names before the first download, which takes hours
    for one, level in itertools.product(task, quality):
        shards = published.download(one, level, out, endpoint, verify)
        folder = shards[0].parent
        check = f"{program_name()} data check {shlex.quote(str(folder))}"
        print(f"shards in {folder}: {len(shards)}; check them with `{check}`")


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
    shortest: int = 1,
) -> None:
    """Convert a dataset from another format; re-run the same command to resume.

    Args:
        format: Name of the format, as in `vd4rl-pomdp list`.
        source: Path or name of the dataset.
        out: Folder of the new dataset.
        task: Its task, if the source does not name one; an unregistered one needs `finetune --eval-episodes 0`.
        quality: Name of the behaviour that made the data.
        size: Height and width to resize images to, by area; default: no resizing.
        picture: Observation key of the images, if there are several.
        clip_actions: Clip actions outside the source's bounds instead of rejecting them.
        shortest: Leave out episodes of fewer rows.
    """
    from vd4rl_pomdp.data import transfer

    shards = transfer.import_set(format, source, out, task, quality, size, picture, clip_actions, shortest)
    print(f"shards in {out}: {len(shards)}, described in {out / 'card.md'}")


@command
def export_set(
    format: tyro.conf.Positional[str],
    set: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    size: int | None = None,
) -> None:
    """Convert a dataset to another format, atomically; prints what the format cannot keep.

    Args:
        format: Name of the format, as in `vd4rl-pomdp list`.
        set: Dataset folder.
        out: Output folder.
        size: Height and width to resize frames to, by area; default: no resizing.
    """
    from vd4rl_pomdp.data import transfer

    transfer.export_set(format, set, out, size)
    print(f"exported to {out}")


@command
def card(set: tyro.conf.Positional[Path]) -> None:
    """Write a dataset's data card, card.md and card.png, into its folder. `data collect` also writes it.

    Args:
        set: Dataset folder.
    """
    from vd4rl_pomdp.data.card import write_card

    print(f"card: {write_card(set)}")


def view(words: list[str], program: str) -> None:
    """Write an HTML page to browse episodes."""
    from vd4rl_pomdp.report.browse import ViewConfig, write_view

    print(f"page: {write_view(parse_stage(ViewConfig, words, program))}")


@command
def check(set: tyro.conf.Positional[Path], json: bool = False) -> None:
    """Validate a dataset: format, episodes, checksums, and that its actions replay to its rewards.

    Args:
        set: Dataset folder.
        json: Print one JSON object.
    """
    from vd4rl_pomdp.data.check import check_dataset

    result = check_dataset(set)
    show(result, json)
    error = result["replay_max_error"]
    if error is not None and not error <= REPLAY_TOLERANCE:  # also NaN
        raise UserError(
            f"{set}: replaying the stored actions does not give the stored values (largest difference {error}, "
            f"tolerance {REPLAY_TOLERANCE})"
        )


@command
def parity(set: tyro.conf.Positional[Path | None] = None, json: bool = False) -> None:
    """Compare rendered reference frames with stored ones, and a dataset's background with the environment's.

    Args:
        set: Compare this dataset's background; without it, the reference frames are compared.
        json: Print one JSON object.
    """
    from vd4rl_pomdp.data.parity import check_parity

    result = check_parity(set)
    show(result, json)
    if not result["equal"] and set:
        raise UserError(f"the environment's background differs from that of {set}: see `background` above")
    if not result["equal"]:
        raise UserError(
            f"{result['render']['gl_renderer']} renders different pixels from the reference frames' software "
            "renderer: pass a dataset to compare with its background instead"
        )
