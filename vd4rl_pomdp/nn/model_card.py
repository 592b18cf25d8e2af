"""An encoder folder's README.md: a model card as the Hugging Face Hub reads it, told from its config.json alone."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from vd4rl_pomdp.core.text import code, code_block, one_line
from vd4rl_pomdp.nn.encoder import EncoderRecord

CARD = "README.md"
LICENSE = "mit"
"""What the package and V-D4RL's sets have."""
TAGS = ("reinforcement-learning", "offline-reinforcement-learning", "partial-observability", "representation-learning")


def model_card(record: EncoderRecord, repository: str = "", license: str = LICENSE) -> str:
    """Text of the card.

    Args:
        record: an encoder folder's config.json.
        repository: OWNER/NAME on the Hub from which the card's code loads it; empty: from the card's own folder.
        license: the licence that its owner gives it, as the Hub spells it; empty: the card names none.
    """
    card = record.pretrain
    tags = dict.fromkeys([*TAGS, card.method, card.task, card.corruption["corruption"]])
    values: dict[str, Any] = {"license": license} if license else {}
    values |= {"library_name": "vd4rl-pomdp", "pipeline_tag": TAGS[0]}
    return "\n".join(
        [
            *front_matter(values | {"tags": [one_line(tag) for tag in tags]}),
            "",
            f"# {code(card.method)} on {code(card.task)}",
            "",
            "An encoder of observations that are seen in part only, pretrained offline by `vd4rl-pomdp`.",
            "",
            "| | |",
            "|---|---|",
            *(f"| {name} | {value} |" for name, value in _facts(record)),
            *([f"| licence | {code(license)} |"] if license else []),
            "",
            "## Use it",
            "",
            *code_block(_loading(repository), "python"),
            "",
            "`encoder.encode` takes windows of rows, `encoder.step` single rows, corrupted as in its pretraining:",
            "`docs/use_an_encoder.md` of the package shows both.",
            "",
            "## Settings",
            "",
            *code_block(json.dumps(asdict(card), indent=2).splitlines(), "json"),
            "",
        ]
    )


def front_matter(values: dict[str, Any]) -> list[str]:
    """YAML, its texts as JSON has them, which is YAML, too."""
    return ["---", *(f"{name}: {json.dumps(value)}" for name, value in values.items()), "---"]


def _facts(record: EncoderRecord) -> Iterator[tuple[str, str]]:
    card, shape = record.pretrain, record.encoder
    yield "method", code(card.method)
    yield "task, quality", f"{code(card.task)}, {code(card.quality)}"
    yield "data", f"fingerprint {code(card.data)}" if card.data else "not recorded"
    yield "corruption", code(json.dumps(card.corruption))
    yield "budget", _budget(record)
    yield "seed", str(card.seed)
    yield "encoder", f"{code(shape.frame_encoder)}, {shape.feature_dim} features, memory: {code(shape.history)}"
    yield "linear probe", _probe(record.probe)
    yield (
        "made by",
        f"vd4rl-pomdp {one_line(record.version)}" + (f", commit {code(record.commit)}" if record.commit else ""),
    )


def _budget(record: EncoderRecord) -> str:
    card, frames = record.pretrain, record.frames
    if card.end_to_end:
        return f"no pretraining: {code(card.end_to_end)} trains it with the policy"
    if frames == 0:
        return "none: it is not trained"
    return f"preset {code(card.preset)}, {card.steps:,} gradient steps" + (f", {frames:,} frames" if frames else "")


def _probe(errors: dict[str, float]) -> str:
    """Errors of `vd4rl_pomdp.probes`, by what was probed."""
    told = [f"{name.removeprefix('probe_')} {error:.1f}%" for name, error in errors.items()]
    return f"error of {', '.join(told)} of a standard deviation, on held-out episodes" if told else "not measured"


def _loading(repository: str) -> list[str]:
    place = f"snapshot_download({json.dumps(repository)})" if repository else '"."'
    hub = ["from huggingface_hub import snapshot_download", ""] if repository else []
    note = "" if repository else "  # this folder"
    return [
        *hub,
        "from vd4rl_pomdp.nn import load_encoder",
        "",
        f"encoder, card = load_encoder({place}){note}",
        "print(card.method, card.task, encoder.dim)",
    ]
