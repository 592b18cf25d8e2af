"""What `test_triton` runs: every stage in one process, as the demo does, and environments before an optimiser."""

import sys
from pathlib import Path

import gymnasium

import vd4rl_pomdp.envs  # noqa: F401 (registers the ids)
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.runs.workers import run_jobs

NAMES = ["vd4rl_pomdp/WalkerWalk-v0", "vd4rl_pomdp/MazeOneCurtain-v0"]
"""One for each of two workers: only the first in a process tells anything."""


def render_then_optimise(name: str) -> bool:
    gymnasium.make(name).reset(seed=0)
    import torch

    torch.optim.Adam([torch.zeros(1, requires_grad=True)])
    return "triton" in sys.modules


def environments() -> None:
    assert all(run_jobs(render_then_optimise, NAMES, workers=2)), "in spawned workers"
    assert render_then_optimise(NAMES[0])


def stages() -> None:
    from vd4rl_pomdp.data.collect import CollectConfig, collect

    data = Path("data/walker_walk/random")
    collect(CollectConfig("walker_walk", "random", data, episodes=2, workers=1), length=40)
    from pretrain.config import PretrainConfig
    from pretrain.train import pretrain

    encoder = pretrain(PretrainConfig.of("smoke", data=data, out=Path("pretrain"))).path / "encoder"
    from finetune.config import FinetuneConfig
    from finetune.evaluation import EpisodeJob, evaluate
    from finetune.train import finetune
    from vd4rl_pomdp.corruptions import CorruptionConfig

    shape = {"eval_episodes": 2, "eval_length": 4, "workers": 1}
    finetune(FinetuneConfig.of("smoke", encoder=encoder, data=data, out=Path("finetune"), **shape))
    job = EpisodeJob(
        encoder, Path("finetune/policy"), TASKS["walker_walk"], CorruptionConfig(), 0, film=False, length=4
    )
    assert len(evaluate([job], workers=1)[0].rewards) == 4


if __name__ == "__main__":
    {"stages": stages, "environments": environments}[sys.argv[1]]()
    print("as expected")
