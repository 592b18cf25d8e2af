"""Fine-tuning runs with given scores and settings, for reports."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.evaluation import append_episodes
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.report.tables import label
from vd4rl_pomdp.runs.files import read_json, write_json


def write_run(
    folder: Path,
    method: str,
    seed: int,
    scores: dict[int, list[float]],
    film: bool = False,
    labels: dict[str, Any] | None = None,
) -> Path:
    """A fine-tuning run with the given scores of its episodes by step."""
    folder.mkdir(parents=True)
    record = {
        "stage": "finetune",
        "config": {"seed": seed},
        "versions": {},
        "git_commit": "abc",
        "command": "vd4rl-pomdp",
    }
    (folder / "config.json").write_text(json.dumps(record))
    (folder / "metrics.jsonl").write_text('{"step": 10, "bc_loss": 0.5}\n')
    names = {"method": method, "task": "walker_walk", "quality": "expert", "corruption": "patch"}
    names |= {"algorithm": "td3_bc", "seed": seed} | (labels or {})
    write_json(folder / "labels.json", names)
    for step, values in scores.items():
        rows = [
            names
            | {"step": step, "episode": i, "episode_seed": i}
            | {"return": value * 10, "length": 500, "score": value, "evaluated_under": names["corruption"]}
            for i, value in enumerate(values)
        ]
        append_episodes(folder / "episodes.csv", rows)
    (folder / "timing.json").write_text('{"seconds": 3.0}')
    if film:
        pictures = np.random.default_rng(0).integers(0, 256, (4, 12, 84, 84), dtype=np.uint8)
        np.savez(
            folder / "film.npz", **{"clean": pictures[:, :3], "corrupted": pictures[:, 3:], "return": np.arange(4.0)}
        )
    return folder


def describe(run: Path, card: dict[str, Any] | None = None, data: str = "", **config: Any) -> Path:
    """Give a run of `write_run` settings: its own config, its encoder's card, and the fingerprint of its data."""
    record = read_json(run / "config.json")
    record["config"] |= {"updates": 10, "preset": "cpu", "batch_size": 256, "views": 4} | config
    write_json(run / "config.json", record | ({"inputs": {"data": data}} if data else {}))
    if card is not None:
        settings = {"max_k": 15, "batch_size": 8, "patch_size": 16, "preset": "cpu", "steps": 20, "task": "walker_walk"}
        settings |= {k: v for k, v in card.items() if k not in ("data",)}
        corruption = {"corruption": "patch", "patch_size": settings["patch_size"]}
        facts = {"corruption": corruption, "steps": settings["steps"], "preset": settings["preset"]}
        (run / "encoder").mkdir()
        write_json(
            run / "encoder" / "config.json", {"pretrain": facts | {"settings": settings, "data": card.get("data", "")}}
        )
    return run


def pooled(folder: Path) -> dict[str, int]:
    """Seeds by the label under which a folder's runs are pooled."""
    return dict(Counter(label(row) for run in load_runs([folder]) for row in run.rows))


def grid(tmp_path: Path) -> Path:
    """Three seeds of acro and two of mik+a on expert data, one of acro on medium data."""
    for method, seeds in (("acro", (0, 1, 2)), ("mik+a", (0, 1))):
        for seed in seeds:
            describe(write_run(tmp_path / f"runs/{method}{seed}", method, seed, {5: [1.0], 10: [20.0 + seed]}), {})
    describe(write_run(tmp_path / "runs/medium", "acro", 0, {10: [9.0]}, labels={"quality": "medium"}), {})
    return tmp_path / "runs"
