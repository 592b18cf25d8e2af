"""Named random streams, all derived from a run's one seed.

A stream's seed comes from numpy's `SeedSequence` with the hashed name as spawn key, so streams of one run, and of runs
with different seeds, are independent. Two exceptions: dataset episodes are seeded by (seed, episode), see
`episode_seed`, and evaluation uses fixed seeds, see `evaluation`.
"""

from __future__ import annotations

import hashlib

import numpy as np
import torch


def stream_seed(seed: int, *name: str | int) -> int:
    """Seed in 0..2^63-1 of the stream of a run's `seed` and a path, such as ("finetune", "corruption", view)."""
    key = [int.from_bytes(hashlib.blake2b(repr(part).encode(), digest_size=8).digest()) for part in name]
    # Halved because torch seeds must be below 2^63.
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0]) >> 1


def stream_generator(seed: int, *name: str | int) -> torch.Generator:
    """A CPU torch generator at the start of a stream (see `stream_seed`)."""
    return torch.Generator().manual_seed(stream_seed(seed, *name))


def seed_networks(seed: int, stage: str) -> None:
    """Seed torch's global generator. Only network initialisation uses it; all other draws use streams."""
    torch.manual_seed(stream_seed(seed, stage, "networks"))


def episode_seed(seed: int, episode: int) -> int:
    """Environment seed of an episode of a dataset."""
    digest = hashlib.blake2b(f"{seed}/{episode}".encode(), digest_size=4).digest()
    return int.from_bytes(digest, "little") & 0x7FFFFFFF
