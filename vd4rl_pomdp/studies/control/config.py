"""What a control study runs: its settings, its runs, and what names a run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from itertools import product
from pathlib import Path

from vd4rl_pomdp.core.errors import MAX_SEED, MOST, refuse_number, refuse_outside, refuse_unknown
from vd4rl_pomdp.core.tasks import MOST_EPISODES, TASKS
from vd4rl_pomdp.data.collect import MAX_NOISE
from vd4rl_pomdp.nn.encoder import Readout
from vd4rl_pomdp.nn.objective import ActionOptions
from vd4rl_pomdp.policies.actor import load_actor
from vd4rl_pomdp.runs.memory import CPU, require_memory

NO_MEMORY, UNTRAINED = "none", "random"
"""What is seen of the states itself, and a GRU over it that is not trained: the floors."""
_FEATURE_BYTES = 4 * 256 * 2
"""Of a row: 4 views of a GRU's 256 units in half precision."""
_LIMITS: dict[str, tuple[float, float]] = {
    "seeds": (0, MAX_SEED),
    "action_noises": (0, MAX_NOISE),
    "hidden_shares": (0, 1),
    "random_histories": (0, 1),
    "history_windows": (0, MOST),
}


@dataclass(frozen=True)
class ControlConfig:
    """Which objectives carry control from memory? Their GRU and TD3+BC on simulator states, some of them hidden."""

    out: Path
    """Folder of runs.csv and episodes.csv; runs that are in it are not run again."""
    tasks: list[str] = field(default_factory=lambda: ["walker_walk"])
    """Tasks whose expert ships."""
    methods: list[str] = field(default_factory=lambda: [NO_MEMORY, "mik", "mik+a"])
    """none (what is seen itself, no memory), random (an untrained GRU), or objectives that train a GRU, such as mik."""
    seeds: list[int] = field(default_factory=lambda: [0, 1])
    """Training seeds."""
    action_noises: list[float] = field(default_factory=lambda: [0.0, 0.5])
    """Standard deviations of the Gaussian noise on the expert's actions, executed and stored."""
    hidden_shares: list[float] = field(default_factory=lambda: [0.5])
    """Shares of the coordinates that are hidden, drawn in every row."""
    readouts: list[Readout] = field(default_factory=lambda: ["state"])
    """What the policy is given of a GRU: its state, the frame's features alone, or both."""
    random_histories: list[float] = field(default_factory=lambda: [0.0])
    """Shares of TD3+BC's transitions whose history begins at a random row, 2 to 8 rows before."""
    history_windows: list[int] = field(default_factory=lambda: [0])
    """Rows that a GRU's state is computed from, in TD3+BC and in evaluation; 0: all, or what the method has."""
    episodes: int = 50
    """Episodes in a set."""
    pretrain_steps: int = 3_000
    """Gradient steps of an objective."""
    updates: int = 10_000
    """Updates of TD3+BC."""
    eval_episodes: int = 20
    """Episodes of a run's evaluation."""
    decisions: int | None = None
    """Most decisions of an episode, in set and evaluation; default: the task's own. Fewer only for trials."""

    def check(self) -> None:
        """Raise UserError for settings that cannot work, before anything is played."""
        refuse_outside(self, episodes=(2, MOST_EPISODES), pretrain_steps=1, updates=1, eval_episodes=(1, MOST_EPISODES))
        for name, limits in _LIMITS.items():
            for value in getattr(self, name):
                refuse_number(name, value, *limits)
        for task in self.tasks:
            load_actor(task, "expert")
            refuse_number("decisions", self._decisions(task), _window(), TASKS.named(task).decisions)
            require_memory(_FEATURE_BYTES * self.episodes * self._decisions(task), CPU, self, "episodes")
        for method in self.methods:
            refuse_unknown("method of this study", method, fitting_methods())

    def runs(self) -> Iterator[ControlRun]:
        """All runs, seed by seed, so that every method has its first seed early; none of them twice."""
        runs = []
        for task, noise, share, seed in product(self.tasks, self.action_noises, self.hidden_shares, self.seeds):
            budget = (self.episodes, self._decisions(task), self.pretrain_steps, self.updates, self.eval_episodes)
            memories = product(self.methods, self.readouts, self.random_histories, self.history_windows)
            for method, readout, begun, window in memories:
                read = _read(method, readout, begun, window)
                runs.append(ControlRun(task, noise, share, *budget, method, *read, seed))
        yield from dict.fromkeys(runs)

    def _decisions(self, task: str) -> int:
        return TASKS.named(task).decisions if self.decisions is None else self.decisions


def _read(method: str, readout: Readout, random_histories: float, history_window: int) -> tuple[Readout, float, int]:
    """What is read of a method's memory: nothing where there is none, no history of the newest frame alone."""
    if method == NO_MEMORY:
        return "state", 0.0, 0
    return ("frame", 0.0, 0) if readout == "frame" else (readout, random_histories, history_window)


@dataclass(frozen=True)
class ControlRun:
    """One run: all that its rows depend on."""

    task: str
    action_noise: float
    hidden_share: float
    episodes: int
    decisions: int
    pretrain_steps: int
    updates: int
    eval_episodes: int
    method: str
    readout: Readout
    random_histories: float
    history_window: int
    seed: int

    @property
    def labels(self) -> dict[str, str]:
        """The columns that name its rows, as a CSV file has them."""
        values = ((name, getattr(self, name)) for name in LABELS)
        return {name: f"{value:.12g}" if isinstance(value, float) else str(value) for name, value in values}


LABELS = tuple(f.name for f in fields(ControlRun))
SETTING = LABELS[: LABELS.index("method")]
"""What the methods of one comparison share."""
MEASURED = (
    *("return", "return_min", "return_max", "data_return", "good_share", "error_on_data", "error_in_loop"),
    *("probe_pose", "probe_velocity", "action_loss", "seconds"),
)
RUN_COLUMNS = (*LABELS, *MEASURED, "git_commit")
WORDS = ("task", "method", "readout", "git_commit")
"""Columns that hold text; all others hold numbers."""


def fitting_methods() -> list[str]:
    """Names of what can be compared: objectives that predict actions and train a GRU, and the floors."""
    from pretrain.objectives import METHODS

    fitting = (name for name, m in METHODS.items() if m.trained and m.history != "none")
    return [NO_MEMORY, UNTRAINED, *(name for name in fitting if issubclass(METHODS[name].options, ActionOptions))]


def _window() -> int:
    """Rows of a window, which an episode must have."""
    from pretrain.config import PretrainConfig

    return PretrainConfig.of("cpu").window
