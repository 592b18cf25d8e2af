"""LeRobot's format, version 3: rows in parquet, with images as PNG in the rows or as separate videos.

    meta/  info.json  tasks.parquet  stats.json  episodes/chunk-000/file-000.parquet: one row per episode, its location
    data/chunk-000/file-000.parquet         one row per step: o_t, a_t, and the outcome of a_t as `next.*`
    videos/KEY/chunk-000/file-000.mp4       many episodes, one after another

A row holds an image and an action, so an episode's final observation needs an extra row. Most data sets lack it, and
their last actions and rewards cannot be used. Data sets written here have it, with the last action repeated, as in
LeRobot's own evaluation; what info.json says of their column `next.discount` identifies them.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.reading import PICTURES, fits, rgb_of
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.format import FRAMES_KEY
from vd4rl_pomdp.data.formats.base import DataFormat, SourceSet, chosen, library, rows_of
from vd4rl_pomdp.data.shards import EpisodeArrays
from vd4rl_pomdp.runs.files import read_json, write_json

_EXTRA = "lerobot"
_PICTURE, _OWN, _NO_TASK = "observation.image", "next.discount", "unknown"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_CHUNK = 1000
"""Files in a folder; a data file has about `_FILE_MB`: LeRobot's own defaults."""
_FILE_MB = 100
_FPS = 20
_CODEC = {"crf": "18", "preset": "veryfast", "tune": "zerolatency", "threads": "1", "g": "2", "bf": "0"}
"""H.264 with a keyframe every second frame, for random access, as in LeRobot's own videos. Lookahead and threads would
take half as long again for such small images, at the same size."""
_arrow, _parquet = partial(library, "pyarrow", _EXTRA), partial(library, "pyarrow.parquet", _EXTRA)


def read_lerobot(path: str, picture: str | None = None) -> SourceSet:
    """Open a data set on disk; reading holds at most one episode and one row group in memory."""
    folder, pq = Path(path), _parquet()
    info = _info(folder)
    features, episodes = info["features"], _episodes(pq, folder, info)
    if "action" not in features:
        raise UserError(f"has no feature 'action' (features: {', '.join(features)})")
    cameras = {name: tuple(one["shape"]) for name, one in features.items() if one["dtype"] in ("image", "video")}
    key, shape = chosen(cameras, picture)
    marked = features.get(_OWN, {}).get("info") or {}
    own, lengths = "quality" in marked, episodes["length"]

    def files(kind: str, template: str) -> list[Path]:
        numbers = zip(episodes[f"{kind}/chunk_index"], episodes[f"{kind}/file_index"], strict=True)
        names = [Path(template.format(chunk_index=c, file_index=f, video_key=key)) for c, f in numbers]
        if outside := [name for name in names if name.is_absolute() or ".." in name.parts]:
            raise UserError(f"its meta/info.json names the file {outside[0]}, outside its folder; download it again")
        return [folder / name for name in names]

    data, filmed = files("data", info["data_path"]), features[key]["dtype"] == "video"
    films = files(f"videos/{key}", info["video_path"]) if filmed else []
    kept = ("next.reward", "next.done", "next.truncated", *((_OWN, "physics") if own else ()))
    outcomes = [name for name in kept if name in features]
    low, high, notes = (None, None, []) if own else _survey(pq, list(dict.fromkeys(data)), outcomes)
    tasks = [str(one) for one in pq.read_table(folder / "meta" / "tasks.parquet").to_pandas().index]
    named = tasks[0] if len(tasks) == 1 and re.fullmatch(r"[\w.-]+", tasks[0]) else None
    if own and named == _NO_TASK:
        named = None
    elif tasks and not named:
        several = f"its {len(tasks)} tasks become one dataset: " if len(tasks) > 1 else "its task is "
        notes.append(several + ", ".join([repr(one) for one in tasks[:3]] + ["..."] * (len(tasks) > 3)))

    def read(first: int) -> Iterator[EpisodeArrays]:
        columns = ["episode_index", "timestamp", "action", *outcomes, *([] if filmed else [key])]
        for number, stored in _stored(data, lengths, columns, first):
            if filmed:
                times = episodes[f"videos/{key}/from_timestamp"][number] + stored["timestamp"].astype(float)
                frames = _filmed(films[number], times, info["fps"], shape)
            elif None in stored[key]:
                raise UserError("its images are stored outside data/, which is not supported")
            else:
                opened = [Image.open(io.BytesIO(one), formats=PICTURES) for one in stored[key]]
                for one in opened:  # before they are decoded: a few kilobytes may hold gigabytes
                    _check_size((one.height, one.width), shape)
                frames = _stacked([np.asarray(rgb_of(one)) for one in opened])
            yield _rows(stored, frames, own)

    size = sum(file.stat().st_size for file in {*data, *films})
    record = {"set": folder.resolve().name, "picture": key, "bytes": size}
    return SourceSet(lengths, shape, read, record, low, high, named, marked.get("quality"), notes)


def _info(folder: Path) -> dict[str, Any]:
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise UserError("has no meta/info.json, so it is not a local LeRobot dataset; `hf download` fetches one")
    info = read_json(path)
    if not (version := str(info.get("codebase_version"))).startswith("v3."):
        raise UserError(f"is in the format {version}, not v3; convert_dataset_v21_to_v30 of LeRobot converts it")
    kinds = {"features": dict, "fps": float, "total_episodes": int, "total_frames": int, "data_path": str}
    wrong = [name for name, kind in kinds.items() if not (info.get(name) and fits(info[name], kind))]
    if wrong := wrong or [name for name, one in info["features"].items() if not {"dtype", "shape"} <= {*one}]:
        raise UserError(f"{path}: its {wrong[0]} is missing or damaged; download it again")
    return info


def _episodes(pq: Any, folder: Path, info: dict[str, Any]) -> dict[str, list[Any]]:
    """Columns of meta/episodes, which locate each episode, in order."""
    index = sorted(folder.glob("meta/episodes/*/[!.]*.parquet"))  # macOS writes ._x beside x
    names = [name for file in index[:1] for name in pq.read_schema(file).names if not name.startswith("stats/")]
    tables = [pq.read_table(file, columns=names) for file in index]
    table = _arrow().concat_tables(tables).sort_by("episode_index").to_pydict() if index else {"length": []}
    for what, found in (("episodes", len(table["length"])), ("frames", sum(table["length"]))):
        if found != (total := info[f"total_{what}"]):
            raise UserError(f"meta/episodes has {found} of {total} {what}; download it again")
    return table


def _stored(
    data: list[Path], lengths: list[int], columns: list[str], first: int
) -> Iterator[tuple[int, EpisodeArrays]]:
    """Yield (number, columns) of episodes from `first` on; `data` and `lengths` are each episode's file and rows."""
    for path, numbers in groupby(range(data.index(data[first]), len(data)), data.__getitem__):
        with _parquet().ParquetFile(path) as file:
            batches = file.iter_batches(256, columns=columns)
            held = file.schema_arrow.empty_table().select(columns)
            for number in numbers:
                while len(held) < lengths[number] and (batch := next(batches, None)):
                    held = _arrow().concat_tables([held, _arrow().Table.from_batches([batch])])
                table, held = held.slice(0, lengths[number]), held.slice(lengths[number])
                if number < first:
                    continue
                stored = {name: _dense(table[name].combine_chunks()) for name in columns}
                if len(table) < lengths[number] or (stored["episode_index"] != number).any():
                    raise UserError(f"{path.name} lacks rows that meta/episodes lists; download it again")
                yield number, stored


def _survey(pq: Any, files: list[Path], outcomes: list[str]) -> tuple[np.ndarray | None, np.ndarray | None, list[str]]:
    """Action bounds, if actions exceed [-1, 1], and warnings about unusable or missing values."""
    lows, highs, unused, lost, notes = [], [], 0, 0.0, []
    for file in files:
        table = pq.read_table(file, columns=["episode_index", "action", *outcomes])
        action = _dense(table["action"].combine_chunks())
        if action.dtype.kind != "f":
            raise UserError(f"its actions are {action.dtype}; expected floating point")
        lows.append(action.min(0))
        highs.append(action.max(0))
        last = np.flatnonzero(np.diff(table["episode_index"].to_numpy(), append=-1))
        if "next.done" in outcomes:  # a row after the terminal one only holds the final image
            last = last[~table["next.done"].to_numpy()[np.maximum(last - 1, 0)]]
        unused += len(last)
        if "next.reward" in outcomes:
            lost += float(_dense(table["next.reward"].combine_chunks())[last].sum())
    if unused:
        rewards = f" and rewards ({lost:g} in all)" if "next.reward" in outcomes else ""
        notes.append(f"the last actions{rewards} of {unused} episodes have no following image and are dropped")
    if "next.reward" not in outcomes:
        notes.append("it has no rewards: all are 0")
    low, high = np.min(lows, 0).astype(float), np.max(highs, 0).astype(float)
    if max(-low.min(), high.max()) <= 1:
        return None, None, notes
    notes.append("LeRobot stores no action bounds: each dimension's minimum and maximum become -1 and 1")
    still = low == high
    return np.where(still, low - 1, low), np.where(still, high + 1, high), notes


def _dense(column: Any) -> np.ndarray:
    """Values of an arrow array: (N,) numbers, (N, D) numbers from lists, or (N,) bytes of encoded images."""
    if hasattr(column, "field"):
        return np.array(column.field("bytes").to_pylist(), object)
    if hasattr(column, "values"):
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)


def _stacked(pictures: list[np.ndarray]) -> np.ndarray:
    """Stack (H, W, 3) images to (T, 3, H, W) with a single copy; transposing after stacking would need another."""
    out = np.empty((len(pictures), 3, *pictures[0].shape[:2]), np.uint8)
    return np.stack([one.transpose(2, 0, 1) for one in pictures], out=out)


def _check_size(size: tuple[int, int], declared: tuple[int, int]) -> None:
    if size != declared:
        found, wanted = (f"{height}x{width}" for height, width in (size, declared))
        raise UserError(f"has images of {found} pixels, its dataset declares {wanted}")


def _filmed(path: Path, times: np.ndarray, fps: float, size: tuple[int, int]) -> np.ndarray:
    """Decode a video's frames (T, 3, H, W) uint8 at increasing times, in seconds of the file; `size` is (H, W)."""
    av = library("av", _EXTRA)
    # Shared by all frames: `frame.to_ndarray(format=...)` creates one per frame, which is four times slower.
    converter = av.video.reformatter.VideoReformatter()
    pictures: list[np.ndarray] = []
    try:
        with av.open(str(path), format="mp4") as file:  # other formats, such as playlists, read other files
            stream = file.streams.video[0]
            file.seek(max(0, int((times[0] - 0.5 / fps) / stream.time_base)), stream=stream)
            for frame in file.decode(stream):
                _check_size((frame.height, frame.width), size)
                if frame.time > times[len(pictures)] + 0.5 / fps:
                    break
                if frame.time > times[len(pictures)] - 0.5 / fps:
                    pictures.append(converter.reformat(frame, format="rgb24").to_ndarray())
                if len(pictures) == len(times):
                    return _stacked(pictures)
    except av.error.InvalidDataError as error:
        raise UserError(f"{path.name} is damaged or not a video; download it again") from error
    raise UserError(f"{path.name} has no frame at {times[len(pictures)]:.3f} s; download it again")


def _rows(stored: dict[str, np.ndarray], frames: np.ndarray, own: bool) -> EpisodeArrays:
    """Convert an episode's LeRobot rows to this package's."""
    count = len(frames)
    done, truncated = (name in stored and bool(stored[name][-2:-1].any()) for name in ("next.done", "next.truncated"))
    reward, action = stored.get("next.reward", np.zeros(count)).reshape(count)[:-1], stored["action"].reshape(count, -1)
    physics = stored["physics"].reshape(count, -1) if "physics" in stored else None
    rows = rows_of(frames, action[:-1], reward, done and not truncated, done or not own, physics)
    return rows | ({"discount": np.append(1.0, stored[_OWN][:-1])} if own else {})


def write_lerobot(folder: Path, out: Path, source: SourceSet, video: bool = False) -> list[str]:
    """Write a data set for `LeRobotDataset(NAME, root=FOLDER)`, with images as PNG in the rows or as H.264 videos."""
    size, end, files, total = source.frame_shape[0], 0, 0, sum(source.lengths)
    if video and size % 2:
        raise UserError(f"video needs an even height and width, not {size}: pass --size, or use the format `lerobot`")
    held, index, changes = list[Any](), list[dict[str, Any]](), list[tuple[float, int]]()
    lost = {f"steps have no duration here: in the export they are {_FPS} a second": None}
    for number, rows in enumerate(source.read(0)):
        if rows["action"][0].any() or rows["reward"][0] or rows["discount"][0] != 1:
            lost["actions, rewards and discounts in first rows, which no step led to, are not stored"] = None
        pictures = np.ascontiguousarray(rows[FRAMES_KEY].transpose(0, 2, 3, 1))
        columns, begin, end = _columns(rows, number, end), end, end + len(pictures)
        with ThreadPoolExecutor() as pool:  # encoding releases the interpreter's lock
            held.append(_table(columns, [] if video else list(pool.map(_png, pictures))))
        place = {"episode_index": number, "tasks": [source.task or _NO_TASK], "length": end - begin}
        place |= {"dataset_from_index": begin, "dataset_to_index": end}
        place |= _numbered("data/", files) | _numbered("meta/episodes/", 0)
        if video:
            film = folder / _VIDEO.format(video_key=_PICTURE, **_numbered("", number))
            _encode(film, pictures)
            if number % 10 == 0:
                decoded = _filmed(film, columns["timestamp"].astype(float), _FPS, (size, size))
                change = np.abs(decoded.astype(np.int16) - rows[FRAMES_KEY])
                changes.append((change.mean(), change.max()))
            where = _numbered("", number) | {"from_timestamp": 0.0, "to_timestamp": len(pictures) / _FPS}
            place |= {f"videos/{_PICTURE}/{name}": value for name, value in where.items()}
        for name, values in (columns | {_PICTURE: rows[FRAMES_KEY][::10]}).items():
            place |= {f"stats/{name}/{kind}": value for kind, value in _stats(values).items()}
        index.append(place)
        if end == total or sum(table.nbytes for table in held) >= _FILE_MB * 2**20:
            _save(folder / _DATA.format(**_numbered("", files)), held)
            held, files = [], files + 1
    _save(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet", [_arrow().Table.from_pylist(index)])
    _describe(folder, source, columns, index, video)
    if video:
        mean, most = np.mean([one[0] for one in changes]), max(one[1] for one in changes)
        off = f"values are off by {mean:.2f} of 255 on average, {most} at most"
        lost[f"pictures became H.264: in every tenth episode {off}; the format `lerobot` keeps them"] = None
    return list(lost)


def _columns(rows: EpisodeArrays, number: int, begin: int) -> dict[str, np.ndarray]:
    """LeRobot's columns of an episode: o_t, a_t and its outcome `next.*`; the last row repeats the last action."""
    frame = np.arange(len(rows["reward"]))
    after = np.minimum(frame + 1, frame[-1])
    return {
        "action": rows["action"][after].astype(np.float32),
        "next.reward": np.append(rows["reward"][1:], 0.0),
        "next.done": (rows["step_type"] == StepType.LAST)[after],
        _OWN: rows["discount"][after].astype(np.float64),
        # not called `observation.*`, since LeRobot's policies read all of those
        **{name: rows[name] for name in ("physics",) if name in rows},
        "timestamp": (frame / _FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full_like(frame, number),
        "index": frame + begin,
        "task_index": np.zeros_like(frame),
    }


def _table(columns: dict[str, np.ndarray], files: list[bytes]) -> Any:
    """Columns as an arrow table: width 1 as numbers, not one-element lists; `files` are PNG images, if any."""
    arrow = _arrow()
    arrays = {name: arrow.array(values.ravel()) for name, values in columns.items()}
    for name, values in columns.items():
        if values[0].size > 1:
            arrays[name] = arrow.FixedSizeListArray.from_arrays(arrays[name], values.shape[1])
    if files:
        parts = [arrow.array(files, arrow.binary()), arrow.nulls(len(files), arrow.string())]
        arrays[_PICTURE] = arrow.StructArray.from_arrays(parts, ["bytes", "path"])
    return arrow.table(arrays)


def _save(path: Path, tables: list[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    _parquet().write_table(_arrow().concat_tables(tables), path, row_group_size=512)


def _describe(
    folder: Path, source: SourceSet, columns: EpisodeArrays, index: list[dict[str, Any]], video: bool
) -> None:
    """Write the files in meta/ other than the episodes."""
    size, task = source.frame_shape[0], source.task or _NO_TASK
    coded = {"height": size, "width": size, "codec": "h264", "pix_fmt": "yuv420p", "fps": _FPS, "channels": 3}
    info = {f"video.{name}": value for name, value in (coded | {"is_depth_map": False}).items()} | {"has_audio": False}
    picture = {"shape": [size, size, 3], "names": ["height", "width", "channels"]}
    picture |= {"dtype": "video", "info": info} if video else {"dtype": "image"}
    features: dict[str, dict[str, Any]] = {_PICTURE: picture} | {
        name: {"dtype": str(values.dtype), "shape": [values[0].size], "names": None} for name, values in columns.items()
    }
    features[_OWN]["info"] = {"quality": source.quality}
    pd.DataFrame({"task_index": [0]}, index=pd.Index([task], name="task")).to_parquet(folder / "meta" / "tasks.parquet")
    write_json(folder / "meta" / "stats.json", {name: _joined(index, f"stats/{name}/") for name in features})
    described = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(index),
        "total_frames": index[-1]["dataset_to_index"],
        "total_tasks": 1,
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": _FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": _FPS,
        "splits": {"train": f"0:{len(index)}"},
        "data_path": _DATA,
        "video_path": _VIDEO if video else None,
        "features": features,
    }
    write_json(folder / "meta" / "info.json", described)


def _stats(values: np.ndarray) -> dict[str, list[Any]]:
    """Statistics of a column over rows, or per channel of (N, 3, H, W) images, scaled to [0, 1]."""
    pixels = values.ndim == 4
    flat = values.swapaxes(0, 1).reshape(3, -1) if pixels else values.reshape(len(values), -1).T.astype(float)
    found = {"min": flat.min(1), "max": flat.max(1), "mean": flat.mean(1), "std": flat.std(1)}
    shaped = {kind: (value / 255).reshape(3, 1, 1) if pixels else value for kind, value in found.items()}
    return {kind: value.tolist() for kind, value in shaped.items()} | {"count": [len(values)]}


def _joined(index: list[dict[str, Any]], prefix: str) -> dict[str, list[Any]]:
    """Combine the episodes' statistics into those of the whole data set."""
    least, most, means, std, count = (
        np.array([one[prefix + kind] for one in index], float) for kind in ("min", "max", "mean", "std", "count")
    )
    share = (count / count.sum()).reshape(-1, *[1] * (means.ndim - 1))
    mean = (share * means).sum(0)
    spread = np.sqrt((share * (std**2 + (means - mean) ** 2)).sum(0))
    whole = {"min": least.min(0), "max": most.max(0), "mean": mean, "std": spread}
    return {kind: value.tolist() for kind, value in whole.items()} | {"count": [int(count.sum())]}


def _png(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", compress_level=2)  # higher levels: slower, 5% smaller
    return buffer.getvalue()


def _encode(path: Path, pictures: np.ndarray) -> None:
    """Write an episode's video."""
    av = library("av", _EXTRA)
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", _FPS, options=_CODEC)
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode())


def _numbered(prefix: str, number: int) -> dict[str, Any]:
    return {f"{prefix}chunk_index": number // _CHUNK, f"{prefix}file_index": number % _CHUNK}


LEROBOT = DataFormat("LeRobot datasets, version 3; written as PNG images", read_lerobot, write_lerobot)
LEROBOT_VIDEO = DataFormat(
    "LeRobot datasets, version 3; written as video", read_lerobot, partial(write_lerobot, video=True)
)
