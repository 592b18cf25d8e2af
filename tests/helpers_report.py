"""Fine-tuning runs with given scores and settings, for reports."""

import csv
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report import page
from vd4rl_pomdp.report.load import label, load_runs
from vd4rl_pomdp.runs.episodes import COLUMNS
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import Result


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
    record = {"stage": "finetune", "config": {"seed": seed}, "versions": {}, "git_commit": "abc"}
    record["command"] = "vd4rl-pomdp"
    (folder / "config.json").write_text(json.dumps(record))
    (folder / "metrics.jsonl").write_text('{"step": 10, "bc_loss": 0.5}\n')
    names = {"method": method, "task": "walker_walk", "quality": "expert", "corruption": "patch"}
    names |= {"algorithm": "td3_bc", "seed": seed} | (labels or {})
    (folder / "labels.json").write_text(json.dumps(names))
    with (folder / "episodes.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for step, values in scores.items():
            row = names | {"step": step, "length": 500, "evaluated_under": names["corruption"], "action_error": ""}
            for i, value in enumerate(values):
                writer.writerow(row | {"episode": i, "episode_seed": 20_000 + i, "return": value * 10, "score": value})
    (folder / "timing.json").write_text('{"seconds": 3.0}')
    if film:
        pictures = np.random.default_rng(0).integers(0, 256, (4, 12, 84, 84), dtype=np.uint8)
        arrays = {"clean": pictures[:, :3], "corrupted": pictures[:, 3:], "return": np.arange(4.0)}
        np.savez(folder / "film.npz", **arrays)
    return folder


def describe(
    run: Path, card: dict[str, Any] | None = None, data: str = "", encoder_seed: int | None = None, **config: Any
) -> Path:
    """Give a run of `write_run` settings: its own config, its encoder's card, and the fingerprint of its data."""
    record = read_json(run / "config.json")
    record["config"] |= {"updates": 10, "preset": "cpu", "batch_size": 256, "views": 4} | config
    (run / "config.json").write_text(json.dumps(record | ({"inputs": {"data": data}} if data else {})))
    if card is not None:
        settings = {"max_k": 15, "batch_size": 8, "patch_size": 16, "preset": "cpu", "steps": 20, "task": "walker_walk"}
        settings |= {k: v for k, v in card.items() if k not in ("data",)}
        corruption = {"corruption": "patch", "patch_size": settings["patch_size"]}
        facts = {"corruption": corruption, "steps": settings["steps"], "preset": settings["preset"]}
        facts |= {} if encoder_seed is None else {"seed": encoder_seed}
        (run / "encoder").mkdir()
        pretraining = facts | {"settings": settings, "data": card.get("data", "")}
        (run / "encoder" / "config.json").write_text(json.dumps({"pretrain": pretraining}))
    return run


def collected(run: Path, content: str, seed: int, **collection: Any) -> Path:
    """Give a run a dataset with the fingerprint `content`, collected with a seed."""
    record = read_json(run / "config.json")
    collection = {"task": "walker_walk", "episodes": 100, "seed": seed} | collection
    write_json(run / "config.json", record | {"inputs": {"data": content}, "collection": collection})
    return run


def on_own_sets(folder: Path, first: int) -> None:
    """Give every run of a folder a dataset collected with `first` + its seed."""
    for run in folder.iterdir():
        seed = first + read_json(run / "config.json")["config"]["seed"]
        collected(run, f"{seed}" * 8, seed)


def write_seeds(
    folder: Path,
    scores: dict[tuple[str, str], tuple[float, ...]],
    data_return: float | None,
    algorithm: str = "td3_bc",
    moved: float | None = 0.01,
    of_set: dict[str, str] | None = None,
    **settings: Any,
) -> Path:
    """Runs that end with the given scores, by method and corruption a seed each, beside data of a mean return.

    `moved` is the share of its value by which each critic moved at the end (None: not recorded), `of_set` task and
    quality, if it is not the expert walker's, `settings` are those of encoders.
    """
    for (method, corruption), seeds in scores.items():
        for seed, score in enumerate(seeds):
            place = folder / "-".join(map(str, (method, corruption, seed, algorithm, *settings.values())))
            labels = {"corruption": corruption, "algorithm": algorithm} | (of_set or {})
            run = write_run(place, method, seed, {5: [99.0], 10: [score]}, labels=labels)
            Reference(data_return).write(describe(run, {"history": "method"} | settings, seed=seed))
            if moved is not None:
                write_json(run / "critic.json", {"value": 150.0, "moved": moved, "data": 160.0})
    return folder


def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip figures, which take most of a report's time."""
    sections = ("scores", "lead", "profiles", "curves", "probes", "errors", "losses")
    monkeypatch.setattr(page, "draw_plots", lambda runs, made: {name: [] for name in sections})


def pretraining(place: Path) -> Path:
    """A finished pretraining run."""
    place.mkdir(parents=True)
    record = {"stage": "pretrain", "config": {"method": "acro", "seed": 0, "steps": 2}, "inputs": {"data": "f00"}}
    write_json(place / "config.json", record)
    lines = [{"step": 1, "action_loss": 0.5, "norm": 3.0}, {"step": 2, "action_loss": 0.25}]
    (place / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    write_json(place / "timing.json", {"seconds": 3.0, "steps": 2})
    return place


def pooled(folder: Path) -> dict[str, int]:
    """Number of seeds by the label under which a folder's runs are pooled."""
    runs = load_runs([folder])
    return dict(Counter(label(run.named) for run in runs for _ in run.rows))


def grid(tmp_path: Path) -> Path:
    """Three seeds of acro and two of mik+a on expert data, one of acro on medium data."""
    for method, seeds in (("acro", (0, 1, 2)), ("mik+a", (0, 1))):
        for seed in seeds:
            describe(write_run(tmp_path / f"runs/{method}{seed}", method, seed, {5: [1.0], 10: [20.0 + seed]}), {})
    describe(write_run(tmp_path / "runs/medium", "acro", 0, {10: [9.0]}, labels={"quality": "medium"}), {})
    return tmp_path / "runs"


def finished_result(path: Path, labels: dict[str, Any]) -> Result:
    """A finished fine-tuning run with one evaluation episode, as read from a results folder."""
    record = {"stage": "finetune", "config": {"seed": labels["seed"]}, "versions": {}, "git_commit": "abc"}
    row = labels | {"step": 10, "episode": 0, "episode_seed": 0, "return": 500.0, "length": 500, "score": 50.0}
    row |= {"evaluated_under": labels["corruption"], "action_error": None}
    files = {"config": record, "labels": labels, "timing": {"seconds": 3.0}, "machine": {"processor": "two cores"}}
    return Result(f"{labels}", path, files, 10, [], [row])
