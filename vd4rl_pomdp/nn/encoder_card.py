"""What an encoder folder's config.json says: what the encoder is, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from vd4rl_pomdp.nn.encoder import EncoderConfig


@dataclass(frozen=True)
class EncoderCard:
    """Where an encoder comes from."""

    method: str
    task: str
    quality: str
    corruption: dict[str, Any]
    """The corruption it was pretrained under, as the settings of CorruptionConfig."""
    seed: int
    steps: int
    preset: str
    end_to_end: str = ""
    """Fine-tuning algorithm that trains the encoder, too; empty for a frozen encoder."""
    action_loss: float | None = None
    """For methods that predict actions: the mean of the last tenth of the pretraining's rows of metrics.

    Each row is the mean over the steps since the row before; all count the same, also where they are of fewer steps.
    """
    data: str = ""
    """Fingerprint of the set it was pretrained on."""
    settings: dict[str, Any] = field(default_factory=dict)
    """The pretraining's settings without seed, folders, device and logging; empty if they were not recorded."""


@dataclass(frozen=True)
class EncoderOrigin:
    """What names no encoder, since the same one may have another: it is not part of `encoder_hash`."""

    version: str = ""
    """Version of this package that wrote the encoder; empty if it was not recorded."""
    commit: str = ""
    """Commit of this package, likewise."""
    frames: int | None = None
    """Frames that the pretraining's batches held; None: not recorded."""
    probe: dict[str, float] = field(default_factory=dict)
    """Errors of linear probes, as `vd4rl_pomdp.nn.probes.probe_state` gives them; empty if none was fitted."""
    plugins: dict[str, str] = field(default_factory=dict)
    """Where parts come from that are not this package's, as `registry.origins` tells; empty if none was recorded."""
    sources: dict[str, str] = field(default_factory=dict)
    """Their files, as `registry.sources` tells, likewise."""


@dataclass(frozen=True)
class EncoderRecord:
    """An encoder folder's config.json."""

    encoder: EncoderConfig
    pretrain: EncoderCard
    origin: EncoderOrigin = EncoderOrigin()

    @property
    def parts(self) -> dict[str, str]:
        """Names of the parts that made it, by the registries' `setting`."""
        card = self.pretrain
        named = {"method": card.method, "task": card.task, "corruption": card.corruption["corruption"]}
        return named | {"frame_encoder": self.encoder.frame_encoder}

    @property
    def code(self) -> dict[str, dict[str, str]]:
        """What it says of their code, as `registry.code_of` does."""
        return {"plugins": self.origin.plugins, "sources": self.origin.sources}
