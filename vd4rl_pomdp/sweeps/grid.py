"""A grid: sections of settings for every stage, where a list is an axis, and the cells that it means."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vd4rl_pomdp.core.errors import UserError

PIXELS = ("collect", "pretrain", "finetune")
MAZES = ("navigation_collect", "navigation_train")
SECTIONS = (*PIXELS, *MAZES)
TRAININGS = ("pretrain", "finetune", "navigation_train")
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
        """What it sets `section.name` to, or `name` in whichever section; None if it does not.

        Raises:
            UserError: sections set that name to different values.
        """
        return value_of({"": self.shared} | self.sections, name)


def value_of(sections: Sections, name: str) -> Any:
    """What some sections, of which "" are the settings outside of all, set a name to; as `GridCell.value`."""
    section, _, own = name.rpartition(".")
    if section or name in sections.get("", {}):
        return sections.get(section, {}).get(own)
    found = {f"{section}.{name}": values[name] for section, values in sections.items() if name in values}
    if any(value != next(iter(found.values())) for value in found.values()):
        raise UserError(f"{name!r} means {' and '.join(found)} here, which differ: write one of these")
    return next(iter(found.values()), None)


@dataclass(frozen=True)
class Where:
    """Settings of the cells that have others."""

    only: list[str]
    """Conditions, as `narrow` takes them."""
    sections: Sections

    def applied(self, cell: GridCell, last: Sections) -> GridCell:
        """The cell with these settings, if it meets all conditions; what stands in `last` stays."""
        if not all(in_words(cell.value(name)) in values for name, values in map(condition, self.only)):
            return cell
        shared, sections = dict(cell.shared), {name: dict(values) for name, values in cell.sections.items()}
        for section, settings in self.sections.items():
            into = sections[section] if section else shared
            into |= {name: value for name, value in settings.items() if name not in last.get(section, {})}
        return GridCell(shared, sections, cell.named)


@dataclass(frozen=True)
class Grid:
    """A grid as its file tells it."""

    name: str
    title: str
    blocks: list[Sections]
    """Settings by section of every block, axes as lists; those of SHARED under the name ""."""
    block_says: list[dict[str, set[str]]]
    """By block and section, the settings that stand in the block itself."""
    wheres: list[Where]
    last: Sections
    """Settings that replace all others: what `testing` and changes say."""

    def cells(self) -> list[GridCell]:
        """All cells, once each; the first seed of every condition comes before the second of any."""
        cells: dict[str, GridCell] = {}
        for block, says in zip(self.blocks, self.block_says, strict=True):
            for cell in _product(merge(block, self.last), says):
                for where in self.wheres:
                    cell = where.applied(cell, self.last)
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


def merge(*parts: Sections) -> Sections:
    """Settings by section; of several for one name the last counts."""
    merged: Sections = {}
    for part in parts:
        for section, settings in part.items():
            merged[section] = merged.get(section, {}) | settings
    return merged


def narrow(cells: list[GridCell], only: Sequence[str]) -> list[GridCell]:
    """The cells whose settings have the named values: "method=mik+a,acro", "seed=0".

    Raises:
        UserError: a condition is none, or no cell has such a value.
    """
    for text in only:
        name, wanted = condition(text)
        found = [in_words(cell.value(name)) for cell in cells]
        check_values(text, wanted, found)
        cells = [cell for cell, value in zip(cells, found, strict=True) if value in wanted]
    return cells


def condition(text: str) -> tuple[str, list[str]]:
    """Name and values of a condition: "method=mik+a,acro"."""
    name, equals, values = (part.strip() for part in text.partition("="))
    if not equals or not name:
        raise UserError(f"{text!r} is no condition: write name=value,value, such as method=mik+a,acro")
    return name, [in_words(toml_value(value.strip())) for value in values.split(",")]


def toml_value(text: str) -> Any:
    """A TOML value, or else the text itself: words need no quotation marks."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def in_words(value: Any) -> str:
    """A setting's value as conditions compare it: equal for equal numbers, however they are written."""
    return str(toml_value(value) if isinstance(value, str) else value)


def check_values(text: str, wanted: list[str], found: list[str]) -> None:
    """Raise UserError if a condition names a value that was not found."""
    if not set(wanted) <= set(found):
        has = f"has {', '.join(dict.fromkeys(found))}" if set(found) != {"None"} else "sets nothing of that name"
        raise UserError(f"no cell has {text!r}: the grid {has}; write name=value,value")
