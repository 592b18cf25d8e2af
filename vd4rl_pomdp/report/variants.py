"""Variants of a method: the settings that differ among its runs, in words that stand beside the method's name.

Runs are seeds of one experiment only if they agree in everything but seed, folders, device and logging. A fine-tuning
run has its own config, its encoder's, and the data of both.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from vd4rl_pomdp.core.settings import LATER, settings_of
from vd4rl_pomdp.corruptions import corruption_settings

Settings = dict[str, str]
"""Values as words, by the name that is shown beside them."""
Parts = tuple[str, str]
"""What differs among all runs of a method, and of the data among those of one setting."""

UNKNOWN = "pretraining"
"""Key in the settings of a run whose encoder does not say how it was pretrained."""
_NOT_RECORDED = "not recorded"
_UNSET = "unset"
_PRESETS = ("preset", "pretraining preset")
DATA = ("data", "pretraining data")
"""Names of the sets' fingerprints."""
OF_CORRUPTION = "corruption "
"""What the names of a corruption's settings begin with: other parts may have options of the same names."""
ENCODER_SEED = "pretraining seed"
"""The seed of a run's encoder, where the run's own is another: its seeds share what they were pretrained with."""
PLAIN = {
    **{"history": "method", "random_histories": "0", "history_window": "0", "readout": "state"},
    **{"pose_noise": "0", "velocity_noise": "0"},
    **LATER,
}
"""Values that add nothing to a method: what has them goes by the method's name, and others are its variants."""
_LABELS = ("method", "task", "quality")
"""Fields that are a run's labels, not its settings."""


def read_settings(record: Mapping[str, Any], card: Mapping[str, Any]) -> Settings:
    """All settings behind a run, those of a corruption with OF_CORRUPTION before their names.

    Args:
        record: its config.json.
        card: its encoder's card, empty for a pretraining run or where there is none.
    """
    own, hiding = settings_of(record["config"]), dict(card.get("corruption", {}))
    if record["stage"] == "pretrain":
        hiding = {name: own[name] for name in corruption_settings(str(own.get("corruption"))) if name in own}
        own = without(own, hiding)
    before = {name: card[name] for name in ("steps", "preset") if name in card} | (card.get("settings") or {})
    found = own | {(f"pretraining {k}" if k in own else k): v for k, v in without(before, hiding).items()}
    found |= {OF_CORRUPTION + name: value for name, value in hiding.items()}
    found |= {"format": record["format"]} if "format" in record else {}
    words = {name: _words(value) for name, value in found.items() if name not in _LABELS}
    if record["stage"] == "finetune" and not card.get("settings"):
        words[UNKNOWN] = _NOT_RECORDED
    if card.get("seed", record["config"]["seed"]) != record["config"]["seed"]:
        words[ENCODER_SEED] = str(card["seed"])
    return words | _data(record.get("inputs", {}).get("data"), card.get("data"))


def of_corruption(settings: Settings) -> Settings:
    """Those of some settings that are a corruption's."""
    return {name: value for name, value in settings.items() if name.startswith(OF_CORRUPTION)}


def without(settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Settings but those of some names."""
    return {name: value for name, value in settings.items() if name not in names}


def is_plain(settings: Settings, history: str = "method") -> bool:
    """Whether settings add nothing to a method but a history; what is not recorded adds nothing."""
    wanted = PLAIN | {"history": history}
    return all(settings.get(name, PLAIN[name]) == value for name, value in wanted.items())


def unlike(one: Settings, other: Settings, names: Collection[str]) -> list[str]:
    """Which of some settings differ, but for what a method is named by; a preset stands for the others."""
    found = [name for name in one if name in names and name not in PLAIN and one[name] != other[name]]
    return [name for name in found if name in _PRESETS] or found


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


def of_sets(settings: Sequence[Settings], sets: Sequence[str]) -> dict[str, Settings]:
    """Settings that go by the set, such as a budget: every run on a set has them so, and those on another otherwise.

    Args:
        settings: of all runs that are looked at together.
        sets: task and quality of each run.

    Returns:
        By set, its values of these settings.
    """
    found: dict[str, dict[str, set[str]]] = {}
    for one, place in zip(settings, sets, strict=True):
        for name in one.keys() - {UNKNOWN, ENCODER_SEED, *DATA}:
            found.setdefault(name, {}).setdefault(place, set()).add(one[name])
    own = {
        name: {place: min(values) for place, values in by_set.items()}
        for name, by_set in found.items()
        if all(len(values) == 1 for values in by_set.values()) and len(set().union(*by_set.values())) > 1
    }
    return {
        place: {name: own[name][place] for name in sorted(own) if place in own[name]} for place in dict.fromkeys(sets)
    }


def differences(settings: list[Settings], brief: bool = True) -> list[str]:
    """What differs among some settings: "max_k 1, steps 20"; nothing for a value that adds nothing.

    ENCODER_SEED is told even where it does not differ: no other name says that seeds share an encoder.

    Args:
        settings: those that count, without what goes by the set.
        brief: whether a preset is named in place of the settings that it decides.
    """
    known = dict.fromkeys(name for one in settings for name in one)
    names = [name for name in known if name != ENCODER_SEED and _differs(settings, name)]
    # An option of a chosen part is not there without the part: naming the part says it all.
    everywhere = [name for name in names if all(_value(one, name) != _UNSET for one in settings)]
    names = [name for name in names if name in everywhere or not _decided(settings, name, everywhere)]
    deciding: list[str] = []
    for preset in _PRESETS if brief else ():
        if preset in names and not _decided(settings, preset, deciding):
            deciding.append(preset)
    names = [name for name in names if name in deciding or not _decided(settings, name, deciding)]
    values = [{name: _value(one, name) for name in names} | _encoder_seed(one) for one in settings]
    return [", ".join(f"{k} {v}" for k, v in one.items() if v not in ("", PLAIN.get(k))) for one in values]


def _encoder_seed(settings: Settings) -> Settings:
    return {name: value for name, value in settings.items() if name == ENCODER_SEED}


def _value(settings: Settings, name: str) -> str:
    """A value in words; none where an encoder does not say how it was pretrained."""
    if name in settings:
        return settings[name]
    if name in DATA:
        return _NOT_RECORDED
    return "" if UNKNOWN in settings or name == UNKNOWN else LATER.get(name, _UNSET)


def _differs(settings: list[Settings], name: str) -> bool:
    values = {_value(one, name) for one in settings}
    return len(values if name == UNKNOWN else values - {""}) > 1


def _decided(settings: list[Settings], name: str, by: Iterable[str]) -> bool:
    """Whether a setting that differs is the same wherever those of `by` are."""
    deciding = [tuple(_value(one, other) for other in by) for one in settings]
    pairs = {(first, _value(one, name)) for first, one in zip(deciding, settings, strict=True)}
    return len(pairs) == len(set(deciding))
