"""LeRobot's format, version 3: rows in parquet, pictures in them as PNG or beside them as video.

    meta/  info.json  tasks.parquet  stats.json  episodes/chunk-000/file-000.parquet: a row an episode, where it lies
    data/chunk-000/file-000.parquet         a row a step: o_t with a_t, and as `next.*` what a_t led to
    videos/KEY/chunk-000/file-000.mp4       many episodes, one after another

A row has a picture and an action, so what the last action led to needs a row of its own. Most sets have none, and their
last actions and rewards cannot be used. Sets that are written here have one, which repeats the last action, as
LeRobot's own evaluation does; they are known by their column `next.discount`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data.format import FRAMES_KEY
from vd4rl_pomdp.data.formats.base import DataFormat, SourceSet, chosen, library, rows_of
from vd4rl_pomdp.data.shards import EpisodeArrays
from vd4rl_pomdp.runs.files import read_json, write_json

_EXTRA = "lerobot"
_PICTURE, _OWN = "observation.image", "next.discount"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_CHUNK = 1000
"""Files in a folder; a data file has about `_FILE_MB`: LeRobot's own defaults."""
_FILE_MB = 100
_FPS = 20
_CODEC = {"crf": "18", "preset": "veryfast", "g": "2", "bf": "0"}
"""H.264 in which every second frame stands alone, as in LeRobot's own videos, for access in any order."""


def read_lerobot(path: str, picture: str | None = None) -> SourceSet:
    """A set on disk, of which no more than an episode and a row group of a file is held."""
    folder = Path(path)
    if not (folder / "meta" / "info.json").is_file():
        raise UserError(
            "has no meta/info.json, so it is no LeRobot set on this disk; `hf download --repo-type dataset NAME "
            "--local-dir FOLDER` fetches one"
        )
    arrow, pq = library("pyarrow", _EXTRA), library("pyarrow.parquet", _EXTRA)
    info = read_json(folder / "meta" / "info.json")
    if not str(info["codebase_version"]).startswith("v3."):
        raise UserError(
            f"is in the format {info['codebase_version']}, not v3; convert_dataset_v21_to_v30 of LeRobot converts it"
        )
    features = info["features"]
    cameras = {name: tuple(one["shape"]) for name, one in features.items() if one["dtype"] in ("image", "video")}
    key, shape = chosen(cameras, picture)
    video, own = features[key]["dtype"] == "video", _OWN in features
    index = sorted(folder.glob("meta/episodes/*/*.parquet"))
    names = [name for name in pq.read_schema(index[0]).names if not name.startswith("stats/")]
    table = arrow.concat_tables([pq.read_table(file, columns=names) for file in index])
    if len(table) != info["total_episodes"]:
        raise UserError(f"meta/episodes has {len(table)} of {info['total_episodes']} episodes; fetch it again")
    episodes = table.sort_by("episode_index").to_pydict()

    def files(kind: str, template: str) -> list[Path]:
        numbers = zip(episodes[f"{kind}/chunk_index"], episodes[f"{kind}/file_index"], strict=True)
        return [folder / template.format(chunk_index=c, file_index=f, video_key=key) for c, f in numbers]

    data, lengths = files("data", info["data_path"]), episodes["length"]
    films = files(f"videos/{key}", info["video_path"]) if video else []
    size = sum(file.stat().st_size for file in {*data, *films})
    wanted = [name for name in ("next.reward", "next.done", "next.truncated", _OWN, "physics") if name in features]
    columns = ["episode_index", "timestamp", "action", *wanted, *([] if video else [key])]
    low, high, notes = (None, None, []) if own else _survey(pq, list(dict.fromkeys(data)), wanted)
    tasks = [str(one) for one in pq.read_table(folder / "meta" / "tasks.parquet").to_pandas().index]
    named = len(tasks) == 1 and re.fullmatch(r"[\w.-]+", tasks[0])
    if len(tasks) == 1 and not named:
        notes.append(f"its task is {tasks[0]!r}")

    def read(first: int) -> Iterator[EpisodeArrays]:
        for path, numbers in groupby(range(data.index(data[first]), len(data)), data.__getitem__):
            with pq.ParquetFile(path) as file:
                batches = file.iter_batches(256, columns=columns)
                held = file.schema_arrow.empty_table().select(columns)
                for number in numbers:
                    while len(held) < lengths[number] and (batch := next(batches, None)):
                        held = arrow.concat_tables([held, arrow.Table.from_batches([batch])])
                    table, held = held.slice(0, lengths[number]), held.slice(lengths[number])
                    if number < first:
                        continue
                    told = {name: _dense(table[name].combine_chunks()) for name in columns}
                    if len(table) < lengths[number] or (told["episode_index"] != number).any():
                        raise UserError(f"{path.name} has not the rows of it that meta/episodes tells; fetch it again")
                    if video:
                        times = episodes[f"videos/{key}/from_timestamp"][number] + told["timestamp"].astype(float)
                        frames = _filmed(films[number], times, info["fps"])
                    else:
                        frames = np.stack([_decoded(one) for one in told[key]])
                    yield _rows(told, frames.transpose(0, 3, 1, 2), own)

    return SourceSet(
        len(lengths),
        sum(lengths),
        shape,
        read,
        {"set": folder.resolve().name, "picture": key, "bytes": size},
        low,
        high,
        task=tasks[0] if named else None,
        quality=(features[_OWN].get("info") or {}).get("quality") if own else None,
        notes=notes,
    )


def _survey(pq: Any, files: list[Path], wanted: list[str]) -> tuple[np.ndarray | None, np.ndarray | None, list[str]]:
    """Bounds of a set's actions, if they pass 1, and notes on what is left out of it or is not there."""
    lows, highs, unused, lost, notes = [], [], 0, 0.0, []
    for file in files:
        table = pq.read_table(file, columns=["episode_index", "action", *wanted])
        action = _dense(table["action"].combine_chunks())
        if action.dtype.kind != "f":
            raise UserError(f"its actions are {action.dtype}; only those of floating point are read")
        lows.append(action.min(0))
        highs.append(action.max(0))
        last = np.flatnonzero(np.diff(table["episode_index"].to_numpy(), append=-1))
        if "next.done" in wanted:  # a row after the one that ended the episode is there for its picture alone
            last = last[~table["next.done"].to_numpy()[np.maximum(last - 1, 0)]]
        unused += len(last)
        if "next.reward" in wanted:
            lost += float(_dense(table["next.reward"].combine_chunks())[last].sum())
    if unused:
        rewards = f" and rewards ({lost:g} in all)" if "next.reward" in wanted else ""
        notes.append(f"the last actions{rewards} of {unused} episodes lead to no stored picture and are left out")
    if "next.reward" not in wanted:
        notes.append("it has no rewards: all are 0")
    low, high = np.min(lows, 0).astype(float), np.max(highs, 0).astype(float)
    if max(-low.min(), high.max()) <= 1:
        return None, None, notes
    notes.append("LeRobot stores no bounds of actions: the least and the greatest of each dimension become -1 and 1")
    still = low == high
    return np.where(still, low - 1, low), np.where(still, high + 1, high), notes


def _dense(column: Any) -> np.ndarray:
    """Values of an arrow array: (N,) numbers, (N, D) of lists of them, or (N,) bytes of pictures."""
    if hasattr(column, "field"):
        return np.array(column.field("bytes").to_pylist(), object)
    if hasattr(column, "values"):
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)


def _decoded(picture: bytes | None) -> np.ndarray:
    if picture is None:
        raise UserError("its pictures lie in other files than data/, which are not followed")
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))


def _filmed(path: Path, times: np.ndarray, fps: float) -> np.ndarray:
    """(T, H, W, 3) uint8 pictures of a video at increasing times, in seconds of the file."""
    av = library("av", _EXTRA)
    # One for all frames: `frame.to_ndarray(format=...)` makes a new one each time, which is four times as slow.
    converter = av.video.reformatter.VideoReformatter()
    pictures: list[np.ndarray] = []
    try:
        with av.open(str(path)) as file:
            stream = file.streams.video[0]
            file.seek(max(0, int((times[0] - 0.5 / fps) / stream.time_base)), stream=stream)
            for frame in file.decode(stream):
                if frame.time > times[len(pictures)] + 0.5 / fps:
                    break
                if frame.time > times[len(pictures)] - 0.5 / fps:
                    pictures.append(converter.reformat(frame, format="rgb24").to_ndarray())
                if len(pictures) == len(times):
                    return np.stack(pictures)
    except av.error.InvalidDataError as error:
        raise UserError(f"{path.name} is damaged or no video; fetch it again") from error
    raise UserError(f"{path.name} has no picture at {times[len(pictures)]:.3f} s; fetch it again")


def _rows(told: dict[str, np.ndarray], frames: np.ndarray, own: bool) -> EpisodeArrays:
    """LeRobot's rows of an episode as this package's."""
    count = len(frames)
    done, truncated = (
        bool(told[name][-2:-1].any()) if name in told else False for name in ("next.done", "next.truncated")
    )
    reward, action = (
        told.get("next.reward", np.zeros(count)).reshape(count)[:-1],
        told["action"].reshape(count, -1)[:-1],
    )
    physics = told["physics"].reshape(count, -1) if "physics" in told else None
    rows = rows_of(frames, action, reward, done and not truncated, done or not own, physics)
    return rows | ({"discount": np.append(1.0, told[_OWN][:-1])} if own else {})


def write_lerobot(folder: Path, out: Path, source: SourceSet, video: bool = False) -> list[str]:
    """A set that `LeRobotDataset(NAME, root=FOLDER)` loads; pictures as PNG in the rows, or as H.264 beside them."""
    arrow, pq = library("pyarrow", _EXTRA), library("pyarrow.parquet", _EXTRA)
    size, task = source.frame_shape[0], source.task or "unknown"
    if video and size % 2:
        raise UserError(f"video needs an even height and width, not {size}: pass --size, or take `lerobot`")

    def opened(path: Path, table: Any) -> Any:
        path.parent.mkdir(parents=True, exist_ok=True)
        return pq.ParquetWriter(path, table.schema)

    features: dict[str, dict[str, Any]] = {
        _PICTURE: {"dtype": "image", "shape": [size, size, 3], "names": ["height", "width", "channels"]}
    }
    if video:
        coded = {"height": size, "width": size, "codec": "h264", "pix_fmt": "yuv420p", "fps": _FPS, "channels": 3}
        info = {f"video.{name}": value for name, value in (coded | {"is_depth_map": False}).items()}
        features[_PICTURE] |= {"dtype": "video", "info": info | {"has_audio": False}}
    png = _png_encoder(size)
    totals: dict[str, dict[str, np.ndarray]] = {}
    told: list[dict[str, Any]] = []
    data: Any = None
    index: Any = None
    changes: list[float] = []
    begin, files, filled, unkept, most = 0, 0, 0, False, 0
    for number, rows in enumerate(source.read(0)):
        count = len(rows["reward"])
        unkept |= bool(rows["action"][0].any() or rows["reward"][0] or rows["discount"][0] != 1)
        columns = _columns(rows) | {
            "timestamp": (np.arange(count) / _FPS).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(begin, begin + count),
            "task_index": np.zeros(count, np.int64),
        }
        if not totals:
            features |= {
                name: {"dtype": str(values.dtype), "shape": [values[0].size], "names": None}
                for name, values in columns.items()
            }
        pictures = np.ascontiguousarray(rows[FRAMES_KEY].transpose(0, 2, 3, 1))
        arrays = {name: _array(arrow, values) for name, values in columns.items()}
        if not video:
            parts = [arrow.array([png(one) for one in pictures], arrow.binary()), arrow.nulls(count, arrow.string())]
            arrays[_PICTURE] = arrow.StructArray.from_arrays(parts, ["bytes", "path"])
        table = arrow.table(arrays)
        if data is None or filled >= _FILE_MB * 2**20:
            if data:
                data.close()
            data, files, filled = opened(folder / _DATA.format(**_numbered("", files)), table), files + 1, 0
        data.write_table(table)
        filled += table.nbytes
        place = _numbered("data/", files - 1) | _numbered("meta/episodes/", 0)
        place |= {"dataset_from_index": begin, "dataset_to_index": begin + count}
        if video:
            where = _numbered("", number)
            film = folder / _VIDEO.format(video_key=_PICTURE, **where)
            _encode(film, pictures)
            if number % 10 == 0:
                change = np.abs(_filmed(film, np.arange(count) / _FPS, _FPS).astype(np.int16) - pictures)
                changes.append(float(change.mean()))
                most = max(most, int(change.max()))
            where |= {"from_timestamp": 0.0, "to_timestamp": count / _FPS}
            place |= {f"videos/{_PICTURE}/{name}": value for name, value in where.items()}
        stats = {name: _stats(values) for name, values in columns.items()} | {_PICTURE: _stats(pictures[::10])}
        totals = {name: _joined(totals[name], one) if totals else one for name, one in stats.items()}
        place |= {f"stats/{name}/{kind}": one[kind].tolist() for name, one in stats.items() for kind in one}
        told.append({"episode_index": number, "tasks": [task], "length": count} | place)
        if len(told) == 100 or number == source.episodes - 1:
            table, told = arrow.Table.from_pylist(told), []
            index = index or opened(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet", table)
            index.write_table(table)
        begin += count
    for writer in (data, index):
        writer.close()
    features[_OWN]["info"] = {"quality": source.quality}
    from pandas import DataFrame, Index  # slow to load

    DataFrame({"task_index": [0]}, index=Index([task], name="task")).to_parquet(folder / "meta" / "tasks.parquet")
    plain = {name: {kind: value.tolist() for kind, value in one.items()} for name, one in totals.items()}
    write_json(folder / "meta" / "stats.json", plain)
    described = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": source.episodes,
        "total_frames": begin,
        "total_tasks": 1,
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": _FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": _FPS,
        "splits": {"train": f"0:{source.episodes}"},
        "data_path": _DATA,
        "video_path": _VIDEO if video else None,
        "features": features,
    }
    write_json(folder / "meta" / "info.json", described)
    lost = [f"steps have no duration here: in the export they are {_FPS} a second"]
    if unkept:
        lost.append("actions, rewards and discounts in first rows, which no step led to, are not stored")
    if video:
        lost.append(
            f"pictures became H.264: in every tenth episode values are off by {np.mean(changes):.2f} of 255 on "
            f"average, {most} at most; the format `lerobot` keeps them"
        )
    return lost


def _columns(rows: EpisodeArrays) -> dict[str, np.ndarray]:
    """An episode's rows by LeRobot's names: o_t with a_t and what it led to; the last row repeats the last action."""
    count = len(rows["reward"])
    after = np.minimum(np.arange(count) + 1, count - 1)
    columns = {
        "action": rows["action"][after].astype(np.float32),
        "next.reward": np.append(rows["reward"][1:], 0.0),
        "next.done": (rows["step_type"] == StepType.LAST)[after],
        _OWN: rows["discount"][after].astype(np.float64),
    }
    # not called `observation.*`, all of which LeRobot's policies are given
    return columns | ({"physics": rows["physics"]} if "physics" in rows else {})


def _array(arrow: Any, values: np.ndarray) -> Any:
    """A column of the file; of width 1 it holds numbers, not lists of one."""
    flat = arrow.array(values.ravel())
    return flat if values[0].size == 1 else arrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _png_encoder(size: int) -> Callable[[np.ndarray], bytes]:
    """What makes a PNG file of a picture: FFmpeg's, which takes half the time of Pillow's for the same size."""
    av = library("av", _EXTRA)
    coder = av.CodecContext.create("png", "w")
    coder.height, coder.width, coder.pix_fmt, coder.time_base = size, size, "rgb24", Fraction(1, _FPS)
    coder.thread_count, coder.options = 1, {"compression_level": "1", "pred": "sub"}
    return lambda picture: b"".join(map(bytes, coder.encode(av.VideoFrame.from_ndarray(picture, format="rgb24"))))


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


def _stats(values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of a column over rows, or of the channels of (N, H, W, 3) pictures, which count from 0 to 1."""
    pixels = values.ndim == 4
    flat = values.reshape(-1, 3) / 255 if pixels else values.reshape(len(values), -1).astype(float)
    told = {"min": flat.min(0), "max": flat.max(0), "mean": flat.mean(0), "std": flat.std(0)}
    shaped = {kind: value.reshape((3, 1, 1) if pixels else -1) for kind, value in told.items()}
    return shaped | {"count": np.array([len(values)])}


def _joined(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Statistics of two parts together."""
    count = a["count"] + b["count"]
    mean = (a["count"] * a["mean"] + b["count"] * b["mean"]) / count
    squares = sum(one["count"] * (one["std"] ** 2 + (one["mean"] - mean) ** 2) for one in (a, b))
    least, most = np.minimum(a["min"], b["min"]), np.maximum(a["max"], b["max"])
    return {"min": least, "max": most, "mean": mean, "std": np.sqrt(squares / count), "count": count}


LEROBOT = DataFormat("LeRobot's sets, version 3; written with PNG pictures", read_lerobot, write_lerobot)
LEROBOT_VIDEO = DataFormat(
    "LeRobot's sets, version 3; written with video", read_lerobot, partial(write_lerobot, video=True)
)
