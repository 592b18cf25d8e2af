"""What a sweep knows of each stage: its command, its settings, and how the settings of a run are recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_number, refuse_unknown
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.runs import FORMAT
from vd4rl_pomdp.runs.files import jsonable
from vd4rl_pomdp.runs.identity import recipe
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
        for cell in {repr((cell.shared | {"seed": 0}, cell.sections)): cell for cell in cells}.values():
            config_of(cell, cell.chain[0])
            for section in cell.chain[1:]:
                recorded(cell, section)
    except UserError as error:
        raise type(error)(f"{grid}: {error}") from error


def config_of(cell: GridCell, section: str) -> Any:
    """A stage's settings, its folders left open."""
    settings = told(cell, section)
    seed = settings.pop("seed", 0)
    try:
        return replace(_made(section, tuple(settings.items())), seed=seed)
    except UserError as error:
        raise type(error)(f"{section}: {error}") from error


@cache
def _made(section: str, items: tuple[tuple[str, Any], ...]) -> Any:
    """The settings of a section, once for all seeds."""
    settings, kind = dict(items), _config_class(section)
    if section == "collect":
        return _collection(kind, settings, {"task": None, "quality": None, "out": Path()})
    if section == "navigation_collect":
        from vd4rl_pomdp.studies.navigation.collect import PRESETS

        preset = settings.get("preset", "paper")
        refuse_unknown("preset", preset, PRESETS)
        return _collection(kind, settings, vars(PRESETS[preset]) | {"maze": None})
    config = kind.of(**settings)
    config.check()
    return config


def _config_class(section: str) -> Any:
    """The class of a section's settings, imported when it is needed."""
    if section == "collect":
        from vd4rl_pomdp.data.collect import CollectConfig

        return CollectConfig
    if section == "pretrain":
        from pretrain.config import PretrainConfig

        return PretrainConfig
    if section == "finetune":
        from finetune.config import FinetuneConfig

        return FinetuneConfig
    from vd4rl_pomdp.studies.navigation import collect, config

    return collect.MazeCollectConfig if section == "navigation_collect" else config.NavigationConfig


def _collection(kind: Any, settings: Values, defaults: Values) -> Any:
    """A collection's settings, of which a grid has to tell those whose default is None."""
    for name in settings:
        refuse_unknown("setting", name, (field.name for field in fields(kind)))
    values = defaults | settings
    for name in defaults:
        if values[name] is None:
            raise UserError(f"names no {name}: give it one")
    return kind(**values)


def collection_of(cell: GridCell) -> Values:
    """What tells the set of a cell from others, as its collection.json has it."""
    section = cell.chain[0]
    if section == "collect":
        from vd4rl_pomdp.data.collect import collection

        return collection(config_of(cell, section))
    from vd4rl_pomdp.studies.navigation.collect import collection as maze_collection

    return maze_collection(config_of(cell, section))


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
    if section == "finetune":
        config = _as_trained(cell, config)
    return jsonable(flat(config))


def _as_trained(cell: GridCell, config: Any) -> Any:
    """The config that a fine-tuning trains with: what its encoder's method cannot read is no part of it."""
    from finetune.settings import as_trained
    from pretrain.config import history_of
    from pretrain.objectives import METHODS

    before = config_of(cell, "pretrain")
    method = METHODS.named(before.method)
    remembers = history_of(before.method, method, before.history) != "none"
    decisions = TASKS.named(cell.value("task")).decisions
    return as_trained(config, before.method, method.end_to_end, remembers, decisions)
