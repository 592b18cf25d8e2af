"""Minari's data sets, by its own library: reads any of its storage formats, writes HDF5.

A data set is a folder with a `data` folder in it, or a name registered with Minari. An episode has one more observation
than actions, with a_t aligned to o_t. Images are written as (3, S, S), which Minari stores losslessly; it stores
(H, W, 3), the shape of most environments, as JPEG unless `jpeg_encoding=False` was passed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np

from vd4rl_pomdp.core.errors import DiskFullError, UserError
from vd4rl_pomdp.core.reading import regular
from vd4rl_pomdp.core.tasks import TASKS, GymnasiumTask
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.format import FRAMES_KEY, refuse_elsewhere
from vd4rl_pomdp.data.formats.base import DataFormat, SourceSet, as_frames, chosen, library, one_hot, rows_of
from vd4rl_pomdp.data.shards import EpisodeArrays

_KEY = "vd4rl_pomdp"
"""Metadata key of an export, for task and quality of the data set."""


def read(source: str, picture: str | None) -> SourceSet:
    """Open a data set by folder or name."""
    minari, storage = library("minari", "minari"), library("minari.dataset.minari_storage", "minari")
    folder = next((f for f in (Path(source), Path(source, "data")) if (f / "metadata.json").is_file()), None)
    try:
        dataset = minari.MinariDataset(folder) if folder else minari.load_dataset(source)
    except FileNotFoundError as error:
        raise UserError(
            f"is neither a Minari folder nor an installed Minari dataset: run `minari download {source}`?"
        ) from error
    for file in Path(dataset.storage.data_path).glob("[!.]*.hdf5"):
        with h5py.File(regular(file)) as opened:
            refuse_elsewhere(file, opened)
    actions = dataset.action_space
    discrete = isinstance(actions, gymnasium.spaces.Discrete)
    if not discrete and not isinstance(actions, gymnasium.spaces.Box):
        raise UserError(f"has actions of {actions}, not Box or Discrete")
    spaces = dict(_leaves(dataset.observation_space))
    key, size = chosen({name: space.shape or () for name, space in spaces.items() if space.dtype == np.uint8}, picture)
    metadata, spec = json.loads(dataset.storage.metadata.get(_KEY, "{}")), dataset.env_spec
    notes = []
    if discrete:
        notes.append(f"the {actions.n} discrete actions become one-hot columns: 1 for the one taken, -1 for the others")
    if storage.is_image_space(spaces[key]) and dataset.storage.jpeg_encoding:
        notes.append("its images are JPEG, not the rendered ones; DataCollector(jpeg_encoding=False) keeps those")
    if spec and spec.kwargs.get("corruption", "none") != "none":
        notes.append(f"its images were recorded under the corruption {spec.kwargs['corruption']}")
    lengths = [int(one["total_steps"]) for one in dataset.storage.get_episode_metadata(dataset.episode_indices)]

    def episode(number: int) -> EpisodeArrays:
        stored = dataset[number]
        if len(stored) != lengths[number]:  # Arrow's reader stops after 32,768 rows, its largest batch
            raise UserError(f"Minari reads {len(stored)} of its {lengths[number]} steps")
        frames = stored.observations
        for part in key.split("/") if key else ():
            frames = frames[int(part) if isinstance(frames, tuple) else part]
        if len(action := stored.actions) != len(stored.truncations):
            raise UserError(f"has {len(action)} actions, but {len(stored.truncations)} truncations")
        action = one_hot(action - actions.start, actions.n) if discrete else action.reshape(len(action), -1)
        return rows_of(
            as_frames(frames),
            action,
            stored.rewards,
            stored.terminations,
            bool(stored.terminations[-1:].any() or stored.truncations[-1:].any()),
            stored.infos["physics"] if metadata.get("physics") else None,
        )

    bounded = not discrete and actions.is_bounded()
    return SourceSet(
        [steps + 1 for steps in lengths],
        size,
        lambda first: map(episode, range(first, len(lengths))),
        {"id": dataset.id, "picture": key, "steps": sum(lengths), "minari": dataset.minari_version},
        actions.low.ravel() if bounded else None,
        actions.high.ravel() if bounded else None,
        metadata.get("task") or _task(spec),
        metadata.get("set"),
        notes,
    )


def _leaves(space: gymnasium.Space[Any], name: str = "") -> Iterator[tuple[str, gymnasium.spaces.Box]]:
    """Yield the Box spaces nested in a space, with their paths, such as "image/front"."""
    if isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple):
        parts = space.spaces.items() if isinstance(space, gymnasium.spaces.Dict) else enumerate(space.spaces)
        for key, part in parts:
            yield from _leaves(part, f"{name}/{key}".strip("/"))
    if isinstance(space, gymnasium.spaces.Box):
        yield name, space


def _task(spec: gymnasium.envs.registration.EnvSpec | None) -> str | None:
    """The registered task with the environment that recorded the data set, None if there is none."""
    if spec is None:
        return None
    own = {name for name, task in TASKS.items() if isinstance(task, GymnasiumTask) and task.environment == spec.id}
    named = spec.kwargs.get("task") if spec.id.startswith("vd4rl_pomdp/") else None
    return named or next(iter(own), None)


def write(folder: Path, out: Path, source: SourceSet) -> list[str]:
    """Write a data set that Minari loads by name if `out` is in Minari's own folder, else by path."""
    minari, storage = library("minari", "minari"), library("minari.dataset.minari_storage", "minari")
    home = library("minari.storage.datasets_root_dir", "minari").get_dataset_path().resolve()
    name = out.resolve().relative_to(home).as_posix() if out.resolve().is_relative_to(home) else out.name
    matched = library("minari.dataset.minari_dataset", "minari").DATASET_ID_RE.fullmatch(name)
    if not matched or not matched["version"]:
        raise UserError(
            f"{out}: Minari does not accept the name {name!r}: end it in a version, as in walker-v0 or mine/walker-v0, "
            "with only letters, digits, - and _, and at least two characters before a /"
        )
    folder.mkdir()
    # Dimensions come from the first episode. Minari does not treat (3, S, S) as an image, so it is never JPEG-encoded.
    first = next(source.read(0))
    size, free = sum(source.lengths) * first[FRAMES_KEY][0].nbytes, shutil.disk_usage(folder).free
    if size > free:  # HDF5 ends the process on a full disk
        raise DiskFullError(
            f"{out}: the export needs {size:,} bytes, the disk has {free:,}; free some space, or choose another folder"
        )
    pictures = gymnasium.spaces.Box(0, 255, first[FRAMES_KEY].shape[1:], np.uint8)
    actions = gymnasium.spaces.Box(-1.0, 1.0, first["action"].shape[1:], np.float32)
    made = storage.MinariStorage.new(folder / "data", pictures, actions)
    metadata = {"task": source.task, "set": source.quality, "physics": "physics" in first}
    made.update_metadata({"dataset_id": name, "minari_version": minari.__version__, _KEY: json.dumps(metadata)})
    lost: dict[str, None] = {}
    for rows in source.read(0):
        discount, steps = rows["discount"], len(rows["reward"]) - 1
        if not steps:
            lost["episodes of a single row are left out: Minari has none"] = None
            continue
        if not np.isin(discount[1:], (0, 1)).all() or discount[0] != 1:
            lost["discounts other than 1, and 0 where the task ended, are not kept"] = None
        truncations = (rows["step_type"] == StepType.LAST)[1:] & (discount[1:] != 0)
        episode = minari.data_collector.EpisodeBuffer(
            observations=rows[FRAMES_KEY],
            actions=rows["action"][1:],
            rewards=rows["reward"][1:],
            terminations=discount[1:] == 0,
            truncations=truncations,
            infos={"physics": rows["physics"]} if metadata["physics"] else None,
        )
        made.update_episodes([episode])
    return list(lost)


MINARI = DataFormat(
    "Minari datasets, HDF5 or Arrow, as its DataCollector records them from a Gymnasium environment", read, write
)
