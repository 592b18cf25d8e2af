"""What a cell's savings are worth: its fine-tuning again and again, as it is and each time without one of them.

    python tools/cell_cost.py --encoders RUN/pretrain/encoder ... --data DATA --out cell_cost.csv

The settings are those of the grid `offline` for a walker. One after another in one process, which evaluates by itself,
so that seconds can be compared. Columns: what names the run, what was changed, wall-clock and processor seconds of the
whole fine-tuning, the mean return of its last evaluation, and the machine.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from script import run_script

from finetune import evaluation
from finetune.config import FinetuneConfig
from finetune.train import finetune
from vd4rl_pomdp.core.settings import LABELS
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.runs.files import Row, write_csv
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.results import read_run
from vd4rl_pomdp.sweeps.grid import load_grid

_FIRST = next(cell for cell in load_grid("offline").cells() if cell.value("task") == "walker_walk")
CELL = _FIRST.sections["finetune"] | {"workers": 1}
"""The grid's settings, beside the preset `cpu`."""
Change = Literal["none", "float32 updates", "all frames drawn", "a second evaluation"]
CHANGES: Mapping[Change, Mapping[str, Any]] = {
    "none": {},
    "float32 updates": {"update_precision": "fp32"},
    "all frames drawn": {},
    "a second evaluation": {"eval_every": 10_000},
}
"""What differs from the cell; to draw all frames is no setting, and the second evaluation is one in the middle."""
COLUMNS = (*LABELS, "change", "seconds", "processor_seconds", "return", "machine")


@dataclass(frozen=True)
class Config:
    """Settings of the measurement."""

    encoders: tuple[Path, ...]
    """Encoders of finished pretrainings; a fine-tuning has its encoder's seed."""
    data: Path
    """The set."""
    changes: tuple[Change, ...] = tuple(CHANGES)
    """What to change in turn."""
    out: Path = Path("cell_cost.csv")
    """CSV file to write, anew after every fine-tuning."""


@contextmanager
def drawing(everything: bool) -> Iterator[None]:
    """Evaluate with the frames drawn that the corruption hides, too."""
    chosen = evaluation._draws
    try:
        if everything:
            evaluation._draws = lambda agent, job: "all"
        yield
    finally:
        evaluation._draws = chosen


def measured(encoder: Path, data: Path, change: Change, out: Path) -> Row:
    """Fine-tune into a folder, and tell what it took and returned."""
    seed = load_encoder(encoder)[1].seed
    config = FinetuneConfig.of("cpu", encoder=encoder, data=data, out=out, seed=seed, **CELL | CHANGES[change])
    wall, processor = time.perf_counter(), time.process_time()
    with drawing(everything=change == "all frames drawn"):
        finetune(config)
    took = {"seconds": time.perf_counter() - wall, "processor_seconds": time.process_time() - processor}
    run = read_run(out)
    last = np.mean([row["return"] for row in run.rows if row["step"] == config.updates])
    found = {name: run.labels[name] for name in LABELS} | {"change": change, "machine": run.machine}
    return found | {name: round(float(value), 2) for name, value in (took | {"return": last}).items()}


def main(config: Config) -> None:
    """Measure and write."""
    refuse_inside(config.out)
    rows: list[Row] = []
    for encoder, change in product(config.encoders, config.changes):
        with tempfile.TemporaryDirectory() as place:
            rows.append(measured(encoder, config.data, change, Path(place) / "run"))
        write_csv(config.out, COLUMNS, rows)


if __name__ == "__main__":
    run_script(main, Config)
