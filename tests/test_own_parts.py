"""The documentation's examples of parts of one's own, each executed as it stands; test_own_task has tasks."""

import csv
import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import pytest

from finetune.algorithms import BC
from finetune.config import FinetuneConfig
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS, Method
from pretrain.objectives.all_history import AllHistory
from pretrain.train import pretrain
from tests.helpers_data import write_fake_set
from tests.helpers_pages import isolated_registries, load_example, write_example
from vd4rl_pomdp import testing
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Options, flat
from vd4rl_pomdp.core.registry import REGISTRIES
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.nn.frame import FrameEncoderPart, FrameOptions
from vd4rl_pomdp.nn.objective import InverseOptions
from vd4rl_pomdp.report import write_report

BY_CALL = "registered by a call"
EXAMPLES = {
    "method": ("past_to_frame", "future_dim", 16),
    "corruption": ("bars", "bar_height", 24),
    "algorithm": ("filtered_bc", "cloned_share", 0.25),
    "frame_encoder": ("tiny", "tiny_channels", 12),
}
"""Kind: name of the part on its page, an option of its own and a value that is not the default."""
USED_IN = {
    "method": ["pretrain"],
    "corruption": ["pretrain", "finetune"],
    "algorithm": ["finetune"],
    "frame_encoder": ["pretrain", "finetune"],
}
"""Kind: the stages that run its code; the first is told of it by name."""
PLAYED = ("corruption", "frame_encoder")
"""Kinds that worker processes meet when they evaluate: they run the script's module level."""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Imports a page's file as a module; what it registers is forgotten at the end."""
    with isolated_registries():
        yield lambda kind: load_example(f"my_{kind}.py", tmp_path, monkeypatch)


def run(script: Path, line: str, folder: Path) -> None:
    """Run a command line of a script."""
    environment = os.environ | {"VD4RL_POMDP_CACHE": str(folder / "cache")}
    command = [sys.executable, str(script), *line.split()]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("kind", EXAMPLES)
def test_an_example_runs_through_every_stage_and_the_record_names_it(tmp_path, kind):
    name, option, value = EXAMPLES[kind]
    script, runs = write_example(f"my_{kind}.py", tmp_path), tmp_path / "runs"
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25, 30])
    flags = f"--{kind} {name} --{option} {value} ".replace("_", "-").replace(name.replace("_", "-"), name)
    first, second = ("", flags) if kind == "algorithm" else (flags, "")
    common = f"--preset smoke --data {data}"
    run(script, f"pretrain {first} {common} --out {runs}/pretrain", tmp_path)
    finetune = f"finetune {second} --encoder {runs}/pretrain/encoder {common} --out {runs}/finetune"
    workers = 2 if kind in PLAYED else 1
    run(script, f"{finetune} --workers {workers} --eval-episodes 2", tmp_path)
    write_report([runs], tmp_path / "report")
    records = {stage: json.loads((runs / stage / "config.json").read_text()) for stage in ("pretrain", "finetune")}
    for stage in USED_IN[kind]:
        assert records[stage]["plugins"] == {f"{kind} {name}": BY_CALL}
        assert records[stage]["sources"][f"{kind} {name}"].startswith(f"my_{kind}.py ")
    config = records[USED_IN[kind][0]]["config"]
    assert (config[kind], config[option]) == (name, value)
    (row,) = csv.DictReader((tmp_path / "report" / "summary.csv").open())
    assert row.get(kind, name) == name
    rows = list(csv.DictReader((runs / "finetune" / "episodes.csv").open()))
    as_trained = [row for row in rows if row["evaluated_under"] == row["corruption"]]
    assert len(as_trained) == 2 * 2, "two evaluations of two"
    assert len(rows) - len(as_trained) == (0 if as_trained[0]["corruption"] == "none" else 2), (
        "the last one is clean, too"
    )


@pytest.mark.parametrize("kind", EXAMPLES)
def test_help_shows_an_examples_flag_where_its_part_is_chosen_and_list_shows_the_part(load, capsys, monkeypatch, kind):
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
def test_an_example_keeps_the_promises_of_its_kind(load, kind):
    name, option, value = EXAMPLES[kind]
    load(kind)
    check = getattr(testing, f"check_{kind}")
    check(name)
    check(name, **{option: value})


def test_a_wrong_claim_of_the_example_is_caught(load):
    load("method").PastToFrame.visible = lambda self, t, k, rows: ({t, t + k}, set())
    with pytest.raises(AssertionError, match=r"method 'past_to_frame' breaks a promise(.|\n)*is declared to see rows"):
        testing.check_method("past_to_frame")


class Stage(FrameOptions):
    """What may be the options of every kind."""

    def __call__(self, frames, key, number):
        frames[..., :9, :] = 0


class Undecorated(Stage):
    width: int = 3


class OtherDefault(Stage):
    feature_dim: int = 3


@dataclass(frozen=True)
class Required(Stage):
    width: int = field(kw_only=True)


@dataclass(frozen=True)
class Listed(Stage):
    columns: tuple[int, ...] = (3, 4)


@dataclass(frozen=True)
class NoneListed(Stage):
    columns: tuple[int, ...] = ()


@dataclass(frozen=True)
class Placed(Stage):
    file: Path = field(default_factory=Path)


@dataclass(frozen=True)
class Hiding(Stage):
    check: bool = False


@dataclass(frozen=True)
class Misspelt(Stage):
    width: int = 3
    limits: ClassVar = {"widht": 1}


@dataclass(frozen=True)
class LimitedWord(Stage):
    width: str = "wide"
    limits: ClassVar = {"width": 1}


@dataclass(frozen=True)
class Kept(Stage):
    width: int | None = None
    share: float = 0.5
    flag: bool = True
    word: str = "a"
    limits: ClassVar = {"width": 1, "share": (0, 1), "feature_dim": 1}


class Inherited(Kept):
    """Adds no option, so that it needs no decorator."""

    summary: ClassVar[str] = "the same"


def part_with(kind: str, options: object) -> object:
    """A part of a kind whose options are what is given."""
    if kind == "method":
        return Method(METHODS["curl"].build, options=options)
    if kind == "frame_encoder":
        return FrameEncoderPart(lambda channels, size, options: None, options)
    return type("Mine", (BC,), {"options": options}) if kind == "algorithm" else options


@pytest.fixture
def registries():
    with isolated_registries():
        yield REGISTRIES


@pytest.mark.parametrize("kind", EXAMPLES)
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (Undecorated, "Undecorated has options, but is no dataclass: write @dataclass"),
        (OtherDefault, "OtherDefault has options, but is no dataclass"),
        (Required, "the option 'width' of Required needs a default that is a number, a word"),
        (Listed, "the option 'columns' of Listed needs a default"),
        (NoneListed, "the option 'columns' of NoneListed needs a default"),
        (Placed, "the option 'file' of Placed needs a default"),
        (Hiding, "the option 'check' of Hiding hides Options.check: rename it"),
        (Misspelt, "limits of Misspelt name 'widht', which is no number among its options: mend the name"),
        (LimitedWord, "limits of LimitedWord name 'width'"),
    ],
)
def test_options_that_flags_or_records_would_lose_are_refused_where_a_part_is_registered(
    registries, kind, options, told
):
    what = f"{registries[kind].kind} 'mine': {told}"
    with pytest.raises(UserError, match=what) as caught:
        registries[kind].register("mine", part_with(kind, options))
    assert "\n" not in str(caught.value)
    assert "mine" not in registries[kind]


@pytest.mark.parametrize("kind", [kind for kind in EXAMPLES if kind != "corruption"])
@pytest.mark.parametrize("options", [Kept(width=3), None, str])
def test_what_is_no_class_of_options_is_refused(registries, kind, options):
    with pytest.raises(UserError, match=r"'mine': its options are .*: name a class that is derived from vd4rl_pomdp\."):
        registries[kind].register("mine", part_with(kind, options))


def test_a_method_that_predicts_actions_has_their_options(registries):
    with pytest.raises(UserError, match="whose objective predicts actions has their options: say options="):
        Method(AllHistory)


def test_the_options_of_a_frame_encoder_have_its_width(registries):
    with pytest.raises(
        UserError, match=r"its options are .*: name a class that is derived from .*\.frame\.FrameOptions"
    ):
        registries["frame_encoder"].register("mine", part_with("frame_encoder", Options))


@pytest.mark.parametrize("kind", EXAMPLES)
@pytest.mark.parametrize("options", [Kept, Inherited])
def test_numbers_words_truth_values_and_none_are_options_of_every_kind(registries, kind, options):
    registries[kind].register("mine", part_with(kind, options))


@dataclass(frozen=True)
class Codes(InverseOptions):
    """An option of its action target's name."""

    codes: int = 3

    __call__ = Stage.__call__


def test_a_part_with_two_options_of_one_name_is_refused(registries):
    with pytest.raises(UserError, match="method 'mine': CodeOptions and Codes both have the setting 'codes'"):
        registries["method"].register("mine", Method(METHODS["mik"].build, options=Codes))


def option_called(name: str, base: type[Options] = Options) -> type[Options]:
    """A class with one option more, that is a stage, too."""
    fields = {"__annotations__": {name: int}, name: 3, "__call__": Stage.__call__}
    return dataclass(frozen=True)(type("Mine", (base,), fields))


@pytest.mark.parametrize(
    ("kind", "option", "owner"),
    [
        ("method", "steps", "PretrainConfig"),
        ("method", "feature_dim", "FrameOptions"),
        ("method", "patch_size", "Patch"),
        ("corruption", "window", "PretrainConfig"),
        ("corruption", "corruption_mode", "CorruptionConfig"),
        ("corruption", "max_k", "InverseOptions|MaskedActionOptions"),
        ("frame_encoder", "hidden_dim", "GRUOptions"),
        ("algorithm", "updates", "FinetuneConfig"),
        ("algorithm", "readout", "HistoryOptions"),
    ],
)
def test_an_option_with_the_name_of_another_setting_is_refused_wherever_both_are_chosen(
    registries, capsys, kind, option, owner
):
    options = option_called(option, FrameOptions if kind == "frame_encoder" else Options)
    registries[kind].register("mine", part_with(kind, options))
    told = rf"(({owner}) and Mine|Mine and ({owner})) both have the setting '{option}', and --.* cannot set two: rename"
    stage, config = ("finetune", FinetuneConfig) if kind == "algorithm" else ("pretrain", PretrainConfig)
    chosen = {kind: "mine"} | ({"corruption": "patch"} if option == "patch_size" else {})
    with pytest.raises(UserError, match=told):
        config.of(**chosen)
    with pytest.raises(UserError, match=told):
        getattr(testing, f"check_{kind}")("mine")
    with pytest.raises(SystemExit) as end:
        main([stage, *(f"--{name.replace('_', '-')}={value}" for name, value in chosen.items())])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"'{option}'" in line


@pytest.mark.parametrize("option", ["quality", "method", "seed", "encoder", "eval_clean", "workers", "format", "help"])
@pytest.mark.parametrize("kind", EXAMPLES)
def test_an_option_with_a_name_by_which_runs_are_known_is_refused(registries, kind, option):
    options = option_called(option, FrameOptions if kind == "frame_encoder" else Options)
    with pytest.raises(UserError, match=f"'mine': the option '{option}' of Mine has a name by which runs are known"):
        registries[kind].register("mine", part_with(kind, options))


@dataclass(frozen=True)
class Scaled(Options):
    scale: float = 1
    least: float | None = None

    __call__ = Stage.__call__


def test_an_integer_that_stands_for_a_float_is_one_in_every_record(registries):
    registries["corruption"].register("mine", Scaled)
    told = [{}, {"scale": 1}, {"scale": 1.0, "least": None}, {"least": 2}]
    records = [json.dumps(flat(PretrainConfig.of(corruption="mine", **settings)), default=str) for settings in told]
    assert records[0] == records[1] == records[2] != records[3]
    assert '"scale": 1.0, "least": 2.0' in records[3]
    whole, decimal = (PretrainConfig.of("smoke", self_prediction=value).options for value in (1, 1.0))
    assert str(whole) == str(decimal)


@dataclass(frozen=True)
class Dirt(Options):
    def __call__(self, frames, key, number):
        if frames.shape[-1] != 84:
            raise UserError(f"the mask is 84x84, the frames are {frames.shape[-1]}")
        frames[..., :9, :] = 0


def test_a_corruption_that_fits_the_set_is_not_tried_on_other_frames(registries, tmp_path, monkeypatch):
    monkeypatch.setenv("VD4RL_POMDP_CACHE", str(tmp_path / "cache"))
    registries["corruption"].register("dirt", Dirt)
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25])
    config = PretrainConfig.of("smoke", method="random", corruption="dirt", data=data, out=tmp_path / "out")
    assert pretrain(config).finished


def test_two_stages_with_an_option_of_one_name_are_not_chosen_together(registries):
    registries["corruption"].register("mine", option_called("patch_size"))
    assert CorruptionConfig.of("mine", patch_size=5).stages[0].patch_size == 5
    for name in ("mine+patch", "patch+mine"):
        with pytest.raises(UserError, match="both have the setting 'patch_size'"):
            CorruptionConfig.of(name)


def test_a_stage_that_is_named_twice_is_one_line_on_the_command_line(capsys):
    with pytest.raises(SystemExit) as end:
        main(["pretrain", "--corruption", "patch+patch"])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "corruption 'patch+patch' names patch twice" in line
