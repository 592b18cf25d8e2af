"""The valid files that bad ones are made from: sets, runs of every kind, reports, and files of no command."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from bad_input_flags import ENCODER, MAZE, NAVIGATED, RUN, SET, SMOKE, STUDY

ROWS, EPISODES = 20, 4
"""Rows of an episode of the small set, and its episodes."""
CUT: dict[str, tuple[str, list[str]]] = {
    "pretrain": ("runs-cut/pretraining", ["--data", SET, *SMOKE]),
    "finetune": ("runs-cut/finetuning", ["--encoder", ENCODER, "--data", SET, *SMOKE, "--workers", "1"]),
    "navigation train": ("runs-cut/navigating", ["--data", MAZE, *SMOKE]),
}
"""For each stage a run that was cut, and the words that go on with it, but for --out."""


def build_world(folder: Path) -> None:
    """Make the valid files that all cases start from: two sets, runs of every kind, and some that are foreign."""
    from vd4rl_pomdp.cli.dispatch import run_stage
    from vd4rl_pomdp.data.collect import CollectConfig, collect

    folder.mkdir()
    before = Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            config = CollectConfig("walker_walk", "random", Path(SET), EPISODES, workers=1, episodes_per_shard=2)
            collect(config, length=ROWS)
            with _keeping_all():
                for words in _stages():
                    run_stage(words)
        shutil.copytree(Path(__file__).parents[1] / "results" / "datasets", "reports/sets")
        _unfinished()
        _policy_run(Path("runs/policy"))
        _swept(Path("swept"))
        _foreign()
    finally:
        os.chdir(before)


def _stages() -> Iterator[list[str]]:
    yield ["navigation", "collect", "--maze", "no_curtain", "--out", MAZE, *SMOKE, "--workers", "1"]
    yield ["pretrain", "--data", SET, "--out", "runs/pretrained", *SMOKE]
    yield ["finetune", "--encoder", ENCODER, "--data", SET, "--out", RUN, *SMOKE, "--workers", "1"]
    yield ["navigation", "train", "--data", MAZE, "--out", NAVIGATED, *SMOKE]
    yield ["navigation", "report", NAVIGATED, "--out", "reports/navigation", "--no-pictures"]
    yield ["theory", "--out", "reports/theory"]
    yield ["results", "add", "runs", "--out", "reports/results"]
    yield ["control-study", "--out", "reports/control", *STUDY]


@contextmanager
def _keeping_all() -> Iterator[None]:
    """Within, a run that ends keeps what it needs only to go on: two checkpoints and its features."""
    from finetune.features import FeatureFile
    from vd4rl_pomdp.runs.checkpoint import KEPT, Checkpoints

    prune = Checkpoints.prune
    with (
        mock.patch.object(Checkpoints, "prune", lambda self, _: prune(self, KEPT)),
        mock.patch.object(FeatureFile, "remove"),
    ):
        yield


def _unfinished() -> None:
    """Runs that were cut after their last checkpoint; the finished ones lose what they have no use for."""
    for finished, (cut, _) in zip(("pretrained", "finetuned", "navigated"), CUT.values(), strict=True):
        folder = Path("runs") / finished
        shutil.copytree(folder, cut)
        Path(cut, "timing.json").unlink()
        shutil.rmtree(folder / "checkpoints")
    for name in ("features.npy", "features.json"):
        Path(RUN, name).unlink()
    shutil.rmtree("runs-cut/pretraining/encoder")
    Path("runs-cut/navigating/results.json").unlink()


def _policy_run(folder: Path) -> None:
    """What a policy run keeps, with shipped actors for its snapshots."""
    from vd4rl_pomdp.policies.actor import load_actor
    from vd4rl_pomdp.policies.export import snapshot_path

    for step, quality in ((5000, "medium"), (10000, "expert")):
        load_actor("walker_walk", quality).save(snapshot_path(folder, step))
    shutil.copy(next((folder / "snapshots").iterdir()), "actor.safetensors")
    (folder / "config.json").write_text(json.dumps({"task": "walker_walk", "seed": 0}))
    (folder / "curve.csv").write_text("decisions,return_mean\n5000,400.0\n10000,900.0\n")


def _swept(folder: Path) -> None:
    """A sweep that is finished, and the grid of another."""
    from vd4rl_pomdp.sweeps.folder import SweepFolder
    from vd4rl_pomdp.sweeps.plan import Job

    shutil.copytree("runs/pretrained", folder / "acro")
    sweep = SweepFolder(folder)
    sweep.keep_plan("mine", [Job("acro", "pretrain", folder / "acro", ("pretrain",))])
    row = {"job": "acro", "cause": "killed", "line": "", "ended": 1.0, "seconds": 2.0, "slots": 1, "step": 0}
    sweep.add(row | {"host": "here"})
    shutil.copy(Path(__file__).parents[1] / "vd4rl_pomdp" / "sweeps" / "grids" / "quick.toml", "grid.toml")


def _foreign() -> None:
    """Things that are no input of any command."""
    Path("file").write_text("not ours\n")
    for folder in ("empty", "foreign"):
        Path(folder).mkdir()
    Path("foreign/notes.txt").write_text("not ours\n")
    os.mkfifo("pipe")
    Path("dangling").symlink_to("nothing-there")
    Path("loop").symlink_to("loop")
