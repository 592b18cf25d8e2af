"""Settings of a stage: its own, and the options of the plug-ins chosen by name.

Every method, corruption, algorithm and frame encoder has a dataclass of options. In Python these are nested in the
stage's config; on the command line and in records all settings form one flat list.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
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
"""Config fields that do not affect results, so a run may resume with other values. `data` and `encoder` may move, since
they are compared by content. `eval_clean` and `eval_clean_episodes` only add rows."""
NO_SETTINGS = RUNTIME_FIELDS | {"seed"}
"""Config fields that may differ between the seeds of one experiment."""

LATER = {"future_frames": "all", "view_seed": None, "keep_newest": False, "hold_out": False}
"""Settings that earlier versions did not record, with the value they implied: this value counts as absent."""

LABELS = ("method", "task", "quality", "corruption", "algorithm", "seed")
"""Columns that identify a run's rows."""

_FLOAT = (float, float | None, "float", "float | None")  # a field's type is text under postponed annotations

Limits = Mapping[str, float | tuple[float, float]]
"""By name, a number's minimum, or minimum and maximum."""


@dataclass(frozen=True)
class Options:
    """Options of a plug-in; here none. Subclass fields need a default and a docstring and become flags."""

    limits: ClassVar[Limits] = {}
    """Valid ranges of the class's own numeric fields."""

    @classmethod
    def fill(cls, values: Mapping[str, Any]) -> Self:
        """Options from the entries of `values` that match a field, and defaults for the rest."""
        return cls(**{field.name: values[field.name] for field in fields(cls) if field.name in values})

    def check(self) -> None:
        """Raise UserError for a number out of range, here or in nested options."""
        for kind in type(self).__mro__:
            refuse_outside(self, **vars(kind).get("limits", {}))
        check_options(self)


NO_OPTIONS = Options()


@dataclass(frozen=True, kw_only=True)
class StageConfig:
    """Settings of a stage; build one with `of`."""

    preset: str = "paper"
    """paper, cpu or smoke: sets the defaults of all other settings."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}}
    """Values by setting for each preset. Values for options that the chosen plug-ins lack are ignored."""
    choosers: ClassVar[tuple[str, ...]] = ()
    """Settings that choose plug-ins and thereby decide which options exist."""

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        """Options of the chosen plug-ins by the field that holds them, filled from `values`."""
        return {}

    @classmethod
    def of(cls, preset: str = "paper", **settings: Any) -> Self:
        """Build the config from values by name, of the stage's own settings and of the chosen plug-ins' options.

        UserError for an unknown preset or plug-in, or a setting that nothing reads.
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
        """Defaults of a preset, for the stage's own settings and for plug-in options."""
        refuse_unknown("preset", preset, cls.presets)
        return flat(cls()) | dict(cls.presets[preset]) | {"preset": preset}

    def check(self) -> None:
        """Raise UserError for invalid settings, before anything is read or written."""
        check_options(self)

    def with_known(self, **settings: Any) -> Self:
        """A copy with those of the given settings that exist here, e.g. sizes, whatever plug-ins are chosen."""
        known = flat(self)
        return type(self).of(**(known | {name: value for name, value in settings.items() if name in known}))


def options_in(value: Any) -> tuple[Options, ...] | None:
    """The options held by a field; None if the field is itself a setting."""
    if isinstance(value, Options):
        return (value,)
    return value if isinstance(value, tuple) and all(isinstance(part, Options) for part in value) else None


def check_options(config: Any) -> None:
    """Raise UserError for a number out of range in the options that a config holds."""
    for field in fields(config):
        for options in options_in(getattr(config, field.name)) or ():
            options.check()


def flat(config: Any) -> dict[str, Any]:
    """All settings of a config by name, with nested options; UserError if two share a name and thus a flag.

    A whole number for a float field becomes a float, as on the command line: 5 and 5.0 are one setting, with one hash.
    """
    found: dict[str, Any] = {}
    owners: dict[str, str] = {}

    def add(config: Any) -> None:
        owner = type(config).__name__
        for field in fields(config):
            name, value = field.name, getattr(config, field.name)
            nested = options_in(value)
            for options in nested or ():
                add(options)
            if nested is not None:
                continue
            if name in found:
                raise UserError(
                    f"{owners[name]} and {owner} both have the setting {name!r}, so {flag_of(name)} would be "
                    "ambiguous: rename it in your own part"
                )
            whole = type(value) is int and field.type in _FLOAT
            found[name], owners[name] = float(value) if whole else value, owner

    add(config)
    return found


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """A stage's config in JSON form without NO_SETTINGS: equal for all seeds of one experiment.

    Runs with different settings are never treated as seeds of one experiment.
    """
    return {
        name: value
        for name, value in config.items()
        if name not in NO_SETTINGS and (name not in LATER or value != LATER[name])
    }


def words_of(settings: Mapping[str, Any]) -> list[str]:
    """Settings as command-line words: {"max_k": 3} -> ["--max-k", "3"]."""
    words: list[str] = []
    for name, value in settings.items():
        flag = flag_of(name)
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{flag[2:]}")
        else:
            words += [f"{flag}={value}"] if str(value).startswith("-") else [flag, str(value)]
    return words


def refuse_options(kind: Any, base: type[Options] = Options) -> None:
    """Raise UserError unless `kind`, what a plug-in gives as its options class, is a valid subclass of `base`."""
    if not (isinstance(kind, type) and issubclass(kind, base)):
        public = base.__module__.replace("vd4rl_pomdp.core.", "vd4rl_pomdp.")
        raise UserError(f"its options are {kind!r}: name a dataclass that is derived from {public}.{base.__name__}")
    own = {field.name: field for field in fields(kind)}
    if unset := [name for name, field in own.items() if field.default is field.default_factory is MISSING]:
        raise UserError(f"its option {unset[0]!r} has no default: give it one")
    for name in (name for one in kind.__mro__ for name in vars(one).get("limits", {}) if name not in own):
        raise UserError(f"its limits name {name!r}, which is none of its options: correct the name")
    usual = kind.fill({})
    Options.check(usual)  # ranges only: a part's own check may require an option
    for name, value in flat(usual).items():
        # records would leave it out, so that runs or encoders with other values would count as the same
        if name in NO_SETTINGS or name in LABELS or LATER.get(name, value) != value:
            raise UserError(f"the name of its option {name!r} is taken: choose another")
