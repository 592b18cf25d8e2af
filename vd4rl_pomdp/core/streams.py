"""Named random streams, all derived from a run's one seed, and their numbers one by one or in blocks.

A stream's seed comes from numpy's `SeedSequence` with the hashed name as spawn key, so streams of one run, and of runs
with different seeds, are independent. Two exceptions: dataset episodes are seeded by (seed, episode), see
`episode_seed`, and evaluation uses fixed seeds, see `evaluation`.

Numbers are drawn on the CPU. A step that is replayed as a CUDA graph cannot draw; it can only read memory. So a stream
records what a step asks for, draws it for a block of steps in the order in which they would have drawn it, copies the
block to the GPU at once, and serves one row per step.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError

BLOCK = 256
"""Steps per block."""
_ALIGNED = 16
"""Alignment in bytes of each draw within a row, enough for any dtype."""


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


@dataclass(frozen=True)
class _Draw:
    """One request of a step, for each run."""

    kind: str
    shape: tuple[int, ...]
    high: tuple[int, ...] = ()
    """Upper bounds, one per run."""

    def made(self, generator: torch.Generator, run: int) -> Tensor:
        if self.kind == "integers":
            return torch.randint(self.high[run], self.shape, generator=generator)
        if self.kind == "normal":
            return torch.randn(self.shape, generator=generator)
        return torch.rand(self.shape, generator=generator)

    @property
    def dtype(self) -> torch.dtype:
        return torch.int64 if self.kind == "integers" else torch.float32

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


class RandomStream:
    """Numbers of one stream on a device: the same on every device, and the same one by one as in blocks.

    A stream of several runs trained together (`stacked`) serves each run's own numbers: every shape requested and
    returned starts with the number of runs. `generator` is on the CPU, at the stream's start.
    """

    def __init__(self, generator: torch.Generator, device: torch.device | str = "cpu") -> None:
        self._generators, self._device = [generator], torch.device(device)
        self._runs: tuple[int, ...] = ()
        """(number of runs,) for a stacked stream, else ()."""
        self._requests: dict[int, list[_Draw]] = {}
        """By turn: requests of its step when it last ran eagerly."""
        self._recorded: list[_Draw] | None = None
        """Requests of the step that is running; None outside steps that may be replayed."""
        self._turn, self._place = 0, 0
        self._block: Tensor | None = None
        """(BLOCK, runs, bytes) uint8 on the device; None: numbers are drawn one by one."""

    def integers(self, high: int | Sequence[int], *shape: int) -> Tensor:
        """Uniform int64 in [0, high); in a stacked stream each run may have its own bound."""
        bounds = (high,) * len(self._generators) if isinstance(high, int) else tuple(high)
        return self._next("integers", shape, bounds)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal float32."""
        return self._next("normal", shape)

    def uniform(self, *shape: int) -> Tensor:
        """Uniform float32 in [0, 1)."""
        return self._next("uniform", shape)

    def get_state(self, run: int = 0) -> Tensor:
        """Generator state of a run after the steps done so far, ignoring numbers drawn ahead."""
        if self._block is None:
            return self._generators[run].get_state()
        made = torch.Generator()
        made.set_state(self._before[run])
        self._draw_steps(made, run, self._used)
        return made.get_state()

    def set_state(self, state: Tensor) -> None:
        """Resume from `get_state`; for a stream of one run."""
        (generator,) = self._generators
        generator.set_state(state)
        if self._block is not None:
            self._before, self._used, self._filled = [state.clone()], 0, False

    def begin(self, turn: int) -> None:
        """Start a step of `turn`: record its requests or, in blocks, read from its row."""
        self._turn, self._place = turn, 0
        if self._block is None:
            self._recorded = self._requests[turn] = []
        else:
            self._row = self._block.index_select(0, self._counter)[0]

    def end(self) -> None:
        """End a step; in blocks, advance to the next row. Part of what is captured and replayed."""
        self._recorded = None
        if self._block is not None:
            if self._place < len(self._requests[self._turn]):
                raise RuntimeError("a step requested fewer random numbers than the recorded steps")
            self._counter.add_(1)

    def in_blocks(self) -> None:
        """Switch to blocks. Every turn must have run once, and turn 0 comes next."""
        self._offsets, width = {}, _ALIGNED
        for turn, requests in self._requests.items():
            ends = [0]
            for draw in requests:
                ends.append(ends[-1] + -(-draw.size // _ALIGNED) * _ALIGNED)
            self._offsets[turn], width = ends[:-1], max(width, ends[-1])
        shape = BLOCK, len(self._generators), width
        self._block = torch.zeros(shape, dtype=torch.uint8, device=self._device)
        self._counter = torch.zeros(1, dtype=torch.int64, device=self._device)
        self._before, self._used, self._first, self._filled = self._states(), 0, 0, False

    def one_by_one(self) -> None:
        """Switch back to drawing one by one, continuing after the steps done so far."""
        self._recorded = None
        if self._block is not None:
            states = [self.get_state(run) for run in range(len(self._generators))]
            for generator, state in zip(self._generators, states, strict=True):
                generator.set_state(state)
            self._block = None

    def provide(self, turn: int) -> None:
        """Ensure that the block holds the next step's row; called before a step of `turn` is replayed."""
        assert self._block is not None
        if self._used == BLOCK or not self._filled:
            self._before, self._first = self._states(), turn
            rows = torch.zeros(self._block.shape, dtype=torch.uint8, pin_memory=self._device.type == "cuda")
            for run, generator in enumerate(self._generators):
                self._draw_steps(generator, run, BLOCK, rows[:, run])
            # PyTorch does not reuse freed pinned memory before the copy has finished
            self._block.copy_(rows, non_blocking=True)
            self._counter.zero_()
            self._used, self._filled = 0, True
        self._used += 1

    def _states(self) -> list[Tensor]:
        return [generator.get_state() for generator in self._generators]

    def _draw_steps(self, generator: torch.Generator, run: int, steps: int, rows: Tensor | None = None) -> None:
        """Draw a run's numbers for `steps` steps from the block's first turn on, into `rows` (steps, bytes) if any."""
        for step in range(steps):
            turn = (self._first + step) % len(self._requests)
            for draw, offset in zip(self._requests[turn], self._offsets[turn], strict=True):
                drawn = draw.made(generator, run)
                if rows is not None:
                    rows[step, offset : offset + draw.size] = drawn.view(-1).view(torch.uint8)

    def _next(self, kind: str, shape: tuple[int, ...], high: tuple[int, ...] = ()) -> Tensor:
        if shape[: len(self._runs)] != self._runs:
            raise UserError(
                f"a step of {self._runs[0]} stacked runs requested random numbers of the shape {shape}: their first "
                "dimension must be that of the batch, as in `self.draws.normal(*batch.action.shape)`"
            )
        draw = _Draw(kind, shape[len(self._runs) :], high)
        if self._block is None:
            if self._recorded is not None:
                self._recorded.append(draw)
            made = [draw.made(generator, run) for run, generator in enumerate(self._generators)]
            drawn = torch.stack(made) if self._runs else made[0]
            # asynchronous to a GPU; to the CPU that would allow reads before the copy is done
            return drawn.to(self._device, non_blocking=self._device.type != "cpu")
        requests, place = self._requests[self._turn], self._place
        if place >= len(requests) or requests[place] != draw:
            raise RuntimeError(f"a step requested {draw}, which the recorded steps did not")
        self._place += 1
        offset = self._offsets[self._turn][place]
        return self._row[:, offset : offset + draw.size].view(draw.dtype).view(shape)


def random_stream(seed: int, *name: str | int, device: torch.device | str = "cpu") -> RandomStream:
    """The stream called `name` of a run (see `stream_seed`) on a device."""
    return RandomStream(stream_generator(seed, *name), device)


def stacked(streams: Sequence[RandomStream]) -> RandomStream:
    """One stream for several runs, continuing from copies of their states. Draws one by one at first."""
    one = RandomStream(torch.Generator(), streams[0]._device)
    one._generators = [torch.Generator() for _ in streams]
    for generator, stream in zip(one._generators, streams, strict=True):
        generator.set_state(stream.get_state())
    one._runs = (len(streams),)
    return one
