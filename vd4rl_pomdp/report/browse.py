"""A dataset's episodes as one self-contained HTML page: frames, clean and corrupted, actions, rewards."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import tyro
from PIL import Image

from vd4rl_pomdp.core.errors import MAX_SEED, UserError, refuse_no_folder, refuse_outside
from vd4rl_pomdp.core.options import Options, StageConfig, flat
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.core.tasks import FRAME_STACK
from vd4rl_pomdp.corruptions import NO_CORRUPTION, CorruptionConfig, check_corruption_fits
from vd4rl_pomdp.data import View, open_dataset
from vd4rl_pomdp.report.render import render
from vd4rl_pomdp.runs.files import Row, write_bytes
from vd4rl_pomdp.runs.outputs import refuse_inside

MOST_BYTES = 4_900_000
"""Maximum size of the page. As many rows per episode are shown as fit."""
COLUMNS = 32  # frames per row of an image sheet
_QUALITY = 50
_POINTS = 600  # maximum points of a curve
_LARGEST = 128  # maximum frame size in pixels; larger frames are subsampled by an integer step
_MARK = b"<title>vd4rl-pomdp data view"


@dataclass(frozen=True, kw_only=True)
class ViewConfig(StageConfig):
    """Write a dataset as one HTML page, clean and corrupted. For its options, put --corruption before --help."""

    data: tyro.conf.Positional[Path] = Path()
    """Folder of shards."""
    out: Path = Path("view.html")
    """File to write."""
    episodes: int = 100
    """Episodes to show, evenly spaced. With fewer episodes, more rows of each fit."""
    seed: int = 0
    """Seed of the corruption."""
    corruption: CorruptionConfig = NO_CORRUPTION
    """The corruption to toggle; with `emission`, exactly as runs with this seed see it."""

    preset: tyro.conf.Suppress[str] = "paper"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"corruption": "patch+zero_frames", "corruption_mode": "emission"}
    }
    choosers: ClassVar[tuple[str, ...]] = ("corruption",)

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        return {"corruption": CorruptionConfig.fill(values)}

    def check(self) -> None:
        """Raise UserError for invalid settings, or if `out` is another kind of file."""
        super().check()
        refuse_outside(self, episodes=(1, 500), seed=(0, MAX_SEED))
        refuse_inside(self.out)
        refuse_no_folder(self.out.parent)
        if os.path.lexists(self.out) and not (self.out.exists() and _MARK in read_bytes(self.out)[:1000]):
            raise UserError(f"{self.out}: is not a page of `data view`; choose another --out")


def write_view(config: ViewConfig) -> Path:
    """Write the page and return its path; UserError if the dataset, the corruption or the file does not allow it."""
    config.check()
    data = open_dataset(config.data)
    check_corruption_fits(config.corruption, data.frame_size)
    view = View(data, config.corruption, seed=config.seed)
    count = min(config.episodes, data.num_episodes)
    shown = np.linspace(0, data.num_episodes - 1, count).round().astype(int).tolist()
    longest = data.longest_episode
    rows = min(longest, 16)  # trial page, to estimate how many rows fit
    few = shown[:: -(-count // 5)]
    trial = len(_page(config, view, few, rows)) / len(few) / rows
    rows = min(longest, max(2, int(MOST_BYTES / count / trial)))
    page = _page(config, view, shown, rows)
    fitting = min(longest, int(0.95 * rows * MOST_BYTES / len(page)))
    if fitting > rows:  # size grows less than linearly with rows, which share frames
        rows, page = fitting, _page(config, view, shown, fitting)
    while len(page) > MOST_BYTES and rows > 2:
        rows = max(2, int(0.95 * rows * MOST_BYTES / len(page)))
        page = _page(config, view, shown, rows)
    write_bytes(config.out, page)
    return config.out


def _page(config: ViewConfig, view: View, shown: list[int], rows: int) -> bytes:
    """Render the page with `rows` rows of each shown episode."""
    data = view.dataset
    longest = data.longest_episode
    content = {
        "size": -(-data.frame_size // -(-data.frame_size // _LARGEST)),
        "columns": COLUMNS,
        "stack": FRAME_STACK,
        "every": -(-longest // _POINTS),
        "action": [float(data.action.min()), float(data.action.max())],
        "reward": [float(data.reward.min()), float(data.reward.max())],
    }
    episodes = [_episode(view, number, rows, content) for number in shown]
    settings = flat(config.corruption)
    name = settings.pop("corruption")
    return render(
        "browse.html",
        data=data,
        name=" ".join(filter(None, (data.task, data.quality))) or config.data.name,
        corruption=", ".join([name, *(f"{key} {value}" for key, value in settings.items()), f"seed {config.seed}"]),
        rows=min(rows, longest),
        longest=longest,
        quality=_QUALITY,
        corrupted=name != "none",
        content=content | {"episodes": episodes},
    ).encode(errors="backslashreplace")


def _episode(view: View, number: int, rows: int, content: Row) -> Row:
    """An episode's data for the page's script."""
    data, place = view.dataset, view.dataset.rows_of(number)
    chosen = torch.from_numpy(np.unique(np.linspace(place.start, place.stop - 1, rows).astype(int)))
    stacks, keys = view.stacks(chosen), view.corruption.keys(data.keys(chosen))
    seen = view.corruption.corruption(stacks, keys)
    frames, index = data.stack_rows(chosen, FRAME_STACK).unique(return_inverse=True)
    # Changed pixels are overlaid losslessly on the clean image, which is lossy.
    before, after = (_pictures(x.reshape(-1, 3, *x.shape[-2:])) for x in (stacks, seen))
    changed = 255 * (before != after).any(-1, keepdims=True).astype(np.uint8)
    over = np.concatenate([np.where(changed, after, 0), changed], -1)
    return {
        "number": number,
        "return": round(float(data.returns[number]), 2),
        "rows": (chosen - place.start).tolist(),
        "length": place.stop - place.start,
        "keys": list(map(str, keys.tolist())),  # as strings: int64 exceeds JavaScript's numbers
        "frames": index.tolist(),
        "clean": _sheet(_pictures(data.frames[frames]), quality=_QUALITY),
        "over": _sheet(over, lossless=True) if changed.any() else "",
        "action": _bytes(data.action[place][:: content["every"]].T, *content["action"]),
        "reward": _bytes(data.reward[place][:: content["every"]], *content["reward"]),
    }


def _pictures(frames: torch.Tensor) -> np.ndarray:
    """(N, 3, S, S) frames as (N, S', S', 3), subsampled if large."""
    return frames.numpy().transpose(0, 2, 3, 1)[:, :: (step := -(-frames.shape[-1] // _LARGEST)), ::step]


def _sheet(pictures: np.ndarray, **options: Any) -> str:
    """(N, S, S, C) pictures as one base64 WebP with COLUMNS per row."""
    count, size, _, channels = pictures.shape
    across, down = min(count, COLUMNS), -(-count // COLUMNS)
    filled = np.concatenate([pictures, np.zeros((across * down - count, *pictures.shape[1:]), np.uint8)])
    sheet = filled.reshape(down, across, size, size, channels).swapaxes(1, 2)
    buffer = io.BytesIO()
    Image.fromarray(sheet.reshape(down * size, across * size, channels)).save(buffer, "WEBP", **options)
    return base64.b64encode(buffer.getvalue()).decode()


def _bytes(values: torch.Tensor, low: float, high: float) -> str:
    """Numbers quantised to one byte over their range, in base64."""
    scaled = (values - low) / (high - low or 1) * 255
    return base64.b64encode(scaled.round().byte().numpy().tobytes()).decode()
