"""For encoders with memory: which of its outputs the policy gets, and where histories begin.

A policy is trained on the memory states of the data's histories, but acts on its own. If all histories are whole
episodes of one behaviour policy, the state also reveals how the episode has gone so far. A policy can exploit this, and
fails once it acts and its own history differs (Swamy et al. 2022, arXiv 2208.02225). So a fraction of the histories can
start at random rows instead; both ends of such a transition are read from the same start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Limits, Options
from vd4rl_pomdp.core.streams import stream_generator
from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.nn.encoder import Encoder, Readout
from vd4rl_pomdp.runs.files import content_hash


@dataclass(frozen=True)
class HistoryOptions(Options):
    """Options for encoders with memory; without memory they are not read."""

    readout: Readout = "state"
    """Input of the policy: state (s_t), frame (e(o_t) only) or frame+state (both)."""
    history_window: int = 0
    """Rows from which a state is computed, in training and evaluation; 0: as in the encoder's own config."""
    random_histories: float = 0.0
    """Fraction of transitions whose history begins at a random row instead of the episode's start."""
    shortest_history: int = 2
    """Minimum rows of a random history; fewer if the episode starts within them."""
    longest_history: int = 8
    """Maximum rows of a random history."""

    limits: ClassVar[Limits] = {
        "history_window": 0,
        "random_histories": (0, 1),
        "shortest_history": 1,
        "longest_history": 1,
    }

    def check(self) -> None:
        super().check()
        if self.shortest_history > self.longest_history:
            raise UserError(
                f"--shortest-history is {self.shortest_history}, --longest-history {self.longest_history}: "
                "choose a longest that is not shorter"
            )

    @property
    def encoder_changes(self) -> dict[str, Any]:
        """Changes to the encoder's config, also for evaluation."""
        window = {"history_window": self.history_window} if self.history_window else {}
        return {"readout": self.readout} | window


class Histories:
    """A dataset's transitions, and which of them have a random history in each view.

    Features of a view are numbered: first the dataset's N rows with full histories, then the first ends, then the last
    ends, of the R transitions with a random history.
    """

    def __init__(self, dataset: Dataset, options: Options, n_step: int, seed: int) -> None:
        """Options other than `HistoryOptions` mean full histories."""
        self.dataset, self._n_step, self._seed = dataset, n_step, seed
        self._options = options if isinstance(options, HistoryOptions) else HistoryOptions()
        self.rows = dataset.transition_rows
        """(M,) int64: first end of every transition."""
        self.ends = dataset.successors(self.rows, n_step)
        """(M,) int64: last end of every transition."""
        self.random = round(self._options.random_histories * len(self.rows))
        """R, the number of random histories."""
        self.features = dataset.num_rows + 2 * self.random
        """Features per view."""

    def name(self) -> str:
        """Cache key of a view's set of features: equal for equal ones."""
        return content_hash([asdict(self._options), self._n_step, self._seed]) if self.random else ""

    def of_view(self, view: int) -> RandomHistories:
        generator = stream_generator(self._seed, "finetune", "histories", view)
        chosen = torch.randperm(len(self.rows), generator=generator)[: self.random].sort().values
        shortest, longest = self._options.shortest_history, self._options.longest_history
        length = torch.randint(shortest, longest + 1, (self.random,), generator=generator)
        return RandomHistories(self, chosen.to(self.rows.device), length.to(self.rows.device))


@dataclass(frozen=True)
class RandomHistories:
    """Random histories of one view."""

    histories: Histories
    chosen: Tensor
    """(R,) int64, sorted: transitions with a random history."""
    length: Tensor
    """(R,) int64: rows of the history up to the transition's first end."""

    def numbers(self) -> tuple[Tensor, Tensor]:
        """Feature numbers of both ends of every transition: (M,) and (M,) int64."""
        first, last = self.histories.rows.clone(), self.histories.ends.clone()
        fresh = self.histories.dataset.num_rows + torch.arange(len(self.chosen), device=first.device)
        first[self.chosen], last[self.chosen] = fresh, fresh + len(self.chosen)
        return first, last

    def fill(self, out: Tensor, encoder: Encoder, frames: Tensor, episodes: range) -> None:
        """Write the features of consecutive episodes into a view's, (features, D), from (rows, F) frame features."""
        dataset = self.histories.dataset
        whole = dataset.rows_of(episodes)
        out[whole] = read_whole(encoder, frames, dataset, episodes)
        row = self.histories.rows[self.chosen]
        mine = torch.nonzero((row >= whole.start) & (row < whole.stop))[:, 0]
        if len(mine):
            row, last = row[mine], self.histories.ends[self.chosen[mine]]
            # same start for both ends, or z' would remember rows that z does not
            first = torch.maximum(row - self.length[mine] + 1, dataset.episode_start[dataset.episode[row]])
            z, next_z = read_both_ends(encoder, lambda rows: frames[rows - whole.start], dataset, first, row, last)
            number = (dataset.num_rows + mine).to(out.device)
            out[number], out[number + len(self.chosen)] = z.to(out), next_z.to(out)


def read_whole(encoder: Encoder, frames: Tensor, dataset: Dataset, episodes: range) -> Tensor:
    """Representations (rows, D) of consecutive episodes with full histories, from their (rows, F) frame features."""
    if not encoder.remembers:
        return frames
    first, end = (ends[episodes.start : episodes.stop, None] for ends in (dataset.episode_start, dataset.episode_end))
    span = torch.arange(int((end - first).max()), device=frames.device)
    # pad shorter episodes with their last row; a causal memory cannot look ahead to the padding
    rows = torch.minimum(first + span, end - 1)
    states = encoder.from_features(frames[rows - rows[0, 0]], dataset.actions_before(rows))
    return states[first + span < end]


def read_both_ends(
    encoder: Encoder, frames: Callable[[Tensor], Tensor], dataset: Dataset, first: Tensor, row: Tensor, last: Tensor
) -> tuple[Tensor, Tensor]:
    """Representations (B, D) and (B, D) of rows `row` and `last`, with histories that begin at rows `first`.

    All are (B,) int64, each triple from one episode; `frames` gives the frame features (B, T, F) of (B, T) rows.
    """
    span = torch.arange(int((last - first).max()) + 1, device=row.device)
    # pad shorter histories with their last row; a causal memory cannot look ahead to the padding
    history = torch.minimum(first[:, None] + span, last[:, None])
    states = encoder.from_features(frames(history), dataset.actions_before(history))
    pick = torch.arange(len(row), device=row.device)
    return states[pick, row - first], states[pick, last - first]
