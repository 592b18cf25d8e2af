"""What tells runs of one method apart: the settings that differ among them, in words beside the method's name.

Runs are seeds of one experiment only if they agree in everything but seed, folders, device and logging. A fine-tuning
run has its own config, its encoder's, and the data of both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.runs.settings import settings_of

Settings = dict[str, str]
"""Values as words, by the name that is shown beside them."""
Parts = tuple[str, str, str]
"""What differs among all runs of a method, among those of one corruption, and among those of one set and corruption."""

UNKNOWN = "pretraining"
"""Stands in the settings of a run whose encoder does not say how it was pretrained."""
_NOT_RECORDED = "not recorded"
_PRESETS = ("preset", "pretraining preset")
_CORRUPTION = frozenset(field.name for field in fields(CorruptionConfig))
_DATA = ("data", "pretraining data")
_LABELS = ("method", "task", "quality")
"""Fields that name a run's rows; they are no settings."""


def read_settings(record: Mapping[str, Any], card: Mapping[str, Any]) -> Settings:
    """All settings behind a run.

    Args:
        record: its config.json.
        card: its encoder's card, empty for a pretraining run or where there is none.
    """
    own = settings_of(record["config"])
    before = dict(card.get("corruption", {})) | {name: card[name] for name in ("steps", "preset") if name in card}
    before |= card.get("settings") or {}
    found = own | {(f"pretraining {k}" if k in own else k): v for k, v in before.items()}
    words = {name: _words(value) for name, value in found.items() if name not in _LABELS}
    if record["stage"] == "finetune" and not card.get("settings"):
        words[UNKNOWN] = _NOT_RECORDED
    return words | _data(record.get("inputs", {}).get("data"), card.get("data"))


def _data(own: str | None, before: str | None) -> Settings:
    """Short fingerprints of the sets behind a run, as far as they are recorded."""
    shown = {"data": own, "pretraining data": "the same" if own and before == own else before}
    return {name: value[:8] for name, value in shown.items() if value}


def _words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def differences(settings: list[Settings], corruption: list[str], place: list[tuple], brief: bool = True) -> list[Parts]:
    """Words for what differs among runs of one method, run by run.

    Args:
        settings: of the runs.
        corruption: the name of each run's corruption: other fields of it are told apart within one name.
        place: where each run stands (task, quality, corruption): sets are told apart within one place.
        brief: whether a preset stands for all the settings that it decides.
    """
    shared = [{k: v for k, v in one.items() if k not in _CORRUPTION and k not in _DATA} for one in settings]
    of_corruption = [{k: v for k, v in one.items() if k in _CORRUPTION} for one in settings]
    data = [{k: v for k, v in one.items() if k in _DATA} for one in settings]
    columns = (
        _name(shared, "unset", brief),
        _by_scope(of_corruption, corruption, "unset", brief),
        _by_scope(data, place, _NOT_RECORDED, brief),
    )
    return list(zip(*columns, strict=True))


def _by_scope(settings: list[Settings], scope: Sequence[Any], absent: str, brief: bool) -> list[str]:
    words = [""] * len(settings)
    for key in dict.fromkeys(scope):
        members = [number for number, other in enumerate(scope) if other == key]
        for number, text in zip(members, _name([settings[i] for i in members], absent, brief), strict=True):
            words[number] = text
    return words


def _name(settings: list[Settings], absent: str, brief: bool) -> list[str]:
    """What differs among some settings: "max_k 1, patch_size 48"."""
    names = [name for name in dict.fromkeys(n for one in settings for n in one) if _differs(settings, name, absent)]
    deciding: list[str] = []
    for preset in _PRESETS if brief else ():
        if preset in names and not _decided(settings, preset, deciding, absent):
            deciding.append(preset)
    names = [n for n in names if n in deciding or not _decided(settings, n, deciding, absent)]
    return [", ".join(f"{n} {v}" for n in names if (v := _value(one, n, absent))) for one in settings]


def _value(settings: Settings, name: str, absent: str) -> str:
    """A value in words; none where it is not known."""
    unknown = "" if UNKNOWN in settings or name == UNKNOWN else absent
    return settings.get(name, unknown)


def _differs(settings: list[Settings], name: str, absent: str) -> bool:
    values = {_value(one, name, absent) for one in settings}
    return len(values if name == UNKNOWN else values - {""}) > 1


def _decided(settings: list[Settings], name: str, by: Iterable[str], absent: str) -> bool:
    """Whether a setting that differs is the same wherever those of `by` are."""
    deciding = [tuple(_value(one, other, absent) for other in by) for one in settings]
    pairs = {(first, _value(one, name, absent)) for first, one in zip(deciding, settings, strict=True)}
    return len(pairs) == len(set(deciding))
