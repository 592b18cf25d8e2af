"""The documentation's examples of user-defined plug-ins are executed; `test_documented_task.py` covers tasks."""

import csv
import json
from dataclasses import dataclass

import pytest

from finetune.algorithms import BC
from finetune.config import FinetuneConfig
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS, Method
from pretrain.train import pretrain
from tests.helpers_bad_input import rejection
from tests.helpers_data import write_fake_set
from tests.helpers_pages import isolated_registries, load_example
from vd4rl_pomdp import testing
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.core.registry import REGISTRIES
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.nn.frame import FrameEncoderPart, FrameOptions
from vd4rl_pomdp.report.page import write_report

BY_CALL = "registered by a call"
EXAMPLES = {
    "method": ("past_to_frame", "future_dim", 16),
    "corruption": ("bars", "bar_height", 24),
    "algorithm": ("filtered_bc", "cloned_share", 0.25),
    "frame_encoder": ("tiny", "tiny_channels", 12),
    "history": ("linear", "slowest", 0.9),
}
"""Kind: name of the documented plug-in, one of its options, and a value other than the default."""
KINDS = {kind: kind.replace("history", "memory") for kind in EXAMPLES}
"""Kind: the word in the names of pages, files and checks."""
USED_IN = {
    "method": ["pretrain"],
    "corruption": ["pretrain", "finetune"],
    "algorithm": ["finetune"],
    "frame_encoder": ["pretrain", "finetune"],
    "history": ["pretrain", "finetune"],
}
"""Kind: the stages that run its code; the plug-in is chosen in the first."""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Imports a page's file as a module; its registrations are removed afterwards."""
    with isolated_registries():
        yield lambda kind: load_example(f"my_{KINDS[kind]}.py", tmp_path, monkeypatch)


@pytest.mark.parametrize("kind", EXAMPLES)
def test_documented_plugins_run_in_all_stages_and_are_recorded(load, tmp_path, kind):
    load(kind)
    name, option, value = EXAMPLES[kind]
    runs, data = tmp_path / "runs", write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25, 30])
    flags = f"--{kind} {name} --{option} {value} ".replace("_", "-").replace(name.replace("_", "-"), name)
    first, second = ("", flags) if kind == "algorithm" else (flags, "")
    common = f"--preset smoke --data {data}"
    main(f"pretrain {first} {common} --out {runs}/pretrain".split())
    finetune = f"finetune {second} --encoder {runs}/pretrain/encoder {common} --out {runs}/finetune --eval-episodes 2"
    main(f"{finetune} --workers 1".split())  # test_documented_task.py covers plug-ins in worker processes
    write_report([runs], tmp_path / "report")
    records = {stage: json.loads((runs / stage / "config.json").read_text()) for stage in ("pretrain", "finetune")}
    for stage in USED_IN[kind]:
        assert records[stage]["plugins"] == {f"{kind} {name}": BY_CALL}
        assert records[stage]["sources"][f"{kind} {name}"].startswith(f"my_{KINDS[kind]}.py ")
    config = records[USED_IN[kind][0]]["config"]
    assert (config[kind], config[option]) == (name, value)
    (row,) = csv.DictReader((tmp_path / "report" / "summary.csv").open())
    assert row.get(kind, name) == name
    rows = list(csv.DictReader((runs / "finetune" / "episodes.csv").open()))
    as_trained = [row for row in rows if row["evaluated_under"] == row["corruption"]]
    assert len(as_trained) == 2 * 2, "two evaluations of two episodes"
    assert len(rows) - len(as_trained) == (0 if as_trained[0]["corruption"] == "none" else 2), "clean evaluation"


@pytest.mark.parametrize("kind", EXAMPLES)
def test_help_and_list_show_documented_plugins(load, capsys, monkeypatch, kind):
    name, option, _ = EXAMPLES[kind]
    load(kind)
    monkeypatch.setenv("COLUMNS", "200")
    stage, flag = "finetune" if kind == "algorithm" else "pretrain", f"--{option.replace('_', '-')}"
    for words, expected in (([f"--{kind.replace('_', '-')}", name], True), ([], False)):
        with pytest.raises(SystemExit) as end:
            main([stage, *words, "--help"])
        assert not end.value.code
        assert (flag in capsys.readouterr().out) == expected
    main(["list"])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.split()[:1] == [name])
    assert line.endswith(f"[{BY_CALL}]")


@pytest.mark.parametrize("kind", EXAMPLES)
def test_documented_plugins_conform(load, kind):
    name, option, value = EXAMPLES[kind]
    load(kind)
    check = getattr(testing, f"check_{KINDS[kind]}")
    check(name)
    check(name, **{option: value})


def test_wrong_visible_set_of_documented_method_is_caught(load):
    load("method").PastToFrame.visible = lambda self, t, k, rows: ({t, t + k}, set())
    with pytest.raises(
        AssertionError, match=r"method 'past_to_frame' violates its contract(.|\n)*is declared to see rows"
    ):
        testing.check_method("past_to_frame")


def option_called(name: str, base: type[Options] = Options) -> type[Options]:
    """An options class with one more option, which is also a corruption stage."""
    fields = {"__annotations__": {name: int}, name: 3, "__call__": lambda self, frames, key, number: None}
    return dataclass(frozen=True)(type("Mine", (base,), fields))


def part_with(kind: str, options: object) -> object:
    """A plug-in of a kind with the given options class."""
    if kind == "method":
        return Method(METHODS["curl"].build, options=options)
    if kind == "frame_encoder":
        return FrameEncoderPart(lambda channels, size, options: None, options)
    return type("Mine", (BC,), {"options": options}) if kind == "algorithm" else options


@pytest.fixture
def registries():
    with isolated_registries():
        yield REGISTRIES


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        *(
            (kind, str, "'mine': its options are .*: name a dataclass")
            for kind in EXAMPLES
            if kind not in ("corruption", "history")
        ),
        ("method", int, r"derived from vd4rl_pomdp\.options\.Options"),
        ("frame_encoder", Options, "name a dataclass that is derived from .*frame.FrameOptions"),
    ],
)
def test_invalid_options_classes_are_rejected(registries, kind, options, message):
    with pytest.raises(UserError, match=message):
        registries[kind].register("mine", part_with(kind, options))


@pytest.mark.parametrize(
    ("kind", "option"),
    [("method", "seed"), ("frame_encoder", "encoder"), ("corruption", "keep_newest"), ("algorithm", "quality")],
)
def test_an_option_that_records_would_leave_out_is_refused(registries, kind, option):
    options = option_called(option, FrameOptions if kind == "frame_encoder" else Options)
    with pytest.raises(UserError, match=f"the name of its option '{option}' is taken: choose another"):
        registries[kind].register("mine", part_with(kind, options))


def test_options_without_a_default_or_with_wrong_limits_are_refused(registries):
    @dataclass(frozen=True)
    class Unset(Options):
        depth: int

    for limits, message in (({"dept": 1}, "its limits name 'dept'"), ({"depth": 5}, "--depth is 3; it must be at")):
        options = type("Mine", (option_called("depth"),), {"limits": limits})
        with pytest.raises(UserError, match=message):
            registries["method"].register("mine", part_with("method", options))
    required = type("Mine", (option_called("depth"),), {"check": lambda self: 1 / 0})
    registries["method"].register("required", part_with("method", required))  # its own check is for its users
    with pytest.raises(UserError, match="its option 'depth' has no default"):
        registries["method"].register("mine", part_with("method", Unset))


@pytest.mark.parametrize(
    ("kind", "option", "owner"),
    [
        ("method", "steps", "PretrainConfig"),
        ("method", "patch_size", "Patch"),
        ("corruption", "corruption_mode", "CorruptionConfig"),
        ("frame_encoder", "hidden_dim", "GRUOptions"),
        ("algorithm", "readout", "HistoryOptions"),
    ],
)
def test_conflicting_option_names_are_rejected(registries, kind, option, owner):
    options = option_called(option, FrameOptions if kind == "frame_encoder" else Options)
    registries[kind].register("mine", part_with(kind, options))
    message = (
        rf"({owner} and Mine|Mine and {owner}) both have the setting '{option}', so --.* would be ambiguous: rename"
    )
    stage, config = ("finetune", FinetuneConfig) if kind == "algorithm" else ("pretrain", PretrainConfig)
    chosen = {kind: "mine"} | ({"corruption": "patch"} if option == "patch_size" else {})
    with pytest.raises(UserError, match=message):
        config.of(**chosen)
    assert f"'{option}'" in rejection(
        [stage, *(f"--{name.replace('_', '-')}={value}" for name, value in chosen.items())]
    )


@dataclass(frozen=True)
class Dirt(Options):
    def __call__(self, frames, key, number):
        if frames.shape[-1] != 84:
            raise UserError(f"the mask is 84x84, the frames are {frames.shape[-1]}")
        frames[..., :9, :] = 0


def test_corruption_is_checked_on_frames_of_the_dataset(registries, tmp_path):
    registries["corruption"].register("dirt", Dirt)
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25])
    config = PretrainConfig.of("smoke", method="random", corruption="dirt", data=data, out=tmp_path / "out")
    assert pretrain(config).finished


def test_corruption_stages_with_equal_options_are_rejected(registries):
    registries["corruption"].register("mine", option_called("patch_size"))
    assert CorruptionConfig.of("mine", patch_size=5).stages[0].patch_size == 5
    for name in ("mine+patch", "patch+mine"):
        with pytest.raises(UserError, match="both have the setting 'patch_size'"):
            CorruptionConfig.of(name)
