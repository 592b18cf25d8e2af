"""The fused single pass of a GPU against the line-by-line implementation of a CPU."""

import shutil
import warnings
from functools import partial

import pytest
import torch

from tests.helpers_data import write_fake_set
from tests.recording import record
from vd4rl_pomdp.core import hardware
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.corruptions import CORRUPTIONS, CorruptionConfig, corruption, fused
from vd4rl_pomdp.data import Dataset, TransitionSampler, View, WindowSampler, open_dataset
from vd4rl_pomdp.runs.replay import Replay

OPTIONS = [
    {"zeroed_frames": 1, "patch_size": 5, "patch_fill": 7},
    {"zeroed_frames": 2, "patch_size": 5, "patch_fill": 255, "patch_count": 3},
    {"zeroed_frames": 3, "patch_size": 1, "patch_count": 2, "patch_shared": True},
    {"zeroed_frames": 2, "patch_size": 17, "patch_fill": 9},
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    """Episodes of random 23 x 17 pixels: not square, no power of two."""
    folder = tmp_path_factory.mktemp("fused")
    dataset = open_dataset(write_fake_set(folder / "set", [9, 5, 12]), folder / "cache")
    g = torch.Generator().manual_seed(0)
    dataset.frames = torch.randint(1, 256, (dataset.num_rows, 3, 23, 17), dtype=torch.uint8, generator=g)
    return dataset


def seen(dataset: Dataset, config: CorruptionConfig, **settings) -> list[torch.Tensor]:
    """Two batches of windows and one of rows."""
    view, device = View(dataset, config, seed=3, **settings), dataset.t.device
    rows = torch.arange(24, device=device).view(4, 6)
    return [view.observe(part).cpu().clone() for part in (rows, rows.flip(0), rows[1])]


SETTINGS = [{"shift": pad, "shared": shared} for pad in (0, 4, 16) for shared in ("window", "observation")]
DROPS = [
    ("zero_frames", {"zeroed_frames": 1, "keep_newest": True}),
    ("patch+zero_frames", {"zeroed_frames": 2, "keep_newest": True, "patch_size": 5, "patch_fill": 7}),
    ("truncate", {}),
    ("patch+truncate", {"kept": "oldest", "patch_size": 5, "patch_fill": 255}),
]
CASES = [*((name, options) for name in CORRUPTIONS for options in OPTIONS), *DROPS]


@pytest.mark.parametrize(
    ("name", "options", "settings"),
    [
        *((name, options, SETTINGS) for name, options in CASES),
        ("patch+zero_frames", {"corruption_mode": "emission", "patch_size": 5}, SETTINGS),
        *(
            ("patch+zero_frames", {"zeroed_frames": 1, "patch_size": 4}, [{"shift": 3, "frame_stack": stack}])
            for stack in (1, 2, 5)
        ),
    ],
)
def test_fused_observations_equal_staged_ones(dataset, monkeypatch, name, options, settings):
    config = CorruptionConfig.fill({"corruption": name} | options)
    expected = [seen(dataset, config, **one) for one in settings]
    monkeypatch.setattr(hardware, "in_host_memory", lambda x: False)
    for one, batches in zip(settings, expected, strict=True):
        assert all(map(torch.equal, seen(dataset, config, **one), batches)), one


def test_ranks_break_ties_as_sorting_does(monkeypatch):
    """Ties are rare, since draws have 31 bits."""
    draws = torch.cartesian_prod(*[torch.arange(3)] * 3)
    for module in (fused, corruption):
        monkeypatch.setattr(module, "drop_order", lambda drop, key, stages, stack: draws)
    key = torch.arange(len(draws))
    for zeroed in (1, 2, 3):
        drop = corruption.ZeroFrames(zeroed)
        kept = corruption.Corruption([], drop).kept(key, 3)
        by_rank = fused.drawn((), drop, zeroed, 0, key, key, 3, (1, 1)).kept
        assert torch.equal(torch.zeros_like(by_rank).scatter_(1, kept, True), by_rank)


def test_fused_observations_compile_to_equal_bits(dataset, monkeypatch):
    """A GPU compiles the pass; here it is traced, and its pixel operators are compiled if a compiler exists."""
    monkeypatch.setattr(hardware, "in_host_memory", lambda x: False)
    config = CorruptionConfig.of("patch+zero_frames", patch_size=5, patch_count=2, patch_fill=7, keep_newest=True)
    rows = torch.arange(24).view(4, 6)
    expected = View(dataset, config, 4).observe(rows)
    backend = "inductor" if shutil.which("g++") else "aot_eager"
    traced = {"drawn": "aot_eager", "painted": backend}
    for name, how in traced.items():
        written = getattr(corruption, name).__wrapped__
        monkeypatch.setattr(corruption, name, torch.compile(written, backend=how, fullgraph=True))
    torch.compiler.reset()
    assert torch.equal(View(dataset, config, 4).observe(rows), expected)


def test_compile_failure_warns_once(monkeypatch, capsys):
    def refuse(function):
        raise RuntimeError("no compiler\nand more")

    monkeypatch.setattr(torch, "compile", refuse)
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    double = hardware.compiled_on_gpu(lambda x: 2 * x)
    assert [int(double(torch.tensor(3))) for _ in range(2)] == [6, 6]
    assert capsys.readouterr().err.count("is not compiled, which is slower: no compiler") == 1


def test_compiler_advises_no_other_precision(monkeypatch, recwarn):
    def compiled(function):
        def call(x):
            warnings.warn("TensorFloat32 tensor cores for float32 matrix multiplication available", stacklevel=1)
            return function(x)

        return call

    monkeypatch.setattr(torch, "compile", compiled)
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    assert int(hardware.compiled_on_gpu(lambda x: 2 * x)(torch.tensor(3))) == 6
    assert not [one for one in recwarn if "TensorFloat32" in str(one.message)]


GPU_CASES = [("none", {}), ("patch", OPTIONS[2]), ("patch+zero_frames", OPTIONS[1]), DROPS[1], DROPS[3]]
"""Few, since compiling takes long."""


@pytest.mark.gpu
@pytest.mark.usefixtures("compiled_anew")
@pytest.mark.parametrize(("name", "options"), GPU_CASES)
def test_gpu_observations_equal_cpu_observations(dataset, capsys, name, options):
    config = CorruptionConfig.fill({"corruption": name} | options)
    for settings in SETTINGS:
        here = seen(dataset, config, **settings)
        try:
            there = seen(dataset.to("cuda"), config, **settings)
        finally:
            dataset.to("cpu")
        assert all(map(torch.equal, here, there)), settings
    assert "not compiled" not in capsys.readouterr().err


def samplers(dataset: Dataset, config: CorruptionConfig) -> list[WindowSampler | TransitionSampler]:
    def draws():
        return RandomStream(torch.Generator().manual_seed(5), dataset.t.device)

    view = partial(View, dataset, config, 4, 3)
    return [WindowSampler(view("w"), 6, 4, draws()), TransitionSampler(view("t"), 6, draws(), n_step=3)]


@pytest.mark.gpu
@pytest.mark.usefixtures("compiled_anew")
@pytest.mark.parametrize("mode", ["resample", "emission"])
def test_gpu_batches_equal_cpu_batches_without_synchronising(dataset, capsys, mode):
    """Keys advance within the graph: each replay samples the next batch."""
    config, steps = CorruptionConfig.of("patch+zero_frames", mode, patch_size=5), 12
    expected = [[s.sample().to("cpu").replace() for _ in range(steps)] for s in samplers(dataset, config)]
    try:
        dataset.to("cuda")
        for sampler, batches in zip(samplers(dataset, config), expected, strict=True):
            held = []

            def step(turn, sampler=sampler, held=held):
                batch = sampler.sample()
                if not held:
                    held.append({name: torch.empty_like(batch[name]) for name in batch})
                for name, place in held[0].items():
                    place.copy_(batch[name])
                return {"loss": batch.obs.float().mean()}

            replay = Replay(step, torch.device("cuda"), [sampler.draws])
            found = []
            for number in range(steps):
                # compilation in the first step and occasional blocks of draws may synchronise
                torch.cuda.set_sync_debug_mode("error" if 0 < number < 3 else "default")
                replay(0)
                torch.cuda.set_sync_debug_mode("default")
                found.append({name: value.cpu() for name, value in held[0].items()})
            assert replay.replays
            assert "not compiled" not in capsys.readouterr().err
            for batch, other in zip(batches, found, strict=True):
                for name in batch:
                    torch.testing.assert_close(other[name], batch[name], rtol=1e-6, atol=1e-6)
    finally:
        torch.cuda.set_sync_debug_mode("default")
        dataset.to("cpu")


@pytest.mark.parametrize("mode", ["resample", "emission"])
def test_replayed_sampler_equals_eager_sampler(dataset, monkeypatch, mode):
    """A recorder stands in for the graph, and rejects operations that would synchronise."""
    config, steps = CorruptionConfig.of("patch+zero_frames", mode, patch_size=5), 8
    expected = [[s.sample() for _ in range(steps)] for s in samplers(dataset, config)]
    expected = [[{name: batch[name].clone() for name in batch} for batch in batches] for batches in expected]
    monkeypatch.setattr(hardware, "in_host_memory", lambda x: False)
    for sampler, batches in zip(samplers(dataset, config), expected, strict=True):
        held = {name: torch.empty_like(value) for name, value in batches[0].items()}

        def step(turn, sampler=sampler, held=held):
            batch = sampler.sample()
            for name, place in held.items():
                place.copy_(batch[name])
            return {"loss": batch.obs.float().mean()}

        replay = Replay(step, torch.device("cpu"), [sampler.draws], capture=record)
        for batch in batches:
            replay(0)
            for name, value in batch.items():
                assert torch.equal(held[name], value), name
        assert replay.replays
