"""A grid is data: sections of settings for every stage, where a list is an axis, in TOML or in a Python file.

    seed = [0, 1, 2]                      # what stands outside the sections is told to every training
    preset = "cpu"

    [collect]
    task = ["walker_walk", "cheetah_run"]
    quality = "expert_noisy"

    [pretrain]
    method = ["mik+a", "acro"]
    corruption = "patch+zero_frames"

    [finetune]
    updates = 20000

    [[block]]                             # a part of the grid: its settings replace those above
    pretrain = { method = "acro", history = "gru" }

    [[where]]                             # settings of the cells that have others: no axes here
    only = ["task=cheetah_run"]
    finetune = { updates = 60000 }

    [testing]                             # what `--testing` runs: its settings replace those of every block
    preset = "smoke"

A grid without blocks is one. A Python file defines the same as a dict called GRID.
"""

from __future__ import annotations

import runpy
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError, disk_error
from vd4rl_pomdp.core.reading import read_bytes, regular
from vd4rl_pomdp.core.settings import RUNTIME_FIELDS
from vd4rl_pomdp.runs.interrupt import Terminated
from vd4rl_pomdp.sweeps.grid import (
    MAZES,
    PIXELS,
    SECTIONS,
    SHARED,
    TRAININGS,
    Grid,
    Sections,
    Values,
    Where,
    check_values,
    condition,
    in_words,
    merge,
    toml_value,
    value_of,
)

GRIDS = Path(__file__).with_name("grids")
"""The grids that ship with the package."""
_FOLDERS = {"out", "data", "encoder"}
"""Settings of the stages that a sweep sets."""


def names() -> list[str]:
    """Grids that ship with the package."""
    return sorted(path.stem for path in GRIDS.glob("*.toml"))


def load_grid(name: str, changes: Sequence[str] = (), testing: bool = False) -> Grid:
    """Read a grid.

    Args:
        name: of one that ships, or the path of a TOML or Python file.
        changes: settings that replace those of every block: "pretrain.steps=100", "seed=0,1".
        testing: whether the grid's `testing` settings replace its own.

    Raises:
        UserError: there is no such grid, or its file is none.
    """
    path = GRIDS / f"{name}.toml" if name in names() else Path(name)
    told = _read(path, name)
    try:
        return _grid_of(path.stem, told, [_change(text) for text in changes], testing)
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def _read(path: Path, name: str) -> Values:
    if path.suffix not in (".toml", ".py"):
        raise UserError(f"unknown grid {name!r}: choose one of {', '.join(names())}, or name a .toml or .py file")
    try:
        if path.suffix == ".toml":
            return tomllib.loads(read_bytes(path).decode())
        told = runpy.run_path(str(regular(path))).get("GRID")
    except (UserError, Terminated):
        raise
    except OSError as error:
        raise disk_error(path, error) from error
    except (Exception, SystemExit) as error:
        raise UserError(f"{path}: is no grid ({type(error).__name__}: {error}); mend it") from error
    if not isinstance(told, dict):
        raise UserError(f"{path}: defines no dict called GRID; see the grids that ship for its form")
    return told


def _grid_of(name: str, told: Values, changes: list[Sections], testing: bool) -> Grid:
    told = dict(told)
    title, tests = told.pop("title", name), told.pop("testing", {})
    own, wheres = _tables(told, "block") or [{}], _tables(told, "where")
    common = _sections(told)
    last = merge({"": {}}, *([_sections(tests)] if testing else []), *changes)
    own = [_sections(block) for block in own]
    blocks = [merge(common, block) for block in own]
    for block in blocks:
        _check_block(merge(block, last))
    says = [{section: set(settings) for section, settings in block.items()} for block in own]
    return Grid(name, str(title), blocks, says, [_where(table, blocks) for table in wheres], last)


def _tables(told: Values, name: str) -> list[Any]:
    tables = told.pop(name, [])
    if not isinstance(tables, list):
        raise UserError(f"its {name}s are no list of tables: write [[{name}]]")
    return tables


def _where(table: Any, blocks: list[Sections]) -> Where:
    """A [[where]] of a grid's file; its conditions have to speak of what stands in a block."""
    table = dict(table) if isinstance(table, dict) else {}
    only, sections = table.pop("only", None), _sections(table)
    if not isinstance(only, list) or not only or not all(isinstance(text, str) for text in only):
        raise UserError('a [[where]] has no conditions: write only = ["task=cheetah_run"], or several')
    for text in only:
        name, wanted = condition(text)
        check_values(text, wanted, [in_words(value) for block in blocks for value in _values_of(block, name)])
    for section, settings in sections.items():
        _check_settings(section, settings, axes=False)
        if section and not all(section in block for block in blocks):
            raise UserError(f"a [[where]] sets {section}, which not every block has")
    return Where(only, sections)


def _sections(table: Any) -> Sections:
    """Settings by section of a table of a grid's file."""
    if not isinstance(table, dict):
        raise UserError(f"{table!r} is no table of settings")
    sections: Sections = {"": {}}
    for name, value in table.items():
        if name in SHARED:
            sections[""][name] = value
        elif name not in SECTIONS:
            raise UserError(f"unknown section or setting {name!r}: choose one of {', '.join((*SHARED, *SECTIONS))}")
        elif not isinstance(value, dict):
            raise UserError(f"{name} is no table of settings")
        else:
            sections[name] = dict(value)
    return sections


def _change(text: str) -> Sections:
    """A change as the command line tells it: "section.name=value", or "name=value" for one of SHARED."""
    where, equals, value = (part.strip() for part in text.partition("="))
    section, _, name = where.rpartition(".")
    if not equals or not name:
        raise UserError(f"{text!r} is no change: write section.name=value, such as pretrain.steps=100 or seed=0,1")
    if (section and section not in SECTIONS) or (not section and name not in SHARED):
        raise UserError(f"{where!r} is no setting of a grid: write one of {', '.join(SHARED)}, or SECTION.NAME")
    values = [toml_value(part.strip()) for part in value.split(",")]
    return {section: {name: values if len(values) > 1 else values[0]}}


def _check_block(block: Sections) -> None:
    chain = [name for name in SECTIONS if name in block]
    if not chain or (set(chain) & set(PIXELS) and set(chain) & set(MAZES)):
        raise UserError(f"a block needs sections of {', '.join(PIXELS)}, or of {', '.join(MAZES)}")
    if "finetune" in chain and "pretrain" not in chain:
        raise UserError("a block with finetune needs pretrain, whose encoder it takes")
    for section, settings in block.items():
        _check_settings(section, settings)


def _check_settings(section: str, settings: Values, axes: bool = True) -> None:
    if folders := _FOLDERS.intersection(settings):
        raise UserError(
            f"{section}.{min(folders)}: a sweep names its folders itself: leave it out, and give --out, --data"
        )
    if "help" in settings:  # a flag of every command
        raise UserError(f"{section}.help: is no setting of a stage; leave it out")
    if section in TRAININGS and "seed" in settings:
        raise UserError(f"{section}.seed: a cell's trainings share one seed: write it outside the sections")
    for name, value in settings.items():
        if not isinstance(name, str):
            raise UserError(f"{section}: {name!r} is the name of no setting")
        if "-" in name:
            raise UserError(f"{section}.{name}: is the flag's name, the setting's is {name.replace('-', '_')}")
        if isinstance(value, list) and axes and name in RUNTIME_FIELDS:
            raise UserError(f"{section}.{name}: changes no result, so that cells of several would be one run; tell one")
        values = value if isinstance(value, list) and axes else [value]
        if not values or not all(_is_value(name, one) for one in values):
            where = f"{section}.{name}".lstrip(".")
            wanted = "a number" if name == "seed" else "a number, a word, true or false"
            raise UserError(f"{where} is {value!r}: write {wanted}{', or a list of such' * axes}")


def _is_value(name: str, told: Any) -> bool:
    if name == "seed":
        return isinstance(told, int) and not isinstance(told, bool)
    return isinstance(told, str | int | float)


def _values_of(block: Sections, name: str) -> list[Any]:
    found = value_of(block, name)
    return found if isinstance(found, list) else [found]
