"""OGBench's visual sets: one compressed `.npz` file, read as a stream.

Row t holds o_t, a_t and `terminals`, which is 1 at an episode's last row, whose action is unused. There are no rewards.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data.formats.base import DataFormat, SourceSet, as_frames, chosen, rows_of
from vd4rl_pomdp.data.shards import EpisodeArrays


def read(source: str, picture: str | None) -> SourceSet:
    """Open a file such as visual-cube-single-play-v0.npz."""
    path = Path(source)
    with zipfile.ZipFile(path) as file:
        if missing := {"observations", "actions", "terminals"} - {Path(name).stem for name in file.namelist()}:
            raise UserError(f"has no {min(missing)!r}, so it is not an OGBench dataset")
    with np.load(path) as file:  # loads only the arrays that are accessed
        action, terminals = file["actions"], file["terminals"].astype(bool)
    with _observations(path) as (_, shape, dtype):
        _, size = chosen({"observations": shape[1:]} if dtype == np.uint8 else {}, picture)
    if action.dtype.kind != "f":
        raise UserError(f"has actions of {action.dtype}, expected floating point")
    if not len(action) == len(terminals) == shape[0]:
        raise UserError(
            f"has {shape[0]} images, {len(action)} actions and {len(terminals)} terminals; download it again"
        )
    ends = np.flatnonzero(terminals) + 1
    if not len(ends) or ends[-1] != len(terminals):
        raise UserError("its last episode has no end")
    starts = np.append(0, ends[:-1])

    def episodes(first: int) -> Iterator[EpisodeArrays]:
        with _observations(path) as (stream, _, _):
            row = int(np.prod(shape[1:]))
            for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
                content = stream.read((end - start) * row)
                if number >= first:
                    frames = np.frombuffer(content, np.uint8).reshape(end - start, *shape[1:])
                    steps = end - start - 1
                    yield rows_of(as_frames(frames), action[start : end - 1], np.zeros(steps), False)

    return SourceSet(
        (ends - starts).tolist(),
        size,
        episodes,
        {"file": path.name.removesuffix(".npz"), "bytes": path.stat().st_size},
        notes=["it has no rewards, since goals define them: all are 0"],
    )


@contextmanager
def _observations(path: Path) -> Iterator[tuple[IO[bytes], tuple[int, ...], np.dtype]]:
    """The stream of the pictures' bytes, their shape and dtype; `np.load` would hold all of them."""
    with zipfile.ZipFile(path) as archive, archive.open("observations.npy") as stream:
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = header(stream)
        if fortran:
            raise UserError("stores its images in Fortran order")
        yield stream, shape, dtype


OGBENCH = DataFormat("OGBench's visual datasets, one .npz file each", read)
