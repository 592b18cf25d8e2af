"""Save and load encoder folders: config.json and model.safetensors, loadable without the code that trained them.

The README.md in the folder is a Hugging Face model card, generated from config.json.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import save
from torch.random import fork_rng

from vd4rl_pomdp.core import __version__
from vd4rl_pomdp.core.errors import UserError, disk_errors, first_line, in_one_line
from vd4rl_pomdp.core.reading import build, parse_json, read_bytes, read_tensors
from vd4rl_pomdp.core.registry import code_of
from vd4rl_pomdp.core.text import code, code_block, one_line
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard, EncoderConfig, EncoderRecord
from vd4rl_pomdp.nn.frame import STATE
from vd4rl_pomdp.runs.files import content_hash, write_bytes, write_json
from vd4rl_pomdp.runs.provenance import git_commit

WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"
FILES_OF_RUN = (f"encoder/{CONFIG}", f"encoder/{WEIGHTS}")
"""An encoder's files, relative to the run folder."""
LICENSE = "mit"
"""Default licence: that of this package and of the V-D4RL data sets."""
TAGS = ("reinforcement-learning", "offline-reinforcement-learning", "partial-observability", "representation-learning")


def save_encoder(folder: Path | str, encoder: Encoder, card: EncoderCard, frames: int | None = None) -> None:
    """Write an encoder folder; `frames` is the number of frames in all pretraining batches, if known."""
    weights = {name: value.cpu().contiguous().clone() for name, value in encoder.state_dict().items()}
    record = EncoderRecord(encoder.config, card, __version__, git_commit(), frames)
    third_party = code_of(record.parts)
    _write(Path(folder), replace(record, plugins=third_party["plugins"], sources=third_party["sources"]), save(weights))


def _write(folder: Path, record: EncoderRecord, weights: bytes) -> None:
    """Write each file atomically, config.json last: without it a folder does not count as an encoder folder."""
    write_bytes(folder / WEIGHTS, weights)
    write_bytes(folder / CARD, model_card(record).encode())
    write_json(folder / CONFIG, asdict(record))


def copy_encoder(source: Path, target: Path, changes: Mapping[str, Any]) -> None:
    """Copy an encoder folder; `changes` are new values of `EncoderConfig` fields, such as {"readout": "frame"}."""
    record = read_record(source)
    _write(target, replace(record, encoder=replace(record.encoder, **changes)), read_bytes(source / WEIGHTS))


def record_probe(folder: Path, errors: Mapping[str, float]) -> None:
    """Record linear probe errors (see `EncoderRecord.probe`) in an encoder folder's config.json and model card."""
    _write(folder, replace(read_record(folder), probe=dict(errors)), read_bytes(folder / WEIGHTS))


def encoder_hash(folder: Path) -> str:
    """Hash of weights, architecture and pretraining settings; independent of path and package version."""
    record, weights = read_record(folder), hashlib.blake2b(read_bytes(folder / WEIGHTS))
    return content_hash([weights.hexdigest(), asdict(record.encoder), asdict(record.pretrain)])


def load_encoder(
    folder: Path | str, task: str | None = None, action_dim: int | None = None, size: int | None = None
) -> tuple[Encoder, EncoderCard]:
    """Load an encoder folder as a frozen module in eval mode.

    UserError if it is missing, damaged or a pickle, or was pretrained for another task, action dimension or image size
    than given; state encoders have no image size.
    """
    folder = Path(folder)
    record = read_record(folder)
    config, card = record.encoder, record.pretrain
    other = ""
    if action_dim not in (None, config.action_dim):
        other = (
            f"was pretrained on {card.task} with {config.action_dim} action dimensions, the dataset has {action_dim}"
        )
    elif size not in (None, config.size) and config.frame_encoder != STATE:
        other = f"reads images of {config.size}x{config.size} pixels, the dataset has {size}x{size}"
    elif task not in (None, card.task):
        other = f"was pretrained on {card.task}, not on {task}"
    if other:
        raise UserError(f"{folder}: this encoder {other}; pretrain one on this dataset")
    try:
        with fork_rng(devices=[]):  # the random initial weights are overwritten: keep the caller's RNG state
            encoder = Encoder(config)
        CorruptionConfig.of(**card.corruption).check()
    except UserError as error:  # a part that nothing has registered here: the encoder itself may be whole
        raise UserError(f"{folder}/config.json: describes no encoder ({error})") from error
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise UserError(
            f"{folder}/config.json: describes no encoder ({first_line(error)}); correct it, or pretrain it again"
        ) from error
    try:
        encoder.load_state_dict(read_tensors(folder / WEIGHTS))
    except RuntimeError as error:
        raise UserError(
            f"{folder}/model.safetensors: does not fit the network that config.json beside it names, whose code may "
            f"have changed ({in_one_line(error)}); use the code it was pretrained with, or pretrain the encoder again"
        ) from error
    except (FileNotFoundError, SafetensorError) as error:
        reason = first_line(error)
        raise UserError(f"{folder}/model.safetensors: cannot be read ({reason}); pretrain the encoder again") from error
    return encoder.eval().requires_grad_(False), card


def read_record(folder: Path) -> EncoderRecord:
    """Read an encoder folder's config.json; UserError if it is missing or damaged, or the folder holds a pickle."""
    with disk_errors(folder):
        pickles = [p.name for p in folder.glob("*") if p.suffix in (".pt", ".pth", ".pkl", ".bin", ".ckpt")]
    if pickles and not (folder / WEIGHTS).exists():
        raise UserError(f"{folder}: {pickles[0]} is a pickle, which can run code; only {WEIGHTS} is read")
    try:
        config = parse_json(read_bytes(folder / CONFIG))
        parts = {"encoder": build(EncoderConfig, config["encoder"]), "pretrain": build(EncoderCard, config["pretrain"])}
        record = build(EncoderRecord, config | parts)
        if not isinstance(name := record.pretrain.corruption["corruption"], str):
            raise TypeError(f"corruption is {name!r}")
        return record
    except UserError:
        raise
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError) as error:
        inner = folder / "encoder"
        hint = f"name {inner}" if (inner / CONFIG).is_file() else "`vd4rl-pomdp pretrain` writes one as RUN/encoder"
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise UserError(f"{folder}: not an encoder folder (config.json: {reason}); {hint}") from error


def model_card(record: EncoderRecord, repository: str = "", license: str = LICENSE) -> str:
    """Text of the model card, README.md.

    Args:
        record: an encoder folder's config.json.
        repository: OWNER/NAME on the Hub, to load from; empty: the example loads the card's own folder.
        license: Hub identifier such as "mit"; empty: none.
    """
    card, shape = record.pretrain, record.encoder
    if card.end_to_end:
        budget = f"no pretraining: {code(card.end_to_end)} trains it with the policy"
    elif record.frames == 0:
        budget = "none: it is not trained"
    else:
        frames = f", {record.frames:,} frames" if record.frames else ""
        budget = f"preset {code(card.preset)}, {card.steps:,} gradient steps{frames}"
    probe = ", ".join(f"{name.removeprefix('probe_')} {error:.1f}%" for name, error in record.probe.items())
    commit = f", commit {code(record.commit)}" if record.commit else ""
    facts = {
        "method": code(card.method),
        "task, quality": f"{code(card.task)}, {code(card.quality)}",
        "data": f"fingerprint {code(card.data)}" if card.data else "not recorded",
        "corruption": code(json.dumps(card.corruption)),
        "budget": budget,
        "seed": str(card.seed),
        "encoder": f"{code(shape.frame_encoder)}, {shape.feature_dim} features, memory: {code(shape.history)}",
        "linear probe": f"error of {probe} of a standard deviation, on held-out episodes" if probe else "not measured",
        "made by": f"vd4rl-pomdp {one_line(record.version)}{commit}",
    } | ({"licence": code(license)} if license else {})
    tags = dict.fromkeys([*TAGS, card.method, card.task, card.corruption["corruption"]])
    values: dict[str, Any] = {"license": license} if license else {}
    values |= {"library_name": "vd4rl-pomdp", "pipeline_tag": TAGS[0], "tags": [one_line(tag) for tag in tags]}
    hub = ["from huggingface_hub import snapshot_download", ""] if repository else []
    place = f"snapshot_download({json.dumps(repository)}))" if repository else '".")  # this folder'
    use = [f"encoder, card = load_encoder({place}", "print(card.method, card.task, encoder.dim)"]
    return "\n".join(
        [
            *front_matter(values),
            "",
            f"# {code(card.method)} on {code(card.task)}",
            "",
            "An encoder of partial observations, pretrained offline by `vd4rl-pomdp`.",
            "",
            "| | |",
            "|---|---|",
            *(f"| {name} | {value} |" for name, value in facts.items()),
            "",
            "## Use it",
            "",
            *code_block([*hub, "from vd4rl_pomdp.nn import load_encoder", "", *use], "python"),
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
    """YAML front matter of a Hub card; values are written as JSON, which is valid YAML."""
    return ["---", *(f"{name}: {json.dumps(value)}" for name, value in values.items()), "---"]
