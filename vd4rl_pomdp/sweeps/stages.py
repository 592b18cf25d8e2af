"""What a sweep knows of each stage: its command, its settings, and how the settings of a run are recorded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

from finetune.config import FinetuneConfig, as_trained
from pretrain.config import PretrainConfig, history_of
from pretrain.objectives import METHODS
from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_number
from vd4rl_pomdp.core.options import flat, settings_of, words_of
from vd4rl_pomdp.core.parsing import parse, parse_stage
from vd4rl_pomdp.core.tasks import SET_QUALITIES, TASKS
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
"""Words of every section's command."""
STAGES = {"pretrain": "pretrain", "finetune": "finetune", "navigation_train": "navigation"}
"""What a training's record calls its stage, by section."""
_PARSERS: dict[str, Callable[[list[str], str], Any]] = {
    "collect": partial(parse, CollectConfig),
    "pretrain": partial(parse_stage, PretrainConfig),
    "finetune": partial(parse_stage, FinetuneConfig),
    "navigation_collect": partial(parse_stage, MazeCollectConfig),
    "navigation_train": partial(parse_stage, NavigationConfig),
}
"""Every section's settings, read as its command line is: a grid takes and refuses what the command does, and a recipe
is that of the run that the command makes."""
_READS = {"pretrain": ("data",), "finetune": ("data", "encoder"), "navigation_train": ("data",)}
"""Folders that a stage is given, beside the one it writes."""
_TAKES = {"collect": (), "navigation_collect": ("preset",)}
"""What a stage takes of the shared settings, where that is not all of them."""


def told(cell: GridCell, section: str) -> Values:
    """What a cell tells a stage, in the order of its command line."""
    takes = _TAKES.get(section, tuple(cell.shared))
    return {name: value for name, value in cell.shared.items() if name in takes} | cell.sections[section]


def check_cells(cells: Sequence[GridCell], grid: str) -> None:
    """Raise UserError, which begins with the grid's name, for settings that a stage does not have or take.

    Whether they fit the set, the machine and one another the stage itself says: its job then fails by itself.
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
    """A stage's settings, as its own command line reads them, its folders left open."""
    settings = told(cell, section)
    later = {"seed": settings.pop("seed", 0)}
    if section == "collect" and settings.get("quality", "expert") not in SET_QUALITIES:
        later |= {"quality": str(settings["quality"])}  # of a set of one's own, which no command collects
        settings |= {"quality": "expert"}
    try:
        return replace(_parsed(section, tuple(words_of(settings))), **later)
    except UserError as error:
        raise type(error)(f"{section}: {error}") from error


@cache
def _parsed(section: str, words: tuple[str, ...]) -> Any:
    """The settings of a section, once for all seeds."""
    line = [*words, *words_of(dict.fromkeys((*_READS.get(section, ()), "out"), "-"))]
    return _PARSERS[section](line, " ".join(("vd4rl-pomdp", *COMMANDS[section])))


def collection_of(cell: GridCell) -> Values:
    """What tells the set of a cell from others, as its collection.json has it."""
    config = config_of(cell, cell.chain[0])
    return collection(config) if isinstance(config, CollectConfig) else maze_collection(config)


def recipe_of(cell: GridCell, section: str) -> str:
    """Name of what a training of a cell computes but for the content of its data; as its run's records have it."""
    record = {"format": FORMAT, "stage": STAGES[section], "config": recorded(cell, section)}
    if section != "finetune":
        return recipe(record, {})
    before = recorded(cell, "pretrain")
    return recipe(record, {"settings": settings_of(before), "seed": before["seed"]})


def recorded(cell: GridCell, section: str) -> Values:
    """The config that a training records, folders aside."""
    config = config_of(cell, section)
    if section == "pretrain":  # its set tells it the task
        config = replace(config, task=cell.value("task") or config.task)
    if section == "finetune":  # what its encoder's method cannot read is no part of what it trains with
        before = config_of(cell, "pretrain")
        method = METHODS.named(before.method)
        remembers = history_of(before.method, method, before.history) != "none"
        config = as_trained(config, method.end_to_end, remembers, TASKS.named(cell.value("task")).decisions)
    return jsonable(flat(config))
