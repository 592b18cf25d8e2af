"""An encoder's model card: content, escaping and code example."""

import json
import re
from dataclasses import replace

import pytest
import yaml
from huggingface_hub import ModelCard

from tests.nn.test_encoder import CARD, make
from vd4rl_pomdp.nn.encoder_folder import (
    copy_encoder,
    encoder_hash,
    model_card,
    read_record,
    record_probe,
    save_encoder,
)


def cells(text: str) -> dict[str, str]:
    return dict(re.findall(r"^\| ([^|]+) \| (.*) \|$", text, re.MULTILINE))


@pytest.fixture
def folder(tmp_path):
    card = replace(CARD, data="f00d", settings={"max_k": 15}, corruption={"corruption": "patch", "patch_size": 8})
    save_encoder(tmp_path / "encoder", make("gru", True), card, frames=10 * 2 * 8)
    return tmp_path / "encoder"


def test_model_card_matches_the_config(folder):
    card = ModelCard.load(folder / "README.md")
    assert (card.data.license, card.data.library_name) == ("mit", "vd4rl-pomdp")
    assert {"mik+a", "walker_walk", "patch", "offline-reinforcement-learning"} <= set(card.data.tags)
    shown = cells(card.text)
    assert (shown["method"], shown["data"], shown["seed"]) == ("`mik+a`", "fingerprint `f00d`", "0")
    assert json.loads(shown["corruption"].strip("`")) == {"corruption": "patch", "patch_size": 8}
    assert shown["budget"] == "preset `smoke`, 10 gradient steps, 160 frames"
    assert (shown["linear probe"], shown["licence"]) == ("not measured", "`mit`")
    made = read_record(folder)
    assert shown["made by"] == f"vd4rl-pomdp {made.version}" + (f", commit `{made.commit}`" if made.commit else "")
    settings = json.loads(re.search(r"```json\n(.*)\n```", card.text, re.DOTALL)[1])
    assert settings == json.loads((folder / "config.json").read_text())["pretrain"]


def test_code_of_model_card_loads_the_encoder(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    block = re.search(r"```python\n(.*?)\n```", (folder / "README.md").read_text(), re.DOTALL)[1]
    exec(block, {})
    assert capsys.readouterr().out.split() == ["mik+a", "walker_walk", "12"]


def test_encoder_hash_depends_on_weights_and_config(folder, tmp_path):
    name = encoder_hash(folder)
    record_probe(folder, {"probe_pose": 12.34, "probe_velocity": 56.0})
    assert encoder_hash(folder) == name
    config = json.loads((folder / "config.json").read_text())
    (folder / "README.md").unlink()
    (folder / "config.json").write_text(json.dumps(config | {"commit": "f00d"}))
    assert encoder_hash(folder) == name
    (folder / "config.json").write_text(json.dumps(config | {"pretrain": config["pretrain"] | {"seed": 1}}))
    assert encoder_hash(folder) != name


def test_model_card_shows_the_probe(folder, tmp_path):
    record_probe(folder, {"probe_pose": 12.34, "probe_velocity": 56.0})
    copy_encoder(folder, tmp_path / "copy", {"readout": "state"})
    probe = cells((tmp_path / "copy" / "README.md").read_text())["linear probe"]
    assert probe == "error of pose 12.3%, velocity 56.0% of a standard deviation, on held-out episodes"
    before, copied = read_record(folder), read_record(tmp_path / "copy")
    assert copied == replace(before, encoder=replace(before.encoder, readout="state"))


@pytest.mark.parametrize(
    ("card", "frames", "budget"),
    [
        (CARD, None, "preset `smoke`, 10 gradient steps"),
        (CARD, 0, "none: it is not trained"),
        (replace(CARD, end_to_end="bc"), 0, "no pretraining: `bc` trains it with the policy"),
    ],
)
def test_model_card_shows_the_budget(folder, card, frames, budget):
    text = model_card(replace(read_record(folder), pretrain=card, frames=frames))
    assert cells(text)["budget"] == budget


def test_model_card_escapes_names(folder):
    record = read_record(folder)
    name = 'my: "method" | `x`\n---\n'
    text = model_card(replace(record, pretrain=replace(record.pretrain, method=name)), license="apache-2.0")
    front = yaml.safe_load(text.split("---\n")[1])
    assert front["license"] == "apache-2.0"
    assert front["tags"][-3] == 'my: "method" | `x` ---'
    assert cells(text.replace(r"\|", "/"))["method"].strip("` ") == 'my: "method" / `x` ---'
