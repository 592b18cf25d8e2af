"""A grid is data: settings of every stage by section, where a list is an axis, in TOML or a Python file.

    seed = [0, 1, 2]                      # settings outside the sections go to every training
    preset = "cpu"

    [collect]
    task = ["walker_walk", "cheetah_run"]
    quality = "expert_noisy"

    [pretrain]
    method = ["mik+a", "acro"]
    corruption = "patch+zero_frames"

    [finetune]
    updates = 20000

    [[block]]                             # a part of the grid: its settings override those above
    pretrain = { method = "acro", history = "gru" }

    [[where]]                             # overrides for the cells that match `only`; no axes here
    only = ["task=cheetah_run"]
    finetune = { updates = 60000 }

    [testing]                             # overrides under `--testing`, for the blocks that have the section
    preset = "smoke"

A grid without [[block]] is a single block. A Python file defines the same as a dict called GRID.
"""

from __future__ import annotations

import itertools
import runpy
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.options import RUNTIME_FIELDS
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.runs.interrupt import Terminated

GRIDS = Path(__file__).with_name("grids")
PIXELS = ("collect", "pretrain", "finetune")
MAZES = ("navigation_collect", "navigation_train")
SECTIONS = (*PIXELS, *MAZES)
SHARED = ("seed", "preset")  # settings outside the sections
_TRAININGS = ("pretrain", "finetune", "navigation_train")
_FOLDERS = {"out", "data", "encoder"}  # settings that the sweep itself fills in
Values = dict[str, Any]
Sections = dict[str, Values]  # settings by section; those of SHARED are under ""


@dataclass(frozen=True)
class GridCell:
    """One point of a grid: a dataset, plus the encoder and policy trained on it if the grid has these sections."""

    sections: Sections  # settings, one value each
    named: Mapping[str, Sequence[str]]
    """By section, settings that distinguish this cell within its grid and so appear in folder names: axes and a block's
    own settings."""
    overridden: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """By section, settings that a `where` has set."""

    @property
    def chain(self) -> tuple[str, ...]:
        """Its sections in dependency order, e.g. ("collect", "pretrain", "finetune")."""
        return tuple(name for name in SECTIONS if name in self.sections)

    @property
    def shared(self) -> Values:
        return self.sections[""]

    @property
    def seed(self) -> int:
        return self.shared.get("seed", 0)

    def value(self, name: str) -> Any:
        """Value of `section.name`, or of `name` in whichever section sets it (None: none); UserError if they differ."""
        return _value_of(self.sections, name)


@dataclass(frozen=True)
class Where:
    """A [[where]] table: overrides for the cells that match its conditions."""

    only: list[str]  # conditions, as in `narrow`
    sections: Sections

    def applied(self, cell: GridCell, last: Sections) -> GridCell:
        """The cell with these overrides if it matches all conditions. Settings in `last` take precedence."""
        if not all(_in_words(cell.value(name)) in values for name, values in map(_condition, self.only)):
            return cell
        own = {
            section: {name: value for name, value in settings.items() if name not in last.get(section, {})}
            for section, settings in self.sections.items()
        }
        overridden = {section: [*cell.overridden.get(section, ()), *names] for section, names in own.items()}
        return replace(cell, sections=_merge(cell.sections, own), overridden={**cell.overridden, **overridden})


@dataclass(frozen=True)
class Grid:
    """A grid as read from its file."""

    name: str
    title: str
    common: Sections  # settings shared by all blocks, axes as lists
    blocks: list[Sections]  # settings of each block's own table
    wheres: list[Where]
    last: Sections  # settings with the highest precedence: from [testing] and --change

    def cells(self) -> list[GridCell]:
        """All cells without duplicates, ordered by seed: every condition runs its first seed before any second one."""
        cells: dict[str, GridCell] = {}
        for block in self.blocks:
            whole = _merge(self.common, block)
            for cell in _product(_merge(whole, _within(whole, self.last)), block):
                for where in self.wheres:
                    cell = where.applied(cell, self.last)
                cells.setdefault(repr(cell.sections), cell)
        return sorted(cells.values(), key=lambda cell: cell.seed)


def names() -> list[str]:
    """Grids that ship with the package."""
    return sorted(path.stem for path in GRIDS.glob("*.toml"))


def load_grid(name: str, changes: Sequence[str] = (), testing: bool = False) -> Grid:
    """Read a shipped grid, or a TOML or Python file; UserError if it does not exist or is invalid.

    `changes` are overrides for all blocks that have the section, e.g. "pretrain.steps=100" or "seed=0,1"; `testing`
    applies those of [testing].
    """
    path = GRIDS / f"{name}.toml" if name in names() else Path(name)
    content = _read(path, name)
    try:
        title, tests = content.pop("title", path.stem), content.pop("testing", None)
        if testing and tests is None:
            raise UserError("has no [testing] section: add one, or leave out --testing")
        tables = {name: content.pop(name, []) for name in ("block", "where")}
        for kind, found in tables.items():
            if not isinstance(found, list):
                raise UserError(f"its {kind}s are not a list of tables: write [[{kind}]]")
        blocks, common = [_sections(block) for block in tables["block"] or [{}]], _sections(content)
        changed = [text.partition("=")[0].strip() for text in changes]
        if twice := [name for name in changed if changed.count(name) > 1]:
            raise UserError(f"{twice[0]} is changed twice; for several values write them as in seed=0,1")
        last = _merge({"": {}}, *([_sections(tests)] if testing else []), *map(_change, changes))
        whole = [_merge(common, block) for block in blocks]
        if foreign := [name for name in last if not any(name in block for block in whole)]:
            raise UserError(
                f"no block has a section {foreign[0]}, which --change or [testing] sets: add or leave it out"
            )
        for block in whole:
            _check_block(_merge(block, _within(block, last)))
        wheres = [_where(table, whole) for table in tables["where"]]
        return Grid(path.stem, str(title), common, blocks, wheres, last)
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def narrow(cells: list[GridCell], only: Sequence[str]) -> list[GridCell]:
    """The cells that match all conditions, e.g. "method=mik+a,acro" and "seed=0".

    UserError if a condition is malformed, or no cell has one of its values.
    """
    for text in only:
        name, wanted = _condition(text)
        found = [_in_words(cell.value(name)) for cell in cells]
        _check_values(text, wanted, found)
        cells = [cell for cell, value in zip(cells, found, strict=True) if value in wanted]
    return cells


def _read(path: Path, name: str) -> Values:
    if path.suffix not in (".toml", ".py"):
        raise UserError(f"unknown grid {name!r}: choose one of {', '.join(names())}, or name a .toml or .py file")
    try:
        with disk_errors(path):
            text = read_bytes(path).decode()
            content = tomllib.loads(text) if path.suffix == ".toml" else runpy.run_path(str(path)).get("GRID")
    except (UserError, Terminated):
        raise
    except (Exception, SystemExit) as error:  # a Python file may raise anything
        raise UserError(f"{path}: is not a valid grid ({type(error).__name__}: {error}); correct it") from error
    if not isinstance(content, dict):
        raise UserError(f"{path}: defines no dict called GRID; see the shipped grids for examples")
    return dict(content)


def _sections(table: Any) -> Sections:
    """Settings by section, from one table of a grid's file."""
    if not isinstance(table, dict):
        raise UserError(f"{table!r} is not a table of settings")
    sections: Sections = {"": {}}
    for name, value in table.items():
        if name in SHARED:
            sections[""][name] = value
        elif name not in SECTIONS:
            raise UserError(f"unknown section or setting {name!r}: choose one of {', '.join((*SHARED, *SECTIONS))}")
        elif not isinstance(value, dict):
            raise UserError(f"{name} is not a table of settings")
        else:
            sections[name] = dict(value)
    return sections


def _where(table: Any, blocks: list[Sections]) -> Where:
    """Parse a [[where]] table. Its conditions may only name values that occur in some block."""
    table = dict(table) if isinstance(table, dict) else {}
    only, sections = table.pop("only", None), _sections(table)
    if not isinstance(only, list) or not only or not all(isinstance(text, str) for text in only):
        raise UserError('a [[where]] has no conditions: write only = ["task=cheetah_run"], or several')
    for text in only:
        name, wanted = _condition(text)
        values = [_value_of(block, name) for block in blocks]
        found = [one for value in values for one in (value if isinstance(value, list) else [value])]
        _check_values(text, wanted, [_in_words(value) for value in found])
    for section, settings in sections.items():
        _check_settings(section, settings, axes=False)
        if section and not all(section in block for block in blocks):
            raise UserError(f"a [[where]] sets {section}, which not every block has")
    return Where(only, sections)


def _change(text: str) -> Sections:
    """Parse a change from the command line: "section.name=value", or "name=value" for one of SHARED."""
    where, equals, value = (part.strip() for part in text.partition("="))
    section, _, name = where.rpartition(".")
    if not equals or not name:
        raise UserError(f"{text!r} is not a change: write section.name=value, such as pretrain.steps=100 or seed=0,1")
    if name not in SHARED if not section else section not in SECTIONS:
        raise UserError(f"{where!r} is not a grid setting: write one of {', '.join(SHARED)}, or SECTION.NAME")
    values = [_toml_value(part.strip()) for part in value.split(",")]
    return {section: {name: values if len(values) > 1 else values[0]}}


def _check_block(block: Sections) -> None:
    chain = [name for name in SECTIONS if name in block]
    if not chain or (set(chain) & set(PIXELS) and set(chain) & set(MAZES)):
        raise UserError(f"a block needs sections of {', '.join(PIXELS)}, or of {', '.join(MAZES)}")
    if "finetune" in chain and "pretrain" not in chain:
        raise UserError("a block with finetune needs pretrain, which makes its encoder")
    if chain[0] not in ("collect", "navigation_collect"):
        raise UserError(f"a block has no dataset: add a section {(MAZES if chain[0] in MAZES else PIXELS)[0]}")
    for section, settings in block.items():
        _check_settings(section, settings)


def _check_settings(section: str, settings: Values, axes: bool = True) -> None:
    for name, value in settings.items():
        where = f"{section}.{name}".lstrip(".")
        if not isinstance(name, str) or not name.isidentifier() or name == "help":
            raise UserError(f"{where}: is not a stage setting; names have underscores, as in max_k")
        if name in _FOLDERS:
            raise UserError(f"{where}: sweeps name their folders: leave it out, and pass --out and --data")
        if section in _TRAININGS and name == "seed":
            raise UserError(f"{where}: a cell's trainings share one seed: write it outside the sections")
        if isinstance(value, list) and axes and name in RUNTIME_FIELDS:
            raise UserError(f"{where}: does not change results, so cells cannot differ in it; give one value")
        values = value if isinstance(value, list) and axes else [value]
        kinds = {int} if name == "seed" else {str, int, float, bool}
        if not values or not {type(one) for one in values} <= kinds:
            wanted = "a number" if name == "seed" else "a number, a word, true or false"
            raise UserError(f"{where} is {value!r}: write {wanted}{', or a list of such' * axes}")


def _product(block: Sections, own: Sections) -> Iterator[GridCell]:
    """The cells of a block; `own` holds the settings of its own table."""
    axes = [(section, name) for section in block for name, value in block[section].items() if isinstance(value, list)]
    named = {
        section: [name for name in settings if (section, name) in axes or name in own.get(section, ())]
        for section, settings in block.items()
    }
    for values in itertools.product(*(block[section][name] for section, name in axes)):
        sections = {section: dict(settings) for section, settings in block.items()}
        for (section, name), value in zip(axes, values, strict=True):
            sections[section][name] = value
        yield GridCell(sections, named)


def _merge(*parts: Sections) -> Sections:
    """Merge settings by section; later parts override earlier ones."""
    merged: Sections = {}
    for part in parts:
        for section, settings in part.items():
            merged[section] = merged.get(section, {}) | settings
    return merged


def _within(block: Sections, last: Sections) -> Sections:
    """The overrides of sections that a block has: others would add a stage to it."""
    return {section: settings for section, settings in last.items() if section in block}


def _value_of(sections: Sections, name: str) -> Any:
    """See `GridCell.value`."""
    section, _, own = name.rpartition(".")
    if section or name in sections.get("", {}):
        return sections.get(section, {}).get(own)
    found = {f"{section}.{name}": values[name] for section, values in sections.items() if name in values}
    if any(value != next(iter(found.values())) for value in found.values()):
        raise UserError(f"{name!r} means {' and '.join(found)} here, which differ: write one of these")
    return next(iter(found.values()), None)


def _condition(text: str) -> tuple[str, list[str]]:
    """Parse a condition into name and values: "method=mik+a,acro" -> ("method", ["mik+a", "acro"])."""
    name, equals, values = (part.strip() for part in text.partition("="))
    if not (name and equals):
        raise UserError(f"{text!r} is not a condition: write name=value, or name=value,value")
    return name, [_in_words(_toml_value(value.strip())) for value in values.split(",")]


def _toml_value(text: str) -> Any:
    """Parse a TOML value, or return the text itself, so that words need no quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _in_words(value: Any) -> str:
    """Canonical text of a value for comparisons: equal for equal numbers however they are written (1e-3, 0.001)."""
    return str(_toml_value(value) if isinstance(value, str) else value)


def _check_values(text: str, wanted: list[str], found: list[str]) -> None:
    """Raise UserError if a condition names a value that no cell has."""
    if not set(wanted) <= set(found):
        has = f"has {', '.join(dict.fromkeys(found))}" if set(found) != {"None"} else "sets nothing of that name"
        raise UserError(f"no cell has {text!r}: the grid {has}; write name=value,value")
