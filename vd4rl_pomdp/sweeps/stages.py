"""What a sweep knows about each stage: its command, its settings, and how a run records them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

from finetune.config import FinetuneConfig, as_trained
from pretrain.config import PretrainConfig, history_of
from pretrain.objectives import METHODS
from vd4rl_pomdp.cli.parsing import parse, parse_stage
from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_number
from vd4rl_pomdp.core.options import StageConfig, flat, settings_of, words_of
from vd4rl_pomdp.core.tasks import SET_QUALITIES
from vd4rl_pomdp.data.collect import CollectConfig, collection
from vd4rl_pomdp.runs import FORMAT
from vd4rl_pomdp.runs.files import jsonable
from vd4rl_pomdp.runs.run import recipe
from vd4rl_pomdp.studies.navigation.collect import MazeCollectConfig
from vd4rl_pomdp.studies.navigation.collect import collection as maze_collection
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.sweeps.grid import GridCell, Values

COMMANDS = {
    "collect": ("data", "collect"),
    "pretrain": ("pretrain",),
    "finetune": ("finetune",),
    "navigation_collect": ("navigation", "collect"),
    "navigation_train": ("navigation", "train"),
}
"""Command by section."""
STAGES = {"pretrain": "pretrain", "finetune": "finetune", "navigation_train": "navigation"}
"""Stage name in a training's record, by section."""
_CONFIGS: dict[str, type[StageConfig]] = {
    "pretrain": PretrainConfig,
    "finetune": FinetuneConfig,
    "navigation_collect": MazeCollectConfig,
    "navigation_train": NavigationConfig,
}
_READS = {"pretrain": ("data",), "finetune": ("data", "encoder"), "navigation_train": ("data",)}
"""Input folders of each stage."""
_TAKES = {"collect": (), "navigation_collect": ("preset",)}
"""Shared settings that a stage accepts, if not all of them."""


def stage_settings(cell: GridCell, section: str) -> Values:
    """A cell's settings for a stage, in command-line order."""
    takes = _TAKES.get(section, tuple(cell.shared))
    return {name: value for name, value in cell.shared.items() if name in takes} | cell.sections[section]


def check_cells(cells: Sequence[GridCell], grid: str) -> None:
    """Raise UserError, starting with the grid's name, for settings that a stage does not know or accept.

    Whether they suit the dataset and the machine, and fit together, is checked by each job itself, which then fails
    alone.
    """
    try:
        for cell in cells:
            refuse_number("seed", cell.seed, 0, MAX_SEED)
        for cell in {repr(cell.sections | {"": cell.shared | {"seed": 0}}): cell for cell in cells}.values():
            config_of(cell, cell.chain[0])
            for section in cell.chain[1:]:
                recorded(cell, section)
    except UserError as error:
        raise type(error)(f"{grid}: {error}") from error


def config_of(cell: GridCell, section: str) -> Any:
    """A stage's config, parsed as its command line would be, with placeholder folders."""
    settings = stage_settings(cell, section)
    later = {"seed": settings.pop("seed", 0)}
    if section == "collect" and settings.get("quality", "expert") not in SET_QUALITIES:
        later |= {"quality": str(settings["quality"])}  # a user's own dataset, which no command collects
        settings |= {"quality": "expert"}
    try:
        return replace(_parsed(section, tuple(words_of(settings))), **later)
    except UserError as error:
        raise type(error)(f"{section}: {error}") from error


@cache
def _parsed(section: str, words: tuple[str, ...]) -> Any:
    """A section's settings, cached across seeds. Read as the command does, a grid takes what the command takes."""
    line = [*words, *words_of(dict.fromkeys((*_READS.get(section, ()), "out"), "-"))]
    program = " ".join(("vd4rl-pomdp", *COMMANDS[section]))
    return (
        parse(CollectConfig, line, program) if section == "collect" else parse_stage(_CONFIGS[section], line, program)
    )


def collection_of(cell: GridCell) -> Values:
    """Collection settings that identify a cell's dataset, as in collection.json."""
    config = config_of(cell, cell.chain[0])
    return collection(config) if isinstance(config, CollectConfig) else maze_collection(config)


def recipe_of(cell: GridCell, section: str, seeds: bool = True) -> str:
    """Hash of what a cell's training computes, apart from its data's content. Equals the one in the run's records."""
    record = {"format": FORMAT, "stage": STAGES[section], "config": recorded(cell, section)}
    if section != "finetune":
        return recipe(record, {}, seeds)
    before = recorded(cell, "pretrain")
    return recipe(record, {"settings": settings_of(before), "seed": before["seed"]}, seeds)


def recorded(cell: GridCell, section: str) -> Values:
    """The config that a training records, without folders."""
    config = config_of(cell, section)
    if section == "pretrain":  # the task comes from the dataset
        config = replace(config, task=cell.value("task") or config.task)
    if section == "finetune":  # drop settings that this encoder makes irrelevant
        before = config_of(cell, "pretrain")
        method = METHODS.named(before.method)
        remembers = history_of(before.method, method, before.history) != "none"
        config = as_trained(config, method.end_to_end, remembers, cell.value("task"))
    return jsonable(flat(config))
