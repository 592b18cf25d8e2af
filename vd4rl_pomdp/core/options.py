"""Settings of a stage: its own, and the options of the parts that were chosen by name.

Every method, corruption, fine-tuning algorithm and frame encoder names a dataclass of its options. In Python they are
nested in the stage's config; on the command line and in records all settings stand in one list by their names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self

from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_outside, refuse_unknown

RUNTIME_FIELDS = frozenset(
    {
        "out",
        "device",
        "workers",
        "wandb",
        "tensorboard",
        "data",
        "encoder",
        "eval_clean",
        "eval_clean_episodes",
        "log_every",
        "checkpoint_every",
    }
)
"""Config fields that do not change a result, so that a run may go on with other values; data and encoder may be moved,
and are compared by content; `eval_clean` and the number of its episodes add rows that change no other."""
NO_SETTINGS = RUNTIME_FIELDS | {"seed"}
"""Config fields in which the seeds of one experiment may differ."""

LATER = {"future_frames": "all", "view_seed": None, "keep_newest": False, "hold_out": False}
"""Settings that earlier versions did not record, with what they did: having this value is the same as not having it."""

LABELS = ("method", "task", "quality", "corruption", "algorithm", "seed")
"""What names the rows of a run."""

Limits = Mapping[str, float | tuple[float, float]]
"""Lowest, or lowest and highest, value of numbers by name."""


@dataclass(frozen=True)
class Options:
    """Options of a part that has none. Subclasses add fields with a default and a docstring, which become flags."""

    limits: ClassVar[Limits] = {}
    """What the numbers among a class's own fields may be."""

    @classmethod
    def fill(cls, values: Mapping[str, Any]) -> Self:
        """Options with those of many values that they have a field for, and their own defaults."""
        return cls(**{field.name: values[field.name] for field in fields(cls) if field.name in values})

    def check(self) -> None:
        """Raise UserError for a number out of range, here or in options within."""
        for kind in type(self).__mro__:
            refuse_outside(self, **vars(kind).get("limits", {}))
        _check_options(self)


NO_OPTIONS = Options()


@dataclass(frozen=True, kw_only=True)
class StageConfig:
    """Settings of a stage; `of` makes them from names and values."""

    preset: str = "paper"
    """paper, cpu or smoke: the defaults of all other settings."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}}
    """Values by setting, by preset; an option is taken where the chosen parts have it."""
    choosers: ClassVar[tuple[str, ...]] = ()
    """Settings that choose parts, and with them which options there are."""

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
        known = flat(config)
        for name in settings.keys() - known.keys():
            chosen = (f"the {c.replace('_', ' ')} {values[c]}" for c in cls.choosers if c in values)
            raise UserError(f"{flag_of(name)} is not read by {', '.join(chosen)}: leave it out")
        return config

    @classmethod
    def defaults(cls, preset: str) -> dict[str, Any]:
        """Default values of a preset: the stage's own, and those that it has for options of parts."""
        refuse_unknown("preset", preset, cls.presets)
        return flat(cls()) | dict(cls.presets[preset]) | {"preset": preset}

    def check(self) -> None:
        """Refuse settings that cannot work, before anything is read or written."""
        _check_options(self)

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


def options_in(value: Any) -> tuple[Options, ...] | None:
    """The options that a field holds; None for a field that is a setting itself."""
    if isinstance(value, Options):
        return (value,)
    return value if isinstance(value, tuple) and all(isinstance(part, Options) for part in value) else None


def _check_options(config: Any) -> None:
    for field in fields(config):
        for options in options_in(getattr(config, field.name)) or ():
            options.check()


def flat(config: Any) -> dict[str, Any]:
    """All settings of a config by name, its options' included.

    Raises:
        UserError: two of them have one name, so that one flag would set both, and a record hold one of them.
    """
    found: dict[str, Any] = {}
    owners: dict[str, str] = {}

    def settings(config: Any) -> Iterator[tuple[str, str, Any]]:
        for field in fields(config):
            value = getattr(config, field.name)
            nested = options_in(value)
            if nested is None:
                yield type(config).__name__, field.name, value
            for options in nested or ():
                yield from settings(options)

    for owner, name, value in settings(config):
        if name in found:
            raise UserError(
                f"{owners[name]} and {owner} both have the setting {name!r}, and {flag_of(name)} cannot set two: "
                "rename it in the part of your own"
            )
        found[name], owners[name] = value, owner
    return found


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """A stage's config, as JSON keeps it, without NO_SETTINGS: the same for all seeds of an experiment.

    Runs are seeds of one experiment only if their settings agree.
    """
    told = {name: value for name, value in config.items() if name not in NO_SETTINGS}
    return {name: value for name, value in told.items() if name not in LATER or value != LATER[name]}


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


def refuse_options(kind: Any, base: type[Options] = Options) -> None:
    """Raise UserError for what cannot be the class of a part's options.

    Args:
        kind: what a part names as this class.
        base: a class that it is, or is derived from.
    """
    if not (isinstance(kind, type) and issubclass(kind, base)):
        raise UserError(
            f"its options are {kind!r}: name a dataclass that is derived from {base.__module__}.{base.__name__}"
        )
    flat(kind.fill({}))
