"""Encoders, datasets and agents survive a round trip over the Hub; foreign, damaged and refused content is reported."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import huggingface_hub
import pytest
import yaml

from tests.helpers_bad_input import rejection
from tests.helpers_data import file_bytes, write_fake_set
from tests.helpers_hub import TOKEN, Hub, Repo
from tests.helpers_pages import agent_card
from tests.nn.test_encoder import CARD, make
from vd4rl_pomdp import load_agent
from vd4rl_pomdp.agents import write_rounded
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.hub import LISTING, pull, push
from vd4rl_pomdp.nn import load_encoder, save_encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.files import write_json

ENCODER, SET = "lab/encoder", "datasets/lab/set"
WHERE = {ENCODER: "models/lab/encoder", SET: "datasets/lab/set"}
"""Their repositories on the Hub."""


@pytest.fixture
def hub(monkeypatch) -> Iterator[Hub]:
    """A local Hub that huggingface_hub uses, with a token that may write."""
    hub = Hub()
    server = hub.serve()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr("huggingface_hub.file_download.time.sleep", lambda _: None)
    yield hub
    server.shutdown()
    server.server_close()
    huggingface_hub.close_session()


@pytest.fixture
def encoder(tmp_path) -> Path:
    save_encoder(tmp_path / "run" / "encoder", make("gru", True), CARD, frames=160)
    return tmp_path / "run" / "encoder"


@pytest.fixture
def data(tmp_path) -> Path:
    folder = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25, 30])
    (folder / "card.md").write_text("# A set\n\n![film](card.png)\n")
    (folder / "card.png").write_bytes(b"\x89PNG")
    (folder / ".hidden").write_text("mine")
    last = max(folder.glob("*.hdf5"))
    last.rename(last.with_suffix(".HDF5"))
    return folder


def content(folder: Path) -> dict[str, bytes]:
    """Files of a folder, except hidden ones."""
    return file_bytes(folder, "[!.]*")


def lists(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_encoder_round_trip_over_the_hub(hub, encoder, tmp_path):
    assert "/models/lab/encoder/commit/" in push(encoder, ENCODER)
    (tmp_path / "new" / "encoder").mkdir(parents=True)
    assert pull(ENCODER, tmp_path / "new" / "encoder")
    assert content(tmp_path / "new" / "encoder") == content(encoder)
    assert load_encoder(tmp_path / "new" / "encoder")[1] == CARD
    assert list(hub.large.values()) == [(encoder / "model.safetensors").read_bytes()]
    hub.requests.clear()
    assert not pull(ENCODER, tmp_path / "new" / "encoder")
    assert not any("model.safetensors" in request for request in hub.requests)
    assert lists(tmp_path / "new") == ["encoder"]


def test_dataset_round_trip_over_the_hub(hub, data, tmp_path):
    push(data, SET)
    assert set(hub.files(WHERE[SET])) == {*content(data), "README.md", LISTING, ".gitattributes"}
    hub.repos[WHERE[SET]].commit("main", hub.files(WHERE[SET]) | {"notes.txt": b"the owner's notes"})
    (data / "card.png").unlink()
    push(data, SET)
    assert "card.png" not in hub.files(WHERE[SET])
    assert "notes.txt" in hub.files(WHERE[SET])
    assert pull(SET, tmp_path / "new")
    assert content(tmp_path / "new") == content(data)
    (tmp_path / "new" / "9_more.H5").write_bytes(b"mine")
    with pytest.raises(UserError, match="is not empty and holds something other"):
        pull(SET, tmp_path / "new")


def test_hub_cards_show_license_and_loading_code(hub, encoder, data, monkeypatch, capsys, tmp_path):
    push(encoder, ENCODER, license="apache-2.0")
    push(data, SET)
    cards = {where: hub.files(WHERE[where])["README.md"].decode() for where in (ENCODER, SET)}
    front = {where: yaml.safe_load(card.split("---\n")[1]) for where, card in cards.items()}
    assert (front[ENCODER]["license"], front[SET]["license"]) == ("apache-2.0", "mit")
    assert {"walker_walk", "expert"} <= set(front[SET]["tags"])
    assert "# A set\n\n![film](card.png)" in cards[SET]
    assert "vd4rl-pomdp hub pull datasets/lab/set FOLDER" in cards[SET]
    pull(ENCODER, tmp_path / "new")
    assert huggingface_hub.ModelCard.load(tmp_path / "new" / "README.md").data.license == "apache-2.0"
    code = re.search(r"```python\n(.*?)\n```", cards[ENCODER], re.DOTALL)[1]
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda name: {"lab/encoder": encoder}[name])
    exec(code, {})
    assert capsys.readouterr().out.split() == ["mik+a", "walker_walk", "12"]


def test_agent_round_trip_over_the_hub(hub, encoder, tmp_path):
    Policy(12, 6, 8).save(encoder.parent / "policy")
    write_rounded(encoder.parent, tmp_path / "agent")
    write_json(tmp_path / "agent" / "card.json", agent_card(CARD, tmp_path / "agent") | {"run": "r00"})
    push(encoder, ENCODER)
    push(tmp_path / "agent", ENCODER)  # replaces the encoder
    assert set(hub.files(WHERE[ENCODER])) == {*content(tmp_path / "agent"), "README.md", LISTING, ".gitattributes"}
    assert pull(ENCODER, tmp_path / "new")
    assert not pull(ENCODER, tmp_path / "new")
    assert content(tmp_path / "new") == content(tmp_path / "agent")
    assert load_agent(tmp_path / "new").card["run"] == "r00"
    readme = hub.files(WHERE[ENCODER])["README.md"].decode()
    assert yaml.safe_load(readme.split("---\n")[1])["license"] == "mit"
    write_json(tmp_path / "agent" / "card.json", agent_card(replace(CARD, seed=7), tmp_path / "agent"))
    with pytest.raises(UserError, match=r"its files do not match card\.json"):
        push(tmp_path / "agent", ENCODER)
    (tmp_path / "agent" / "policy" / "config.json").write_text("{}")
    with pytest.raises(UserError, match=r"its files do not match card\.json"):
        push(tmp_path / "agent", ENCODER)


def test_revisions_are_branches_or_commits(hub, encoder, tmp_path):
    push(encoder, ENCODER, private=True)
    assert hub.repos[WHERE[ENCODER]].private
    first = hub.repos[WHERE[ENCODER]].at("main")
    save_encoder(encoder, make("gru", True), replace(CARD, seed=1))
    for _ in range(2):
        push(encoder, ENCODER, revision="seed1")
    assert hub.repos[WHERE[ENCODER]].at("main") == first
    for revision, seed in (("main", 0), ("seed1", 1), (first, 0)):
        pull(ENCODER, tmp_path / revision, revision)
        assert load_encoder(tmp_path / revision)[1].seed == seed
    with pytest.raises(UserError, match=r"lab/encoder: the Hub refused or did not answer .*check the name, --rev"):
        pull(ENCODER, tmp_path / "new", "seed2")
    assert not (tmp_path / "new").exists()


def test_invalid_pushes_are_rejected_before_any_request(hub, encoder, data, tmp_path):
    for text in ("encoder", "datasets/set", "models/lab/encoder", ""):
        with pytest.raises(UserError, match="is not a repository: write OWNER/NAME for an encoder, datasets/OWNER"):
            push(encoder, text)
    for folder, where in ((tmp_path / "run", ENCODER), (encoder, SET), (data, ENCODER)):
        with pytest.raises(UserError, match=f"contains .*, but {where} is a name for"):
            push(folder, where)
    (encoder / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(UserError, match="cannot be read"):
        push(encoder, ENCODER)
    shard = next(data.glob("*.HDF5"))
    shard.write_bytes(shard.read_bytes()[:-99])
    with pytest.raises(UserError, match="is truncated"):
        push(data, SET)
    assert not hub.requests


def test_foreign_repository_is_rejected(hub, encoder, tmp_path):
    repo = hub.repos[WHERE[ENCODER]] = Repo()
    repo.commit("main", {"pytorch_model.bin": b"pickle", "README.md": b""})
    with pytest.raises(UserError, match=r"lab/encoder: holds files that were not pushed by vd4rl-pomdp; choose"):
        push(encoder, ENCODER, revision="v1")
    with pytest.raises(UserError, match=r"lab/encoder: the Hub refused"):
        pull(ENCODER, tmp_path / "new")
    assert set(hub.files(WHERE[ENCODER])) == {"pytorch_model.bin", "README.md"}
    assert set(repo.branches) == {"main"}
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2},
        {"kind": "a data set"},
        {"sha256": {}},
        {"sha256": {"config.json": ""}},
        {"sha256": {"config.json": "", "model.safetensors": "", "../x.md": ""}},
    ],
)
def test_invalid_listing_is_rejected(hub, encoder, tmp_path, change):
    push(encoder, ENCODER)
    listing = json.loads(hub.files(WHERE[ENCODER])[LISTING]) | change
    hub.repos[WHERE[ENCODER]].commit("main", hub.files(WHERE[ENCODER]) | {LISTING: json.dumps(listing).encode()})
    with pytest.raises(UserError, match=r"lab/encoder: its vd4rl_pomdp\.json is of another version or damaged"):
        pull(ENCODER, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_dataset_with_other_files_is_rejected(hub, data, tmp_path):
    push(data, SET)
    whole = json.loads(hub.files(WHERE[SET])[LISTING])
    for name in ("notes.txt", "\x1b[31mnotes.md"):
        listing = whole | {"sha256": whole["sha256"] | {name: ""}}
        hub.repos[WHERE[SET]].commit("main", hub.files(WHERE[SET]) | {LISTING: json.dumps(listing).encode()})
        with pytest.raises(UserError, match=r"lab/set: its vd4rl_pomdp\.json is of another version or damaged"):
            pull(SET, tmp_path / "new")


def test_files_that_a_dataset_links_to_elsewhere_are_not_pushed(hub, data, tmp_path):
    (tmp_path / "private.json").write_text("{}")
    (data / "more.json").symlink_to(tmp_path / "private.json")
    with pytest.raises(UserError, match=r"more\.json: links to a file outside .*expert; replace it by a copy"):
        push(data, SET)
    assert not hub.repos


def test_dataset_files_with_brackets_are_pulled(hub, data, tmp_path):
    (data / "returns[all].png").write_bytes(b"\x89PNG")
    push(data, SET)
    assert pull(SET, tmp_path / "new")
    assert (tmp_path / "new" / "returns[all].png").read_bytes() == b"\x89PNG"


def test_damaged_download_is_fetched_again(hub, encoder, tmp_path):
    push(encoder, ENCODER)
    hub.damaged.add("model.safetensors")
    with pytest.raises(UserError, match=r"lab/encoder: model\.safetensors has a wrong SHA-256 and was removed; pull"):
        pull(ENCODER, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    hub.damaged.clear()
    hub.requests.clear()
    pull(ENCODER, tmp_path / "new")
    gets = [request for request in hub.requests if request.startswith("GET") and "/resolve/" in request]
    assert not any("config.json" in request for request in gets)
    assert content(tmp_path / "new") == content(encoder)
    assert lists(tmp_path) == ["new", "run"]


FOREIGN = {
    "a file": lambda path: path.write_text("mine"),
    "a link": lambda path: path.symlink_to("nowhere"),
    "an encoder": lambda path: save_encoder(path, make("gru", True), replace(CARD, seed=7)),
    "a folder": lambda path: (path.mkdir(), (path / ".env").write_text("mine")),
}


def test_pull_refuses_a_mount_point_before_the_download(hub, encoder, tmp_path, monkeypatch):
    push(encoder, ENCODER)
    (tmp_path / "disk").mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path) == tmp_path / "disk")
    with pytest.raises(UserError, match="disk: is a mount point; choose a folder in it"):
        pull(ENCODER, tmp_path / "disk")
    assert lists(tmp_path) == ["disk", "run"]
    assert pull(ENCODER, tmp_path / "disk" / "encoder")


@pytest.mark.parametrize("write", FOREIGN.values(), ids=FOREIGN)
def test_pull_does_not_overwrite_foreign_files(hub, encoder, tmp_path, write):
    push(encoder, ENCODER)
    write(tmp_path / "there")
    before = content(tmp_path)
    with pytest.raises(UserError, match="is not empty and holds something other than lab/encoder; choose another"):
        pull(ENCODER, tmp_path / "there")
    assert content(tmp_path) == before
    assert lists(tmp_path) == ["run", "there"]


@pytest.mark.parametrize(("path", "status"), [("/preupload/", 500), ("/commit/", 403)])
def test_failed_push_leaves_the_repository_unchanged(hub, encoder, monkeypatch, path, status):
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)
    push(encoder, ENCODER)
    save_encoder(encoder, make("gru", True), replace(CARD, seed=1))
    before = hub.files(WHERE[ENCODER])
    hub.status = {path: status}
    with pytest.raises(UserError, match=f"lab/encoder: the Hub refused or did not answer .*{status}"):
        push(encoder, ENCODER)
    assert hub.files(WHERE[ENCODER]) == before


def test_unreachable_hub_leaves_nothing(encoder, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)
    monkeypatch.setenv("NO_PROXY", "*")
    for act in (lambda: pull(ENCODER, tmp_path / "new"), lambda: push(encoder, ENCODER)):
        with pytest.raises(UserError, match=r"lab/encoder: the Hub refused or did not answer .*and the network"):
            act()
    assert lists(tmp_path) == ["run"]


def test_hub_commands(hub, encoder, tmp_path, capsys):
    main(["hub", "push", str(encoder), "lab/encoder", "--private", "--revision", "v1"])
    assert "/models/lab/encoder/commit/" in capsys.readouterr().out
    new = str(tmp_path / "new")
    for message in ("downloaded and verified", "already present and verified"):
        main(["hub", "pull", "lab/encoder", new, "--revision", "v1"])
        assert tuple(capsys.readouterr()) == (f"{new}: {message}\n", "")
    assert rejection(["hub", "pull", "lab/nothing", new]).startswith("error: lab/nothing: the Hub refused")
