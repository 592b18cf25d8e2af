"""Variants of a method: the settings that differ among its runs, in words that stand beside the method's name.

Runs are seeds of one experiment only if they agree in everything but seed, folders, device and logging. A fine-tuning
run has its own config, its encoder's, and the data of both.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from typing import Any

from vd4rl_pomdp.core.options import LATER, settings_of
from vd4rl_pomdp.corruptions import corruption_settings
from vd4rl_pomdp.runs.files import groups

Settings = dict[str, str]
"""Values as words, by the name that is shown beside them."""
Parts = tuple[str, str]
"""What differs among all runs of a method, and of the data among those of one setting."""

_UNSET = "unset"
PRESETS = ("preset", "pretraining preset")
DATA = ("data", "pretraining data")
"""Names of the sets' fingerprints."""
OF_CORRUPTION = "corruption "
"""What the names of a corruption's settings begin with: other parts may have options of the same names."""
ENCODER_SEED = "pretraining seed"
"""The seed of a run's encoder, where the run's own is another: its seeds share what they were pretrained with."""


def _words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


PLAIN = {
    **{"history": "method", "random_histories": "0", "history_window": "0", "readout": "state"},
    **{"pose_noise": "0", "velocity_noise": "0"},
    **{name: _words(value) for name, value in LATER.items()},
}
"""Values that add nothing to a method: what has them goes by the method's name, and others are its variants."""


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
    words = {name: _words(value) for name, value in found.items() if name not in ("method", "task", "quality")}
    if card.get("seed", record["config"]["seed"]) != record["config"]["seed"]:
        words[ENCODER_SEED] = str(card["seed"])
    data, first = record.get("inputs", {}).get("data"), card.get("data")
    prints = zip(DATA, (data, "the same" if data and first == data else first), strict=True)
    return words | {name: value[:8] for name, value in prints if value}


def of_corruption(settings: Settings) -> Settings:
    """Those of some settings that are a corruption's."""
    return {name: value for name, value in settings.items() if name.startswith(OF_CORRUPTION)}


def without(settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Settings but those of some names."""
    return {name: value for name, value in settings.items() if name not in names}


def without_sets(settings: Sequence[Settings], sets: Sequence[str], alike: Sequence[Hashable]) -> list[Settings]:
    """Settings but those that go by the set, such as a budget: runs on one set agree in them, and the sets differ.

    Args:
        settings: of every run.
        sets: task and quality of every run.
        alike: what runs share that are looked at together.
    """
    # A task's own budget is no ablation: as a variant it would make two methods of one, and gaps on every other task.
    kept = [dict(one) for one in settings]
    for places in groups(range(len(settings)), alike.__getitem__).values():
        for name in {name for i in places for name in settings[i]} - {ENCODER_SEED, *DATA}:
            having = groups((i for i in places if name in settings[i]), sets.__getitem__)
            values = [{settings[i][name] for i in mine} for mine in having.values()]
            if all(len(found) == 1 for found in values) and len(set().union(*values)) > 1:
                for i in places:
                    kept[i].pop(name, None)
    return kept


def differences(settings: Sequence[Settings], alike: Sequence[Hashable]) -> list[str]:
    """What differs of each run's settings among those that are alike, in words; nothing where none are recorded."""
    words = [""] * len(settings)
    for places in groups((i for i, own in enumerate(settings) if own), alike.__getitem__).values():
        for i, told in zip(places, _differences([settings[i] for i in places]), strict=True):
            words[i] = told
    return words


def _differences(settings: Sequence[Settings]) -> list[str]:
    """What differs among some settings: "max_k 1, steps 20"; nothing for a value that adds nothing.

    ENCODER_SEED is told even where it does not differ: no other name says that seeds share an encoder. A preset is
    named in place of the settings that it decides.
    """
    names = [name for name in dict.fromkeys(name for one in settings for name in one) if name != ENCODER_SEED]
    columns = {name: [one.get(name, PLAIN[name] if name in LATER else _UNSET) for one in settings] for name in names}
    columns = {name: column for name, column in columns.items() if len(set(column)) > 1}
    # An option of a chosen part is not there without the part: naming the part says it all.
    everywhere = [name for name, column in columns.items() if _UNSET not in column]
    columns = {name: column for name, column in columns.items() if not _decided(name, columns, everywhere)}
    presets: list[str] = []
    for name in PRESETS:
        if name in columns and not _decided(name, columns, presets):
            presets.append(name)
    columns = {name: column for name, column in columns.items() if not _decided(name, columns, presets)}
    told = [{name: column[i] for name, column in columns.items()} for i in range(len(settings))]
    for own, one in zip(told, settings, strict=True):
        own |= {name: value for name, value in one.items() if name == ENCODER_SEED}
    return [", ".join(f"{name} {value}" for name, value in own.items() if value != PLAIN.get(name)) for own in told]


def _decided(name: str, columns: Mapping[str, list[str]], by: Sequence[str]) -> bool:
    """Whether a setting has the same value wherever others, of which it is none, have the same."""
    deciding = list(zip(*(columns[other] for other in by), strict=True)) or [()] * len(columns[name])
    return name not in by and len(set(zip(deciding, columns[name], strict=True))) == len(set(deciding))
