"""Settings of a stage: its own, and the options of the parts that were chosen by name.

Every method, corruption, fine-tuning algorithm and frame encoder names a dataclass of its options. In Python they are
nested in the stage's config; on the command line and in records all settings stand in one list by their names.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields
from inspect import get_annotations
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, get_args, get_origin, get_type_hints

from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_outside, refuse_unknown
from vd4rl_pomdp.core.reading import fits
from vd4rl_pomdp.core.registry import REGISTRIES
from vd4rl_pomdp.core.settings import LABELS, NO_SETTINGS

Limits = Mapping[str, float | tuple[float, float]]
"""Lowest, or lowest and highest, value of numbers by name."""


@dataclass(frozen=True)
class Options:
    """Options of a part that has none. Subclasses add fields with a default and a docstring, which become flags."""

    limits: ClassVar[Limits] = {}
    """What the numbers among a class's own fields may be."""

    def __post_init__(self) -> None:
        _adapt(self)

    @classmethod
    def fill(cls, values: Mapping[str, Any]) -> Self:
        """Options with those of many values that they have a field for, and their own defaults."""
        return cls(**{field.name: values[field.name] for field in fields(cls) if field.name in values})

    def check(self) -> None:
        """Raise UserError for a value that cannot work, here or in options within."""
        _refuse_types(self)
        for kind in type(self).__mro__:
            refuse_outside(self, **vars(kind).get("limits", {}))
        check_options(self)


_KINDS = {bool: "True or False", int: "an integer", float: "a number", str: "a word", Path: "a path"}
_TAKEN = NO_SETTINGS | {*LABELS, "format", "help"}
"""Names by which runs are known, and which no option of a part can have: records and reports take them for these."""


def _adapt(config: Any) -> None:
    """Make an integer a float, and a word a path, where that is what is wanted: records know one form of each."""
    hints = get_type_hints(type(config))
    for field in fields(config):
        value, hint = getattr(config, field.name), hints[field.name]
        wanted = get_args(hint) or (hint,)
        if type(value) is int and float in wanted and int not in wanted:
            object.__setattr__(config, field.name, float(value))
        if type(value) is str and Path in wanted and str not in wanted:
            object.__setattr__(config, field.name, Path(value))


NO_OPTIONS = Options()


def _refuse_types(config: Any) -> None:
    """Raise UserError for a value that is not of its annotated type."""
    hints = get_type_hints(type(config))
    for option in fields(config):
        value, hint = getattr(config, option.name), hints[option.name]
        if fits(value, hint):
            continue
        if get_origin(hint) is Literal:
            raise UserError(f"{flag_of(option.name)} is {value!r}: choose one of {', '.join(map(str, get_args(hint)))}")
        raise UserError(f"{flag_of(option.name)} is {value!r}: it must be {_KINDS.get(hint, hint)}")


def flat(config: Any) -> dict[str, Any]:
    """All settings of a config by name, its options' included.

    Raises:
        UserError: two of them have one name, so that one flag would set both, and a record hold one of them.
    """
    found: dict[str, Any] = {}
    owners: dict[str, str] = {}
    for owner, name, value in _settings(config):
        if name in found:
            raise UserError(
                f"{owners[name]} and {owner} both have the setting {name!r}, and {flag_of(name)} cannot set two: "
                "rename it in the part of your own"
            )
        found[name], owners[name] = value, owner
    return found


def words_of(settings: Mapping[str, Any]) -> list[str]:
    """Settings as words of a command line."""
    words: list[str] = []
    for name, value in settings.items():
        flag = flag_of(name)
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{flag[2:]}")
        else:
            words += [f"{flag}={value}"] if str(value).startswith("-") else [flag, str(value)]
    return words


def _settings(config: Any) -> Iterator[tuple[str, str, Any]]:
    """Class, name and value of every setting of a config, its options' included."""
    for field in fields(config):
        value = getattr(config, field.name)
        nested = options_in(value)
        if nested is None:
            yield type(config).__name__, field.name, value
        for options in nested or ():
            yield from _settings(options)


def options_in(value: Any) -> tuple[Options, ...] | None:
    """The options that a field holds; None for a field that is a setting itself."""
    if isinstance(value, Options):
        return (value,)
    return value if isinstance(value, tuple) and all(isinstance(part, Options) for part in value) else None


def check_options(config: Any) -> None:
    """Raise UserError for a value that cannot work among all options of a config."""
    for field in fields(config):
        for options in options_in(getattr(config, field.name)) or ():
            options.check()


def refuse_options(kind: Any, base: type[Options] = Options) -> None:
    """Raise UserError for what cannot be the class of a part's options: flags or records would lose some of them.

    Args:
        kind: what a part names as this class.
        base: a class that it is, or is derived from.
    """
    if not (isinstance(kind, type) and issubclass(kind, base)):
        raise UserError(
            f"its options are {kind!r}: name a class that is derived from {base.__module__}.{base.__name__}"
        )
    for fault in (*_undecorated(kind), *_unkept(kind), *_unlimited(kind)):
        raise UserError(fault)
    flat(kind.fill({}))


def _undecorated(kind: type[Options]) -> Iterator[str]:
    """Classes whose fields are no options, because nothing made them fields."""
    for base in kind.__mro__:
        own = [hint for hint in get_annotations(base).values() if "ClassVar" not in str(hint)]
        if own and issubclass(base, Options) and "__dataclass_fields__" not in vars(base):
            yield f"{base.__name__} has options, but is no dataclass: write @dataclass(frozen=True) above it"


def _unkept(kind: type[Options]) -> Iterator[str]:
    """Fields that cannot be options: by their names, or because no record gives back their values."""
    for field in fields(kind):
        where = f"the option {field.name!r} of {kind.__name__}"
        if hasattr(Options, field.name):
            yield f"{where} hides Options.{field.name}: rename it"
        if field.name in _TAKEN:
            yield f"{where} has a name by which runs are known (labels, seed, folders, logging): rename it"
        default = field.default if field.default_factory is MISSING else field.default_factory()
        if not isinstance(default, bool | int | float | str | Options | None):
            yield f"{where} needs a default that is a number, a word, a truth value or None: records keep nothing else"


def _unlimited(kind: type[Options]) -> Iterator[str]:
    """Names in `limits` that are not those of numbers."""
    defaults = {field.name: field.default for field in fields(kind)}
    for base in kind.__mro__:
        for name in vars(base).get("limits", {}):
            default = defaults.get(name, "")
            if isinstance(default, bool) or not isinstance(default, int | float | None):
                yield f"limits of {base.__name__} name {name!r}, which is no number among its options: mend the name"


@dataclass(frozen=True, kw_only=True)
class StageConfig:
    """Settings of a stage; `of` makes them from names and values."""

    preset: str = "paper"
    """paper, cpu or smoke: the defaults of all other settings."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}}
    """Values by setting, by preset; an option is taken where the chosen parts have it."""
    choosers: ClassVar[tuple[str, ...]] = ()
    """Settings that choose parts, and with them which options there are."""

    def __post_init__(self) -> None:
        _adapt(self)

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        """Options of the chosen parts, by the field that holds them, taking what `values` has for them."""
        return {}

    @classmethod
    def of(cls, preset: str = "paper", **settings: Any) -> Self:
        """Settings of the stage.

        Args:
            preset: what decides the defaults.
            settings: values by name, of the stage's own settings and of the chosen parts' options.

        Raises:
            UserError: an unknown preset or part, a setting that nothing reads, or one that two parts have.
        """
        values = cls.defaults(preset) | settings
        parts = cls.parts(values)
        own = {field.name for field in fields(cls)} - parts.keys()
        config = cls(**({name: values[name] for name in own} | parts))
        config.check_read(settings)
        return config

    @classmethod
    def defaults(cls, preset: str) -> dict[str, Any]:
        """Default values of a preset: the stage's own, and those that it has for options of parts."""
        refuse_unknown("preset", preset, cls.presets)
        return flat(cls()) | dict(cls.presets[preset]) | {"preset": preset}

    def check_read(self, names: Iterable[str]) -> None:
        """Raise UserError for the first of some settings that this config has not: set, it would change nothing."""
        known = flat(self)
        for name in names:
            if name not in known:
                raise UserError(f"{flag_of(name)} is not read by {_reader(self.choosers, name, known)}: leave it out")

    def check(self) -> None:
        """Refuse settings that cannot work, before anything is read or written."""
        _refuse_types(self)
        check_options(self)

    def altered(self, **changes: Any) -> Self:
        """The same with other settings, perhaps other parts; what differs from the preset's defaults is kept.

        Raises:
            UserError: a setting that was not the default is not read by what is now chosen.
        """
        usual = self.usual()
        told = {name: value for name, value in flat(self).items() if value != usual.get(name)}
        return type(self).of(**({"preset": self.preset} | self._chosen() | told | changes))

    def with_known(self, **settings: Any) -> Self:
        """The same with those of some settings that it has: sizes, say, for whatever parts are chosen."""
        known = flat(self)
        return self.altered(**{name: value for name, value in settings.items() if name in known})

    def usual(self) -> dict[str, Any]:
        """What the settings would be if nothing had been chosen but preset and parts."""
        return flat(type(self).of(self.preset, **self._chosen()))

    def _chosen(self) -> dict[str, Any]:
        """The parts, other than those that another part's options name."""
        own = flat(type(self)())
        return {name: value for name, value in flat(self).items() if name in self.choosers and name in own}


def option_names() -> set[str]:
    """Names of the options of all parts that there are."""
    kinds, found = [Options], set[str]()
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        found |= {field.name for field in fields(kind)}
    return found


def _reader(choosers: Iterable[str], name: str, values: Mapping[str, Any]) -> str:
    """What would read a setting if it were chosen otherwise: the one part, or all that was chosen."""
    for setting in choosers:
        parts: Mapping[str, Any] = REGISTRIES.get(setting, {})
        readers = [key for key, part in parts.items() if name in flat(getattr(part, "options", part).fill({}))]
        if readers and values[setting] not in (*readers, "method"):
            return f"the {REGISTRIES[setting].kind} {values[setting]}"
    chosen = (f"{setting.replace('_', ' ')} {values[setting]}" for setting in choosers if setting in values)
    return f"what is chosen ({', '.join(chosen)})"
