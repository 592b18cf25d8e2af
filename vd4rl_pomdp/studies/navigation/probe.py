"""State probes: an MLP estimates the true state from a representation, trained beside it or refitted on it frozen.

States are the standardised position and velocity, (x, y, vx, vy). Errors are mean absolute errors in two units: percent
of a standard deviation, where predicting the mean gives some 65 to 100, and the simulator's own, times 100.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.seeding import seed_networks, stream_generator
from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.envs.mazes import MazeSpec
from vd4rl_pomdp.nn.heads import mlp
from vd4rl_pomdp.nn.policy import Standardise
from vd4rl_pomdp.studies.navigation.measures import RAW_PREFIX

STATE_DIM = 4
COMPONENTS = {"state": slice(0, 4), "position": slice(0, 2), "velocity": slice(2, 4)}
_BATCH = 1024
_LEARNING_RATE = 1e-3


@dataclass(frozen=True)
class TrueStates:
    """Standardised states of all rows of a set."""

    values: Tensor
    """(N, 4) float32."""
    hidden: Tensor
    """(N,) bool: a curtain covers the whole mass."""
    mean: Tensor
    std: Tensor
    """(4,) float32, of the training rows."""

    @classmethod
    def of(cls, dataset: Dataset, maze: MazeSpec, training_rows: int) -> TrueStates:
        """States of a set, standardised by its first `training_rows` rows."""
        assert dataset.physics is not None
        raw = torch.from_numpy(dataset.physics[:, maze.position + maze.velocity])
        std, mean = torch.std_mean(raw[:training_rows], dim=0)
        hidden = torch.from_numpy(maze.hidden(dataset.physics))
        return cls(((raw - mean) / std).float(), hidden, mean.float(), std.float())

    def to(self, device: torch.device) -> TrueStates:
        """Copy on a device."""
        return TrueStates(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


class StateProbe(nn.Module):
    """Two hidden layers of 256 units: (..., D) representations -> (..., 4) states."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.standardise = Standardise(dim)
        self.net = mlp(dim, 256, STATE_DIM, layers=2)

    def forward(self, z: Tensor, frozen: bool = True) -> Tensor:
        """Estimated states; no gradient reaches the representation unless it is not `frozen`."""
        return self.net(self.standardise(z.detach() if frozen else z))


class ErrorSums(nn.Module):
    """Sums of absolute errors and their counts: over all rows and over hidden ones. Both are part of its state."""

    sums: Tensor
    counts: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sums", torch.zeros(2, STATE_DIM, dtype=torch.float64))
        self.register_buffer("counts", torch.zeros(2, dtype=torch.float64))

    def add(self, estimate: Tensor, truth: Tensor, hidden: Tensor, burn_in: int) -> None:
        """Count (B, T, 4) estimates against truths, a GPU is not waited for; rows before `burn_in` are left out."""
        error = (estimate.detach().float() - truth)[:, burn_in:].abs().flatten(0, 1)
        under = hidden[:, burn_in:].flatten()
        weights = torch.stack([torch.ones_like(under), under]).to(error)
        self.to(error.device)
        # in place, as a replayed step adds to the tensors that it was captured with
        self.sums.add_((weights @ error).double())
        self.counts.add_(weights.sum(1).double())

    def reset(self) -> None:
        """Count anew."""
        self.sums.zero_()
        self.counts.zero_()

    def percent(self) -> dict[str, float]:
        """`state`, `position`, `velocity`, and the same with `_hidden` where any counted row was hidden."""
        return self._times(torch.ones(STATE_DIM))

    def both(self, std: Tensor) -> dict[str, float]:
        """The same, and after RAW_PREFIX in units of the simulator x 100, by the states' (4,) standard deviations."""
        raw = self._times(std.cpu())
        return self.percent() | {f"{RAW_PREFIX}{name}": value for name, value in raw.items()}

    def _times(self, scale: Tensor) -> dict[str, float]:
        named: dict[str, float] = {}
        sums, counts = self.sums.cpu(), self.counts.cpu()
        for number, suffix in enumerate(("", "_hidden")):
            if counts[number]:
                means = 100 * scale * sums[number] / counts[number]
                named |= {f"{name}{suffix}": float(means[part].mean()) for name, part in COMPONENTS.items()}
        return named


def refit(features: Tensor, truth: Tensor, steps: int, seed: int) -> StateProbe:
    """Fit a probe on frozen (N, D) representations and their (N, 4) states."""
    seed_networks(seed, "refit")
    probe = StateProbe(features.shape[1]).to(features.device)
    probe.standardise.fit(features)
    optimiser = torch.optim.Adam(probe.parameters(), lr=_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    generator = stream_generator(seed, "refit", "batches")
    for _ in range(steps):
        rows = torch.randint(len(features), (_BATCH,), generator=generator).to(features.device, non_blocking=True)
        loss = (probe(features[rows]) - truth[rows]).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return probe.eval()
