"""Certificates: training, verdicts, and where they are shown."""

import json
import re
from html import unescape

import numpy as np
import pytest

from tests.helpers_bad_input import rejection
from tests.helpers_data import write_fake_set
from tests.helpers_report import describe, without_figures, write_run
from tests.helpers_stages import contents
from vd4rl_pomdp.cli import main, studies
from vd4rl_pomdp.runs.outputs import owned
from vd4rl_pomdp.runs.results import certificate_id, keep_certificates
from vd4rl_pomdp.studies.certify import FLOORS, MEMORY, NEEDS, NEEDS_NOT, OPEN, judge


@pytest.fixture
def executed(monkeypatch):
    """Command lines of sweep jobs, which run in this process."""
    done = []

    def carry_out(plans, *_):
        for job in (job for job in plans[0].jobs if not job.finished):
            done.append(job.words)
            main(job.words)

    monkeypatch.setattr(studies, "carry_out", carry_out)
    return done


SMALL = "preset=smoke seed=0 pretrain.steps=1 pretrain.patch_size=24"
POLICIES = (
    "finetune.updates=5 finetune.eval_every=5 finetune.eval_episodes=2 finetune.eval_length=2 finetune.eval_clean=false"
)


def test_certificate_is_computed_stored_and_shown(states, executed, tmp_path, monkeypatch, capsys):
    out = tmp_path / "certified"
    words = ["certify", str(states), "patch", "--out", str(out), "--change", *SMALL.split()]
    main(words)
    trained = [f"{method}/seed0/pretrain" for method in (MEMORY, *FLOORS)]
    assert [line[-1].removeprefix(f"{out}/") for line in executed] == trained
    assert all("--hold-out" in line and "24" in line for line in executed)
    (certificate,) = json.loads((out / "certificates.json").read_text()).values()
    assert certificate["name"] == "patch, patch_size 24"
    assert certificate["why"].startswith("R2: supervised+a -")
    assert certificate["why"].endswith(", too few seeds, itself too low to judge; 1 steps, no returns")
    assert (states / "certificates.json").read_bytes() == (out / "certificates.json").read_bytes()
    assert f"patch: {certificate['verdict']} ({certificate['why']})" in capsys.readouterr().out
    (states / "certificates.json").unlink()
    (states / "certificates.json").mkdir()  # a file that cannot be written, as in a read-only dataset
    main(words)
    shown = capsys.readouterr()
    assert f"patch: {certificate['verdict']} ({certificate['why']})" in shown.out
    assert f"the certificate is only in {out}" in shown.err
    (states / "certificates.json").rmdir()
    with owned(states):  # by another certificate of the dataset: written at once, one of them would be lost
        main(words)
    shown = capsys.readouterr()
    assert re.search(f"is in use by .*; the certificate is only in {out}", shown.err)

    before, executed[:] = contents(out / MEMORY), []
    main([*words, *POLICIES.split(), "--returns"])
    assert [line[0] for line in executed].count("pretrain") == 1, "only the state reference"
    assert [line[0] for line in executed].count("finetune") == 4
    kept = contents(out / MEMORY)
    assert {name: kept[name] for name in before} == before, "finished runs are not trained again"
    (certificate,) = json.loads((out / "certificates.json").read_text()).values()
    assert "returns: state returns " in certificate["why"]
    assert "critics are not known to have converged" in certificate["why"]
    assert certificate["measured"]["returns"]["verdict"] == OPEN
    assert certificate["why"].endswith("; 1 steps, 5 updates")
    main(["data", "card", str(states)])
    (states / "certificates.json").unlink()
    main([*words, *POLICIES.split(), "--returns"])
    main([*words[:4], str(tmp_path / "again"), *words[5:]])  # smaller budget, without policies
    assert json.loads((states / "certificates.json").read_text()).popitem()[1]["why"] == certificate["why"]
    assert f"| memory under patch, patch_size 24 | {certificate['verdict']} (" in (states / "card.md").read_text()
    without_figures(monkeypatch)
    line = f"memory: {certificate['verdict']} ({certificate['why']})"
    (states / "certificates.json").unlink()
    main(["results", "add", str(out), "--out", str(tmp_path / "kept")])
    for source, target in ((out, "first"), (tmp_path / "kept", "second"), (tmp_path / "first", "third")):
        capsys.readouterr()
        main(["report", str(source), "--out", str(tmp_path / target)])
        assert line in " ".join(capsys.readouterr().out.split())
        assert line.replace("memory", "Memory") in unescape((tmp_path / target / "index.html").read_text())
    capsys.readouterr()
    main(["report", "compare", str(tmp_path / "kept"), str(out), "--out", str(tmp_path / "both")])
    assert line in " ".join(capsys.readouterr().out.split())
    assert line.replace("memory", "Memory") in unescape((tmp_path / "both" / "index.html").read_text())


def test_runs_on_another_dataset_do_not_count(states, executed, tmp_path, capsys):
    words = ["patch", "--out", str(tmp_path / "certified"), "--change", *SMALL.split()]
    main(["certify", str(states), *words])
    other = write_fake_set(tmp_path / "walker_walk" / "medium", [9] * 10, physics_dim=18)
    with pytest.raises(SystemExit):
        main(["certify", str(other), *words])
    assert "the content of --data" in capsys.readouterr().err
    assert not (other / "certificates.json").exists()


def test_missing_certificate_is_reported(tmp_path, monkeypatch, capsys):
    without_figures(monkeypatch)
    for method in ("acro", "mik+a"):
        describe(write_run(tmp_path / "runs" / method, method, 0, {10: [20.0]}), {}, data="f00")
    certificate = {"data": "f00", "corruption": {}, "name": "patch", "verdict": NEEDS, "why": "it does", "made": "2026"}
    certificate |= {"measured": {}, "budget": {}}
    hidden = {"corruption": "patch", "patch_size": 16}
    for data, corruption in (("f01", hidden), ("f00", hidden | {"patch_size": 24})):
        keep_certificates(tmp_path / "runs", {certificate_id(data, corruption): certificate})
    report = ["report", str(tmp_path / "runs"), "--out", str(tmp_path / "report")]
    main(report)
    assert "memory: not certified\n" in capsys.readouterr().out
    assert not (tmp_path / "report" / "certificates.json").exists()
    for year in ("2027", "2026"):  # the newest of equal budget counts
        (tmp_path / "runs" / year).mkdir()
        dated = certificate | {"made": year, "why": f"in {year}"}
        keep_certificates(tmp_path / "runs" / year, {certificate_id("f00", hidden): dated})
    main(report)
    assert f"memory: {NEEDS} (in 2027)\n" in capsys.readouterr().out


def test_verdict_follows_from_both_intervals():
    def verdict(over_picture, over_integrator, seeds=3, spread=0.01, unit=1.0, level=0.9):
        g = np.random.default_rng(0)
        levels = {MEMORY: level, FLOORS[0]: level - over_picture, FLOORS[1]: level - over_integrator}
        values = {name: unit * (level + spread * g.normal(size=(seeds, 20))) for name, level in levels.items()}
        return judge(values, unit, 2)["verdict"]

    assert verdict(0.4, 0.3) == NEEDS
    assert verdict(40, 30, unit=100) == NEEDS
    assert verdict(0.4, 0.0) == NEEDS_NOT, "the integrator is as good"
    assert verdict(0.0, 0.4) == NEEDS_NOT, "one observation is as good"
    assert verdict(0.4, 0.03) == NEEDS_NOT, "less than the margin"
    assert verdict(0.4, -0.3) == NEEDS_NOT
    assert verdict(0.4, 0.0, level=0.45) == OPEN, "the memory is too poor to judge, perhaps for lack of budget"
    assert verdict(0.4, 0.3, level=0.45) == NEEDS
    assert verdict(0.4, 0.3, level=-0.1) == OPEN, "worse than predicting the mean"
    assert verdict(0.4, 0.1, spread=1) == OPEN
    assert verdict(0.4, 0.3, seeds=1) == OPEN


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--change", "finetune.updates=3"], "are trained with --returns: add it"),
        (["--change", "pretrain.steps=1,2"], "lists several values of a setting"),
        (["--change", "pretrain.nonsense=1"], "nonsense"),
        (["--jobs", "-1"], "--jobs is -1"),
    ],
)
def test_invalid_input_trains_nothing(states, executed, tmp_path, words, line):
    assert line in rejection(["certify", str(states), "patch", "--out", str(tmp_path / "out"), *words])
    assert executed == []
