"""SBX's soft actor-critic: build it, export its actor, keep and restore everything it has learned.

A checkpoint holds networks, optimisers and the replay buffer; `networks.safetensors` beside it holds the networks and
the observation statistics alone, small enough for a repository, and is what another machine can start from.
"""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load, save

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.core.seeding import stream_seed
from vd4rl_pomdp.core.tasks import Task
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.policies.actor import OBSERVATION_CLIP, Actor
from vd4rl_pomdp.policies.config import PolicyConfig
from vd4rl_pomdp.policies.state_env import StateEnv
from vd4rl_pomdp.runs.checkpoint import Checkpoints
from vd4rl_pomdp.runs.files import write_bytes

if TYPE_CHECKING:
    from sbx import SAC

REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
STATISTICS = ("mean", "var", "count")
DECISIONS_A_ROUND = 4
"""Decisions between two rounds of updates, or one for each environment if those are more."""
RANDOM_DECISIONS = 1_000
"""Uniformly random decisions that a new run begins with, times its environments (ten at most)."""


def build(config: PolicyConfig, task: Task) -> SAC:
    """A new learner; its environments standardise observations only if the config says so."""
    try:
        from sbx import SAC
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
    except ImportError as error:
        raise UserError(
            "policy training needs SBX: install it with `pip install '.[policy]'` in the package's folder"
        ) from error
    envs = DummyVecEnv([lambda: StateEnv(task)] * config.envs)
    rounds = max(1, DECISIONS_A_ROUND // config.envs)
    network = {"net_arch": [config.hidden] if config.network == "simba" else [config.hidden, config.hidden]}
    model = SAC(
        "SimbaPolicy" if config.network == "simba" else "MlpPolicy",
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
        policy_kwargs=network | ({"layer_norm": True} if config.critic_norm else {}),
        seed=config.seed,
    )
    model.set_logger(Logger(None, []))  # its own would leave an empty folder among the temporary files
    _set_temperature_rate(model, config.temperature_rate)
    return model


def _set_temperature_rate(model: SAC, rate: float) -> None:
    """Give the temperature a learning rate of its own; SBX takes the actor's."""
    import optax

    state, optimiser = model.ent_coef_state, optax.adam(rate)
    model.ent_coef_state = state.replace(tx=optimiser, opt_state=optimiser.init(state.params))


def export_actor(model: SAC, config: PolicyConfig, decisions: int) -> Actor:
    """The learner's policy as an `Actor`."""
    params = model.policy.actor_state.params["params"]
    weights = _simba_weights(params) if config.network == "simba" else _mlp_weights(params)
    if config.normalise:
        envs = _envs(model)
        weights["observation.mean"] = envs.obs_rms.mean
        weights["observation.std"] = np.sqrt(envs.obs_rms.var + envs.epsilon)
    card = {"task": config.task, "decisions": decisions, "algorithm": "SAC", "seed": config.seed}
    card["versions"] = {name: version(name) for name in ("sbx-rl", "jax")}
    return Actor({name: np.asarray(value, np.float32) for name, value in weights.items()}, card)


def _mlp_weights(params: Any) -> dict[str, Any]:
    """Dense layers in order: the hidden ones, mean and log_std."""
    names = [f"hidden.{i}" for i in range(len(params) - 2)] + ["mean", "log_std"]
    return {key: value for i, name in enumerate(names) for key, value in _dense(name, params[f"Dense_{i}"]).items()}


def _simba_weights(params: Any) -> dict[str, Any]:
    weights = _dense("embed", params["Dense_0"]) | _norm("norm", params["LayerNorm_0"])
    weights |= _dense("mean", params["Dense_1"]) | _dense("log_std", params["Dense_2"])
    for i in range(sum(name.startswith("SimbaResidualBlock") for name in params)):
        block = params[f"SimbaResidualBlock_{i}"]
        weights |= _norm(f"block.{i}.norm", block["LayerNorm_0"])
        weights |= _dense(f"block.{i}.up", block["Dense_0"]) | _dense(f"block.{i}.down", block["Dense_1"])
    return weights


def _dense(name: str, layer: Any) -> dict[str, Any]:
    return {f"{name}.weight": layer["kernel"], f"{name}.bias": layer["bias"]}


def _norm(name: str, layer: Any) -> dict[str, Any]:
    return {f"{name}.scale": layer["scale"], f"{name}.bias": layer["bias"]}


def save_networks(model: SAC, path: Path) -> None:
    """Write actor, critics, temperature and observation statistics, without optimisers, to one small file."""
    leaves, _ = _flatten(_networks(model))
    arrays = {f"{i:04d}": np.array(leaf) for i, leaf in enumerate(leaves)} | _statistics(model)
    write_bytes(path, save(arrays))


def start_from_networks(model: SAC, path: Path) -> None:
    """Load what `save_networks` wrote; the target critics become copies of the critics."""
    import jax

    try:
        stored = load(read_bytes(path))
    except (FileNotFoundError, SafetensorError) as error:
        raise UserError(f"{path}: not a networks file ({error}); policy training writes one into its folder") from error
    leaves, structure = _flatten(_networks(model))
    if any(f"{i:04d}" not in stored or stored[f"{i:04d}"].shape != leaf.shape for i, leaf in enumerate(leaves)):
        raise UserError(f"{path}: holds networks of another shape; use the --network and --hidden they were made with")
    loaded = [jax.numpy.asarray(stored[f"{i:04d}"]) for i in range(len(leaves))]
    actor, critics, temperature = jax.tree_util.tree_unflatten(structure, loaded)
    policy = model.policy
    policy.actor_state = policy.actor_state.replace(params=actor)
    policy.qf_state = policy.qf_state.replace(params=critics, target_params=critics)
    model.ent_coef_state = model.ent_coef_state.replace(params=temperature)
    _set_statistics(model, stored)


def refill(model: SAC, decisions: int, critic_updates: int) -> None:
    """Fill the empty replay with the policy's own noisy decisions, then train the critics with the actor frozen."""
    settings = model.gradient_steps, model.learning_starts, model.lr_schedule
    model.gradient_steps, model.learning_starts = 0, 0
    model.learn(decisions, reset_num_timesteps=False)
    model.gradient_steps, model.learning_starts, schedule = settings
    model.lr_schedule = lambda _: 0.0  # the critics have a rate of their own
    temperature = model.ent_coef_state
    for _ in range(critic_updates // model.gradient_steps):
        model.train(model.gradient_steps, model.batch_size)
        model.ent_coef_state = temperature
    model.lr_schedule = schedule


def save_checkpoint(model: SAC, run: Path) -> None:
    """Write the checkpoint of the decisions made so far."""
    leaves, _ = _flatten(_states(model))
    arrays = {f"{i:04d}": np.array(leaf) for i, leaf in enumerate(leaves)} | _statistics(model)
    buffer: Any = model.replay_buffer
    stop = buffer.buffer_size if buffer.full else buffer.pos
    replay = {k: np.ascontiguousarray(getattr(buffer, k)[:stop]) for k in REPLAY_ARRAYS}
    counters = {"decisions": model.num_timesteps, "updates": model._n_updates, "position": buffer.pos}
    state = {"model": _tensors(arrays), "replay": _tensors(replay), "counters": counters}
    Checkpoints(run).add(model.num_timesteps, state, 0.0)


def _tensors(arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def restore_checkpoint(model: SAC, run: Path) -> int:
    """Load the newest whole checkpoint; returns the decisions made so far, 0 without one. New episodes begin there."""
    found = Checkpoints(run).restore(lambda state: _restore(model, state))
    return 0 if found is None else int(model.num_timesteps)


def _restore(model: SAC, state: dict[str, Any]) -> None:
    import jax

    counters = state["counters"]
    stored, replay = ({name: tensor.numpy() for name, tensor in state[part].items()} for part in ("model", "replay"))
    model.set_random_seed(_seed_from(model.seed or 0, counters["decisions"]))
    policy = model.policy
    leaves, structure = _flatten(_states(model))
    restored = [np.asarray(stored[f"{i:04d}"], dtype=np.asarray(leaf).dtype) for i, leaf in enumerate(leaves)]
    states = jax.tree_util.tree_unflatten(structure, [jax.numpy.asarray(leaf) for leaf in restored])
    policy.actor_state, policy.qf_state, model.ent_coef_state, model.key, policy.key = states
    _set_statistics(model, stored)
    _restore_replay(model.replay_buffer, replay, counters["position"])
    model.num_timesteps, model._n_updates = counters["decisions"], counters["updates"]


def _seed_from(seed: int, decisions: int) -> int:
    """Of a run that goes on: other episodes than it began with, and than those that evaluate. Gymnasium adds to it."""
    return stream_seed(seed, "policy", "resumed", decisions) % 2**31


def _restore_replay(buffer: Any, replay: dict[str, np.ndarray], position: int) -> None:
    stop = len(replay["rewards"])
    for name in REPLAY_ARRAYS:
        getattr(buffer, name)[:stop] = replay[name]
    buffer.pos = position
    buffer.full = stop == buffer.buffer_size
    buffer.timeouts[position - 1] = True  # the episodes under way are not continued


def _flatten(tree: Any) -> tuple[list[Any], Any]:
    import jax

    return jax.tree_util.tree_flatten(tree)


def _states(model: SAC) -> tuple[Any, ...]:
    """Everything SBX learns, optimisers included, and the keys of its draws."""
    policy = model.policy
    return policy.actor_state, policy.qf_state, model.ent_coef_state, model.key, policy.key


def _networks(model: SAC) -> tuple[Any, ...]:
    return model.policy.actor_state.params, model.policy.qf_state.params, model.ent_coef_state.params


def _envs(model: SAC) -> Any:
    """The environments in SB3's VecNormalize, which keeps the statistics of their observations."""
    return model.get_vec_normalize_env()


def _statistics(model: SAC) -> dict[str, np.ndarray]:
    envs = _envs(model)
    if not envs.norm_obs:
        return {}
    running = envs.obs_rms
    return {f"observation.{name}": np.asarray(getattr(running, name), np.float64) for name in STATISTICS}


def _set_statistics(model: SAC, stored: dict[str, np.ndarray]) -> None:
    envs = _envs(model)
    if envs.norm_obs:
        for name in STATISTICS:
            setattr(envs.obs_rms, name, stored[f"observation.{name}"])
