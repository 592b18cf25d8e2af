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

    [testing]                             # what `--testing` runs: its settings replace those of every block
    preset = "smoke"

A grid without blocks is one. A Python file defines the same as a dict called GRID.
"""

from __future__ import annotations

import itertools
import runpy
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vd4rl_pomdp.errors import UserError, disk_error
from vd4rl_pomdp.runs.reading import read_bytes, regular

GRIDS = Path(__file__).parents[1] / "experiments" / "grids"
"""The grids that ship with the package."""
PIXELS = ("collect", "pretrain", "finetune")
MAZES = ("navigation_collect", "navigation_train")
SECTIONS = (*PIXELS, *MAZES)
SHARED = ("seed", "preset")
"""Settings outside the sections."""
Values = dict[str, Any]
Sections = dict[str, Values]


@dataclass(frozen=True)
class GridCell:
    """One point of a grid: a set, an encoder and a policy, or whatever of the chain a grid asks for."""

    shared: Values
    """Values of SHARED, as far as they are told."""
    sections: Sections
    """Settings by section, without axes."""
    named: Mapping[str, Sequence[str]]
    """By section, the settings that tell this cell from others of its grid: axes, and what a block says."""

    @property
    def chain(self) -> tuple[str, ...]:
        """Its sections, in the order in which they depend on one another."""
        return tuple(name for name in SECTIONS if name in self.sections)

    @property
    def seed(self) -> int:
        """Seed of its trainings."""
        return self.shared.get("seed", 0)

    def value(self, name: str) -> Any:
        """What it sets a setting to, in whichever section; None if it does not."""
        found = (values[name] for values in (self.shared, *self.sections.values()) if name in values)
        return next(found, None)


@dataclass(frozen=True)
class Grid:
    """A grid as its file tells it."""

    name: str
    title: str
    blocks: list[Sections]
    """Settings by section of every block, axes as lists; those of SHARED under the name ""."""
    block_says: list[dict[str, set[str]]]
    """By block and section, the settings that stand in the block itself."""

    def cells(self) -> list[GridCell]:
        """All cells, once each; the first seed of every condition comes before the second of any."""
        cells: dict[str, GridCell] = {}
        for block, says in zip(self.blocks, self.block_says, strict=True):
            for cell in _product(block, says):
                cells.setdefault(repr((cell.shared, cell.sections)), cell)
        return sorted(cells.values(), key=lambda cell: cell.seed)


def _product(block: Sections, says: dict[str, set[str]]) -> Iterator[GridCell]:
    axes = [(section, name) for section in block for name, value in block[section].items() if isinstance(value, list)]
    named = {
        section: [name for name in block[section] if (section, name) in axes or name in says.get(section, ())]
        for section in block
    }
    for values in itertools.product(*(block[section][name] for section, name in axes)):
        sections = {section: dict(settings) for section, settings in block.items()}
        for (section, name), value in zip(axes, values, strict=True):
            sections[section][name] = value
        shared = sections.pop("")
        yield GridCell(shared, sections, named)


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
    except UserError:
        raise
    except OSError as error:
        raise disk_error(path, error) from error
    except Exception as error:
        raise UserError(f"{path}: is no grid ({type(error).__name__}: {error}); mend it") from error
    if not isinstance(told, dict):
        raise UserError(f"{path}: defines no dict called GRID; see the grids that ship for its form")
    return told


def _grid_of(name: str, told: Values, changes: list[Sections], testing: bool) -> Grid:
    told = dict(told)
    title, blocks, tests = told.pop("title", name), told.pop("block", [{}]), told.pop("testing", {})
    if not isinstance(blocks, list) or not blocks:
        raise UserError("its blocks are no list of tables: write [[block]]")
    common = _sections(told)
    last = [_sections(tests)] if testing else []
    merged, says = [], []
    for block in map(_sections, blocks):
        merged.append(_merge(common, block, *last, *changes))
        says.append({section: set(settings) for section, settings in block.items()})
    for block in merged:
        _check_block(block)
    return Grid(name, str(title), merged, says)


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


def _merge(*parts: Sections) -> Sections:
    merged: Sections = {}
    for part in parts:
        for section, settings in part.items():
            merged[section] = merged.get(section, {}) | settings
    return merged


def _change(text: str) -> Sections:
    """A change as the command line tells it: "section.name=value", or "name=value" for one of SHARED."""
    where, equals, value = text.partition("=")
    section, _, name = where.rpartition(".")
    if not equals or not name:
        raise UserError(f"{text!r} is no change: write section.name=value, such as pretrain.steps=100 or seed=0,1")
    if (section and section not in SECTIONS) or (not section and name not in SHARED):
        raise UserError(f"{where!r} is no setting of a grid: write one of {', '.join(SHARED)}, or SECTION.NAME")
    values = [_value(part) for part in value.split(",")]
    return {section: {name: values if len(values) > 1 else values[0]}}


def _value(text: str) -> Any:
    """A TOML value, or else the text itself: words need no quotation marks."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _check_block(block: Sections) -> None:
    chain = [name for name in SECTIONS if name in block]
    if not chain or (set(chain) & set(PIXELS) and set(chain) & set(MAZES)):
        raise UserError(f"a block needs sections of {', '.join(PIXELS)}, or of {', '.join(MAZES)}")
    for section, settings in block.items():
        for name, value in settings.items():
            values = value if isinstance(value, list) else [value]
            kinds = int if name == "seed" else str | int | float
            if not values or not all(isinstance(one, kinds) for one in values):
                where, wanted = (
                    f"{section}.{name}".lstrip("."),
                    "a number" if kinds is int else "a number, a word, true or false",
                )
                raise UserError(f"{where} is {value!r}: write {wanted}, or a list of such")


def narrow(cells: list[GridCell], only: Sequence[str]) -> list[GridCell]:
    """The cells whose settings have the named values: "method=mik+a,acro", "seed=0".

    Raises:
        UserError: a condition is none, or no cell has such a value.
    """
    for text in only:
        name, equals, values = text.partition("=")
        wanted = values.split(",")
        found = [str(cell.value(name)) for cell in cells]
        unknown = [value for value in wanted if value not in found]
        if not equals or unknown:
            has = f"has {', '.join(dict.fromkeys(found))}" if set(found) != {"None"} else "sets nothing of that name"
            raise UserError(f"--only {text!r}: the grid {has}; write name=value,value")
        cells = [cell for cell, value in zip(cells, found, strict=True) if value in wanted]
    return cells
