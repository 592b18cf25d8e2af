"""A folder of small valid files, and helpers to run commands in it."""

import contextlib
import io
import shutil
from collections.abc import Sequence
from pathlib import Path

from tests.helpers_data import write_fake_set
from vd4rl_pomdp.cli import main, run_to_end

SET, ENCODER, RUN = "walker_walk/expert", "runs/pretrained/encoder", "runs/finetuned"
PRETRAIN = ["--preset", "smoke", "--steps", "2"]
FINETUNE = ["--preset", "smoke", "--updates", "2", "--eval-length", "2", "--workers", "1"]
VALID = {
    "demo": [],
    "data check": [SET],
    "data parity": [SET],
    "data view": [SET],
    "data collect": ["--task", "walker_walk", "--quality", "random", "--episodes", "1"],
    "data download": ["--task", "walker_walk", "--quality", "random"],
    "pretrain": ["--data", SET, "--corruption", "patch+zero_frames", *PRETRAIN],
    "pretrain --method homer": ["--data", SET, *PRETRAIN],
    "finetune": ["--encoder", ENCODER, "--data", SET, *FINETUNE],
    "finetune --algorithm iql": ["--encoder", ENCODER, "--data", SET, *FINETUNE],
    "evaluate": [RUN, "--episodes", "1", "--workers", "1"],
    "report": ["runs"],
    "report compare": ["runs", "runs"],
    "results add": ["runs"],
    "results verify": ["results"],
    "agents export": [RUN, "--episodes", "1", "--workers", "1"],
    "navigation collect": ["--maze", "no_curtain", "--preset", "smoke"],
    "navigation train": ["--data", SET, "--preset", "smoke"],
    "navigation policy": ["--decisions", "1"],
    "navigation report": ["runs"],
    "sweep run": ["quick", "--testing", "--dry-run"],
    "certify": [SET, "patch"],
    "theory": [],
}
"""Valid arguments of commands in the folder of `build_world`, without --out."""
WITHOUT_OUT = ("data check", "data parity", "results verify")
"""Those of `VALID` that have no --out."""


def build_world(folder: Path) -> None:
    """Write a dataset, runs of both stages, an interrupted run, results, and files that are no valid input."""
    write_fake_set(folder / SET, [20, 25, 30], physics_dim=18)
    with contextlib.chdir(folder):
        for words in (
            ["pretrain", "--data", SET, "--out", "runs/pretrained", *PRETRAIN],
            ["finetune", "--encoder", ENCODER, "--data", SET, "--out", RUN, *FINETUNE],
            ["results", "add", "runs", "--out", "results"],
        ):
            code, stderr = end_of(words)
            assert code == 0, stderr
        shutil.copytree("runs/pretrained", "cut/pretrained")
        Path("cut/pretrained/timing.json").unlink()
        shutil.rmtree("cut/pretrained/encoder")
        Path("file").write_text("not ours\n")
        for name in ("empty", "foreign"):
            Path(name).mkdir()
        Path("foreign/notes.txt").write_text("not ours\n")
        Path("loop").symlink_to("loop")


def end_of(words: list[str]) -> tuple[int, str]:
    """Exit code and stderr of a command line; other exceptions are raised."""
    stderr = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(stderr):
        try:
            main(words)
        except SystemExit as end:
            return int(end.code or 0), stderr.getvalue()
    return 0, stderr.getvalue()


def rejection(words: Sequence[str]) -> str:
    """Run a command line that must end with exit code 2, and return its error line."""
    end = run_to_end(words)
    assert end.code == 2, end
    return end.line


def snapshot(folder: Path) -> dict[Path, tuple[int, int]]:
    """Size and modification time of all paths below a folder; zero for folders, where locks come and go."""
    return {
        path: (0, 0) if path.is_dir() else ((stat := path.lstat()).st_size, stat.st_mtime_ns)
        for path in folder.rglob("*")
    }
