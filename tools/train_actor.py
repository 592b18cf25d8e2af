"""Train the actors that collect data: soft actor-critic on simulator states (SBX), with a recipe per task.

`python tools/train_actor.py humanoid_walk --out RUN`, with the extra `policy`; re-run the same command to resume.
`python tools/train_actor.py my_task.py my_task --out RUN` first runs a file that registers a user's own task.

RUN holds `snapshots/` (an actor every `eval_every` decisions), `curve.csv` (mean returns), `checkpoint.safetensors`
(networks, optimisers, replay buffer) and `networks.safetensors` (small; another machine can start from it). At the end,
the chosen actors are exported there (see `export_actor`).
"""

from __future__ import annotations

import json
import runpy
import shutil
import sys
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import export_actor as exporting
import jax
import numpy as np
import optax
import tyro
from export_actor import StateEnv, episode_returns, export_run, exported_actors, read_curve, snapshot_path
from safetensors.numpy import load, save
from sbx import SAC
from script import one_line_errors
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.streams import stream_seed
from vd4rl_pomdp.core.tasks import TASKS, Task
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.policies.actor import OBSERVATION_CLIP, Actor
from vd4rl_pomdp.runs.files import jsonable, write_bytes

CHECKPOINT = "checkpoint.safetensors"
REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
STATISTICS = ("mean", "var", "count")
DECISIONS_A_ROUND = 4
"""Decisions between rounds of updates; at least one per environment."""
RANDOM_DECISIONS = 1_000
"""Uniformly random decisions at the start of a new run, times its environments (at most ten)."""


@dataclass(frozen=True)
class PolicyConfig:
    """Settings of one actor's training; the task chooses the defaults."""

    task: tyro.conf.Suppress[str]
    out: Path
    """Run folder; re-run the same command to resume."""
    decisions: int = 300_000
    """Total environment decisions."""
    seed: int = 0
    """Seed of the networks, the replay sampling and the training episodes."""
    learning_rate: float = 7e-4
    """Adam's learning rate for actor and critics."""
    hidden: int = 256
    """Units of each of two hidden layers."""
    critic_norm: bool = False
    """Layer norm after each hidden layer of the critics."""
    normalise: bool = False
    """Standardise observations by running statistics."""
    n_step: int = 1
    """Steps of the critics' returns."""
    envs: int = 1
    """Vectorised environments."""
    updates_per_decision: float = 1.0
    """Gradient steps per decision."""
    batch_size: int = 256
    """Transitions per gradient step."""
    temperature: float = 1.0
    """Initial entropy temperature."""
    temperature_rate: float = 7e-4
    """Adam's learning rate for the temperature."""
    target_entropy: float = -1.0
    """Target entropy per action dimension."""
    replay_size: int = 1_000_000
    """Capacity of the replay buffer in transitions."""
    eval_every: int = 5_000
    """Decisions between snapshots."""
    eval_episodes: int = 5
    """Evaluation episodes per point of the learning curve."""
    stop_at: float = 1000.0
    """Stop early once a snapshot's mean return reaches this."""
    start_from: Path | None = None
    """Start from another run: a folder with its config.json, curve.csv and networks.safetensors."""
    refill: int = 100_000
    """After --start-from: decisions of the old policy that fill the replay buffer before the first update."""
    critic_warmup: int = 20_000
    """After --start-from: updates of the critics alone, before the actor is trained."""


_STEADY = PolicyConfig("", Path(), learning_rate=5e-4, critic_norm=True, normalise=True, n_step=3)
_STEADY = replace(_STEADY, temperature_rate=1e-4, target_entropy=-0.5)
"""Settings of all tasks but walker_walk."""
_GENERAL = replace(_STEADY, decisions=600_000, envs=4, temperature=0.1, replay_size=800_000, eval_every=4_000)
"""Settings of a task without a recipe: cheetah_run's."""
_SMALL = replace(_GENERAL, decisions=60_000, hidden=64, replay_size=100_000, eval_every=500, eval_episodes=2)
RECIPES: dict[str, PolicyConfig] = {
    "walker_walk": PolicyConfig("walker_walk", Path()),
    "cheetah_run": replace(_GENERAL, task="cheetah_run"),
    "humanoid_walk": replace(
        replace(_STEADY, task="humanoid_walk", decisions=20_000_000, envs=16, eval_every=24_000),
        **{"updates_per_decision": 0.5, "temperature": 0.01},
    ),
    "reacher_jump": replace(_SMALL, task="reacher_jump"),
    "point_mass_cue": replace(_SMALL, task="point_mass_cue"),
}
"""Defaults by task. Plain SAC is enough for walker_walk. The others use standardised observations, layer norms in the
critics and three-step returns; humanoid_walk also more decisions per update, since physics is far cheaper than
gradients. Where a run plateaus, start another from it (--start-from) with a different learning rate or exploration.
"""


def build(config: PolicyConfig, task: Task) -> SAC:
    """A new learner; its environments standardise observations if the config says so."""
    envs = DummyVecEnv([lambda: StateEnv(task)] * config.envs)
    rounds = max(1, DECISIONS_A_ROUND // config.envs)
    model = SAC(
        "MlpPolicy",
        VecNormalize(envs, norm_obs=config.normalise, norm_reward=False, clip_obs=OBSERVATION_CLIP),
        learning_rate=config.learning_rate,
        qf_learning_rate=config.learning_rate,
        buffer_size=config.replay_size,
        learning_starts=RANDOM_DECISIONS * min(config.envs, 10),
        batch_size=config.batch_size,
        train_freq=rounds,
        gradient_steps=max(1, round(rounds * config.envs * config.updates_per_decision)),
        n_steps=config.n_step,
        ent_coef=f"auto_{config.temperature}",
        target_entropy=config.target_entropy * layout_of(task).action_dim,
        policy_kwargs={"net_arch": [config.hidden, config.hidden], "layer_norm": config.critic_norm},
        seed=config.seed,
    )
    model.set_logger(Logger(None, []))  # the default logger leaves an empty temporary folder
    # the temperature has its own learning rate; SBX uses the actor's
    state, optimiser = model.ent_coef_state, optax.adam(config.temperature_rate)
    model.ent_coef_state = state.replace(tx=optimiser, opt_state=optimiser.init(state.params))
    return model


def export_actor(model: SAC, config: PolicyConfig, decisions: int) -> Actor:
    """The learner's policy as an `Actor`."""
    params = model.policy.actor_state.params["params"]
    names = [*(f"hidden.{i}" for i in range(len(params) - 2)), "mean", "log_std"]
    weights: dict[str, Any] = {}
    for i, name in enumerate(names):
        weights |= {f"{name}.weight": params[f"Dense_{i}"]["kernel"], f"{name}.bias": params[f"Dense_{i}"]["bias"]}
    if config.normalise:
        envs = model.get_vec_normalize_env()
        weights["observation.mean"] = envs.obs_rms.mean
        weights["observation.std"] = np.sqrt(envs.obs_rms.var + envs.epsilon)
    card = {"task": config.task, "decisions": decisions, "algorithm": "SAC", "seed": config.seed}
    card["versions"] = {name: version(name) for name in ("sbx-rl", "jax")}
    return Actor({name: np.asarray(value, np.float32) for name, value in weights.items()}, card)


def _arrays(model: SAC, states: Any) -> dict[str, np.ndarray]:
    """A tree's leaves, and observation statistics."""
    arrays = {f"{i:04d}": np.array(leaf) for i, leaf in enumerate(jax.tree_util.tree_leaves(states))}
    rms: Any = model.get_vec_normalize_env()
    names = STATISTICS if rms.norm_obs else ()
    return arrays | {f"observation.{name}": np.asarray(getattr(rms.obs_rms, name), np.float64) for name in names}


def _restored(model: SAC, states: Any, path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """The tree whose `_arrays` a file holds, and all that it holds; sets observation statistics.

    Raises:
        UserError: leaves have other shapes.
    """
    stored = load(path.read_bytes())
    leaves, structure = jax.tree_util.tree_flatten(states)
    found = [stored.get(f"{i:04d}", np.empty(0)) for i in range(len(leaves))]
    if any(one.shape != np.shape(leaf) for one, leaf in zip(found, leaves, strict=True)):
        raise UserError(f"{path}: holds networks of another shape; use the --hidden they were made with")
    cast = [jax.numpy.asarray(one.astype(np.asarray(leaf).dtype)) for one, leaf in zip(found, leaves, strict=True)]
    rms: Any = model.get_vec_normalize_env()
    for name in STATISTICS if rms.norm_obs else ():
        setattr(rms.obs_rms, name, stored[f"observation.{name}"])
    return jax.tree_util.tree_unflatten(structure, cast), stored


def _states(model: SAC) -> tuple[Any, ...]:
    """Everything SBX learns, including optimisers, and its random keys."""
    policy = model.policy
    return policy.actor_state, policy.qf_state, model.ent_coef_state, model.key, policy.key


def _networks(model: SAC) -> tuple[Any, ...]:
    return model.policy.actor_state.params, model.policy.qf_state.params, model.ent_coef_state.params


def refill(model: SAC, decisions: int, critic_updates: int) -> None:
    """Fill the empty replay buffer with the policy's own noisy decisions, then train the critics with the actor
    frozen."""
    settings = model.gradient_steps, model.learning_starts, model.lr_schedule
    model.gradient_steps, model.learning_starts = 0, 0
    model.learn(decisions, reset_num_timesteps=False)
    model.gradient_steps, model.learning_starts, schedule = settings
    model.lr_schedule = lambda _: 0.0  # the critics have their own learning rate
    temperature = model.ent_coef_state
    for _ in range(critic_updates // model.gradient_steps):
        model.train(model.gradient_steps, model.batch_size)
        model.ent_coef_state = temperature
    model.lr_schedule = schedule


def save_checkpoint(model: SAC, run: Path) -> None:
    """Write the whole training state, replacing the previous checkpoint."""
    buffer: Any = model.replay_buffer
    stop = buffer.buffer_size if buffer.full else buffer.pos
    arrays = _arrays(model, _states(model))
    arrays |= {f"replay.{k}": np.ascontiguousarray(getattr(buffer, k)[:stop]) for k in REPLAY_ARRAYS}
    arrays["counters"] = np.array([model.num_timesteps, model._n_updates, buffer.pos])
    write_bytes(run / CHECKPOINT, save(arrays))


def restore_checkpoint(model: SAC, run: Path) -> int:
    """Load the checkpoint; returns the decisions made so far, 0 without one. Episodes start anew."""
    if not (run / CHECKPOINT).exists():
        return 0
    states, stored = _restored(model, _states(model), run / CHECKPOINT)
    decisions, updates, position = map(int, stored["counters"])
    # episodes differ from those at the start and from evaluation; Gymnasium increments the seed
    model.set_random_seed(stream_seed(model.seed or 0, "policy", "resumed", decisions) % 2**31)
    policy, buffer = model.policy, model.replay_buffer
    policy.actor_state, policy.qf_state, model.ent_coef_state, model.key, policy.key = states
    stop = len(stored["replay.rewards"])
    for name in REPLAY_ARRAYS:
        getattr(buffer, name)[:stop] = stored[f"replay.{name}"]
    buffer.pos, buffer.full = position, stop == buffer.buffer_size
    buffer.timeouts[position - 1] = True  # interrupted episodes are not continued
    model.num_timesteps, model._n_updates = decisions, updates
    return decisions


def train_actor(config: PolicyConfig) -> dict[str, Path]:
    """Train or resume, and export the actors; returns the exported files by quality.

    Raises:
        UserError: a task without states, or a folder with something other than this run.
    """
    task, run = TASKS.named(config.task), config.out
    if not layout_of(task).state_dim:
        raise UserError(f"{config.task} has no states for an actor to read: choose a task of dm_control")
    _begin(config)
    model = build(config, task)
    done = restore_checkpoint(model, run)
    curve = [row for row in read_curve(run) if row[0] <= done]  # drop rows that a killed run wrote after its checkpoint
    if done == 0 and config.start_from is not None:
        curve = _start_from(model, config, config.start_from)
        done = int(model.num_timesteps)
    while done < config.decisions and (not curve or curve[-1][1] < config.stop_at):
        model.learn(min(config.eval_every, config.decisions - done), reset_num_timesteps=done == 0)
        done = int(model.num_timesteps)
        actor = export_actor(model, config, done)
        returns = episode_returns(actor, task, config.eval_episodes, exporting.CARD_SEED - config.eval_episodes)
        curve.append((done, float(np.mean(returns))))
        actor.save(snapshot_path(run, done))
        _write_curve(run, curve)
        write_bytes(run / exporting.NETWORKS, save(_arrays(model, _networks(model))))
        save_checkpoint(model, run)
        print(f"{config.task}: {done:,} of {config.decisions:,} decisions, mean return {curve[-1][1]:.1f}", flush=True)
    return export_run(run, run)


def _begin(config: PolicyConfig) -> None:
    """Write a new run's settings, or reject settings that differ from an existing run's. Its length may change."""
    settings = jsonable({k: v for k, v in asdict(config).items() if k not in ("out", "decisions", "stop_at")})
    path = config.out / exporting.SETTINGS
    if path.exists():
        stored = json.loads(path.read_text(encoding="utf-8"))
        if differing := [name for name, value in settings.items() if stored.get(name) != value]:
            raise UserError(f"{config.out}: holds a run that differs in {', '.join(differing)}; choose another --out")
        return
    if config.out.exists() and any(config.out.iterdir()):
        raise UserError(f"{config.out}: is not empty and holds no training run; choose another --out")
    if config.start_from is not None and not all((config.start_from / name).exists() for name in exporting.PROGRESS):
        raise UserError(f"{config.start_from}: lacks one of {', '.join(exporting.PROGRESS)}; name the folder of a run")
    config.out.mkdir(parents=True, exist_ok=True)
    write_bytes(path, (json.dumps(settings, indent=1) + "\n").encode())


def _start_from(model: SAC, config: PolicyConfig, start: Path) -> list[tuple[int, float]]:
    """Copy another run's networks, curve (returned) and snapshots; its replay buffer is filled anew."""
    (actor, critics, temperature), _ = _restored(model, _networks(model), start / exporting.NETWORKS)
    policy = model.policy
    policy.actor_state = policy.actor_state.replace(params=actor)
    policy.qf_state = policy.qf_state.replace(params=critics, target_params=critics)
    model.ent_coef_state = model.ent_coef_state.replace(params=temperature)
    curve = read_curve(start)
    (config.out / "snapshots").mkdir(exist_ok=True)
    for step, exported in exported_actors(start, config.task):
        exported.save(snapshot_path(config.out, step))
    for step, _ in curve:
        if snapshot_path(start, step).exists():
            shutil.copy(snapshot_path(start, step), snapshot_path(config.out, step))
    _write_curve(config.out, curve)
    model.num_timesteps = curve[-1][0]
    refill(model, config.refill, config.critic_warmup)
    return curve


def _write_curve(run: Path, curve: list[tuple[int, float]]) -> None:
    lines = ["decisions,return_mean", *(f"{step},{mean:.3f}" for step, mean in curve)]
    write_bytes(run / exporting.CURVE, ("\n".join(lines) + "\n").encode())


def main() -> None:
    """Train with the command line's settings."""
    words = sys.argv[1:]
    if words and words[0].endswith(".py"):
        runpy.run_path(words.pop(0))
    recipes = {name: RECIPES.get(name, replace(_GENERAL, task=name)) for name in TASKS}
    presets = {name: (f"train on {name}", replace(recipe, out=tyro.MISSING)) for name, recipe in recipes.items()}
    with one_line_errors():
        for quality, path in train_actor(tyro.extras.overridable_config_cli(presets, args=words)).items():
            print(f"{quality}: {path}")


if __name__ == "__main__":
    main()
