"""Every stream of random numbers of a run, named and derived from the run's one seed.

A stream's seed comes from numpy's `SeedSequence`, its name being the spawn key, so no two streams of a run meet, nor
those of two runs with different seeds. Sets are the exception: their episodes are keyed by (seed, episode), see
`episode_seed`, and evaluation starts from fixed seeds, see `evaluation`.
"""

from __future__ import annotations

import hashlib

import numpy as np
import torch


def stream_seed(seed: int, *name: str | int) -> int:
    """Seed of one stream.

    Args:
        seed: the run's seed.
        name: what the stream is for, from the general to the particular: ("finetune", "corruption", view).

    Returns:
        An integer in 0..2^63-1, the same on every machine.
    """
    key = [int.from_bytes(hashlib.blake2b(repr(part).encode(), digest_size=8).digest()) for part in name]
    # Halved, because torch takes seeds below 2^63.
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0]) >> 1


def stream_generator(seed: int, *name: str | int) -> torch.Generator:
    """A torch generator, on the CPU, at the beginning of a stream (see `stream_seed`)."""
    return torch.Generator().manual_seed(stream_seed(seed, *name))


def seed_networks(seed: int, stage: str) -> None:
    """Seed torch's global generator, which only the initialisation of networks uses; every other draw has a stream."""
    torch.manual_seed(stream_seed(seed, stage, "networks"))


def episode_seed(seed: int, episode: int) -> int:
    """Environment seed of an episode of a set."""
    digest = hashlib.blake2b(f"{seed}/{episode}".encode(), digest_size=4).digest()
    return int.from_bytes(digest, "little") & 0x7FFFFFFF
