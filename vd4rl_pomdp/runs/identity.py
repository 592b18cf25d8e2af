"""What a run computes, by name: equal for equal settings, seed, data and format, whatever its folder and its machine.

A run's `recipe` can be told before its data exist; with the fingerprints of the data it becomes its `identity`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from vd4rl_pomdp.core.settings import settings_of


def identity(record: Mapping[str, Any], card: Mapping[str, Any]) -> str:
    """Name of what a run computes, 24 characters.

    Args:
        record: its config.json.
        card: what the encoder it started from says of its pretraining; empty for a pretraining run.
    """
    inputs = record.get("inputs", {})
    named = record["config"].get("exogenous")
    images = inputs.get("exogenous", named)  # the content of a folder; the name again of those that are made
    own = [] if images == named else [images]
    return content_hash([recipe(record, card), inputs.get("data"), card.get("data"), *own])


def recipe(record: Mapping[str, Any], card: Mapping[str, Any]) -> str:
    """Name of what a run computes but for the content of its data, likewise."""
    own = settings_of(record["config"]) | {"seed": record["config"]["seed"]}
    before = {"settings": card["settings"], "seed": card["seed"]} if card else {}
    return content_hash([record.get("format", 1), record["stage"], own, before])


def content_hash(told: Any) -> str:
    """Name of what can be written as JSON, 24 characters."""
    return hashlib.blake2b(json.dumps(told, sort_keys=True).encode(), digest_size=12).hexdigest()
