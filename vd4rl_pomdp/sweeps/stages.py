"""What a sweep knows of each stage: its command, its settings, and how the settings of a run are recorded.

Settings are parsed once for all seeds and folders, by the stage's own command line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from typing import Any

from vd4rl_pomdp.cli.parsing import parse, parse_stage, with_presets
from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_number
from vd4rl_pomdp.core.options import flat, words_of
from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.runs import FORMAT
from vd4rl_pomdp.runs.files import jsonable
from vd4rl_pomdp.runs.identity import recipe
from vd4rl_pomdp.sweeps.fits import check_fit
from vd4rl_pomdp.sweeps.grid import GridCell, Values

_NOWHERE = "-"
"""Stands for a path while settings are parsed."""
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
_READS = {"collect": (), "pretrain": ("data",), "finetune": ("data", "encoder"), "navigation_train": ("data",)}
"""Folders that a stage is given, beside the one it writes."""
_TAKES = {"collect": (), "navigation_collect": ("preset",)}
"""What a stage takes of the shared settings, where that is not all of them."""


def told(cell: GridCell, section: str) -> Values:
    """What a cell tells a stage, in the order of its command line."""
    takes = _TAKES.get(section, tuple(cell.shared))
    return {name: value for name, value in cell.shared.items() if name in takes} | cell.sections[section]


def check_cells(cells: Iterable[GridCell], grid: str, collects: Callable[[GridCell], bool] = lambda _: True) -> None:
    """`check_cell` for cells of a grid, whose name goes before what is wrong with one.

    Args:
        cells: the cells.
        grid: the grid's name.
        collects: whether a cell's set is one that this package collects, not one that somebody put there.
    """
    try:
        for cell in cells:
            check_cell(cell, collects(cell))
    except UserError as error:
        raise type(error)(f"{grid}: {error}") from error


def check_cell(cell: GridCell, collects: bool = True) -> None:
    """Raise UserError for settings that a stage would refuse, by themselves or on the set that the cell collects."""
    configs = {section: config_of(cell, section) for section in cell.chain}
    if collects and (check := _CHECKS.get(cell.chain[0])):
        check(configs[cell.chain[0]])
    check_fit(configs)
    if "finetune" in cell.chain:
        _finetuning(cell)


def config_of(cell: GridCell, section: str) -> Any:
    """A stage's settings, its folders left open."""
    settings = told(cell, section)
    seed = settings.pop("seed", 0)
    refuse_number("seed", seed, 0, MAX_SEED)
    return replace(_parsed(section, tuple(words_of(settings))), seed=seed)


@cache
def _parsed(section: str, words: tuple[str, ...]) -> Any:
    command = " ".join(COMMANDS[section])
    places = words_of(dict.fromkeys((*_READS.get(section, ()), "out"), _NOWHERE))
    return _PARSERS[section]([*words, *places], f"vd4rl-pomdp {command}")


def _collect(words: list[str], program: str) -> Any:
    from vd4rl_pomdp.data.collect import CollectConfig

    return parse(CollectConfig, words, program)


@cache
def _check_collection(config: Any) -> None:
    from vd4rl_pomdp.data.collect import check_config

    check_config(config)


def _pretrain(words: list[str], program: str) -> Any:
    from pretrain.config import PretrainConfig

    config = parse_stage(PretrainConfig, words, program)
    config.check()
    return config


def _finetune(words: list[str], program: str) -> Any:
    from finetune.config import FinetuneConfig

    return parse_stage(FinetuneConfig, words, program)


def _navigation_collect(words: list[str], program: str) -> Any:
    from vd4rl_pomdp.studies.navigation.collect import PRESETS, MazeCollectConfig

    return with_presets(MazeCollectConfig, PRESETS, words, program)


@cache
def _check_maze_collection(config: Any) -> None:
    from vd4rl_pomdp.studies.navigation.collect import check_config

    check_config(config)


def _navigation_train(words: list[str], program: str) -> Any:
    from vd4rl_pomdp.studies.navigation.config import NavigationConfig

    return parse_stage(NavigationConfig, words, program)


_PARSERS: dict[str, Callable[[list[str], str], Any]] = {
    "collect": _collect,
    "pretrain": _pretrain,
    "finetune": _finetune,
    "navigation_collect": _navigation_collect,
    "navigation_train": _navigation_train,
}
_CHECKS: dict[str, Callable[[Any], None]] = {
    "collect": _check_collection,
    "navigation_collect": _check_maze_collection,
}
"""What refuses a set that cannot be collected, by section."""


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
    config = _finetuning(cell) if section == "finetune" else config_of(cell, section)
    if section == "pretrain":  # its set tells it the task
        config = replace(config, task=cell.value("task") or config.task)
    return jsonable(flat(config))


def _finetuning(cell: GridCell) -> Any:
    """The config that a fine-tuning trains with: what its encoder's method cannot read is no part of it."""
    from finetune.settings import as_trained
    from pretrain.config import history_of
    from pretrain.objectives import METHODS

    before = config_of(cell, "pretrain")
    method = METHODS.named(before.method)
    remembers = history_of(before.method, method, before.history) != "none"
    task = TASKS.get(cell.value("task"))  # none in a cell that will be refused, for it has no set
    decisions = task.decisions if task else 0
    return as_trained(config_of(cell, "finetune"), before.method, method.end_to_end, remembers, decisions)
